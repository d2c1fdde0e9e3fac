"""Adam with Neural Head Avatars' rates reaches the minimum that Gauss-Newton finds, slowly."""

from dataclasses import replace

import numpy as np
import pytest

from fitting import adam, energy, solver
from tests.landmarked import LENS, WEIGHTS, detected, landmarked_head, model_of, random_state


@pytest.fixture(scope="module")
def frame():
    model = model_of(landmarked_head())[1]
    truth = random_state(model, 1)
    problem = energy.landmark_problem(
        truth.fold(model), detected(model, truth, 1.0).frame(model, 0), WEIGHTS, LENS, energy.free_unknowns(model)
    )
    start = truth.pose(0).moved(np.random.default_rng(0).normal(0, 0.04, 16) * np.repeat([1, 0.2, 1], [3, 3, 10]))
    return problem, start


def test_many_steps_end_at_the_gauss_newton_minimum(frame):
    problem, start = frame
    best, lowest, _ = solver.solve_frame(problem, start, 30, tolerance=1e-12)
    pose, cost, steps = adam.solve_frame(problem, start, 600)
    assert steps == 600
    assert lowest <= cost < lowest + 0.02 * (problem.evaluate(start)[0] - lowest)
    np.testing.assert_allclose(pose.rotation, best.rotation, atol=0.02)
    np.testing.assert_allclose(pose.translation, best.translation, atol=0.008)


def test_the_first_step_has_the_rates_size(frame):
    """Adam's first step is the rate against the gradient's sign, whatever its size."""
    problem, start = frame
    evaluated = problem.evaluate(start)
    gradient = problem.gradient(start, evaluated[1])
    pose, cost, _ = adam.solve_frame(problem, start, 1)
    assert cost == evaluated[0]
    moved = np.concatenate([pose.translation - start.translation, pose.expression - start.expression])
    rate = np.repeat([adam.TRANSLATION_RATE, adam.RATE], 3)
    np.testing.assert_allclose(moved, -rate * np.sign(gradient[3:9]), rtol=1e-6)


def test_held_unknowns_stay(frame):
    problem, start = frame
    pose, _, _ = adam.solve_frame(replace(problem, free=np.arange(16) < 6), start, 5)
    np.testing.assert_array_equal(pose.expression, start.expression)
    assert (pose.translation != start.translation).all()


def test_a_start_that_is_not_finite_is_an_error(frame):
    problem, start = frame
    with pytest.raises(FloatingPointError, match="not finite"):
        adam.solve_frame(problem, replace(start, expression=np.full(3, np.nan)), 2)
