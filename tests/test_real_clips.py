"""Self-consistency on real clips (research/fitting.md section 4.4): no truth, but two ways to one answer must agree.

Runs where AVATAR_RESULTS names a results folder with frames/, landmarks/ and split.json of at least one subject (what the steps
probe, extract, detect and split write); landmarks only, the first 100 training frames of at most three subjects.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fitting import calibrate, fit, settings, stages, tracking
from fitting.calibrate import Calibration
from fitting.config import FitConfig, TermWeights
from fitting.head_model import HeadModel
from fitting.landmark_model import EYE_CORNERS, IRIS_RINGS, LandmarkModel
from fitting.observed import Observed, observe
from fitting.rig import Rig, posed
from fitting.state import State, neutral, rotation_degrees

RESULTS = Path(os.environ.get("AVATAR_RESULTS", "no folder named"))
HEAD = Path(__file__).resolve().parent.parent / "resources" / "heads" / "anny.npz"
SUBJECTS = sorted(path.parent.parent.name for path in RESULTS.glob("*/landmarks/landmarks.npz"))[:3] if RESULTS.is_dir() else []
ROWS, KEYFRAMES = 100, 12
MIRROR = np.diag([-1.0, 1.0, 1.0])
WEIGHTS = settings.weights(TermWeights(photometric=0.0, silhouette=0.0))

pytestmark = pytest.mark.skipif(
    not SUBJECTS or not HEAD.exists(),
    reason="needs AVATAR_RESULTS (a results folder with landmarks) and resources/heads/anny.npz",
)


@dataclass(frozen=True)
class Detected:
    """What the detector wrote of one clip."""

    points: np.ndarray  # [T, 478, 3] px
    found: np.ndarray
    scores: np.ndarray
    names: tuple[str, ...]
    centre_px: np.ndarray
    size: tuple[int, int]
    focal_px: float  # of the prior


@cache
def head() -> tuple[HeadModel, Rig, LandmarkModel]:
    """The head model, its rig and its landmarks."""
    model = HeadModel.load(HEAD)
    rig = Rig(model)
    return model, rig, fit.landmark_model(rig, model)


@cache
def detected(subject: str) -> Detected:
    """The first training frames of one subject."""
    folder = RESULTS / subject
    index = json.loads((folder / "frames" / "frames.json").read_text())
    rows = np.array(json.loads((folder / "split.json").read_text())["train"])[:ROWS]
    with np.load(folder / "landmarks" / "landmarks.npz", allow_pickle=False) as file:
        points, found, scores = (file[name][rows] for name in ("points", "found", "blendshapes"))
        names = tuple(file["blendshape_names"].tolist())
    source = np.array(index["source_size"][::-1], float)
    centre = (source / 2 - [index["crop"]["x"], index["crop"]["y"]]) * index["scale"]
    focal = settings.FOCAL_OF_LONG_SIDE * source.max() * index["scale"]
    return Detected(points, found, scores, names, centre, tuple(index["size"]), focal)


def observed(clip: Detected) -> Observed:
    """As the fit reads it."""
    names = head()[0].expression_names
    return observe(head()[2], clip.points, clip.found, clip.scores, list(clip.names), names, clip.centre_px, clip.size)


def calibrated(clip: Detected, keyframes: np.ndarray) -> Calibration:
    """Calibration on given keyframes."""
    focal = float(np.log(clip.focal_px))
    return calibrate.calibrate(head()[2], observed(clip), keyframes, WEIGHTS, focal, settings.BIAS_SD_M, settings.MAX_FOCAL_SD)


@cache
def first(subject: str) -> tuple[Calibration, np.ndarray, State]:
    """Calibration, frames with a face and their track."""
    clip = detected(subject)
    seen = observed(clip)
    good = np.flatnonzero(seen.found)
    poses = stages.pnp(head()[2], seen, good, neutral(head()[2], 1, float(np.log(clip.focal_px))))
    keyframes = calibrate.choose_keyframes(seen, good, poses, np.ones(len(seen.found)), KEYFRAMES)
    calibration = calibrated(clip, keyframes)
    return calibration, good, tracked(clip, calibration, good)


def tracker(clip: Detected, calibration: Calibration) -> stages.Tracker:
    """A tracker with the default solver."""
    solve = tracking._solver(FitConfig())
    return stages.Tracker(head()[2], observed(clip), WEIGHTS, calibration.state, calibration.actions, calibration.held, solve)


def tracked(clip: Detected, calibration: Calibration, rows: np.ndarray) -> State:
    """Rows tracked in the order given."""
    return calibration.state.with_poses(tracker(clip, calibration).block(rows)[0])


def below(value: float, bound: float, what: str) -> None:
    """Assert and print."""
    print(f"{what}: {value:.3f} (bound {bound})")
    assert value < bound, f"{what}: {value:.3f}, bound {bound}"


@pytest.mark.parametrize("subject", SUBJECTS)
def test_held_out_landmarks(subject: str) -> None:
    """Four fifths of the landmarks tell the last fifth to 2 % of the inter-ocular distance."""
    calibration, good, state = first(subject)
    some = np.arange(0, len(good), 10)
    one = tracker(detected(subject), calibration)
    away = stages.held_out_px(one, good[some], state.frames(some), 2) / one.observed.scale_px[good[some]]
    below(100 * np.nanmedian(away), 2.0, "held out, % of the inter-ocular distance")


@pytest.mark.parametrize("subject", SUBJECTS)
def test_forward_and_backward(subject: str) -> None:
    """Tracking from the last frame to the first finds the same poses."""
    calibration, good, state = first(subject)
    back = tracked(detected(subject), calibration, good[::-1])
    angle = rotation_degrees(back.rotation[::-1], state.rotation)
    below(np.percentile(angle, 95), 0.5, "rotation, degrees (p95)")
    below(np.percentile(np.abs(back.expression[::-1] - state.expression), 99), 0.1, "expression (p99)")


@pytest.mark.parametrize("subject", SUBJECTS)
def test_half_resolution(subject: str) -> None:
    """Landmarks at half size, rounded to a quarter of a pixel, give the same poses."""
    calibration, good, state = first(subject)
    clip = detected(subject)
    size = (clip.size[0] // 2, clip.size[1] // 2)
    small = replace(clip, points=np.round(2 * clip.points) / 4, centre_px=clip.centre_px / 2, size=size)
    shared = replace(calibration.state, log_focal=calibration.state.log_focal - np.log(2))
    half = tracked(small, replace(calibration, state=shared), good)
    below(np.percentile(rotation_degrees(half.rotation, state.rotation), 95), 0.3, "rotation, degrees (p95)")
    away = 1e3 * np.linalg.norm(half.translation - state.translation, axis=1)
    below(np.percentile(away, 95), 3.0, "translation, mm (p95)")


@pytest.mark.parametrize("subject", SUBJECTS)
def test_mirrored_video(subject: str) -> None:
    """The mirrored clip gives the mirrored motion, calibration and all; the face's own asymmetry (constant) aside."""
    calibration, good, state = first(subject)
    clip, partner = detected(subject), _partners()
    points = clip.points[:, partner].copy()
    points[..., 0] = clip.size[1] - points[..., 0]
    points[:, partner < 0, :2] = -100.0  # outside the picture: no landmark of the head model lies on the other side
    swap = lambda name: name.replace("Left", "?").replace("Right", "Left").replace("?", "Right")  # noqa: E731
    scores = clip.scores[:, [clip.names.index(swap(name)) for name in clip.names]]
    centre = np.array([clip.size[1] - clip.centre_px[0], clip.centre_px[1]])
    other = replace(clip, points=points, scores=scores, centre_px=centre)
    mirrored = tracked(other, calibrated(other, calibration.keyframes), good)
    difference = state.rotation.swapaxes(1, 2) @ (MIRROR @ mirrored.rotation @ MIRROR)
    u, _, v = np.linalg.svd(difference.mean(0))
    below(np.percentile(rotation_degrees(difference, (u @ v)[None]), 95), 1.0, "rotation, degrees (p95)")
    names = head()[0].expression_names
    columns = [names.index(swap(name)) for name in names]
    below(np.median(np.abs(mirrored.expression[:, columns] - state.expression).max(1)), 0.3, "largest difference of an action")


