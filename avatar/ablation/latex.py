"""The ablation as LaTeX in the layout of the paper's table: sources down, subjects across, LPIPS; full data, then half of it."""

from __future__ import annotations

from collections.abc import Sequence

from avatar.ablation import report as ablation_report
from avatar.ablation.report import FAILED, OURS, Figure, Results
from avatar.ablation.settings import FACTOR, SOURCES, cell_of
from avatar.report import latex
from avatar.report.latex import Group, Notes
from avatar.report.tables import REST

COLUMNS = 4
"""Subjects beside each other; more go into another tabular below."""
PACKAGES = {"booktabs": "rules", "xcolor": "gains and losses"}
WORSE, BETTER = r"\textcolor{red}", r"\textcolor[rgb]{0,0.5,0}"
"""Beside a sign: colour is not the only mark."""


def document(results: Results) -> str:
    """A file with one table for each family of sources that has figures."""
    tables = []
    for constant, (title, about) in ablation_report.FAMILIES.items():
        names = [name for name in results.subjects if results.marks(name, "lpips", "test", constant)]
        if names:
            tables.append(_table(results, names, constant, f"{title}. {about}"))
    about = [*ablation_report.budget(results), *ablation_report.failures(results)]
    about += [sentence for constant in ablation_report.FAMILIES for sentence in ablation_report.claims(results, constant)]
    return latex.document(
        PACKAGES, about if tables else [*about, "No training has ended yet: there is no figure to show."], tables
    )


def _table(results: Results, subjects: Sequence[str], constant: bool, about: str) -> list[str]:
    notes, parts = Notes(), []
    for start in range(0, len(subjects), COLUMNS):
        chosen = subjects[start : start + COLUMNS]
        header = [["", *(rf"\textit{{{latex.escape(ablation_report.name_of(name))}}}" for name in chosen)]]
        groups = [
            Group("Full Training Data", _sources(results, chosen, "test", constant, notes)),
            Group(r"First $50\%$ Training Data", _half(results, chosen, constant, notes)),
        ]
        if any(results.marks(name, "lpips", "doubled", constant) for name in chosen):
            rows = _sources(results, chosen, "doubled", constant, notes)
            groups.append(Group(rf"Expression Codes $\times {FACTOR:g}$", rows))
        parts.append(latex.tabular(header, groups))
    caption = "LPIPS (AlexNet), lower is better, by source of the features. "
    caption += r"\textbf{Bold} denotes the best while \underline{underline} denotes the second best, ties marked alike. "
    caption += r"$\pm$ is half of the range over the seeds. With half of the data: the difference to full data below. "
    label = "tab:ablations_constant" if constant else "tab:ablations"
    return latex.table(parts, caption + latex.escape(about), label, notes.lines(), wide=min(len(subjects), COLUMNS) > 2)


def _sources(results: Results, subjects: Sequence[str], frames: str, constant: bool, notes: Notes) -> list[list[str]]:
    """A row a source, best and second marked within a subject."""
    marks = {name: results.marks(name, "lpips", frames, constant) for name in subjects}
    rows = []
    for source, title in SOURCES.items():
        cells = []
        for name in subjects:
            if source in marks[name]:
                cells.append(_figure(*marks[name][source]))
            elif frames == "doubled" and results.marks(name, "lpips", "test", constant).get(source):
                cells.append(notes.mark("unknown", "A real subject has no true pictures of doubled codes."))
            else:
                cells.append(_missing(results, name, cell_of(source, constant), notes))
        rows.append([latex.escape(title), *cells])
    return rows


def _half(results: Results, subjects: Sequence[str], constant: bool, notes: Notes) -> list[list[str]]:
    """Two rows a source: the figure, and by how much it is worse than with all frames."""
    rows = []
    for source in OURS:
        cell = cell_of(source, constant)
        figures = {name: results.figure(name, f"{cell}_half", "lpips") for name in subjects}
        cells = [
            _figure(figure.text(4), REST) if figure else _missing(results, name, f"{cell}_half", notes)
            for name, figure in figures.items()
        ]
        losses = {name: results.loss(name, cell, "half") for name in subjects}
        changes = [_change(loss) if loss else "no comparison" for loss in losses.values()]
        rows += [[latex.escape(SOURCES[source]), *cells], ["", *changes]]
    return rows


def _figure(text: str, rank: int) -> str:
    """`0.1417 ± 0.0012` with the mean marked and the spread small."""
    mean, _, spread = text.partition(" ± ")
    return latex.marked(mean, rank) + (rf" {{\scriptsize $\pm$ {spread}}}" if spread else "")


def _change(loss: Figure) -> str:
    text = f"{loss.mean:+.4f}"
    return rf"{WORSE if loss.mean > 0 else BETTER}{{{text}}}"


def _missing(results: Results, subject: str, cell: str, notes: Notes) -> str:
    """A word, and for a failure its reason as a note."""
    word = results.missing(subject, cell)
    if word != FAILED:
        return word
    reasons = [
        row["failed"] for (name, kind, _), row in results.rows.items() if (name, kind) == (subject, cell) and "failed" in row
    ]
    return notes.mark("failed", "; ".join(dict.fromkeys(reasons)))
