"""The track as Neural Head Avatars and its tracker write it (`tracked_flame_params.npz`); keys and shapes as read in their code.

Their conventions (nha/models/flame.py, nha/data/real.py, nha/util/render.py of philgras/neural-head-avatars):
- camera axes are PyTorch3D's (x left, y up, z forward), so that a frontal head has the rotation (0, pi, 0);
- vertices are FLAME's less its root joint plus the translation;
- neck, jaw and eyes are stored before a tanh that maps the real line onto fixed limits;
- the focal length is divided by the longer image side, the principal point by width and height; the renderer takes `H - cy` for
  PyTorch3D's downward y, so the stored cy counts from the lower edge.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fitting.camera import log_rotation
from fitting.export_pose import FLIP, FlamePose

TO_PYTORCH3D = np.diag([-1.0, -1.0, 1.0])  # from OpenCV's camera axes
LIMITS_DEG = {  # one row an axis-angle component: lowest, highest
    "neck": ((-90, 90), (-60, 60), (-80, 80)),
    "jaw": ((-5, 60), (-0.1, 0.1), (-0.1, 0.1)),
    "eyes": ((-50, 50), (-50, 50), (-0.1, 0.1)),
}
INSIDE = 0.01  # of the limits' width that NHA itself keeps away from either end, where atanh explodes
TEXTURES = 100
UNIFORM_LIGHT = np.sqrt(4 * np.pi)  # NHA's start: the constant harmonic alone, shading 1


def limited(pose: FlamePose, parts: tuple[str, ...] = tuple(LIMITS_DEG)) -> FlamePose:
    """The nearest pose that the format can hold: each component of the named joints moved inside its limits."""
    return replace(pose, **{part: _clip(getattr(pose, part), part) for part in parts})


def arrays(pose: FlamePose, focal_px: float, centre_px: np.ndarray, size: tuple[int, int]) -> dict[str, np.ndarray]:
    """Content of `tracked_flame_params.npz`.

    Args:
        pose: T frames; what lies outside the limits is clipped as `limited` does.
        focal_px: focal length of the frames.
        centre_px: [2] principal point, from the upper left corner.
        size: (height, width) of the frames.

    Returns:
        arrays by NHA's keys; float32, ids int64, names text.
    """
    frames = len(pose.expression)
    rotation = np.einsum("ij,tjk,kl->til", TO_PYTORCH3D, pose.rotation, FLIP)
    translation = pose.offset @ TO_PYTORCH3D + np.einsum("tij,tj->ti", rotation, pose.root @ FLIP)
    light = np.zeros((frames, 9, 3))
    light[:, 0] = UNIFORM_LIGHT
    height, width = size
    real = {
        "rotation": _near(log_rotation(rotation), np.array([0.0, np.pi, 0.0])),
        "translation": translation,
        "neck_pose": _before_tanh(pose.neck, "neck"),
        "jaw_pose": _before_tanh(pose.jaw, "jaw"),
        "eyes_pose": _before_tanh(pose.eyes, "eyes").reshape(frames, 6),
        "shape": pose.shape,
        "expr": pose.expression,
        "texture": np.zeros(TEXTURES),
        "light": light,
        "K": np.array([focal_px / max(size), centre_px[0] / width, 1 - centre_px[1] / height]),
        "RT": np.eye(3, 4),
    }
    return {name: value.astype(np.float32) for name, value in real.items()} | {
        "frame": np.arange(1, frames + 1),  # of the folders frame_0001, ...
        "view": np.full(frames, "image_0000.png"),
        "image_size": np.array(size),
        "n_processed": np.array(frames),
    }


def _limits(part: str) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.radians(np.array(LIMITS_DEG[part], np.float64)).T
    return low, high


def _clip(angles: np.ndarray, part: str) -> np.ndarray:
    low, high = _limits(part)
    margin = INSIDE * (high - low)
    return np.clip(angles, low + margin, high - margin)


def _before_tanh(angles: np.ndarray, part: str) -> np.ndarray:
    """Unlimited numbers [..., 3] of angles (rad): NHA reads `low + (tanh(x) + 1) / 2 (high - low)`."""
    low, high = _limits(part)
    return np.arctanh(2 * (_clip(angles, part) - low) / (high - low) - 1)


def _near(vector: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The one of the two axis-angle vectors of each rotation [T, 3] that is nearer to a target: no sign flips about pi."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    other = vector * (1 - 2 * np.pi / np.maximum(angle, 1e-9))
    nearer = np.linalg.norm(other - target, axis=-1) < np.linalg.norm(vector - target, axis=-1)
    return np.where(nearer[:, None] & (angle > 1e-9), other, vector)
