"""The step that scores: against the libraries frame by frame, what it leaves out, and what it refuses."""

import json
import pickle
from pathlib import Path

import made_subject as made
import numpy as np
import pandas as pd
import pytest
import torch
from made_face import face
from pydantic import ValidationError
from skimage import metrics as reference
from test_lpips import random_vgg16

from avatar import evaluate, lpips, metrics, regions
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


def run(
    files: dict[str, Path], tmp_path: Path, config: dict | None = None, **more: Path | list[Path]
) -> tuple[pd.DataFrame, dict]:
    out = {"per_frame": tmp_path / "metrics" / "per_frame.csv", "metrics": tmp_path / "metrics" / "metrics.json"}
    inputs = {name: files[name] for name in (*INPUTS, "render", "report")} | more
    step.main(evaluate.run, EvaluateConfig, made.arguments(config or {}, inputs, out))
    return pd.read_csv(out["per_frame"]), json.loads(out["metrics"].read_text())


def tensors(files: dict[str, Path], frame: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Truth on white [1, 3, H, W], render [1, 4, H, W], alpha [1, H, W], float64."""
    colour, alpha = made.picture(frame)
    mask = torch.from_numpy(alpha / 255.0)
    truth = torch.from_numpy(colour / 255.0).permute(2, 0, 1) * mask + 1 - mask
    render = torch.from_numpy(np.load(files["render"])[made.TEST.index(frame)] / 255.0).permute(2, 0, 1)
    return truth[None], render[None], mask[None]


def twin(truth: torch.Tensor, render: torch.Tensor, part: np.ndarray | regions.Box, network: lpips.Lpips) -> dict[str, float]:
    """Scores of a region by hand, SSIM by scikit-image: truth [1, 3, H, W] and render [1, 4, H, W], float64."""
    inside, colour = np.zeros(truth.shape[2:], bool), render[:, :3]
    inside[part if isinstance(part, np.ndarray) else part.slices] = True
    first, second = (image[0].permute(1, 2, 0).numpy() for image in (colour, truth))
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1, "channel_axis": 2}
    similar = reference.structural_similarity(first, second, full=True, **settings)[1]
    inner = np.zeros_like(inside)
    inner[5:-5, 5:-5] = inside[5:-5, 5:-5]
    rows, columns = np.where(inside)
    ends = [rows.min(), rows.max() + 1, columns.min(), columns.max() + 1]
    for first_end, side in ((0, truth.shape[2]), (2, truth.shape[3])):
        missing = max(0, 31 - (ends[first_end + 1] - ends[first_end]))
        ends[first_end] = min(max(0, ends[first_end] - missing // 2), side - (ends[first_end + 1] - ends[first_end]) - missing)
        ends[first_end + 1] = max(ends[first_end + 1], ends[first_end] + 31)
    crops = []
    for image in (colour, truth):
        shown = torch.where(torch.from_numpy(inside), image, 1.0) if isinstance(part, np.ndarray) else image
        crops.append(shown[:, :, ends[0] : ends[1], ends[2] : ends[3]])
    return {
        "psnr": reference.peak_signal_noise_ratio(second[inside], first[inside], data_range=1),
        "ssim": similar[inner].mean(),
        "l1": np.abs(first - second)[inside].mean(),
        "lpips": network(*crops).item(),
    }


def test_each_score_equals_a_frame_by_frame_twin(files: dict[str, Path], tmp_path: Path) -> None:
    table, result = run(files, tmp_path)
    network = lpips.load(files["lpips"]).double()
    for row in table.itertuples():
        truth, render, mask = tensors(files, row.frame)
        expected = {
            "psnr": metrics.psnr(render[:, :3], truth).item(),
            "ssim": metrics.ssim(render[:, :3], truth).item(),
            "l1": metrics.l1(render[:, :3], truth).item(),
            "lpips": network(render[:, :3], truth).item(),
            "iou": 1.0,
        }
        if row.frame != made.NOT_FOUND:
            found = regions.find(made.landmarks(row.frame), (made.HEIGHT, made.WIDTH))
            assert found.face is not None and len(found.mouth) == 1 and len(found.eyes) == 2
            y, x = np.mgrid[: made.HEIGHT, : made.WIDTH] + 0.5
            hull = found.face
            ellipse = np.hypot((x - made.pose(row.frame)[0]) / 14, (y - 32) / 17) < 1
            assert (hull & ellipse).sum() / (hull | ellipse).sum() > 0.9  # OpenCV's fill takes pixels that the border touches
            assert np.abs([x[hull].mean() - made.pose(row.frame)[0], y[hull].mean() - 32]).max() < 0.25  # px: no half-pixel shift
            for region, parts in (("face", [hull]), ("mouth", found.mouth), ("eyes", found.eyes)):
                scores = [twin(truth, render, part, network) for part in parts]
                expected |= {f"{name}_{region}": np.mean([score[name] for score in scores]) for name in scores[0]}
        for name, value in expected.items():
            assert getattr(row, name) == pytest.approx(value, abs=1e-4), (row.frame, name)
    assert result["metrics"]["psnr"]["mean"] == pytest.approx(table.psnr.mean(), abs=1e-5)
    assert result["metrics"]["psnr"]["std"] == pytest.approx(table.psnr.std(ddof=0), abs=1e-5)


def test_columns_are_the_contract(files: dict[str, Path], tmp_path: Path) -> None:
    report = json.loads(files["report"].read_text())
    files["report"].write_text(json.dumps(report | {"ms": [float(k) for k in range(8)], "ms_counts": "all of it"}))
    parts = [f"{metric}_{region}" for region in ("face", "mouth", "eyes") for metric in ("psnr", "ssim", "lpips", "l1")]
    table, result = run(files, tmp_path)
    assert table.columns.tolist() == ["frame", "psnr", "ssim", "lpips", "l1", "iou", *parts, "ms", "note"]
    assert table.ms.tolist() == [0.0, 1.0, 2.0, 3.0, 5.0, 6.0, 7.0]  # one frame could not be tracked
    assert result["protocol"]["speed"] == "all of it" and list(result["metrics"]) == table.columns[1:-2].tolist()
    files["report"].write_text(json.dumps(report | {"ms": [1.0]}))
    with pytest.raises(SystemExit):
        run(files, tmp_path)


def test_vgg16_stands_under_its_own_name(files: dict[str, Path], tmp_path: Path) -> None:
    vgg = tmp_path / "vgg.ckpt"
    vgg.write_bytes(pickle.dumps(random_vgg16(), 4))
    plain = run(files, tmp_path)[0]
    table, result = run(files, tmp_path, {"lpips": ["alexnet", "vgg16"]}, lpips=[files["lpips"], vgg])
    more = ["lpips_vgg", "lpips_vgg_face", "lpips_vgg_mouth", "lpips_vgg_eyes"]
    assert table.columns.tolist() == [*plain.columns[:-2], *more, *plain.columns[-2:]]
    pd.testing.assert_frame_equal(table[plain.columns], plain)
    assert "AlexNet" in result["protocol"]["lpips"] and "VGG16" in result["protocol"]["lpips_vgg"]
    row = table.iloc[0]
    truth, render, _ = tensors(files, int(row.frame))
    network = lpips.load(vgg, network="vgg16").double()
    assert row.lpips_vgg == pytest.approx(network(render[:, :3], truth).item(), abs=1e-6)
    swapped = run(files, tmp_path, {"lpips": ["vgg16", "alexnet"]}, lpips=[vgg, files["lpips"]])[0]
    pd.testing.assert_frame_equal(swapped[table.columns], table)


def test_networks_that_the_config_refuses() -> None:
    for wrong in ([], ["vgg16"], ["alexnet", "alexnet"], ["squeeze"]):
        with pytest.raises(ValidationError):
            EvaluateConfig(lpips=wrong)


def test_regions_that_are_not_seen_are_left_out_with_a_note(files: dict[str, Path], tmp_path: Path) -> None:
    with np.load(files["landmarks"]) as file:
        landmarks = dict(file)
    landmarks["points"] = np.stack([face((36, 34), 40)] * made.FRAMES)
    landmarks["points"][16] = face((36, 34), 40, -75)  # the subject's right eye is behind the nose
    landmarks["points"][17] = face((36, 58), 40)  # the mouth is below the picture
    np.savez(files["landmarks"], **landmarks)
    table, result = run(files, tmp_path)
    counts = {name: value["n"] for name, value in result["metrics"].items()}
    assert (counts["psnr"], counts["psnr_face"], counts["lpips_mouth"], counts["ssim_eyes"]) == (7, 6, 5, 6)
    notes = dict(zip(table.frame, table.note.fillna(""), strict=True))
    assert notes[16] == "right eye turned away: left out" and notes[17] == "mouth out of the picture: left out"
    assert result["regions_left_out"] == {
        notes[16]: 1,
        notes[17]: 1,
        "no face landmarks: face, mouth and eyes left out": 1,
    }
    truth, render, _ = tensors(files, 16)
    (eye,) = regions.find(landmarks["points"][16], (made.HEIGHT, made.WIDTH)).eyes
    expected = twin(truth, render, eye, lpips.load(files["lpips"]).double())
    assert table.lpips_eyes[0] == pytest.approx(expected["lpips"], abs=1e-4)
    assert table.psnr_eyes[0] == pytest.approx(expected["psnr"], abs=1e-4)


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
    keys = ("background", "mask", "crop", "face", "mouth", "eyes", "resolution", "lpips", "frames", "test_time_fitting", "speed")
    for key in keys:
        assert result["protocol"][key]
    assert result["protocol"]["frames"] == "7 of 8 rendered test frames" and result["protocol"]["test_time_fitting"] == "none"
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
    best = {"psnr": 100, "ssim": 1, "lpips": 0, "l1": 0}
    assert len(means) == 17 and means == pytest.approx(
        {"iou": 1} | {name: best[name.partition("_")[0]] for name in means if name != "iou"}, abs=1e-5
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
