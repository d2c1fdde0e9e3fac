"""Step `index_page`: the page over all subjects: cards, the whole table, plots; opens from disk and inside a report.

Input: table (metrics.csv of `tabulate`), and lists pages (the subjects' page folders) and plots (SVG). Output: page, a folder
with index.html. A subject without a page folder is a card with its reason.

Snakemake's report.zip holds each page under a name of its own, `data/raw/HASH/index.html`, the hash being that of the path that
the rule gave it. So every link knows two addresses, and the script takes the second one inside a report.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

from avatar.report import index_template
from avatar.report.config import IndexConfig
from avatar.report.page_parts import Folder
from avatar.report.page_scores import ARROWS, COLUMNS, REGIONS, metric_key
from avatar.report.results import many
from workflow import step

REPORT_HASH_LENGTH = 16
NAMED = 6
NEEDED = ("subject", "variant", "status", "note")
COSTS = (("ms_per_frame", "render ms", 1, min), ("training_seconds", "training s", 0, min), ("scored_frames", "frames", 0, max))
CARD_FIGURES = ("lpips", "ssim", "psnr")


def report_address(path: Path) -> str:
    """Where report.zip keeps the page of a folder, as seen from another page in it."""
    return f"../{hashlib.sha256(f'{path}/index.html'.encode()).hexdigest()[:REPORT_HASH_LENGTH]}/index.html"


def read_table(path: Path) -> pd.DataFrame:
    """The long table; columns that it does not have are empty. StepError where it is damaged."""
    try:
        table = pd.read_csv(path, dtype=dict.fromkeys(NEEDED, str), keep_default_na=False, na_values=[""])
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeError) as error:
        raise step.StepError(f"{path}: not readable as a table ({error}); delete it and run snakemake again") from None
    lost = [name for name in NEEDED if name not in table]
    if lost:
        raise step.StepError(f"{path}: column {lost[0]} is missing; delete it and run snakemake again")
    table[list(NEEDED)] = table[list(NEEDED)].fillna("")
    for name in ("predictor", "published"):
        found = table[name] if name in table else pd.Series(False, index=table.index)
        table[name] = found.astype(str).str.lower() == "true"
    return table


def shown_columns(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The columns that have a figure: every metric of every region, then the cost."""
    metrics = [
        (f"{metric_key(key, region)}_mean", f"{region} {title}{ARROWS[end]}".strip(), digits, end)
        for region in ("", *REGIONS)
        for key, title, digits, end in COLUMNS
    ]
    keys = ("key", "title", "digits", "end")
    known = [dict(zip(keys, item, strict=True)) for item in (*metrics, *COSTS)]
    return [column for column in known if column["key"] in table and table[column["key"]].notna().any()]


def table_rows(table: pd.DataFrame, columns: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the table; a subject's best figure of each metric, as shown, is marked. A row without any figure has its reason."""
    rows = []
    metric_keys = {column["key"] for column in columns} - {key for key, *_ in COSTS}
    for subject, own in table.groupby("subject", sort=False):
        scored = own[own["status"] == "ok"]
        for _, row in own.iterrows():
            cells = []
            for column in columns:
                values = [f"{value:.{column['digits']}f}" for value in scored[column["key"]].dropna()]
                value = row[column["key"]]
                text = f"{value:.{column['digits']}f}" if pd.notna(value) else "none"
                best = len(values) > 1 and column["key"] in metric_keys and text == column["end"](values, key=float)
                cells.append({"text": text, "value": float(value) if pd.notna(value) else None, "best": best})
            kind = "predictor" if row["predictor"] else "published" if row["published"] else ""
            same = {name: row[name] for name in ("variant", "status", "note")}
            rows.append({"subject": subject, "kind": kind, "cells": cells if row["status"] == "ok" else []} | same)
    return rows


def cards(table: pd.DataFrame, pages: dict[str, Path], folder: Folder, home: Path) -> list[dict[str, Any]]:
    """One card a subject: thumbnail, link, best avatar's figures, or the reason why there is none.

    Args:
        table: from `read_table`.
        pages: folder of each subject's page, where there is one.
        folder: of this page, while it is made.
        home: where that folder will be.
    """
    found = []
    for place, (subject, own) in enumerate(table.groupby("subject", sort=False)):
        status = "ok" if (own["status"] == "ok").any() else own["status"].iloc[0]
        notes = [f"{row.variant}: {row.note}" if row.variant else row.note for row in own[own["status"] != "ok"].itertuples()]
        card: dict[str, Any] = {
            "subject": subject,
            "status": status,
            "notes": list(dict.fromkeys(notes)),
            "figures": [],
            "best": "",
        }
        trained = own[(own["status"] == "ok") & ~own["predictor"] & ~own["published"]]
        if len(trained) and "lpips_mean" in trained:
            best = trained.sort_values("lpips_mean").iloc[0]
            card["best"] = best["variant"]
            for key, title, digits, end in COLUMNS:
                if key in CARD_FIGURES and pd.notna(best[f"{key}_mean"]):
                    card["figures"].append((title + ARROWS[end], f"{best[f'{key}_mean']:.{digits}f}"))
        path = pages.get(subject)
        card["link"] = f"{os.path.relpath(path, home)}/index.html" if path else ""
        card["report_link"] = report_address(path) if path else ""
        picture = path / "card.jpg" if path else None
        card["picture"] = folder.copy(picture, f"card_{place:03d}.jpg") if picture and picture.is_file() else ""
        found.append(card)
    return found


def notes(rows: list[dict[str, Any]]) -> list[str]:
    """Notes on rows that have figures, each once, with the rows that it is about."""
    about: dict[str, list[str]] = {}
    for row in rows:
        if row["cells"] and row["note"]:
            about.setdefault(row["note"], []).append(f"{row['subject']}/{row['variant']}")
    return [
        f"{note} ({', '.join(names[:NAMED])}{f' and {len(names) - NAMED} more' if len(names) > NAMED else ''})"
        for note, names in about.items()
    ]


def counted(found: Iterable[dict[str, Any]]) -> str:
    """How many subjects there are, and what became of them."""
    found = list(found)
    kinds = {"ok": "with scores", "rejected": "rejected", "failed": "failed", "not made": "not made yet"}
    counts = {words: sum(card["status"] == kind for card in found) for kind, words in kinds.items()}
    noun = "subject" if len(found) == 1 else "subjects"
    return f"{len(found)} {noun}: " + ", ".join(f"{count} {words}" for words, count in counts.items() if count)


def run(job: step.Job) -> None:
    """Write the folder."""
    table = read_table(job.input.table)
    if table.empty:
        raise step.StepError(f"{job.input.table}: there is no subject in it; run snakemake first")
    folder = Folder(job.output.page)
    columns = shown_columns(table)
    found = cards(table, {path.parent.name: path for path in many(job.input, "pages")}, folder, job.final.page)
    rows = table_rows(table, columns)
    content = {
        "title": "Head avatars",
        "summary": counted(found),
        "cards": found,
        "columns": [column["title"] for column in columns],
        "rows": rows,
        "csv": folder.copy(job.input.table, "metrics.csv"),
        "notes": notes(rows),
        "plots": [{"file": folder.copy(path, path.name), "alt": f"{path.stem} plot"} for path in many(job.input, "plots")],
        "protocols": list(dict.fromkeys(table["protocol"].dropna())) if "protocol" in table else [],
    }
    job.log.info("%s", folder.write(index_template.PAGE, content))


if __name__ == "__main__":
    step.main(run, IndexConfig)
