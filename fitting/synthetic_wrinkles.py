"""Wrinkles of a simulated face: dark lines on the skin that come and go with its actions, each subject's a little different.

No constant texture holds them and no mesh of a head model's resolution has them, so an avatar must learn them from the
expression.  Drawn as seen from the front, like the paint's frontal map.  F folds, E expression, Y, X the map.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.interpolate import make_interp_spline

HALF = 0.3
"""Sum of a fold's actions where it has 63 % of its depth; people in front of a phone seldom reach more than twice that."""
SIGMA_M = 0.0011  # half width of a line: still there when a face is 60 pixels wide
WOBBLE_M = 0.0012
STEPS = 60  # pieces of a line
POINTS = {  # MediaPipe's landmarks, of the subject's right and left side
    "inner brow": (107, 336), "brow": (105, 334), "outer brow": (70, 300), "eye corner": (33, 263), "lower lid": (145, 374),
    "nostril": (129, 358), "cheek": (206, 426), "mouth corner": (61, 291),
}  # fmt: skip
SIDES = ("Right", "Left")

Point = tuple[str, float, float]
"""A landmark, and mm from it: outward from the middle of the face, and down."""


@dataclass(frozen=True)
class Fold:
    """Lines that appear together."""

    actions: tuple[tuple[str, float], ...]  # names (`*` stands for the side) and weights
    lines: tuple[tuple[Point, ...], ...]
    depth: float  # part of the light that is lost in the middle of a full line


FOREHEAD_UP_MM = (11.0, 19.0, 27.0)  # of the lines over the brows
BOTH = (  # across the middle of the forehead: drawn to one side, then mirrored
    Fold((("browInnerUp", 1.0),), tuple((("brow", -4.0, -up), ("inner brow", 0.0, 1.5 - up)) for up in FOREHEAD_UP_MM), 0.5),
)
EACH = (
    Fold(
        (("browOuterUp*", 1.0),),
        tuple((("brow", -9.0, 1.0 - up), ("brow", 4.0, -up), ("outer brow", -3.0, 1.0 - 0.9 * up)) for up in FOREHEAD_UP_MM[:2]),
        0.45,
    ),
    Fold(
        (("browDown*", 1.0),),
        (
            (("inner brow", -6.5, -11.0), ("inner brow", -8.0, -2.0), ("inner brow", -7.0, 8.0)),
            (("inner brow", -1.0, -12.0), ("inner brow", -3.5, -6.0)),
        ),
        0.55,
    ),
    Fold(
        (("eyeSquint*", 1.0), ("cheekSquint*", 0.8), ("mouthSmile*", 0.3)),
        (
            (("eye corner", 5.0, -2.0), ("eye corner", 14.0, -9.0)),
            (("eye corner", 6.0, 1.5), ("eye corner", 16.0, 1.0)),
            (("eye corner", 4.0, 5.0), ("eye corner", 13.0, 11.0)),
            (("lower lid", -11.0, 4.0), ("lower lid", 0.0, 7.5), ("lower lid", 11.0, 5.0)),
        ),
        0.5,
    ),
    Fold(
        (("mouthSmile*", 1.0), ("noseSneer*", 1.0), ("mouthUpperUp*", 0.6)),
        ((("nostril", 3.0, -4.0), ("cheek", 1.0, -1.0), ("mouth corner", 11.0, -9.0), ("mouth corner", 13.0, 4.0)),),
        0.55,
    ),
)


@dataclass(frozen=True)
class Wrinkles:
    """The folds of one subject."""

    maps: np.ndarray  # [F, Y, X] float32: part of the light lost where a fold is full
    weights: np.ndarray  # [F, E] of the actions

    def darkness(self, expression: np.ndarray) -> np.ndarray:
        """Part of the light lost [Y, X] float32 with the actions [E]; zero without any."""
        amount = self.weights @ np.maximum(expression, 0)
        strength = 1 - np.exp(-((amount / HALF) ** 2))  # no slope at rest: a face that hardly moves has no lines
        return np.tensordot(strength.astype(np.float32), self.maps, 1).clip(0, 0.8)


def wrinkles(
    landmarks_m: np.ndarray, names: Sequence[str], low_m: np.ndarray, step_m: float, size: tuple[int, int], seed: int
) -> Wrinkles:
    """Folds of one subject; those whose landmarks have no place, or whose actions the model lacks, are left out.

    Args:
        landmarks_m: [478, 2] of the template, x and y; NaN where a landmark has no place.
        names: the E action names.
        low_m, step_m, size: corner, cell and (Y, X) of the frontal map.
        seed: the subject's; how its lines run and how deep they are.
    """
    random = np.random.default_rng([seed, 7])
    maps, weights = [], []
    for actions, lines, depth in _folds():
        depth *= random.uniform(0.85, 1.15)
        points = [np.array([_place(landmarks_m, *point) for point in line]) for line in lines]
        points = [line + WOBBLE_M * random.uniform(-1, 1, line.shape) for line in points]
        row = np.array([dict(actions).get(name, 0.0) for name in names])
        if all(np.isfinite(line).all() for line in points) and row.any():
            maps.append(depth * _drawn([(line - low_m) / step_m for line in points], SIGMA_M / step_m, size))
            weights.append(row)
    return Wrinkles(np.array(maps, np.float32).reshape(-1, *size), np.array(weights).reshape(-1, len(names)))


def _folds() -> Iterator[tuple[tuple[tuple[str, float], ...], list[list[tuple[int, float, float]]], float]]:
    """Every fold with the names of its actions, its lines as (landmark, x, y mm) and its depth."""
    sided = lambda line, side: [(POINTS[name][side], (2 * side - 1) * out, down) for name, out, down in line]  # noqa: E731
    for fold in BOTH:
        yield fold.actions, [sided(line, 0) + sided(line, 1)[::-1] for line in fold.lines], fold.depth
    for fold in EACH:
        for side, word in enumerate(SIDES):
            actions = tuple((name.replace("*", word), weight) for name, weight in fold.actions)
            yield actions, [sided(line, side) for line in fold.lines], fold.depth


def _place(landmarks_m: np.ndarray, landmark: int, x_mm: float, y_mm: float) -> np.ndarray:
    return landmarks_m[landmark] + 1e-3 * np.array([x_mm, y_mm])


def _drawn(lines: list[np.ndarray], sigma: float, size: tuple[int, int]) -> np.ndarray:
    """Smooth lines [Y, X] in [0, 1] through points [N, 2] (cells), thin at their ends; sigma in cells."""
    out = np.zeros(size, np.float32)
    along = np.linspace(0, 1, STEPS + 1)
    for points in lines:
        curve = make_interp_spline(np.linspace(0, 1, len(points)), points, k=min(2, len(points) - 1))(along)
        canvas = np.zeros(size, np.float32)
        for a, b, place in zip(curve, curve[1:], along, strict=False):
            value = float(np.sin(np.pi * (0.06 + 0.88 * place)) ** 0.7)
            first, second = ([int(16 * c) for c in end] for end in (a, b))
            cv2.line(canvas, first, second, value, max(1, round(sigma)), cv2.LINE_8, 4)
        canvas = cv2.GaussianBlur(canvas, (0, 0), sigma)
        out = np.maximum(out, canvas / max(float(canvas.max()), 1e-9))
    return out
