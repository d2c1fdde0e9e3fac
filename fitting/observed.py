"""What the detector saw of a whole clip, as the fit reads it: placed landmarks, their weights, iris and lid state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fitting.energy import Frame
from fitting.landmark_model import EYE_CORNERS, IRIS_RINGS, LID_PAIRS, OUTER_EYE_CORNERS, LandmarkModel

SHUT, OPEN = 0.07, 0.14  # lid gap over eye width: an iris counts nothing below, fully above


@dataclass(frozen=True)
class Observed:
    """Landmarks of a whole clip, restricted to the placed ones."""

    points: np.ndarray  # [T, L, 2] px; zero where not found
    found: np.ndarray  # [T] bool
    scale_px: np.ndarray  # [T] inter-ocular distance as seen head-on
    expression_mean: np.ndarray  # [T, E]
    inside: np.ndarray  # [T, L] bool, the point lies in the picture
    open_eyes: np.ndarray  # [T, 2] 1 open, 0 shut; left, right
    centre_px: np.ndarray  # [2]

    def frame(self, model: LandmarkModel, row: int, gaze_mean: np.ndarray | None = None, keep: np.ndarray | None = None) -> Frame:
        """Observations of one frame; keep [L] bool hides landmarks; gaze_mean [4] is where a shut eye looks."""
        weight = self.inside[row] * float(self.found[row])
        weight[model.pupil] *= self.open_eyes[row]
        weight = weight if keep is None else weight * keep
        held = np.zeros(4) if gaze_mean is None else gaze_mean
        return Frame(self.points[row], weight, self.scale_px[row], self.expression_mean[row], self.open_eyes[row], held)


def observe(
    model: LandmarkModel,
    points: np.ndarray,
    found: np.ndarray,
    blendshapes: np.ndarray,
    blendshape_names: list[str],
    expression_names: tuple[str, ...],
    centre_px: np.ndarray,
    size: tuple[int, int],
) -> Observed:
    """Collect what the detector saw.

    Args:
        points: [T, 478, 3] px, depth in px too; found: [T] bool; blendshapes: [T, 51] by name; size: (H, W) px.

    The blendshape scores become the centre of the expression prior where the head model has an action of that name: with it the
    identity stays within 2 standard deviations instead of 4 at the same held-out error.  An iris centre is the mean of its five
    points.
    """
    found = np.asarray(found, bool) & np.isfinite(points).all((1, 2))
    points = np.where(found[:, None, None], points, 0.0).astype(np.float64)
    for ring in IRIS_RINGS:
        points[:, ring[0]] = points[:, list(ring)].mean(1)
    within = ((points[..., :2] > 1) & (points[..., :2] < np.array(size[::-1]) - 1)).all(-1)
    scale = _interocular(points, within)
    found &= scale > 2.0
    chosen, inside = points[:, model.ids, :2], within[:, model.ids]
    found &= inside.mean(1) > 0.5
    names = list(blendshape_names)
    score = np.stack([blendshapes[:, names.index(n)] if n in names else np.zeros(len(found)) for n in expression_names], 1)
    score = np.where(found[:, None] & np.isfinite(score), score, 0.0)
    return Observed(chosen, found, np.where(found, scale, 1.0), score, inside, _open(points), np.asarray(centre_px, np.float64))


def _interocular(points: np.ndarray, within: np.ndarray) -> np.ndarray:
    """Distance [T] px of the outer eye corners, with depth, so that it does not shrink with yaw.

    A detector may clamp what lies outside the picture, so a frame without both corners takes the nearest frame's that has them.
    """
    corners = points[:, list(OUTER_EYE_CORNERS)]
    scale = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)
    seen = np.flatnonzero(within[:, list(OUTER_EYE_CORNERS)].all(1) & (scale > 2.0))
    if not len(seen):
        return scale
    right = np.searchsorted(seen, np.arange(len(scale))).clip(0, len(seen) - 1)
    left = (right - 1).clip(0)
    nearest = np.where(np.abs(seen[right] - np.arange(len(scale))) < np.abs(seen[left] - np.arange(len(scale))), right, left)
    clamped = within.any(1) & ~within[:, list(OUTER_EYE_CORNERS)].all(1)
    return np.where(clamped, scale[seen[nearest]], scale)


def _open(points: np.ndarray) -> np.ndarray:
    """How open each eye is [T, 2], left then right, from the lid gap over the eye's width.

    The gap is a mean of vectors across the line of the corners, with a sign: noise would hold a shut eye open else.
    """
    eyes = []
    for pairs, corners, side in zip(LID_PAIRS, EYE_CORNERS, (1, -1), strict=True):
        upper, lower = np.moveaxis(points[:, np.array(pairs)], 2, 0)
        along = side * (points[:, corners[0]] - points[:, corners[1]])  # towards the subject's left
        width = np.maximum(np.linalg.norm(along, axis=1), 1e-6)[:, None]
        gap = (lower - upper).mean(1)
        gap = gap - (gap * along).sum(1, keepdims=True) / width**2 * along
        down = np.sign(along[:, 0] * gap[:, 1] - along[:, 1] * gap[:, 0])
        eyes.append(np.clip((down * np.linalg.norm(gap, axis=1) / width[:, 0] - SHUT) / (OPEN - SHUT), 0, 1))
    return np.stack(eyes, 1)
