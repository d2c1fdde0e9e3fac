"""The head model at its landmarks only: a linear model of a few hundred points, folded once, and which landmark is what.

Letters: L landmarks, S shape, E expression coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fitting.correspondence import LEFT_IRIS, RIGHT_IRIS
from fitting.head_model import HeadModel

# MediaPipe's own index lists (Apache-2.0), for weights only.
LIPS = (
    61,
    146,
    91,
    181,
    84,
    17,
    314,
    405,
    321,
    375,
    291,
    185,
    40,
    39,
    37,
    0,
    267,
    269,
    270,
    409,
    78,
    95,
    88,
    178,
    87,
    14,
    317,
    402,
    318,
    324,
    308,
    191,
    80,
    81,
    82,
    13,
    312,
    311,
    310,
    415,
)
EYES = (
    263,
    249,
    390,
    373,
    374,
    380,
    381,
    382,
    362,
    466,
    388,
    387,
    386,
    385,
    384,
    398,
    33,
    7,
    163,
    144,
    145,
    153,
    154,
    155,
    133,
    246,
    161,
    160,
    159,
    158,
    157,
    173,
)
BROWS = (276, 283, 282, 295, 285, 300, 293, 334, 296, 336, 46, 53, 52, 65, 55, 70, 63, 105, 66, 107)
NOSE = (168, 6, 197, 195, 5, 4, 1, 2, 98, 97, 326, 327, 129, 358)
OUTER_EYE_CORNERS = (33, 263)


@dataclass(frozen=True)
class LandmarkModel:
    """The head model at its landmarks only: a linear model, folded once."""

    ids: np.ndarray  # [L] MediaPipe numbers
    base: np.ndarray  # [L, 3] m
    shape_basis: np.ndarray  # [S, L, 3]
    expression_basis: np.ndarray  # [E, L, 3]
    normal: np.ndarray  # [L, 3] outward, of the template
    low: np.ndarray  # [E] ends of the expression range
    high: np.ndarray  # [E]
    eye_joint: np.ndarray  # [2, 3] left, right
    eye_joint_basis: np.ndarray  # [S, 2, 3]
    pupil: np.ndarray  # [2] rows of the left and right pupil in ids
    group_sigma: np.ndarray  # [L] relative standard deviation by group

    @staticmethod
    def of(head: HeadModel) -> LandmarkModel:
        """Fold a head model; landmarks without a place are left out."""
        ids = np.flatnonzero(head.landmark_triangles.numpy() >= 0)
        corner = head.triangles.numpy()[head.landmark_triangles.numpy()[ids]]  # [L, 3]
        weight = head.landmark_barycentric.numpy().astype(np.float64)[ids]
        fold = lambda values: np.einsum("lk,...lkd->...ld", weight, values.numpy().astype(np.float64)[..., corner, :])  # noqa: E731
        triangle = head.template.numpy().astype(np.float64)[corner]
        normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
        sigma = np.full(len(ids), 2.0)
        for group, value in ((BROWS, 1.8), (NOSE, 0.8), (LIPS, 0.9), (EYES, 0.8), ((LEFT_IRIS, RIGHT_IRIS), 0.5)):
            sigma[np.isin(ids, group)] = value
        return LandmarkModel(
            ids,
            fold(head.template),
            fold(head.shape_basis),
            fold(head.expression_basis),
            normal / np.linalg.norm(normal, axis=1, keepdims=True),
            head.expression_low.numpy().astype(np.float64),
            head.expression_high.numpy().astype(np.float64),
            head.joints.numpy().astype(np.float64)[3:],
            head.joint_shape_basis.numpy().astype(np.float64)[:, 3:],
            np.array([np.flatnonzero(ids == LEFT_IRIS)[0], np.flatnonzero(ids == RIGHT_IRIS)[0]]),
            sigma,
        )
