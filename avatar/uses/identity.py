"""Whether two fitted heads can be one person: distances between fitted shapes, and what they say. Arrays in, numbers out.

A fit explains a face by identity and by expression, and what one clip does not show (a face at rest, from the front) it may put
into the wrong one: distances between people overlap with those of one person from a clip that shows too little of him.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Literal

import numpy as np

from fitting.head_model import REGIONS, HeadModel

# `snakemake identity_calibration` on the shared clips and the default head; see README, "drive".
CALIBRATED_ON = "anny"
CHOSEN = "codes"
REFUSED_FROM = 0.31
DOUBT = 0.8  # of the limit: pairs from there on are warned of, for parts of one clip are nearer than two sessions

Distance = Callable[[HeadModel, np.ndarray, np.ndarray], float]


def code_distance(head: HeadModel, first: np.ndarray, second: np.ndarray) -> float:
    """Root mean square difference of two shape codes [S], in standard deviations of the head model's people."""
    return float(np.sqrt(np.mean((np.asarray(first, np.float64) - second) ** 2)))


def face_distance(head: HeadModel, first: np.ndarray, second: np.ndarray) -> float:
    """Root mean square distance (mm) of two neutral faces, shape [S] each, once place, turn and size are taken out.

    Size is the model's mean face's for both, so that the figure does not depend on either's distance from its camera.
    """
    return _surface_distance(head, first, second, ("face",))


def head_distance(head: HeadModel, first: np.ndarray, second: np.ndarray) -> float:
    """As `face_distance`, over face, scalp and ears."""
    return _surface_distance(head, first, second, ("face", "scalp", "ears"))


def _surface_distance(head: HeadModel, first: np.ndarray, second: np.ndarray, regions: tuple[str, ...]) -> float:
    chosen = vertices_of(head, regions)
    basis, template = head.shape_basis.numpy()[:, chosen].astype(np.float64), head.template.numpy()[chosen].astype(np.float64)
    size, _ = _unit(template)
    (_, here), (_, there) = (_unit(template + np.einsum("s,svd->vd", shape, basis)) for shape in (first, second))
    return float(1000 * size * np.sqrt(np.mean(((here - aligned(there, here)) ** 2).sum(-1))))


@dataclass(frozen=True)
class Verdict:
    """What a distance between two fitted heads says."""

    distance: float
    refused_from: float

    @property
    def doubtful_from(self) -> float:
        return DOUBT * self.refused_from

    @property
    def word(self) -> Literal["same", "doubtful", "other"]:
        """`other` is refused, `doubtful` warned of."""
        if self.distance >= self.refused_from:
            return "other"
        return "doubtful" if self.distance >= self.doubtful_from else "same"


DISTANCES: dict[str, Distance] = {"codes": code_distance, "face_mm": face_distance, "head_mm": head_distance}


def vertices_of(head: HeadModel, regions: tuple[str, ...] = ("face",)) -> np.ndarray:
    """Mask [V] of some regions, or every vertex of a model that has none of them."""
    chosen = np.isin(head.region.numpy(), [REGIONS.index(name) for name in regions])
    return chosen if chosen.any() else np.ones_like(chosen)


def _unit(points: np.ndarray) -> tuple[float, np.ndarray]:
    """Root mean square radius of points [N, 3], and the points centred and of radius 1."""
    centred = points - points.mean(0)
    size = float(np.sqrt(np.mean((centred**2).sum(-1))))
    return size, centred / size


def aligned(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Centred points [N, 3] turned onto a centred target [N, 3] (Kabsch; never mirrored)."""
    left, _, right = np.linalg.svd(points.T @ target)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    return points @ (left * sign) @ right


@dataclass(frozen=True)
class Separation:
    """How well a distance tells pairs of one person from pairs of two."""

    same: np.ndarray  # [P] distances
    different: np.ndarray  # [Q]

    @property
    def area(self) -> float:
        """Chance that two people lie further apart than one person from himself (area under the ROC curve)."""
        above = (self.different[:, None] > self.same).mean() + 0.5 * (self.different[:, None] == self.same).mean()
        return float(above)

    @property
    def gap(self) -> float:
        """Nearest pair of two people over farthest pair of one: above 1 they are told apart without error."""
        return float(self.different.min() / self.same.max())

    @property
    def threshold(self) -> float:
        """Distance from which a pair is refused: where the two rates of error together are smallest.

        The geometric middle between the neighbouring distances; of several equally good places the lowest, for to let another
        person through is the worse error.
        """
        places = np.unique(np.concatenate([self.same, self.different]))
        middles = np.sqrt(places[1:] * places[:-1])
        return float(min(middles, key=lambda limit: self.refused(limit) + self.missed(limit)))

    def refused(self, threshold: float) -> float:
        """Part of the pairs of one person at or above the threshold."""
        return float((self.same >= threshold).mean())

    def missed(self, threshold: float) -> float:
        """Part of the pairs of two people below the threshold."""
        return float((self.different < threshold).mean())


def separation(head: HeadModel, people: Sequence[Sequence[np.ndarray]], distance: Distance) -> Separation:
    """All pairs within a person and all pairs across people.

    people: shape codes [S] of every part of each person's clip. Raises ValueError without a pair of either kind.
    """
    same = [distance(head, *pair) for parts in people for pair in combinations(parts, 2)]
    different = [distance(head, *pair) for one, other in combinations(people, 2) for pair in product(one, other)]
    if not same or not different:
        raise ValueError(f"{len(same)} pairs of one person and {len(different)} of two; at least two clips are needed")
    return Separation(np.array(same), np.array(different))


def verdict(head: HeadModel, first: np.ndarray, second: np.ndarray, limit: float | None = None) -> Verdict:
    """Whether two fitted shapes [S] can be one person; limit: another than the calibrated one.

    Raises ValueError for codes of unlike length.
    """
    if np.shape(first) != np.shape(second):
        raise ValueError(f"two shapes of {np.shape(first)} and {np.shape(second)} codes cannot be compared")
    return Verdict(DISTANCES[CHOSEN](head, first, second), REFUSED_FROM if limit is None else limit)
