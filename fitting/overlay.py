"""The tracked mesh drawn over the video, for eyes."""

from __future__ import annotations

import cv2
import numpy as np

from fitting import camera, raster

MESH_COLOUR = np.array([0.35, 0.62, 1.0])
LANDMARK_COLOUR = np.array([60, 220, 90], np.uint8)


def draw_mesh(
    frame: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, focal_px: float, centre_px: np.ndarray, opacity: float = 0.6
) -> np.ndarray:
    """Shaded mesh blended over a frame, drawn at half the size (a quarter of the time, and nobody sees it).

    Args:
        frame: [H, W, 3] uint8 RGB; vertices: [V, 3] m in camera axes.

    Returns:
        [H, W, 3] uint8.
    """
    height, width = frame.shape[:2]
    small = (-(-height // 2), -(-width // 2))
    picture, index = raster.shade(
        vertices, triangles, focal_px / 2, np.asarray(centre_px) / 2, small, MESH_COLOUR, background=0.0
    )
    cover = (index >= 0).astype(np.float32)
    layer = cv2.resize(np.dstack([picture * cover[..., None], cover]), None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
    layer = layer[:height, :width] * opacity
    return np.clip((1 - layer[..., 3:]) * frame + 255 * layer[..., :3], 0, 255).astype(np.uint8)


def draw_points(frame: np.ndarray, points: np.ndarray) -> np.ndarray:
    """A copy of a frame [H, W, 3] with points [L, 2] px marked."""
    out = frame.copy()
    pixel = np.floor(points).astype(int)
    inside = ((pixel >= 0) & (pixel < np.array(frame.shape[1::-1]))).all(1)
    out[pixel[inside, 1], pixel[inside, 0]] = LANDMARK_COLOUR
    return out


def overlay(
    frame: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, landmarks: np.ndarray, focal_px: float, centre_px: np.ndarray
) -> np.ndarray:
    """Side by side [H, 2W, 3]: the frame with the model's landmarks [L, 3] m, and the mesh over it."""
    points = camera.project(landmarks.astype(np.float64), focal_px, centre_px)
    return np.concatenate([draw_points(frame, points), draw_mesh(frame, vertices, triangles, focal_px, centre_px)], 1)
