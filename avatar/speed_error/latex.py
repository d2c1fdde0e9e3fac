"""The rows of `snakemake speed_error` as LaTeX, in the layout of the project's other tables. Pure text."""

from __future__ import annotations

from avatar.report import latex
from avatar.report.latex import Group, Notes
from avatar.report.tables import BEST, REST
from avatar.speed_error import report
from avatar.speed_error.report import METRICS, Line, Results, number
from avatar.speed_error.settings import GROUPS

PACKAGES = {"booktabs": "rules"}
HEADER = ("", *(title for title, _, _ in METRICS.values()), "ms", "eval./ray", "GFLOP", "train, s", "steps")


def document(results: Results) -> str:
    """A file with one table of renderings and one of what grows."""
    about = [report.ABOUT.format(threads=results.threads)]
    about += [*report.claims(results), *(f"not run: {what}: {why}" for what, why in results.left_out.items())]
    return latex.document(PACKAGES, about, [_rows(results), *_growth(results)])


def _rows(results: Results) -> list[str]:
    marks, notes, groups = report.fronts(results, "ms_per_frame"), Notes(), []
    for group, title in GROUPS.items():
        chosen = [line for line in results.lines if line.group == group]
        if chosen:
            groups.append(Group(latex.escape(title), [_row(line, marks, notes) for line in chosen]))
    header = [[latex.escape(name) for name in HEADER]]
    caption = rf"Speed against error, {latex.escape(results.subject)}. "
    caption += r"\textbf{Bold}: no other row is better and as fast. Evaluations of the networks over all rays / the head's rays."
    return latex.table([latex.tabular(header, groups)], caption, "tab:speed_error", notes.lines())


def _row(line: Line, marks: dict[str, list[str]], notes: Notes) -> list[str]:
    if line.failed:
        return [latex.escape(line.what), notes.mark("failed", line.failed), *[""] * (len(HEADER) - 2)]
    cells = []
    for metric, (_, digits, _) in METRICS.items():
        value = line.figure(metric)
        rank = BEST if line.name in marks[metric] else REST
        cells.append("no face" if value is None else latex.marked(f"{value:.{digits}f}", rank))
    costs = [number(line.figure("ms_per_frame"))]
    costs.append(" / ".join(number(line.figure(name)) for name in ("evaluations_per_ray", "evaluations_per_head_ray")))
    costs += [number(line.figure("gflop_per_frame")), number(line.figure("train_seconds")), line.steps]
    return [latex.escape(line.what), *cells, *map(latex.escape, costs)]


def _growth(results: Results) -> list[list[str]]:
    """One table whose groups are what grows."""
    groups = []
    for kind, title in report.GROWTH.items():
        for series, rows in results.growth(kind).items():
            known = [row for row in rows if "amount" in row]
            body = [[f"{row['amount']:g}", *(number(row[name]) if name in row else "" for name in report.COSTS)] for row in known]
            if body:
                groups.append(Group(latex.escape(f"{title}{f' ({series})' if series else ''}"), body))
    if not groups:
        return []
    header = [["", *(latex.escape(name) for name in report.COSTS.values())]]
    return [latex.table([latex.tabular(header, groups)], "Cost as work grows.", "tab:cost_growth", wide=False)]
