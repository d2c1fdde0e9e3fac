"""The tables of scores in LaTeX: variants x subjects as in the paper's Table 1; regions as blocks, as in its ablation table."""

from __future__ import annotations

from collections.abc import Sequence

from avatar.report import latex, tables
from avatar.report.latex import Group, Notes
from avatar.report.table_text import PREDICTORS, kinds
from avatar.report.tables import MEAN, Block, Cell, Subject

COLUMNS = 4
"""Subjects beside each other, as many as the paper's page has; more go into another tabular below."""
ARROWS = {min: r"$\downarrow$", max: r"$\uparrow$"}
PACKAGES = {"booktabs": "rules"}
SHORT = ("background", "mask", "resolution", "lpips", "lpips vgg", "test time fitting")
"""Points of the protocol that stand in the caption, beside those on the regions shown; all are in a comment."""


def scores(blocks: Sequence[Block], subjects: Sequence[Subject], variants: Sequence[str], label: str, cost: bool) -> str:
    """A file with one table: a group of rows a block, and below the frames and (where asked for) the cost."""
    notes = Notes()
    columns = [subject.name for subject in subjects]
    columns += [MEAN] if any(block.mean_of > 1 for block in blocks) else []
    by_name = {subject.name: subject for subject in subjects}
    parts = []
    for start in range(0, len(columns), COLUMNS):
        chosen = columns[start : start + COLUMNS]
        groups = [Group(_title(block, blocks), _rows(block, chosen, subjects, variants, notes)) for block in blocks]
        if cost:
            groups.append(_costs(chosen, subjects, variants, by_name, notes))
        groups.append(Group("", [["Test frames", *(_frames(name, by_name, blocks) for name in chosen)]]))
        parts.append(latex.tabular(_header(chosen, blocks), groups))
    words = tables.protocols(subjects)
    about = [*tables.remarks(subjects, variants), "Protocol:", *(f"  {key}: {text}" for key, text in words.items())]
    about += ["  frames: " + "; ".join(f"{subject.name}: {tables.frames_of(subject)}" for subject in subjects)]
    lines = latex.table(parts, _caption(blocks, subjects, variants, words), label, notes.lines())
    return latex.document(PACKAGES, about, [lines])


def _header(columns: Sequence[str], blocks: Sequence[Block]) -> list[list[str]]:
    """Subjects, and below what a cell shows, where that is the same in all blocks; else their titles say it."""
    count = max(block.mean_of for block in blocks)
    mean = f"Mean of {count}" if len({block.mean_of for block in blocks}) == 1 else "Mean"
    top = ["", *(rf"\textit{{{latex.escape(name) if name != MEAN else mean}}}" for name in columns)]
    if not _alike(blocks):
        return [top]
    units = ", ".join(f"{item.title} in {item.unit}" for item in blocks[0].metrics if item.unit)  # once, for the width
    return [top, [rf"\scriptsize {units}", *[rf"\scriptsize {_titles(blocks[0])}"] * len(columns)]]


def _alike(blocks: Sequence[Block]) -> bool:
    """Whether the cells of all blocks show the same metrics."""
    return len({_titles(block) for block in blocks}) == 1


def _titles(block: Block) -> str:
    """`LPIPS / SSIM / PSNR` with arrows."""
    return " / ".join(latex.escape(item.title) + ARROWS[item.best] for item in block.metrics)


def _title(block: Block, blocks: Sequence[Block]) -> str:
    """Title of a group of rows."""
    words = [latex.escape(block.title)] if block.title else []
    return ", ".join(words if _alike(blocks) else [*words, _titles(block)])


def _rows(
    block: Block, columns: Sequence[str], subjects: Sequence[Subject], variants: Sequence[str], notes: Notes
) -> list[list[str]]:
    """A row a variant."""
    by_name = {subject.name: subject for subject in subjects}
    rows = []
    for variant, title in zip(variants, _names(subjects, variants), strict=True):
        cells = []
        for name in columns:
            if name != MEAN:
                cells.append(_cell(block.cells[name, variant], by_name[name], variant, notes))
            elif block.mean_of > 1:
                cells.append(_cell(block.cells[MEAN, variant], None, variant, notes))
            else:
                cells.append(notes.mark("none", "Fewer than two subjects have these scores of every variant."))
        rows.append([title, *cells])
    return rows


def _names(subjects: Sequence[Subject], variants: Sequence[str]) -> list[str]:
    """Variants as rows, predictors and published renders with a sign that the caption explains."""
    predictors, published = kinds(subjects)
    signs = {True: r"$^\ast$", False: ""}
    daggers = {True: r"$^\dagger$", False: ""}
    return [latex.escape(name) + signs[name in predictors] + daggers[name in published] for name in variants]


def _cell(cell: Cell, subject: Subject | None, variant: str, notes: Notes) -> str:
    """Figures, or a word with the number of the note that says why there are none."""
    if not cell.reason:
        text = " / ".join(latex.marked(*part) for part in cell.parts)
        return notes.mark(text, f"On {cell.remark}.") if cell.remark else text
    if subject is None or cell.reason in (tables.NOT_MEASURED, tables.NO_FACE):
        return latex.escape(cell.reason)
    word = subject.fate(variant)
    return word if cell.reason == tables.NOT_MADE else notes.mark(word, cell.reason)


def _costs(
    columns: Sequence[str], subjects: Sequence[Subject], variants: Sequence[str], by_name: dict[str, Subject], notes: Notes
) -> Group:
    """Render and training time, one row a variant."""
    rows = []
    for variant, title in zip(variants, _names(subjects, variants), strict=True):
        cells = []
        for name in columns:
            if name == MEAN:
                cells.append("not averaged")
            elif variant in by_name[name].results:
                words = " / ".join(tables.cost(by_name[name], variant))
                cells.append(latex.escape(words.replace(" ms /", " /").removesuffix(" s")))  # the title has the units
            else:
                cells.append(_cell(Cell(reason=by_name[name].missing(variant)), by_name[name], variant, notes))
        rows.append([title, *cells])
    return Group("Render time a frame (ms) / training time (s)", rows)


def _frames(name: str, by_name: dict[str, Subject], blocks: Sequence[Block]) -> str:
    if name != MEAN:
        return tables.frames_of(by_name[name])
    counts = dict.fromkeys(str(block.mean_of) for block in blocks if block.mean_of > 1)
    return f"{', '.join(counts)} of {len(by_name)} subjects"


def _caption(blocks: Sequence[Block], subjects: Sequence[Subject], variants: Sequence[str], words: dict[str, str]) -> str:
    """What is shown, how to read it, and the protocol in short."""
    predictors, published = kinds(subjects)
    inside = [name for name, title in tables.REGIONS.items() if title in {block.title for block in blocks}]
    where = f" inside {', '.join(inside)}" if inside else ""
    text = f"Scores of the test frames{where}, mean over the frames ($\\downarrow$ lower, $\\uparrow$ higher is better). "
    text += r"\textbf{Bold} is the best and \underline{underline} the second best of a column, ties marked alike. "
    if predictors:
        text += rf"$^\ast$\,Trivial predictors, not trained: {latex.escape(PREDICTORS)}. "
    if published:
        text += r"$^\dagger$\,Published renders, trained on other frames. "
    if any(block.mean_of > 1 for block in blocks):
        text += "The mean is over the subjects that have scores of every variant. "
    protocol = "; ".join(f"{key}: {words[key]}" for key in (*SHORT, *inside) if key in words)
    return text + (f"Protocol: {latex.escape(protocol)}." if protocol else "The protocol is not known.")
