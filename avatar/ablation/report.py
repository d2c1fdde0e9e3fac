"""Cells of the ablation as one table in the paper's layout, and what became of the paper's claims. Pure numbers and text."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from avatar.ablation.settings import CELLS, FACTOR, OVERFIT_KEYS, SIZE_PX, SOURCES, TRAIN, cell_of
from avatar.losses import RATES
from avatar.report.table_text import marked, table
from avatar.report.tables import REST, ranks
from fitting.benchmark_settings import PREFIX

METRICS = {"lpips": ("LPIPS", 4), "ssim": ("SSIM", 4), "psnr": ("PSNR, dB", 2)}
NOT_RUN, FAILED = "not run", "failed, see below"
FAMILIES = {
    False: (
        "As in the paper",
        "Features come from the source alone (Static Features and 3DMM Codes are, or have, a learned table).",
    ),
    True: (
        "On a learned constant",
        "The same, but every source adds to a learned constant of each vertex. A network that has to draw the whole texture from "
        "the frame's codes or displacement is far from done after so few steps, and what is compared above is mostly that; here "
        "all have the texture at once.",
    ),
}
"""Title and what it is, by whether there is a table."""
OURS, OTHERS = ("ours_c", "ours_d"), ("static", "codes", "codes_mlp")
"""The paper's claim is about these; `displacement_mlp` is no row of its table."""


@dataclass(frozen=True)
class Figure:
    """A metric over the seeds."""

    mean: float
    spread: float
    """Half of the distance from the least to the largest; 0 for one seed."""
    seeds: int

    def text(self, digits: int) -> str:
        """`0.1417 ± 0.0012`, without the spread for one seed."""
        return f"{self.mean:.{digits}f}" + (f" ± {self.spread:.{digits}f}" if self.seeds > 1 else "")


def of(values: Sequence[float]) -> Figure | None:
    """Mean and spread of some values; None of nothing."""
    return Figure(statistics.fmean(values), (max(values) - min(values)) / 2, len(values)) if values else None


