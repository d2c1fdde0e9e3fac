"""`python -m avatar.profile results/SUBJECT --head HEAD`: where the time of a training step and of a picture goes, by stage.

Stages are timed by wrapping the functions that do them; a stage's time is its own, without that of stages inside it. The last
rows time the matrix products and convolutions of the step alone, on matrices of the same sizes and types.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import nn

from avatar import build, field_kernel, field_loops, guide, losses, marching, radiance, sampling, train
from avatar.checkpoint import State
from avatar.config import RenderConfig, TrainConfig
from avatar.dataset import Scene
from avatar.learning import rays as learning
from avatar.networks import best_precision
from avatar.view import View
from fitting.files import load_head
from workflow.step import Job

LOOPS = [name for name, loop in vars(field_loops).items() if hasattr(loop, "py_func") and not name.startswith("_")]
STAGES: list[tuple[Any, str, str]] = [
    (learning.Batches, "at", "frames, rays, truth"),
    (radiance.RadianceAvatar, "pose", "posed heads: search trees, shells"),
    (learning.Batches, "_grid", "posed heads: search trees, shells"),
    (sampling, "in_shell", "samples on rays"),
    (guide, "guided", "samples on rays"),
    (guide, "seen_density", "voxels that rays see"),
    (radiance.RadianceAvatar, "nearest", "neighbours"),
    (field_kernel, "active", "field: matrix products"),
    (field_kernel, "product", "field: matrix products"),
    *((field_loops, name, "field: loops between them") for name in LOOPS),
    (field_kernel, "evaluate", "field: forward, the rest"),
    (field_kernel, "block_back", "field: backward, the rest"),
    (radiance, "composite", "compositing and losses"),
    (marching, "composite", "compositing and losses"),
    (losses, "photometric", "compositing and losses"),
    (torch.Tensor, "backward", "backward of all else"),
    (train, "verdict", "is every gradient finite"),
    (torch.optim.Adam, "step", "Adam"),
]  # fmt: skip


def now() -> float:
    """Seconds: of the processor on one thread, whatever else the machine does; else of the wall clock."""
    return time.process_time() if torch.get_num_threads() == 1 else time.perf_counter()


class Clock:
    """Seconds of each stage, nested ones taken out, and the sizes of the products that were seen."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.inner = [0.0]
        self.products: list[tuple[str, tuple[torch.Tensor, ...]]] = []

    def wrapped(self, work: Callable, stage: str, name: str) -> Callable:
        """`work`, timed."""

        def timed(*arguments: Any, **keys: Any) -> Any:
            self.inner.append(0.0)
            started = now()
            try:
                return work(*arguments, **keys)
            finally:
                spent = now() - started
                self.seconds[stage] += spent - self.inner.pop()
                self.inner[-1] += spent
                if name in ("active", "product"):
                    self.products.append((name, arguments))

        return timed

    @contextmanager
    def running(self, avatar: nn.Module) -> Iterator[None]:
        """Times everything inside; the avatar's source of features too."""
        stages = [*STAGES, (type(avatar.source), "forward", "features: U-Net and UV maps")]
        before = [getattr(owner, name) for owner, name, _ in stages]
        for owner, name, stage in stages:
            setattr(owner, name, self.wrapped(getattr(owner, name), stage, name))
        try:
            yield
        finally:
            for (owner, name, _), original in zip(stages, before, strict=True):
                setattr(owner, name, original)


def products_alone(products: list[tuple[str, tuple[torch.Tensor, ...]]]) -> float:
    """Seconds of a step's products once more, each on warm matrices and without anything between."""
    calls: dict[tuple, list] = defaultdict(list)
    for name, arguments in products:
        matrices = [arguments[0][0], arguments[1]] if name == "active" else arguments
        calls[name, *((matrix.shape, matrix.stride()) for matrix in matrices)].append((getattr(field_kernel, name), arguments))
    return sum(len(same) * fastest(lambda same=same: same[0][0](*same[0][1]), 5) for same in calls.values())


def convolutions_alone(avatar: nn.Module, run: Callable[[], Any], precision: torch.dtype) -> float:
    """Seconds of the source's convolutions forward and backward, each alone on maps of its size in the products' type."""
    found: list[tuple[nn.Module, torch.Size]] = []
    layers = [module for module in avatar.source.modules() if isinstance(module, nn.Conv2d | nn.ConvTranspose2d)]
    hooks = [layer.register_forward_hook(lambda m, inputs, _: found.append((m, inputs[0].shape))) for layer in layers]
    run()
    for hook in hooks:
        hook.remove()
    total = 0.0
    for layer, shape in found:
        maps = torch.randn(shape).to(precision, memory_format=torch.channels_last).requires_grad_(shape[1] > 3)

        def both(layer: nn.Module = layer, maps: torch.Tensor = maps) -> None:
            with torch.autocast("cpu", torch.bfloat16, enabled=precision == torch.bfloat16):
                layer(maps).sum().backward()

        total += fastest(both, 3)
    return total


