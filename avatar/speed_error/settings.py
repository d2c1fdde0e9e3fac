"""What `snakemake speed_error` trains, renders and times, within an hour on two cores. No torch: the workflow plans with it."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from avatar.config import TrainConfig
from avatar.speed_error.config import CostConfig, RenderingConfig, RowPlan, SpeedTableConfig, TrainingConfig

BASE = "ours_d"
"""The training whose weights all ways of sampling are compared on: preset `demo`."""
STEPS, PRESET_STEPS, DENSE_STEPS = 400, 1200, 100
"""Of a training; at most of a preset's own; of the training on whole rays, whose step takes several times as long."""
SIZE_PX, FRAMES = 256, 6
SMALL_PX, SMALL_FRAMES, FEW_FRAMES, SMALL_SAMPLES = 128, 8, 2, 20
SAMPLES, ENDS, UV_SIZES = (4, 8, 12, 16, 24, 32), (0.0, 0.001, 0.004, 0.02, 0.1), (64, 128, 256)
DEFAULT_SAMPLES, DEFAULT_END = 24, 0.004
"""What `render` takes of preset `demo`, and `avatar.marching.END`: rows with these are one rendering, timed once."""
DENSE_SAMPLES, PAPER_SAMPLES = 64, (256, 128)
COST_FRAMES, COST_PIXELS, COST_VERTICES = (50, 100, 200, 354), (64, 128, 256, 512), (1000, 2500, 5000, 10000, 20000)
REFERENCES = {"dense_64": "shell_16", "dense_64_128px": "shell_128px", "paper_128px": "shell_128px_few"}
"""Whole rays, with which all renderings of the same weights, size and frames are compared; and the shell's default there."""
GROUPS = {
    "dense": "uniform samples on the whole ray",
    "shell": "samples in the shell",
    "end": "early stop: light at which a ray ends",
    "uv": "side of the U-Net's maps",
    "neighbourhood": "neighbours of a point",
    "preset": "presets",
    "representation": "representations",
    "small": f"at {SMALL_PX} px: whole rays against the shell",
}
"""In the order of the table."""


@dataclass(frozen=True)
class Training:
    """An avatar that is trained."""

    config: TrainConfig
    what: str
    of: int | None = None
    """Steps of the preset, where fewer were taken."""


@dataclass(frozen=True)
class Rendering:
    """A row of the table."""

    group: str
    what: str
    training: str = BASE
    keys: Mapping[str, Any] = field(default_factory=dict)

    @property
    def config(self) -> RenderingConfig:
        """Of the step."""
        return RenderingConfig(**{"size": SIZE_PX, "frames": FRAMES} | dict(self.keys))


def choices(name: str) -> tuple[str, ...]:
    """The values that a key of TrainConfig may have, the default first: a new one is compared without a word here."""
    found = TrainConfig.model_fields[name]
    return (found.default, *(value for value in typing.get_args(found.annotation) if value != found.default))


def base_of(presets: Mapping[str, TrainConfig]) -> TrainConfig:
    """The preset `demo` with STEPS steps."""
    return presets["demo"].model_copy(update={"steps": STEPS})


def trainings(presets: Mapping[str, TrainConfig]) -> dict[str, Training]:
    """Every training by name. presets: `train` of each."""
    base = base_of(presets)

    def changed(what: str, **keys: Any) -> Training:
        return Training(base.model_copy(update=keys), what)

    found = {name: changed(name, representation=name) for name in choices("representation")}
    found |= {f"uv_{size}": changed(f"U-Net of {size} px", uv_size=size) for size in UV_SIZES if size != base.uv_size}
    found |= {
        f"neighbours_{name}": changed(f"neighbours: {name}", neighbourhood=name)
        for name in choices("neighbourhood")
        if name != base.neighbourhood
    }
    # Two networks on the whole ray, as in the paper, at a sixth of its samples: its own counts do not fit the hour.
    half = DENSE_SAMPLES // 2
    keys = {"sampling": "hierarchical", "coarse_samples": half, "fine_samples": half}
    found["dense_trained"] = changed("trained on whole rays, coarse and fine", **keys, steps=DENSE_STEPS)
    for name, config in presets.items():
        if stands_for(presets, name) == name:
            short = cut(config)
            of = config.steps if short.steps < config.steps else None
            found[f"preset_{name}"] = Training(short, f"preset {name}", of)
    return found


def cut(config: TrainConfig) -> TrainConfig:
    """A preset's training with PRESET_STEPS steps at most."""
    return config.model_copy(update={"steps": min(config.steps, PRESET_STEPS), "budget": None})


def stands_for(presets: Mapping[str, TrainConfig], name: str) -> str | None:
    """The preset whose row shows this one: the longest of those that are one training when cut; None where none fits the hour."""
    if presets[name].sampling == "hierarchical":
        return None
    alike = (other for other, config in presets.items() if cut(config) == cut(presets[name]))
    return max(alike, key=lambda other: presets[other].steps)


