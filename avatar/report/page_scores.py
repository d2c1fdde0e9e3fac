"""Scores as the pages show them: tables by region, tiles, and the ranking of frames. Content of metrics.json in, text out."""

from __future__ import annotations

from typing import Any

import pandas as pd

WORST = 3
COLUMNS = (("lpips", "LPIPS", 3, min), ("lpips_vgg", "LPIPS (VGG)", 3, min), ("ssim", "SSIM", 3, max),
           ("psnr", "PSNR dB", 2, max), ("l1", "L1", 4, min), ("iou", "mask IoU", 3, max))  # fmt: skip
"""Metric, title, digits, which end is better."""
REGIONS = {"face": "face hull", "mouth": "mouth box", "eyes": "eye boxes"}
ARROWS = {min: " ↓", max: " ↑"}


def metric_key(name: str, region: str) -> str:
    """Name of a metric in a region, the whole head being no region."""
    return f"{name}_{region}" if region else name


def ordered(metrics: dict[str, dict]) -> list[str]:
    """Trained variants first, then predictors."""
    return sorted(metrics, key=lambda name: metrics[name]["predictor"])


def cells(metrics: dict[str, dict], names: list[str], key: str, digits: int, end: Any, lost: str) -> list[dict[str, Any]]:
    """A column's cells, one a variant; the best of several figures, as shown, is marked, `lost` stands where there is none."""
    values = [metrics[name]["metrics"].get(key) for name in names]
    texts = [f"{value['mean']:.{digits}f}" if value else lost for value in values]
    known = [text for text, value in zip(texts, values, strict=True) if value]
    best = end(known, key=float) if len(known) > 1 else None
    return [
        {"value": text, "spread": f"{value['std']:.{digits}f}" if value else "", "best": text == best}
        for text, value in zip(texts, values, strict=True)
    ]


def _group(metrics: dict[str, dict], names: list[str], region: str) -> dict[str, Any] | None:
    """Titles and columns of a region, or None where no variant has it."""
    found = [
        (title + ARROWS[end], cells(metrics, names, metric_key(key, region), digits, end, f"no {region or 'score'}"))
        for key, title, digits, end in COLUMNS
        if any(metric_key(key, region) in metrics[name]["metrics"] for name in names)
    ]
    titles = [title for title, _ in found]
    return (
        {"title": REGIONS.get(region, "whole head"), "titles": titles, "columns": [cells for _, cells in found]}
        if found
        else None
    )


def _rows(metrics: dict[str, dict], names: list[str], groups: list[dict]) -> list[dict[str, Any]]:
    """One row a variant; the first cell of each group but the first starts it."""
    rows = []
    for place, name in enumerate(names):
        row = {"variant": name, "predictor": metrics[name]["predictor"], "cells": []}
        for group in groups:
            for column, found in enumerate(group["columns"]):
                row["cells"].append(found[place] | {"start": column == 0 and group is not groups[0]})
        rows.append(row)
    return rows


def _cost(result: dict[str, Any]) -> list[str]:
    """Render time, training time and number of frames of a variant."""
    seconds = result.get("training_seconds")
    training = f"{seconds:.0f}" if seconds is not None else "not trained" if result["predictor"] else "not given"
    speed = result.get("ms_per_frame")
    return ["not known" if speed is None else f"{speed:.1f}", training, str(result["scored_frames"])]


def tables(metrics: dict[str, dict]) -> list[dict[str, Any]]:
    """The whole head with its cost, and the regions beside each other: groups of titles, and rows."""
    names = ordered(metrics)
    plain = [[{"value": value, "spread": "", "best": False} for value in _cost(metrics[name])] for name in names]
    cost = {"title": "cost", "titles": ["render ms", "training s", "frames"], "columns": list(zip(*plain, strict=True))}
    head = [_group(metrics, names, ""), cost]
    found = [{"name": "the whole head", "groups": head, "rows": _rows(metrics, names, head)}]
    regions = [group for group in (_group(metrics, names, region) for region in REGIONS) if group]
    if regions:
        found.append({"name": "parts of the face", "groups": regions, "rows": _rows(metrics, names, regions)})
    return found


def lead(metrics: dict[str, dict]) -> str:
    """The trained variant with the least LPIPS; a predictor where nothing was trained."""
    trained = [name for name in metrics if not metrics[name]["predictor"]] or list(metrics)
    return min(trained, key=lambda name: metrics[name]["metrics"]["lpips"]["mean"])


def tiles(metrics: dict[str, dict]) -> list[dict[str, str]]:
    """The figures of the leading variant."""
    name = lead(metrics)
    best = metrics[name]
    found = [
        {"value": f"{best['metrics'][key]['mean']:.{digits}f}", "label": f"{title}{ARROWS[end]} · {name}"}
        for key, title, digits, end in COLUMNS
        if key in ("lpips", "ssim", "psnr")
    ]
    if best.get("ms_per_frame") is not None:
        found.append({"value": f"{best['ms_per_frame']:.0f} ms", "label": "render time a frame"})
    if best.get("training_seconds") is not None:
        found.append({"value": f"{best['training_seconds'] / 60:.1f} min", "label": "training time"})
    return [*found, {"value": str(best["scored_frames"]), "label": "test frames scored"}]


def ranked(table: pd.DataFrame) -> list[tuple[str, pd.Series]]:
    """The worst frames by LPIPS, the median one and the best, each once."""
    order = table.sort_values("lpips", ascending=False).reset_index(drop=True)
    places = {place: f"worst {place + 1}" for place in range(min(WORST, len(order)))}
    places.setdefault(len(order) // 2, "median")
    places.setdefault(len(order) - 1, "best")
    return [(rank, order.iloc[place]) for place, rank in places.items()]
