"""One face is kept: by place, size and shape; and what the landmarks mean in pixels."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_subject import arguments

from fitting import detect, video
from fitting.config import DetectConfig
from fitting.detection import BLENDSHAPE_NAMES, Face, FaceFinder, FaceTrack, shape_difference
from workflow import step

FPS = 30.0


def made_face(x: float, y: float, size: float, person: int = 0, yaw_rad: float = 0.0, noise: int | None = None) -> Face:
    """A face-like cloud of points of one of several persons, turned, at a place."""
    base = np.random.default_rng(7).normal(size=(478, 3)) * [0.5, 0.65, 0.3]
    base += np.random.default_rng(100 + person).normal(size=(478, 3)) * 0.12
    base = np.clip(base, -1.5, 1.5)
    if noise is not None:
        base += np.random.default_rng(noise).normal(size=(478, 3)) * 0.01
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    points = base @ np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
    extent = np.ptp(base[:, :2], axis=0).max()
    return Face((points / extent * size + [x, y, 0.0]).astype(np.float32), np.zeros(51, np.float32), np.eye(4, dtype=np.float32))


def follow(frames: list[list[tuple[str, Face]]]) -> tuple[list[str | None], list[bool]]:
    """Names of the faces that the track chose, and its flags."""
    track, names, flags = FaceTrack(), [], []
    for t, faces in enumerate(frames):
        chosen, switched = track.update([face for _, face in faces], t / FPS)
        names.append(None if chosen is None else faces[chosen][0])
        flags.append(switched)
    return names, flags


def test_shape_difference_ignores_place_size_and_turn() -> None:
    here, there = made_face(100, 100, 80), made_face(400, 30, 240, yaw_rad=0.6)
    assert shape_difference(here.points, there.points) < 1e-3
    assert shape_difference(here.points, made_face(100, 100, 80, person=1).points) > 0.1


def test_a_bigger_face_that_enters_does_not_steal_the_track() -> None:
    frames = []
    for t in range(60):
        faces = [("first", made_face(200 + t, 200, 100, noise=t))]
        if t >= 15:  # comes in from the right, larger, and stops beside the first
            faces.insert(t % 2, ("second", made_face(max(700 - 20 * (t - 15), 420), 220, 220, person=1, noise=t)))
        frames.append(faces)
    names, flags = follow(frames)
    assert names == ["first"] * 60
    assert not any(flags)


@pytest.mark.parametrize("order", [1, -1])
def test_two_faces_that_cross_keep_their_names(order: int) -> None:
    frames = []
    for t in range(80):
        second = made_face(500 - 5 * t, 215, 105, person=1, noise=t + 500)
        pair = [("first", made_face(100 + 5 * t, 200, 100, noise=t)), ("second", second)]
        frames.append((pair if t else pair[:1])[::order])
    names, flags = follow(frames)
    assert names == ["first"] * 80
    assert not any(flags)


def test_a_face_that_leaves_is_found_again_within_two_frames() -> None:
    def place(t: int) -> float:
        return 200.0 + (8 * t if t < 40 else 8 * (80 - t))

    frames = [[("first", made_face(place(t), 200, 100, noise=t))] if place(t) < 400 else [] for t in range(80)]
    names, flags = follow(frames)
    gone = [t for t in range(80) if place(t) >= 400]
    back = gone[-1] + 1
    assert all(names[t] is None for t in gone)
    assert names[back] == "first" or names[back + 1] == "first"
    assert names[back + 2 :] == ["first"] * (80 - back - 2)


def test_a_stranger_is_refused_while_the_kept_face_is_briefly_gone() -> None:
    frames = [[("first", made_face(200, 200, 100, noise=t))] for t in range(20)]
    frames += [[("stranger", made_face(600, 220, 60, person=1, noise=t))] for t in range(20)]
    frames += [[("first", made_face(205, 200, 100, noise=t)), ("stranger", made_face(600, 220, 60, person=1))] for t in range(10)]
    names, flags = follow(frames)
    assert names == ["first"] * 20 + [None] * 20 + ["first"] * 10
    assert not any(flags)


def test_a_switch_is_flagged_once() -> None:
    frames = [[("first", made_face(200, 200, 100, noise=t))] for t in range(20)]
    frames += [[("stranger", made_face(600, 220, 60, person=1, noise=t))] for t in range(100)]
    names, flags = follow(frames)
    first_switch = flags.index(True)
    assert (first_switch - 19) / FPS > FaceTrack().forget_s
    assert sum(flags) == 1
    assert names[first_switch:] == ["stranger"] * (120 - first_switch)


def test_a_cut_to_another_place_keeps_the_same_person_but_is_flagged() -> None:
    frames = [[("first", made_face(200, 200, 100, noise=t))] for t in range(20)]
    frames += [[("first", made_face(600, 260, 110, yaw_rad=0.3, noise=t))] for t in range(20)]
    names, flags = follow(frames)
    assert names == ["first"] * 40
    assert [t for t, flag in enumerate(flags) if flag] == [20]


def test_times_grow_strictly() -> None:
    assert detect.growing_ms([0.0, 0.0, 0.0004, 0.033, 0.033]) == [0, 1, 2, 33, 34]


@pytest.fixture(scope="module")
def frames(assets: Path) -> np.ndarray:
    """(24, 132, 176, 3) of the demo clip."""
    return np.stack([frame.rgb() for frame, _ in zip(video.read_frames(assets / "carphone.mp4"), range(24), strict=False)])


def detected(tmp_path: Path, assets: Path, frames: np.ndarray) -> tuple[dict[str, np.ndarray], dict]:
    np.save(tmp_path / "frames.npy", frames)
    (tmp_path / "frames.json").write_text(json.dumps({"time_s": [t / FPS for t in range(len(frames))]}))
    out = {"landmarks": tmp_path / "landmarks.npz", "report": tmp_path / "landmarks.json"}
    inputs = {"frames": tmp_path / "frames.npy", "index": tmp_path / "frames.json", "landmarker": assets / "face_landmarker.task"}
    step.main(detect.run, DetectConfig, arguments({}, inputs, out))
    return dict(np.load(out["landmarks"])), json.loads(out["report"].read_text())


def test_detect_on_the_demo_clip_with_a_gap(tmp_path: Path, assets: Path, frames: np.ndarray) -> None:
    frames = frames.copy()
    frames[8:11] = 128
    found, report = detected(tmp_path, assets, frames)
    assert found["points"].shape == (24, 478, 3) and found["points"].dtype == np.float32
    assert found["blendshapes"].shape == (24, 51) and tuple(found["blendshape_names"]) == BLENDSHAPE_NAMES
    assert found["head_pose"].shape == (24, 4, 4)
    assert not found["found"][8:11].any() and found["found"][:8].all() and found["found"][13:].all()
    assert np.isnan(found["points"][~found["found"]]).all()
    assert np.isfinite(found["points"][found["found"]]).all() and np.isfinite(found["blendshapes"][found["found"]]).all()
    assert not found["switched"].any()
    assert report["lost_frames"] == [8, 9, 10] or set(report["lost_frames"]) <= {8, 9, 10, 11, 12}


def test_points_count_from_the_edge_of_the_first_pixel(assets: Path, frames: np.ndarray) -> None:
    """Pixel centres at +0.5: a picture and its exact enlargement by 8 have the same points times 8 (a shift of 3.5 px if not)."""
    with FaceFinder((assets / "face_landmarker.task").read_bytes(), video=False, max_faces=1) as finder:
        differences = []
        for frame in frames[::3]:
            large = cv2.resize(frame, None, fx=8, fy=8, interpolation=cv2.INTER_LINEAR)
            differences.append((finder.find(large)[0].points - 8.0 * finder.find(frame)[0].points)[:, :2].mean(axis=0))
        shifted = np.pad(frames[0], ((16, 0), (16, 0), (0, 0)), mode="edge")
        moved = finder.find(shifted)[0].points - finder.find(frames[0])[0].points
    assert np.abs(np.mean(differences, axis=0)).max() < 1.2
    assert np.abs(moved[:, :2].mean(axis=0) - 16.0).max() < 0.5


def test_a_second_copy_of_the_face_does_not_take_over(tmp_path: Path, assets: Path, frames: np.ndarray) -> None:
    """From frame 8 a larger copy of the same clip stands beside the first: the hardest second face there is."""
    scene = np.full((24, 200, 420, 3), 90, np.uint8)
    scene[:, 30:162, :176] = frames
    for t in range(8, 24):
        scene[t, :180, 180:] = cv2.resize(frames[t], (240, 180))
    found, report = detected(tmp_path, assets, scene)
    assert report["faces_max"] >= 2
    assert found["found"].all() and not found["switched"].any()
    assert (found["points"][:, :, 0].mean(axis=1) < 176).all()


def test_no_face_at_all_is_a_sentence(tmp_path: Path, assets: Path, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(SystemExit):
        detected(tmp_path, assets, np.full((4, 64, 64, 3), 127, np.uint8))
    assert "no face in any of 4 frames" in caplog.records[-1].getMessage()
    assert not (tmp_path / "landmarks.npz").exists()
