"""Step `plot`, of one subject (outputs curve and error) or of all of them (output speed), as SVG.

One subject: inputs curves (curve.tsv), metrics, per_frames of its variants -> training curve, error of each test frame.
All subjects: input metrics -> speed against error.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import pandas as pd
from matplotlib.figure import Figure

from avatar.report import figures
from avatar.report.config import PlotConfig
from avatar.report.results import by_variant, many, subject_of, variant_of
from workflow import step


def _save(figure: Figure, path: Path) -> None:
    """SVG without a date, so that the same figures give the same file."""
    figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})


def _read(path: Path, separator: str, needed: tuple[str, ...]) -> pd.DataFrame:
    """A table with at least one row and the named columns; StepError names the file otherwise."""
    try:
        table = pd.read_csv(path, sep=separator)
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise step.StepError(f"{path}: not readable as a table ({error}); delete it and run snakemake again") from None
    lost = [name for name in needed if name not in table]
    if lost or table.empty:
        what = f"column {lost[0]} is missing" if lost else "no rows"
        raise step.StepError(f"{path}: {what}; delete it and run snakemake again")
    return table


def subject_figures(job: step.Job) -> None:
    """The two plots of one subject."""
    curves = {
        name: _read(path, "\t", ("step", "seconds", "loss")) for name, path in by_variant(many(job.input, "curves")).items()
    }
    metrics = {name: step.read_json(path) for name, path in by_variant(many(job.input, "metrics")).items()}
    scores = ("frame", "lpips", "psnr", "ssim")
    tables = {name: _read(path, ",", scores) for name, path in by_variant(many(job.input, "per_frames")).items()}
    _save(figures.training_figure(curves, job.subject), job.output.curve)
    predictors = [name for name, content in metrics.items() if content["predictor"]]
    _save(figures.error_figure(tables, predictors, job.subject), job.output.error)


def cohort_figure(job: step.Job) -> None:
    """The plot over all subjects."""
    rows = []
    for path in many(job.input, "metrics"):
        content = step.read_json(path)
        means = {name: content["metrics"][name]["mean"] for name in ("lpips", "psnr")}
        cost = {name: content[name] for name in ("predictor", "ms_per_frame", "training_seconds")}
        rows.append({"subject": subject_of(path), "variant": variant_of(path)} | means | cost)
    columns = ["subject", "variant", "lpips", "psnr", "predictor", "ms_per_frame", "training_seconds"]
    numbers = dict.fromkeys(("lpips", "psnr", "ms_per_frame", "training_seconds"), float)
    _save(figures.speed_figure(pd.DataFrame(rows, columns=columns).astype(numbers | {"predictor": bool})), job.output.speed)


def run(job: step.Job) -> None:
    """Draw the plots that the outputs name."""
    with mpl.rc_context(figures.STYLE):
        if hasattr(job.output, "speed"):
            cohort_figure(job)
        else:
            subject_figures(job)


if __name__ == "__main__":
    step.main(run, PlotConfig)
