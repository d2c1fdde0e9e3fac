"""Frames: exact pixels at scale 1, one scale for both axes, times kept, and files that changed since probe."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import video_files
from made_subject import arguments

from fitting import extract
from fitting.config import ExtractConfig
from workflow import step


def extracted(path: Path, crop: dict[str, int], frames: int, source: tuple[int, int], **config: int) -> tuple[np.ndarray, dict]:
    folder = path.parent
    (folder / "probe.json").write_text(
        json.dumps({"accepted": True, "reason": None, "frames": frames, "fps": 30.0, "source_size": list(source), "crop": crop})
    )
    out = {"frames": folder / "frames.npy", "index": folder / "frames.json"}
    step.main(extract.run, ExtractConfig, arguments(config, {"video": path, "probe": folder / "probe.json"}, out))
    return np.load(out["frames"], mmap_mode="r"), json.loads(out["index"].read_text())


def numbered(count: int, height: int, width: int) -> list[np.ndarray]:
    return list(np.random.default_rng(3).integers(0, 255, (count, height, width, 3), dtype=np.uint8))


def lossless(path: Path, pictures: list[np.ndarray], stamps: list[int] | None = None) -> Path:
    return video_files.write(path, pictures, codec="ffv1", pixel_format="bgr0", stamps=stamps)


def test_at_scale_one_the_crop_is_the_source_pixels(tmp_path: Path) -> None:
    pictures = numbered(5, 61, 83)
    crop = {"x": 7, "y": 3, "width": 63, "height": 49}
    frames, index = extracted(lossless(tmp_path / "a.mkv", pictures), crop, 5, (61, 83))
    assert frames.dtype == np.uint8 and frames.shape == (5, 49, 63, 3)
    for found, picture in zip(frames, pictures, strict=True):
        assert np.array_equal(found, picture[3:52, 7:70])
    assert index["scale"] == 1.0 and index["crop"] == crop and index["size"] == [49, 63] and index["source_size"] == [61, 83]
    assert index["source_frame"] == [0, 1, 2, 3, 4]


def test_shrinking_averages_areas(tmp_path: Path) -> None:
    pictures = numbered(2, 128, 256)
    crop = {"x": 0, "y": 0, "width": 256, "height": 128}
    frames, index = extracted(lossless(tmp_path / "a.mkv", pictures), crop, 2, (128, 256), size=64)
    assert index["scale"] == 0.25 and frames.shape == (2, 32, 64, 3)
    slow = pictures[0].reshape(32, 4, 64, 4, 3).astype(np.float64).mean(axis=(1, 3))
    assert np.abs(frames[0] - slow).max() <= 0.51


@pytest.mark.parametrize(("width", "height"), [(701, 613), (613, 701), (1080, 1919), (720, 1029), (513, 512), (1118, 720)])
def test_one_scale_serves_both_axes(width: int, height: int) -> None:
    crop, size, scale = extract.fit_crop({"x": 5, "y": 6, "width": width, "height": height}, 512)
    assert max(size) == 512 and scale == 512 / max(crop["width"], crop["height"])
    assert abs(size[0] - crop["height"] * scale) < 0.1 and abs(size[1] - crop["width"] * scale) < 0.1
    assert 0 <= width - crop["width"] <= 8 and 0 <= height - crop["height"] <= 8


def test_never_upscaled() -> None:
    crop = {"x": 1, "y": 2, "width": 101, "height": 77}
    assert extract.fit_crop(crop, 512) == (crop, (77, 101), 1.0)


def test_variable_rate_times_and_max_frames(tmp_path: Path) -> None:
    stamps = [0, 33, 100, 133, 300, 333, 366, 400, 433, 466]
    path = lossless(tmp_path / "a.mkv", numbered(10, 20, 20), stamps)
    frames, index = extracted(path, {"x": 0, "y": 0, "width": 20, "height": 20}, 10, (20, 20), max_frames=8)
    assert len(frames) == 8
    assert np.allclose(index["time_s"], np.array(stamps[:8]) / 1000.0, atol=2e-3)


def test_a_few_missing_frames_shorten_the_array(tmp_path: Path) -> None:
    path = lossless(tmp_path / "a.mkv", numbered(99, 12, 14))
    frames, index = extracted(path, {"x": 0, "y": 0, "width": 14, "height": 12}, 100, (12, 14))
    assert frames.shape == (99, 12, 14, 3) and len(index["time_s"]) == 99


@pytest.mark.parametrize(
    ("claimed", "source", "says"), [(20, (12, 14), "10 frames decode but probe counted 20"), (10, (14, 12), "has changed")]
)
def test_a_file_that_changed_since_probe(tmp_path: Path, caplog, claimed: int, source: tuple[int, int], says: str) -> None:
    path = lossless(tmp_path / "a.mkv", numbered(10, 12, 14))
    with pytest.raises(SystemExit) as stopped:
        extracted(path, {"x": 0, "y": 0, "width": 12, "height": 12}, claimed, source)
    assert stopped.value.code == 1
    assert says in caplog.records[-1].getMessage() and str(path) in caplog.records[-1].getMessage()
    assert not (tmp_path / "frames.npy").exists()
