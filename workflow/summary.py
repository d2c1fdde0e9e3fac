"""What came of every subject, in one line each, for the end of a run."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

PREPARATION = {
    "probe": "probe/probe.json",
    "extract": "frames/frames.npy",
    "matte": "matte/alpha.npy",
    "detect": "landmarks/landmarks.npz",
    "split": "split.json",
    "fit": "fit/track.npz",
    "trim": "trim/alpha.npy",
}
"""Product of each step under `results/{subject}/`, in order."""
PER_VARIANT = {"train": "avatar.pt", "render": "render/render.json", "evaluate": "metrics/metrics.json"}
"""Product of each step under `results/{subject}/{variant}/`, in order."""


def summary(subjects: Iterable[str], variants: Iterable[str], root: Path = Path(".")) -> list[str]:
    """One line for each subject that has no avatar, with the reason or the log to read; last, how many have one."""
    subjects = list(subjects)
    variants = list(variants)
    reasons = {subject: _missing(subject, variants, root) for subject in subjects}
    lines = [f"{subject}: {reason}" for subject, reason in reasons.items() if reason]
    done = sum(reason is None for reason in reasons.values())
    noun = "subject has" if len(subjects) == 1 else "subjects have"
    return [*lines, f"{done} of {len(subjects)} {noun} an avatar"]


def failed_logs(
    subjects: Iterable[str], variants: Iterable[str], predictors: Iterable[str], root: Path = Path(".")
) -> list[Path]:
    """Log of the first step that did not finish, for every subject and variant without scores; some may not be there.

    variants: trained ones and predictors; the latter have no training.
    """
    logs, variants, predictors = [], list(variants), list(predictors)
    for subject in subjects:
        for variant in variants:
            if (root / "results" / subject / variant / PER_VARIANT["evaluate"]).exists():
                continue
            steps = [name for name in PER_VARIANT if name != "train" or variant not in predictors]
            if found := _unfinished(subject, [variant], root, steps):
                logs.append(root / "logs" / subject / found[1])
    return logs


def _unfinished(subject: str, variants: list[str], root: Path, steps: Iterable[str] = PER_VARIANT) -> tuple[Path, str] | None:
    """First product that does not exist, and the name of its step's log under `logs/{subject}/`."""
    folder = root / "results" / subject
    chain = [(folder / product, f"{step}.log") for step, product in PREPARATION.items()]
    for variant in variants:
        chain += [(folder / variant / PER_VARIANT[step], f"{variant}/{step}.log") for step in steps]
    return next(((product, log) for product, log in chain if not product.exists()), None)


def _missing(subject: str, variants: list[str], root: Path) -> str | None:
    """Why a subject has no avatar, or None when it has all of them."""
    probe = root / "results" / subject / PREPARATION["probe"]
    if probe.is_file():
        content = json.loads(probe.read_text(encoding="utf-8"))
        if not content["accepted"]:
            return f"rejected: {content['reason']}"
    if found := _unfinished(subject, variants, root):
        product, log = found
        return f"not finished, {product.relative_to(root)} is missing; see {Path('logs') / subject / log}"
    return None
