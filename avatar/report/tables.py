"""Scores of all subjects and variants as numbers: aggregates over frames and subjects, what is best, why a cell has no figure.

Pure: tables in, tables out; `avatar.report.table_text` and `avatar.report.table_latex` write them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

ALWAYS = ("psnr", "ssim", "lpips", "l1")
"""Scores that every scored frame must have."""
HEAD = (*ALWAYS, "iou")
"""Columns that every file must have; published renders come without an opacity, and a note says so."""
KINDS = (*HEAD, "lpips_vgg")
REGIONS = {"face": "Face (hull of its landmarks)", "mouth": "Mouth (box)", "eyes": "Eyes (boxes)"}
COLUMNS = (*KINDS, *(f"{kind}_{region}" for region in REGIONS for kind in KINDS if kind != "iou"))
"""All metrics that a per-frame file may hold, in the order of the tables."""
MEAN = ""
"""Stands for the mean over subjects where a subject's name is asked for; no subject is called this."""
BEST, SECOND, REST = 0, 1, 2
NOT_MEASURED, NO_FACE = "not measured", "no face"


@dataclass(frozen=True)
class Metric:
    """How a metric is shown."""

    name: str
    title: str
    digits: int
    best: Callable[..., Any]
    """`min` or `max`: which end is better."""
    unit: str = ""


SHOWN = (Metric("lpips", "LPIPS", 3, min), Metric("ssim", "SSIM", 3, max), Metric("psnr", "PSNR", 2, max, "dB"))
"""What a cell shows, in the order of the paper's Table 1."""
VGG = (Metric("lpips_vgg", "LPIPS (VGG16)", 3, min),)


def of_region(metrics: Sequence[Metric], region: str) -> tuple[Metric, ...]:
    """The metrics inside `face`, `mouth` or `eyes`."""
    return tuple(Metric(f"{metric.name}_{region}", metric.title, metric.digits, metric.best, metric.unit) for metric in metrics)


@dataclass(frozen=True)
class Figure:
    """A metric over the frames of one clip: mean, standard deviation (population), number of frames."""

    mean: float
    std: float
    n: int


@dataclass
class Scores:
    """One variant of one subject."""

    figures: dict[str, Figure | None]
    """By metric; None where it was measured and no frame has it."""
    frames: tuple[int, ...]
    """The scored frames."""
    predictor: bool = False
    published: bool = False
    """Whether these are somebody's published renders, trained on other frames."""
    excluded: int = 0
    """Rendered test frames without a score."""
    ms_per_frame: float | None = None
    training_seconds: float | None = None
    protocol: Mapping[str, str] = field(default_factory=dict)

    @property
    def rendered(self) -> int:
        """Number of test frames, scored or not."""
        return len(self.frames) + self.excluded


NOT_MADE = "not made yet"
"""Where there are neither scores nor the log of a step that stopped."""
UNSCORED = ("rejected", "failed", "not made")


@dataclass
class Subject:
    """What is known of a subject."""

    name: str
    status: str
    """`ok`, `rejected`, `failed` or `not made`."""
    reason: str = ""
    """Why there is no figure, where there is none."""
    results: dict[str, Scores] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    """Why a variant has no figures, by its name; under an empty name why none that is missing has any."""

    def missing(self, variant: str) -> str:
        """What stands in the cell of a variant without figures."""
        if self.reason:
            return f"rejected: {self.reason}" if self.status == "rejected" else self.reason
        return self.reasons.get(variant) or self.reasons.get("") or NOT_MADE

    def fate(self, variant: str) -> str:
        """In a word what became of a variant without figures."""
        if self.status in ("ok", "failed"):
            return "not made" if self.missing(variant) == NOT_MADE else "failed"
        return self.status


@dataclass(frozen=True)
class Cell:
    """One variant of one subject in a table."""

    parts: tuple[tuple[str, int], ...] = ()
    """Text and rank (`BEST`, `SECOND` or `REST`) of each metric."""
    remark: str = ""
    """On how many frames, where that is not all of the scored ones."""
    reason: str = ""
    """Why there is no figure at all."""


@dataclass(frozen=True)
class Block:
    """Subjects x variants for a few metrics."""

    title: str
    metrics: tuple[Metric, ...]
    cells: dict[tuple[str, str], Cell]
    """By subject (or `MEAN`) and variant."""
    mean_of: int
    """Number of subjects in the mean, those that have every figure of the block; less than 2 where there is no mean."""


def aggregate(table: pd.DataFrame) -> dict[str, Figure | None]:
    """Mean, standard deviation and count of each metric's column; None for a column without any value.

    Raises:
        ValueError: a figure is not finite.
    """
    figures: dict[str, Figure | None] = {}
    for name in (name for name in COLUMNS if name in table):
        values = table[name].dropna()
        figure = Figure(float(values.mean()), float(values.std(ddof=0)), len(values)) if len(values) else None
        if figure and not (math.isfinite(figure.mean) and math.isfinite(figure.std)):
            raise ValueError(f"{name} has mean {figure.mean} and standard deviation {figure.std}")
        figures[name] = figure
    return figures


def ordered_variants(subjects: Iterable[Subject], expected: tuple[str, ...] = ()) -> list[str]:
    """Variants in the order expected, then others as they come; published renders first, predictors last."""
    found = [(name, scores) for subject in subjects for name, scores in subject.results.items()]
    names = dict.fromkeys([*expected, *(name for name, _ in found)])
    predictors = {name for name, scores in found if scores.predictor}
    published = {name for name, scores in found if scores.published}
    return sorted(names, key=lambda name: (name in predictors) - (name in published))


