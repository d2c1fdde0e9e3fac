"""The fit's stages on sequences with known truth, and the hard cases of tracking that belong to them."""

from dataclasses import replace

import numpy as np
import pytest

from fitting import bundle, camera, stages
from fitting.fit import SMOOTHNESS
from fitting.landmark_model import LandmarkModel
from tests.landmarked import WEIGHTS, detected, landmarked_head, random_state


@pytest.fixture(scope="module")
def model():
    return LandmarkModel.of(landmarked_head())


@pytest.fixture(scope="module")
def made(model):
    truth = random_state(model, 60)
    return truth, detected(model, truth, 1.0)


def rotation_error_deg(a, b):
    return np.degrees(np.linalg.norm(camera.log_rotation(a @ b.swapaxes(-1, -2)), axis=-1))


def test_pnp_finds_the_pose(model, made):
    truth, observed = made
    start = replace(stages.neutral(model, 1, truth.log_focal), shape=truth.shape)
    state = stages.pnp(model, observed, np.arange(60), start)
    assert np.median(rotation_error_deg(state.rotation, truth.rotation)) < 6
    assert (state.translation[:, 2] > 0.3).all()


@pytest.mark.parametrize("case", ["same_point", "two_clusters", "line"])
def test_degenerate_points_give_a_pose_not_nan(model, made, case):
    truth, observed = made
    points = observed.points[:1].copy()
    if case == "same_point":
        points[:] = [100.0, 100.0]
    elif case == "two_clusters":
        points[:] = np.where(np.arange(points.shape[1])[:, None] % 2 == 0, [50.0, 50.0], [60.0, 60.0])
    else:
        points[..., 1] = 120.0
    state = stages.pnp(model, replace(observed, points=points), np.array([0]), stages.neutral(model, 1, truth.log_focal))
    assert np.isfinite(state.rotation).all() and np.isfinite(state.translation).all()


def test_calibration_and_tracking_recover_the_truth(model, made):
    truth, observed = made
    keyframes = stages.choose_keyframes(
        observed, np.arange(45), stages.pnp(model, observed, np.arange(45), stages.neutral(model, 1, 6.0)), np.ones(60), 20
    )
    assert len(keyframes) == 20 and keyframes.max() < 45
    calibration = stages.calibrate(model, observed, keyframes, WEIGHTS, float(np.log(380.0)), 0.0015, 0.2)
    assert abs(calibration.state.focal_px / 420 - 1) < max(3 * calibration.focal_sd, 0.1)
    state = stages.track_block(model, observed, np.arange(60), WEIGHTS, calibration.state, 6)
    assert np.median(rotation_error_deg(state.rotation, truth.rotation)) < 1.0
    assert np.median(stages.reprojection_px(model, observed, np.arange(60), state)) < 1.6  # the noise itself is 1.41 px
    assert np.abs(state.expression - truth.expression).mean() < 0.12
    held_out = stages.held_out_px(model, observed, np.arange(0, 60, 10), WEIGHTS, state.frame(np.arange(0, 60, 10)), 6)
    assert np.median(held_out) < 1.9


def test_an_undetermined_focal_length_keeps_its_prior(model):
    truth = random_state(model, 12, amount=0.0)
    observed = detected(model, replace(truth, expression=np.full_like(truth.expression, 0.5)), 1.0)
    calibration = stages.calibrate(model, observed, np.arange(12), WEIGHTS, float(np.log(300.0)), 0.0015, 0.001)
    assert calibration.focal_kept_prior
    assert calibration.state.focal_px == pytest.approx(300, rel=0.01)


def test_blocks_do_not_read_each_other(model, made):
    truth, observed = made
    shared = replace(truth, bias=np.zeros_like(model.base)).frame(slice(0, 1))
    whole = stages.track_block(model, observed, np.arange(30, 60), WEIGHTS, shared, 4)
    spoiled = replace(observed, points=np.where(np.arange(60)[:, None, None] < 30, 5.0, observed.points))
    again = stages.track_block(model, spoiled, np.arange(30, 60), WEIGHTS, shared, 4)
    np.testing.assert_array_equal(whole.expression, again.expression)


