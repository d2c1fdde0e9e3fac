"""Driving: what is carried from one fit of a head to another, and the step on a toy avatar."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toy_head import toy_head, toy_track
from toy_run import job, train_in, write_subject

from avatar import provenance
from avatar.uses import drive, drive_split, motion, retarget
from avatar.uses.config import DriveSplitConfig, DriveStepConfig
from avatar.uses.motion import PARTS, Motion
from fitting.video import inspect, read_frames
from workflow.step import StepError

HEAD = toy_head()
SHAPE = np.array([0.4, -0.7])


def walk(frames: int = 40, seed: int = 3) -> Motion:
    return motion.of_track(toy_track(HEAD, frames, seed=seed), range(frames), 25.0)


def carried_over(moved: Motion, source: retarget.Rest, target: retarget.Rest, use: retarget.Use = "both") -> Motion:
    return retarget.transferred(HEAD, SHAPE, moved, source, target, retarget.face_centres(HEAD, SHAPE, moved), use)


def test_a_clip_that_drives_itself_moves_as_it_did() -> None:
    own = walk()
    rest = retarget.rest_of(HEAD, SHAPE, own)
    offset = retarget.same_face(HEAD, SHAPE, SHAPE)
    np.testing.assert_allclose(offset, 0, atol=1e-9)
    moved = retarget.transferred(HEAD, SHAPE, own, rest, rest, retarget.face_centres(HEAD, SHAPE, own), "both", offset)
    for name in PARTS:
        np.testing.assert_allclose(getattr(moved, name), getattr(own, name), atol=2e-7, err_msg=name)


def test_what_one_fit_takes_for_identity_the_other_says_by_expression() -> None:
    """A shape code that is an action: the fit that gave 0.3 of it to identity has codes that are 0.3 too small."""
    head = replace(HEAD, shape_basis=HEAD.expression_basis[1:] * 1.0)
    offset = retarget.same_face(head, np.array([0.3, 0.0]), np.zeros(2))
    np.testing.assert_allclose(offset, [0, 0.3, 0], atol=0.1)  # small codes are preferred
    own = walk()
    rest = replace(retarget.rest_of(head, np.zeros(2), own), expression=np.array([0.1, 0.2, 0.1]))
    centres = retarget.face_centres(head, np.zeros(2), own)
    moved = retarget.transferred(head, np.zeros(2), own, rest, rest, centres, offset=np.array([0.0, 0.3, -0.4]))
    at_rest, acted = own.expression[:, 1] <= 0.2, own.expression[:, 1] > 0.2
    np.testing.assert_allclose(moved.expression[at_rest, 1], own.expression[at_rest, 1] + 0.3)
    np.testing.assert_allclose(moved.expression[acted, 1], 1 - (1 - own.expression[acted, 1]) * 0.5 / 0.8)  # the end stays
    assert moved.expression.min() >= 0 and (moved.expression[own.expression[:, 2] < 0.1, 2] < 1e-9).all()
    np.testing.assert_array_equal(moved.expression[:, 0], own.expression[:, 0])
    np.testing.assert_array_equal(moved.eyes, own.eyes)


@pytest.mark.parametrize("size, focal", [(1.0, 1.6), (1.3, 1.0), (0.8, 0.5)])
def test_size_and_focal_length_of_the_driver_count_nothing(size: float, focal: float) -> None:
    """A fit that takes the head for larger puts it further away, and so does one that takes the lens for longer."""
    own = walk()
    rest, centres = retarget.rest_of(HEAD, SHAPE, own), retarget.face_centres(HEAD, SHAPE, own)
    other = replace(rest, size_m=size * rest.size_m, centre_m=rest.centre_m * (size, size, size * focal))
    np.testing.assert_allclose(retarget.places(centres * (size, size, size * focal), other, rest), centres, atol=1e-9)


def test_the_face_goes_where_it_should_whatever_the_head_does() -> None:
    driver, subject = walk(), walk(seed=8)
    source, target = retarget.rest_of(HEAD, SHAPE, driver), retarget.rest_of(HEAD, -SHAPE, subject)
    target = replace(target, centre_m=np.array([0.05, -0.02, 0.6]), size_m=2 * source.size_m)
    centres = retarget.face_centres(HEAD, SHAPE, driver)
    moved = retarget.transferred(HEAD, -SHAPE, driver, source, target, centres)
    found = retarget.face_centres(HEAD, -SHAPE, moved)
    np.testing.assert_allclose(found, retarget.places(centres, source, target), atol=1e-6)
    np.testing.assert_allclose(np.median(found[:, 2]), 0.6, atol=1e-6)
    np.testing.assert_allclose(found[:, 0] - 0.05, 2 * (centres[:, 0] - source.centre_m[0]), atol=1e-6)  # in head sizes
    np.testing.assert_array_equal(moved.rotation, driver.rotation)


def test_pose_alone_and_expression_alone() -> None:
    driver, subject = walk(), walk(seed=8)
    source, target = retarget.rest_of(HEAD, SHAPE, driver), retarget.rest_of(HEAD, SHAPE, subject)
    both, pose, expression = (carried_over(driver, source, target, use) for use in ("both", "pose", "expression"))
    for name in ("expression", "jaw", "eyes"):
        np.testing.assert_array_equal(getattr(expression, name), getattr(both, name))
        np.testing.assert_array_equal(getattr(pose, name), np.repeat(getattr(target, name)[None], len(driver), 0))
    np.testing.assert_array_equal(pose.rotation, driver.rotation)
    np.testing.assert_allclose(
        retarget.face_centres(HEAD, SHAPE, pose), retarget.face_centres(HEAD, SHAPE, both), atol=1e-6
    )  # translations differ where the root joint follows the expression
    np.testing.assert_array_equal(expression.rotation, np.repeat(target.rotation[None], len(driver), 0))
    assert target.rotation.tolist() in subject.rotation.tolist()
    np.testing.assert_allclose(retarget.face_centres(HEAD, SHAPE, expression), target.centre_m[None].repeat(40, 0), atol=1e-6)


def test_codes_keep_the_ends_of_their_range() -> None:
    low, high = np.array([0.0, 0.0, -np.inf]), np.array([1.0, 1.0, np.inf])
    source, target = np.array([0.3, 0.1, 0.5]), np.array([0.1, 0.4, -0.2])
    codes = np.linspace(0, 1, 11)[:, None].repeat(3, 1)
    moved = retarget.carried(codes, source, target, low, high)
    np.testing.assert_allclose(moved[-1, :2], 1.0)  # a shut eye is shut
    np.testing.assert_allclose(moved[0], [0.0, 0.3, -0.7])  # below the rest nothing is stretched
    np.testing.assert_allclose(moved[:, 2], codes[:, 2] - 0.7, atol=1e-12)
    np.testing.assert_allclose(retarget.carried(source[None], source, target, low, high)[0], target)
    assert (np.diff(moved, axis=0) > 0).all() and (moved[:, :2] >= 0).all() and (moved[:, :2] <= 1).all()
    np.testing.assert_allclose(retarget.carried(codes, source, source, low, high), codes, atol=1e-12)


def test_codes_at_the_end_of_their_range_are_not_stretched_without_bound() -> None:
    source, target = np.array([1.0, 0.9, 0.0]), np.array([0.2, 0.0, 0.3])
    low, high = np.zeros(3), np.ones(3)
    moved = retarget.carried(np.array([[1.01, 1.0, -0.01], [0.0, 0.0, 1.0]]), source, target, low, high)
    assert np.isfinite(moved).all() and moved[0, 0] - target[0] <= 0.0201 and moved[0, 1] == pytest.approx(0.2)
    np.testing.assert_allclose(moved[1], [0.0, 0.0, 1.0])


def test_the_rest_of_a_talking_face_that_the_fit_explains_by_expression() -> None:
    """Half of the frames talk, some blink, some look away with codes that are wrong there; one action never stops."""
    random = np.random.default_rng(0)
    frames = 200
    own = walk(frames)
    codes = np.zeros((frames, 3)) + np.array([0.45, 0.1, 0.0]) + random.normal(0, 0.01, (frames, 3))
    codes[::2, 1] += random.uniform(0.2, 0.9, frames // 2)
    codes[random.choice(frames, 20), 2] = 1.0
    turned = own.rotation * 0.1
    turned[150:, 1], codes[150:] = 1.2, [0.0, 0.0, 0.6]
    own = replace(own, expression=codes, rotation=turned, eyes=np.full((frames, 2, 3), 0.2))
    rest = retarget.rest_of(HEAD, SHAPE, own)
    np.testing.assert_allclose(rest.expression, [0.45, 0.1, 0.0], atol=0.02)
    np.testing.assert_allclose(rest.eyes, 0.2)
    assert max(rest.frames) < 150 and len(rest.frames) >= 5
    with pytest.raises(ValueError, match="no usable frame"):
        retarget.rest_of(HEAD, SHAPE, own.take([]))


def test_lost_frames_are_bridged_before_anything_is_smoothed() -> None:
    own = walk(9)
    broken = replace(own, translation=own.translation + np.where(np.arange(9) == 4, 50.0, 0.0)[:, None])
    usable = np.arange(9) != 4
    smooth = motion.smoothed(retarget.bridged(broken, usable), 0.04)
    assert np.abs(smooth.translation).max() < 1
    some = [False, True, False, False, False, True, False, False, False]
    assert retarget.bridged(own, some).jaw.tolist() == own.jaw[[1, 1, 1, 1, 5, 5, 5, 5, 5]].tolist()
    with pytest.raises(ValueError, match="none of the frames is usable"):
        retarget.bridged(own, np.zeros(9, bool))


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A subject with an avatar, and itself as the driver."""
    folder = tmp_path_factory.mktemp("drive")
    inputs = write_subject(folder, frames=10)
    inputs["index"].write_text(json.dumps({"fps": 25, "size": [40, 40]}))
    inputs["avatar"] = train_in(folder / "toy", inputs, steps=3)["avatar"]
    return inputs | {f"driver_{name}": inputs[name] for name in ("track", "frames", "index")}


