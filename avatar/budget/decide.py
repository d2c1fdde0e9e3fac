"""What `train.budget` decides before the loop of training goes on with it, and what of that is kept for an interrupted run."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from avatar import coverage, shell
from avatar.budget import questions
from avatar.budget.questions import answered
from avatar.budget.trials import Run, Trials, configure
from avatar.checkpoint import State
from avatar.config import TrainConfig
from avatar.dataset import shrink_any
from avatar.learning import Data, Learner, measured_shell
from workflow import step

GUESSED_STEPS = 2000  # of the schedule before the first steps are timed
PROBE_SHARE = 0.04  # of the minutes goes into looking at the held-out frames while training
LOOKED_AT = 12
KEPT = "budget.json"


def decide(
    job: step.Job, data: Data, make: Callable[[TrainConfig], Learner], optimise: Callable[[Learner, State], float]
) -> tuple[Run, dict[str, Any]]:
    """The avatar that goes on to be trained, some steps old, and the decisions with their reasons.

    make: a learner of a config; optimise: one step of training.
    """
    started, minutes = time.perf_counter(), questions.minutes_of(job.config.budget)
    asked, decided = questions.asked(job.config, head_height_px(data))
    config = job.config.model_copy(update={"steps": GUESSED_STEPS})
    trials = Trials(data, job.device, make, optimise, job.log)
    run = Run(make(config), State(), config)
    base_step_s = trials.timed(run)
    total = questions.steps_in(60 * minutes * (1 - PROBE_SHARE) - (time.perf_counter() - started), base_step_s)
    configure(run, config.model_copy(update={"steps": max(total, run.state.step + 1)}))
    decided += [shell_found(data)] if job.config.sampling == "shell" and job.config.representation != "layers" else []
    if asked and total < questions.LEAST_STEPS:
        reason = f"{total} steps fit into {minutes:g} minutes; below {questions.LEAST_STEPS} no trial says anything"
        decided += [answered("trials", "none", reason)]
        asked = []
    if asked:
        run, found = answers(run, trials, asked, total, minutes)
        decided += found
    elapsed = time.perf_counter() - started
    step_s = trials.timed(run)
    left = questions.steps_in(60 * minutes * (1 - PROBE_SHARE) - elapsed, step_s)
    configure(run, run.config.model_copy(update={"steps": run.state.step + left}))
    reason = f"{left} steps of {step_s:.3f} s fit into what is left of {minutes:g} minutes"
    if job.config.budget == "auto":
        reason += f"; fewer where the held-out frames gain less than {questions.PLATEAU_DB:g} dB"
    decided.append(answered("steps", run.config.steps, reason, step_s=round(step_s, 4), step_s_before=round(base_step_s, 4)))
    run.state.seconds = time.perf_counter() - started
    job.log.info("budget: %d steps; %.0f s of trials thrown away", run.config.steps, trials.wasted_s)
    return run, {"minutes": minutes, "wasted_seconds": round(trials.wasted_s, 1), "decisions": decided}


def answers(
    run: Run, trials: Trials, asked: list[questions.Question], total: int, minutes: float
) -> tuple[Run, list[dict[str, Any]]]:
    """Ask one question after the other while the trials' share of the minutes lasts."""
    decided = []
    whole = run.work / run.state.step * total
    trials.advance(run, questions.FRESH_SHARE * whole - run.work)
    taken: set[str] = set()
    for question in asked:
        if question.name in taken:
            continue
        cost = (questions.FRESH_SHARE if question.fresh else questions.BRANCH_SHARE) * 60 * minutes
        if trials.wasted_s + cost > questions.TRIALS_SHARE * 60 * minutes:
            reason = f"not tried: {trials.wasted_s:.0f} s of trials are thrown away already"
            decided.append(answered(question.name, question.instead, reason))
            continue
        if question.fresh:
            run, found = trials.fresh(run, question)
        else:
            trials.advance(run, questions.BRANCH_FROM * whole - run.work)
            run, found = trials.branch(run, question, questions.BRANCH_SHARE * whole)
        decided.append(found)
        taken |= {question.name} if found["taken"] == question.what else set()
    return run, decided


def head_height_px(data: Data) -> float:
    """Median height of the matte over some training frames, pixels."""
    heights = []
    for frame in data.train[:: max(1, len(data.train) // LOOKED_AT)]:
        rows = np.flatnonzero((np.asarray(data.alpha[frame]) > 127).any(1))
        heights.append(rows[-1] + 1 - rows[0] if len(rows) else 0)
    return float(np.median(heights))


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


def remember(folder: Path, mark: str, config: TrainConfig, found: dict[str, Any]) -> None:
    """Keep the decisions beside the checkpoint, so that an interrupted run goes on with them."""
    folder.mkdir(parents=True, exist_ok=True)
    content = {"fingerprint": mark, "config": config.model_dump(mode="json"), "found": found}
    (folder / KEPT).write_text(json.dumps(content), encoding="utf-8")


def remembered(folder: Path, mark: str) -> tuple[TrainConfig, dict[str, Any]] | None:
    """Config and decisions of an interrupted run of the same code, config and inputs."""
    try:
        content = json.loads((folder / KEPT).read_text(encoding="utf-8"))
    except (OSError, json.JSONDecodeError):
        return None
    if content.get("fingerprint") != mark:
        return None
    return TrainConfig(**content["config"]), content["found"]