def test_missing_frames_hold_and_recover(model, made):
    truth, observed = made
    found = np.ones(60, bool)
    found[10:15] = False
    points = observed.points.copy()
    points[10:15] = np.nan
    shared = truth.frame(slice(0, 1))
    state = stages.track_block(model, replace(observed, points=points, found=found), np.arange(30), WEIGHTS, shared, 6)
    assert np.isfinite(state.rotation).all()
    np.testing.assert_array_equal(state.rotation[10], state.rotation[9])
    assert rotation_error_deg(state.rotation[16:18], truth.rotation[16:18]).max() < 2


def test_ten_percent_outliers_of_50_px(model, made):
    truth, observed = made
    random = np.random.default_rng(4)
    points = observed.points.copy()
    bad = random.random(points.shape[:2]) < 0.1
    points[bad] += random.choice([-50.0, 50.0], (bad.sum(), 2))
    shared = truth.frame(slice(0, 1))
    clean = stages.track_block(model, observed, np.arange(20), WEIGHTS, shared, 6)
    dirty = stages.track_block(model, replace(observed, points=points), np.arange(20), WEIGHTS, shared, 6)
    error = lambda s: np.median(rotation_error_deg(s.rotation, truth.rotation[:20]))  # noqa: E731
    assert error(dirty) < max(2 * error(clean), 1.0)


def test_smoothing_brings_jittered_frames_nearer_to_the_truth_and_closes_seams(model):
    truth = random_state(model, 60)
    observed = detected(model, truth, 4.0)
    shared = truth.frame(slice(0, 1))
    blocks = [stages.track_block(model, observed, np.arange(k, k + 20), WEIGHTS, shared, 6) for k in (0, 20, 40)]
    names = ("rotation", "translation", "expression", "gaze")
    rough = replace(blocks[0], **{n: np.concatenate([getattr(b, n) for b in blocks]) for n in names})
    rows = np.arange(60)
    calm = bundle.smooth(model, observed, rows, WEIGHTS, rough, SMOOTHNESS, 5)
    before, after = (rotation_error_deg(s.rotation, truth.rotation)[2:-2] for s in (rough, calm))
    assert np.mean(after) < 0.8 * np.mean(before)
    assert np.percentile(after, 95) < np.percentile(before, 95)
    depth = lambda s: np.abs(s.translation[2:-2, 2] - truth.translation[2:-2, 2]).mean()  # noqa: E731
    assert depth(calm) < depth(rough)


def test_smoothing_carries_lost_frames_and_leaves_short_clips_alone(model, made):
    truth, observed = made
    found = np.ones(60, bool)
    found[20:23] = False
    points = np.where(found[:, None, None], observed.points, 0.0)
    state = stages.track_block(
        model, replace(observed, points=points, found=found), np.arange(60), WEIGHTS, truth.frame(slice(0, 1)), 6
    )
    calm = bundle.smooth(model, replace(observed, points=points, found=found), np.arange(60), WEIGHTS, state, SMOOTHNESS, 30)
    held, carried = (rotation_error_deg(s.rotation, truth.rotation)[20:23].mean() for s in (state, calm))
    assert carried < 0.6 * held
    short = state.frame(slice(0, 4))
    assert bundle.smooth(model, observed, np.arange(4), WEIGHTS, short, SMOOTHNESS, 2) is short


def test_no_face_in_a_block_is_an_error(model, made):
    truth, observed = made
    with pytest.raises(ValueError, match="no face in any of the frames 0 to 4"):
        stages.track_block(model, replace(observed, found=np.zeros(60, bool)), np.arange(5), WEIGHTS, truth.frame(slice(0, 1)), 3)


def test_lost_and_tiny_detections_are_not_usable(model):
    points = np.zeros((4, 478, 3), np.float32)
    points[0] = np.random.default_rng(0).uniform(50, 200, (478, 3))
    points[1] = np.nan
    points[2] = 77.0  # all in one place
    points[3] = np.random.default_rng(1).uniform(-900, -800, (478, 3))  # outside
    found = np.array([True, False, True, True])
    observed = stages.observe(
        model,
        points,
        found,
        np.zeros((4, 51), np.float32),
        [f"b{i}" for i in range(51)],
        ("bump0",) * len(model.low),
        np.zeros(2),
        (240, 256),
        1.0,
    )
    assert observed.found.tolist() == [True, False, False, False]
    assert np.isfinite(observed.points).all()
