"""Step: the rows of `snakemake speed_error` as tables, one plot and one report.

    python -m avatar.speed_error.table --config '{"rows": {...}}' --input rows=results/speed_error/ann/rows/shell_8.json \\
        rows=... renders=.../shell_8.npy curves=.../trainings/ours_d/curve.tsv costs=.../costs/frames_50.json \\
        --output csv=... markdown=... latex=... plot=... report=...

File and folder names say which cell a file belongs to.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd

from avatar.report import figures
from avatar.report.plot import _read as read_table
from avatar.report.results import many
from avatar.speed_error import latex as speed_latex
from avatar.speed_error import plot, report
from avatar.speed_error.config import RowPlan, SpeedTableConfig
from avatar.speed_error.report import Line, Results
from avatar.speed_error.settings import REFERENCES
from workflow import step


def run(job: step.Job) -> None:
    """Write tables, plot and report."""
    contents = {path.stem: step.read_json(path) for path in many(job.input, "rows")}
    renders = {path.stem: path for path in many(job.input, "renders")}
    if lost := sorted({plan.cell for plan in job.config.rows.values()} - set(contents)):
        raise step.StepError(f"{job.output.csv.parent}: there is no row {lost[0]}; run snakemake speed_error")
    lines = [line_of(name, plan, job.config.rows, contents, renders) for name, plan in job.config.rows.items()]
    costs = {path.stem: step.read_json(path) for path in many(job.input, "costs")}
    results = Results(job.subject, lines, costs, job.config.left_out)
    curves = {path.parent.name: read_table(path, "\t", ("step", "seconds", "probe_psnr")) for path in many(job.input, "curves")
              if len(path.read_text(encoding="utf-8").splitlines()) > 1}  # fmt: skip
    rows = report.long_rows(results)
    pd.DataFrame(rows).to_csv(job.output.csv, index=False)
    job.output.markdown.write_text(report.markdown(results), encoding="utf-8")
    job.output.latex.write_text(speed_latex.document(results), encoding="utf-8")
    with mpl.rc_context(figures.STYLE):
        made = plot.figure(results, curves)
        made.savefig(job.output.plot, format="svg", metadata={"Date": None, "Creator": None})
    whole = {"rows": rows, "costs": {name: without_origin(row) for name, row in costs.items()}}
    whole |= {"curves": {name: curve.to_dict("list") for name, curve in curves.items()}}
    whole |= {"fronts": report.fronts(results, "ms_per_frame"), "claims": report.claims(results), "left_out": job.config.left_out}
    job.write_json(job.output.report, whole)
    for sentence in report.claims(results):
        job.log.info("%s", sentence)


def without_origin(row: dict[str, Any]) -> dict[str, Any]:
    """A row's own figures."""
    return {name: value for name, value in row.items() if name != "provenance"}


def line_of(name: str, plan: RowPlan, plans: dict[str, RowPlan], contents: dict[str, Any], renders: dict[str, Path]) -> Line:
    """A row with its figures, and how near its pictures are to the reference's of the same weights and size."""
    against = None
    for other in REFERENCES:
        same = other in plans and other != name and plans[other].training == plan.training
        if same and plans[other].cell in renders and plan.cell in renders:
            first, second = (np.load(renders[cell], mmap_mode="r") for cell in (plan.cell, plans[other].cell))
            alike = contents[plan.cell].get("frames") == contents[plans[other].cell].get("frames")
            if alike and first.shape == second.shape and len(first):
                against = between(first, second)
    return Line(name, plan.group, plan.what, contents[plan.cell], plan.training, plan.of_steps, against)


def between(first: np.ndarray, second: np.ndarray) -> float:
    """Mean PSNR in dB over the colours of two renders [B, H, W, 4] uint8; 100 where they are equal."""
    error = (first[..., :3].astype(np.float64) - second[..., :3]) / 255
    squared = np.maximum((error**2).mean((1, 2, 3)), 1e-10)
    return float(np.mean(-10 * np.log10(squared)))


if __name__ == "__main__":
    step.main(run, SpeedTableConfig)
