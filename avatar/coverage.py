"""What of an image the posed mesh and its shell cover: pixels worth a ray, thickness from the mattes, the preflight check."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from avatar import shell
from avatar.dataset import CELL, Scene, shrink_any
from fitting.head_model import REGIONS
from fitting.landmark_model import EYES, LIPS

# Shell thickness before the mattes are seen, in metres: how far hair stands off the mesh there, or the fit is off.
BASE_M = {
    "face": 0.009,
    "scalp": 0.025,
    "ears": 0.012,
    "neck": 0.014,
    "eyeballs": 0.006,
    "mouth_cavity": 0.006,
    "teeth": 0.006,
    "tongue": 0.006,
}
LARGEST_M = 0.08
MARGIN_M = 0.004
SPREAD_M = 0.015  # a measured thickness holds for the vertices within this distance, because only silhouettes are measured
FAR_BLOCKS = 1e4  # from the image's corner: beyond it a landmark is not in the picture, whatever the codes are
PREFLIGHT_OVERLAP = 0.4


def block_rays(scene: Scene, frame: int, size: tuple[int, int]):  # noqa: ANN201
    """Rays through the centres of the CELL x CELL blocks of an image of `size` (height, width), row-major; and (h, w)."""
    shape = (-(-size[0] // CELL), -(-size[1] // CELL))
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    middle = CELL / 2 - 0.5
    return scene.rays(frame, columns.ravel() * CELL + middle, rows.ravel() * CELL + middle), shape


def hit_blocks(grid: shell.Grid, scene: Scene, frame: int, size: tuple[int, int]) -> np.ndarray:
    """[h, w] bool: blocks whose central ray meets the shell."""
    rays, shape = block_rays(scene, frame, size)
    return (shell.intervals(grid, rays.origins_m, rays.directions, 1e-6)[1] > 0).reshape(shape)


def feature_blocks(scene: Scene, frame: int, size: tuple[int, int]) -> np.ndarray:
    """[h, w] bool: blocks of the mouth and of the eyes in a frame of `size`, a block's width around their landmarks' hulls."""
    shape = (-(-size[0] // CELL), -(-size[1] // CELL))
    points = scene.head.landmarks(scene.vertices_m[scene.place[frame]]).numpy()
    covered = np.zeros(shape, np.uint8)
    for ids in (LIPS, EYES[: len(EYES) // 2], EYES[len(EYES) // 2 :]):
        placed = points[list(ids)].astype(np.float64)
        with np.errstate(all="ignore"):
            block = scene.pixels_of(frame, placed) / CELL - 0.5
        block = block[np.isfinite(block).all(1) & (np.abs(block) < FAR_BLOCKS).all(1)]
        if len(block) > 2:
            hull = cv2.convexHull(block.astype(np.float32))
            cv2.fillConvexPoly(covered, np.round(hull).astype(np.int32), 1)
    return ndimage.binary_dilation(covered > 0, iterations=1)


def base_thickness(region: np.ndarray, vertices_m: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Thickness [V] m by region label [V], and enough that the balls of neighbouring vertices [V, 3] close the surface."""
    longest = np.zeros(len(vertices_m))
    for a, b in ((0, 1), (1, 2), (2, 0)):
        edge = np.linalg.norm(vertices_m[triangles[:, a]] - vertices_m[triangles[:, b]], axis=1)
        np.maximum.at(longest, triangles[:, a], edge)
        np.maximum.at(longest, triangles[:, b], edge)
    return np.maximum(np.array([BASE_M[name] for name in REGIONS])[region], longest * 0.75)


def measured_thickness(scene: Scene, alphas: np.ndarray, frames: Sequence[int], base_m: np.ndarray) -> np.ndarray:
    """Thickness [V] that also holds hair, glasses and beard: opaque pixels beside the mesh pull the shell out to them.

    alphas: [T, H, W] uint8; frames: those looked at; base_m: [V].
    Each opaque block that the base shell misses asks the vertex that lacks least for what it lacks.
    """
    needed = base_m.copy()
    for frame in frames:
        vertices = scene.vertices_m[scene.place[frame]].numpy()
        grid = shell.occupancy(vertices, base_m, np.zeros((0, 3)))
        rays, shape = block_rays(scene, frame, alphas.shape[1:])
        hit = hit_blocks(grid, scene, frame, alphas.shape[1:])
        missed = ndimage.binary_opening(shrink_any(alphas[frame], 128), iterations=1) & ~hit  # specks of the matte do not count
        directions = rays.directions.reshape(*shape, 3)[missed].astype(np.float64)
        towards = vertices - scene.camera_centre_m(frame)
        for direction in directions:
            along = towards @ direction
            away = np.sqrt(np.maximum((towards * towards).sum(1) - along * along, 0)) + MARGIN_M
            best = np.argmin(away - base_m)
            needed[best] = max(needed[best], away[best])
    needed = np.minimum(needed, LARGEST_M)
    around = cKDTree(scene.neutral_m.numpy()).query_ball_point(scene.neutral_m.numpy(), SPREAD_M)
    larger = needed > base_m
    return np.array([max(needed[v], needed[near][larger[near]].max(initial=0.0)) for v, near in enumerate(around)])


def overlap(scene: Scene, alpha: np.ndarray, frame: int) -> float:
    """Intersection over union of the projected mesh and the matte [H, W], on blocks; 0 where both are empty."""
    vertices = scene.vertices_m[scene.place[frame]].numpy()
    grid = shell.occupancy(vertices, np.full(len(vertices), 2 * shell.VOXEL_M), np.zeros((0, 3)))
    mesh = ndimage.binary_closing(np.pad(hit_blocks(grid, scene, frame, alpha.shape), 4), iterations=3)[4:-4, 4:-4]
    matte = shrink_any(alpha, 128)
    union = (mesh | matte).sum()
    return float((mesh & matte).sum() / union) if union else 0.0
