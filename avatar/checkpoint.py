"""Checkpoints of a training run: what it was at a step, whether it may continue, and interrupts that wait for the step's end."""

from __future__ import annotations

import copy
import hashlib
import io
import json
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import nn

from workflow import step

BAD_WINDOW = 200  # steps over which bad ones are counted


@dataclass
class State:
    """What a checkpoint holds besides the weights."""

    step: int = 0
    seconds: float = 0.0
    skipped: int = 0
    evaluations: int = 0
    curve: list[list[float]] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)  # since the curve's last row
    recent: deque[bool] = field(default_factory=lambda: deque(maxlen=BAD_WINDOW))
    planned: int = 0  # steps that `avatar.budget` planned; 0 before it did
    decisions: list[dict] = field(default_factory=list)  # and with what reasons
    ended: bool = False  # before all steps: a plateau


@contextmanager
def deferred_interrupts() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM in the list that is returned instead of stopping in the middle of a step.

    A second signal stops at once. Outside the main thread, where Python allows no handlers, nothing is deferred.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return

    def handler(number: int, frame: object) -> None:
        received.append(number)
        if len(received) > 1:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield received
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def fingerprint(job: step.Job) -> str:
    """Digest of all that a checkpoint depends on: config, code, inputs, versions, device kind and threads."""
    digest = hashlib.sha256()
    provenance = job.provenance()
    digest.update(
        json.dumps([provenance[key] for key in ("config", "code", "versions", "device", "threads")], sort_keys=True).encode()
    )
    for name in ("head", "frames", "alpha", "track", "split", "vgg"):
        if not (path := getattr(job.input, name, None)):
            continue  # not every representation reads each of them
        with open(path, "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def write(path: Path, content: dict) -> None:
    """`torch.save` by way of memory: on a full disk the file's own write raises OSError, which the harness has a sentence for."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    path.write_bytes(buffer.getbuffer())


def save(path: Path, mark: str, state: State, avatar: nn.Module, optimiser: torch.optim.Optimizer) -> None:
    """Replace the checkpoint in one rename."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_suffix(".partial")
    write(
        temporary,
        {
            "fingerprint": mark,
            "state": vars(state) | {"recent": list(state.recent)},
            "avatar": avatar.state_dict(),
            "optimiser": optimiser.state_dict(),
        },
    )
    os.replace(temporary, path)


def resume(job: step.Job, path: Path, mark: str, avatar: nn.Module, optimiser: torch.optim.Optimizer) -> State:
    """The state to continue from: the checkpoint's when it was made by equal code, config and inputs, else a new one."""
    if not path.exists():
        return State()
    fresh = None
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
        if stored["fingerprint"] != mark:
            job.log.info("starting afresh: the checkpoint %s was made with another config, code or input", path)
            return State()
        fresh = copy.deepcopy((avatar.state_dict(), optimiser.state_dict()))
        avatar.load_state_dict(stored["avatar"])
        optimiser.load_state_dict(stored["optimiser"])
    except (RuntimeError, KeyError, EOFError, OSError, ValueError, pickle.UnpicklingError) as error:
        job.log.info("starting afresh: the checkpoint %s cannot be read (%s)", path, error)
        if fresh:  # it may have been read in part
            avatar.load_state_dict(fresh[0])
            optimiser.load_state_dict(fresh[1])
        return State()
    state = State(**stored["state"] | {"recent": deque(stored["state"]["recent"], maxlen=BAD_WINDOW)})
    job.log.info("continuing at step %d of %d", state.step, job.config.steps)
    return state
