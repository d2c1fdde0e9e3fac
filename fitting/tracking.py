"""The whole fit of one clip, arrays in and arrays out: calibrate on keyframes, track in blocks, look at pixels, bundle.

`fitting.fit` reads and writes the files; simulated clips and the benchmark call this directly.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from fitting import adam, bundle, calibrate, energy, measures, settings, solver, stages
from fitting.calibrate import Calibration
from fitting.config import FitConfig
from fitting.energy import Problem
from fitting.landmark_model import LandmarkModel
from fitting.observed import Observed
from fitting.pictures import FINEST, Look, Pictures
from fitting.rig import Pose, Rig
from fitting.state import State, neutral


class LostFace(Exception):
    """Too few frames with a face; the message says where."""


@dataclass(frozen=True)
class Clip:
    """Everything the fit reads of one clip."""

    rig: Rig
    model: LandmarkModel  # unfolded
    observed: Observed
    frames: np.ndarray  # [T, H, W, 3] uint8
    alpha: np.ndarray  # [T, H, W] uint8, the person
    time_s: np.ndarray  # [T]
    train: np.ndarray  # frame numbers
    test: np.ndarray
    log_focal: float  # of the prior, px of the frames


@dataclass
class Fitted:
    """What the fit found."""

    state: State  # all T frames
    calibration: Calibration
    pictures: Pictures | None
    reinit: np.ndarray  # [T] bool
    usable: np.ndarray  # [T] bool
    cut: np.ndarray  # [T] bool
    error_px: np.ndarray  # [T] reprojection
    held_out_px: np.ndarray  # [T] NaN where not measured
    seams: dict[str, dict[str, float]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


Bar = Callable[[Iterable[int], str], Iterable[int]]


def fit_clip(clip: Clip, config: FitConfig, bar: Bar = lambda rows, _: rows, held_out: bool = True) -> Fitted:
    """Fit one clip.

    Args:
        config: see `fitting.config`; bar: wraps a loop to show progress; held_out: also measure the error on held-out landmarks.

    Raises:
        LostFace: too few training frames with a face, or a part without any usable frame.
    """
    seconds: dict[str, float] = {}
    found = clip.observed.found
    good = clip.train[found[clip.train]]
    if len(good) < 5:
        raise LostFace(f"a face is found in {len(good)} of {len(clip.train)} training frames; at least 5 are needed")
    with _timed(seconds, "calibrate"):
        calibration, weights = _calibrate(clip, config, good)
    pictures = _pictures(clip, config)
    if pictures is not None:
        with _timed(seconds, "appearance"):
            calibration = _with_silhouette(clip, config, pictures, calibration, weights)
    shared = calibration.state
    with _timed(seconds, "track"):
        tracker = stages.Tracker(
            clip.model, clip.observed, weights, shared, calibration.actions, calibration.held, _solver(config)
        )
        state, reinit = _track(clip, config, tracker, bar)
    looks: dict[int, Look] = {}
    if pictures is not None:
        if config.weights.photometric:
            with _timed(seconds, "appearance"):
                pictures.learn(calibration.keyframes, state.frames(calibration.keyframes), tracker.lens)
        with _timed(seconds, "pixels"):
            state, looks = _refine(clip, tracker, pictures, state, np.flatnonzero(found), bar)
    cut = bundle.cuts(state, found)
    before = state
    if config.weights.temporal:
        with _timed(seconds, "bundle"):
            state = _bundle(clip, config, tracker, pictures, looks, state, cut)
    rows = np.arange(len(found))
    error = stages.reprojection_px(clip.model, clip.observed, rows, state)
    usable = _usable(clip, error, good, cut)
    state = _hold(clip, state, usable)
    held = np.full(len(rows), np.nan)
    if held_out:
        with _timed(seconds, "held_out"):
            checked = np.setdiff1d(rows[usable], calibration.keyframes)
            checked = checked[:: max(1, len(checked) // 60)]
            held[checked] = stages.held_out_px(tracker, checked, state.frames(checked), 2)
    starts = np.concatenate([part[config.reinit_every :: config.reinit_every] for part in (clip.train, clip.test)])
    starts = starts[usable[starts] & ~cut[starts]]
    seams = {"before": measures.seams(clip.rig, before, starts, usable), "after": measures.seams(clip.rig, state, starts, usable)}
    return Fitted(state, calibration, pictures, reinit, usable, cut, error, held, seams, seconds)


@contextmanager
def _timed(table: dict[str, float], name: str) -> Iterator[None]:
    """Add the seconds of a block to a table."""
    start = time.perf_counter()
    yield
    table[name] = table.get(name, 0.0) + time.perf_counter() - start


def _solver(config: FitConfig) -> stages.Solve:
    """The chosen per-frame solver: (problem, start, effort) -> (pose, cost, steps); effort multiplies the step count."""
    if config.solver == "adam":
        return lambda problem, pose, effort: adam.solve_frame(problem, pose, config.adam_steps * effort)
    return lambda problem, pose, effort: solver.solve_frame(problem, pose, config.iterations * effort)


def _pictures(clip: Clip, config: FitConfig) -> Pictures | None:
    if not (config.weights.photometric or config.weights.silhouette):
        return None
    strength = settings.strength(config.weights)
    return Pictures(clip.rig, clip.frames, clip.alpha, clip.observed.scale_px, strength, settings.SAMPLES)


def _calibrate(clip: Clip, config: FitConfig, good: np.ndarray) -> tuple[Calibration, energy.Weights]:
    """Keyframes and the shared unknowns from landmarks."""
    weights = settings.weights(config.weights)
    if config.focal_px is not None:
        weights = replace(weights, log_focal_sd=1e-3)
    blank = neutral(clip.model, 1, clip.log_focal)
    sharpness = _sharpness(clip, good)
    poses = stages.pnp(clip.model, clip.observed, good, blank)
    keyframes = calibrate.choose_keyframes(clip.observed, good, poses, sharpness, config.keyframes)
    calibration = calibrate.calibrate(
        clip.model, clip.observed, keyframes, weights, clip.log_focal, settings.BIAS_SD_M, settings.MAX_FOCAL_SD
    )
    return calibration, weights


def _with_silhouette(
    clip: Clip, config: FitConfig, pictures: Pictures, calibration: Calibration, weights: energy.Weights
) -> Calibration:
    """Skin colour, then identity once more with the silhouette."""
    if not config.weights.silhouette:
        return calibration
    centre = clip.observed.centre_px
    pictures.learn_skin(calibration.keyframes, calibration.state, calibration.state.lens(centre))
    extra = lambda state: pictures.silhouette_extra(calibration.keyframes, state, centre)  # noqa: E731
    return calibrate.refine(clip.model, clip.observed, calibration, weights, extra, settings.SILHOUETTE_ROUNDS)


def _sharpness(clip: Clip, rows: np.ndarray) -> np.ndarray:
    """Variance of the Laplacian inside the landmarks' box [T], zero for frames not asked for."""
    out = np.zeros(len(clip.frames))
    for row in rows:
        points = clip.observed.points[row]
        low = np.clip(points.min(0).astype(int), 0, None)
        high = points.max(0).astype(int) + 1
        box = cv2.cvtColor(np.ascontiguousarray(clip.frames[row][low[1] : high[1], low[0] : high[0]]), cv2.COLOR_RGB2GRAY)
        out[row] = cv2.Laplacian(cv2.resize(box, (128, 128), interpolation=cv2.INTER_AREA), cv2.CV_32F).var()
    return out


