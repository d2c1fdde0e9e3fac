"""Rotations and the pinhole camera, float64 numpy: camera axes as OpenCV's, pixel centres at +0.5, camera fixed at the origin."""

from __future__ import annotations

import numpy as np

SMALL = 1e-4  # below this angle (rad) the series are exact to float64


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """Matrices [..., 3, 3] with `cross_matrix(a) @ b == cross(a, b)` of vectors [..., 3]."""
    out = np.zeros((*vector.shape, 3))
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def _series(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """sin(a)/a, (1-cos a)/a^2, (a-sin a)/a^3 of angles [...] with their limits at zero."""
    small = angle < SMALL
    safe = np.where(small, 1.0, angle)
    square = angle**2
    return (
        np.where(small, 1 - square / 6, np.sin(safe) / safe),
        np.where(small, 0.5 - square / 24, 2 * np.sin(safe / 2) ** 2 / safe**2),
        np.where(small, 1 / 6 - square / 120, (safe - np.sin(safe)) / safe**3),
    )


def exp_rotation(vector: np.ndarray) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of axis-angle vectors [..., 3] (rad)."""
    sine, cosine, _ = _series(np.linalg.norm(vector, axis=-1)[..., None, None])
    cross = cross_matrix(vector)
    return np.eye(3) + sine * cross + cosine * cross @ cross


def left_jacobian(vector: np.ndarray) -> np.ndarray:
    """J [..., 3, 3] with `exp(w + dw) = exp(J dw) exp(w)` to first order, of axis-angle vectors w [..., 3]."""
    _, cosine, cubic = _series(np.linalg.norm(vector, axis=-1)[..., None, None])
    cross = cross_matrix(vector)
    return np.eye(3) + cosine * cross + cubic * cross @ cross


def log_rotation(matrix: np.ndarray) -> np.ndarray:
    """Axis-angle vectors [..., 3] of rotation matrices [..., 3, 3]; the angle lies in [0, pi]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(*matrix.shape[:-2], 3)


def project(points: np.ndarray, focal_px: float, centre_px: np.ndarray) -> np.ndarray:
    """Pixels [..., 2] of camera-space points [..., 3] m."""
    return focal_px * points[..., :2] / points[..., 2:] + centre_px


def project_jacobian(points: np.ndarray, focal_px: float) -> np.ndarray:
    """Derivative [..., 2, 3] of `project` with respect to the points [..., 3], px per m."""
    near = focal_px / points[..., 2]
    out = np.zeros((*points.shape[:-1], 2, 3))
    out[..., 0, 0] = out[..., 1, 1] = near
    out[..., 2] = -points[..., :2] * (near / points[..., 2])[..., None]
    return out
