"""What a track looks like from outside: seams at the starts of blocks, jitter."""

from __future__ import annotations

import numpy as np

from fitting import camera
from fitting.rig import Rig, Surface, posed
from fitting.state import State

EVERY = 40  # vertices looked at


def points_m(rig: Rig, state: State) -> np.ndarray:
    """Every fortieth vertex in camera axes [T, N, 3] m."""
    whole = rig.vertices()
    some = slice(None, None, EVERY)
    few = Surface(
        whole.base[some], whole.shape_basis[some], whole.expression_basis[some], whole.normal[some], whole.skin[some],
        whole.pose_basis[some], whole.joints, whole.joint_shape_basis, whole.joint_expression_basis,
    )  # fmt: skip
    folded = few.folded(state.shape)
    return np.stack([posed(folded, state.pose(k)).points for k in range(len(state))])


def seams(rig: Rig, state: State, starts: np.ndarray, usable: np.ndarray) -> dict[str, float]:
    """How far frames jump at the starts of blocks beyond their neighbours' mean velocity.

    Returns:
        `largest_mm`, `largest_degrees` over the starts (0 without any), and the clip's own `median_mm`, `median_degrees` of the
        same measure, for comparison.
    """
    points, rotation = points_m(rig, state), state.rotation
    inner = np.arange(2, len(state) - 1)
    inner = inner[usable[inner] & usable[inner - 1] & usable[inner - 2] & usable[inner + 1]]
    if not len(inner):
        return {"largest_mm": 0.0, "largest_degrees": 0.0, "median_mm": 0.0, "median_degrees": 0.0}
    step = np.diff(points, axis=0)
    jump = np.linalg.norm(step[inner - 1] - 0.5 * (step[inner - 2] + step[inner]), axis=-1).mean(1) * 1e3
    turn = camera.log_rotation(rotation[1:] @ rotation[:-1].swapaxes(1, 2))
    angle = np.degrees(np.linalg.norm(turn[inner - 1] - 0.5 * (turn[inner - 2] + turn[inner]), axis=-1))
    at = np.isin(inner, starts)
    return {
        "largest_mm": float(jump[at].max(initial=0.0)),
        "largest_degrees": float(angle[at].max(initial=0.0)),
        "median_mm": float(np.median(jump)),
        "median_degrees": float(np.median(angle)),
    }


def jitter(rig: Rig, state: State, usable: np.ndarray) -> dict[str, float]:
    """Second differences over usable frames: of vertices (mm) and of the rotation (degrees), median of each."""
    inner = np.arange(1, len(state) - 1)
    inner = inner[usable[inner] & usable[inner - 1] & usable[inner + 1]]
    if not len(inner):
        return {"vertices_mm": 0.0, "rotation_degrees": 0.0}
    points = points_m(rig, state)
    bend = np.linalg.norm(points[inner + 1] - 2 * points[inner] + points[inner - 1], axis=-1).mean(1) * 1e3
    turn = camera.log_rotation(state.rotation[1:] @ state.rotation[:-1].swapaxes(1, 2))
    angle = np.degrees(np.linalg.norm(turn[inner] - turn[inner - 1], axis=-1))
    return {"vertices_mm": float(np.median(bend)), "rotation_degrees": float(np.median(angle))}
