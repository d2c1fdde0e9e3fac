"""Step `tabulate`: the tables of all subjects and variants, made from the scores of single frames.

Input: probes (every probe.json), per_frames (every per_frame.csv), metrics (every metrics.json), logs (of what failed); any may
be absent. Output: csv, per_frame (csv), markdown, latex, regions_markdown, regions_latex.

Every figure is computed here from the per-frame files; metrics.json says only what was measured how, on which frames it could not
be, and what it cost. The folder names say which subject and variant a file belongs to: `{subject}/{variant}/metrics/...`.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pandas as pd

from avatar.report import table_latex, table_text, tables
from avatar.report.config import TabulateConfig
from avatar.report.results import many, subject_of, variant_of
from avatar.report.tables import Scores, Subject
from workflow import step

AGAIN = "delete it and run snakemake again"
VARIANT_STEPS = ("train", "render", "evaluate")
LOG_LINE = re.compile(r"\d\d:\d\d:\d\d [\w.]+(\[[^\]]*\])? (?P<message>.+)")
REASON_LENGTH = 300


def read_per_frame(path: Path) -> pd.DataFrame:
    """The scores of one variant's frames; an empty field becomes NaN.

    Raises:
        StepError: not a table of frames, a frame twice, a score that is not a number or not finite, one that every frame must
            have is missing, or another one without a note that says why.
    """
    try:
        table = pd.read_csv(path, dtype=str, na_filter=False, encoding="utf-8")
    except (OSError, UnicodeError, pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise step.StepError(f"{path}: not readable as a table ({error}); {AGAIN}") from None
    if lost := [name for name in ("frame", *tables.HEAD) if name not in table]:
        raise step.StepError(f"{path}: column {lost[0]} is missing; {AGAIN}")
    if table.empty:
        raise step.StepError(f"{path}: no frames; {AGAIN}")
    if not table["frame"].str.fullmatch(r"\d+").all() or table["frame"].duplicated().any():
        raise step.StepError(f"{path}: frames must be whole numbers, each once; {AGAIN}")
    table["frame"] = table["frame"].astype(int)
    table["note"] = table.get("note", "")
    for name in (name for name in table if name not in ("frame", "note")):
        for frame, text, note in zip(table["frame"], table[name], table["note"], strict=True):
            if not _is_score(text) and (text or name in tables.ALWAYS or (name in tables.COLUMNS and not note)):
                raise step.StepError(f"{path}: frame {frame} has {name} = {text or 'nothing'}; {AGAIN}")
        table[name] = pd.to_numeric(table[name].replace("", None)).astype(float)
    return table


def _is_score(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def scores_of(path: Path, table: pd.DataFrame, facts: dict[str, Any] | None) -> Scores:
    """Aggregates of a per-frame file, with what metrics.json says of it (None where there is none)."""
    try:
        scores = Scores(tables.aggregate(table), tuple(table["frame"]))
    except ValueError as error:
        raise step.StepError(f"{path}: {error}; {AGAIN}") from None
    if facts is None:
        return scores
    scores.predictor, scores.published = bool(facts.get("predictor", False)), facts.get("kind") == "published"
    scores.excluded, scores.protocol = facts["excluded"]["count"], facts["protocol"]
    scores.ms_per_frame, scores.training_seconds = facts.get("ms_per_frame"), facts.get("training_seconds")
    for name in ("ms_per_frame", "training_seconds"):
        value = getattr(scores, name)
        if value is not None and not math.isfinite(value):
            raise step.StepError(f"{path.with_name('metrics.json')}: {name} is {value}; {AGAIN}")
    return scores


def log_reason(path: Path) -> str:
    """What is known of a failure from the log of the step that did not finish: the last thing it said.

    A step that fails for a reason that the user can act on says it in one sentence and ends; one that was killed ends in the
    middle of something. So the words are quoted, not interpreted.
    """
    lines = [line.strip() for line in path.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    if not lines:
        return f"failed: see {path}"
    found = LOG_LINE.fullmatch(lines[-1])
    last = found["message"] if found else lines[-1]
    if last.startswith("done in "):
        return f"failed: {path} ends well, but its result is gone; run snakemake again"
    short = last if len(last) <= REASON_LENGTH else last[: REASON_LENGTH - 1] + "…"
    return f"failed: {path} ends “{short}”"


def failures(logs: list[Path]) -> dict[tuple[str, str], str]:
    """Reason by subject and variant, the variant empty for a step that all variants need."""
    reasons = {}
    for path in logs:
        own = path.stem in VARIANT_STEPS
        key = (path.parents[1].name, path.parent.name) if own else (path.parent.name, "")
        reasons[key] = log_reason(path)
    return reasons


def collect(job: step.Job) -> tuple[list[Subject], pd.DataFrame]:
    """Subjects in the order expected, then as their files come; and all per-frame files as one."""
    facts = {path.parents[1].name: step.read_json(path) for path in many(job.input, "probes")}
    said = {path.parent: step.read_json(path) for path in many(job.input, "metrics")}
    reasons = failures(many(job.input, "logs"))
    for folder in said.keys() - {path.parent for path in many(job.input, "per_frames")}:
        key = (folder.parents[1].name, folder.parent.name)
        reasons.setdefault(key, f"failed: {folder / 'per_frame.csv'} is gone; run snakemake again")
    results: dict[str, dict[str, Scores]] = {}
    frames = []
    for path in many(job.input, "per_frames"):
        table = read_per_frame(path)
        results.setdefault(subject_of(path), {})[variant_of(path)] = scores_of(path, table, said.get(path.parent))
        table.insert(0, "variant", variant_of(path))
        table.insert(0, "subject", subject_of(path))
        frames.append(table)
    subjects = []
    for name in dict.fromkeys([*job.config.subjects, *facts, *results]):
        found = results.get(name, {})
        own = {variant: reason for (subject, variant), reason in reasons.items() if subject == name}
        if name in facts and not facts[name]["accepted"]:
            subjects.append(Subject(name, "rejected", facts[name]["reason"]))
        elif found:
            subjects.append(Subject(name, "ok", "", found, own))
        else:
            why = own.get("") or next(iter(own.values()), "")
            subjects.append(Subject(name, "failed", why) if why else Subject(name, "not made", tables.NOT_MADE))
    return subjects, _joined(frames)


def _joined(frames: list[pd.DataFrame]) -> pd.DataFrame:
    """One long table; where a file lacks a metric that another has, its note says so."""
    columns = dict.fromkeys(name for table in frames for name in table.columns)
    known = ["subject", "variant", "frame", *(name for name in tables.COLUMNS if name in columns)]
    ordered = [*known, *(name for name in columns if name not in (*known, "note")), "note"]
    for table in frames:
        absent = ", ".join(name for name in ordered if name not in table)
        if absent:
            more = f"{tables.NOT_MEASURED}: {absent}"
            table["note"] = [f"{note}; {more}" if note else more for note in table["note"]]
    return pd.concat(frames)[ordered] if frames else pd.DataFrame(columns=["subject", "variant", "frame", "note"])


def run(job: step.Job) -> None:
    """Write the tables in all forms."""
    subjects, frames = collect(job)
    if not subjects:
        raise step.StepError("results: there is nothing to tabulate yet; run snakemake first")
    variants = tables.ordered_variants(subjects, job.config.variants) or ["result"]
    table = pd.DataFrame(table_text.long_rows(subjects, variants))
    table.insert(len(table.columns) - 1, "note", table.pop("note"))
    counts = [name for name in table.columns if name.endswith(("_n", "_frames"))]
    table = table.astype(dict.fromkeys(counts, "Int64"))  # whole numbers beside empty fields
    table.to_csv(job.output.csv, index=False, float_format="%.6f")
    frames.to_csv(job.output.per_frame, index=False, float_format="%.6f")
    blocks = [tables.block("", tables.SHOWN, subjects, variants)]
    if any(metric.name in scores.figures for metric in tables.VGG for subject in subjects for scores in subject.results.values()):
        blocks.append(tables.block("Another network", tables.VGG, subjects, variants))
    regions = [
        tables.block(title, tables.of_region(tables.SHOWN, name), subjects, variants) for name, title in tables.REGIONS.items()
    ]
    out = job.output
    for chosen, text, source, whole in (
        (blocks, out.markdown, out.latex, True),
        (regions, out.regions_markdown, out.regions_latex, False),
    ):
        text.write_text(table_text.markdown(chosen, subjects, variants, cost=whole), encoding="utf-8")
        label = "tab:scores" if whole else "tab:regions"
        source.write_text(table_latex.scores(chosen, subjects, variants, label, cost=whole), encoding="utf-8")
    job.log.info("%d subjects, %d of them with figures", len(subjects), sum(bool(subject.results) for subject in subjects))


if __name__ == "__main__":
    step.main(run, TabulateConfig)
