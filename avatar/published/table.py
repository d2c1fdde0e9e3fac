"""Step `published_table`: one table of a comparison: our avatars, trivial predictors and published renders on the same frames.

Input: metrics (every method's metrics.json) and per_frames (their CSVs, from which all means are taken), in one order.
Output: csv, markdown, latex. Best in bold, second underlined, over all methods, published ones too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from avatar.published.config import PublishedTableConfig
from avatar.report import latex, table_text, tables
from avatar.report.results import many
from workflow import step

TRAINED = {
    "avatar": "Trained here, on the panel's first {train_frames} frames",
    "predictor": "Not trained: made of the panel's first {train_frames} frames",
    "published": "Published: trained on other frames of this person (thousands, on GPUs)",
}
"""By kind, in the order of the table. The frames that test are the same for all."""
REGIONS = ("head", *tables.REGIONS)


@dataclass(frozen=True)
class Method:
    """One row."""

    name: str
    kind: str
    """A key of TRAINED."""
    figures: dict[str, tables.Figure | None]
    frames: tuple[int, ...]
    """Numbers of the scored frames in the comparison video."""
    facts: dict[str, Any]
    """Content of metrics.json."""

    @property
    def trained(self) -> str:
        """What it learned from."""
        return TRAINED[self.kind].format(**self.facts)

    @property
    def counted(self) -> str:
        """Scored frames, of how many where some were left out."""
        lost = self.facts["excluded"]["count"]
        return f"{len(self.frames)} of {len(self.frames) + lost}" if lost else str(len(self.frames))


def collect(reports: Sequence[Path], per_frames: Sequence[Path]) -> list[Method]:
    """The methods in the order of TRAINED; StepError where a file is damaged or of other frames than the first."""
    methods: list[Method] = []
    for report, per_frame in zip(reports, per_frames, strict=True):
        facts = step.read_json(report)
        try:
            table = pd.read_csv(per_frame)
            method = Method(facts["method"], facts["kind"], tables.aggregate(table), tuple(table["frame"]), facts)
        except (ValueError, KeyError) as error:
            raise step.StepError(f"{per_frame}: cannot be used ({error}); delete it and run snakemake again") from None
        if methods and methods[0].frames != method.frames:
            raise step.StepError(f"{per_frame}: other frames than in {per_frames[0]}; delete both and run snakemake again")
        methods.append(method)
    return sorted(methods, key=lambda method: list(TRAINED).index(method.kind))


def cells(methods: Sequence[Method], region: str) -> list[list[tuple[str, int]]]:
    """Text and rank of each metric of a region, one list a method."""
    metrics = tables.SHOWN if region == "head" else tables.of_region(tables.SHOWN, region)
    rows: list[list[tuple[str, int]]] = [[] for _ in methods]
    for metric in metrics:
        found = {place: method.figures.get(metric.name) for place, method in enumerate(methods)}
        texts = {place: f"{figure.mean:.{metric.digits}f}" for place, figure in found.items() if figure}
        ranks = tables.ranks(texts, metric.best)
        for place, row in enumerate(rows):
            row.append((texts[place], ranks[place]) if place in texts else (tables.NO_FACE, tables.REST))
    return rows


def long_rows(methods: Sequence[Method]) -> list[dict[str, Any]]:
    """One row a method with every aggregate."""
    rows = []
    for method in methods:
        row = {"method": method.name, "kind": method.kind, "trained": method.trained}
        for name, figure in method.figures.items():
            if figure:
                row |= {f"{name}_mean": figure.mean, f"{name}_std": figure.std, f"{name}_n": figure.n}
        row |= {"scored_frames": len(method.frames), "excluded_frames": method.facts["excluded"]["count"]}
        rows.append(row | {key: method.facts[key] for key in ("ms_per_frame", "training_seconds", "note")})
    return rows


def markdown(methods: Sequence[Method]) -> str:
    """Methods x regions, then what was left out and what the figures mean."""
    columns = [cells(methods, region) for region in REGIONS]
    title = " / ".join(metric.title for metric in tables.SHOWN)
    lines = [["method", *REGIONS, "frames", "trained"], ["---"] * (len(REGIONS) + 3)]
    for place, method in enumerate(methods):
        texts = [" / ".join(table_text.marked(text, rank) for text, rank in column[place]) for column in columns]
        lines.append([method.name, *texts, method.counted, method.trained])
    table = ["| " + " | ".join(line) + " |" for line in lines]
    top = (
        f"{title} (dB), mean over the scored frames; lower LPIPS, higher SSIM and PSNR are better; best bold, second underlined."
    )
    return "\n".join([top, "", *table, "", *(f"- {line}" for line in remarks(methods))]) + "\n"


def remarks(methods: Sequence[Method]) -> list[str]:
    """What is to be said beside the figures: speed, frames left out, backgrounds, protocol."""
    said = [f"{method.name}: {method.facts['note']}" for method in methods if method.facts["note"]]
    for method in methods:
        if method.facts["training_seconds"] is not None:
            seconds, speed = method.facts["training_seconds"], method.facts["ms_per_frame"]
            said.append(f"{method.name}: {seconds / 60:.0f} minutes of training, {speed:.0f} ms a frame")
    excluded = methods[0].facts["excluded"]
    if excluded["count"]:
        said.append(f"{excluded['count']} test frames left out of every row: {excluded['reason']}")
    return said + [f"{key.replace('_', ' ')}: {text}" for key, text in methods[0].facts["protocol"].items()]


def as_latex(methods: Sequence[Method], name: str) -> str:
    """A file with one table: methods as rows, grouped by what they were trained on, regions as columns."""
    columns = [cells(methods, region) for region in REGIONS]
    titles = " / ".join(latex.escape(metric.title) for metric in tables.SHOWN)
    header = [
        ["", *(region.capitalize() for region in REGIONS), "Frames"],
        ["", *[rf"\footnotesize {titles}"] * len(REGIONS), ""],
    ]
    groups = []
    for kind in dict.fromkeys(method.kind for method in methods):
        chosen = [place for place, method in enumerate(methods) if method.kind == kind]
        rows = [
            [
                latex.escape(methods[place].name),
                *(" / ".join(latex.marked(*part) for part in column[place]) for column in columns),
                methods[place].counted,
            ]
            for place in chosen
        ]
        groups.append(latex.Group(latex.escape(methods[chosen[0]].trained), rows))
    caption = latex.escape(f"{name}: the same test frames for all rows. Lower LPIPS, higher SSIM and PSNR (dB) are better.")
    lines = latex.table([latex.tabular(header, groups)], caption, f"tab:published-{name}")
    return latex.document({"booktabs": "rules"}, remarks(methods), [lines])


def run(job: step.Job) -> None:
    """Write the table in all three forms."""
    methods = collect(many(job.input, "metrics"), many(job.input, "per_frames"))
    table = pd.DataFrame(long_rows(methods))
    counts = [name for name in table.columns if name.endswith(("_n", "_frames"))]
    table.astype(dict.fromkeys(counts, "Int64")).to_csv(job.output.csv, index=False, float_format="%.6f")
    job.output.markdown.write_text(markdown(methods), encoding="utf-8")
    job.output.latex.write_text(as_latex(methods, job.subject), encoding="utf-8")
    job.log.info("%d methods on %s frames", len(methods), methods[0].counted)


if __name__ == "__main__":
    step.main(run, PublishedTableConfig)
