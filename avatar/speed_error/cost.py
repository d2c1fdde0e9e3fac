"""Step: seconds and memory of one amount of work: training frames, pixels of a picture, or vertices of the head model.

    python -m avatar.speed_error.cost --config '{"kind": "vertices", "amount": 10000}' --input head=... frames=... alpha=... \\
        track=... split=... avatar=... report=... --output row=...

A process of its own for each amount, so that its peak memory is that amount's. Times are medians, after first calls that
compile and fill caches.
"""

from __future__ import annotations

import json
import resource
import shutil
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from avatar import build, train
from avatar.checkpoint import State
from avatar.config import RenderConfig, modules_of
from avatar.dataset import Scene
from avatar.frames import chosen_frames
from avatar.networks import best_precision
from avatar.speed_error import resample
from avatar.speed_error.config import CostConfig
from fitting.files import load_head
from workflow import step

WARM_UP = 3  # steps before the clock counts


def run(job: step.Job) -> None:
    """Write the row."""
    report = step.read_json(job.input.report)
    if job.config.kind == "pixels" and "failed" in report:
        job.write_json(job.output.row, {"failed": report["failed"]})
        return
    work = job.final.row.with_suffix("")
    work.mkdir(parents=True, exist_ok=True)
    try:
        measured = {"frames": of_frames, "pixels": of_pixels, "vertices": of_vertices}[job.config.kind](job, work)
    finally:
        shutil.rmtree(work)
    memory = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    job.write_json(job.output.row, measured | {"memory_mb": memory, "threads": torch.get_num_threads()})
    job.log.info("%s %d: %s, %d MB", job.config.kind, job.config.amount, measured, memory)


def of_frames(job: step.Job, work: Path) -> dict[str, Any]:
    """Training on evenly spaced frames, as many as are asked for."""
    split = step.read_json(job.input.split)
    split["train"] = chosen_frames(split["train"], job.config.amount)
    (work / "split.json").write_text(json.dumps(split), encoding="utf-8")
    return {"amount": len(split["train"])} | trained(job, split=work / "split.json")[1]


def of_vertices(job: step.Job, work: Path) -> dict[str, Any]:
    """Training steps and pictures with the head model resampled; the shell is measured again."""
    head = resample.resampled(load_head(job.input.head), job.config.amount)
    head.save(work / "head.npz")
    with np.load(job.input.track, allow_pickle=False) as file:
        track = {name: file[name] for name in file.files} | {"head_digest": np.array(head.digest)}
    np.savez(work / "track.npz", **track)
    learner, found = trained(job, head=work / "head.npz", track=work / "track.npz")
    frames = chosen_frames(step.read_json(job.input.split)["test"], job.config.pictures)
    return {"amount": head.vertex_count} | found | pictures(job, learner.avatar.eval(), head, track, frames, job.config.size)


def of_pixels(job: step.Job, work: Path) -> dict[str, Any]:
    """Pictures of another size, by the camera of the clip; there is no truth beyond the frames' own size, and none is needed."""
    head = load_head(job.input.head)
    avatar = build.restore(torch.load(job.input.avatar, map_location=job.device, weights_only=True), head).to(job.device)
    if hasattr(avatar, "sharpen"):
        avatar.sharpen(RenderConfig().sample_factor)
    with np.load(job.input.track, allow_pickle=False) as file:
        track = {name: file[name] for name in file.files}
    frames = chosen_frames(step.read_json(job.input.split)["test"], job.config.pictures)
    return {"amount": job.config.amount} | pictures(job, avatar, head, track, frames, job.config.amount)


def trained(job: step.Job, **inputs: Path) -> tuple[Any, dict[str, Any]]:
    """The learner after the timed steps, seconds of the preparation and of a step. inputs: in the place of the job's."""
    config = job.config.train.model_copy(update={"steps": WARM_UP + job.config.steps})
    own = replace(job, config=config, input=SimpleNamespace(**vars(job.input) | inputs))
    started = time.perf_counter()
    data = train.load(own)
    learner = import_module(modules_of(config.representation, training=True)[-1]).learner(own, data)
    prepared = time.perf_counter() - started
    state, seconds = State(), []
    for _ in range(config.steps):
        started = time.perf_counter()
        train.optimise(learner, state)
        seconds.append(time.perf_counter() - started)
    steady = float(np.median(seconds[WARM_UP:]))
    return learner, {
        "prepare_s": round(prepared, 2),
        "step_s": round(steady, 4),
        "evaluations_per_step": state.evaluations // state.step,
    }


def pictures(job: step.Job, avatar: torch.nn.Module, head: Any, track: dict, frames: list[int], size: int) -> dict[str, Any]:
    """Median milliseconds of pictures whose longer side is `size` px."""
    whole = np.load(job.input.frames, mmap_mode="r").shape[1:3]
    scale = size / max(whole)
    smaller = track | {name: track[name] * scale for name in ("centre_px", "focal_px")}
    shape, precision = tuple(max(1, round(side * scale)) for side in whole), best_precision(job.device)
    milliseconds, evaluations = [], 0
    for frame in [frames[0], *frames]:  # the first twice: it compiles
        started = time.perf_counter()
        scene = Scene(head, smaller, [frame])
        posed = avatar.pose(*scene.heads([frame], job.device))
        with torch.no_grad():
            evaluations = avatar.picture(posed, scene.view(frame, shape), precision)[1]
        milliseconds.append(1000 * (time.perf_counter() - started))
    return {"ms_per_frame": round(float(np.median(milliseconds[1:])), 1), "evaluations_per_frame": evaluations}


if __name__ == "__main__":
    step.main(run, CostConfig)
