"""A face of 478 landmarks with lips and eyes where MediaPipe numbers them: the front of an ellipsoid, turned and scaled."""

from __future__ import annotations

import numpy as np

from avatar.regions import EYE_CORNERS, EYES, LIPS

# Of the face's length, x to the right of the picture, y down, z away: middles and half sizes. The subject's left is on the right.
_MOUTH = ((0.0, 0.22, -0.36), (0.14, 0.05))
_EYES = {"left": ((0.17, -0.16, -0.30), (0.08, 0.025)), "right": ((-0.17, -0.16, -0.30), (0.08, 0.025))}
_LEAN_RAD = 0.3  # the plane of an eye looks to its side


def face(centre_px: tuple[float, float] | np.ndarray, length_px: float, yaw_degrees: float = 0.0) -> np.ndarray:
    """Landmarks float32 [478, 3] px around a centre, `length_px` from brow to chin; positive yaw turns to the subject's left."""
    along = np.linspace(0, 2 * np.pi, 478, endpoint=False)
    rings = np.linspace(0.2, 1, 478)
    points = np.stack([0.4 * rings * np.cos(7 * along), 0.5 * rings * np.sin(7 * along), np.zeros(478)], -1)
    points[:40, :2] = np.stack([0.4 * np.cos(along[:40] * 12), 0.5 * np.sin(along[:40] * 12)], -1)  # the outline
    points[:, 2] = -0.4 * np.sqrt(np.clip(1 - (points[:, 0] / 0.4) ** 2 - (points[:, 1] / 0.5) ** 2, 0, 1))
    points[list(LIPS)] = _ring(*_MOUTH, len(LIPS), 0.0)
    for side, (middle, half) in _EYES.items():
        sign = 1 if side == "left" else -1
        ids = [*EYE_CORNERS[side], *(number for number in EYES[side] if number not in EYE_CORNERS[side])]
        ring = _ring(middle, half, len(ids), sign * _LEAN_RAD)
        outer, inner = np.argmax(sign * ring[:, 0]), np.argmin(sign * ring[:, 0])
        order = [outer, inner, *(place for place in range(len(ids)) if place not in (outer, inner))]
        points[ids] = ring[order]
    yaw = np.radians(yaw_degrees)
    turn = np.array([[np.cos(yaw), 0, -np.sin(yaw)], [0, 1, 0], [np.sin(yaw), 0, np.cos(yaw)]])
    points = points @ turn.T * length_px
    return (points + [*centre_px, 0]).astype(np.float32)


def _ring(middle: tuple[float, ...], half: tuple[float, float], count: int, lean_rad: float) -> np.ndarray:
    """An ellipse [count, 3] whose plane looks to the side by an angle."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    across = half[0] * np.cos(angle)
    return np.stack([across * np.cos(lean_rad), half[1] * np.sin(angle), across * np.sin(lean_rad)], -1) + np.asarray(middle)
