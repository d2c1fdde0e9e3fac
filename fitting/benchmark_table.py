"""Rows of the tracking benchmark as one table: medians over clips, CSV rows and Markdown. Pure numbers and text."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from fitting.benchmark_settings import GROUPS, PREFIX, REAL_FRAMES, REFERENCE, SETTINGS, SIMULATED_FRAMES, SOLVER_FRAMES

TRUTH = {
    "rotation_deg": ("rotation, deg", 2),
    "rotation_less_constant_deg": ("less constant, deg", 2),
    "face_mm": ("face, mm", 2),
    "face_alone_mm": ("face alone, mm", 2),
    "skull_mm": ("skull, mm", 1),
    "neck_mm": ("neck, mm", 1),
    "expression_mm": ("expression, mm", 2),
    "jitter_fit_mm": ("jitter, mm", 2),
    "jitter_true_mm": ("true jitter, mm", 2),
    "gaze_deg": ("gaze, deg", 1),
    "aperture_mm": ("lids, mm", 2),
}
"""Errors against the truth: title and digits. Each is the median over frames, then over simulated clips."""
REAL = {"heldout_percent": ("held-out, %", 2), "real_jitter_mm": ("jitter (real), mm", 2)}
COST = {"ms_per_frame": ("ms a frame", 1), "once_s": ("once, s", 1)}
NONE = "-"
ABOUT = {
    "terms": "Terms left out.",
    "iterations": "Iterations with all terms, on some of the simulated clips.",
    "solvers": f"Solvers alone, on {SOLVER_FRAMES} frames about the split of some clips (Adam is slow): landmarks, irises, lids "
    "and priors; no pixels, no temporal terms. All start from the same calibration.",
}


@dataclass(frozen=True)
class Aggregate:
    """One setting over its clips."""

    setting: str
    simulated: int
    """Simulated clips behind it."""
    real: int
    values: dict[str, float | None]
    """By the names of COST, TRUTH and REAL; None where no clip has it."""
    failed: dict[str, str]
    """Reason by clip for fits that gave no track."""


def median(values: Iterable[float | None]) -> float | None:
    """Median of what is known, None of nothing."""
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def p50(row: dict[str, Any], name: str) -> float | None:
    """Median over frames of one error against the truth; None without truth."""
    return (row.get("errors") or {}).get(name, {}).get("p50")


def aggregate(rows: Sequence[dict[str, Any]]) -> list[Aggregate]:
    """One entry a setting in the order of SETTINGS, others last as they come.

    Args:
        rows: content of the rows' files, each with its `setting`.
    """
    out = []
    for name in dict.fromkeys([*SETTINGS, *(row["setting"] for row in rows)]):
        chosen = [row for row in rows if row["setting"] == name]
        if not chosen:
            continue
        fitted = [row for row in chosen if "failed" not in row]
        simulated = [row for row in fitted if row["simulated"]]
        real = [row for row in fitted if not row["simulated"]]
        timed = simulated or real
        values = {key: median(row[key] for row in timed) for key in COST}
        values |= {key: median(p50(row, key) for row in simulated) for key in TRUTH}
        values["heldout_percent"] = median(row["heldout_percent"] for row in real)
        values["real_jitter_mm"] = median(row["jitter"]["vertices_mm"] for row in real)
        failed = {clip_name(row): row["failed"] for row in chosen if "failed" in row}
        out.append(Aggregate(name, len(simulated), len(real), values, failed))
    return out


def sections(rows: Sequence[dict[str, Any]]) -> dict[str, list[Aggregate]]:
    """Settings by group, those that are to be compared with each other: on the same clips. Groups without rows are left out."""
    group_of = {name: setting.group for name, setting in SETTINGS.items()}
    found = {}
    for group in GROUPS:
        own = [row for row in rows if group_of.get(row["setting"], "terms") == group]
        if group == "iterations":
            clips = {row["subject"] for row in own}
            own = [row for row in rows if row["setting"] == REFERENCE and row["subject"] in clips] + own
        if own:
            found[group] = aggregate(own)
    return found


def clip_name(row: dict[str, Any]) -> str:
    """A clip as the table calls it: the kind of a simulated one."""
    return row["subject"].removeprefix(PREFIX).partition("_")[0] if row["simulated"] else row["subject"]


def long_rows(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One flat row a clip and setting with everything that was measured, for the CSV."""
    out = []
    for row in rows:
        flat = {name: row[name] for name in ("setting", "subject", "simulated", "frames")}
        flat |= {name: row.get(name) for name in ("ms_per_frame", "once_s", "usable_percent", "heldout_percent", "load")}
        flat |= {f"{name}_ms": value for name, value in row.get("ms_by_stage", {}).items()}
        flat |= {f"jitter_{name}": value for name, value in row.get("jitter", {}).items()}
        for name, value in (row.get("errors") or {}).items():
            flat |= {f"{name}_{part}": number for part, number in value.items()} if isinstance(value, dict) else {name: value}
        out.append(flat | {"note": row.get("failed", "")})
    return out


