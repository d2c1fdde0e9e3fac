"""Step: the cells of the ablation as one table, with what became of the paper's claims, and one plot.

    python -m avatar.ablation.table --input rows=results/ablation/rows/ann/ours_c/0.json rows=... \\
        --output csv=... markdown=... latex=... plot=...

The folder names say which cell a file belongs to: `rows/{subject}/{cell}/{seed}.json`.
"""

from __future__ import annotations

import math
from typing import Any

import matplotlib as mpl
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from avatar.ablation import latex as ablation_latex
from avatar.ablation import report as ablation_report
from avatar.ablation.config import AblationTableConfig
from avatar.ablation.report import Results
from avatar.ablation.settings import CELLS, SOURCES
from avatar.report import figures
from avatar.report.results import many
from workflow import step

PANEL_IN, REST_IN = 2.6, 2.0  # height of a subject's panel, and of what is around the panels


def run(job: step.Job) -> None:
    """Write tables and plot."""
    rows: list[dict[str, Any]] = []
    for path in many(job.input, "rows"):
        row = step.read_json(path)
        if "scores" not in row and "failed" not in row:
            raise step.StepError(f"{path}: scores is missing; delete it and run snakemake again")
        for frames, scores in row.get("scores", {}).items():
            if lost := [name for name, value in scores.items() if not math.isfinite(value)]:
                raise step.StepError(f"{path}: {lost[0]} of the {frames} frames is {scores[lost[0]]}; delete it and run again")
        rows.append(row | {"subject": path.parents[1].name, "cell": path.parent.name, "seed": int(path.stem)})
    if not rows:
        raise step.StepError("results/ablation: there are no rows; run snakemake ablation")
    results = Results(rows)
    pd.DataFrame(ablation_report.long_rows(results)).to_csv(job.output.csv, index=False)
    job.output.markdown.write_text(ablation_report.markdown(rows), encoding="utf-8")
    job.output.latex.write_text(ablation_latex.document(results), encoding="utf-8")
    with mpl.rc_context(figures.STYLE):
        plot(results).savefig(job.output.plot, format="svg", metadata={"Date": None, "Creator": None})
    for sentence in (*ablation_report.claims(results, False), *ablation_report.claims(results, True)):
        job.log.info("%s", sentence)


def plot(results: Results) -> Figure:
    """A panel a subject: LPIPS of every cell, a mark a seed; hollow marks are the doubled codes."""
    count = len(results.subjects)
    height = PANEL_IN * count + REST_IN
    out = Figure((figures.WIDTH_IN, height))
    panels = out.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    out.subplots_adjust(0.08, 1.4 / height, 0.98, 1 - 0.8 / height, hspace=0.3)
    for axes, subject in zip(panels, results.subjects, strict=True):
        for place, cell in enumerate(CELLS):
            _marks(axes, results, subject, cell, place)
        axes.set_title(ablation_report.name_of(subject))
        axes.set_ylabel("LPIPS")
        axes.margins(y=0.15)
        axes.axvline(len(SOURCES) - 0.5, color=figures.INK, linewidth=0.6)
    panels[-1].set_xticks(range(len(CELLS)), list(CELLS), rotation=35, ha="right", rotation_mode="anchor")
    panels[-1].set_xlim(-0.6, len(CELLS) - 0.4)
    out.suptitle("Ablation: LPIPS by source of the features", x=0.08, y=1 - 0.1 / height, ha="left", va="top", fontweight="bold")
    legend = "lower is better; a mark a seed; full: test frames, hollow: expression codes doubled (simulated subject)"
    out.text(0.08, 1 - 0.42 / height, legend, fontsize=8.5, color="#475569", va="top")
    return out


def _marks(axes: Axes, results: Results, subject: str, cell: str, place: int) -> None:
    """One cell's seeds, and a line at their mean."""
    for frames, fill, shift in (("test", figures.INK, -0.1), ("doubled", "white", 0.1)):
        values = list(results.by_seed(subject, cell, "lpips", frames).values())
        if not values:
            continue
        x = place + shift
        marks = axes.plot([x] * len(values), values, "o", color=figures.INK, markerfacecolor=fill, markersize=5.5, alpha=0.85)
        marks[0].set_gid(f"{subject}-{cell}-{frames}")
        axes.hlines(sum(values) / len(values), x - 0.12, x + 0.12, color=figures.INK, linewidth=1)


if __name__ == "__main__":
    step.main(run, AblationTableConfig)
