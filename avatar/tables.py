"""The metric table of all subjects as long rows and as Markdown in the layout of the paper's Table 1; pure text and numbers."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

SHOWN = (("lpips", 3, min), ("ssim", 3, max), ("psnr", 2, max))
"""What a cell shows, in the paper's order: metric, digits, which end is better."""


@dataclass
class Subject:
    """One row: what is known of a subject."""

    name: str
    status: str
    """`ok`, `rejected` or `failed`."""
    reason: str = ""
    """Why there is no figure, where there is none."""
    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Content of metrics.json by variant."""


def missing(subject: Subject, variant: str) -> str:
    """What stands in the cell of a variant without figures."""
    return subject.reason or f"failed: see logs/{subject.name}/{variant}/"


def ordered_variants(subjects: list[Subject], expected: tuple[str, ...] = ()) -> list[str]:
    """Variants in the order expected, then others as they come; predictors last."""
    names = dict.fromkeys([*expected, *(name for subject in subjects for name in subject.results)])
    predictors = {name for subject in subjects for name, result in subject.results.items() if result["predictor"]}
    return [name for name in names if name not in predictors] + [name for name in names if name in predictors]


def long_rows(subjects: list[Subject], variants: list[str]) -> list[dict[str, Any]]:
    """One row a subject and variant (one a subject that has no figures at all), with every aggregate."""
    rows = []
    for subject in subjects:
        for variant in variants if subject.results else [""]:
            result = subject.results.get(variant)
            if result is None:
                status = "failed" if subject.status == "ok" else subject.status
                rows.append({"subject": subject.name, "variant": variant, "status": status, "note": missing(subject, variant)})
                continue
            row: dict[str, Any] = {"subject": subject.name, "variant": variant, "status": "ok", "predictor": result["predictor"]}
            row |= {f"{name}_{kind}": value for name, values in result["metrics"].items() for kind, value in values.items()}
            row |= {"test_frames": result["test_frames"], "scored_frames": result["scored_frames"]}
            row |= {"excluded_frames": result["excluded"]["count"], "ms_per_frame": result["ms_per_frame"]}
            row |= {"training_seconds": result.get("training_seconds"), "resolution": result["protocol"]["resolution"]}
            rows.append(row | {"note": _note(result)})
    return rows


def _note(result: dict[str, Any]) -> str:
    """Why a row has empty fields."""
    notes = []
    if result.get("training_seconds") is None:
        notes.append("trivial predictor: not trained" if result["predictor"] else "training time was not given")
    if "psnr_face" not in result["metrics"]:
        notes.append("no face landmarks in any scored frame: no face scores")
    return "; ".join(notes)


def _cells(subject: Subject, variants: list[str]) -> list[str]:
    """`LPIPS / SSIM / PSNR` of each variant, the row's best of each in bold; equal figures as shown are all best."""
    figures = {
        name: [f"{subject.results[name]['metrics'][metric]['mean']:.{digits}f}" for metric, digits, _ in SHOWN]
        for name in variants
        if name in subject.results
    }
    best = [end((values[place] for values in figures.values()), key=float, default="") for place, (_, _, end) in enumerate(SHOWN)]
    several = len(figures) > 1
    return [
        " / ".join(f"**{text}**" if several and text == top else text for text, top in zip(figures[name], best, strict=True))
        if name in figures
        else missing(subject, name)
        for name in variants
    ]


def _frames(subject: Subject) -> str:
    """Scored test frames, `scored of rendered` where some were left out; each count once where variants differ."""
    found = dict.fromkeys(
        str(result["scored_frames"]) + (f" of {result['test_frames']}" if result["excluded"]["count"] else "")
        for result in subject.results.values()
    )
    return ", ".join(found) or "0"


def _cost(result: dict[str, Any]) -> str:
    seconds = result.get("training_seconds")
    training = f"{seconds:.0f} s" if seconds is not None else "not trained" if result["predictor"] else "not given"
    return f"{result['ms_per_frame']:.1f} ms / {training}"


def _table(header: list[str], rows: list[list[str]]) -> list[str]:
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in line) + " |" for line in lines]


def markdown(subjects: list[Subject], variants: list[str]) -> str:
    """Subjects x variants, then the cost in the same layout, then the protocol.

    A subject without any figure has its reason in the first cell and a dash that refers to it in the others.
    """
    results = [result for subject in subjects for result in subject.results.values()]
    predictors = {name for subject in subjects for name, result in subject.results.items() if result["predictor"]}
    titles = [f"{name} (predictor)" if name in predictors else name for name in variants]
    scores, costs = [], []
    for subject in subjects:
        if not subject.results:
            reason = f"{subject.status}: {subject.reason}" if subject.status == "rejected" else subject.reason
            scores.append([subject.name, reason, *["see left"] * max(0, len(variants) - 1), "0"])
            continue
        scores.append([subject.name, *_cells(subject, variants), _frames(subject)])
        cost = [_cost(subject.results[name]) if name in subject.results else missing(subject, name) for name in variants]
        costs.append([subject.name, *cost])
    lines = [
        "LPIPS / SSIM / PSNR (dB), mean over the scored test frames; lower LPIPS, higher SSIM and PSNR are better, best in bold.",
        "",
    ]
    lines += _table(["subject", *(titles or ["result"]), "test frames"], scores)
    if costs:
        lines += ["", "Render time a frame / training time.", "", *_table(["subject", *titles], costs)]
    lines += ["", *_protocol(results)]
    return "\n".join(lines) + "\n"


def _protocol(results: list[dict[str, Any]]) -> list[str]:
    """What the figures mean; where results differ in a point, each wording is listed."""
    if not results:
        return []
    lines = ["Protocol:", ""]
    for key in results[0]["protocol"]:
        if key != "frames":
            wordings = dict.fromkeys(str(result["protocol"].get(key, "not said")) for result in results)
            lines.append(f"- {key.replace('_', ' ')}: {' | '.join(wordings)}")
    lines.append(
        "- predictors: mean_frame is the mean training frame, nearest_frame the training frame nearest in expression and pose"
    )
    return lines
