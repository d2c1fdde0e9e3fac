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
    corners = points[:, list(OUTER_EYE_CORNERS)]
    scale = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)  # with depth: does not shrink with yaw
    found &= scale > 2.0
    chosen = points[:, model.ids, :2]
    inside = ((chosen > 1) & (chosen < np.array(size[::-1]) - 1)).all(-1)
    found &= inside.mean(1) > 0.5
    names = list(blendshape_names)
    score = np.stack([blendshapes[:, names.index(n)] if n in names else np.zeros(len(found)) for n in expression_names], 1)
    score = np.where(found[:, None] & np.isfinite(score), score, 0.0)
    return Observed(
        chosen, found, np.where(found, scale, 1.0), score, inside, _open(points), np.asarray(centre_px, np.float64)
    )


def _open(points: np.ndarray) -> np.ndarray:
    """How open each eye is [T, 2], left then right, from the lid gap over the eye's width."""
    eyes = []
    for pairs, corners in zip(LID_PAIRS, EYE_CORNERS, strict=True):
        upper, lower = np.moveaxis(points[:, np.array(pairs)], 2, 0)
        width = np.linalg.norm(points[:, corners[0]] - points[:, corners[1]], axis=1)
        gap = np.linalg.norm(upper - lower, axis=2).mean(1) / np.maximum(width, 1e-6)
        eyes.append(np.clip((gap - SHUT) / (OPEN - SHUT), 0, 1))
    return np.stack(eyes, 1)
