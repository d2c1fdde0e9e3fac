"""Analytic Jacobians against differences; the linear landmark model against the head model; priors and robustness."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fitting import energy
from fitting.landmark_model import LandmarkModel
from tests.landmarked import WEIGHTS, detected, landmarked_head, random_state

# A quadratic loss: with Huber the weights depend on the residual, and differences would see that.
SQUARED = replace(WEIGHTS, robust_sigmas=1e9)


@pytest.fixture(scope="module")
def model():
    return LandmarkModel.of(landmarked_head())


@pytest.fixture(scope="module")
def made(model):
    truth = random_state(model, 3)
    observed = detected(model, truth, 2.0)
    return truth, observed.frames(np.arange(3))


def test_points_equal_the_head_model_without_gaze(model):
    head = landmarked_head()
    state = replace(random_state(model, 2), gaze=np.zeros((2, 4)))
    local = head.local(torch.from_numpy(state.shape).float(), torch.from_numpy(state.expression).float(), torch.zeros(2, 3))
    expected = head.landmarks(local).numpy()[:, model.ids]
    np.testing.assert_allclose(energy.head_points(model, state), expected, atol=1e-6)


def test_gaze_turns_the_pupil_about_the_eye_joint(model):
    state = replace(random_state(model, 1), gaze=np.array([[0.0, 0.2, 0.0, 0.0]]))
    still = replace(state, gaze=np.zeros((1, 4)))
    moved = energy.head_points(model, state)[0] - energy.head_points(model, still)[0]
    changed = np.flatnonzero(np.abs(moved).max(1) > 1e-9)
    assert changed.tolist() == [model.pupil[0]]
    assert moved[model.pupil[0], 0] < 0  # positive yaw about +y (down) takes a point at -z towards -x


@pytest.mark.parametrize("with_shared", [False, True])
def test_gradient_against_differences(model, made, with_shared, monkeypatch):
    truth, frames = made
    state = replace(random_state(model, 3, seed=5), log_focal=truth.log_focal + 0.1)
    frozen = energy.visibility(model, state)
    monkeypatch.setattr(energy, "visibility", lambda *_: frozen)  # held constant within a step, as the solver does
    prior = truth.log_focal if with_shared else None
    normal = energy.linearise(model, frames, SQUARED, state, prior)
    count = normal.gradient.shape[1]
    step = 1e-6
    for frame in (0, 2):
        for unknown in range(count):
            block = np.zeros((3, count))
            block[frame, unknown] = step
            ahead = energy.cost(model, frames, SQUARED, energy.update(state, block, None), prior)
            behind = energy.cost(model, frames, SQUARED, energy.update(state, -block, None), prior)
            np.testing.assert_allclose(normal.gradient[frame, unknown], (ahead - behind) / (2 * step), rtol=2e-5, atol=2e-3)
    if with_shared:
        for unknown in range(len(normal.shared_gradient)):
            shared = np.zeros(len(normal.shared_gradient))
            shared[unknown] = step
            nothing = np.zeros((3, count))
            ahead = energy.cost(model, frames, SQUARED, energy.update(state, nothing, shared), prior)
            behind = energy.cost(model, frames, SQUARED, energy.update(state, nothing, -shared), prior)
            np.testing.assert_allclose(normal.shared_gradient[unknown], (ahead - behind) / (2 * step), rtol=2e-5, atol=2e-3)


def test_pose_only_moves_the_pose_alone(model, made):
    truth, frames = made
    normal = energy.linearise(model, frames, WEIGHTS, random_state(model, 3, seed=7), None, pose_only=True)
    assert np.all(normal.gradient[:, energy.POSE :] == 0)
    assert np.abs(normal.gradient[:, : energy.POSE]).min() > 0


def test_huber_is_continuous_and_bounds_the_influence():
    residual = np.array([[[2.999999, 0.0], [3.000001, 0.0], [300.0, 0.0], [0.0, 0.0]]])
    cost, weight = energy.robust(residual, 3.0)
    assert abs(cost[0, 0] - cost[0, 1]) < 1e-5
    assert weight[0, 2] * 300 == pytest.approx(3.0)
    assert weight[0, 3] == 1.0


def test_a_point_turned_away_counts_little(model):
    state = replace(random_state(model, 1), rotation=np.diag([-1.0, 1.0, -1.0])[None])  # seen from behind
    assert np.median(energy.visibility(model, state)) == pytest.approx(0.02)


def test_bias_takes_up_a_constant_disagreement(model):
    truth = replace(random_state(model, 30), bias=np.zeros_like(model.base))
    offset = 0.001 * np.random.default_rng(3).normal(size=model.base.shape)
    offset[model.pupil] = 0
    observed = detected(model, replace(truth, bias=offset), 0.0)
    frames = observed.frames(np.arange(30))
    solved = energy.solve_bias(model, frames, WEIGHTS, truth, 0.0015)
    before = np.abs(energy.residuals(model, frames, WEIGHTS, truth)[0]).mean()
    after = np.abs(energy.residuals(model, frames, WEIGHTS, solved)[0]).mean()
    assert after < 0.3 * before
    assert np.all(solved.bias[model.pupil] == 0)
