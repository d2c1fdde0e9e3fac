"""The damped Gauss-Newton solver against dense algebra, against scipy, and on a problem whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from fitting import energy, solver
from tests.landmarked import LENS, WEIGHTS, detected, landmarked_head, model_of, random_state


def arrow(seed=0, blocks=3, unknowns=4, shared=2):
    """Random normal equations and the same system written out densely."""
    random = np.random.default_rng(seed)
    jacobian = random.normal(size=(blocks, 12, unknowns + shared))
    right = random.normal(size=(blocks, 12))
    own, common = jacobian[..., :unknowns], jacobian[..., unknowns:]
    stacked = common.reshape(-1, shared)
    normal = solver.Normal(
        0.5 * (right**2).sum(1),
        own.swapaxes(1, 2) @ own,
        np.einsum("bmd,bm->bd", own, right),
        own.swapaxes(1, 2) @ common,
        stacked.T @ stacked,
        stacked.T @ right.reshape(-1),
    )
    dense = np.zeros((blocks * 12, blocks * unknowns + shared))
    for b in range(blocks):
        dense[12 * b : 12 * b + 12, unknowns * b : unknowns * b + unknowns] = own[b]
        dense[12 * b : 12 * b + 12, blocks * unknowns :] = common[b]
    return normal, dense, right.reshape(-1)


def test_arrow_step_equals_dense_least_squares():
    normal, dense, right = arrow()
    block, shared, schur = solver.step_of(normal, 0.0)
    expected = -np.linalg.lstsq(dense, right, rcond=None)[0]
    np.testing.assert_allclose(np.concatenate([block.ravel(), shared]), expected, atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(schur), np.linalg.inv(dense.T @ dense)[-2:, -2:], atol=1e-9)


def test_scaling_survives_a_condition_of_1e12():
    matrix = np.diag([1e12, 1.0, 1e-6])
    np.testing.assert_allclose(solver.damped_solve(matrix, np.array([1e12, 2.0, 3e-6]), 0.0), [1, 2, 3], rtol=1e-9)


def test_damped_arrow_step_equals_the_damped_dense_system():
    """Marquardt's damping scales the blocks' own diagonals; the shared part is damped on its Schur complement."""
    normal, dense, right = arrow(seed=3)
    block, shared, schur = solver.step_of(normal, 0.3)
    own = dense[:, :-2]
    damped = own.T @ own + 0.3 * np.diag(np.diag(own.T @ own))
    cross = own.T @ dense[:, -2:]
    expected = dense[:, -2:].T @ dense[:, -2:] - cross.T @ np.linalg.solve(damped, cross)
    np.testing.assert_allclose(schur, expected, atol=1e-9)
    side = dense[:, -2:].T @ right - cross.T @ np.linalg.solve(damped, own.T @ right)
    np.testing.assert_allclose(shared, -np.linalg.solve(expected + 0.3 * np.diag(np.diag(expected)), side), atol=1e-9)
    np.testing.assert_allclose(block.ravel(), -np.linalg.solve(damped, own.T @ right + cross @ shared), atol=1e-9)


def test_an_unseen_unknown_does_not_move():
    """A row and column of zeros: the step is zero there and right elsewhere."""
    matrix = np.array([[2.0, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 3.0]])
    solved = solver.damped_solve(matrix, np.array([3.0, 0.0, 4.0]), 0.0)
    np.testing.assert_allclose(solved, [1, 0, 1], atol=1e-9)


def test_many_systems_and_many_right_sides_at_once():
    random = np.random.default_rng(0)
    factor = random.normal(size=(5, 6, 4)) * 10.0 ** random.uniform(-4, 4, (5, 1, 4))
    matrix, right = factor.swapaxes(1, 2) @ factor, random.normal(size=(5, 4, 3))
    for damping in (0.0, 0.1):
        solved = solver.damped_solve(matrix, right, damping)
        for k in range(5):
            one = matrix[k] + (damping + 1e-12) * np.diag(np.diag(matrix[k]))
            np.testing.assert_allclose(one @ solved[k], right[k], rtol=1e-6, atol=1e-7)
            np.testing.assert_allclose(solver.damped_solve(matrix[k], right[k, :, 0], damping), solved[k, :, 0], rtol=1e-9)


@pytest.fixture(scope="module")
def frame():
    """The landmark problem of one noisy frame with a quadratic cost and no walls, its truth, a start beside it."""
    model = model_of(landmarked_head())[1]
    model = replace(model, low=np.full(3, -np.inf), high=np.full(3, np.inf))
    truth = random_state(model, 1)
    observed = detected(model, truth, 1.0)
    folded, seen = truth.fold(model), observed.frame(model, 0)
    weights = replace(WEIGHTS, robust_sigmas=1e9, jaw_wall_rad=-np.inf)
    problem = energy.landmark_problem(folded, seen, weights, LENS, energy.free_unknowns(model))
    start = truth.pose(0).moved(np.random.default_rng(0).normal(0, 0.05, 16) * np.repeat([1, 0.2, 1], [3, 3, 10]))
    return problem, truth.pose(0), start


def test_one_frame_reaches_scipys_minimum(frame, monkeypatch):
    problem, truth, start = frame
    held = energy.facing(problem.terms[0].surface.normal, truth)
    monkeypatch.setattr(energy, "facing", lambda normal, _: held if len(normal) == len(held) else 1.0)
    root = np.linalg.cholesky(problem.prior.precision[6:, 6:]).T

    def residual(x):
        pose = start.moved(x)
        rest = np.concatenate([pose.expression, pose.gaze, pose.jaw]) - problem.prior.mean[6:]
        return np.concatenate([*(rows.residual for _, rows in problem.evaluate(pose)[1]), root @ rest])

    best = least_squares(residual, np.zeros(16), method="lm", xtol=1e-14, ftol=1e-14)
    pose, cost, done = solver.solve_frame(problem, start, 50, tolerance=1e-13)
    assert cost == pytest.approx(best.cost, rel=1e-9) and done < 20
    expected = start.moved(best.x)
    for name in ("rotation", "translation", "expression", "gaze", "jaw"):
        np.testing.assert_allclose(getattr(pose, name), getattr(expected, name), atol=2e-5)


def test_one_frame_never_gets_worse_and_four_steps_are_enough(frame):
    problem, _, start = frame
    costs = [problem.evaluate(start)[0], *(solver.solve_frame(problem, start, n, tolerance=0.0)[1] for n in (1, 2, 4, 8, 16))]
    assert all(after <= before for before, after in zip(costs, costs[1:], strict=False))
    assert costs[3] - costs[5] < 1e-3 * costs[5]


def test_held_unknowns_stay_to_the_bit(frame):
    problem, _, start = frame
    rigid = replace(problem, free=np.arange(16) < 6)
    pose, cost, _ = solver.solve_frame(rigid, start, 10)
    assert cost < problem.evaluate(start)[0]
    for name in ("expression", "gaze", "jaw"):
        np.testing.assert_array_equal(getattr(pose, name), getattr(start, name))


def test_a_frame_that_starts_with_nan_is_an_error(frame):
    problem, _, start = frame
    with pytest.raises(FloatingPointError, match="not finite"):
        solver.solve_frame(problem, replace(start, translation=np.full(3, np.nan)), 3)


def rosenbrock():
    def linearise(x):
        residual = np.array([[10 * (x[1] - x[0] ** 2), 1 - x[0]]])
        jacobian = np.array([[[-20 * x[0], 10.0], [-1.0, 0.0]]])
        return solver.Normal(
            0.5 * (residual**2).sum(1), jacobian.swapaxes(1, 2) @ jacobian, np.einsum("bmd,bm->bd", jacobian, residual)
        )

    return linearise, lambda x, step, _: x + step[0], lambda x: float(linearise(x).cost.sum())


def test_minimise_reaches_the_minimum_and_never_climbs():
    linearise, update, cost = rosenbrock()
    seen = []
    state, report = solver.minimise(
        np.array([-1.2, 1.0]), lambda x: seen.append(cost(x)) or linearise(x), update, cost, 100, tolerance=1e-12
    )
    np.testing.assert_allclose(state, [1, 1], atol=1e-5)
    assert report.accepted <= report.iterations
    assert all(b <= a for a, b in zip(seen, seen[1:], strict=False))


def test_a_start_that_is_not_finite_is_an_error():
    linearise, update, cost = rosenbrock()
    with pytest.raises(FloatingPointError, match="not finite"):
        solver.minimise(np.array([np.nan, 1.0]), linearise, update, cost, 5)


def test_a_singular_linearisation_is_damped_away():
    """Two blocks that only see their unknowns' sum: the step is the smallest one, the cost falls to zero."""

    def linearise(x):
        residual = x.sum(1) - np.array([1.0, 2.0])
        return solver.Normal(0.5 * residual**2, np.ones((2, 2, 2)), np.tile(residual[:, None], (1, 2)))

    cost = lambda x: float(linearise(x).cost.sum())  # noqa: E731
    state, report = solver.minimise(np.zeros((2, 2)), linearise, lambda x, step, _: x + step, cost, 40, tolerance=1e-12)
    np.testing.assert_allclose(state.sum(1), [1, 2], atol=1e-5)
    assert report.cost < 1e-9 and np.isfinite(state).all()


