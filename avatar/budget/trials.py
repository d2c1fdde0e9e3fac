"""Short measured trials on held-out training frames: two ways to go on from one point, compared after equal work.

Work is counted in operations of training, never in seconds, so that the same data give the same decisions on any machine;
the seconds are logged. What is trained on the way of the winner counts as training.
"""

from __future__ import annotations

import copy
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import nn

from avatar import learning, losses
from avatar.budget import questions
from avatar.budget.questions import Question
from avatar.checkpoint import State
from avatar.config import TrainConfig
from avatar.dataset import on_white
from avatar.learning import Data, Learner
from avatar.operations import operations

TIMED_STEPS, UNTIMED_STEPS = 12, 4
BACKWARD = 3
"""Operations of a step of training by those of its forward pass."""


@dataclass
class Run:
    """One avatar in training, and what it took."""

    learner: Learner
    state: State
    config: TrainConfig
    work: float = 0.0
    """FLOP."""


@dataclass
class Trials:
    """What all trials share."""

    data: Data
    device: str
    make: Callable[[TrainConfig], Learner]
    step: Callable[[Learner, State], float]
    """One step of training: `avatar.train.optimise`."""
    log: logging.Logger
    wasted_s: float = 0.0
    """Seconds of trainings that were thrown away."""

    def advance(self, run: Run, flop: float) -> float:
        """Train until `flop` more are spent. Returns seconds."""
        started, until = time.perf_counter(), run.work + flop
        cost = operations(run.learner.avatar, self.data.head)
        while run.work < until:
            self.one(run, cost)
        return time.perf_counter() - started

    def one(self, run: Run, cost: tuple[float, float]) -> None:
        """One step, and what it took. cost: from `operations`."""
        before = run.state.evaluations
        self.step(run.learner, run.state)
        run.work += BACKWARD * ((run.state.evaluations - before) * cost[0] + run.config.frames_per_step * cost[1])

    def timed(self, run: Run) -> float:
        """Median seconds of some steps of the run, the first of them left out."""
        cost = operations(run.learner.avatar, self.data.head) or (0.0, 0.0)
        seconds = []
        for _ in range(UNTIMED_STEPS + TIMED_STEPS):
            begun = time.perf_counter()
            self.one(run, cost)
            seconds.append(time.perf_counter() - begun)
        return float(np.median(seconds[UNTIMED_STEPS:]))

    @torch.no_grad()
    def probe(self, run: Run, stride: int = learning.PROBE_STRIDE) -> float:
        """Mean PSNR in dB over the held-out training frames, on every `stride`-th pixel."""
        data, avatar, values = self.data, run.learner.avatar, []
        for frame in data.probe:
            truth = on_white(data.frames[frame][::stride, ::stride], data.alpha[frame][::stride, ::stride])
            view = data.scene.view(frame, data.alpha.shape[1:]).every(stride)
            posed = avatar.pose(*data.scene.heads([frame], self.device))
            colour = avatar.picture(posed, view, run.learner.precision())[0].colour.cpu()
            values.append(losses.psnr(colour, torch.from_numpy(truth.reshape(-1, 3))))
        return float(np.mean(values))

    def fresh(self, run: Run, question: Question) -> tuple[Run, dict[str, Any]]:
        """An alternative trained from the start by the work that the run has had, against that run."""
        started = time.perf_counter()
        config = run.config.model_copy(update=question.keys)
        other = Run(self.make(config), State(), config)
        self.advance(other, run.work)
        # Whole rays cost a hundred times as much to look at.
        stride = learning.PROBE_STRIDE * (4 if config.sampling == "hierarchical" else 1)
        kept_db, other_db = self.probe(run, stride), self.probe(other, stride)
        taken, found = questions.answer(question, kept_db, other_db, run.work / 1e12)
        return self.settled(other if taken else run, found, time.perf_counter() - started)

    def branch(self, run: Run, question: Question, flop: float) -> tuple[Run, dict[str, Any]]:
        """The run trained on without and with the alternative, from the same weights and on the same rays.

        One learner does both, one after the other: a second one would measure shell and mesh all over again.
        """
        start, started = snapshot(run), time.perf_counter()
        kept_db = self.on(run, flop)
        kept, between = snapshot(run), time.perf_counter()
        restore(run, start)
        undo = alter(run, question, self.data)
        other_db = self.on(run, flop)
        taken, found = questions.answer(question, kept_db, other_db, flop / 1e12)
        if not taken:
            undo()
            restore(run, kept)
        return self.settled(run, found, between - started if taken else time.perf_counter() - between)

    def on(self, run: Run, flop: float) -> float:
        """Train on by `flop`; mean of the probes after two thirds of it and at its end, in dB: one alone is noise."""
        begun, values = run.work, []
        for share in (2 / 3, 1):
            self.advance(run, begun + share * flop - run.work)
            values.append(self.probe(run))
        return float(np.mean(values))

    def settled(self, run: Run, found: dict[str, Any], seconds: float) -> tuple[Run, dict[str, Any]]:
        """Log a decision and what it cost."""
        self.wasted_s += seconds
        self.log.info("%s: %s; %s", found["decision"], found["taken"], found["reason"])
        return run, found | {"seconds": round(seconds, 1)}


