"""The rows of `snakemake speed_error` as figures, sentences and Markdown. Pure numbers and text."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from avatar.report.table_text import table
from avatar.speed_error.settings import GROUPS, REFERENCES

METRICS = {"psnr": ("PSNR, dB", 2, max), "lpips": ("LPIPS", 4, min), "lpips_mouth": ("mouth LPIPS", 4, min)}
"""Title, digits and what is better of the metrics that are drawn against time."""
GROWTH = {"frames": "training frames", "pixels": "longer side, px", "vertices": "vertices of the head model"}
ABOUT = (
    "One run on one machine, a row at a time, with {threads} threads; times are medians. Time counts all work of a frame never "
    "seen before: head model, features, shell, field, compositing. Evaluations are of the field's networks, a ray: over all "
    "rays / over the rays of the head alone (matte above one half). GFLOP: two per multiply-accumulate of matrix products and "
    "convolutions, a frame: all rays / the head's alone. **Bold**: no other row is better and as fast. Memory is the peak of "
    "the process that renders."
)


@dataclass(frozen=True)
class Line:
    """One row with its figures."""

    name: str
    group: str
    what: str
    content: Mapping[str, Any]
    training: str = ""
    of_steps: int | None = None
    against: float | None = None
    """PSNR in dB between this render and the reference's, of the same weights and size."""

    @property
    def failed(self) -> str:
        """Why there are no figures."""
        return self.content.get("failed", "")

    def figure(self, name: str) -> float | None:
        """A metric or a cost; None where it is not known."""
        places = (self.content.get("scores", {}), self.content.get("training", {}), self.content)
        return next((place[name] for place in places if place.get(name) is not None), None)

    @property
    def steps(self) -> str:
        """`450`, or `1500 of 6000`."""
        taken = self.figure("steps")
        return "" if taken is None else f"{taken:g}" + (f" of {self.of_steps}" if self.of_steps else "")


@dataclass(frozen=True)
class Results:
    """Everything that one subject's run gave."""

    subject: str
    lines: Sequence[Line]
    costs: Mapping[str, Mapping[str, Any]]
    left_out: Mapping[str, str]

    @property
    def threads(self) -> int:
        """Of the run; 0 where nothing has ended."""
        return next((line.content["threads"] for line in self.lines if "threads" in line.content), 0)

    def line(self, name: str) -> Line | None:
        """A row that has figures."""
        return next((line for line in self.lines if line.name == name and not line.failed), None)

    def drawn(self) -> list[Line]:
        """The rows with figures that are compared in the plot: of one size, each rendering once."""
        seen, found = set(), []
        for line in self.lines:
            key = id(line.content)
            if line.group != "small" and not line.failed and key not in seen:
                found.append(line)
                seen.add(key)
        return found

    def growth(self, kind: str) -> dict[str, list[Mapping[str, Any]]]:
        """Rows of what grows, by series (a representation, or nothing), the least first."""
        series: dict[str, list[Mapping[str, Any]]] = {}
        for name, row in self.costs.items():
            first, *rest = name.split("_")
            if first == kind:
                series.setdefault("_".join(rest[:-1]), []).append(row)
        return {name: sorted(rows, key=lambda row: row.get("amount", 0)) for name, rows in series.items()}


def front(points: Iterable[tuple[str, float, float]], best: Any) -> list[str]:
    """Names of the points that no other beats, the fastest first.

    points: name, cost, error. best: `min` or `max`, of the error. Of equal ones the first stays.
    """
    found, limit = [], math.inf if best is min else -math.inf
    for name, _, error in sorted(points, key=lambda point: (point[1], point[2] if best is min else -point[2])):
        if error < limit if best is min else error > limit:
            found.append(name)
            limit = error
    return found


def fronts(results: Results, cost: str) -> dict[str, list[str]]:
    """By metric the names of the rows on the front against a cost."""
    lines = [line for line in results.drawn() if line.figure(cost) is not None]
    found = {}
    for metric, (_, _, best) in METRICS.items():
        points = [(line.name, line.figure(cost), line.figure(metric)) for line in lines if line.figure(metric) is not None]
        chosen = {id(line.content) for line in lines if line.name in front(points, best)}
        found[metric] = [line.name for line in results.lines if id(line.content) in chosen]  # the same rendering by other names
    return found


def number(value: float | None, digits: int = 3) -> str:
    """Significant digits without an exponent; `not counted` for None."""
    if value is None:
        return "not counted"
    if value == 0:
        return "0"
    return f"{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}"


