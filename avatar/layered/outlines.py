"""How far hair stands off the skin: measured on the mattes' outlines, where a ray just touches it, and drawn on smoothly between.

Colours say little about it: hair looks alike everywhere and shines, and a plane sweep finds it too low.  A head that turns shows
its outline in a wide band over the scalp; the rest lies between that band and the forehead.  Letters: V vertices, T frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from avatar.dataset import Scene
from avatar.layered.shells import averaging, inner_triangles
from fitting import raster
from fitting.head_model import REGIONS, HeadModel

RAYS = 240  # of an outline, at most
BORDER_PX = 3  # an outline this close to the picture's border is cut off there
SMOOTH = 30.0  # weight of a vertex's difference from its neighbours' mean against one measurement
SWEPT = 0.02  # weight of what a plane sweep says of the scalp, against one measurement


def outline(alpha: np.ndarray) -> np.ndarray:
    """Pixels [N, 2] (column, row) of the outline of a matte's [H, W] uint8 largest part, without the picture's border."""
    opaque = cv2.morphologyEx((alpha > 127).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    found = cv2.findContours(opaque, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    if not found:
        return np.zeros((0, 2), np.int64)
    pixels = max(found, key=cv2.contourArea)[:, 0].astype(np.int64)
    height, width = alpha.shape
    inside = ((pixels >= BORDER_PX) & (pixels < [width - BORDER_PX, height - BORDER_PX])).all(1)
    return pixels[inside][:: max(1, -(-len(pixels) // RAYS))]


def touched(scene: Scene, alpha: np.ndarray, frames: Sequence[int]) -> np.ndarray:
    """Mean distance [V] m at which the outlines' rays pass the scalp's vertices that lie nearest to them; NaN where none does.

    alpha: [T, H, W] uint8; frames: those looked at. A ray that meets the mesh passes it at no distance. Rays that lie nearest to
    other parts tell nothing: beside jaw and neck the mattes are cut (`fitting.trim`).
    """
    triangles = scene.head.triangles.cpu().numpy()
    skin = np.unique(triangles[~inner_triangles(scene.head)])
    total, count = np.zeros((2, scene.head.vertex_count))
    for frame in frames:
        pixels = outline(alpha[frame])
        if not len(pixels):
            continue
        view, vertices = scene.view(frame, alpha.shape[1:]), scene.vertices_m[scene.place[frame]].numpy().astype(np.float64)
        drawn = raster.rasterise(view.pixels_of(vertices), triangles, alpha.shape[1:])[0] >= 0
        rays = view.through(*pixels.T)
        towards = vertices[skin] - rays.origins_m[:1].astype(np.float64)
        along = towards @ rays.directions.T.astype(np.float64)
        away = np.sqrt(np.maximum((towards**2).sum(1)[:, None] - along**2, 0))  # [V', N]
        nearest = away.argmin(0)
        distance = np.where(drawn[pixels[:, 1], pixels[:, 0]], 0.0, away[nearest, np.arange(len(pixels))])
        np.add.at(total, skin[nearest], distance)
        np.add.at(count, skin[nearest], 1)
    scalp = scene.head.region.cpu().numpy() == REGIONS.index("scalp")
    return np.where(scalp & (count > 0), total / np.maximum(count, 1), np.nan)


def surface(head: HeadModel, touched_m: np.ndarray, swept_m: np.ndarray) -> np.ndarray:
    """Height [V] m of what is seen above the skin: smooth, close to the outlines' and, away from the scalp, to the sweep's.

    touched_m: [V] from `touched`; swept_m: [V] of a plane sweep, NaN where it says nothing. All NaN where both say nothing.
    """
    if not (np.isfinite(touched_m) | np.isfinite(swept_m)).any():
        return np.full(head.vertex_count, np.nan)
    scalp = head.region.cpu().numpy() == REGIONS.index("scalp")
    weight, right = np.full(head.vertex_count, 1e-6), np.zeros(head.vertex_count)
    for heights, share in ((touched_m, 1.0), (swept_m, np.where(scalp, SWEPT, 1.0))):
        known = np.where(np.isfinite(heights), share, 0.0)
        weight += known
        right += known * np.nan_to_num(heights)
    bend = sparse.eye(head.vertex_count) - averaging(head)
    return np.maximum(spsolve((sparse.diags(weight) + SMOOTH * bend.T @ bend).tocsc(), right), 0.0)
