"""Step `tabulate`: one table of all subjects and variants, a rejected or failed subject with its reason.

Input: probes (every probe.json), metrics (every metrics.json that exists); both may be absent. Output: csv, markdown.
The folder names say which subject and variant a file belongs to: `{subject}/{variant}/metrics/metrics.json`.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from avatar.config import TabulateConfig
from avatar.results import many, subject_of, variant_of
from avatar.tables import Subject, long_rows, markdown, ordered_variants
from workflow import step


def collect(probes: list[Path], metrics: list[Path], expected: tuple[str, ...]) -> list[Subject]:
    """Subjects in the order expected, then as their files come; StepError where a file is damaged."""
    facts = {path.parents[1].name: step.read_json(path) for path in probes}
    results: dict[str, dict[str, dict]] = {}
    for path in metrics:
        results.setdefault(subject_of(path), {})[variant_of(path)] = step.read_json(path)
    subjects = []
    for name in dict.fromkeys([*expected, *facts, *results]):
        found = results.get(name, {})
        if name in facts and not facts[name]["accepted"]:
            subjects.append(Subject(name, "rejected", facts[name]["reason"]))
        elif found:
            subjects.append(Subject(name, "ok", "", found))
        else:
            subjects.append(Subject(name, "failed", f"failed: see logs/{name}/"))
    return subjects


def run(job: step.Job) -> None:
    """Write the table in both forms."""
    subjects = collect(many(job.input, "probes"), many(job.input, "metrics"), job.config.subjects)
    if not subjects:
        raise step.StepError("results: there is nothing to tabulate yet; run snakemake first")
    variants = ordered_variants(subjects, job.config.variants)
    table = pd.DataFrame(long_rows(subjects, variants))
    table.insert(len(table.columns) - 1, "note", table.pop("note"))
    counts = [name for name in table.columns if name.endswith(("_n", "_frames"))]
    table = table.astype(dict.fromkeys(counts, "Int64"))  # whole numbers beside empty fields
    table.to_csv(job.output.csv, index=False, float_format="%.6f")
    job.output.markdown.write_text(markdown(subjects, variants), encoding="utf-8")
    job.log.info("%d subjects, %d of them with figures", len(subjects), sum(bool(subject.results) for subject in subjects))


if __name__ == "__main__":
    step.main(run, TabulateConfig)
