"""Keyframes, the joint solve of camera and identity, biases: against differences, dense algebra and made sequences."""

from dataclasses import replace

import numpy as np
import pytest

from fitting import calibrate, camera, energy, stages
from fitting.energy import Rows, Term
from fitting.rig import posed
from fitting.state import neutral
from tests.landmarked import (
    CENTRE_PX,
    WEIGHTS,
    degrees_apart,
    detected,
    landmarked_head,
    model_of,
    random_state,
    statistical_head,
)

BIAS_SD_M, MAX_FOCAL_SD = 0.0015, 0.15


@pytest.fixture(scope="module")
def model():
    return model_of(landmarked_head())[1]


@pytest.fixture(scope="module")
def wide(model):
    """A head that turns by 70 degrees to both sides, seen from near."""
    truth = random_state(model, 14, yaw=1.2)
    time = np.linspace(0, 2 * np.pi, 14)
    turn = np.stack([0.5 * np.sin(2 * time), 1.2 * np.sin(time), 0.1 * np.cos(time)], 1)
    truth = replace(truth, rotation=camera.exp_rotation(turn), translation=truth.translation * [1, 1, 0.6])
    return truth, detected(model, truth, 0.3)


@pytest.fixture(scope="module")
def solved(model, wide):
    return calibrate.calibrate(model, wide[1], np.arange(14), WEIGHTS, float(np.log(380.0)), BIAS_SD_M, MAX_FOCAL_SD)


def test_wide_yaw_gives_focal_length_and_identity(wide, solved):
    truth, _ = wide
    assert not solved.focal_kept_prior and solved.focal_sd < MAX_FOCAL_SD
    assert abs(solved.state.focal_px / 420 - 1) < 0.04  # from a prior 10 % off
    assert np.abs(solved.state.shape - truth.shape).max() < 0.25  # of a standard deviation: 0.75 mm here
    assert degrees_apart(solved.state.rotation, truth.rotation).max() < 1.5
    assert solved.actions.all() and solved.iterations > 0


def test_a_still_head_keeps_the_prior_and_says_so(model):
    truth = random_state(model, 12, amount=0.0)
    observed = detected(model, replace(truth, expression=np.full_like(truth.expression, 0.5)), 1.0)
    calibration = calibrate.calibrate(model, observed, np.arange(12), WEIGHTS, float(np.log(300.0)), BIAS_SD_M, MAX_FOCAL_SD)
    assert calibration.focal_kept_prior and calibration.focal_sd > MAX_FOCAL_SD
    assert calibration.state.focal_px == pytest.approx(300, rel=0.01)


def test_more_of_the_same_keyframes_promise_nothing(model, wide, solved):
    """The detector errs alike in all keyframes: three times the same ones do not make the focal length three times as certain."""
    _, observed = wide
    rows = np.tile(np.arange(14), 3)
    again = calibrate.calibrate(model, observed, rows, WEIGHTS, float(np.log(380.0)), BIAS_SD_M, MAX_FOCAL_SD, rounds=1)
    once = calibrate.calibrate(model, observed, np.arange(14), WEIGHTS, float(np.log(380.0)), BIAS_SD_M, MAX_FOCAL_SD, rounds=1)
    assert again.focal_sd == pytest.approx(once.focal_sd, rel=0.15)


