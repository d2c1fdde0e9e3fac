"""One frame's geometry at speed: the head model's posing for one subject, normals, layers and their projection, in numba.

What `fitting.head_model.HeadModel` gives, with all that does not change from frame to frame done before: the same to a
micrometre (the tests hold it to that).  Letters: V vertices, F triangles, L layers, E expression codes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from avatar.layered.raster import NEAR_M
from fitting.camera import exp_rotation
from fitting.head_model import JOINTS, HeadModel
from fitting.raster import FLAT

PARTS = {"rotation": (3,), "neck": (3,), "jaw": (3,), "eyes": (2, 3), "translation": (3,)}


class PosedHead(NamedTuple):
    """One posed head in its neck-normalised frame, and where that frame is."""

    vertices_m: np.ndarray  # [V, 3] float32, with eye pose
    displacement_m: np.ndarray  # [V, 3] float32 of expression and jaw against neutral: what the networks read
    codes: np.ndarray  # [E + 3] float32, expression and jaw
    rotation: np.ndarray  # [3, 3] head frame to camera axes
    offset_m: np.ndarray  # [3]


class Poser:
    """The head model of one identity, made ready."""

    def __init__(self, head: HeadModel, shape: np.ndarray) -> None:
        """shape: [S]."""
        identity = head.template.new_tensor(np.asarray(shape, np.float64))
        self.neutral_m = head.shaped(identity).cpu().numpy().astype(np.float32)
        self._rest = head.joints_of(identity).double().cpu().numpy()  # [5, 3]
        self._rest_basis = head.joint_expression_basis.double().cpu().numpy()  # [E, 5, 3]
        basis = head.expression_basis.cpu().numpy().astype(np.float32)
        # Expressions leave most of a head where it is.
        self._moved = np.nonzero(np.abs(basis).max((0, 2)) > 0)[0] if len(basis) else np.zeros(0, np.int64)
        self._basis = np.ascontiguousarray(basis[:, self._moved]).reshape(len(basis), 3 * len(self._moved))
        self._correctives = head.pose_basis.cpu().numpy().astype(np.float32).reshape(len(head.pose_basis), 3 * head.vertex_count)
        self._weights = np.ascontiguousarray(head.skinning_weights.cpu().numpy(), np.float32)

    def pose(self, row: Mapping[str, Any]) -> PosedHead:
        """row: expression [E], rotation, neck, jaw, translation [3] and eyes [2, 3], as a frame of fit/track.npz.

        Raises ValueError naming what has another shape, is missing, or is not finite.
        """
        values = {}
        for name, size in (PARTS | {"expression": (len(self._basis),)}).items():
            if name not in row:
                raise ValueError(f"the parameters lack {name}")
            values[name] = np.asarray(row[name], np.float64)
            if values[name].shape != size:
                raise ValueError(f"{name} has the shape {values[name].shape}, the head model takes {size}")
            if not np.isfinite(values[name]).all():
                raise ValueError(f"{name} is not finite")
        expression = values["expression"]
        rest = self._rest + np.tensordot(expression, self._rest_basis, 1)
        turns = exp_rotation(np.stack([values["neck"], values["jaw"], *values["eyes"]]))  # [4, 3, 3]
        still = np.stack([np.eye(3), turns[1], np.eye(3), np.eye(3)])
        moved = self.neutral_m.copy()
        moved[self._moved] += (expression.astype(np.float32) @ self._basis).reshape(-1, 3)
        vertices, read = self._skinned(moved, turns, rest), self._skinned(moved, still, rest)
        root = exp_rotation(values["rotation"])
        offset = root @ (rest[1] - turns[0] @ rest[1] - rest[0]) + rest[0] + values["translation"]
        codes = np.concatenate([expression, values["jaw"]]).astype(np.float32)
        return PosedHead(vertices, read - self.neutral_m, codes, root @ turns[0], offset)

    def _skinned(self, moved: np.ndarray, turns: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """moved: [V, 3]; turns: [4, 3, 3] of neck, jaw and eyes. See `HeadModel.local`."""
        if len(self._correctives):
            features = (turns - np.eye(3)).astype(np.float32).reshape(-1)
            moved = moved + (features @ self._correctives).reshape(-1, 3)
        matrices = np.stack([turns[0].T, np.eye(3), *turns[1:]])  # the root undoes the neck's turn about the neck joint
        centres = np.stack([rest[1], *rest[1:]])
        shifts = centres - np.einsum("jab,jb->ja", matrices, centres)
        assert len(matrices) == len(JOINTS)
        out = np.empty_like(moved)
        _skin(moved, self._weights, matrices, shifts, out)
        return out


@njit(nogil=True, cache=True)
def _skin(points, weights, matrices, shifts, out):  # noqa: ANN001, ANN202
    for v in range(points.shape[0]):
        x, y, z = float(points[v, 0]), float(points[v, 1]), float(points[v, 2])
        for axis in range(3):
            total = 0.0
            for joint in range(weights.shape[1]):
                share = weights[v, joint]
                if share != 0:
                    turn = matrices[joint, axis]
                    total += share * (turn[0] * x + turn[1] * y + turn[2] * z + shifts[joint, axis])
            out[v, axis] = total


@njit(nogil=True, cache=True)
def normals(vertices, triangles):  # noqa: ANN001, ANN201
    """Unit normals [V, 3] float32 of vertices [V, 3] and triangles [F, 3], as `fitting.raster.vertex_normals`."""
    count = vertices.shape[0]
    total = np.zeros((count, 4))
    for f in range(triangles.shape[0]):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        ax, ay, az = float(vertices[a, 0]), float(vertices[a, 1]), float(vertices[a, 2])
        bx, by, bz = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
        cx, cy, cz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
        x, y, z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        scale = np.sqrt((bx * bx + by * by + bz * bz) * (cx * cx + cy * cy + cz * cz))
        for v in (a, b, c):
            total[v, 0] += x
            total[v, 1] += y
            total[v, 2] += z
            total[v, 3] += scale
    out = np.zeros((count, 3), np.float32)
    for v in range(count):
        length = np.sqrt(total[v, 0] ** 2 + total[v, 1] ** 2 + total[v, 2] ** 2)
        if length > FLAT * total[v, 3]:
            for axis in range(3):
                out[v, axis] = total[v, axis] / length
    return out


@njit(nogil=True, cache=True)
def layers(vertices, directions, offsets, rotation, shift, focal, centre):  # noqa: ANN001, ANN201
    """Each layer's vertices and their projections.

    vertices, directions: [V, 3] float32 and unit normals; offsets: [L, V] m along these.
    rotation [3, 3], shift [3]: head frame to camera axes; focal, centre [2] in px.
    Returns [L, V, 3] float32 m in the head frame, [L, V, 3] float32 (px, px, m), and the box of those before the camera in px:
    left, top, right, bottom (left > right when there are none).
    """
    places = np.empty((offsets.shape[0], vertices.shape[0], 3), np.float32)
    points = np.empty_like(places)
    left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
    for layer in range(offsets.shape[0]):
        for v in range(vertices.shape[0]):
            away = offsets[layer, v]
            x = vertices[v, 0] + away * directions[v, 0]
            y = vertices[v, 1] + away * directions[v, 1]
            z = vertices[v, 2] + away * directions[v, 2]
            places[layer, v, 0], places[layer, v, 1], places[layer, v, 2] = x, y, z
            depth = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + shift[2]
            across = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + shift[0]
            down = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + shift[1]
            points[layer, v, 2] = depth
            if depth > NEAR_M:
                column, row = focal * across / depth + centre[0], focal * down / depth + centre[1]
                left, right = min(left, column), max(right, column)
                top, bottom = min(top, row), max(bottom, row)
            else:
                column, row = 0.0, 0.0  # the rasteriser leaves its triangles out
            points[layer, v, 0], points[layer, v, 1] = column, row
    return places, points, (left, top, right, bottom)