def snapshot(run: Run) -> dict[str, Any]:
    """Weights, optimiser and counters as they are."""
    return {
        "avatar": copy.deepcopy(run.learner.avatar.state_dict()),
        "optimiser": copy.deepcopy(run.learner.optimiser.state_dict()),
        "state": copy.deepcopy(run.state),
        "work": run.work,
    }


def restore(run: Run, kept: dict[str, Any]) -> None:
    """Back to a snapshot of the same layers."""
    run.learner.avatar.load_state_dict(kept["avatar"])
    run.learner.optimiser.load_state_dict(copy.deepcopy(kept["optimiser"]))
    run.state, run.work = copy.deepcopy(kept["state"]), kept["work"]


def alter(run: Run, question: Question, data: Data) -> Callable[[], None]:
    """Change the avatar in training as the question says, its weights kept. Returns what takes the change back."""
    learner, avatar, config = run.learner, run.learner.avatar, run.config
    before = {name: getattr(avatar, name) for name in ("step_m", "max_samples", "thickness_m", "warp")}
    layers, view_bands, optimiser = avatar.field.mlp2.layers, avatar.field.view_bands, learner.optimiser
    groups = [dict(group) | {"params": list(group["params"])} for group in optimiser.param_groups]
    first = layers[0]

    def undo() -> None:
        for name, value in before.items():
            setattr(avatar, name, value)
        layers[0], avatar.field.view_bands = first, view_bands
        optimiser.param_groups[:] = groups
        configure(run, config)

    configure(run, config.model_copy(update=question.keys))
    avatar.step_m = question.keys.get("sample_step_m", avatar.step_m)
    avatar.max_samples = question.keys.get("max_samples", avatar.max_samples)
    avatar.thickness_m = avatar.thickness_m * question.shell
    if "view_bands" in question.keys:
        avatar.field.view_bands = question.keys["view_bands"]
        layers[0] = narrowed(first, len(first.weight[0]) - 6 * (view_bands - avatar.field.view_bands), optimiser)
    if question.keys.get("warp"):
        avatar.correct_errors(len(data.scene.frames))
        optimiser.add_param_group({"params": list(avatar.warp.parameters()), "name": "warp"})
    return undo


def configure(run: Run, config: TrainConfig) -> None:
    """Have the learner train, and the avatar's file say, what `config` says."""
    run.config = run.learner.config = config
    if (batches := getattr(run.learner, "batches", None)) is not None:
        batches.config = config
        for known in (batches.cells, batches.grids):  # where rays are drawn depends on the shell
            known.clear()


def narrowed(layer: nn.Linear, inputs: int, optimiser: torch.optim.Optimizer) -> nn.Linear:
    """The layer on its first `inputs` inputs alone (bands are encoded last), in the optimiser's list in the other's place."""
    made = nn.Linear(inputs, layer.out_features).to(layer.weight)
    made.bias = layer.bias
    made.weight.data.copy_(layer.weight.data[:, :inputs])
    for group in optimiser.param_groups:
        group["params"] = [made.weight if value is layer.weight else value for value in group["params"]]
    if known := optimiser.state.get(layer.weight):
        optimiser.state[made.weight] = {
            name: value[:, :inputs].clone() if value.ndim == 2 else value.clone() for name, value in known.items()
        }
    return made
