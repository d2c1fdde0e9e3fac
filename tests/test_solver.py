"""The damped Gauss-Newton solver against dense algebra and on a problem whose answer is known."""

import numpy as np
import pytest

from fitting import solver


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
