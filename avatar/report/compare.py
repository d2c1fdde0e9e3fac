"""Step: the tracking benchmark's rows as one table and one plot of speed against error.

    python -m avatar.report.compare --input rows=results/tracking_benchmark/rows/ann/all.json rows=... \\
        --output csv=... markdown=... plot=...

The folder names say which clip and setting a file belongs to: `rows/{subject}/{setting}.json`.
"""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
import pandas as pd

from avatar.report import figures, tracking_figure
from avatar.report.config import CompareConfig
from avatar.report.results import many
from fitting import benchmark_table
from workflow import step

KEYS = ("subject", "simulated", "frames")


def run(job: step.Job) -> None:
    """Write table and plot."""
    rows: list[dict[str, Any]] = []
    for path in many(job.input, "rows"):
        row = step.read_json(path)
        if lost := [name for name in KEYS if name not in row]:
            raise step.StepError(f"{path}: {lost[0]} is missing; delete it and run snakemake again")
        rows.append(row | {"setting": path.stem})
    if not rows:
        raise step.StepError("results/tracking_benchmark: there are no rows; run snakemake tracking_benchmark")
    pd.DataFrame(benchmark_table.long_rows(rows)).to_csv(job.output.csv, index=False)
    job.output.markdown.write_text(benchmark_table.markdown(rows), encoding="utf-8")
    with mpl.rc_context(figures.STYLE):
        figure = tracking_figure.figure(benchmark_table.sections(rows))
        figure.savefig(job.output.plot, format="svg", metadata={"Date": None, "Creator": None})
    job.log.info("%d fits, %d of them without a track", len(rows), sum("failed" in row for row in rows))


if __name__ == "__main__":
    step.main(run, CompareConfig)