@pytest.mark.parametrize("make", [landmarked_head, statistical_head])
def test_joint_gradient_against_differences(make, monkeypatch):
    """Both the frames' own unknowns and the shared ones, Huber and walls included."""
    monkeypatch.setattr(energy, "facing", lambda normal, _: np.ones(len(normal)))  # held within a step
    model = model_of(make())[1]
    model = replace(model, surface=replace(model.surface, joint_expression_basis=np.zeros((3, 3, 3))))
    truth = random_state(model, 2)
    observed = detected(model, truth, 2.0)
    extra = lambda state, k: ((pull(model, state, 2.0), model.surface),)  # noqa: E731
    joint = calibrate._Joint(model, observed, np.arange(2), WEIGHTS, 6.0, energy.free_unknowns(model), extra)
    random = np.random.default_rng(0)
    state = joint.update(truth, random.normal(0, 0.01, (2, 16)), np.append(0.05, random.normal(0, 0.4, 4)))
    state = replace(state, shape=np.array([3.0, -2.9, 0.1, 0.5]), bias=0.0005 * random.normal(size=state.bias.shape))
    normal = joint.linearise(state)
    assert normal.cost.sum() + normal.shared_cost == pytest.approx(joint.cost(state))
    step = 1e-6
    for unknown in range(5):
        shared = step * np.eye(5)[unknown]
        ahead, behind = (joint.cost(joint.update(state, np.zeros((2, 16)), sign * shared)) for sign in (1, -1))
        np.testing.assert_allclose(normal.shared_gradient[unknown], (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-2)
    for frame, unknown in ((0, 0), (0, 4), (1, 5), (1, 7), (0, 10), (1, 13)):
        block = np.zeros((2, 16))
        block[frame, unknown] = step
        ahead, behind = (joint.cost(joint.update(state, sign * block, np.zeros(5))) for sign in (1, -1))
        np.testing.assert_allclose(normal.gradient[frame, unknown], (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-2)


def pull(model, state, sigma_px, to=(140.0, 100.0)):
    """A further term: one landmark's pixel is pulled towards a place."""
    surface, lens = model.surface.folded(state.shape), state.lens(CENTRE_PX)

    def rows(at):
        residual = (camera.project(at.points[3], lens.focal_px, lens.centre_px) - to) / sigma_px
        covector = camera.project_jacobian(at.points[3], lens.focal_px) / sigma_px
        return Rows(0.5 * float(residual @ residual), residual, ((covector, np.full(2, 3)),))

    return Term(surface, rows)


def test_cross_terms_are_those_of_the_stacked_jacobian(model, monkeypatch):
    """The shared block and the cross block of the Gauss-Newton matrix against differences of all residuals together."""
    monkeypatch.setattr(energy, "facing", lambda normal, _: np.ones(len(normal)))
    truth = random_state(model, 2)
    weights = replace(WEIGHTS, robust_sigmas=1e9)
    joint = calibrate._Joint(
        model, detected(model, truth, 1.0), np.arange(2), weights, 6.0, energy.free_unknowns(model), lambda *_: ()
    )

    def residuals(state, k):
        problem, _ = joint.problem(state, state.fold(model), k)
        return np.concatenate([rows.residual for _, rows in problem.evaluate(state.pose(k))[1]])

    normal = joint.linearise(truth)
    step, total = 1e-6, joint._shared_prior(truth)[2]
    for k in range(2):
        columns = []
        for unknown in range(21):
            away = step * np.eye(21)[unknown]
            block = np.zeros((2, 16))
            block[k] = away[5:]
            ahead, behind = (residuals(joint.update(truth, sign * block, sign * away[:5]), k) for sign in (1, -1))
            columns.append((ahead - behind) / (2 * step))
        columns = np.stack(columns, 1)
        total = total + columns[:, :5].T @ columns[:, :5]
        expected = columns[:, 5:].T @ columns[:, :5]
        np.testing.assert_allclose(normal.cross[k], expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(normal.shared_hessian, total, rtol=1e-5, atol=1e-6 * np.abs(total).max())


def test_the_wall_keeps_the_identity_among_real_heads(model, wide):
    truth, _ = wide
    monster = replace(truth, shape=np.array([7.0, 0.0, 0.0, -6.0]))
    observed = detected(model, monster, 0.2)
    largest = []
    for sd in (WEIGHTS.shape_wall_sd, 1e6):
        weights = replace(WEIGHTS, shape_wall_sd=sd)
        calibration = calibrate.calibrate(model, observed, np.arange(14), weights, truth.log_focal, BIAS_SD_M, MAX_FOCAL_SD, 1)
        largest.append(np.abs(calibration.state.shape).max())
    assert WEIGHTS.shape_wall < largest[0] < largest[1] - 0.5


def test_bias_equals_a_dense_ridge_regression(model, wide):
    truth, _ = wide
    off = replace(truth, bias=0.001 * np.random.default_rng(3).normal(size=truth.bias.shape))
    observed = detected(model, off, 0.5)
    weights = replace(WEIGHTS, robust_sigmas=1e9)
    ours = calibrate.solve_bias(model, observed, np.arange(14), weights, truth, BIAS_SD_M).bias
    surface = truth.fold(model).surface
    for point in (0, 50, 300, 477):
        if point in model.pupil:
            continue
        matrix, right = [np.eye(3) / BIAS_SD_M], [np.zeros(3)]
        for k in range(14):
            pose = truth.pose(k)
            place = posed(surface, pose).points[point]
            weight = energy.facing(model.surface.normal[point : point + 1], pose)[0]
            scale = np.sqrt(weight / weights.correlated) / (
                weights.landmark_sigma * observed.scale_px[k] * model.group_sigma[point]
            )
            matrix.append(scale * camera.project_jacobian(place, truth.focal_px) @ pose.rotation)
            right.append(scale * (observed.points[k, point] - camera.project(place, truth.focal_px, CENTRE_PX)))
        expected = np.linalg.lstsq(np.concatenate(matrix), np.concatenate(right), rcond=None)[0]
        np.testing.assert_allclose(ours[point], expected, rtol=1e-8, atol=1e-12)
    assert not ours[model.pupil].any()


def test_bias_takes_up_a_constant_disagreement(model, wide):
    truth, _ = wide
    offset = 0.001 * np.random.default_rng(3).normal(size=truth.bias.shape)
    offset[model.pupil] = 0
    observed = detected(model, replace(truth, bias=offset), 0.0)
    state = truth
    for _ in range(3):
        state = calibrate.solve_bias(model, observed, np.arange(14), WEIGHTS, state, 0.01)
    before, after = (stages.reprojection_px(model, observed, np.arange(14), s).mean() for s in (truth, state))
    assert after < 0.5 * before
    again = calibrate.solve_bias(model, observed, np.arange(14), replace(WEIGHTS, robust_sigmas=1e9), state, 0.01)
    np.testing.assert_allclose(again.bias, state.bias, atol=2e-5)  # it is a fixed point, not a sum


def test_keyframes_are_sorted_unique_and_spread(model):
    truth = random_state(model, 120)
    observed = detected(model, truth, 0.5)
    rows = np.arange(10, 90, 2)
    poses = stages.pnp(model, observed, rows, neutral(model, 1, truth.log_focal))
    keyframes = calibrate.choose_keyframes(observed, rows, poses, np.ones(120), 8)
    assert len(keyframes) == 8 and np.isin(keyframes, rows).all() and (np.diff(keyframes) > 0).all()
    yaw = np.degrees(camera.log_rotation(poses.rotation)[:, 1])
    assert np.ptp(yaw[np.isin(rows, keyframes)]) > 0.8 * np.ptp(yaw)
    np.testing.assert_array_equal(keyframes, calibrate.choose_keyframes(observed, rows, poses, np.ones(120), 8))
    few = calibrate.choose_keyframes(observed, rows[:5], poses.frames(slice(0, 5)), np.ones(120), 8)
    np.testing.assert_array_equal(few, rows[:5])


def test_keyframes_are_sharp_and_calm_where_there_is_a_choice(model):
    truth = random_state(model, 100, amount=0.0)
    observed = detected(model, truth, 0.5)
    blurred = np.arange(100) % 3 == 0
    lively = np.where(np.arange(100)[:, None] % 3 == 1, 0.9, 0.1) * np.ones((100, 3))
    poses = stages.pnp(model, observed, np.arange(100), neutral(model, 1, truth.log_focal))
    chosen = calibrate.choose_keyframes(
        replace(observed, expression_mean=lively), np.arange(100), poses, np.where(blurred, 1.0, 50.0), 10
    )
    assert (chosen % 3 == 2).mean() > 0.6


def test_an_action_that_no_landmark_sees_is_held(model, wide):
    truth, observed = wide
    surface = replace(model.surface, expression_basis=model.surface.expression_basis * [1, 0, 1])
    scores = np.tile([0.2, 0.35, 0.6], (14, 1))
    calibration = calibrate.calibrate(
        replace(model, surface=surface), replace(observed, expression_mean=scores), np.arange(14), WEIGHTS, truth.log_focal,
        BIAS_SD_M, MAX_FOCAL_SD, 1,
    )  # fmt: skip
    assert calibration.actions.tolist() == [True, False, True]
    assert calibration.certainty[1] == pytest.approx(1, abs=0.01) and (calibration.certainty[[0, 2]] < 0.9).all()
    np.testing.assert_allclose(calibration.held, [0.2, 0.35, 0.6])


def test_refine_moves_identity_and_poses_and_leaves_camera_and_bias(model, wide, solved):
    _, observed = wide
    calls = []
    place = lambda s: camera.project(posed(model.surface.folded(s.shape), s.pose(0)).points[3], s.focal_px, CENTRE_PX)  # noqa: E731
    target = place(solved.state) + [0.0, 3.0]

    def extra_of(state):
        calls.append(state)
        return lambda at, k: ((pull(model, at, 0.2, target), model.surface),) if k == 0 else ()

    refined = calibrate.refine(model, observed, solved, WEIGHTS, extra_of, 2)
    assert len(calls) == 2 and refined.iterations > solved.iterations
    assert refined.state.focal_px == pytest.approx(solved.state.focal_px, rel=1e-3)
    np.testing.assert_array_equal(refined.state.bias, solved.state.bias)
    assert np.linalg.norm(place(refined.state) - target) < 1.5
    assert not np.array_equal(refined.state.shape, solved.state.shape)
    nothing = calibrate.refine(model, observed, solved, WEIGHTS, lambda _: lambda *__: (), 1)
    np.testing.assert_allclose(nothing.state.shape, solved.state.shape, atol=0.1)
