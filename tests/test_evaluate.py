"""The step that scores: against the libraries frame by frame, what it leaves out, and what it refuses."""

import json
from pathlib import Path

import made_subject as made
import numpy as np
import pandas as pd
import pytest
import torch

from avatar import evaluate, lpips, metrics
from avatar.config import EvaluateConfig
from workflow import step

INPUTS = ("frames", "alpha", "landmarks", "track", "split", "lpips")


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """The tiny subject with a render that is the truth on white, darkened by 0.1 in the left half."""
    paths = made.make(tmp_path / "in")
    renders = []
    for frame in made.TEST:
        colour, alpha = made.picture(frame)
        mask = alpha[..., None] / 255
        shown = colour * mask + 255 * (1 - mask)
        shown[:, : made.WIDTH // 2] -= 25.5
        renders.append(np.concatenate([shown.clip(0, 255), alpha[..., None]], -1).round())
    paths["render"], paths["report"] = tmp_path / "test.npy", tmp_path / "render.json"
    np.save(paths["render"], np.stack(renders).astype(np.uint8))
    paths["report"].write_text(json.dumps({"frames": made.TEST, "ms_per_frame": 12.5}))
    return paths


def run(files: dict[str, Path], tmp_path: Path, **more: Path) -> tuple[pd.DataFrame, dict]:
    out = {"per_frame": tmp_path / "metrics" / "per_frame.csv", "metrics": tmp_path / "metrics" / "metrics.json"}
    inputs = {name: files[name] for name in (*INPUTS, "render", "report")} | more
    step.main(evaluate.run, EvaluateConfig, made.arguments({}, inputs, out))
    return pd.read_csv(out["per_frame"]), json.loads(out["metrics"].read_text())


def tensors(files: dict[str, Path], frame: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Truth on white [1, 3, H, W], render [1, 4, H, W], alpha [1, H, W], float64."""
    colour, alpha = made.picture(frame)
    mask = torch.from_numpy(alpha / 255.0)
    truth = torch.from_numpy(colour / 255.0).permute(2, 0, 1) * mask + 1 - mask
    render = torch.from_numpy(np.load(files["render"])[made.TEST.index(frame)] / 255.0).permute(2, 0, 1)
    return truth[None], render[None], mask[None]


def test_each_score_equals_a_frame_by_frame_twin(files: dict[str, Path], tmp_path: Path) -> None:
    table, result = run(files, tmp_path)
    network = lpips.load(files["lpips"]).double()
    for row in table.itertuples():
        truth, render, mask = tensors(files, row.frame)
        expected = {
            "psnr": metrics.psnr(render[:, :3], truth),
            "ssim": metrics.ssim(render[:, :3], truth),
            "l1": metrics.l1(render[:, :3], truth),
            "lpips": network(render[:, :3], truth),
            "iou": torch.ones(1),
        }
        if row.frame != made.NOT_FOUND:
            y, x = np.mgrid[: made.HEIGHT, : made.WIDTH] + 0.5
            hull = evaluate.face_hull(made.landmarks(row.frame), (made.HEIGHT, made.WIDTH))
            ellipse = np.hypot((x - made.pose(row.frame)[0]) / 14, (y - 32) / 17) < 1
            assert (hull & ellipse).sum() / (hull | ellipse).sum() > 0.9  # OpenCV's fill takes pixels that the border touches
            assert np.abs([x[hull].mean() - made.pose(row.frame)[0], y[hull].mean() - 32]).max() < 0.25  # px: no half-pixel shift
            expected["psnr_face"] = metrics.psnr(render[:, :3], truth, torch.from_numpy(hull)[None])
            rows, columns = np.where(hull)
            box = np.s_[:, :, rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
            only = [torch.where(torch.from_numpy(hull), image, 1.0)[box] for image in (render[:, :3], truth)]
            padding = (0, max(0, 31 - only[0].shape[3]), 0, max(0, 31 - only[0].shape[2]))
            expected["lpips_face"] = network(*(torch.nn.functional.pad(image, padding, value=1.0) for image in only))
        for name, value in expected.items():
            assert getattr(row, name) == pytest.approx(value.item(), abs=1e-4), (row.frame, name)
    assert result["metrics"]["psnr"]["mean"] == pytest.approx(table.psnr.mean(), abs=1e-5)
    assert result["metrics"]["psnr"]["std"] == pytest.approx(table.psnr.std(ddof=0), abs=1e-5)


def test_what_is_left_out_is_said(files: dict[str, Path], tmp_path: Path) -> None:
    table, result = run(files, tmp_path)
    assert table.frame.tolist() == [frame for frame in made.TEST if frame != made.UNUSABLE]
    assert result["excluded"] | {"reason": ""} == {"count": 1, "reason": "", "frames": [made.UNUSABLE]}
    assert (result["scored_frames"], result["test_frames"], result["ms_per_frame"]) == (7, 8, 12.5)
    lost = table[table.frame == made.NOT_FOUND].iloc[0]
    assert np.isnan(lost.psnr_face) and "no face" in lost.note and np.isfinite(lost.psnr)
    assert table.note.notna().sum() == 1
    assert (result["metrics"]["psnr"]["n"], result["metrics"]["psnr_face"]["n"]) == (7, 6)
    assert result["predictor"] is False and result["training_seconds"] is None
    for key in ("background", "mask", "crop", "resolution", "lpips", "frames", "test_time_fitting"):
        assert result["protocol"][key]
    assert "[0, 1]" in result["protocol"]["lpips"] and result["protocol"]["resolution"] == "72x64"


def test_training_seconds_are_handed_on(files: dict[str, Path], tmp_path: Path) -> None:
    train = tmp_path / "train.json"
    train.write_text(json.dumps({"train_seconds": 42.0}))
    assert run(files, tmp_path, train=train)[1]["training_seconds"] == 42.0


def test_a_perfect_render_scores_the_cap(files: dict[str, Path], tmp_path: Path) -> None:
    colours, alphas = np.load(files["frames"])[made.TEST], np.full((8, made.HEIGHT, made.WIDTH), 255, np.uint8)
    np.save(files["alpha"], np.full((made.FRAMES, made.HEIGHT, made.WIDTH), 255, np.uint8))
    np.save(files["render"], np.concatenate([colours, alphas[..., None]], -1))
    means = {name: value["mean"] for name, value in run(files, tmp_path)[1]["metrics"].items()}
    assert means == pytest.approx(
        {"psnr": 100, "ssim": 1, "lpips": 0, "l1": 0, "iou": 1, "psnr_face": 100, "lpips_face": 0}, abs=1e-5
    )


def refused(files: dict[str, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture) -> str:
    with pytest.raises(SystemExit) as stopped:
        run(files, tmp_path)
    assert stopped.value.code == 1
    return caplog.text


def test_refusals(files: dict[str, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    render = np.load(files["render"])
    np.save(files["render"], render[:5])
    assert "expected shape (8, 64, 72, 4), found (5, 64, 72, 4)" in refused(files, tmp_path, caplog)
    np.save(files["render"], render)
    files["report"].write_text(json.dumps({"frames": [3, *made.TEST[1:]], "ms_per_frame": 1}))
    assert "frame 3 is not a test frame" in refused(files, tmp_path, caplog)
    files["report"].write_text(json.dumps({"frames": made.TEST, "ms_per_frame": 1}))
    with np.load(files["track"]) as file:
        track = dict(file)
    np.savez(files["track"], **(track | {"usable": np.zeros(made.FRAMES, bool)}))
    assert "none of the 8 test frames" in refused(files, tmp_path, caplog)
    np.savez(files["track"], **track)
    files["lpips"].write_bytes(b"<html>")
    assert "lpips.ckpt" in refused(files, tmp_path, caplog)


def test_a_score_that_is_not_finite_names_the_frame() -> None:
    rows = [{"frame": 3, "psnr": 20.0}, {"frame": 7, "psnr": float("nan"), "note": ""}]
    with pytest.raises(step.StepError, match=r"test\.npy: frame 7 has psnr = nan"):
        evaluate._check(rows, Path("test.npy"))


def test_a_hull_outside_the_frame_is_empty() -> None:
    points = made.landmarks(16) + 500
    assert not evaluate.face_hull(points, (made.HEIGHT, made.WIDTH)).any()
