"""A face that is tracked while it is filmed: one frame after the other, with the fit's own energy and solver. No files.

What `fitting.stages.Tracker.block` does for a clip whose frames are all there is done here for one frame at a time: landmarks,
irises and lids of the detector, the detector's scores as the centre of the expression's prior, Levenberg-Marquardt from the
frame before. Identity and focal length are fixed: a mean head at first, then what `fitting.calibrate` finds on a second of
film (0.4 s of work). The focal length stays its prior: a second of film does not tell it, and `Carrier` does not need it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from fitting import calibrate, settings, solver, stages
from fitting.detection import BLENDSHAPE_NAMES
from fitting.fit import landmark_model
from fitting.head_model import HeadModel
from fitting.observed import Observed, observe
from fitting.rig import Pose, Rig
from fitting.state import State, neutral

ITERATIONS = 4  # a frame at most; a warm start mostly needs 3
CALIBRATE_ON = 20  # found frames; 15 did as well as 30
KEYFRAMES = 8
KEPT = 60  # frames, for a calibration that is asked for


class FaceSolver:
    """Head parameters of one filmed face."""

    def __init__(self, head: HeadModel, size: tuple[int, int], iterations: int = ITERATIONS) -> None:
        """
        Args:
            head: with its landmarks placed; size: (H, W) px of the pictures.

        Raises:
            ValueError: the head model has no place for pupils or lids.
        """
        self.head, self.size = head, size
        self.model = landmark_model(Rig(head), head)
        self.shared = neutral(self.model, 1, float(np.log(settings.FOCAL_OF_LONG_SIDE * max(size))))
        self.calibrated = False
        self._centre_px = np.array(size[::-1], np.float64) / 2
        self._seen: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=KEPT)
        self._costs: deque[float] = deque(maxlen=30)
        self._pose: Pose | None = None
        self._missing = stages.LONG_GAP
        self._solve = lambda problem, pose, effort: solver.solve_frame(problem, pose, iterations * effort)

    def observed(self, points: np.ndarray, blendshapes: np.ndarray) -> Observed:
        """Detections [T, 478, 3] px and [T, 51] as the fit reads them."""
        found, names = np.isfinite(points).all((1, 2)), list(BLENDSHAPE_NAMES)
        return observe(self.model, points, found, blendshapes, names, self.head.expression_names, self._centre_px, self.size)

    def solve(self, points: np.ndarray | None, blendshapes: np.ndarray | None) -> Pose | None:
        """The pose of the next frame.

        Args:
            points: [478, 3] px, pixel centres at +0.5, or None where no face was found; blendshapes: [51].

        Returns:
            the pose, in the solver's own axes (see `fitting.rig`); None where there is no face or no finite solution.
        """
        if points is None or blendshapes is None:
            self._missing += 1
            return None
        observed = self.observed(points[None], blendshapes[None])
        if not observed.found[0]:
            self._missing += 1
            return None
        try:
            pose = self._tracked(observed)
        except (np.linalg.LinAlgError, FloatingPointError):
            pose = None
        if pose is None:
            self._missing = stages.LONG_GAP  # a start from where it went wrong would go wrong again
            return None
        self._seen.append((points, blendshapes))
        self._pose, self._missing = pose, 0
        if not self.calibrated and len(self._seen) >= CALIBRATE_ON:
            self.calibrate()
        return pose

    def _tracked(self, observed: Observed) -> Pose | None:
        """As `stages.Tracker.block` treats a frame: from the last pose, or afresh after a gap or where that fits badly."""
        codes = len(self.head.expression_names)
        tracker = stages.Tracker(
            self.model, observed, settings.WEIGHTS, self.shared, np.ones(codes, bool), np.zeros(codes), self._solve
        )
        last = self._pose if self._missing < stages.LONG_GAP else None
        if last is None:
            pose, cost = tracker.fresh(0)
        else:
            tracker.foresee(0, last)
            pose, cost, _ = self._solve(tracker.problem(0, last.gaze), last, 1)
            if self._costs and cost > stages.GATE * np.median(self._costs):
                again, other = tracker.fresh(0, last.gaze)
                pose, cost = (again, other) if other < cost else (pose, cost)
        if tracker.distrust(0, pose):
            pose, cost, _ = self._solve(tracker.problem(0, pose.gaze), pose, 1)
        self._costs.append(cost)
        values = (pose.rotation, pose.translation, pose.expression, pose.gaze, pose.jaw)
        before = pose.translation[2] > 0 and all(np.isfinite(value).all() for value in values)
        return pose if before else None

    def calibrate(self) -> None:
        """Identity and the detector's bias on this face, from the frames seen so far; tracking goes on from the new head."""
        if not self._seen:
            return
        points, scores = (np.stack(values) for values in zip(*self._seen, strict=True))
        observed = self.observed(points, scores)
        rows = np.flatnonzero(observed.found)
        blank = neutral(self.model, 1, self.shared.log_focal)
        poses = stages.pnp(self.model, observed, rows, blank)
        keyframes = calibrate.choose_keyframes(observed, rows, poses, np.zeros(len(points)), KEYFRAMES)
        fixed = replace(settings.WEIGHTS, log_focal_sd=1e-3)
        try:
            found: State = calibrate.calibrate(
                self.model, observed, keyframes, fixed, blank.log_focal, settings.BIAS_SD_M, np.inf, rounds=1
            ).state
        except (np.linalg.LinAlgError, FloatingPointError):
            return  # the mean head goes on
        if not (np.isfinite(found.shape).all() and np.isfinite(found.bias).all()):
            return
        self.shared = replace(blank, shape=found.shape, bias=found.bias, log_focal=found.log_focal)
        self.calibrated, self._missing = True, stages.LONG_GAP
        self._costs.clear()

    def forget(self) -> None:
        """Another person sits down."""
        self.shared = neutral(self.model, 1, self.shared.log_focal)
        self.calibrated, self._pose, self._missing = False, None, stages.LONG_GAP
        self._seen.clear()
        self._costs.clear()