def _cell(value: float | None, digits: int) -> str:
    return NONE if value is None else f"{value:.{digits}f}"


def _table(header: list[str], rows: list[list[str]]) -> list[str]:
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines]


def _settings(found: Sequence[Aggregate]) -> list[str]:
    shown = COST | TRUTH | REAL
    kept = [name for name in shown if any(entry.values[name] is not None for entry in found)]
    rows = []
    for entry in found:
        what = SETTINGS[entry.setting].what if entry.setting in SETTINGS else entry.setting
        clips = f"{entry.simulated} + {entry.real} real" if entry.real else str(entry.simulated)
        rows.append([entry.setting, what, clips, *(_cell(entry.values[name], shown[name][1]) for name in kept)])
    return _table(["setting", "what", "clips", *(shown[name][0] for name in kept)], rows)


def _clips(rows: Sequence[dict[str, Any]], setting: str) -> list[str]:
    """One setting clip by clip."""
    shown = COST | TRUTH | REAL
    found = []
    for row in rows:
        if row["setting"] == setting:
            values = aggregate([row])[0].values
            found.append([clip_name(row), str(row["frames"]), *(_cell(values[name], shown[name][1]) for name in shown)])
    return _table(["clip", "frames", *(title for title, _ in shown.values())], found) if found else []


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """The whole table with what its figures mean."""
    lines = ["# Tracking: speed against error", ""]
    for group, found in sections(rows).items():
        lines += [ABOUT[group], "", *_settings(found), ""]
    if clips := _clips(rows, REFERENCE):
        lines += ["Each clip, default settings.", "", *clips, ""]
    for entry in aggregate(rows):
        lines += [f"- {entry.setting}, {clip}: no track: {reason}" for clip, reason in entry.failed.items()]
    return "\n".join([*lines, *_protocol(rows)]) + "\n"


def _protocol(rows: Sequence[dict[str, Any]]) -> list[str]:
    """What the figures mean."""
    minutes = sum(row.get("provenance", {}).get("seconds", 0.0) for row in rows) / 60
    simulated = list(dict.fromkeys(clip_name(row) for row in rows if row["simulated"]))
    real = list(dict.fromkeys(row["subject"] for row in rows if not row["simulated"]))
    load = median(row.get("load") for row in rows)
    beside = (
        "" if load is None else f"; load of the machine {load:.1f} (median; much above 1: something else ran, times are too long)"
    )
    lines = [
        f"- {len(rows)} fits took {minutes:.1f} minutes, one after the other, on one thread each: Snakemake gave each fit all "
        f"cores, so that nothing of its own ran beside it{beside}",
        "- ms a frame: tracking, photometric refinement and temporal bundle; once, whatever the length: calibration and the "
        "skin's colours, on keyframes",
        f"- simulated clips ({', '.join(simulated) or 'none'}): at most {SIMULATED_FRAMES} frames, rendered as the config's "
        "`simulate` says, through the real detector and matte; a figure is the median over clips of each clip's median frame",
        f"- real clips ({', '.join(real) or 'none'}): at most {REAL_FRAMES} frames about the split; held-out: error on a fifth "
        "of the landmarks, % of the distance between the eyes",
        "- face, skull, neck: distance of vertices after one scale a clip, which a camera cannot see; face alone: without pose",
        "- less constant: rotation without one constant turn a clip, by which two head models' neutral frames differ",
    ]
    if not any(row.get("errors") for row in rows):
        lines.append("- no truth: the simulated clips are of the head model anny, another one was fitted")
    return lines
