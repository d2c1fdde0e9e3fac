"""On a CUDA device, where there is one: an avatar trains, renders and is the same function as on the CPU."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_head import toy_head
from toy_run import SMALL, job, write_subject

from avatar import build, train
from avatar.config import TrainConfig
from avatar.dataset import Scene

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


@pytest.mark.parametrize("sampling", ["shell", "hierarchical"])
def test_training_and_rendering_on_cuda(tmp_path: Path, sampling: str) -> None:
    inputs = write_subject(tmp_path)
    outputs = {name: tmp_path / name for name in ("avatar", "curve", "report")}
    config = TrainConfig(**(SMALL | {"steps": 3, "sampling": sampling, "coarse_samples": 8, "fine_samples": 8, "warp": True}))
    train.run(replace(job(config, inputs, outputs), device="cuda"))
    head = toy_head(24, 36)
    scene = Scene(head, dict(np.load(inputs["track"])), [6])
    rays = scene.rays(6, np.arange(10, 30), np.arange(10, 30))
    pictures = []
    for device in ("cpu", "cuda"):
        avatar = build.restore(torch.load(outputs["avatar"], weights_only=True, map_location=device), head).to(device)
        pictures.append(avatar.march(avatar.pose(*scene.heads([6], device)), rays, torch.float32)[0].colour)
    torch.testing.assert_close(pictures[0], pictures[1], atol=1e-3, rtol=1e-3)
