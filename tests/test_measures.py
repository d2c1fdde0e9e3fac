"""Seams and jitter of motions whose values are known."""

from dataclasses import replace

import numpy as np
import pytest

from fitting import camera, measures
from fitting.state import neutral
from tests.landmarked import landmarked_head, model_of, random_state

USABLE = np.ones(12, bool)


@pytest.fixture(scope="module")
def made():
    return model_of(landmarked_head())


def still(model, frames=12):
    return neutral(model, frames, 6.0)


def test_points_are_every_fortieth_vertex_posed(made):
    rig, model = made
    points = measures.points_m(rig, still(model, 2))
    np.testing.assert_allclose(points, np.tile(rig.template[:: measures.EVERY] + [0, 0, 0.5], (2, 1, 1)))
    state = random_state(model, 2)
    shaped = measures.points_m(rig, state)
    assert shaped.shape == points.shape and np.abs(shaped[0] - shaped[1]).max() > 1e-4


def test_a_still_head_and_an_even_motion_have_no_jitter_and_no_seams(made):
    rig, model = made
    time = np.arange(12.0)[:, None]
    even = replace(still(model), translation=[0, 0, 0.5] + 0.001 * time * [1, 2, 3], expression=0.03 * time * np.ones(3))
    for state in (still(model), even):
        assert max(measures.jitter(rig, state, USABLE).values()) < 1e-9
        assert max(measures.seams(rig, state, np.array([4, 8]), USABLE).values()) < 1e-9
    turning = replace(still(model), rotation=camera.exp_rotation(0.02 * time * [0, 1, 0]))
    assert measures.jitter(rig, turning, USABLE)["rotation_degrees"] < 1e-9
    assert 0 < measures.jitter(rig, turning, USABLE)["vertices_mm"] < 0.05  # the circle's own bend: 0.02^2 * 0.1 m


def test_jitter_of_a_zigzag(made):
    """1 mm and 0.1 degrees to and fro: second differences of 4 mm and 0.4 degrees."""
    rig, model = made
    sign = np.where(np.arange(12) % 2, 1.0, -1.0)[:, None]
    shifted = replace(still(model), translation=[0, 0, 0.5] + 0.001 * sign * [0.6, 0.8, 0])
    assert measures.jitter(rig, shifted, USABLE) == pytest.approx({"vertices_mm": 4.0, "rotation_degrees": 0.0})
    turned = replace(still(model), rotation=camera.exp_rotation(np.radians(0.1) * sign * [0, 0.6, 0.8]))
    assert measures.jitter(rig, turned, USABLE)["rotation_degrees"] == pytest.approx(0.4)


def test_a_jump_at_a_start_is_a_seam(made):
    """A step of 5 mm and 2 degrees at frame 6 and of 9 mm at frame 9, where only 6 starts a block."""
    rig, model = made
    after = lambda frame: (np.arange(12) >= frame)[:, None]  # noqa: E731
    state = replace(
        still(model),
        translation=[0, 0, 0.5] + after(6) * [0.005, 0, 0] + after(9) * [0, 0.009, 0],
        rotation=camera.exp_rotation(after(6) * [0, 0, np.radians(2.0)]),
    )
    plain = replace(state, rotation=still(model).rotation)
    alone = replace(plain, translation=[0, 0, 0.5] + after(6) * [0.005, 0, 0])
    found = measures.seams(rig, alone, np.array([6]), USABLE)
    assert found["seam_mm"] == pytest.approx(5.0) and found["seam_degrees"] == pytest.approx(0.0, abs=1e-9)
    assert measures.seams(rig, state, np.array([6]), USABLE)["seam_degrees"] == pytest.approx(2.0)
    assert measures.seams(rig, plain, np.array([6, 9]), USABLE)["jump_mm"] == pytest.approx(9.0)
    assert found["median_mm"] < 5.0


def test_unusable_neighbours_and_short_clips_say_nothing(made):
    rig, model = made
    state = replace(still(model), translation=[0, 0, 0.5] + (np.arange(12) >= 6)[:, None] * [0.005, 0, 0])
    for broken in (4, 5, 6, 7):
        assert measures.seams(rig, state, np.array([6]), np.arange(12) != broken)["jump_mm"] == 0
    nothing = measures.seams(rig, state.frames(slice(0, 3)), np.array([1]), USABLE[:3])
    assert set(nothing.values()) == {0.0} and len(nothing) == 6
    assert measures.jitter(rig, state.frames(slice(0, 2)), USABLE[:2]) == {"vertices_mm": 0.0, "rotation_degrees": 0.0}
    assert measures.jitter(rig, state, ~USABLE) == {"vertices_mm": 0.0, "rotation_degrees": 0.0}
    assert measures.seams(rig, state, np.array([], int), USABLE)["jump_mm"] == 0.0


def test_a_head_that_sets_off_is_no_seam(made):
    """The same change of acceleration in every frame around a start: it jumps, but no more than its neighbours."""
    rig, model = made
    time = np.arange(12.0)[:, None]
    state = replace(still(model), translation=[0, 0, 0.5] + 0.001 * time**3 * [1, 0, 0])
    found = measures.seams(rig, state, np.array([6]), USABLE)
    assert found["jump_mm"] == pytest.approx(3.0) and found["seam_mm"] == pytest.approx(0.0, abs=1e-9)
