"""The stages of the fit that look at one frame at a time: poses by PnP, tracking in independent blocks, held-out check."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from fitting import camera, energy, solver
from fitting.correspondence import LEFT_IRIS, RIGHT_IRIS
from fitting.energy import Problem, Weights
from fitting.landmark_model import LandmarkModel
from fitting.observed import Observed
from fitting.rig import Pose, Surface, posed
from fitting.state import State, neutral

STABLE = (4, 6, 33, 263, 133, 362, 129, 358, 168, 197, 5, 61, 291, 152, 127, 356, 234, 454)  # for PnP: bones and corners
LEAST_POINTS = 6  # for PnP
GATE = 3.0  # a frame this many times worse than the running median is tried again from PnP
FAR_OF_EYES, FAR_OF_MEDIAN = 0.1, 5.0  # a landmark off by this many inter-ocular distances and medians of its frame is wrong
AFFINE_STEPS = 3
FEW = 0.01  # part of the landmarks
SIDE = 0.4  # weight of `energy.facing` below which a landmark is rather guessed than seen
LONG_GAP = 5  # frames without a face after which tracking starts afresh

Solve = Callable[[Problem, Pose, int], tuple[Pose, float, int]]  # (problem, start, effort) -> pose, cost, steps


def pnp(model: LandmarkModel, observed: Observed, rows: np.ndarray, state: State) -> State:
    """Poses of `rows` by Perspective-n-Point on stable landmarks of the neutral head, expression, gaze and jaw set to neutral.

    A frame where PnP fails or puts the face behind the camera or turned away keeps a frontal pose at a plausible depth.

    Args:
        model: unfolded; the identity and biases are state's.
    """
    stable = np.flatnonzero(np.isin(model.ids, STABLE))
    points = state.fold(model).surface.base
    matrix = np.array([[state.focal_px, 0, observed.centre_px[0]], [0, state.focal_px, observed.centre_px[1]], [0, 0, 1.0]])
    eyes = np.linalg.norm(points[model.pupil[0]] - points[model.pupil[1]]) * 1.45  # corner to corner
    rotation, translation = [], []
    for row in rows:
        depth = state.focal_px * eyes / observed.scale_px[row]
        guess = np.array([*((observed.points[row].mean(0) - observed.centre_px) * depth / state.focal_px), depth])
        used = stable[observed.inside[row, stable]]
        if len(used) < LEAST_POINTS:  # a face on the border of the picture
            used = np.flatnonzero(observed.inside[row])
        places, pixels = np.ascontiguousarray(points[used]), np.ascontiguousarray(observed.points[row, used])
        solved = _solve_pnp(places, pixels, matrix, 0.2 * depth)
        turn, guess = (np.eye(3), guess) if solved is None else solved
        rotation.append(turn)
        translation.append(guess)
    blank = neutral(model, len(rows), state.log_focal)
    return replace(blank, rotation=np.stack(rotation), translation=np.stack(translation), shape=state.shape, bias=state.bias)


def _solve_pnp(
    object_points: np.ndarray, image_points: np.ndarray, matrix: np.ndarray, nearest_m: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation [3, 3] and translation [3] m by SQPnP, refined; None for a degenerate, too near or turned-away solution."""
    if len(object_points) < LEAST_POINTS:
        return None
    try:
        ok, vector, offset = cv2.solvePnP(object_points, image_points, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        if not ok or not np.isfinite(vector).all() or not np.isfinite(offset).all():
            return None
        if offset[2, 0] < nearest_m or camera.exp_rotation(vector[:, 0])[2, 2] <= 0:
            return None
        vector, offset = cv2.solvePnPRefineLM(object_points, image_points, matrix, None, vector, offset)
    except cv2.error:  # OpenCV's way of saying that the points lie on top of each other
        return None
    turn = camera.exp_rotation(vector[:, 0])
    good = np.isfinite(turn).all() and np.isfinite(offset).all() and offset[2, 0] > nearest_m and turn[2, 2] > 0
    return (turn, offset[:, 0]) if good else None


class Tracker:
    """Solves frames one after the other with the shared unknowns held."""

    def __init__(
        self,
        model: LandmarkModel,
        observed: Observed,
        weights: Weights,
        shared: State,
        actions: np.ndarray,
        held: np.ndarray,
        solve: Solve,
    ) -> None:
        """
        Args:
            model: unfolded; shared: its shape, bias and focal length are used.
            actions: [E] bool, expression coefficients that are solved for; held: [E] values of the others.
            solve: the per-frame solver.
        """
        self.model, self.folded, self.observed, self.weights, self.shared = model, shared.fold(model), observed, weights, shared
        self.lens = shared.lens(observed.centre_px)
        self.all = energy.free_unknowns(model, actions=actions)
        self.rigid = energy.free_unknowns(model, pose_only=True)
        self.start = np.where(actions, 0.0, held)
        self.solve = solve
        self.trust = np.ones(observed.points.shape[:2], bool)  # [T, L] landmarks that `block` found to fit the face

    def problem(self, row: int, gaze: np.ndarray | None, keep: np.ndarray | None = None, pose_only: bool = False) -> Problem:
        """The landmark problem of one frame; gaze [4] is held where an eye is shut, keep [L] hides landmarks."""
        frame = self.observed.frame(self.model, row, gaze, self.trust[row] if keep is None else keep & self.trust[row])
        return energy.landmark_problem(self.folded, frame, self.weights, self.lens, self.rigid if pose_only else self.all)

    def fresh(self, row: int, gaze: np.ndarray | None = None) -> tuple[Pose, float]:
        """One frame from PnP and a neutral expression, with its cost; gaze [4] is where a shut eye looks.

        The pose is solved alone first, so that the expression does not take up what is motion.
        """
        start = pnp(self.model, self.observed, np.array([row]), self.shared).pose(0)
        start = replace(start, expression=self.start.copy(), gaze=np.zeros(4) if gaze is None else gaze)
        start = solver.solve_frame(self.problem(row, gaze, pose_only=True), start, 6)[0]
        return self.solve(self.problem(row, gaze), start, 3)[:2]

    def distrust(self, row: int, pose: Pose) -> bool:
        """Leave out landmarks that lie far from where a solved pose has them (outliers, guesses); whether it changes the pose."""
        away = _distance(self.folded.surface, self.observed, row, pose, self.shared)
        return self._leave_out(row, pose, away)

    def foresee(self, row: int, last: Pose) -> None:
        """Leave out landmarks that did not move with the others since a solved pose (a hand drags them).

        Any motion of the head moves its points as an affine camera does to first order, so that camera is fitted robustly.
        """
        at, seen = posed(self.folded.surface, last), _visible(self.folded.surface, last, self.observed, row)
        system = np.column_stack([at.head - at.head.mean(0), np.ones(len(at.head))])
        target = self.observed.points[row]
        shift = target - camera.project(at.points, self.lens.focal_px, self.lens.centre_px)
        away = np.linalg.norm(shift - np.median(shift[seen], 0), axis=1)  # a start that a quarter of the points does not move
        if (away > FAR_OF_EYES * self.observed.scale_px[row]).mean() <= FEW:
            return
        for _ in range(AFFINE_STEPS):
            spread = np.median(away[seen]) + 1e-3 * self.observed.scale_px[row]
            weighted = system * (seen / (1 + (away / (2 * spread)) ** 2) ** 2)[:, None]
            away = np.linalg.norm(target - system @ np.linalg.solve(weighted.T @ system, weighted.T @ target), axis=1)
        self._leave_out(row, last, away)

    def _leave_out(self, row: int, pose: Pose, away: np.ndarray) -> bool:
        wrong = _wrong(away, self.folded.surface, pose, self.observed, row) & self.trust[row]
        self.trust[row] &= ~wrong
        return bool(wrong.mean() > FEW)  # the robust cost bears a few

    def block(self, rows: np.ndarray) -> tuple[list[Pose], np.ndarray]:
        """Track consecutive frames: the first by PnP and a neutral expression, each next one from the frame before.

        Blocks do not read each other (the paper re-initialises every 200 frames, supplement "3DMM Fitting Details"), so they can
        run in any order.  A frame that is much worse than those before (a cut, a lost track) is tried again from PnP; frames
        that were not found keep the pose before them.

        Returns:
            poses and whether each frame started afresh [B] bool.

        Raises:
            ValueError: no face in any of the rows.
        """
        poses: list[Pose | None] = []
        afresh = np.zeros(len(rows), bool)
        costs: list[float] = []
        missing = LONG_GAP
        for k, row in enumerate(rows):
            last = poses[-1] if poses else None
            if not self.observed.found[row]:
                poses.append(last)
                missing += 1
                continue
            if last is None or missing >= LONG_GAP:
                pose, cost = self.fresh(row)
                afresh[k] = True
            else:
                self.foresee(row, last)
                pose, cost, _ = self.solve(self.problem(row, last.gaze), last, 1)
                if costs and cost > GATE * np.median(costs[-30:]):
                    again, other = self.fresh(row, last.gaze)
                    if other < cost:
                        pose, cost = again, other
                        afresh[k] = True
            if self.distrust(row, pose):
                pose, cost, _ = self.solve(self.problem(row, pose.gaze), pose, 1)
            missing = 0
            costs.append(cost)
            poses.append(pose)
        first = next((pose for pose in poses if pose is not None), None)
        if first is None:
            raise ValueError(f"no face in any of the frames {rows[0]} to {rows[-1]}")
        return [first if pose is None else pose for pose in poses], afresh


def reprojection_px(model: LandmarkModel, observed: Observed, rows: np.ndarray, state: State) -> np.ndarray:
    """Root mean square distance [B] px between fitted (state of these rows) and detected landmarks inside the picture.

    Landmarks that are wrong by themselves, a minority far from the rest, do not count.
    """
    surface = state.fold(model).surface
    out = []
    for k, row in enumerate(rows):
        away = _distance(surface, observed, row, state.pose(k), state)
        used = observed.inside[row] & ~_wrong(away, surface, state.pose(k), observed, row)
        out.append(np.sqrt((away**2 * used).sum() / max(used.sum(), 1)))
    return np.array(out)


def _visible(surface: Surface, pose: Pose, observed: Observed, row: int) -> np.ndarray:
    """Landmarks [L] bool inside the picture on the side that faces the camera; all inside where that is hardly any."""
    inside = observed.inside[row]
    visible = inside & (energy.facing(surface.normal, pose) > SIDE)
    return visible if visible.sum() > 0.1 * len(visible) else inside


def _wrong(away: np.ndarray, surface: Surface, pose: Pose, observed: Observed, row: int) -> np.ndarray:
    """Which landmarks [L] bool are far off, given how far [L] px each is: never most of those that face the camera."""
    seen = _visible(surface, pose, observed, row)
    middle = np.median(away[seen]) if seen.any() else 0.0
    return observed.inside[row] & (away > max(FAR_OF_EYES * observed.scale_px[row], FAR_OF_MEDIAN * middle))


def _distance(surface: Surface, observed: Observed, row: int, pose: Pose, state: State) -> np.ndarray:
    """Distance [L] px of each landmark."""
    pixel = camera.project(posed(surface, pose).points, state.focal_px, observed.centre_px)
    return np.linalg.norm(pixel - observed.points[row], axis=-1)


def held_out_px(tracker: Tracker, rows: np.ndarray, state: State, effort: int) -> np.ndarray:
    """Root mean square distance [B] px on a fixed fifth of the landmarks, each frame's own unknowns solved from the other four.

    Shape, camera and bias come from all points; the irises are never held out (nothing else tells the gaze).
    """
    model = tracker.model
    held = np.random.default_rng(0).permutation(len(model.ids)) < len(model.ids) // 5
    held &= ~np.isin(model.ids, (LEFT_IRIS, RIGHT_IRIS))
    out = []
    for k, row in enumerate(rows):
        start = replace(state.pose(k), expression=tracker.start.copy())
        fitted, _, _ = tracker.solve(tracker.problem(row, state.gaze[k], ~held), start, effort)
        away = _distance(tracker.folded.surface, tracker.observed, row, fitted, state)
        keep = held & tracker.observed.inside[row]
        out.append(np.sqrt((away[keep] ** 2).mean()) if keep.any() else np.nan)
    return np.array(out)
