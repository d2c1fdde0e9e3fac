"""Which frames of a clip show what: calm, expressive, turned, mouth open, eyes shut. Judged on the posed mesh, in any head model.

An expression's strength is how far it moves the face, in millimetres, not the norm of its code: the actions of one head model
differ in what a unit moves, and codes of two head models have no common unit. A blink moves much skin and tells little: the most
expressive frames are looked for among those with open eyes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar.dataset import Scene
from avatar.uses.sequence import camera_angles
from fitting.head_model import REGIONS
from fitting.landmark_model import EYE_CORNERS, LID_PAIRS, OUTER_EYE_CORNERS

INNER_LIPS = (13, 14)
"""MediaPipe's middle of the upper and lower lip's inner rim."""
CALM_GAZE_QUANTILE = 0.75
WIDE_QUANTILE, OPEN_OF_WIDE = 0.9, 0.8
"""Eyes count as open from this part of the gap that their widest tenth has."""
SHOWN_FPS = 15.0
"""Frames a second, about, of a stretch that is shown."""


@dataclass(frozen=True)
class Looks:
    """What T frames of a scene show."""

    strength_mm: np.ndarray  # [T] rms way of the face's surface from the fitted neutral
    mouth: np.ndarray  # [T] gap of the lips over the distance of the outer eye corners; NaN where the head model lacks them
    lids: np.ndarray  # [T] gap of the lids over the eye's width, the wider eye's; NaN as above
    gaze_rad: np.ndarray  # [T] how far the eyes are turned, the larger of both
    yaw_rad: np.ndarray  # [T] see `sequence.camera_angles`
    pitch_rad: np.ndarray  # [T]


def looks_of(scene: Scene, eyes: np.ndarray) -> Looks:
    """Measure a scene; eyes: [T, 2, 3] rad, its motion's gaze."""
    squared = scene.displacement_m.double().square().sum(-1).numpy()
    strength = 1000 * np.sqrt(squared @ face_area(scene))
    points = scene.head.landmarks(scene.vertices_m).double().numpy()
    across = np.linalg.norm(points[:, OUTER_EYE_CORNERS[0]] - points[:, OUTER_EYE_CORNERS[1]], axis=-1)
    mouth = np.linalg.norm(points[:, INNER_LIPS[0]] - points[:, INNER_LIPS[1]], axis=-1) / across
    lids = []
    for pairs, corners in zip(LID_PAIRS, EYE_CORNERS, strict=True):
        upper, lower = np.moveaxis(points[:, np.array(pairs)], 2, 0)
        width = np.linalg.norm(points[:, corners[0]] - points[:, corners[1]], axis=-1)
        lids.append(np.linalg.norm((upper - lower).mean(1), axis=-1) / width)
    yaw, pitch = camera_angles(scene)
    return Looks(strength, mouth, np.maximum(*lids), np.linalg.norm(eyes, axis=-1).max(1), yaw, pitch)


def face_area(scene: Scene) -> np.ndarray:
    """Part of the face's area that belongs to each vertex [V]: vertices lie densest on lids and lips. Sums to 1."""
    vertices, triangles = scene.neutral_m.double().numpy(), scene.head.triangles.numpy()
    first, second = (vertices[triangles[:, k]] - vertices[triangles[:, 0]] for k in (1, 2))
    area = np.repeat(np.linalg.norm(np.cross(first, second), axis=1), 3)
    of_vertex = np.bincount(triangles.ravel(), area, len(vertices))
    face = (scene.head.region == REGIONS.index("face")).numpy()
    of_vertex = np.where(face, of_vertex, 0) if of_vertex[face].sum() else of_vertex
    return of_vertex / of_vertex.sum()


def awake(looks: Looks) -> np.ndarray:
    """Frames [T] bool with open eyes; all of them where the head model has no lids."""
    if not np.isfinite(looks.lids).all():
        return np.ones(len(looks.lids), bool)
    return looks.lids >= OPEN_OF_WIDE * np.quantile(looks.lids, WIDE_QUANTILE)


def calm(looks: Looks) -> int:
    """Place of the frame with the weakest expression among those with open eyes that look ahead."""
    ahead, allowed = looks.gaze_rad <= np.quantile(looks.gaze_rad, CALM_GAZE_QUANTILE), awake(looks)
    allowed = allowed & ahead if (allowed & ahead).any() else allowed
    return int(np.where(allowed, looks.strength_mm, np.inf).argmin())


def telling(looks: Looks) -> dict[int, str]:
    """Places of frames that together show what an avatar can do, with what each shows; one may show several things."""
    found: dict[int, str] = {}

    def add(values: np.ndarray, words: str) -> None:
        if np.isfinite(values).all():
            place = int(values.argmax())
            found[place] = f"{found[place]}, {words}" if place in found else words

    found[calm(looks)] = "calm"
    add(np.where(awake(looks), looks.strength_mm, 0), "most expressive")
    add(looks.yaw_rad, "turned to the left")  # of the picture
    add(-looks.yaw_rad, "turned to the right")
    add(looks.mouth, "mouth most open")
    add(-looks.lids, "eyes most shut")
    return found


def most_expressive(looks: Looks, count: int, apart: int) -> list[int]:
    """Places of the strongest expressions with open eyes, strongest first, each `apart` frames or more from those before it."""
    chosen: list[int] = []
    places = np.argsort(-looks.strength_mm, kind="stable")
    for place in places[awake(looks)[places]]:
        if len(chosen) < count and all(abs(int(place) - other) >= apart for other in chosen):
            chosen.append(int(place))
    return chosen


def liveliest(looks: Looks, frames: list[int], count: int, stride: int) -> list[int]:
    """Places of `count` frames, `stride` apart, where the expression is strongest on average; fewer in a short clip.

    frames: [T] frame numbers: a stretch that leaves frames out (not usable) is no stretch, unless there is no other.
    """
    total = len(frames)
    count = min(count, (total - 1) // stride + 1)
    length = (count - 1) * stride + 1
    starts = np.arange(total - length + 1)
    whole = np.array([frames[start + length - 1] - frames[start] == length - 1 for start in starts])
    strength = np.array([looks.strength_mm[start : start + length : stride].mean() for start in starts])
    best = int(np.where(whole, strength, -1.0).argmax()) if whole.any() else int(strength.argmax())
    return list(range(best, best + length, stride))
