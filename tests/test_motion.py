"""Motions: taken, scaled and smoothed; rotations against scipy's own mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from toy_head import toy_head, toy_track

from avatar.uses import motion
from avatar.uses.motion import PARTS, TURNS, Motion
from fitting.camera import exp_rotation, log_rotation


def made(count: int = 12, seed: int = 0) -> Motion:
    random = np.random.default_rng(seed)
    size = {"expression": (3,), "eyes": (2, 3)}
    return Motion(**{name: random.normal(size=(count, *size.get(name, (3,)))) * 0.3 for name in PARTS}, fps=30.0)


def test_of_track_takes_frames_in_order_and_names_what_is_wrong() -> None:
    track = toy_track(toy_head(6, 8), 6)
    found = motion.of_track(track, [4, 1], 25.0)
    assert len(found) == 2 and found.fps == 25.0 and found.rotation.dtype == np.float64
    np.testing.assert_array_equal(found.rotation, track["rotation"][[4, 1]])
    with pytest.raises(ValueError, match="lacks jaw"):
        motion.of_track({name: track[name] for name in track if name != "jaw"}, [0], 25.0)
    track["eyes"][1, 0, 2] = np.nan
    with pytest.raises(ValueError, match="eyes of frame 1 is not finite"):
        motion.of_track(track, [4, 1], 25.0)
    motion.of_track(track, [4, 2], 25.0)


def test_shapes_and_frame_rate_are_checked() -> None:
    with pytest.raises(ValueError, match=r"jaw of a motion must have shape \(12, 3\), found \(11, 3\)"):
        replace(made(), jaw=np.zeros((11, 3)))
    for fps in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="frames a second"):
            replace(made(), fps=fps)


def test_scaled_doubles_codes_and_the_jaws_angle_and_nothing_else() -> None:
    own, double = made(), motion.scaled(made(), 2.0)
    np.testing.assert_allclose(double.expression, 2 * own.expression)
    angle = np.linalg.norm(log_rotation(exp_rotation(own.jaw)), axis=1)
    np.testing.assert_allclose(np.linalg.norm(log_rotation(exp_rotation(double.jaw)), axis=1), 2 * angle)
    for name in ("rotation", "neck", "eyes", "translation"):
        np.testing.assert_array_equal(getattr(double, name), getattr(own, name))
    np.testing.assert_array_equal(motion.scaled(own, 1.0).expression, own.expression)


def test_smoothing_keeps_a_still_head_and_is_off_at_zero() -> None:
    still = motion.held(made(), 3, 20)
    for name in PARTS:
        np.testing.assert_allclose(getattr(motion.smoothed(still, 0.2), name), getattr(still, name), atol=1e-12, err_msg=name)
    own = made()
    assert motion.smoothed(own, 0) is own and motion.smoothed(own.take([0]), 1.0).expression.shape == (1, 3)
    for seconds in (-0.1, np.nan, np.inf):
        with pytest.raises(ValueError, match="0 seconds or more"):
            motion.smoothed(own, seconds)


def test_smoothing_is_a_weighted_mean_of_the_rotations() -> None:
    """Against scipy's chordal mean with the Gaussian's own weights, in the middle of a clip, where no end is held."""
    own, sigma = made(41), 2.0
    low = motion.smoothed(own, sigma / own.fps)
    weight = np.exp(-0.5 * (np.arange(-8, 9) / sigma) ** 2)
    for name in TURNS:
        vectors = getattr(own, name)[12:29].reshape(17, -1, 3)
        expected = [Rotation.from_rotvec(vectors[:, k]).mean(weight).as_rotvec() for k in range(vectors.shape[1])]
        np.testing.assert_allclose(getattr(low, name)[20].reshape(-1, 3), expected, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(low.expression[20], (weight[:, None] * own.expression[12:29]).sum(0) / weight.sum(), atol=1e-9)


def test_a_head_that_turns_past_half_a_turn_is_not_thrown_around() -> None:
    """Axis-angle vectors jump from +pi to -pi there; their plain mean would be a head that looks forward."""
    angle = np.linspace(np.pi - 0.2, np.pi + 0.2, 21)
    vectors = log_rotation(exp_rotation(np.stack([0 * angle, angle, 0 * angle], 1)))
    low = motion.smoothed(replace(made(21), rotation=vectors), 0.1)
    turned = Rotation.from_rotvec(low.rotation[10]).magnitude()
    assert turned == pytest.approx(np.pi, abs=1e-6)


def test_smoothing_lowers_jitter_and_leaves_slow_motion() -> None:
    time = np.arange(90) / 30
    slow = 0.3 * np.sin(2 * np.pi * 0.3 * time)
    noisy = slow + np.random.default_rng(1).normal(size=90) * 0.02
    vectors = np.stack([0 * time, noisy, 0 * time], 1)
    low = motion.smoothed(replace(made(90), rotation=vectors), 0.1).rotation[:, 1]
    assert np.abs(np.diff(low, 2)).mean() < 0.1 * np.abs(np.diff(noisy, 2)).mean()
    assert np.abs(low - slow)[10:-10].max() < 0.03


def test_some_frames_of_a_motion() -> None:
    own = made()
    some = own.take([6, 0, 6], fps=5.0)
    assert len(some) == 3 and some.fps == 5.0 and own.take([1]).fps == own.fps
    for name in PARTS:
        np.testing.assert_array_equal(getattr(some, name), getattr(own, name)[[6, 0, 6]])


def test_nearest_rotation_is_one_even_of_a_reflection() -> None:
    random = np.random.default_rng(0)
    matrices = random.normal(size=(50, 3, 3))
    found = motion.nearest_rotation(matrices)
    np.testing.assert_allclose(np.linalg.det(found), 1, atol=1e-9)
    np.testing.assert_allclose(found @ found.transpose(0, 2, 1), np.tile(np.eye(3), (50, 1, 1)), atol=1e-9)
    worse = Rotation.random(200, random_state=1).as_matrix()
    for matrix, best in zip(matrices[:5], found[:5], strict=True):
        assert np.linalg.norm(matrix - best) <= np.linalg.norm(matrix - worse, axis=(1, 2)).min()
