"""Rows of `snakemake speed_error` as the steps write them, with made-up figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import yaml

from avatar.config import TrainConfig
from avatar.speed_error import settings

PRESETS = {
    path.stem: TrainConfig(**(yaml.safe_load(path.read_text(encoding="utf-8")).get("train") or {}))
    for path in sorted((Path(__file__).parents[1] / "config" / "presets").glob("*.yaml"))
}


def write_rows(folder: Path, failed: str = "") -> dict[str, list[Path]]:
    """A file for each training, rendering and cost; `failed` names a training that diverged."""
    random, paths = np.random.default_rng(0), {"rows": [], "renders": [], "curves": [], "costs": []}
    seconds = {}
    for name, training in settings.trainings(PRESETS).items():
        paths["curves"].append(folder / "trainings" / name / "curve.tsv")
        paths["curves"][-1].parent.mkdir(parents=True)
        share, seconds[name] = np.linspace(0.1, 1, 10), training.config.steps * random.uniform(0.2, 0.4)
        curve = {"step": (share * training.config.steps).astype(int), "seconds": share * seconds[name], "loss": 0.1 / share}
        curve |= {"probe_psnr": 20 + 6 * np.log10(1 + 9 * share) + random.uniform(-1, 1)}
        pd.DataFrame(curve).iloc[: 0 if name == failed else None].to_csv(paths["curves"][-1], sep="\t", index=False)
    (folder / "rows").mkdir()
    (folder / "costs").mkdir()
    for name, cell in settings.cells(PRESETS).items():
        paths["rows"].append(folder / "rows" / f"{name}.json")
        paths["renders"].append(folder / "rows" / f"{name}.npy")
        drawn = np.full((cell.config.frames, 8, 8, 4), 100, np.uint8)
        drawn[..., 0] += len(name) % 3
        np.save(paths["renders"][-1], drawn)
        row = {"failed": "training diverges | at step 7"} if cell.training == failed else made(cell, seconds, random)
        paths["rows"][-1].write_text(json.dumps(row))
    for name, cost in settings.costs(PRESETS).items():
        paths["costs"].append(folder / "costs" / f"{name}.json")
        row = {"amount": cost.amount, "memory_mb": 500 + cost.amount // 30, "threads": 2}
        row |= {} if cost.kind == "pixels" else {"prepare_s": 2 + cost.amount / 100, "step_s": 0.2}
        row |= {} if cost.kind == "frames" else {"ms_per_frame": cost.amount**1.5 / 10}
        paths["costs"][-1].write_text(json.dumps(row))
    return paths


def made(cell: settings.Rendering, seconds: dict[str, float], random: np.random.Generator) -> dict:
    """One row."""
    samples = cell.config.samples or settings.DEFAULT_SAMPLES
    dense = cell.config.sampling != "own"
    own = 0.0 if cell.training == settings.BASE else random.normal()
    milliseconds = 60000.0 if dense else 125.0 * samples * np.exp(0.4 * own)
    psnr = 27 + 0.4 * own - 2 / samples
    small = cell.config.size < settings.SIZE_PX
    return {
        "training": {"steps": settings.trainings(PRESETS)[cell.training].config.steps, "train_seconds": seconds[cell.training]},
        "frames": list(range(cell.config.frames)),
        "size": [123, 128] if small else [250, 256],
        "threads": 2,
        "ms_per_frame": milliseconds,
        "evaluations_per_ray": 64.0 if dense else samples / 20,
        "evaluations_per_head_ray": 64.0 if dense else samples / 4,
        "gflop_per_frame": milliseconds / 10,
        "gflop_of_head": milliseconds / 20,
        "memory_mb": 700,
        "scores": {"psnr": psnr, "ssim": 0.93, "lpips": 0.4 - psnr / 100, "iou": 0.97, "lpips_mouth": 0.38 - psnr / 100},
    }
