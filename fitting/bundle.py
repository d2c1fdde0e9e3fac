"""The bundle: all frames of one part together, with temporal terms, as one banded linear system an iteration.

Each frame's terms enter as their own quadratic (Hessian, gradient at the current pose); accelerations couple a frame with its two
neighbours on either side.  The matrix is block-pentadiagonal and solved exactly in O(T d^3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, dataclass

import numpy as np
import scipy.linalg

from fitting.energy import Problem, huber
from fitting.rig import GAZE, JAW
from fitting.state import State

ROBUST_SIGMAS = 3.0  # accelerations beyond this pull no harder: a sudden move, a duplicated frame
JUMP_DEGREES, JUMP_M = 15.0, 0.06  # a change from one frame to the next beyond this is a cut


@dataclass(frozen=True)
class Smoothness:
    """Standard deviations of the acceleration, per (1/30 s) squared: the second difference at 30 frames a second."""

    rotation_rad: float
    across_m: float
    depth_m: float
    expression: float
    gaze_rad: float
    jaw_rad: float

    def deviation(self, expressions: int) -> np.ndarray:
        """One standard deviation per unknown [d]."""
        rotation, across, depth, expression, gaze, jaw = astuple(self)
        return np.concatenate(
            [
                np.full(3, rotation),
                [across, across, depth],
                np.full(expressions, expression),
                np.full(GAZE, gaze),
                np.full(JAW, jaw),
            ]
        )


def stencils(time_s: np.ndarray, cut: np.ndarray) -> np.ndarray:
    """Coefficients [T - 2, 3] of the acceleration at each inner frame, per (1/30 s) squared; zero across a cut.

    Args:
        time_s: [T]; cut: [T] bool, a frame that does not continue the one before it.
    """
    step = np.diff(time_s)
    step = np.maximum(step, 0.25 * np.median(step)) if len(step) else step  # duplicated frames
    first, second = step[:-1], step[1:]
    unit = (1 / 30) ** 2
    rows = np.stack([2 / (first * (first + second)), -2 / (first * second), 2 / (second * (first + second))], 1) * unit
    return np.where((cut[1:-1] | cut[2:])[:, None], 0.0, rows)


def cuts(state: State, found: np.ndarray) -> np.ndarray:
    """Frames [T] bool whose pose jumps away from the frame before: a cut, or a track that was lost and found."""
    jump = np.zeros(len(state), bool)
    if len(state) > 1:
        angle = np.degrees(np.linalg.norm(state.turns, axis=1))
        way = np.linalg.norm(np.diff(state.translation, axis=0), axis=1)
        jump[1:] = ((angle > JUMP_DEGREES) | (way > JUMP_M)) & found[1:] & found[:-1]
    return jump


def acceleration(state: State, stencil: np.ndarray) -> np.ndarray:
    """Accelerations [T - 2, d]; those of the rotation are differences of relative rotation vectors."""
    flat = np.concatenate([state.translation, state.expression, state.gaze, state.jaw], 1)
    back, here, on = flat[:-2], flat[1:-1], flat[2:]
    straight = stencil[:, :1] * (back - here) + stencil[:, 2:] * (on - here)
    turn = state.turns
    turned = -stencil[:, :1] * turn[:-1] + stencil[:, 2:] * turn[1:]
    return np.concatenate([turned, straight], 1)


def smooth(
    problem_of: Callable[[int, State], Problem | None],
    state: State,
    stencil: np.ndarray,
    deviation: np.ndarray,
    iterations: int,
) -> tuple[State, list[float]]:
    """Bundle over consecutive frames, shared unknowns held.

    Args:
        problem_of: the problem of the k-th frame around a state, None for a frame without a face (carried by its neighbours).
        state: of these frames; stencil: [T - 2, 3] from `stencils`; deviation: [d] from `Smoothness`.

    Returns:
        state and the total cost at each iteration; a step that does not lower the cost is halved, then given up.
    """
    count, unknowns = len(state), len(deviation)
    if count < 3:
        return state, []
    precision = 1 / deviation**2

    def bends(at: State) -> tuple[float, np.ndarray, np.ndarray]:
        """Robust cost of the accelerations, themselves [T - 2, d] and their precision [T - 2, d]."""
        bend = acceleration(at, stencil)
        size, influence = huber(np.abs(bend) / deviation, ROBUST_SIGMAS)
        return float(size.sum()), bend, influence * precision

    def measure(at: State) -> tuple[float, np.ndarray, np.ndarray]:
        hessian, gradient, total = np.zeros((count, unknowns, unknowns)), np.zeros((count, unknowns)), 0.0
        for k in range(count):
            problem = problem_of(k, at)
            if problem is None:
                hessian[k] = np.diag(1e-4 * precision)  # keeps a lost tail where it is
                continue
            cost, evaluated = problem.evaluate(at.pose(k))
            hessian[k], gradient[k] = problem.normal(at.pose(k), evaluated)
            total += cost
        return total + bends(at)[0], hessian, gradient

    cost, hessian, gradient = measure(state)
    costs = [cost]
    for _ in range(iterations):
        step = _solve(hessian, gradient, *bends(state)[1:], stencil)
        for _ in range(3):
            trial = state.with_poses([state.pose(k).moved(step[k]) for k in range(count)])
            new, trial_hessian, trial_gradient = measure(trial)
            if np.isfinite(new) and new < cost:
                break
            step = step / 2
        else:
            break
        state, hessian, gradient = trial, trial_hessian, trial_gradient
        gain, cost = cost - new, new
        costs.append(cost)
        if gain < 1e-3 * cost:
            break
    return state, costs


def _solve(hessian: np.ndarray, gradient: np.ndarray, bend: np.ndarray, precision: np.ndarray, stencil: np.ndarray) -> np.ndarray:
    """Gauss-Newton step [T, d] of frames and accelerations [T - 2, d] together (banded Cholesky, Jacobi-scaled)."""
    count, unknowns = gradient.shape
    total, right = hessian.copy(), gradient.copy()
    diagonal = np.arange(unknowns)
    near, far = np.zeros((count, unknowns)), np.zeros((count, unknowns))  # coupling of frame k with k + 1 and k + 2
    for offset in range(3):
        right[offset : count - 2 + offset] += stencil[:, offset : offset + 1] * precision * bend
        np.add.at(
            total,
            (np.arange(offset, count - 2 + offset)[:, None], diagonal, diagonal),
            stencil[:, offset : offset + 1] ** 2 * precision,
        )
    near[: count - 2] += (stencil[:, 0] * stencil[:, 1])[:, None] * precision
    near[1 : count - 1] += (stencil[:, 1] * stencil[:, 2])[:, None] * precision
    far[: count - 2] += (stencil[:, 0] * stencil[:, 2])[:, None] * precision
    scale = 1 / np.sqrt(np.maximum(np.einsum("kii->ki", total), 1e-30))
    band = np.zeros((2 * unknowns + 1, count * unknowns))
    scaled = total * scale[:, :, None] * scale[:, None, :]
    for below in range(unknowns):  # lower form: band[i - j, j]
        columns = (np.arange(count)[:, None] * unknowns + np.arange(unknowns - below)).ravel()
        band[below, columns] = scaled[:, np.arange(below, unknowns), np.arange(unknowns - below)].ravel()
    band[0] += 1e-9
    flat = scale.ravel()
    band[unknowns, : (count - 1) * unknowns] = near[:-1].ravel() * flat[unknowns:] * flat[:-unknowns]
    band[2 * unknowns, : (count - 2) * unknowns] = far[:-2].ravel() * flat[2 * unknowns :] * flat[: -2 * unknowns]
    return -(scipy.linalg.solveh_banded(band, right.ravel() * flat, lower=True) * flat).reshape(count, unknowns)
