"""Flicker where its truth is known, the stillest stretch, and the step on a toy avatar."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from pathlib import Path

import av
import made_subject as made
import numpy as np
import pytest
import torch
from toy_run import job, train_in, write_subject

from avatar.provenance import synthetic_comment
from avatar.uses import flicker
from avatar.uses.config import FlickerConfig
from fitting.files import load_head
from workflow.step import StepError

MASK = np.zeros((48, 64), bool)
MASK[4:44, 6:60] = True


def still(count: int = 60) -> np.ndarray:
    """A picture with edges, held: [T, 48, 64, 3] in levels."""
    y, x = np.mgrid[:48, :64]
    return np.repeat(np.stack([80 + x, 120 + 60 * (x > 30), 200 - 2 * y], -1)[None].astype(float), count, 0)


@pytest.mark.parametrize("sigma", [0.7, 3.0])
def test_white_noise_on_a_still_picture_reads_as_its_sigma(sigma: float) -> None:
    noisy = still() + np.random.default_rng(1).normal(0, sigma, (60, 48, 64, 3))
    assert flicker.flicker(noisy, MASK) == pytest.approx(sigma, rel=0.01)


def test_what_is_steady_is_no_flicker() -> None:
    drift = still() + 1.5 * np.arange(60)[:, None, None, None]  # brighter by 1.5 levels a frame
    assert flicker.flicker(still(), MASK) == 0
    assert flicker.flicker(drift, MASK) < 1e-4
    slow = 20 * np.sin(2 * np.pi * 0.5 * np.arange(60) / 30)  # half a turn a second at 30 frames a second
    expected = 20 * (2 * np.pi * 0.5 / 30) ** 2 * 2 / np.pi / flicker.WHITE_NOISE  # second derivative's mean: 0.07 levels
    assert flicker.flicker(still() + slow[:, None, None, None], MASK) == pytest.approx(expected, rel=0.05)


def test_only_pixels_of_the_mask_count_also_after_the_blur() -> None:
    frames = still()
    frames[:, ~MASK] = np.random.default_rng(2).uniform(0, 255, (60, (~MASK).sum(), 3))
    assert flicker.flicker(frames, MASK) == 0
    assert flicker.flicker(flicker.blurred(frames, MASK, 2.0), MASK) < 1e-4


def test_the_coarse_measure_forgets_sensor_noise_and_keeps_what_moves_as_a_whole() -> None:
    random, inside = np.random.default_rng(3), np.zeros_like(MASK)
    inside[16:32, 20:44] = True  # away from the mask's rim, where the blur has fewer pixels
    noisy = still() + random.normal(0, 2, (60, 48, 64, 3))
    expected = 2 / (2 * np.sqrt(np.pi) * 1.5)  # of a Gaussian of 1.5 px over white noise
    assert flicker.flicker(flicker.blurred(noisy, MASK, 1.5), inside) == pytest.approx(expected, rel=0.05)
    lamp = still() + random.normal(0, 2, (60, 1, 1, 1))
    assert flicker.flicker(flicker.blurred(lamp, MASK, 1.5), MASK) == pytest.approx(flicker.flicker(lamp, MASK), rel=1e-3)


def test_no_frames_or_no_pixels() -> None:
    for frames, mask in ((still(2), MASK), (still(), np.zeros_like(MASK))):
        with pytest.raises(ValueError, match="three frames and a pixel"):
            flicker.flicker(frames, mask)


def moving(speeds: list[float]) -> np.ndarray:
    """Landmarks [T, 478, 2] whose step from one frame to the next is known."""
    start = np.random.default_rng(4).uniform(50, 200, (478, 2))
    return start + np.cumsum(speeds)[:, None, None]


def test_the_stillest_stretch() -> None:
    speeds = [3.0] * 10 + [0.1] * 8 + [1.0] * 12
    points, valid, time_s = moving(speeds), np.ones(30, bool), np.arange(30) / 30
    found = flicker.stillest(points, valid, range(5, 30), time_s, 6)
    assert set(found.frames) <= set(range(9, 18)) and found.run == list(range(5, 30))
    assert found.rms_px == pytest.approx(np.sqrt(2 * np.var(0.1 * np.arange(6))), rel=1e-6)
    valid[12] = False  # a lost frame in the middle of it
    found = flicker.stillest(points, valid, range(5, 30), time_s, 6)
    assert 12 not in found.frames and len(found.frames) == 6 and found.run[0] in (5, 13)
    gap = time_s.copy()
    gap[15:] += 1.0
    assert not {14, 15} <= set(flicker.stillest(points, np.ones(30, bool), range(5, 30), gap, 6).frames)


def test_a_short_run_gives_a_short_stretch_or_none() -> None:
    points, valid, time_s = moving([1.0] * 20), np.zeros(20, bool), np.arange(20) / 30
    valid[8:15] = True
    assert flicker.stillest(points, valid, range(20), time_s, 24).frames == list(range(8, 15))
    valid[12:] = False
    assert flicker.stillest(points, valid, range(20), time_s, 24) is None


def test_reading() -> None:
    assert "no more than the video (0.20 and 0.30 levels); smoothing takes away 50 %" in flicker.reading(
        {"video": 0.3, "tracked": 0.2, "smoothed": 0.1}
    )
    assert (
        "takes away 75 %" in (noise := flicker.reading({"video": 0.2, "tracked": 0.6, "smoothed": 0.3}))
        and "the fit's noise" in noise
    )
    assert "most of it is slower" in flicker.reading({"video": 0.2, "tracked": 0.6, "smoothed": 0.5})


def test_a_frame_on_the_grid_of_a_smaller_camera() -> None:
    picture = np.arange(41 * 60, dtype=np.float32).reshape(41, 60)
    small = flicker.shrunk(picture, (20, 30), 0.5)
    np.testing.assert_allclose(small, picture[:40].reshape(20, 2, 30, 2).mean((1, 3)), atol=1e-3)
    assert flicker.shrunk(picture, (41, 60), 1.0) is picture


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A toy subject with six test frames and an avatar."""
    folder = tmp_path_factory.mktemp("flicker")
    paths = write_subject(folder, frames=12)
    head = load_head(paths["head"])
    corners = torch.full((478, 3), 1 / 3)
    replace(head, landmark_triangles=torch.arange(478) % len(head.triangles), landmark_barycentric=corners).save(paths["head"])
    paths["split"].write_text(json.dumps({"train": list(range(6)), "test": list(range(6, 12))}))
    paths["index"].write_text(json.dumps({"fps": 25, "time_s": [frame / 25 for frame in range(12)]}))
    track = dict(np.load(paths["track"]))
    np.savez(paths["track"], **track | {"usable": np.ones(12, bool)})
    paths["landmarks"], paths["lpips"] = folder / "landmarks.npz", folder / "lpips.ckpt"
    np.savez(paths["landmarks"], points=moving([0.5] * 12).astype(np.float32), found=np.ones(12, bool))
    paths["lpips"].write_bytes(pickle.dumps(made.random_lpips(), 4))
    return paths | {"avatar": train_in(folder, paths, steps=12)["avatar"]}


