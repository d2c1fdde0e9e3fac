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


def _missing(subject: str, variants: list[str], root: Path) -> str | None:
    """Why a subject has no avatar, or None when it has all of them."""
    folder = root / "results" / subject
    probe = folder / PREPARATION["probe"]
    if probe.is_file():
        content = json.loads(probe.read_text(encoding="utf-8"))
        if not content["accepted"]:
            return f"rejected: {content['reason']}"
    chain = [(folder / product, f"{step}.log") for step, product in PREPARATION.items()]
    for variant in variants:
        chain += [(folder / variant / product, f"{variant}/{step}.log") for step, product in PER_VARIANT.items()]
    for product, log in chain:
        if not product.exists():
            return f"not finished, {product.relative_to(root)} is missing; see {Path('logs') / subject / log}"
    return None