def _track(clip: Clip, config: FitConfig, tracker: stages.Tracker, bar: Bar) -> tuple[State, np.ndarray]:
    """All frames in blocks that start afresh; a block without any face takes the nearest pose of its part."""
    found = clip.observed.found
    state = neutral(clip.model, len(found), tracker.shared.log_focal)
    state = replace(state, shape=tracker.shared.shape, bias=tracker.shared.bias)
    reinit = np.zeros(len(found), bool)
    for part in (clip.train, clip.test):
        blocks = [part[k : k + config.reinit_every] for k in range(0, len(part), config.reinit_every)]
        for rows in bar(blocks, "blocks"):
            if found[rows].any():
                poses, reinit[rows] = tracker.block(rows)
                state = state.replaced(rows, state.with_poses(poses))
        seen = part[found[part]]
        if len(seen):
            nearest = seen[np.abs(part[:, None] - seen).argmin(1)]
            missing = ~found[part]
            state = state.replaced(part[missing], state.frames(nearest[missing]))
    return state, reinit


def _problem(
    clip: Clip, tracker: stages.Tracker, pictures: Pictures | None, look: Look | None, row: int, pose: Pose, level: int
) -> Problem:
    """All terms of one frame around a pose; those that read pixels where there is a look."""
    problem = tracker.problem(row, pose.gaze)
    if look is None:
        return problem
    shape, lens = tracker.shared.shape, tracker.lens
    extra = pictures.photometric_terms(row, look, shape, lens, (level,)) + pictures.silhouette_terms(row, look, shape, lens)
    return replace(problem, terms=(*problem.terms, *extra))


