"""Two expression components that close the eyes of a head model whose own components do it poorly (FLAME).

Made from the mesh alone: the opening is where the eyeball is seen from the front; the rim of the upper lid turns about the
eyeball's horizontal axis until it lies on the lower lid, column by column, and the skin above follows less and less.  The
components are linear like all others, so half way the lid takes the chord: up to about a millimetre inside the eyeball.
"""

from __future__ import annotations

import numpy as np

from fitting import raster

PIXEL_M = 0.00025
REACH = 2.2  # half the side of the window that is looked at, in eyeball radii
FOLD_RAD = 0.7  # how far above the rim the lid follows
FULL, NONE = 1.25, 1.8  # radii between which the motion fades out
OVERLAP_RAD = 0.03  # the rim goes this far below the lower one, so that no gap is left between vertices
LEAST_COLUMNS = 12  # of an eye that is open


def eyelids(points: np.ndarray, triangles: np.ndarray, balls: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Displacements [2, V, 3] m that close the left and the right eye.

    Args:
        points: [V, 3] m, neutral head with open eyes, in our axes; triangles: [F, 3].
        balls: [V] bool of the left and the right eyeball.

    Raises:
        ValueError: an eyeball is not seen from the front.
    """
    either = balls[0] | balls[1]
    return np.stack([_closing(points, triangles, ball, either) for ball in balls])


def opening(points: np.ndarray, triangles: np.ndarray, ball: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where an eyeball is seen from the front.

    Returns:
        seen [H, W] bool, pixels of PIXEL_M; depth [H, W] m, z of the first surface. The window is centred on the eyeball.
    """
    centre, radius = _sphere(points[ball])
    side = int(2 * REACH * radius / PIXEL_M)
    far = 10.0  # from so far away the perspective is as good as parallel
    flat = (points - centre) / [PIXEL_M, PIXEL_M, 1] + [side / 2, side / 2, far]
    near = (np.abs(flat[triangles][..., :2] - side / 2) < side).all((1, 2))
    index, depth, _ = raster.rasterise(flat, triangles[near], (side, side))
    return (index >= 0) & ball[triangles[near]].all(1)[index.clip(0)], depth - far + centre[2]


def _sphere(ball: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre [3] and radius of an eyeball's vertices."""
    centre = (ball.min(0) + ball.max(0)) / 2
    return centre, float(np.ptp(ball, 0).mean() / 2)


def _closing(points: np.ndarray, triangles: np.ndarray, ball: np.ndarray, either: np.ndarray) -> np.ndarray:
    """Displacement [V, 3] that closes one eye."""
    centre, radius = _sphere(points[ball])
    seen, depth = opening(points, triangles, ball)
    columns = np.flatnonzero(seen.any(0))
    if len(columns) < LEAST_COLUMNS:
        raise ValueError(f"no eye opening is seen from the front at x = {centre[0]:.3f} m; the template's eyes must be open")
    middle = seen.shape[0] / 2

    def elevation(rows: np.ndarray) -> np.ndarray:
        """Angle above the horizontal of the surface at some row of each column, smoothed along the lid."""
        down = (rows + 0.5 - middle) * PIXEL_M
        angle = np.arctan2(-down, centre[2] - depth[rows, columns])
        padded = np.pad(angle, 4, mode="edge")
        return np.convolve(padded, np.ones(9) / 9, "valid")

    upper, lower = elevation(seen[:, columns].argmax(0)), elevation(len(seen) - 1 - seen[::-1, columns].argmax(0))
    across = (columns + 0.5 - middle) * PIXEL_M
    offset = points - centre
    rim = np.interp(offset[:, 0], across, upper)
    angle = np.interp(offset[:, 0], across, upper - lower + OVERLAP_RAD, left=0, right=0)
    corner = np.clip(np.minimum(offset[:, 0] - across[0], across[-1] - offset[:, 0]) / 0.002, 0, 1)  # the lids meet
    height, far = np.arctan2(-offset[:, 1], -offset[:, 2]), np.hypot(offset[:, 1], offset[:, 2])
    follow = 1 - _smooth((height - rim) / FOLD_RAD)
    follow *= 1 - _smooth((np.linalg.norm(offset, axis=1) / radius - FULL) / (NONE - FULL))
    follow *= _smooth((height - (rim - angle / 2)) / (0.1 * angle + 1e-6) + 0.5)  # the lower lid stays
    turned = height - angle * corner * follow
    moved = np.stack([np.zeros_like(far), far * (np.sin(height) - np.sin(turned)), far * (np.cos(height) - np.cos(turned))], 1)
    return np.where(either[:, None], 0, moved)


def _smooth(value: np.ndarray) -> np.ndarray:
    """Smooth step from 0 at 0 to 1 at 1."""
    value = np.clip(value, 0, 1)
    return value * value * (3 - 2 * value)
