"""The tables of scores as rows of a CSV file and as Markdown. Pure text.

Markdown has a subject a row, so that it grows downwards; the LaTeX tables (`avatar.report.table_latex`) have the paper's layout.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from avatar.report import tables
from avatar.report.tables import BEST, MEAN, SECOND, Block, Cell, Metric, Scores, Subject

MARKS = {BEST: ("**", "**"), SECOND: ("<ins>", "</ins>")}
"""GitHub shows `<ins>` as underlined; it drops `<u>`."""
ARROWS = {min: "↓", max: "↑"}
READING = "↓ lower is better, ↑ higher is better; **best** and <ins>second</ins> of a row as shown, ties alike"
PREDICTORS = "mean_frame is the mean training frame, nearest_frame the training frame nearest in expression and pose"
PUBLISHED = "published renders, trained on other frames"


def marked(text: str, rank: int) -> str:
    """Best bold, second underlined."""
    left, right = MARKS.get(rank, ("", ""))
    return f"{left}{text}{right}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table; what would end a cell is escaped."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in line) + " |" for line in lines]


def header(metrics: Sequence[Metric]) -> str:
    """`LPIPS ↓ / SSIM ↑ / PSNR ↑ (dB)`."""
    return " / ".join(f"{item.title} {ARROWS[item.best]}{f' ({item.unit})' if item.unit else ''}" for item in metrics)


def kinds(subjects: Sequence[Subject]) -> tuple[set[str], set[str]]:
    """Names of the variants that are predictors, and of those that are published."""
    found = [(name, scores) for subject in subjects for name, scores in subject.results.items()]
    return {name for name, scores in found if scores.predictor}, {name for name, scores in found if scores.published}


def titles(subjects: Sequence[Subject], variants: Sequence[str]) -> list[str]:
    """Variants as columns, with what they are where that is no avatar of ours."""
    words = [dict.fromkeys(names, f" ({word})") for names, word in zip(kinds(subjects), ("predictor", "published"), strict=True)]
    return [name + words[0].get(name, "") + words[1].get(name, "") for name in variants]


def markdown(blocks: Sequence[Block], subjects: Sequence[Subject], variants: Sequence[str], cost: bool) -> str:
    """One table a block, subjects x variants; then the cost in the same layout where asked for, failures, protocol.

    A subject without any figure has its reason in the first cell and `see left` in the others.
    """
    lines = []
    for place, block in enumerate(blocks):
        title = f"{block.title}: " if block.title else ""
        reading = "" if place else f", mean over the scored test frames; {READING}"
        lines += [f"{title}{header(block.metrics)}{reading}.", "", *_scores(block, subjects, variants), ""]
    known = [subject for subject in subjects if subject.results]
    if cost and known:
        rows = [[subject.name, *(_cost(subject, name) for name in variants)] for subject in known]
        lines += ["Render time a frame / training time.", "", *table(["subject", *titles(subjects, variants)], rows), ""]
    lines += [f"- {sentence}" for sentence in tables.remarks(subjects, variants)]
    return "\n".join([*lines, *_protocol(subjects)]) + "\n"


def _scores(block: Block, subjects: Sequence[Subject], variants: Sequence[str]) -> list[str]:
    """Rows of a block, the mean over subjects last."""
    rows = []
    for subject in subjects:
        if not subject.results:
            first = subject.missing(variants[0])
            rows.append([subject.name, first, *["see left"] * (len(variants) - 1), "0"])
            continue
        rows.append([subject.name, *(_text(block.cells[subject.name, name]) for name in variants), tables.frames_of(subject)])
    known = sum(bool(subject.results) for subject in subjects)
    if block.mean_of > 1:
        means = [_text(block.cells[MEAN, name]) for name in variants]
        rows.append([f"mean of {block.mean_of} subjects", *means, f"{block.mean_of} of {len(subjects)} subjects"])
    lines = table(["subject", *titles(subjects, variants), "test frames"], rows)
    if known > 1:
        every = "every variant has scores of them" if block.mean_of == known else "the others lack some of these scores"
        what = f"Mean over {block.mean_of} of {known} scored subjects, each counting the same; {every}."
        lines += ["", what if block.mean_of > 1 else "No mean over subjects: fewer than two have scores of every variant."]
    return lines


def _text(cell: Cell) -> str:
    if cell.reason:
        return cell.reason.replace("<", "&lt;")  # a quoted log may hold what Markdown takes for HTML
    return " / ".join(marked(*part) for part in cell.parts) + (f" ({cell.remark})" if cell.remark else "")


def _cost(subject: Subject, variant: str) -> str:
    return " / ".join(tables.cost(subject, variant)) if variant in subject.results else subject.missing(variant)


def _protocol(subjects: Sequence[Subject]) -> list[str]:
    """What the figures mean, point by point."""
    if not any(subject.results for subject in subjects):
        return []
    found = tables.protocols(subjects) or {"all points": "not known: there is no metrics.json beside the per-frame files"}
    lines = ["", "Protocol:", "", *(f"- {key}: {words}" for key, words in found.items()), f"- predictors: {PREDICTORS}"]
    return [*lines, f"- published: {PUBLISHED}"] if kinds(subjects)[1] else lines


def long_rows(subjects: Sequence[Subject], variants: Sequence[str]) -> list[dict[str, Any]]:
    """One row a subject and variant (one a subject that has no figures at all), with every aggregate."""
    everywhere = {name for subject in subjects for scores in subject.results.values() for name in scores.figures}
    rows = []
    for subject in subjects:
        for variant in variants if subject.results else [""]:
            scores = subject.results.get(variant)
            if scores is None:
                why = subject.reason or subject.missing(variant)
                rows.append({"subject": subject.name, "variant": variant, "status": subject.fate(variant), "note": why})
                continue
            row: dict[str, Any] = {"subject": subject.name, "variant": variant, "status": "ok"}
            row |= {"predictor": scores.predictor, "published": scores.published}
            for name in (name for name in tables.COLUMNS if name in everywhere):
                figure = scores.figures.get(name)
                row |= {f"{name}_mean": figure and figure.mean, f"{name}_std": figure and figure.std}
                row[f"{name}_n"] = figure.n if figure else 0 if name in scores.figures else None
            row |= {"test_frames": scores.rendered, "scored_frames": len(scores.frames), "excluded_frames": scores.excluded}
            row |= {"ms_per_frame": scores.ms_per_frame, "training_seconds": scores.training_seconds}
            row["resolution"] = scores.protocol.get("resolution")
            row["protocol"] = "; ".join(f"{key}: {words}" for key, words in scores.protocol.items()) or None
            rows.append(row | {"note": _note(scores, everywhere)})
    return rows


def _note(scores: Scores, everywhere: set[str]) -> str:
    """Why a row has empty fields."""
    notes = []
    if scores.training_seconds is None:
        trained = "published: cost not given" if scores.published else "training time was not given"
        notes.append("trivial predictor: not trained" if scores.predictor else trained)
    if scores.ms_per_frame is None or not scores.protocol:
        notes.append("there is no metrics.json: render time and protocol are not known")
    absent = [name for name in tables.COLUMNS if name in everywhere and name not in scores.figures]
    faceless = [name for name, figure in scores.figures.items() if figure is None]
    notes += [f"{tables.NOT_MEASURED}: {', '.join(absent)}"] if absent else []
    notes += [f"{tables.NO_FACE} in any scored frame: {', '.join(faceless)}"] if faceless else []
    return "; ".join(notes)