def cells(line: Line, marks: Mapping[str, Sequence[str]]) -> list[str]:
    """A row's figures as text. marks: names on the front by metric."""
    out = [line.what]
    for metric, (_, digits, _) in METRICS.items():
        value = line.figure(metric)
        text = "no face" if value is None else f"{value:.{digits}f}"
        out.append(f"**{text}**" if line.name in marks.get(metric, ()) else text)
    out.append(number(line.figure("iou"), 4))
    out.append("reference" if line.against is None and line.name in REFERENCES else
               "other weights" if line.against is None else f"{line.against:.1f}")  # fmt: skip
    out.append(number(line.figure("ms_per_frame")))
    for names in (("evaluations_per_ray", "evaluations_per_head_ray"), ("gflop_per_frame", "gflop_of_head")):
        found = [number(line.figure(name)) for name in names]
        out.append(found[0] if found[0] == "not counted" else " / ".join(found))
    return [*out, f"{number(line.figure('train_seconds'))} ({line.steps})", number(line.figure("memory_mb"))]


HEADER = (
    "",
    *(title for title, _, _ in METRICS.values()),
    "matte IoU",
    "dB to dense",
    "ms a frame",
    "evaluations a ray",
    "GFLOP a frame",
    "training, s (steps)",
    "MB",
)


def markdown(results: Results) -> str:
    """The table group by group, cost as work grows, what was claimed, what was left out."""
    lines = [f"# Speed against error: {results.subject}", "", ABOUT.format(threads=results.threads), ""]
    marks = fronts(results, "ms_per_frame")
    for group, title in GROUPS.items():
        chosen = [line for line in results.lines if line.group == group]
        if not chosen:
            continue
        rows = [[line.what, "failed", *[""] * (len(HEADER) - 2)] if line.failed else cells(line, marks) for line in chosen]
        lines += [f"## {title[0].upper()}{title[1:]}", "", *table(HEADER, rows), ""]
    lines += ["## Cost as work grows", "", *growth(results)]
    if found := claims(results):
        lines += ["## Shell against dense", "", *(f"- {sentence}" for sentence in found), ""]
    failed = {f"{GROUPS[line.group]}, {line.what}": line.failed for line in results.lines if line.failed}
    lines += [f"- not run: {what}: {why}" for what, why in results.left_out.items()]
    lines += [f"- failed: {what}: {why}" for what, why in failed.items()]
    return "\n".join(lines).rstrip() + "\n"


COSTS = {"prepare_s": "preparation, s", "step_s": "s a step", "ms_per_frame": "ms a frame", "memory_mb": "MB"}


def growth(results: Results) -> list[str]:
    """A table for each thing that grows."""
    out = []
    for kind, title in GROWTH.items():
        for series, rows in results.growth(kind).items():
            known = [row for row in rows if "amount" in row]
            names = [name for name in COSTS if any(name in row for row in known)]
            body = [[f"{row['amount']:g}", *(number(row.get(name)) for name in names)] for row in known]
            head = f"{title}{f' ({series})' if series else ''}"
            out += [*table([head, *(COSTS[name] for name in names)], body), ""] if body else [f"{head}: failed", ""]
    return out


def claims(results: Results) -> list[str]:
    """One sentence on each pair of renderings of the same weights, and on the counts."""
    found = []
    for reference, name in REFERENCES.items():
        shell, dense = results.line(name), results.line(reference)
        if shell is None or dense is None:
            continue
        ratio = {name: dense.figure(name) / max(shell.figure(name), 1e-9) for name in
                 ("evaluations_per_ray", "evaluations_per_head_ray", "ms_per_frame")}  # fmt: skip
        difference = {name: shell.figure(name) - dense.figure(name) for name in ("psnr", "lpips", "iou")}
        found.append(
            f"{max(dense.content['size'])} px, {dense.what} against the shell, the same weights: "
            f"{difference['psnr']:+.2f} dB and {difference['lpips']:+.4f} LPIPS to the truth, {difference['iou']:+.4f} matte IoU"
            + ("" if shell.against is None else f", {shell.against:.1f} dB between the two renders")
            + f"; {ratio['evaluations_per_ray']:.1f} times fewer evaluations over all rays, "
            f"{ratio['evaluations_per_head_ray']:.1f} over the head's, {ratio['ms_per_frame']:.1f} times less time "
            f"({number(shell.figure('ms_per_frame'))} ms)."
        )
    return found


def long_rows(results: Results) -> list[dict[str, Any]]:
    """One CSV row a rendering, every figure in its own column."""
    marks, out = fronts(results, "ms_per_frame"), []
    names = ("steps", "train_seconds", "evaluations_per_step", "ms_per_frame", "evaluations_per_ray", "evaluations_per_head_ray",
             "gflop_per_frame", "gflop_of_head", "memory_mb", "threads")  # fmt: skip
    for line in results.lines:
        row: dict[str, Any] = {"subject": results.subject, "row": line.name, "group": line.group, "what": line.what}
        row |= {"size": "x".join(map(str, reversed(line.content.get("size", [])))), "frames": len(line.content.get("frames", []))}
        row |= dict(line.content.get("scores", {})) | {"psnr_to_dense": line.against}
        row |= {name: line.figure(name) for name in names}
        row |= {f"front_{metric}": line.name in names for metric, names in marks.items()}
        out.append(row | {"note": line.failed or (f"of {line.of_steps} steps" if line.of_steps else "")})
    return out