def left_out(presets: Mapping[str, TrainConfig]) -> dict[str, str]:
    """What does not fit the hour, with the reason."""
    why = "{steps:,} steps of {samples} evaluations a ray on whole rays: a step took 40 to 80 s and 11 GB on one core"
    found = {}
    for name, config in presets.items():
        if (other := stands_for(presets, name)) is None:
            samples = 2 * config.coarse_samples + config.fine_samples
            found[f"preset {name}"] = why.format(steps=config.steps, samples=samples)
        elif other != name:
            found[f"preset {name}"] = f"cut to {PRESET_STEPS:,} steps it is the same training as preset {other}"
    return found


def renderings(presets: Mapping[str, TrainConfig]) -> dict[str, Rendering]:
    """Every row of the table by name."""
    made = trainings(presets)
    dense = {"sampling": "dense", "samples": DENSE_SAMPLES}
    found = {"dense_64": Rendering("dense", f"{DENSE_SAMPLES} uniform", keys=dense)}
    found["dense_trained"] = Rendering("dense", made["dense_trained"].what, "dense_trained", {"samples": DENSE_SAMPLES // 2})
    for count in SAMPLES:
        found[f"shell_{count}"] = Rendering("shell", f"{count}", keys={} if count == DEFAULT_SAMPLES else {"samples": count})
    found |= {f"end_{end:g}": Rendering("end", f"{end:g}", keys={} if end == DEFAULT_END else {"end": end}) for end in ENDS}
    base = base_of(presets)
    for size in UV_SIZES:
        found[f"uv_{size}"] = Rendering("uv", f"{size} px", BASE if size == base.uv_size else f"uv_{size}")
    for name in choices("neighbourhood"):
        found[f"neighbours_{name}"] = Rendering(
            "neighbourhood", name, BASE if name == base.neighbourhood else f"neighbours_{name}"
        )
    for name, training in made.items():
        if name.startswith("preset_"):
            found[name] = Rendering("preset", training.what.removeprefix("preset "), name)
    found |= {f"kind_{name}": Rendering("representation", name, name) for name in choices("representation")}
    small, few = ({"size": SMALL_PX, "frames": count} for count in (SMALL_FRAMES, FEW_FRAMES))
    coarse, fine = PAPER_SAMPLES
    # Of the longest training there is: whole rays and the shell agree only where the density has become clear.
    fields = [name for name in made if name.startswith("preset_") and made[name].config.representation == base.representation]
    of = max(fields, key=lambda name: made[name].config.steps, default=BASE)
    found["dense_64_128px"] = Rendering("small", f"{DENSE_SAMPLES} uniform, {SMALL_FRAMES} frames", of, small | dense)
    found["shell_128px"] = Rendering("small", f"shell, {SMALL_FRAMES} frames", of, small)
    what = f"shell, {SMALL_SAMPLES} samples, {SMALL_FRAMES} frames"
    found["shell_128px_fewer"] = Rendering("small", what, of, small | {"samples": SMALL_SAMPLES})
    keys = few | {"sampling": "dense_fine", "samples": coarse, "fine_samples": fine}
    found["paper_128px"] = Rendering("small", f"{coarse} uniform + {fine} fine, {FEW_FRAMES} frames", of, keys)
    found["shell_128px_few"] = Rendering("small", f"shell, {FEW_FRAMES} frames", of, few)
    return found


def cells(presets: Mapping[str, TrainConfig]) -> dict[str, Rendering]:
    """The renderings that are run: of rows that are the same one the first."""
    found: dict[str, Rendering] = {}
    for name, row in renderings(presets).items():
        if not any((row.training, row.config) == (other.training, other.config) for other in found.values()):
            found[name] = row
    return found


def table_config(presets: Mapping[str, TrainConfig]) -> SpeedTableConfig:
    """Rows of the table, each with the rendering and the training behind it."""
    run, made = cells(presets), trainings(presets)
    rows = {}
    for name, row in renderings(presets).items():
        cell = next(key for key, other in run.items() if (row.training, row.config) == (other.training, other.config))
        plan = {"group": row.group, "what": row.what, "cell": cell, "training": row.training}
        rows[name] = RowPlan(**plan, of_steps=made[row.training].of)
    return SpeedTableConfig(rows=rows, left_out=left_out(presets))


def costs(presets: Mapping[str, TrainConfig]) -> dict[str, CostConfig]:
    """What is timed as the work grows, by name; the first word is what grows."""
    base = base_of(presets)
    found = {f"frames_{count}": CostConfig(kind="frames", amount=count, train=base) for count in COST_FRAMES}
    found |= {f"vertices_{count}": CostConfig(kind="vertices", amount=count, train=base) for count in COST_VERTICES}
    for name in (BASE, *(name for name in choices("representation") if name == "layers")):
        train = base.model_copy(update={"representation": name})
        found |= {f"pixels_{name}_{size}": CostConfig(kind="pixels", amount=size, train=train) for size in COST_PIXELS}
    return found


def training_config(presets: Mapping[str, TrainConfig], name: str) -> TrainingConfig:
    """The config of one training."""
    return TrainingConfig(train=trainings(presets)[name].config)