def _partners() -> np.ndarray:
    """The landmark [478] on the other side of each, -1 where the head model has none."""
    model = head()[2]
    base = model.surface.base
    away = np.linalg.norm(base[:, None] @ MIRROR - base[None], axis=-1)
    nearest = away.argmin(1)
    partner = np.full(478, -1)
    partner[model.ids] = np.where(nearest[nearest] == np.arange(len(base)), model.ids[nearest], -1)
    for left, right in zip(*IRIS_RINGS, strict=True):
        partner[[left, right]] = right, left
    for left, right in zip(np.ravel(EYE_CORNERS[0]), np.ravel(EYE_CORNERS[1]), strict=True):
        partner[[left, right]] = right, left
    return partner


@pytest.mark.parametrize("subject", SUBJECTS)
def test_shape_from_disjoint_halves(subject: str) -> None:
    """Two halves of the keyframes give the same face."""
    calibration, _, _ = first(subject)
    clip, surface = detected(subject), head()[2].surface
    faces = []
    for start in (0, 1):
        state = calibrated(clip, calibration.keyframes[start::2]).state
        faces.append(posed(surface.folded(state.shape), neutral(head()[2], 1, 6.0).pose(0)).points)
    one, other = (face - face.mean(0) for face in faces)
    size = (one * other).sum() / (one**2).sum()  # the camera does not see it
    below(1e3 * np.sqrt(((size * one - other) ** 2).sum(1).mean()), 2.0, "landmarks of the neutral face, mm rms")
