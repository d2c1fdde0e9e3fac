"""What `train.budget` asks, how an answer is found from figures, and when training ends. No torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from avatar.config import TrainConfig

AUTO_MINUTES = 30.0
"""Of `budget: auto`, at most: it ends on a plateau."""
TRIALS_SHARE = 0.2
"""Of the minutes that trials whose result is thrown away may take."""
FRESH_SHARE, BRANCH_SHARE, BRANCH_FROM = 0.04, 0.016, 0.2
"""Of the whole work that each trial gets, from the start, and from weights that are trained already; and when those begin: in the
first steps whatever makes a shell converge sooner looks better by half a decibel and more."""
CLEAR_DB = 0.3
"""By how much an alternative must be better on the held-out frames: probes 50 steps apart differ by as much (nerface.mp4)."""
LEAST_STEPS = 4000
"""Trainings that are shorter have no trials. At 8 minutes (1100 to 2400 steps; nerface, glasses, wojtek) trials took 82 to 93 s,
changed nothing on two clips, added the warp on the third, and the avatars were 0.05 to 0.23 dB worse than without."""
HEAD_OF_UV = 2.0
"""Pixels of the head's height for each texel of the side of the U-Net's maps below which a finer map is not tried."""
MAPPED = ("ours_d", "ours_c")
"""Representations with maps in UV."""
PLATEAU_DB, PLATEAU_SHARE, PLATEAU_FROM = 0.05, 0.25, 0.5
"""`auto` ends when the mean probe of the last 25 % of the steps is not this much above that of the 25 % before; never before half
of the steps that fit. By means: single probes go up and down by 0.3 dB. Minutes that are named are used to their end."""


@dataclass(frozen=True)
class Question:
    """One alternative to what is trained."""

    name: str
    what: str
    """`a U-Net of 128 px`."""
    instead: str
    keys: dict[str, Any] = field(default_factory=dict)
    """Of TrainConfig."""
    shell: float = 1.0
    """By what the shell's thickness is multiplied."""
    fresh: bool = False
    """Whether it is trained from the start; otherwise from the weights that are there."""


def answered(decision: str, taken: Any, reason: str, **more: Any) -> dict[str, Any]:
    """A decision as train.json has it."""
    return {"decision": decision, "taken": taken, "reason": reason} | more


def minutes_of(budget: float | str) -> float:
    """Minutes that a budget allows."""
    return AUTO_MINUTES if budget == "auto" else float(budget)


def asked(config: TrainConfig, head_px: float) -> tuple[list[Question], list[dict[str, Any]]]:
    """The questions in their order, and what is decided without a trial.

    head_px: height of the head in the frames, pixels.
    """
    if config.representation == "layers":
        return [], [answered("trials", "none", "a layered avatar has no rays, samples or second network to ask about")]
    found, decided = [], []
    finer = 2 * config.uv_size
    resolution = f"the head is {head_px:.0f} px high; a ray costs the same at any resolution, so all pixels are learned from"
    decided.append(answered("resolution", "all pixels", resolution))
    if config.representation in MAPPED and head_px >= HEAD_OF_UV * finer:
        what = f"a U-Net of {finer} px"
        found.append(Question("uv_size", what, f"one of {config.uv_size} px", {"uv_size": finer}, fresh=True))
    elif config.representation in MAPPED:
        reason = f"the head is {head_px:.0f} px high: too small for {finer} texels a side, {HEAD_OF_UV:g} px each"
        decided.append(answered("uv_size", config.uv_size, reason))
    if config.sampling == "shell":
        keys = {"sampling": "hierarchical", "coarse_samples": 48, "fine_samples": 16}
        found.append(Question("second network", "a coarse and a fine network", "one network in the shell", keys, fresh=True))
        length, most = config.sample_step_m, config.max_samples
        per_ray = "{} samples a ray, one for {:.2g} mm"
        now = per_ray.format(most, 1000 * length)
        for factor in (2 / 3, 4 / 3):
            keys = {"max_samples": max(2, round(most * factor)), "sample_step_m": round(length / factor, 6)}
            what = per_ray.format(keys["max_samples"], 1000 * keys["sample_step_m"])
            found.append(Question("samples a ray", what, now, keys))
        found.append(Question("shell thickness", "a shell 0.8 times as thick", "the thickness from the mattes", shell=0.8))
    if config.view_bands:
        bands = f"{config.view_bands} bands of the view direction"
        found.append(Question("view direction", "no bands of the view direction", bands, {"view_bands": 0}))
    if not config.warp:
        found.append(Question("warp", "the error-correction warp", "no warp", {"warp": True}))
    return found, decided


def answer(question: Question, kept_db: float, other_db: float, teraflop: float) -> tuple[bool, dict[str, Any]]:
    """Whether the alternative is taken, and the decision with its figures.

    kept_db, other_db: PSNR on the held-out frames after equal work of `teraflop`, without and with the alternative.
    """
    taken = other_db - kept_db >= CLEAR_DB
    began = "from the start" if question.fresh else "from the same weights"
    reason = f"after equal work ({teraflop:.2f} TFLOP, {began}) {question.what} had {other_db:.2f} dB on held-out frames, "
    reason += f"{question.instead} {kept_db:.2f} dB; {CLEAR_DB:g} dB are asked for"
    figures = {"probe_psnr": round(kept_db, 3), "alternative_psnr": round(other_db, 3), "teraflop": round(teraflop, 3)}
    return taken, answered(question.name, question.what if taken else question.instead, reason, **figures)


def steps_in(seconds: float, step_s: float) -> int:
    """Steps that fit, to two digits: a clock that ticks a little differently is to give the same schedule."""
    count = max(1, int(seconds / max(step_s, 1e-6)))
    unit = 10 ** max(len(str(count)) - 2, 0)
    return max(1, count // unit * unit)


def plateau(curve: Sequence[Sequence[float]], steps: int) -> bool:
    """Whether the last PLATEAU_SHARE of the steps so far brought less than PLATEAU_DB, in the mean.

    curve: rows of step, seconds, loss, probe's PSNR in dB; steps: of the whole schedule.
    """
    if not curve or curve[-1][0] < PLATEAU_FROM * steps:
        return False
    last = curve[-1][0]
    recent = [row[3] for row in curve if row[0] > (1 - PLATEAU_SHARE) * last]
    before = [row[3] for row in curve if (1 - 2 * PLATEAU_SHARE) * last < row[0] <= (1 - PLATEAU_SHARE) * last]
    enough = len(before) >= 3 and len(recent) >= 3
    return enough and sum(recent) / len(recent) - sum(before) / len(before) < PLATEAU_DB
