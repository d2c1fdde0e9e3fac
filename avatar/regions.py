"""Where a head is scored besides the whole of it: face hull, mouth box and eye boxes, from the input's MediaPipe landmarks.

The *face* is the convex hull of the mesh's landmarks. A *box* is the upright rectangle around a feature's contour, MARGIN of the
face's length wider on every side; the face's length is the largest distance between two of its landmarks (brow to chin), which
neither yaw nor roll shortens. Boxes follow the landmarks of the input, never those of a render, so that every method is
scored on the same pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.distance import pdist

HULL_POINTS = 468  # the face mesh; MediaPipe's last ten points are the irises, inside it
# MediaPipe's own index lists (Apache-2.0): outer contour of the lips; contours of the subject's left and right eye.
# fmt: off
LIPS = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 185, 40, 39, 37, 0, 267, 269, 270, 409)
EYES = {
    "left": (263, 249, 390, 373, 374, 380, 381, 382, 362, 466, 388, 387, 386, 385, 384, 398),
    "right": (33, 7, 163, 144, 145, 153, 154, 155, 133, 246, 161, 160, 159, 158, 157, 173),
}
EYE_CORNERS = {"left": (263, 362), "right": (33, 133)}
# fmt: on
MARGIN = 0.06
"""Of the face's length, about 1 cm on a head: a mouth box holds the lips' surroundings, an eye box the lids and no brow."""
INSIDE_SHARE = 0.5
"""A region with less than this share of its landmarks in the picture is left out."""
RIM_PX = 6
"""Landmarks this near to the border, or beyond it, are outside of the picture: SSIM has no value there."""
TURNED_RATIO = 0.4
"""An eye whose corners are closer than this part of the other's is turned away: a frontal pair at about 58 degrees of yaw."""
NAMES = ("face", "mouth", "eyes")


@dataclass(frozen=True)
class Box:
    """Pixels [top, bottom) x [left, right)."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the box in an array [H, W]."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


@dataclass(frozen=True)
class Regions:
    """The regions of one frame; what is left out has its reason in `notes`."""

    face: np.ndarray | None = None  # bool [H, W]
    mouth: tuple[Box, ...] = ()
    eyes: tuple[Box, ...] = ()
    notes: tuple[str, ...] = ("no face landmarks: face, mouth and eyes left out",)


def find(points: np.ndarray | None, size: tuple[int, int]) -> Regions:
    """Regions of a frame.

    Args:
        points: [478, 2 or 3] px, pixel centres at +0.5; None where no face was found.
        size: H, W.
    """
    if points is None or not np.isfinite(points[:, :2]).all():
        return Regions()
    points = points[:, :2].astype(np.float64)
    notes, length = [], face_length(points)
    if length < 1:  # px: all landmarks in one place are no face
        return Regions()
    if (face := hull(points, size)) is None:
        notes.append("face out of the picture: left out")
    mouth = box(points[list(LIPS)], MARGIN * length, size)
    if mouth is None:
        notes.append("mouth out of the picture: left out")
    widths = {side: np.linalg.norm(np.subtract(*points[list(corners)])) for side, corners in EYE_CORNERS.items()}
    eyes = []
    for side, ids in EYES.items():
        found = box(points[list(ids)], MARGIN * length, size)
        if widths[side] < TURNED_RATIO * max(widths.values()):
            notes.append(f"{side} eye turned away: left out")
        elif found is None:
            notes.append(f"{side} eye out of the picture: left out")
        else:
            eyes.append(found)
    return Regions(face, () if mouth is None else (mouth,), tuple(eyes), tuple(notes))


def face_length(points: np.ndarray) -> float:
    """Largest distance in px between two of the face mesh's landmarks [478, 2]."""
    corners = cv2.convexHull(points[:HULL_POINTS].astype(np.float32))[:, 0]
    return float(pdist(corners).max()) if len(corners) > 1 else 0.0


def hull(points: np.ndarray, size: tuple[int, int]) -> np.ndarray | None:
    """Mask bool [H, W] of the hull of the face landmarks [478, 2] px, None where less than half of them are in the picture."""
    if not _inside(points[:HULL_POINTS], size):
        return None
    corners = np.round(points[:HULL_POINTS] - 0.5).astype(np.int32)
    mask = np.zeros(size, np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(corners), 1)
    return mask.astype(bool) if mask.any() else None


def box(points: np.ndarray, margin_px: float, size: tuple[int, int]) -> Box | None:
    """Box around points [N, 2] px, `margin_px` wider on each side, cut at the frame; None where most points are outside of it."""
    if not _inside(points, size):
        return None
    (left, top), (right, bottom) = points.min(0) - margin_px, points.max(0) + margin_px
    rows, columns = (np.clip(ends, 0, side) for ends, side in (((top, bottom), size[0]), ((left, right), size[1])))
    return Box(int(np.floor(rows[0])), int(np.ceil(rows[1])), int(np.floor(columns[0])), int(np.ceil(columns[1])))


def widened(found: Box, smallest_px: int, size: tuple[int, int]) -> Box:
    """The box with at least `smallest_px` a side, where the picture has them: more of the picture around it, shifted inside.

    Context instead of enlargement: resampled pixels hold no finer detail and change the frequencies that a network compares,
    and a white rim would add edges that both images share.
    """

    def ends(first: int, last: int, side: int) -> tuple[int, int]:
        length = max(last - first, min(smallest_px, side))
        start = min(max(0, first - (length - (last - first)) // 2), side - length)
        return start, start + length

    rows, columns = ends(found.top, found.bottom, size[0]), ends(found.left, found.right, size[1])
    return Box(*rows, *columns)


def around(mask: np.ndarray) -> Box:
    """Bounding box of a mask [H, W] that is not empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return Box(int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1)


def _inside(points: np.ndarray, size: tuple[int, int]) -> bool:
    """Whether enough of points [N, 2] px lie in a frame of H, W."""
    within = (points >= RIM_PX) & (points <= np.array([size[1], size[0]]) - RIM_PX)
    return bool(within.all(1).mean() >= INSIDE_SHARE)
