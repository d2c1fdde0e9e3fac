"""A comparison video of the tiny subject: the driving panel, one that shows the truth on white, and that one moved by 2 px."""

from __future__ import annotations

import json
from pathlib import Path

import made_subject as made
import numpy as np
import pandas as pd
from toy_run import job

from avatar.published import panel as published_panel
from avatar.published import place as published_place
from avatar.published import score as published_score
from avatar.published.config import PublishedPlaceConfig, PublishedScoreConfig
from avatar.report.pictures import on_white

PANELS = ("driving", "Good", "Shifted")
SIZE, CORNER = (84, 96), (12, 8)  # (h, w) of a panel; (y, x) of the crop in it
CHOSEN = made.TEST[::2]
SCORED = [frame for frame in CHOSEN if frame not in (made.UNUSABLE, made.NOT_FOUND)]


def shown(image: np.ndarray, outside: int) -> np.ndarray:
    """The tiny subject's picture in its panel."""
    panel = np.full((*SIZE, 3), outside, np.uint8)
    panel[CORNER[0] : CORNER[0] + made.HEIGHT, CORNER[1] : CORNER[1] + made.WIDTH] = image
    return panel


def whole(frame: int, background: int = 255, shoulders: bool = False) -> np.ndarray:
    """Driving panel, the same on white, and that moved by 2 px, beside each other."""
    colour, alpha = made.picture(frame)
    good = shown(on_white(colour, alpha), 255)
    good[good.min(-1) == 255] = background
    if shoulders:
        good[40:, :12] = 90
    return np.concatenate([shown(colour, 70), good, np.roll(good, 2, 1)], 1)


def make(folder: Path) -> dict[str, Path]:
    """The tiny subject as the driving panel of a comparison video."""
    paths = made.make(folder / "in")
    paths["video"] = folder / "clip.mp4"
    published_panel.write_lossless(paths["video"], map(whole, range(made.FRAMES)), 25.0)
    index = json.loads(paths["index"].read_text()) | {"source_frame": list(range(made.FRAMES)), "source_size": list(SIZE)}
    index |= {"crop": {"x": CORNER[1], "y": CORNER[0], "width": made.WIDTH, "height": made.HEIGHT}, "scale": 1.0}
    paths["index"].write_text(json.dumps(index))
    paths["matte"] = paths["trim"] = paths["alpha"]
    return paths


def score(paths: dict[str, Path], folder: Path, method: str, kind: str, **more: Path) -> tuple[pd.DataFrame, dict]:
    names = ("video", "index", "matte", "trim", "landmarks", "track", "split", "lpips")
    outputs = {"per_frame": folder / method / "per_frame.csv", "metrics": folder / method / "metrics.json"}
    config = PublishedScoreConfig(panels=PANELS, method=method, kind=kind, stride=2)
    published_score.run(job(config, {name: paths[name] for name in names} | more, outputs))
    return pd.read_csv(outputs["per_frame"]), json.loads(outputs["metrics"].read_text())


def placed(paths: dict[str, Path], folder: Path, images: np.ndarray, frames: list[int]) -> dict[str, Path]:
    """Outputs of `published_place` for a predictor's render."""
    render_npy, report = folder / "test.npy", folder / "base.json"
    folder.mkdir(parents=True, exist_ok=True)
    np.save(render_npy, images)
    report.write_text(json.dumps({"frames": frames, "ms_per_frame": 3.0}))
    inputs = {"index": paths["index"], "split": paths["split"], "render": render_npy, "report": report}
    outputs = {"png": folder / "png", "opacity": folder / "opacity.npy", "report": folder / "render.json"}
    published_place.run(job(PublishedPlaceConfig(stride=2), inputs, outputs))
    return outputs
