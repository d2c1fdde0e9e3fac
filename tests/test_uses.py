"""The steps orbit, extrapolate, sheet, animate and half_data on a toy avatar: files, notes in videos, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from toy_head import toy_head
from toy_run import job, train_in, write_subject

from avatar import baseline, provenance, render
from avatar.config import BaselineConfig, RenderConfig
from avatar.uses import animate, choose, extrapolate, half_data, motion, orbit, parameters, sheet
from avatar.uses.config import AnimateConfig, ExtrapolateConfig, HalfDataConfig, OrbitConfig, SheetConfig
from fitting.video import read_frames
from workflow.step import StepError

FAST = {"sample_factor": 1.0}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("uses")
    inputs = write_subject(folder, frames=12)
    inputs["split"].write_text(json.dumps({"train": list(range(6)), "test": list(range(6, 12))}))
    return inputs | {"avatar": train_in(folder, inputs, steps=40)["avatar"]}


def outputs(folder: Path, use: str, *names: str) -> dict[str, Path]:
    return {name: folder / (use + {"video": ".mp4", "sheet": ".png", "report": ".json", "folder": ""}[name]) for name in names}


def frames_of(video: Path) -> list[np.ndarray]:
    return [frame.rgb() for frame in read_frames(video)]


def checked(paths: dict[str, Path], avatar: Path) -> dict:
    """The report, after what every use promises: a video that names its avatar, and what its milliseconds count."""
    report = json.loads(paths["report"].read_text())
    assert report["synthetic"] and report["avatar_sha256"] == provenance.avatar_sha256(avatar)
    assert report["ms_per_frame"] > 0 and "networks" in report["counted"] and report["sample_factor"] == 1.0
    if "video" in paths:
        provenance.check(paths["video"], avatar)
    return report


def test_orbit_frozen(made: dict[str, Path], tmp_path: Path) -> None:
    paths = outputs(tmp_path, "orbit", "video", "sheet", "report")
    orbit.run(job(OrbitConfig(size=32, views=8, **FAST), made, paths))
    report = checked(paths, made["avatar"])
    assert report["renders"] == 7 and report["frames"][0] in range(6, 12)
    views = np.array([[view["yaw_degrees"], view["pitch_degrees"]] for view in report["views"]])
    np.testing.assert_allclose(np.abs(views).max(0), [35, 15], atol=0.2)
    seen = report["training_saw"]
    assert report["views_beyond_training"] == orbit.beyond(views.T, seen).sum() > 0
    shown = frames_of(paths["video"])
    assert len(shown) == len(report["order"]) == 12
    height, width = report["size"]
    assert cv2.imread(str(paths["sheet"])).shape[1] > 5 * width and shown[0].shape[1] >= 3 * width
    first, side = (shown[report["order"].index(place)][-height:, :width] for place in (2, 0))
    assert np.abs(first.astype(int) - side).mean() > 3  # another view, not the same picture again
    with pytest.raises(StepError, match="there is no frame 99; the clip has 12"):
        orbit.run(job(OrbitConfig(size=32, frame=99, **FAST), made, paths))


def test_orbit_playing_shows_every_view_once(made: dict[str, Path], tmp_path: Path) -> None:
    paths = outputs(tmp_path, "orbit", "video", "sheet", "report")
    orbit.run(job(OrbitConfig(size=24, views=8, playing=True, **FAST), made, paths))
    report = checked(paths, made["avatar"])
    assert report["frames"] == list(range(6, 12)) and report["order"] == list(range(6)) and report["fps"] == 25


@pytest.mark.parametrize("views", [8, 9, 25, 26, 200])
def test_arc_shows_every_view_and_never_jumps(views: int) -> None:
    yaw, pitch, order = orbit.arc(views, 0.6, 0.25)
    assert len(yaw) == views - (1 - views % 2) and set(order) == set(range(len(yaw)))
    assert np.unique(np.stack([yaw, pitch], 1).round(9), axis=0).shape[0] == len(yaw)
    assert yaw.max() == -yaw.min() == 0.6 and pitch.max() == -pitch.min() == 0.25
    path = np.stack([yaw, pitch], 1)[[*order, order[0]]]  # a loop
    steps = np.abs(np.diff(path, axis=0)).max(0)
    across = (np.diff(np.sort(yaw[pitch == 0]))).max()
    assert steps[0] <= across + 1e-9 and steps[1] <= np.diff(np.sort(pitch[np.abs(yaw) < 1e-9])).max() + 1e-9


def test_extrapolate(made: dict[str, Path], tmp_path: Path) -> None:
    paths = outputs(tmp_path, "extrapolate", "video", "sheet", "report")
    extrapolate.run(job(ExtrapolateConfig(size=32, frames=2, **FAST), made, paths))
    report = checked(paths, made["avatar"])
    assert report["stretch"][1] - report["stretch"][0] == 2 and report["fps"] == 12.5  # every second frame of 25 a second
    moves = [report["by_factor"][name]["face_moves_mm"] for name in ("x1", "x1.5", "x2")]
    np.testing.assert_allclose(np.array(moves) / moves[0], [1, 1.5, 2], rtol=0.1)
    shown, (height, width) = frames_of(paths["video"]), report["size"]
    assert len(shown) == 2 and shown[0].shape[1] - 4 * width in (0, 1)
    parts = [shown[0][-height:, k * width : (k + 1) * width].astype(int) for k in range(4)]
    assert np.abs(parts[1] - parts[0]).mean() < 0.7 * np.abs(parts[0] - 255).mean()  # the render looks like the input
    assert np.abs(parts[3] - parts[1]).mean() > 0.5  # doubled codes do something
    assert cv2.imread(str(paths["sheet"])).shape[1] > 4 * width


def test_sheet(made: dict[str, Path], tmp_path: Path) -> None:
    paths = outputs(tmp_path, "sheet", "sheet", "folder", "report")
    sheet.run(job(SheetConfig(**FAST), made, paths))
    report = checked(paths, made["avatar"])
    shows = {entry["frame"]: entry["shows"] for entry in report["frames"]}
    words = ", ".join(shows.values())
    assert all(word in words for word in ("calm", "most expressive", "turned to the left", "turned to the right"))
    assert "mouth" not in words and set(shows) <= set(range(6, 12))  # this head model has no lips
    assert sorted(path.name for path in paths["folder"].iterdir()) == sorted(f"frame_{frame:05d}.png" for frame in shows)
    one = cv2.imread(str(next(paths["folder"].iterdir())))
    assert one.shape[1] == 7 * report["size"][1] + 8 * 6 and report["size"][0] == report["crop"]["height"]
    assert all(entry["l1"] < 0.2 and entry["part"] == "test frame" for entry in report["frames"])
    more = outputs(tmp_path / "more", "sheet", "sheet", "folder", "report")
    sheet.run(job(SheetConfig(frames=(2, 7), size=20, **FAST), made, more))
    asked = json.loads(more["report"].read_text())
    assert [entry["part"] for entry in asked["frames"]] == ["training frame", "test frame"] and max(asked["size"]) == 20
    with pytest.raises(StepError, match=r"sheet.frames: there is no frame 12"):
        sheet.run(job(SheetConfig(frames=(12,), **FAST), made, more))


def test_animate(made: dict[str, Path], tmp_path: Path) -> None:
    paths, file = outputs(tmp_path, "animate", "video", "report"), tmp_path / "wave.csv"
    file.write_text("bump0,rotation_y\n0.5,0\n3,0.5\n")
    inputs = made | {"file": file}
    animate.run(job(AnimateConfig(file="wave.csv", fps=12, size=32, **FAST), inputs, paths))
    report = checked(paths, made["avatar"])
    assert report["frames"] == 2 and report["fps"] == 12 and report["columns"] == ["bump0", "rotation_y"]
    assert report["beyond_training"]["bump0"]["farthest"] == 3 and report["beyond_training"]["bump0"]["frames"] == 0.5
    shown = frames_of(paths["video"])
    assert len(shown) == 2 and np.abs(shown[0].astype(int) - shown[1]).mean() > 1
    file.write_text("bmup0\n0\n")
    with pytest.raises(StepError, match=r"wave.csv: the column bmup0 is not known; did you mean bump0\?"):
        animate.run(job(AnimateConfig(file="wave.csv", size=32, **FAST), inputs, paths))
    file.write_text("bump0,translation_z\n0,-1\n")
    with pytest.raises(StepError, match="behind the camera"):
        animate.run(job(AnimateConfig(file="wave.csv", size=32, **FAST), inputs, paths))
    with pytest.raises(StepError, match="there is no such file"):
        animate.run(job(AnimateConfig(file="no.csv", size=32, **FAST), made | {"file": tmp_path / "no.csv"}, paths))


def test_a_track_written_as_a_parameter_file_drives_as_the_track_does(made: dict[str, Path], tmp_path: Path) -> None:
    track = dict(np.load(made["track"]))
    few = {name: value[6:8] if value.ndim and len(value) == 12 else value for name, value in track.items()}
    np.savez(tmp_path / "few.npz", **few)
    head = toy_head(24, 36)
    parameters.write(tmp_path / "few.csv", motion.of_track(few, range(2), 25.0), head.expression_names, False)
    shown = []
    for name in ("few.npz", "few.csv"):
        paths = outputs(tmp_path / name.replace(".", "_"), "animate", "video", "report")
        animate.run(job(AnimateConfig(file=name, size=32, **FAST), made | {"file": tmp_path / name}, paths))
        shown.append(frames_of(paths["video"]))
    np.testing.assert_array_equal(shown[0], shown[1])


def test_videos_of_test_frames_say_what_they_are(made: dict[str, Path], tmp_path: Path) -> None:
    paths = {"render": tmp_path / "test.npy", "report": tmp_path / "render.json", "video": tmp_path / "test.mp4"}
    render.run(job(RenderConfig(max_frames=1, sample_factor=1), made, paths))
    provenance.check(paths["video"], made["avatar"])
    for predictor in ("mean_frame", "nearest_frame"):
        baseline.run(job(BaselineConfig(predictor=predictor, max_frames=1), made, paths))
        assert provenance.read_comment(paths["video"]) == provenance.FILMED


def test_half_data_is_the_first_half(tmp_path: Path) -> None:
    split, half = tmp_path / "split.json", tmp_path / "half.json"
    split.write_text(json.dumps({"train": [0, 1, 2, 4, 5], "test": [7, 8]}))
    half_data.run(job(HalfDataConfig(), {"split": split}, {"half": half}))
    found = json.loads(half.read_text())
    assert found["train"] == [0, 1, 2] and found["test"] == [7, 8]
    split.write_text(json.dumps({"train": [0, 1], "test": [7]}))
    with pytest.raises(StepError, match="2 training frames have no half"):
        half_data.run(job(HalfDataConfig(), {"split": split}, {"half": half}))


def looks(**values: object) -> choose.Looks:
    count = 40
    base = {name: np.zeros(count) for name in ("mouth", "gaze_rad", "yaw_rad", "pitch_rad")}
    base |= {"strength_mm": np.linspace(1, 2, count), "lids": np.full(count, 0.3)}
    return choose.Looks(**base | values)


def test_calm_is_weak_with_open_eyes_that_look_ahead() -> None:
    strength, lids, gaze = np.linspace(1, 2, 40), np.full(40, 0.3), np.zeros(40)
    lids[0], gaze[1] = 0.1, 0.4  # weaker still, but shut; weaker, but looking aside
    lids[[5, 6]], gaze[[7, 8]] = 0.1, 0.4
    assert choose.calm(looks(strength_mm=strength, lids=lids, gaze_rad=gaze)) == 2
    lids = np.where(np.arange(40) < 20, 0.1, 0.3)
    assert choose.calm(looks(lids=lids)) == 20
    assert choose.calm(looks(lids=np.full(40, np.nan))) == 0


def test_expressive_frames_are_apart_and_not_blinks() -> None:
    strength, lids = np.ones(40), np.full(40, 0.3)
    strength[[3, 4, 20, 30]] = [5, 6, 4, 9]
    lids[30], lids[:12] = 0.05, 0.31
    lids[31:] = 0.2
    assert choose.most_expressive(looks(strength_mm=strength, lids=lids), 2, 5) == [4, 20]


def test_liveliest_stretch_avoids_gaps() -> None:
    strength = np.ones(40)
    strength[18:24], strength[30:34] = 5, 4
    numbers = [*range(20), *range(25, 45)]  # five frames could not be tracked after the twentieth
    assert choose.liveliest(looks(strength_mm=strength), numbers, 4, 1) == [20, 21, 22, 23]
    assert choose.liveliest(looks(strength_mm=strength), list(range(40)), 3, 2) == [18, 20, 22]
    assert choose.liveliest(looks(), list(range(40)), 100, 3) == list(range(0, 40, 3))
