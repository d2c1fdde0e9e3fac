"""Landmarks of a simulated clip without pixels: exact projections, then the faults of a real detector, one by one.

Each fault is a number in `Faults`, zero for none, so that a test can ask what one of them does to a fit.
T frames, V vertices, L = 478 landmarks, E expression coefficients.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from fitting.correspondence import LEFT_IRIS, RIGHT_IRIS
from fitting.head_model import HeadModel
from fitting.landmark_model import IRIS_RINGS

GAZE_UNIT_RAD = 0.3  # turn of the eyes at which the coupled motion reaches its amplitude
GAZE_REACH_M = 0.03  # distance from the eye over which it falls to the far amplitude
LOOK_FULL_RAD = 0.5  # turn of an eye at which its eyeLook score reaches one
HIDDEN_COSINE = -0.25  # cosine between normal and view at which a landmark counts as wholly hidden; seen from 0.1 on


@dataclass(frozen=True)
class Faults:
    """What is wrong with the detector; everything in pixels unless named otherwise."""

    white_px: float = 0.0  # independent noise, standard deviation an axis
    slow_px: float = 0.0  # noise that lasts: AR(1), standard deviation an axis
    slow_memory: float = 0.9  # its correlation from frame to frame
    bias_m: float = 0.0  # constant per landmark, along the surface, rms length
    outlier_share: float = 0.0  # part of all points that lie elsewhere
    outlier_px: float = 50.0  # their largest distance an axis
    lost: tuple[int, ...] = ()  # frames without a face
    gaze_near_px: float = 0.0  # motion of all landmarks with the gaze, beside the eyes (irises excepted)
    gaze_far_px: float = 0.0  # and far from them
    far_side_px: float = 0.0  # wrong guess of landmarks on the far side of a turned head
    score_noise: float = 0.0  # standard deviation of blendshape scores


@dataclass(frozen=True)
class LandmarkTrack:
    """As landmarks.npz."""

    points: np.ndarray  # [T, 478, 3] float32 px; depth relative to the face's middle, towards the camera negative
    found: np.ndarray  # [T] bool
    blendshapes: np.ndarray  # [T, N] float32
    blendshape_names: tuple[str, ...]  # N; the model's actions and eight eyeLook scores: with the anny model MediaPipe's 51
    exact: np.ndarray  # [T, 478, 2] px, without any fault; NaN where a landmark has no place


def landmark_track(
    head: HeadModel,
    vertices: np.ndarray,
    project: Callable[[np.ndarray], np.ndarray],
    faults: Faults,
    expression: np.ndarray,
    eyes: np.ndarray,
    seed: int = 0,
) -> LandmarkTrack:
    """What a faulty detector would report.

    Args:
        head: gives the landmark embedding; landmarks without a place report the mean of the others,
            those of an iris its centre.
        vertices: [T, V, 3] m, camera axes; project: camera-space points [..., 3] -> px [..., 2] (`synthetic.Camera.project`).
        expression: [T, E] true actions in the head's order; eyes: [T, 2, 3] axis-angle, left then right.
    """
    if len(expression) != len(vertices) or len(eyes) != len(vertices):
        raise ValueError(f"{len(vertices)} frames of vertices, {len(expression)} of expressions, {len(eyes)} of gaze: not a clip")
    random = [np.random.default_rng([seed, 10, k]) for k in range(7)]  # one a fault: switching one leaves the others as they are
    corners, weight, placed = _embedding(head, vertices)
    points = np.einsum("lk,tlkd->tld", weight, corners)
    exact = project(points)
    normal = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-15)
    moved = project(points + _along_surface(corners, normal, faults.bias_m, random[0]))
    count, frames = placed.sum(), len(points)
    moved = moved + faults.white_px * random[1].normal(size=(frames, count, 2))
    moved = moved + faults.slow_px * _lasting(frames, count, faults.slow_memory, random[2])
    moved = moved + _with_gaze(head, placed, eyes, faults, random[3])
    hidden = _hidden(points, normal)[..., None]
    guess = random[4].normal(size=(1, count, 2)) + 0.3 * _lasting(frames, count, faults.slow_memory, random[4])
    moved = moved + faults.far_side_px * hidden * guess
    away = random[5].uniform(-1, 1, (frames, count, 2)) * faults.outlier_px
    moved = np.where(random[5].random((frames, count, 1)) < faults.outlier_share, moved + away, moved)
    depth = points[..., 2] - points[..., 2].mean(1, keepdims=True)
    scale = np.linalg.norm(project(points + [1e-3, 0, 0]) - exact, axis=-1).mean(1)[:, None] * 1e3  # px a metre
    out = np.empty((frames, len(head.landmark_triangles), 3), np.float32)
    out[:] = np.concatenate([moved.mean(1, keepdims=True), np.zeros((frames, 1, 1))], -1)
    out[:, placed] = np.concatenate([moved, (depth * scale)[..., None]], -1)
    for ring in IRIS_RINGS:  # a ring without a place lies around its centre
        out[:, [point for point in ring if not placed[point]]] = out[:, ring[:1]]
    found = np.ones(frames, bool)
    found[[k for k in faults.lost if k < frames]] = False
    out[~found] = np.nan
    every = np.full((frames, len(placed), 2), np.nan)
    every[:, placed] = exact
    names, scores = _scores(head.expression_names, expression, eyes, faults.score_noise, random[6])
    return LandmarkTrack(out, found, np.where(found[:, None], scores, np.nan).astype(np.float32), names, every)


def _embedding(head: HeadModel, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangle corners [T, P, 3, 3] and weights [P, 3] of the placed landmarks, and which are placed [478] bool."""
    triangle = head.landmark_triangles.numpy()
    placed = triangle >= 0
    corners = vertices[:, head.triangles.numpy()[triangle[placed]]].astype(np.float64)
    return corners, head.landmark_barycentric.numpy()[placed].astype(np.float64), placed