def ranks(texts: Mapping[str, str], best: Callable[..., Any]) -> dict[str, int]:
    """Rank of each figure as shown, so that what reads alike is marked alike; with one figure nothing is marked."""
    order = sorted({float(text) for text in texts.values()}, reverse=best is max)
    places = {value: min(place, REST) for place, value in enumerate(order)}
    return {name: places[float(text)] if len(texts) > 1 else REST for name, text in texts.items()}


def block(title: str, metrics: Sequence[Metric], subjects: Sequence[Subject], variants: Sequence[str]) -> Block:
    """Figures of every subject, and their mean over the subjects that have all of them.

    A variant without a figure in any subject does not count for that; each subject has the same weight.
    """
    cells: dict[tuple[str, str], Cell] = {}
    means: dict[str, dict[tuple[str, str], float]] = {subject.name: {} for subject in subjects}
    for subject in subjects:
        for variant, scores in subject.results.items():
            for metric in metrics:
                if figure := scores.figures.get(metric.name):
                    means[subject.name][variant, metric.name] = figure.mean
        for variant in variants:
            if variant not in subject.results:
                cells[subject.name, variant] = Cell(reason=subject.missing(variant))
        cells |= {(subject.name, name): cell for name, cell in _row(metrics, subject, means[subject.name]).items()}
    wanted = {key for found in means.values() for key in found}
    complete = [found for found in means.values() if found and set(found) == wanted]
    if len(complete) > 1:
        overall = {key: sum(found[key] for found in complete) / len(complete) for key in wanted}
        rows = _marked(metrics, overall)
        for variant in variants:
            texts = [rows.get((variant, metric.name), (NOT_MEASURED, REST)) for metric in metrics]
            has = any((variant, metric.name) in rows for metric in metrics)
            cells[MEAN, variant] = Cell(tuple(texts)) if has else Cell(reason="no figures")
    return Block(title, tuple(metrics), cells, len(complete))


def _marked(metrics: Sequence[Metric], means: Mapping[tuple[str, str], float]) -> dict[tuple[str, str], tuple[str, int]]:
    """Text and rank by variant and metric."""
    found = {}
    for metric in metrics:
        texts = {variant: f"{value:.{metric.digits}f}" for (variant, name), value in means.items() if name == metric.name}
        rank = ranks(texts, metric.best)
        found |= {(variant, metric.name): (text, rank[variant]) for variant, text in texts.items()}
    return found


def _row(metrics: Sequence[Metric], subject: Subject, means: Mapping[tuple[str, str], float]) -> dict[str, Cell]:
    """Cells of one subject's variants that have files."""
    marked, cells = _marked(metrics, means), {}
    for variant, scores in subject.results.items():
        parts, counts = [], {}
        for metric in metrics:
            why = NO_FACE if metric.name in scores.figures else NOT_MEASURED
            parts.append(marked.get((variant, metric.name), (why, REST)))
            if figure := scores.figures.get(metric.name):
                counts[figure.n] = None
        few = [str(n) for n in counts if n != len(scores.frames)]
        whole = {text for text, _ in parts}
        remark = f"{', '.join(few)} of {len(scores.frames)} frames" if few else ""
        alike = whole <= {NO_FACE} or whole <= {NOT_MEASURED}
        cells[variant] = Cell(reason=whole.pop()) if alike else Cell(tuple(parts), remark)
    return cells


def frames_of(subject: Subject) -> str:
    """Scored test frames, `scored of rendered` where some were left out; each count once where variants differ."""
    found = dict.fromkeys(
        f"{len(scores.frames)} of {scores.rendered}" if scores.excluded else str(len(scores.frames))
        for scores in subject.results.values()
    )
    return ", ".join(found) or "0"


def cost(subject: Subject, variant: str) -> tuple[str, str]:
    """Render time of a frame in ms and training time in s, as words; of a variant with scores."""
    scores = subject.results[variant]
    render = f"{scores.ms_per_frame:.1f} ms" if scores.ms_per_frame is not None else "not known"
    if scores.training_seconds is not None:
        return render, f"{scores.training_seconds:.0f} s"
    return render, "not trained" if scores.predictor else "not given"


def remarks(subjects: Sequence[Subject], variants: Sequence[str]) -> list[str]:
    """One sentence on the failures, and one for each subject whose variants were not scored on the same frames."""
    lacking = [
        f"{subject.name}/{name}" for subject in subjects if subject.results for name in variants if name not in subject.results
    ]
    kinds = [(f"subject {kind}", [item.name for item in subjects if item.status == kind]) for kind in UNSCORED]
    kinds.append(("variant without scores", lacking))
    said = [f"{_count(len(names), what)} ({', '.join(names)})" for what, names in kinds if names]
    found = [f"Failures: {'; '.join(said) or 'none'}, of {_count(len(subjects), 'subject')}."]
    for subject in subjects:
        if len({scores.frames for scores in subject.results.values()}) > 1:
            found.append(f"{subject.name}: its variants were scored on different frames; compare them with care.")
    return found


def _count(number: int, what: str) -> str:
    """`2 subjects failed`: the first word in the plural where that is needed."""
    noun, space, rest = what.partition(" ")
    return f"{number} {noun}{'' if number == 1 else 's'}{space}{rest}"


def protocols(subjects: Sequence[Subject]) -> dict[str, str]:
    """What the figures mean, in words; where results differ in a point, each wording is listed."""
    known = [scores.protocol for subject in subjects for scores in subject.results.values() if scores.protocol]
    keys = dict.fromkeys(key for protocol in known for key in protocol if key != "frames")
    return {
        key.replace("_", " "): " | ".join(dict.fromkeys(str(protocol.get(key, "not said")) for protocol in known)) for key in keys
    }