def fastest(work: Callable[[], Any], times: int) -> float:
    """Least seconds of a few runs."""
    work()
    spent = []
    for _ in range(times):
        started = now()
        work()
        spent.append(now() - started)
    return min(spent)


def profile(run: Callable[[], Any], avatar: nn.Module, times: int) -> tuple[dict[str, float], float, Clock]:
    """Mean seconds of each stage over some runs after two that compile, their median total, and the last run's clock."""
    run(), run()
    stages, totals = defaultdict(list), []
    for _ in range(times):
        clock = Clock()
        with clock.running(avatar):
            started = now()
            run()
            totals.append(now() - started)
        for stage, seconds in clock.seconds.items():
            stages[stage].append(seconds)
    return {stage: float(np.median(values)) for stage, values in stages.items()}, float(np.median(totals)), clock


def lines_of(title: str, stages: dict[str, float], total: float, more: dict[str, float]) -> list[str]:
    """A Markdown table of milliseconds."""
    rows = [*sorted(stages.items(), key=lambda row: -row[1]), ("everything else", total - sum(stages.values()))]
    lines = ["", f"| {title} | ms | share |", "|---|---:|---:|"]
    lines += [f"| {stage} | {1000 * seconds:.1f} | {seconds / total:.0%} |" for stage, seconds in rows]
    return [*lines, f"| **all** | **{1000 * total:.1f}** | |", *(f"| {name} | {value:.4g} | |" for name, value in more.items())]


def training(job: Job, times: int) -> list[str]:
    """Table of a training step."""
    data = train.load(job)
    learner, state, config = learning.learner(job, data), State(), job.config
    stages, total, clock = profile(lambda: train.optimise(learner, state), learner.avatar, times)
    alone = products_alone(clock.products)
    maps = convolutions_alone(learner.avatar, lambda: learner.loss(state.step), learner.precision())
    more = {
        "its products alone, ms": 1000 * alone,
        "its convolutions alone, ms": 1000 * maps,
        "all over these": total / (alone + maps),
    }
    title = (
        f"step: {config.rays} rays of {config.frames_per_step} frames, {config.uv_size} px maps, {len(clock.products)} products"
    )
    return lines_of(title, stages, total, more | {"evaluations": state.evaluations / state.step})


def drawing(job: Job, avatar: nn.Module, scene: Scene, view: View, frame: int, times: int) -> list[str]:
    """Table of a picture of a posed frame."""
    precision, counts = best_precision(job.device), []

    def run() -> None:
        posed = avatar.pose(*scene.heads([frame], job.device))
        counts.append(avatar.picture(posed, view, precision)[1])

    stages, total, _ = profile(run, avatar, times)
    return lines_of(f"picture: {view.size[1]} x {view.size[0]} px", stages, total, {"evaluations": counts[-1]})


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("subject", type=Path, help="folder with frames/, trim/, fit/ and split.json")
    parser.add_argument("--head", type=Path, required=True, help="head model (.npz)")
    parser.add_argument("--avatar", type=Path, help="avatar.pt whose pictures are timed")
    parser.add_argument("--times", type=int, default=7, help="runs that the medians are taken of")
    parser.add_argument("--steps", default="2:64,2:128,4:64,4:128", help="frames:map size of the steps that are timed")
    parser.add_argument("--strides", default="4,1", help="of every how many pixels the pictures are")
    arguments, folder = parser.parse_args(), parser.parse_args().subject
    names = {"frames": "frames/frames.npy", "alpha": "trim/alpha.npy", "track": "fit/track.npz", "split": "split.json"}
    inputs = SimpleNamespace(head=arguments.head, **{name: folder / path for name, path in names.items()})

    def job(**keys: Any) -> Job:
        nothing = SimpleNamespace()
        return Job(TrainConfig(**keys), inputs, nothing, nothing, folder.name, 1, "cpu", "", logging.getLogger("profile"))

    print(f"{torch.get_num_threads()} threads, products in {str(best_precision('cpu')).split('.')[1]}")  # noqa: T201
    for pair in filter(None, arguments.steps.split(",")):
        frames, size = map(int, pair.split(":"))
        print("\n".join(training(job(frames_per_step=frames, uv_size=size, static_features=True), arguments.times)))  # noqa: T201
    if arguments.avatar:
        data, head = train.load(job()), load_head(arguments.head)
        avatar = build.restore(torch.load(arguments.avatar, weights_only=True), head)
        if not hasattr(avatar, "field"):
            raise SystemExit("this profile is of fields; `python -m avatar.play.timing` has a layered avatar's")
        avatar.sharpen(RenderConfig().sample_factor)
        for stride in map(int, arguments.strides.split(",")):
            view = data.scene.view(data.train[0], data.alpha.shape[1:]).every(stride)
            print("\n".join(drawing(job(), avatar, data.scene, view, data.train[0], 3)))  # noqa: T201


if __name__ == "__main__":
    main()
