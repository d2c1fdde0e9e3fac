"""Step: fit one clip with one setting, time it, and compare it with the truth where there is one. One row of the benchmark.

    python -m fitting.benchmark --config '{"fit": {"iterations": 2}, "simulated": true}' --input head=resources/heads/anny.npz \\
        frames=... index=... landmarks=... alpha=... split=... truth=simulated/truth/slow_0.npz --output row=...
"""

from __future__ import annotations

import math
import os
from dataclasses import fields, replace
from typing import Any

import numpy as np

from fitting import fit, measures, synthetic_errors, tracking
from fitting.config import BenchmarkConfig
from fitting.files import load_head
from fitting.head_model import HeadModel
from workflow import step

A_FRAME = ("track", "pixels", "bundle")
"""Stages whose time grows with the clip; the others work on a fixed number of keyframes."""
ONCE = ("calibrate", "appearance")


def run(job: step.Job) -> None:
    """Write the row. A fit that loses the face is a row with its reason; the other rows do not wait for it."""
    head = load_head(job.input.head)
    whole = fit.read_clip(replace(job, config=job.config.fit), head)
    clip, rows = cut(whole, job.config.frames or len(whole.frames))
    row: dict[str, Any] = {"subject": job.subject, "simulated": job.config.simulated, "frames": len(rows)}
    try:
        fitted = tracking.fit_clip(clip, job.config.fit, job.progress, held_out=not job.config.simulated)
    except (tracking.LostFace, FloatingPointError) as error:
        job.write_json(job.output.row, row | {"failed": str(error)})
        return
    row |= figures(clip, fitted) | {"load": round(os.getloadavg()[0], 2)}
    truth = getattr(job.input, "truth", None)
    if truth is not None:
        with np.load(truth, allow_pickle=False) as file:
            row["errors"] = errors(
                head, clip, fitted, {name: file[name] for name in file.files}, step.read_json(job.input.index), rows
            )
    job.write_json(job.output.row, row)


def cut(clip: tracking.Clip, frames: int) -> tuple[tracking.Clip, np.ndarray]:
    """At most so many frames, the last that train and the first that test in the clip's own proportion; their numbers [T]."""
    train, test = clip.train, clip.test
    if len(train) + len(test) > frames:
        tested = min(len(test), max(1, round(frames * len(test) / (len(train) + len(test)))))
        train, test = train[max(0, len(train) - (frames - tested)) :], test[:tested]
    rows = np.concatenate([train, test])
    observed = {item.name: getattr(clip.observed, item.name) for item in fields(clip.observed)}
    per_frame = {name: values[rows] for name, values in observed.items() if name != "centre_px"}
    return replace(
        clip,
        observed=replace(clip.observed, **per_frame),
        frames=clip.frames[rows],  # in memory: the disk is not timed
        alpha=clip.alpha[rows],
        time_s=clip.time_s[rows],
        train=np.arange(len(train)),
        test=np.arange(len(train), len(rows)),
    ), rows


def figures(clip: tracking.Clip, fitted: tracking.Fitted) -> dict[str, Any]:
    """Time and what can be measured without a truth: jitter, share of usable frames, error on held-out landmarks."""
    frames, seconds = len(clip.frames), fitted.seconds
    held = 100 * fitted.held_out_px / clip.observed.scale_px
    return {
        "ms_per_frame": round(1e3 * sum(seconds.get(name, 0.0) for name in A_FRAME) / frames, 3),
        "ms_by_stage": {name: round(1e3 * seconds.get(name, 0.0) / frames, 3) for name in A_FRAME},
        "once_s": round(sum(seconds.get(name, 0.0) for name in ONCE), 3),
        "usable_percent": round(100 * float(fitted.usable.mean()), 2),
        "heldout_percent": round(float(np.nanmedian(held)), 4) if np.isfinite(held).any() else None,
        "jitter": {name: round(value, 4) for name, value in measures.jitter(clip.rig, fitted.state, fitted.usable).items()},
    }


def errors(
    head: HeadModel,
    clip: tracking.Clip,
    fitted: tracking.Fitted,
    truth: dict[str, np.ndarray],
    index: dict[str, Any],
    rows: np.ndarray,
) -> dict[str, Any]:
    """Errors against the truth (`synthetic_errors`): p50 and p95 over frames, or one number a clip; None where not defined.

    index: content of frames.json; rows: [T] numbers of the clip's frames in it.
    """
    track = fit.track_arrays(head, clip, fitted)
    source = np.asarray(index["source_frame"])[rows]
    found = synthetic_errors.compare(head, track, truth, index["scale"], source).summary()
    plain = lambda value: value if math.isfinite(value) else None  # noqa: E731
    return {
        name: {part: plain(number) for part, number in value.items()} if isinstance(value, dict) else plain(value)
        for name, value in found.items()
    }


if __name__ == "__main__":
    step.main(run, BenchmarkConfig)
