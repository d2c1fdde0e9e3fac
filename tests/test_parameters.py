"""The parameter file: round trips, rest, times, ARKit's names, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toy_head import toy_head, toy_track

from avatar.uses import parameters
from avatar.uses.motion import PARTS, Motion, of_track
from avatar.uses.parameters import ParameterError
from fitting.camera import exp_rotation
from fitting.head_model import HeadModel

HEAD = replace(toy_head(6, 8), expression_names=("jawOpen", "browInnerUp", "cheekPuff"))


def rest() -> Motion:
    zeros = np.zeros((1, 3))
    return Motion(np.zeros((1, 3)), zeros, zeros, zeros, np.zeros((1, 2, 3)), np.array([[0.01, 0.02, 0.7]]), 30.0)


def read(path: Path, text: str | None = None, fps: float = 30.0, head: HeadModel = HEAD) -> parameters.Parameters:
    if text is not None:
        path.write_text(text)
    return parameters.read(path, head, rest(), fps)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "wave.csv"


@pytest.mark.parametrize("timed", [False, True])
def test_a_track_comes_back_from_csv_as_it_was(file: Path, timed: bool) -> None:
    track = toy_track(HEAD, 9)
    track["eyes"] = np.random.default_rng(0).normal(size=(9, 2, 3)).astype(np.float32) * 0.2
    motion = of_track(track, range(9), 25.0)
    parameters.write(file, motion, HEAD.expression_names, timed)
    back = read(file, fps=25.0)
    assert len(back.motion) == 9 and back.motion.fps == 25.0
    for name in PARTS:
        got = getattr(back.motion, name)
        if timed:  # turned through matrices and back
            np.testing.assert_allclose(got, track[name], atol=1e-6, err_msg=name)
        else:
            np.testing.assert_array_equal(got.astype(np.float32), track[name], err_msg=name)


def test_a_track_itself_is_a_parameter_file(tmp_path: Path) -> None:
    track = toy_track(HEAD, 5)
    path = tmp_path / "track.npz"
    np.savez(path, **track)
    motion = read(path).motion
    for name in PARTS:
        np.testing.assert_array_equal(getattr(motion, name), track[name])
    np.savez(path, **track | {"head_digest": np.array("another")})
    with pytest.raises(ParameterError, match="a track of head model another"):
        read(path)


def test_command_writes_a_track_as_a_file(tmp_path: Path, file: Path, capsys: pytest.CaptureFixture) -> None:
    track = toy_track(HEAD, 4)
    np.savez(tmp_path / "track.npz", **track)
    HEAD.save(tmp_path / "head.npz")
    assert parameters.main([str(tmp_path / "track.npz"), str(tmp_path / "head.npz"), str(file), "25"]) == 0
    assert file.read_text().startswith("time_s,jawOpen,browInnerUp,cheekPuff,rotation_x")
    np.testing.assert_allclose(read(file, fps=25.0).motion.rotation, track["rotation"], atol=1e-6)
    assert parameters.main([str(tmp_path / "no.npz"), str(tmp_path / "head.npz"), str(file)]) == 1
    assert parameters.main([]) == 2 and "usage" in capsys.readouterr().err


def test_what_is_not_named_rests(file: Path) -> None:
    motion = read(file, "browInnerUp,eye_right_y,translation_z\n0.5,0.1,0.6\n0.6,0.2,0.6\n").motion
    np.testing.assert_array_equal(motion.expression, [[0, 0.5, 0], [0, 0.6, 0]])
    np.testing.assert_array_equal(motion.translation, [[0.01, 0.02, 0.6]] * 2)
    np.testing.assert_array_equal(motion.eyes, [[[0, 0, 0], [0, 0.1, 0]], [[0, 0, 0], [0, 0.2, 0]]])
    assert not motion.rotation.any() and not motion.neck.any() and not motion.jaw.any()


def test_npz_of_named_arrays(tmp_path: Path) -> None:
    path = tmp_path / "wave.npz"
    np.savez(path, jawOpen=np.array([0.1, 0.2, 0.3]), rotation_y=np.array([0, 0.1, 0.2]))
    motion = read(path).motion
    np.testing.assert_allclose(motion.expression[:, 0], [0.1, 0.2, 0.3])
    np.savez(path, jawOpen=np.zeros(3), rotation_y=np.zeros(4))
    with pytest.raises(ParameterError, match=r"as many as the others; found \(3,\), \(4,\)"):
        read(path)
    np.savez(path, jawOpen=np.zeros((3, 2)))
    with pytest.raises(ParameterError, match="one number a frame"):
        read(path)
    whole = path.read_bytes()
    for content in (b"no archive", b"", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(ParameterError, match="not readable as NPZ"):
            read(path)
    with open(path, "wb") as file:
        np.save(file, np.zeros((3, 2)))
    with pytest.raises(ParameterError, match="one array without a name"):
        read(path)


def test_times_are_resampled_and_rotations_turn_the_short_way(file: Path) -> None:
    motion = read(file, "time_s,jawOpen,rotation_y\n10,0,3.1\n10.5,1,-3.1\n", fps=8.0).motion
    np.testing.assert_allclose(motion.expression[:, 0], [0, 0.25, 0.5, 0.75, 1.0])
    turned = exp_rotation(motion.rotation)
    way = np.arccos(np.clip((np.einsum("tij,tij->t", turned[1:], turned[:-1]) - 1) / 2, -1, 1))
    np.testing.assert_allclose(way.sum(), 2 * np.pi - 6.2, atol=1e-6)  # 5 degrees, not 355 back
    assert len(read(file, "time_s,jawOpen\n3,0.5\n").motion) == 1
    assert len(read(file, "time_s,jawOpen\n0,0\n0.11,1\n", fps=10.0).motion) == 2  # never beyond the last row
    with pytest.raises(ParameterError, match="33 s apart; if these are milliseconds"):
        read(file, "time_s,jawOpen\n0,0\n33,1\n66,1\n")
    with pytest.raises(ParameterError, match="row 3 of column time_s is 1, not after the row before it"):
        read(file, "time_s,jawOpen\n0,0\n1,0\n1,0\n")


def test_live_link_face_names(file: Path) -> None:
    header = "Timecode,BlendshapeCount,EyeLookInLeft,JawOpen,BrowInnerUp,CheekPuff,TongueOut,HeadYaw,LeftEyePitch\n"
    found = read(file, "\ufeff" + header + "09:01:02:03.500,61,0.1,0.2,0.3,0.4,0.5,0.6,0.7\n")
    np.testing.assert_allclose(found.motion.expression, [[0.2, 0.3, 0.4]])
    assert found.left_out == ("Timecode", "BlendshapeCount", "EyeLookInLeft", "TongueOut", "HeadYaw", "LeftEyePitch")
    assert not found.motion.rotation.any() and not found.motion.eyes.any()
    with pytest.raises(ParameterError, match="HeadYaw is not known"):  # not Live Link's file: the name means nothing here
        read(file, "jawOpen,HeadYaw\n0,0\n")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("jawopne\n0\n", "the column jawopne is not known; did you mean jawOpen?"),
        ("rotation_yaw\n0\n", "did you mean rotation_"),
        ("qqqq\n0\n", "known are time_s, jawOpen"),
        ("jawOpen,JAWOPEN\n0,0\n", "the column JAWOPEN is there twice"),
        ("jawOpen,browInnerUp\n0,0\n0,nan\n", "row 2 of column browInnerUp is nan"),
        ("jawOpen\n0\ninf\n", "row 2 of column jawOpen is inf"),
        ("jawOpen,browInnerUp\n0,\n", "line 2, column browInnerUp: '' is not a number"),
        ("jawOpen,browInnerUp\n0,0\n1\n", "line 3 has 1 cells, the header 2"),
        ("jawOpen\n", "one number a frame"),
        ("", "the file is empty"),
    ],
)
def test_refused(file: Path, text: str, words: str) -> None:
    with pytest.raises(ParameterError) as caught:
        read(file, text)
    assert words in str(caught.value)


def test_bytes_that_are_no_text_are_refused(file: Path) -> None:
    file.write_bytes(b"jawOpen\n\xff\xfe\n")
    with pytest.raises(ParameterError, match="not readable as CSV"):
        read(file)
    with pytest.raises(FileNotFoundError):
        read(file.with_name("none.csv"))
