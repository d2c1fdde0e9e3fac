"""Training for a number of minutes (`train.budget`): how many steps fit, and when it ends.

Decisions go to train.json and the page. Steps are counted twice: from the first of them, and again once everything that comes in
late (the warp, the perceptual loss, the alignment of poses) is on. What alternatives are worth is not asked: trials of 2 to 4 %
of the work each (finer maps, a second network, samples a ray, a thinner shell, no view direction, the warp; nerface, glasses
and wojtek, 8 minutes) took 82 to 93 s, changed nothing on two clips, added the warp on the third, and the avatars were 0.05 to
0.23 dB worse than the same minutes without them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from avatar import coverage, learning, shell
from avatar.checkpoint import State
from avatar.dataset import shrink_any
from avatar.learning import Data, Learner, measured_shell
from workflow import step

AUTO_MINUTES = 30.0
"""Of `budget: auto`, at most: it ends on a plateau."""
PROBES = 20
"""Times the held-out frames are looked at."""
GUESSED_STEPS = 2000
"""Of the schedule before the first steps are timed."""
UNTIMED_STEPS, TIMED_STEPS, TIMED_SHARE = 4, 12, 0.1
"""Steps before timing, steps that are timed, and the share of the minutes after which timing ends in any case."""
LATE = (0.3, 0.4)
"""Shares of the steps between which the steps are timed again."""
PLATEAU_DB, PLATEAU_SHARE, PLATEAU_FROM = 0.05, 0.25, 0.5
"""`auto` ends when the mean probe of the last 25 % of the steps is not this much above that of the 25 % before; never before half
of the steps that fit. By means: single probes go up and down by 0.3 dB. Minutes that are named are used to their end."""


def minutes_of(budget: float | str) -> float:
    """Minutes that a budget allows."""
    return AUTO_MINUTES if budget == "auto" else float(budget)


def steps_in(seconds: float, step_s: float) -> int:
    """Steps that fit, at least one, to two digits: a clock that ticks a little differently is to give the same schedule."""
    count = max(1, int(seconds / max(step_s, 1e-6)))
    unit = 10 ** max(len(str(count)) - 2, 0)
    return max(1, round(count / unit) * unit)


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


def schedules(
    job: step.Job, learner: Learner, data: Data, state: State, optimise: Callable[[Learner, State], float]
) -> Iterator[tuple[step.Job, int]]:
    """The job with the steps that are planned, and up to which of them to train with that plan, one stretch after the other.

    What was planned is part of `state`, and so of the checkpoint: an interrupted run goes on with it.
    """
    minutes = minutes_of(job.config.budget)
    if not state.planned:
        _first(job, learner, data, state, optimise, 60 * minutes)
    if not any(row["decision"] == "steps again" for row in state.decisions):
        first = state.planned
        yield _told(job, learner, first), round(LATE[1] * first)
        rows = [row for row in state.curve if row[0] >= LATE[0] * first]
        if len(rows) > 1:
            count = rows[-1][0] - rows[0][0]
            step_s = (rows[-1][1] - rows[0][1]) / count
            state.planned = state.step + steps_in(60 * minutes - state.seconds, step_s)
            reason = f"the last {count} steps took {step_s:.3f} s each, looking at the held-out frames included"
            state.decisions.append(answered("steps again", state.planned, reason, step_s=round(step_s, 4)))
            job.log.info("budget: %d steps", state.planned)
    yield _told(job, learner, state.planned), state.planned


def _first(
    job: step.Job, learner: Learner, data: Data, state: State, optimise: Callable[[Learner, State], float], seconds: float
) -> None:
    """Time the first steps, and plan with them; in place."""
    started, taken = time.perf_counter(), []
    _told(job, learner, GUESSED_STEPS)
    while not taken or (len(taken) < UNTIMED_STEPS + TIMED_STEPS and time.perf_counter() - started < TIMED_SHARE * seconds):
        begun = time.perf_counter()
        state.losses.append(optimise(learner, state))
        taken.append(time.perf_counter() - begun)
    step_s = float(np.median(taken[UNTIMED_STEPS:] or taken))
    begun = time.perf_counter()
    learning.probe_psnr(learner, data)
    probe_s = time.perf_counter() - begun
    state.seconds = time.perf_counter() - started
    state.planned = state.step + steps_in(seconds - state.seconds - PROBES * probe_s, step_s)
    reason = (
        f"{step_s:.3f} s each, {probe_s:.1f} s for each of {PROBES} looks at the held-out frames, in {seconds / 60:g} minutes"
    )
    if job.config.budget == "auto":
        reason += f"; fewer where the held-out frames gain less than {PLATEAU_DB:g} dB"
    if job.config.sampling == "shell" and job.config.representation != "layers":
        state.decisions.append(shell_found(data))
    state.decisions.append(answered("steps", state.planned, reason, step_s=round(step_s, 4)))
    job.log.info("budget: %d steps of %.3f s", state.planned, step_s)


def ends(job: step.Job, state: State) -> bool:
    """Whether `auto` ends here, for the probes are on a plateau; noted in `state`."""
    if not state.ended and job.config.budget == "auto" and plateau(state.curve, job.config.steps):
        state.ended = True
        reason = f"no longer {PLATEAU_DB:g} dB better on the held-out frames than a quarter of the steps before"
        state.decisions.append(answered("end", state.step, reason))
        job.log.info("training ends at step %d: %s", state.step, reason)
    return state.ended


def answered(decision: str, taken: Any, reason: str, **more: Any) -> dict[str, Any]:
    """A decision as train.json has it."""
    return {"decision": decision, "taken": taken, "reason": reason} | more


def _told(job: step.Job, learner: Learner, steps: int) -> step.Job:
    """The job with a schedule of `steps`, of which the learner is told too."""
    config = job.config.model_copy(update={"steps": steps})
    learner.config = config
    return replace(job, config=config)


def shell_found(data: Data) -> dict[str, Any]:
    """The shell's thickness, which the mattes decide, and what the held-out frames say of it."""
    neutral, triangles = data.scene.neutral_m.numpy().astype(np.float64), data.head.triangles.numpy()
    base, thickness = coverage.base_thickness(data.head.region.numpy(), neutral, triangles), measured_shell(data)
    missed = {"base": missed_share(data, base), "measured": missed_share(data, thickness)}
    shares = [100 * missed[name] for name in ("base", "measured")]
    reason = "from the mattes: a shell by region alone misses {:.1f} % of the held-out frames' opaque blocks, this one {:.1f} %"
    low, middle, high = 1000 * np.quantile(thickness, (0, 0.5, 1))
    taken = f"{low:.0f} to {high:.0f} mm, median {middle:.0f} mm"
    return answered("shell from mattes", taken, reason.format(*shares), missed=missed)


def missed_share(data: Data, thickness_m: np.ndarray) -> float:
    """Share of the opaque blocks of the held-out frames whose central ray does not meet the shell; thickness_m: [V]."""
    opaque = missed = 0
    for frame in data.probe:
        vertices = data.scene.vertices_m[data.scene.place[frame]].numpy()
        grid = shell.occupancy(vertices, thickness_m, np.zeros((0, 3)))
        matte = shrink_any(np.asarray(data.alpha[frame]), 128)
        opaque += int(matte.sum())
        missed += int((matte & ~coverage.hit_blocks(grid, data.scene, frame, data.alpha.shape[1:])).sum())
    return round(missed / max(opaque, 1), 4)
