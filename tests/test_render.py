"""Rendering: packed marching against one pass over all samples, the files it writes, what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_head import toy_head
from toy_run import job, marched_in_one_pass, train_in, write_subject

from avatar import build, marching, radiance, render
from avatar.config import RenderConfig
from avatar.dataset import Scene, on_white
from workflow.step import StepError


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("trained")
    inputs = write_subject(folder)
    return inputs | {"avatar": train_in(folder, inputs, steps=60)["avatar"]}


def scene_and_avatar(paths: dict[str, Path]) -> tuple[Scene, radiance.RadianceAvatar]:
    head = toy_head(24, 36)
    return Scene(head, dict(np.load(paths["track"])), [6, 7]), build.restore(torch.load(paths["avatar"], weights_only=True), head)


def test_marching_in_blocks_equals_one_pass_over_all_samples(trained: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    scene, avatar = scene_and_avatar(trained)
    rows, columns = np.mgrid[:40, :40]
    rays = scene.rays(6, columns.ravel(), rows.ravel())
    posed = avatar.pose(*scene.heads([6], "cpu"))
    monkeypatch.setattr(marching, "RAY_CHUNK", 300)
    monkeypatch.setattr(marching, "END", 0.0)
    whole = marched_in_one_pass(avatar, posed, rays)
    blocks, evaluations = avatar.march(posed, rays, torch.float32)
    for name in ("colour", "opacity"):
        torch.testing.assert_close(getattr(blocks, name), getattr(whole, name), atol=2e-5, rtol=1e-4)
    seen = whole.opacity > 0.01  # elsewhere the mean depth is a quotient of rounding errors
    torch.testing.assert_close(blocks.depth[seen], whole.depth[seen], atol=2e-5, rtol=1e-4)
    monkeypatch.undo()
    quick, fewer = avatar.march(posed, rays, torch.float32)
    torch.testing.assert_close(quick.colour, marched_in_one_pass(avatar, posed, rays).colour, atol=2e-5, rtol=1e-4)
    assert fewer <= evaluations and (quick.colour - whole.colour).abs().mean() < 0.01
    missing = (whole.opacity == 0).numpy()
    assert missing.any() and (quick.colour[missing] == 1).all()


def test_files_and_report(trained: dict[str, Path], tmp_path: Path) -> None:
    outputs = {"render": tmp_path / "test.npy", "report": tmp_path / "render.json", "video": tmp_path / "test.mp4"}
    render.run(job(RenderConfig(), trained, outputs))
    images, report = np.load(outputs["render"]), json.loads(outputs["report"].read_text())
    assert images.dtype == np.uint8 and images.shape == (2, 40, 40, 4)
    assert (
        report["frames"] == [6, 7]
        and report["ms_per_frame"] > 0
        and report["evaluations_per_covered_ray"] >= report["evaluations_per_ray"] > 0
    )
    assert outputs["video"].stat().st_size > 500
    truth = on_white(np.load(trained["frames"])[6], np.load(trained["alpha"])[6])
    outside = images[0, ..., 3] == 0
    assert outside.any() and (images[0, outside, :3] == 255).all()
    assert np.mean((images[0, ..., :3] / 255 - truth) ** 2) < np.mean((1 - truth) ** 2) / 4  # much better than blank paper
    render.run(job(RenderConfig(max_frames=1), trained, outputs))
    assert len(np.load(outputs["render"])) == 1


def test_another_head_model_and_a_damaged_avatar_are_refused(trained: dict[str, Path], tmp_path: Path) -> None:
    outputs = {"render": tmp_path / "test.npy", "report": tmp_path / "render.json", "video": tmp_path / "test.mp4"}
    other = tmp_path / "head.npz"
    toy_head(24, 36, seed=5).save(other)
    with pytest.raises(StepError, match="trained on head model toy"):
        render.run(job(RenderConfig(), trained | {"head": other}, outputs))
    split = tmp_path / "split.json"
    split.write_text(json.dumps({"train": [0, 1], "test": []}))
    with pytest.raises(StepError, match="no test frame"):
        render.run(job(RenderConfig(), trained | {"split": split}, outputs))


def test_large_expression_codes_stay_finite(trained: dict[str, Path]) -> None:
    scene, avatar = scene_and_avatar(trained)
    track = dict(np.load(trained["track"]))
    for factor in (2, 10):
        wild = Scene(toy_head(24, 36), track | {"expression": track["expression"] * np.float32(factor)}, [6])
        rendered = render.render_frame(avatar, wild, 6, (40, 40), torch.float32, "cpu")[0]
        assert rendered.shape == (40, 40, 4)


def test_a_view_without_the_head_is_white(trained: dict[str, Path]) -> None:
    scene, avatar = scene_and_avatar(trained)
    posed = avatar.pose(*scene.heads([6], "cpu"))
    rays = scene.rays(6, np.arange(5000, 5010), np.arange(10))
    rendered, _ = avatar.march(posed, rays, torch.float32)
    assert (rendered.colour == 1).all() and (rendered.opacity == 0).all()
    with torch.no_grad():
        assert (avatar.render(posed, [rays], torch.float32).renders[0].colour == 1).all()
