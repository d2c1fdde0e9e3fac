"""What is accepted, what is rejected with which sentence, where the crop lies, and what the capture warnings say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import video_files
from made_subject import arguments
from test_detect import made_face

from fitting import probe, video
from fitting.config import ProbeConfig
from workflow import step


@pytest.fixture(scope="module")
def talking(assets: Path) -> list[np.ndarray]:
    """48 frames of the demo clip, (132, 176, 3) each."""
    return [frame.rgb() for frame, _ in zip(video.read_frames(assets / "carphone.mp4"), range(48), strict=False)]


def probed(path: Path, assets: Path) -> dict:
    out = path.with_name("probe.json")
    inputs = {"video": path, "landmarker": assets / "face_landmarker.task"}
    step.main(probe.run, ProbeConfig, arguments({}, inputs, {"probe": out}))
    report = json.loads(out.read_text())
    assert report["accepted"] == (report["reason"] is None)
    assert [*report] == [*probe.KEYS, "provenance"]
    if not report["accepted"]:
        assert report["reason"].startswith(path.name) and "\n" not in report["reason"]
    return report


def test_a_talking_head_is_accepted(tmp_path: Path, assets: Path, talking: list[np.ndarray]) -> None:
    report = probed(video_files.write(tmp_path / "ännä one.mp4", talking), assets)
    assert report["accepted"]
    assert (report["file"], report["codec"], report["frames"], report["source_size"]) == ("ännä one.mp4", "h264", 48, [132, 176])
    assert (report["rotation_degrees"], report["variable_frame_rate"], report["faces_max"]) == (0, False, 1)
    assert report["fps"] == pytest.approx(30.0) and report["duration_s"] == pytest.approx(1.6, abs=0.01)
    assert report["face_found_fraction"] > 0.95
    assert 40 < report["head_size_px"] < 100
    crop = report["crop"]
    assert all(isinstance(value, int) for value in crop.values())
    assert crop["x"] >= 0 and crop["y"] >= 0 and crop["x"] + crop["width"] <= 176 and crop["y"] + crop["height"] <= 132
    assert any("over 500 px" in warning for warning in report["warnings"])
    assert any("1-2 minutes" in warning for warning in report["warnings"])


def test_a_turned_video_gives_the_crop_in_upright_pixels(tmp_path: Path, assets: Path, talking: list[np.ndarray]) -> None:
    straight = probed(video_files.write(tmp_path / "a.mp4", talking), assets)
    lying = [np.ascontiguousarray(np.rot90(picture, 1)) for picture in talking]
    turned = probed(video_files.write(tmp_path / "b.mp4", lying, prepare=lambda stream: stream.set_display_rotation(-90)), assets)
    assert turned["rotation_degrees"] == 270 and turned["source_size"] == [132, 176]
    for key, value in straight["crop"].items():
        assert abs(turned["crop"][key] - value) <= 3, key


@pytest.mark.parametrize(("seen", "accepted"), [(40, True), (16, False), (0, False)])
def test_a_face_in_under_half_of_the_frames(tmp_path: Path, assets: Path, talking, seen: int, accepted: bool) -> None:
    frames = talking[:seen] + [np.full_like(talking[0], 100)] * (48 - seen)
    report = probed(video_files.write(tmp_path / "a.mp4", frames), assets)
    assert report["accepted"] == accepted
    if accepted:
        assert any("no face in" in warning for warning in report["warnings"])
    else:
        assert "at least half is needed" in report["reason"] if seen else "no face in any" in report["reason"]


def test_a_second_face_is_warned_of_and_left_out_of_the_crop(tmp_path: Path, assets: Path, talking: list[np.ndarray]) -> None:
    wide = [np.hstack([picture, np.full((132, 150, 3), 90, np.uint8), picture if t >= 24 else np.full_like(picture, 90)])
            for t, picture in enumerate(talking)]  # fmt: skip
    report = probed(video_files.write(tmp_path / "a.mp4", wide), assets)
    assert report["accepted"] and report["faces_max"] == 2
    assert any("second face" in warning for warning in report["warnings"])
    assert report["crop"]["x"] + report["crop"]["width"] < 176 + 150


def test_too_short(tmp_path: Path, assets: Path, talking: list[np.ndarray]) -> None:
    assert "12 frames could be read" in probed(video_files.write(tmp_path / "a.mp4", talking[:12]), assets)["reason"]


@pytest.mark.parametrize("make", [
    lambda path: path.write_text("not a video"), lambda path: path.write_bytes(b""),
    video_files.write_audio, video_files.write_no_frames,
])  # fmt: skip
def test_what_is_no_video_is_rejected_not_crashed(tmp_path: Path, assets: Path, make) -> None:
    path = tmp_path / "clip.mp4"
    make(path)
    report = probed(path, assets)
    assert not report["accepted"]


def test_a_truncated_file_is_accepted_with_what_it_has(tmp_path: Path, assets: Path, talking: list[np.ndarray]) -> None:
    whole = video_files.write(tmp_path / "whole.mp4", talking, container_options={"movflags": "faststart"})
    path = tmp_path / "cut.mp4"
    path.write_bytes(whole.read_bytes()[: int(0.8 * whole.stat().st_size)])
    report = probed(path, assets)
    assert report["accepted"] and 30 <= report["frames"] < 48
    assert any(f"only {report['frames']} of" in warning for warning in report["warnings"])


def test_the_crop_is_the_union_of_all_heads_with_margins() -> None:
    faces = [made_face(300 + 10 * t, 400, 100) for t in range(20)]
    crop = probe.crop_box(faces, (1000, 1000))
    low = np.min([face.points[:, :2].min(axis=0) for face in faces], axis=0)
    high = np.max([face.points[:, :2].max(axis=0) for face in faces], axis=0)
    assert crop["x"] == int(np.floor(low[0] - 50)) and crop["y"] == int(np.floor(low[1] - 55))
    assert abs(crop["x"] + crop["width"] - (high[0] + 50)) <= 1 and abs(crop["y"] + crop["height"] - (high[1] + 55)) <= 1
    clipped = probe.crop_box(faces, (420, 330))
    assert clipped == {"x": crop["x"], "y": crop["y"], "width": 330 - crop["x"], "height": 420 - crop["y"]}


def test_exposure_of_dark_and_burnt_faces() -> None:
    face = made_face(50, 50, 60)
    assert probe.exposure(np.full((100, 100, 3), 20, np.uint8), face)[0] < probe.DARK
    mean, clipped = probe.exposure(np.full((100, 100, 3), 255, np.uint8), face)
    assert mean > probe.BRIGHT and clipped == 1.0
    outside = probe.exposure(np.full((100, 100, 3), 128, np.uint8), made_face(-200, -200, 60))
    assert np.isfinite(outside).all()
