"""The pipeline from video to scores on a tiny clip, with a FLAME-shaped head in the place of the default one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
from pipeline import Pipeline

from fitting.head_model import HeadModel
from tests import flame_file
from tests.test_dag import FRAMES, SMALL, shorten

CONFIG = f"""
videos: videos
device: cpu
extract: {{size: 96, max_frames: {FRAMES}}}
variants:
  tiny: {{preset: demo, train: {{steps: 2, {SMALL}}}, render: {{max_frames: 1}}}}
"""
TARGET = "results/ann/tiny/metrics/metrics.json"


def test_pipeline_with_flame(tmp_path: Path, assets: Path) -> None:
    pipeline = Pipeline.create(tmp_path / "run")
    (pipeline.folder / "resources").mkdir()
    shutil.copytree(assets, pipeline.folder / "resources" / "assets")
    flame_file.write(tmp_path / "generic_model.pkl", chumpy=("shapedirs",))
    head = f"head: {{model: flame, path: {tmp_path / 'generic_model.pkl'}, mouth_cavity: true, renders: 60}}\n"
    pipeline.write_config(CONFIG + head)
    shorten(assets / "carphone.mp4", pipeline.folder / "videos" / "ann.mp4", FRAMES)
    result = pipeline.run(TARGET, stub=False)
    assert result.code == 0, result.text
    model = HeadModel.load(pipeline.folder / "resources" / "heads" / "flame.npz")
    assert (model.name, model.version) == ("flame", "2020") and model.vertex_count == 5023 + 4 * 32
    assert not (pipeline.folder / "resources" / "heads" / "anny.npz").exists()
    subject = pipeline.folder / "results" / "ann"
    with np.load(subject / "fit" / "track.npz") as track:
        assert str(track["head_digest"]) == model.digest
        assert track["expression"].shape == (FRAMES, 52) and track["usable"].mean() > 0.8
        lids = track["expression"][:, -2:]
        assert np.isfinite(track["expression"]).all() and lids.min() > -0.2 and lids.max() < 1.2
    report = json.loads((subject / "fit" / "fit.json").read_text())
    assert report["reprojection_percent_of_interocular"]["p50"] < 10
    for name in ("fit/overlay.mp4", "tiny/avatar.pt", "tiny/render/test.mp4", "tiny/metrics/metrics.json"):
        assert (subject / name).stat().st_size > 0, name
    assert pipeline.plan(TARGET) == set()