def measured(paths: dict[str, Path], folder: Path, **config: float) -> dict:
    outputs = {"report": folder / "flicker.json", "video": folder / "flicker.mp4"}
    flicker.run(job(FlickerConfig(**config), paths, outputs))
    return json.loads(outputs["report"].read_text())


def test_the_step_measures_video_tracked_and_smoothed(trained: dict[str, Path], tmp_path: Path) -> None:
    found = measured(trained, tmp_path, smooth_s=0.1)
    assert found["frames"] == list(range(6, 12)) and found["size"] == [40, 40] and found["pixels"] > 50
    for name in ("flicker", "flicker_coarse", "jitter_px"):
        assert set(found[name]) == {"video", "tracked", "smoothed"}
        assert 0 < found[name]["smoothed"] < found[name]["tracked"]  # the toy's poses are random from frame to frame
    assert found["scores"]["tracked"]["psnr"] > 10 and set(found["scores"]) == {"tracked", "smoothed"}
    assert found["reading"] and found["ms_per_frame"] > 0 and found["synthetic"]
    with av.open(str(tmp_path / "flicker.mp4")) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.metadata["comment"] == synthetic_comment(trained["avatar"])
    assert len(pictures) == 6 and pictures[0].shape == (40, 120, 3)


def test_held_parameters_give_a_render_without_flicker(trained: dict[str, Path], tmp_path: Path) -> None:
    track = dict(np.load(trained["track"]))
    for name in ("expression", "rotation", "neck", "jaw", "eyes", "translation"):
        track[name][:] = track[name][7]
    np.savez(tmp_path / "track.npz", **track)
    found = measured(trained | {"track": tmp_path / "track.npz"}, tmp_path)
    assert found["flicker"]["tracked"] == 0 and found["jitter_px"]["tracked"] < 1e-4 and found["flicker"]["video"] > 0


def test_a_test_part_without_a_stretch_is_refused(trained: dict[str, Path], tmp_path: Path) -> None:
    track = dict(np.load(trained["track"]))
    np.savez(tmp_path / "track.npz", **track | {"usable": np.arange(12) % 3 > 0})
    with pytest.raises(StepError, match="toy has no 5 consecutive test frames"):
        measured(trained | {"track": tmp_path / "track.npz"}, tmp_path)