def drive_in(folder: Path, inputs: dict[str, Path], **keys: object) -> dict[str, Path]:
    outputs = {"video": folder / "drive.mp4", "strip": folder / "strip.png", "report": folder / "drive.json"}
    drive.run(job(DriveStepConfig(**{"size": 24, "max_frames": 4, "driver": "second"} | keys), inputs, outputs))
    return outputs


def changed(toy: dict[str, Path], folder: Path, **arrays: np.ndarray) -> dict[str, Path]:
    """The inputs with another driver: some arrays of the track replaced."""
    with np.load(toy["track"]) as file:
        np.savez(folder / "driver.npz", **({name: file[name] for name in file.files} | arrays))
    return toy | {"driver_track": folder / "driver.npz"}


def test_the_step(toy: dict[str, Path], tmp_path: Path) -> None:
    usable = np.arange(10) != 3
    shape = np.load(toy["track"])["shape"] + np.float32(0.1)
    outputs = drive_in(tmp_path, changed(toy, tmp_path, usable=usable, shape=shape), max_frames=3)
    report = json.loads(outputs["report"].read_text())
    assert report["frames"] in ([4, 6, 8], [5, 7, 9]) and report["left_out"]["count"] == 1  # frame 3 is in no stretch
    assert report["fps"] == 12.5
    assert report["identity"]["verdict"] == "same" and report["identity"]["distance"] == pytest.approx(0.1, abs=1e-4)
    assert set(report["identity"]["distances"]) == {"codes", "face_mm", "head_mm"}
    assert report["synthetic"] and report["renders"] == 6
    provenance.check(outputs["video"], toy["avatar"])
    pictures = [frame.rgb() for frame in read_frames(outputs["video"])]
    assert len(pictures) == 3 and pictures[0].shape[1] > 4 * 24
    assert inspect(outputs["video"]).fps == pytest.approx(12.5, rel=0.01)
    assert outputs["strip"].stat().st_size > 1000


