"""Stages that look at one frame at a time, on sequences with known truth: PnP, tracking in blocks, held-out check."""

from dataclasses import replace

import numpy as np
import pytest

from fitting import solver, stages
from fitting.state import neutral
from tests.landmarked import WEIGHTS, degrees_apart, detected, landmarked_head, model_of, random_state


@pytest.fixture(scope="module")
def model():
    return model_of(landmarked_head())[1]


@pytest.fixture(scope="module")
def made(model):
    truth = random_state(model, 60)
    return truth, detected(model, truth, 1.0)


def solve(problem, pose, effort):
    return solver.solve_frame(problem, pose, 6 * effort)


def tracker(model, observed, truth, actions=None, held=None, how=solve):
    actions = np.ones(3, bool) if actions is None else actions
    return stages.Tracker(
        model, observed, WEIGHTS, truth.frames(slice(0, 1)), actions, np.zeros(3) if held is None else held, how
    )


def track(model, observed, truth, rows, **options):
    """State of some frames and which started afresh."""
    poses, afresh = tracker(model, observed, truth, **options).block(rows)
    return truth.with_poses(poses), afresh


def test_pnp_finds_the_pose(model, made):
    truth, observed = made
    start = replace(neutral(model, 1, truth.log_focal), shape=truth.shape)
    state = stages.pnp(model, observed, np.arange(60), start)
    assert np.median(degrees_apart(state.rotation, truth.rotation)) < 8
    assert np.abs(state.translation[:, 2] / truth.translation[:, 2] - 1).max() < 0.25
    assert not state.expression.any() and not state.jaw.any() and not state.gaze.any()
    np.testing.assert_array_equal(state.shape, truth.shape)


def test_pnp_of_a_neutral_head_is_exact(model, made):
    truth, _ = made
    still = replace(truth, expression=0 * truth.expression, jaw=0 * truth.jaw, gaze=0 * truth.gaze)
    state = stages.pnp(model, detected(model, still, 0.0), np.arange(60), still.frames(slice(0, 1)))
    assert degrees_apart(state.rotation, truth.rotation).max() < 1e-3
    assert np.abs(state.translation - truth.translation).max() < 1e-5


@pytest.mark.parametrize("case", ["same_point", "two_clusters", "line", "mirrored"])
def test_degenerate_points_give_a_pose_not_nan(model, made, case):
    truth, observed = made
    points = observed.points[:1].copy()
    if case == "same_point":
        points[:] = [100.0, 100.0]
    elif case == "two_clusters":
        points[:] = np.where(np.arange(points.shape[1])[:, None] % 2 == 0, [50.0, 50.0], [60.0, 60.0])
    elif case == "mirrored":
        points[..., 0] = 256 - points[..., 0]
    else:
        points[..., 1] = 120.0
    state = stages.pnp(model, replace(observed, points=points), np.array([0]), neutral(model, 1, truth.log_focal))
    assert np.isfinite(state.rotation).all() and np.isfinite(state.translation).all()
    assert state.translation[0, 2] > 0.05 and state.rotation[0, 2, 2] > 0


def test_tracking_recovers_the_truth(model, made):
    truth, observed = made
    state, afresh = track(model, observed, truth, np.arange(60))
    assert degrees_apart(state.rotation, truth.rotation).max() < 1.0
    assert np.median(stages.reprojection_px(model, observed, np.arange(60), state)) < 1.6  # the noise itself is 1.41 px
    assert np.abs(state.expression - truth.expression).mean() < 0.12
    assert np.abs(state.gaze - truth.gaze).mean() < 0.06
    assert np.flatnonzero(afresh).tolist() == [0]
    held_out = stages.held_out_px(tracker(model, observed, truth), np.arange(0, 60, 10), state.frames(np.arange(0, 60, 10)), 2)
    assert 1.2 < np.median(held_out) < 1.7


def test_reprojection_is_the_root_mean_square(model, made):
    truth, observed = made
    off = replace(observed, points=detected(model, truth, 0.0).points + [3.0, 4.0], inside=observed.inside.copy())
    off.points[2, :40] += 1000
    off.inside[2, :40] = False
    np.testing.assert_allclose(stages.reprojection_px(model, off, np.arange(5), truth.frames(slice(0, 5))), 5.0)


