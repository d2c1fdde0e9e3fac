"""Where results lie: lists of inputs, and the subject and variant that a path belongs to. No I/O."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace


def many(inputs: SimpleNamespace, name: str) -> list[Path]:
    """All paths given under an input name, in order; none is an empty list (the harness hands over a list from two on)."""
    found = getattr(inputs, name, [])
    return found if isinstance(found, list) else [found]


def variant_of(path: Path) -> str:
    """`{subject}/{variant}/metrics/metrics.json`, `.../render/test.npy` or `{subject}/{variant}/curve.tsv` -> variant."""
    return path.parents[1 if path.parent.name in ("metrics", "render") else 0].name


def subject_of(path: Path) -> str:
    """The folder above the variant's."""
    return path.parents[2 if path.parent.name in ("metrics", "render") else 1].name


def by_variant(paths: list[Path]) -> dict[str, Path]:
    """Paths of one subject by variant, in the order given."""
    return {variant_of(path): path for path in paths}
