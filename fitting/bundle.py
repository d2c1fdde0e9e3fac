"""The bundle: all frames of one part together, with temporal terms."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np

from fitting import camera, energy, solver
from fitting.energy import State, Weights
from fitting.landmark_model import LandmarkModel
from fitting.stages import Observed


@dataclass(frozen=True)
class Smoothness:
    """Standard deviations of the second difference from frame to frame, at 30 frames a second."""

    rotation_rad: float
    across_m: float
    depth_m: float
    expression: float
    gaze_rad: float

    def at_rate(self, fps: float) -> Smoothness:
        """The same accelerations a second at another frame rate: a second difference grows with the square of its interval."""
        return Smoothness(*(value * (30 / fps) ** 2 for value in astuple(self)))


def smooth(
    model: LandmarkModel,
    observed: Observed,
    rows: np.ndarray,
    weights: Weights,
    state: State,
    smoothness: Smoothness,
    sweeps: int,
) -> State:
    """Bundle over consecutive frames: landmark energy plus accelerations, shared unknowns held.

    Frames that are three apart do not meet in any acceleration, so a third of all frames is solved at once (one damped
    Gauss-Newton step each) while the others stand still.  Closes the seams between blocks and takes the detector's jitter out;
    frames without a face are carried by their neighbours.

    Args:
        rows: [B] consecutive frame numbers of one part (training or test); state: of these rows.
    """
    if len(rows) < 5:
        return state
    count = state.expression.shape[1]
    deviation = np.concatenate(
        [
            np.full(3, smoothness.rotation_rad),
            [smoothness.across_m, smoothness.across_m, smoothness.depth_m],
            np.full(count, smoothness.expression),
            np.full(energy.GAZE, smoothness.gaze_rad),
        ]
    )
    for sweep in range(3 * sweeps):
        some = np.arange(2 + sweep % 3, len(rows) - 2, 3)
        normal = energy.linearise(model, observed.frames(rows[some]), weights, state.frame(some))
        pull = _acceleration_anchor(state, some)  # where the neighbours would put this frame, as a step
        precision = 6 / deviation**2
        hessian = normal.hessian + np.diag(precision)
        step = -solver.damped_solve(hessian, normal.gradient - precision * pull, 1e-3)
        moved = energy.update(state.frame(some), step, None)
        values = {name: getattr(state, name).copy() for name in ("rotation", "translation", "expression", "gaze")}
        for name, value in values.items():
            value[some] = getattr(moved, name)
        state = replace(state, **values)
    return state


def _acceleration_anchor(state: State, rows: np.ndarray) -> np.ndarray:
    """Step [B, 6 + E + 4] from each row's parameters to the minimum of the five-frame acceleration energy around it.

    The three second differences that contain x_t have their joint minimum at (4 (x_-1 + x_+1) - x_-2 - x_+2) / 6, precision 6.
    """
    flat = np.concatenate([state.translation, state.expression, state.gaze], 1)
    own = state.rotation[rows]
    total = np.zeros((len(rows), 3 + flat.shape[1]))
    for offset, weight in ((-2, -1), (-1, 4), (1, 4), (2, -1)):
        total[:, :3] += weight * camera.log_rotation(state.rotation[rows + offset] @ own.swapaxes(1, 2))
        total[:, 3:] += weight * (flat[rows + offset] - flat[rows])
    return total / 6