def test_held_out_landmarks_are_not_read(model, made):
    """Spoiling the held-out fifth changes its error and nothing else: the other four fifths place the frame."""
    truth, observed = made
    rows = np.array([7])
    held = np.random.default_rng(0).permutation(len(model.ids)) < len(model.ids) // 5
    held[model.pupil] = False
    moved = observed.points.copy()
    moved[7, held] += [30.0, 40.0]
    plain, spoiled = (
        stages.held_out_px(tracker(model, o, truth), rows, truth.frames(rows), 2)
        for o in (observed, replace(observed, points=moved))
    )
    assert plain[0] < 2 and 47 < spoiled[0] < 53


def test_blocks_do_not_read_each_other(model, made):
    truth, observed = made
    spoiled = replace(observed, points=np.where(np.arange(60)[:, None, None] < 30, 5.0, observed.points))
    whole, again = (track(model, o, truth, np.arange(30, 60))[0] for o in (observed, spoiled))
    for name in ("rotation", "translation", "expression", "gaze", "jaw"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(again, name))


def lose(observed, rows):
    found, points = observed.found.copy(), observed.points.copy()
    found[rows], points[rows] = False, 0.0
    return replace(observed, found=found, points=points)


@pytest.mark.parametrize(("gap", "restarts"), [(3, [0]), (7, [0, 17])])
def test_missing_frames_hold_and_recover(model, made, gap, restarts):
    truth, observed = made
    state, afresh = track(model, lose(observed, slice(10, 10 + gap)), truth, np.arange(30))
    np.testing.assert_array_equal(state.rotation[10 : 10 + gap], np.repeat(state.rotation[9:10], gap, 0))
    assert np.flatnonzero(afresh).tolist() == restarts
    assert degrees_apart(state.rotation[10 + gap :], truth.rotation[10 + gap : 30]).max() < 1.5


def test_a_block_that_starts_without_a_face(model, made):
    truth, observed = made
    state, afresh = track(model, lose(observed, slice(0, 4)), truth, np.arange(12))
    np.testing.assert_array_equal(state.translation[:4], np.repeat(state.translation[4:5], 4, 0))
    assert np.flatnonzero(afresh).tolist() == [4]
    assert degrees_apart(state.rotation[4:], truth.rotation[4:12]).max() < 1.5


def test_no_face_in_a_block_is_an_error(model, made):
    truth, observed = made
    with pytest.raises(ValueError, match="no face in any of the frames 0 to 4"):
        track(model, lose(observed, slice(0, 60)), truth, np.arange(5))


def test_a_cut_to_another_pose_starts_afresh(model):
    """Half a radian from one frame to the next: too few iterations from there would keep the old pose."""
    truth = random_state(model, 40, yaw=0.6)
    rows = np.concatenate([np.arange(8, 16), np.arange(32, 40)])  # yaw of 0.4 to 0.6, then of -0.2 to -0.5
    truth = truth.frames(rows)
    observed = detected(model, truth, 0.5)
    state, afresh = track(model, observed, truth, np.arange(16), how=lambda p, x, effort: solver.solve_frame(p, x, effort))
    assert np.flatnonzero(afresh).tolist() == [0, 8]
    assert degrees_apart(state.rotation[9:], truth.rotation[9:]).max() < 2


def test_undetermined_actions_keep_their_held_value(model, made):
    truth, observed = made
    state, _ = track(model, observed, truth, np.arange(5), actions=np.array([True, False, True]), held=np.array([0.1, 0.4, 0.2]))
    np.testing.assert_array_equal(state.expression[:, 1], 0.4)
    assert (np.ptp(state.expression[:, [0, 2]], 0) > 0).all()


def test_ten_percent_outliers_of_50_px(model, made):
    truth, observed = made
    random = np.random.default_rng(4)
    points = observed.points.copy()
    bad = random.random(points.shape[:2]) < 0.1
    points[bad] += random.choice([-50.0, 50.0], (bad.sum(), 2))
    clean, dirty = (track(model, o, truth, np.arange(20))[0] for o in (observed, replace(observed, points=points)))
    error = lambda s: np.median(degrees_apart(s.rotation, truth.rotation[:20]))  # noqa: E731
    assert error(dirty) < max(2 * error(clean), 0.5)


def test_a_shut_eye_keeps_its_gaze(model, made):
    truth, observed = made
    open_eyes = np.ones((60, 2))
    open_eyes[10:14] = 0.0
    points = observed.points.copy()
    points[10:14, model.pupil] += 15.0  # what a detector makes of a shut eye
    state, _ = track(model, replace(observed, open_eyes=open_eyes, points=points), truth, np.arange(20))
    assert np.degrees(np.abs(state.gaze[10:14] - state.gaze[9]).max()) < 1.0
    assert np.abs(state.gaze[16:] - truth.gaze[16:20]).mean() < 0.06