def test_the_reported_covariance_is_that_of_the_undamped_problem():
    random = np.random.default_rng(2)
    design, right = random.normal(size=(4, 10, 5)), random.normal(size=(4, 10))

    def linearise(x):
        own, shared = x
        residual = np.einsum("bmd,bd->bm", design[..., :3], own) + design[..., 3:] @ shared - right
        mine, common = design[..., :3], design[..., 3:]
        return solver.Normal(
            0.5 * (residual**2).sum(1),
            mine.swapaxes(1, 2) @ mine,
            np.einsum("bmd,bm->bd", mine, residual),
            mine.swapaxes(1, 2) @ common,
            np.einsum("bms,bmt->st", common, common),
            np.einsum("bms,bm->s", common, residual),
        )

    update = lambda x, block, shared: (x[0] + block, x[1] + shared)  # noqa: E731
    cost = lambda x: float(linearise(x).cost.sum())  # noqa: E731
    (own, shared), report = solver.minimise((np.zeros((4, 3)), np.zeros(2)), linearise, update, cost, 30, tolerance=1e-14)
    dense = np.zeros((40, 14))
    for b in range(4):
        dense[10 * b : 10 * b + 10, 3 * b : 3 * b + 3], dense[10 * b : 10 * b + 10, 12:] = design[b, :, :3], design[b, :, 3:]
    expected = np.linalg.lstsq(dense, right.ravel(), rcond=None)[0]
    np.testing.assert_allclose(np.concatenate([own.ravel(), shared]), expected, atol=1e-6)
    np.testing.assert_allclose(report.shared_covariance, np.linalg.inv(dense.T @ dense)[12:, 12:], rtol=1e-6)
