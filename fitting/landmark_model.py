"""Which detected landmark is what, and the head model's surface points at the landmarks.  L landmarks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fitting.correspondence import LEFT_IRIS, RIGHT_IRIS
from fitting.rig import Rig, Surface

# MediaPipe's own index lists (Apache-2.0), for weights only.
# fmt: off
LIPS = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 185, 40, 39, 37, 0, 267, 269, 270, 409, 78, 95, 88, 178, 87, 14, 317,
        402, 318, 324, 308, 191, 80, 81, 82, 13, 312, 311, 310, 415)
EYES = (263, 249, 390, 373, 374, 380, 381, 382, 362, 466, 388, 387, 386, 385, 384, 398, 33, 7, 163, 144, 145, 153, 154, 155, 133,
        246, 161, 160, 159, 158, 157, 173)
BROWS = (276, 283, 282, 295, 285, 300, 293, 334, 296, 336, 46, 53, 52, 65, 55, 70, 63, 105, 66, 107)
NOSE = (168, 6, 197, 195, 5, 4, 1, 2, 98, 97, 326, 327, 129, 358)
# fmt: on
OUTER_EYE_CORNERS = (33, 263)
IRIS_RINGS = ((473, 474, 475, 476, 477), (468, 469, 470, 471, 472))  # left, right eye: centre and ring
LID_PAIRS = (((386, 374), (385, 380), (387, 373)), ((159, 145), (158, 153), (160, 144)))  # left, right eye: upper and lower lid
UNIT_SIGMA = 0.012  # of the inter-ocular distance: what a relative standard deviation of 1 means
EYE_CORNERS = ((263, 362), (33, 133))  # left, right eye


@dataclass(frozen=True)
class LandmarkModel:
    """Landmarks that have a place on the mesh."""

    ids: np.ndarray  # [L] MediaPipe numbers
    surface: Surface  # L points
    pupil: np.ndarray  # [2] rows of the left and right pupil in ids
    lids: np.ndarray  # [2, 3, 2] rows of upper and lower lid in ids, left then right eye
    group_sigma: np.ndarray  # [L] relative standard deviation by group
    low: np.ndarray  # [E] ends of the expression range
    high: np.ndarray  # [E]
    jaw_moves: bool

    @staticmethod
    def of(
        rig: Rig,
        landmark_triangles: np.ndarray,
        landmark_barycentric: np.ndarray,
        slide: np.ndarray | None = None,
        sigma_m: np.ndarray | None = None,
    ) -> LandmarkModel:
        """Landmarks of the head model's embedding [478], [478, 3]; those without a place (-1) are left out.

        Args:
            slide: [478, 3, 1 + S + 2] m, sigma_m: [478], the detector's habits (`fitting.habits`); None: fixed points and
                standard deviations by group.

        Raises:
            ValueError: a pupil or a lid landmark has no place on this head model.
        """
        ids = np.flatnonzero(landmark_triangles >= 0)
        row = {int(landmark): k for k, landmark in enumerate(ids)}
        missing = [n for n in (LEFT_IRIS, RIGHT_IRIS, *np.ravel(LID_PAIRS)) if n not in row]
        if missing:
            raise ValueError(f"the head model has no place for the landmarks {missing}; bake it again")
        sigma = np.full(len(ids), 2.0)
        for group, value in ((BROWS, 1.8), (NOSE, 0.8), (LIPS, 0.9), (EYES, 0.8), ((LEFT_IRIS, RIGHT_IRIS), 0.5)):
            sigma[np.isin(ids, group)] = value
        if sigma_m is not None:
            corners = landmark_triangles[list(OUTER_EYE_CORNERS)], landmark_barycentric[list(OUTER_EYE_CORNERS)]
            first, second = rig.surface(*corners).base
            known = np.isfinite(sigma_m[ids])
            sigma[known] = sigma_m[ids][known] / (UNIT_SIGMA * np.linalg.norm(first - second))
        surface = rig.surface(landmark_triangles[ids], landmark_barycentric[ids].astype(np.float64))
        if slide is not None:
            surface = _sliding(surface, slide[ids].astype(np.float64))
        return LandmarkModel(
            ids,
            surface,
            np.array([row[LEFT_IRIS], row[RIGHT_IRIS]]),
            np.vectorize(row.get)(np.array(LID_PAIRS)),
            sigma,
            rig.low,
            rig.high,
            rig.jaw_moves,
        )


def _sliding(surface: Surface, slide: np.ndarray) -> Surface:
    """A surface whose points wander with identity and view as the detector's do; slide [L, 3, 1 + S + 2] m."""
    return replace(
        surface,
        base=surface.base + slide[..., 0],
        shape_basis=np.ascontiguousarray(surface.shape_basis + slide[..., 1:-2]),
        view_basis=np.ascontiguousarray(slide[..., -2:]),
    )