def _along_surface(corners: np.ndarray, normal: np.ndarray, size_m: float, random: np.random.Generator) -> np.ndarray:
    """A constant offset [T, P, 3] m per landmark in its triangle's plane, which turns with the triangle."""
    first = corners[:, :, 1] - corners[:, :, 0]
    first = first / np.linalg.norm(first, axis=-1, keepdims=True).clip(1e-15)
    second = np.cross(normal, first)
    amount = random.normal(size=(2, 1, corners.shape[1], 1)) * size_m / np.sqrt(2)
    return amount[0] * first + amount[1] * second


def _lasting(frames: int, count: int, memory: float, random: np.random.Generator) -> np.ndarray:
    """AR(1) noise [T, P, 2] of unit variance from the first frame on."""
    drive = random.normal(size=(frames, count, 2)) * np.sqrt(1 - memory**2)
    drive[0] /= np.sqrt(1 - memory**2)
    return lfilter([1.0], [1.0, -memory], drive, axis=0)


def _with_gaze(head: HeadModel, placed: np.ndarray, eyes: np.ndarray, faults: Faults, random: np.random.Generator) -> np.ndarray:
    """Motion [T, P, 2] px of landmarks that follows the eyes (google-ai-edge/mediapipe#1786), strongest beside them."""
    rest = head.landmarks(head.template).numpy().astype(np.float64)[placed]
    away = np.linalg.norm(rest[:, None] - head.joints.numpy()[None, 3:] - [0, 0, -0.012], axis=-1).min(1)
    near = np.exp(-0.5 * (away / GAZE_REACH_M) ** 2)
    amount = faults.gaze_far_px + (faults.gaze_near_px - faults.gaze_far_px) * near
    amount = amount * random.uniform(0.7, 1.3, len(amount))
    amount[np.isin(np.flatnonzero(placed), (LEFT_IRIS, RIGHT_IRIS))] = 0
    turn = eyes.mean(1)[:, [1, 0]] * [-1, 1]  # a turn about +y looks to -x, one about +x looks down
    return (turn / GAZE_UNIT_RAD)[:, None] * amount[:, None]


def _hidden(points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """How far each landmark is turned away from the camera [T, P]: 0 seen, 1 hidden."""
    cosine = -(normal * points).sum(-1) / np.linalg.norm(points, axis=-1)
    return ((0.1 - cosine) / (0.1 - HIDDEN_COSINE)).clip(0, 1)


def _scores(
    names: tuple[str, ...], expression: np.ndarray, eyes: np.ndarray, noise: float, random: np.random.Generator
) -> tuple[tuple[str, ...], np.ndarray]:
    """Blendshape scores [T, N]: the true actions, and eyeLook from the gaze, noisy and in [0, 1]."""
    down, right = eyes[..., 0] / LOOK_FULL_RAD, eyes[..., 1] / LOOK_FULL_RAD  # right: towards the subject's right, image left
    looks = {}
    for side, eye, outward in (("Left", 0, -1), ("Right", 1, 1)):
        looks |= {f"eyeLookDown{side}": down[:, eye], f"eyeLookUp{side}": -down[:, eye]}
        looks |= {f"eyeLookOut{side}": outward * right[:, eye], f"eyeLookIn{side}": -outward * right[:, eye]}
    scores = np.concatenate([expression[:, : len(names)], np.stack(list(looks.values()), 1)], 1)
    return (*names, *looks), (scores + noise * random.normal(size=scores.shape)).clip(0, 1)