def _refine(
    clip: Clip, tracker: stages.Tracker, pictures: Pictures, state: State, rows: np.ndarray, bar: Bar
) -> tuple[State, dict[int, Look]]:
    """Some frames again with their pixels, coarse level first; frames do not read each other."""
    poses = [state.pose(row) for row in range(len(state))]
    looks = {}
    levels = range(FINEST + 1) if pictures.appearance is not None else (FINEST,)
    for row in bar(rows, "pixels"):
        looks[row] = pictures.look(row, poses[row], tracker.shared.shape, tracker.lens)
        for level in levels:
            problem = _problem(clip, tracker, pictures, looks[row], row, poses[row], level)
            poses[row] = solver.solve_frame(problem, poses[row], settings.PIXEL_ITERATIONS)[0]
    return state.with_poses(poses), looks


def _bundle(
    clip: Clip,
    config: FitConfig,
    tracker: stages.Tracker,
    pictures: Pictures | None,
    looks: dict[int, Look],
    state: State,
    cut: np.ndarray,
) -> State:
    """Temporal terms over the training and the test part apart: no term crosses the split."""
    smoothness = settings.SMOOTHNESS.deviation(state.expression.shape[1]) / np.sqrt(config.weights.temporal)
    for part in (clip.train, clip.test):
        if len(part) < 3 or not clip.observed.found[part].any():
            continue

        def problem_of(k: int, at: State, part: np.ndarray = part) -> Problem | None:
            if not clip.observed.found[part[k]]:
                return None
            return _problem(clip, tracker, pictures, looks.get(part[k]), part[k], at.pose(k), FINEST)

        stencil = bundle.stencils(clip.time_s[part], cut[part])
        bundled, _ = bundle.smooth(problem_of, state.frames(part), stencil, smoothness, settings.BUNDLE_ITERATIONS)
        state = state.replaced(part, bundled)
    return state


def _usable(clip: Clip, error: np.ndarray, good: np.ndarray, cut: np.ndarray) -> np.ndarray:
    """Frames whose fit can be trusted: not much worse than the median, and not a stretch between two cuts that fits another face.

    Raises:
        LostFace: a part has none.
    """
    relative = error / clip.observed.scale_px
    median = np.median(relative[good])  # of training frames: the test tail decides nothing
    lost = (relative > settings.LOST_OF_MEDIAN * median) & (relative > settings.LOST_OF_EYES)
    for stretch in np.split(np.arange(len(cut)), np.flatnonzero(cut)):
        seen = stretch[clip.observed.found[stretch]]
        if len(seen) < len(cut) and len(seen) and np.median(relative[seen]) > settings.ANOTHER_FACE * median:
            lost[seen] = True
    usable = clip.observed.found & ~lost
    for name, part in (("training", clip.train), ("test", clip.test)):
        if not usable[part].any():
            raise LostFace(f"the face is lost in all {len(part)} {name} frames; use another clip")
    return usable


def _hold(clip: Clip, state: State, usable: np.ndarray) -> State:
    """Frames without a face: a short gap keeps what the bundle drew across it, a longer one takes the nearest usable frame.

    A frame that has a face but is not usable keeps its own solved pose: blurred, it is still nearer than its neighbours'.
    """
    for part in (clip.train, clip.test):
        rows = part[usable[part]]
        nearest = rows[np.abs(part[:, None] - rows).argmin(1)]
        lost = ~clip.observed.found[part]
        places = np.flatnonzero(lost)
        for gap in np.split(places, np.flatnonzero(np.diff(places) > 1) + 1):
            if len(gap) and gap[0] > 0 and gap[-1] < len(part) - 1 and len(gap) <= stages.LONG_GAP:
                lost[gap] = False
        state = state.replaced(part[lost], state.frames(nearest[lost]))
    return state
