"""What a track looks like from outside: seams at the starts of blocks, jitter."""

from __future__ import annotations

import numpy as np

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
    """How far frames jump at the starts of blocks.

    A jump is what a frame moves beyond its neighbours' mean velocity.  A head that really sets off at that frame jumps in the
    frames around it too, so the seam is what the start jumps beyond the frames before and after it.

    Returns:
        `seam_mm`, `seam_degrees`: largest over the starts (0 without any); `jump_mm`, `jump_degrees`: the starts' largest jump
        itself; `median_mm`, `median_degrees`: median jump of the clip.
    """
    points = points_m(rig, state)
    inner = np.arange(2, len(state) - 1)
    inner = inner[usable[inner] & usable[inner - 1] & usable[inner - 2] & usable[inner + 1]]
    out = {}
    step = np.diff(points, axis=0)
    for name, way, size in (
        ("mm", step, lambda bend: 1e3 * np.linalg.norm(bend, axis=-1).mean(1)),
        ("degrees", state.turns, lambda bend: np.degrees(np.linalg.norm(bend, axis=-1))),
    ):
        jump = np.zeros(len(state))
        if len(inner):
            jump[inner] = size(way[inner - 1] - 0.5 * (way[inner - 2] + way[inner]))
        at = np.intersect1d(inner, starts)
        beyond = jump[at] - np.maximum(jump[at - 2], jump[np.minimum(at + 2, len(state) - 1)])
        out[f"seam_{name}"] = float(beyond.max(initial=0.0))
        out[f"jump_{name}"] = float(jump[at].max(initial=0.0))
        out[f"median_{name}"] = float(np.median(jump[inner])) if len(inner) else 0.0
    return out


def jitter(rig: Rig, state: State, usable: np.ndarray) -> dict[str, float]:
    """Second differences over usable frames: of vertices (mm) and of the rotation (degrees), median of each."""
    inner = np.arange(1, len(state) - 1)
    inner = inner[usable[inner] & usable[inner - 1] & usable[inner + 1]]
    if not len(inner):
        return {"vertices_mm": 0.0, "rotation_degrees": 0.0}
    points = points_m(rig, state)
    bend = np.linalg.norm(points[inner + 1] - 2 * points[inner] + points[inner - 1], axis=-1).mean(1) * 1e3
    turn = state.turns
    angle = np.degrees(np.linalg.norm(turn[inner] - turn[inner - 1], axis=-1))
    return {"vertices_mm": float(np.median(bend)), "rotation_degrees": float(np.median(angle))}