class Results:
    """All rows by subject, cell and seed."""

    def __init__(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """rows: content of the rows' files with `subject`, `cell` and `seed`."""
        self.rows = {(row["subject"], row["cell"], row["seed"]): row for row in rows}
        self.subjects = sorted({subject for subject, _, _ in self.rows}, key=lambda name: (not name.startswith(PREFIX), name))

    def by_seed(self, subject: str, cell: str, metric: str, frames: str = "test") -> dict[int, float]:
        """A metric of one cell; seeds whose training failed, or without such frames, are left out."""
        found = {seed: row for (name, kind, seed), row in self.rows.items() if (name, kind) == (subject, cell)}
        scores = {seed: row.get("scores", {}).get(frames, {}) for seed, row in sorted(found.items())}
        return {seed: values[metric] for seed, values in scores.items() if metric in values}

    def figure(self, subject: str, cell: str, metric: str, frames: str = "test") -> Figure | None:
        """Mean and spread over seeds, None where there is no score."""
        return of(list(self.by_seed(subject, cell, metric, frames).values()))

    def missing(self, subject: str, cell: str) -> str:
        """Why there is no figure: real subjects have not all cells, and a training may have failed."""
        failed = any("failed" in row for (name, kind, _), row in self.rows.items() if (name, kind) == (subject, cell))
        return FAILED if failed else NOT_RUN

    def marks(self, subject: str, metric: str, frames: str, table: bool) -> dict[str, tuple[str, int]]:
        """Text of the mean as shown and its rank among the sources, by source; those without a figure are left out."""
        digits, best = METRICS[metric][1], min if metric == "lpips" else max
        found = {source: self.figure(subject, cell_of(source, table), metric, frames) for source in SOURCES}
        texts = {source: f"{figure.mean:.{digits}f}" for source, figure in found.items() if figure}
        rank = ranks(texts, best)
        return {source: (found[source].text(digits), rank[source]) for source in texts}

    def loss(self, subject: str, cell: str, to: str) -> Figure | None:
        """By how much LPIPS grows from full data to `half`, or from the test frames to `doubled`; seed by seed."""
        before = self.by_seed(subject, cell, "lpips")
        after = self.by_seed(subject, f"{cell}_half", "lpips") if to == "half" else self.by_seed(subject, cell, "lpips", to)
        return of([after[seed] - before[seed] for seed in before if seed in after])


def long_rows(results: Results) -> list[dict[str, Any]]:
    """One CSV row a cell and seed."""
    out = []
    for (subject, cell, seed), row in results.rows.items():
        line = {"subject": subject, "cell": cell, "seed": seed}
        for frames in ("test", "doubled"):
            scores = row.get("scores", {}).get(frames, {})
            line |= {f"{frames}_{name}": scores.get(name) for name in (*METRICS, "frames")}
        line |= {name: row.get(name) for name in ("steps", "training_frames", "train_seconds", "skipped_steps")}
        out.append(line | {"load": row.get("load"), "note": row.get("failed", "")})
    return out


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """The claims, then the tables: full data, half, doubled codes, warp, true parameters; then the budget."""
    results = Results(rows)
    lines = ["# Ablation (paper, section 4.4, at a small size)", "", "LPIPS (AlexNet): lower is better. ± is half of the range"]
    lines[-1] += " over the seeds. **Best** and <ins>second</ins> of a row by the mean as shown, ties alike."
    for constant, (title, about) in FAMILIES.items():
        lines += ["", f"## {title}", "", about, "", *(f"- {sentence}" for sentence in claims(results, constant))]
        for metric, (name, _) in METRICS.items():
            lines += ["", f"{name}, all training frames:", "", *_full(results, metric, "test", constant)]
        lines += ["", "LPIPS, first half of the training frames:", "", *_half(results, constant)]
        lines += ["", f"LPIPS, expression codes x {FACTOR:g} (the simulator draws the truth; blinks are not doubled):", ""]
        lines += _full(results, "lpips", "doubled", constant)
    lines += ["", "## Warp, and true against tracked parameters (Ours-D on a learned constant)", "", *_pairs(results), ""]
    lines += _overfit(results)
    return "\n".join([*lines, "", *budget(results), *failures(results)]) + "\n"


def name_of(subject: str) -> str:
    """A subject's name in the table."""
    return f"{subject.removeprefix(PREFIX)} (simulated)" if subject.startswith(PREFIX) else subject


def _full(results: Results, metric: str, frames: str, constant: bool) -> list[str]:
    """Subjects by sources, best and second marked."""
    body = []
    for subject in results.subjects:
        if marks := results.marks(subject, metric, frames, constant):
            why = {source: results.missing(subject, cell_of(source, constant)) for source in SOURCES}
            body.append([name_of(subject), *(marked(*marks.get(source, (why[source], REST))) for source in SOURCES)])
    return table(["subject", *SOURCES.values()], body) if body else ["Not measured."]


def _half(results: Results, constant: bool) -> list[str]:
    body, ours = [], [cell_of(source, constant) for source in OURS]
    for subject in results.subjects:
        cells = [
            figure.text(4) if figure else results.missing(subject, f"{cell}_half")
            for cell in ours
            for figure in (results.figure(subject, f"{cell}_half", "lpips"), results.loss(subject, cell, "half"))
        ]
        body.append([name_of(subject), *cells])
    titles = [f"{SOURCES[source]}{more}" for source in OURS for more in ("", ": worse by")]
    return table(["subject", *titles], body)


def _pairs(results: Results) -> list[str]:
    name = cell_of("ours_d", True)
    names = {name: "tracked, no warp", f"{name}_warp": "tracked, warp", f"{name}_true": "true head and parameters"}
    body = []
    for subject in results.subjects:
        if not any(results.figure(subject, name, "lpips") for name in list(names)[1:]):
            continue
        for name, title in names.items():
            figures = [results.figure(subject, name, metric) for metric in METRICS]
            why = results.missing(subject, name)
            texts = [figure.text(METRICS[metric][1]) if figure else why for metric, figure in zip(METRICS, figures, strict=True)]
            body.append([name_of(subject), title, *texts])
    return table(["subject", "trained with", *(title for title, _ in METRICS.values())], body) if body else ["Not measured."]


def _overfit(results: Results) -> list[str]:
    """One sentence on the four frames that were learned by heart."""
    cell = f"{cell_of('ours_d', True)}_overfit"
    found = {subject: results.figure(subject, cell, "psnr_inside") for subject in results.subjects}
    return [
        f"Four frames learned by heart with the true head and parameters (full-size field, {OVERFIT_KEYS['steps']} steps), "
        f"{name_of(subject)}: {figure.text(2)} dB inside the head (35 were asked for)."
        for subject, figure in found.items()
        if figure
    ]


def budget(results: Results) -> list[str]:
    """What was spent."""
    done = [row for (_, cell, _), row in results.rows.items() if "scores" in row and CELLS[cell].group != "overfit"]
    if not done:
        return []
    frames = sorted({row["scores"]["test"]["frames"] for row in done})
    seconds = [row["train_seconds"] for row in done]
    size = f"{TRAIN.steps} steps of {TRAIN.rays} rays from {TRAIN.frames_per_step} frame(s), UV {TRAIN.uv_size}, width "
    return [
        f"Learning rates: tables {RATES['table']:g}, networks of the sources {RATES['source']:g}, field {RATES['field']:g} of "
        f"{TRAIN.learning_rate:g}. Three seeds on the simulated subject for the sources on a learned constant, "
        "one for the rest and on real subjects, which have the sources on a learned constant alone. "
        f"Budget, equal for all cells but the four frames': frames of at most {SIZE_PX} px, {size}{TRAIN.mlp_width}; "
        f"{'/'.join(map(str, frames))} test frames; {len(done)} cells, training {statistics.median(seconds):.0f} s each in the "
        f"median ({max(seconds):.0f} at most) on one core; load of the machine "
        f"{statistics.median(row['load'] for row in done):.1f}."
    ]


def failures(results: Results) -> list[str]:
    """One line a training that failed."""
    failed = [(key, row["failed"]) for key, row in results.rows.items() if "failed" in row]
    return [f"- {subject}, {cell}, seed {seed}: {why}" for (subject, cell, seed), why in failed]


def claims(results: Results, table: bool) -> list[str]:
    """One sentence a claim of the paper, computed from the figures. table: of the sources on a learned constant."""
    loses = lambda to: lambda found, subject: _loses(found, subject, to, table)  # noqa: E731
    return [
        _claim(results, "C and D beat the other sources on LPIPS", lambda found, subject: _beats(found, subject, table)),
        _claim(results, "D loses less than C with half of the data", loses("half")),
        _claim(results, "D loses less than C on doubled expression codes", loses("doubled")),
    ]


Verdict = tuple[bool, bool, str]
"""Whether it held, whether by more than the seeds' spread, and the figures."""


def _claim(results: Results, claim: str, judge: Callable[[Results, str], Verdict | None]) -> str:
    """`"claim": held on 1 of 2 subjects (...)`."""
    found = {subject: judge(results, subject) for subject in results.subjects}
    known = {subject: verdict for subject, verdict in found.items() if verdict}
    if not known:
        return f'"{claim}": not measured.'
    held = sum(verdict[0] for verdict in known.values())
    words = "held" if held == len(known) else "did not hold" if not held else f"held on {held} of {len(known)} subjects"
    details = [
        f"{name_of(subject)}: {figures}{'' if clear else ', within the spread over seeds, or one seed'}"
        for subject, (_, clear, figures) in known.items()
    ]
    return f'"{claim}": {words} ({"; ".join(details)}).'


def _beats(results: Results, subject: str, table: bool) -> Verdict | None:
    """The worse of C and D against the best of the others."""
    figures = {source: results.figure(subject, cell_of(source, table), "lpips") for source in (*OURS, *OTHERS)}
    if not all(figures.values()):
        return None
    ours, other = max(OURS, key=lambda name: figures[name].mean), min(OTHERS, key=lambda name: figures[name].mean)
    first, second = figures[ours], figures[other]
    text = f"the worse of the two is {SOURCES[ours]} {first.text(4)}, the best other {SOURCES[other]} {second.text(4)}"
    return first.mean < second.mean, _clear(first, second), text


def _loses(results: Results, subject: str, to: str, table: bool) -> Verdict | None:
    """By how much LPIPS grows, D against C."""
    c, d = (results.loss(subject, cell_of(source, table), to) for source in OURS)
    if not (c and d):
        return None
    return d.mean < c.mean, _clear(c, d), f"D {_signed(d)}, C {_signed(c)}"


def _signed(figure: Figure) -> str:
    return ("+" if figure.mean >= 0 else "") + figure.text(4)


def _clear(first: Figure, second: Figure) -> bool:
    """Whether the ranges over the seeds are apart; with one seed nothing is known of the spread, and nothing is clear."""
    return min(first.seeds, second.seeds) > 1 and abs(first.mean - second.mean) > first.spread + second.spread