def test_all_usable_frames_at_full_rate(toy: dict[str, Path], tmp_path: Path) -> None:
    usable = np.arange(10) != 3
    report = json.loads(drive_in(tmp_path, changed(toy, tmp_path, usable=usable), max_frames=None)["report"].read_text())
    assert report["frames"] == np.flatnonzero(usable).tolist() and report["fps"] == 25


def test_another_person_is_refused_unless_allowed(toy: dict[str, Path], tmp_path: Path) -> None:
    other = changed(toy, tmp_path, shape=np.load(toy["track"])["shape"] + np.float32(0.5))
    with pytest.raises(StepError, match=r"second and subject toy differ by 0\.50 .*two people.*drivers\.second\.allow_other"):
        drive_in(tmp_path, other)
    assert not (tmp_path / "drive.mp4").exists()
    report = json.loads(drive_in(tmp_path, other, allow_other_identity=True, max_frames=1)["report"].read_text())
    assert report["identity"]["verdict"] == "other" and report["identity"]["allow_other_identity"]
    report = json.loads(drive_in(tmp_path, other, identity_limit=0.6, max_frames=1)["report"].read_text())
    assert report["identity"]["verdict"] == "doubtful"


def test_a_limit_of_another_head_model_is_warned_of(
    toy: dict[str, Path], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    words = "the limit is that of head model anny, not of toy: set drive.identity_limit"
    found = []
    for keys in ({}, {"identity_limit": 0.4}):
        drive_in(tmp_path, toy, max_frames=1, **keys)
        found.append(words in caplog.text)
        caplog.clear()
    assert found == [True, False]


def test_a_driver_that_cannot_drive(toy: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(StepError, match="belongs to head model abc, the avatar to toy"):
        drive_in(tmp_path, changed(toy, tmp_path, head_digest=np.array("abc")))
    with pytest.raises(StepError, match="none of the frames is usable; use another driving video"):
        drive_in(tmp_path, changed(toy, tmp_path, usable=np.zeros(10, bool)))
    with pytest.raises(StepError, match="translation of frame 0 is not finite"):
        drive_in(tmp_path, changed(toy, tmp_path, translation=np.full((10, 3), np.nan, np.float32)))


def test_the_viewpoint_swings_to_both_sides_and_ends_ahead() -> None:
    yaw = np.degrees(drive.swing(33, 25.0))
    assert yaw.max() == pytest.approx(25) and yaw.min() == pytest.approx(-25)
    assert yaw[[0, -1]] == pytest.approx(0) and drive.swing(1, 25.0).tolist() == [0.0]


def test_the_split_of_a_driving_video(tmp_path: Path) -> None:
    found = np.ones(20, bool)
    found[[4, 15, 18, 19]] = False
    train, test = drive_split.driver_split(found)
    assert train == list(range(13)) and test == list(range(13, 20)) and found[test].sum() == 4
    with pytest.raises(ValueError, match="found in 4 of 20 frames"):
        drive_split.driver_split(np.arange(20) < 4)
    np.savez(tmp_path / "landmarks.npz", found=found)
    one = job(DriveSplitConfig(), {"landmarks": tmp_path / "landmarks.npz"}, {"split": tmp_path / "split.json"})
    drive_split.run(one)
    assert json.loads((tmp_path / "split.json").read_text())["test"] == test
