"""Damped Gauss-Newton (Levenberg-Marquardt) on normal equations, float64, Jacobi-scaled.

The problems here are small and dense per frame (about 50 unknowns, 800 residuals) with a few shared unknowns: a frame's block is
eliminated first and the shared unknowns are solved from the Schur complement ("arrow" structure).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fitting.energy import Problem
from fitting.rig import Pose


@dataclass
class Normal:
    """Normal equations of B independent blocks with d unknowns each and s shared ones."""

    cost: np.ndarray  # [B] half squared residuals (robust)
    hessian: np.ndarray  # [B, d, d]
    gradient: np.ndarray  # [B, d]
    cross: np.ndarray | None = None  # [B, d, s]
    shared_hessian: np.ndarray | None = None  # [s, s]
    shared_gradient: np.ndarray | None = None  # [s]
    shared_cost: float = 0.0


@dataclass
class Report:
    """How a solve ended."""

    cost: float
    iterations: int
    accepted: int
    shared_covariance: np.ndarray | None = None  # [s, s] inverse of the Schur complement


def damped_solve(hessian: np.ndarray, right: np.ndarray, damping: float) -> np.ndarray:
    """Solve (H + damping * diag H) x = b with symmetric Jacobi scaling.

    Args:
        hessian: [..., d, d] positive semi-definite; right: [..., d] or [..., d, m].
        damping: relative to the diagonal (Marquardt).

    Raises:
        numpy.linalg.LinAlgError: the scaled matrix is singular.
    """
    diagonal = np.einsum("...ii->...i", hessian)
    scale = 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = hessian * scale[..., :, None] * scale[..., None, :]
    scaled = scaled + (damping + 1e-12) * np.eye(hessian.shape[-1])
    vector = right.ndim == hessian.ndim - 1
    columns = right[..., None] if vector else right
    solved = np.linalg.solve(scaled, columns * scale[..., :, None]) * scale[..., :, None]
    return solved[..., 0] if vector else solved


def solve_frame(
    problem: Problem, pose: Pose, iterations: int, tolerance: float = 1e-4, damping: float = 1e-3
) -> tuple[Pose, float, int]:
    """Levenberg-Marquardt on one frame's unknowns.

    Args:
        iterations: at most this many linearisations; tolerance: stop when the relative decrease of the cost falls below it.

    Returns:
        pose, its cost, linearisations done.

    Raises:
        FloatingPointError: the cost at the start is not finite.
    """
    cost, evaluated = problem.evaluate(pose)
    if not np.isfinite(cost):
        raise FloatingPointError("the cost at the start of a frame's solve is not finite")
    done = 0
    for done in range(1, iterations + 1):  # noqa: B007
        hessian, gradient = problem.normal(pose, evaluated)
        before = cost
        for _ in range(6):
            trial = pose.moved(-damped_solve(hessian, gradient, damping))
            new, trial_evaluated = problem.evaluate(trial)
            if np.isfinite(new) and new < cost:
                pose, cost, evaluated, damping = trial, new, trial_evaluated, max(damping / 5, 1e-9)
                break
            damping = min(damping * 8, 1e6)
        if before - cost <= tolerance * before:
            break
    return pose, cost, done


def step_of(normal: Normal, damping: float) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Descent step of the blocks [B, d], of the shared unknowns [s] and the Schur complement [s, s] (None without shared)."""
    if normal.cross is None:
        return -damped_solve(normal.hessian, normal.gradient, damping), None, None
    both = np.concatenate([normal.gradient[..., None], normal.cross], -1)
    solved = damped_solve(normal.hessian, both, damping)  # [B, d, 1 + s]
    schur = normal.shared_hessian - np.einsum("bds,bdt->st", normal.cross, solved[..., 1:])
    right = normal.shared_gradient - np.einsum("bds,bd->s", normal.cross, solved[..., 0])
    shared = -damped_solve(schur, right, damping)
    return -(solved[..., 0] + solved[..., 1:] @ shared), shared, schur


def minimise(
    state: Any,
    linearise: Callable[[Any], Normal],
    update: Callable[[Any, np.ndarray, np.ndarray | None], Any],
    cost_of: Callable[[Any], float],
    iterations: int,
    damping: float = 1e-3,
    tolerance: float = 1e-4,
) -> tuple[Any, Report]:
    """Levenberg-Marquardt: accept a step only if the true robust cost falls.

    Args:
        state: any value; linearise(state) gives its normal equations, update(state, block_step, shared_step) a new state,
            cost_of(state) its cost (the sum of Normal.cost and shared_cost).
        iterations: at most this many linearisations.
        tolerance: stop when the relative decrease falls below it.

    Raises:
        FloatingPointError: the cost of the start is not finite.
    """
    cost = cost_of(state)
    if not np.isfinite(cost):
        raise FloatingPointError("the cost at the start of the solve is not finite")
    accepted, done, schur = 0, 0, None
    for done in range(1, iterations + 1):  # noqa: B007
        normal = linearise(state)
        before = cost
        for _ in range(6):
            try:
                block, shared, schur = step_of(normal, damping)
                trial = update(state, block, shared)
                new = cost_of(trial)
            except np.linalg.LinAlgError:
                new = np.inf
            if np.isfinite(new) and new < cost:
                state, cost, damping = trial, new, max(damping / 5, 1e-9)
                accepted += 1
                break
            damping = min(damping * 8, 1e6)
        if before - cost <= tolerance * before:
            break
    if schur is None:
        return state, Report(float(cost), done, accepted)
    schur = step_of(linearise(state), 0.0)[2]  # undamped: damping would pass for information
    return state, Report(float(cost), done, accepted, np.linalg.pinv(schur, hermitian=True))
