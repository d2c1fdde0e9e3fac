"""The stages of the fit: initial poses by PnP, joint calibration on keyframes, tracking in independent blocks, held-out check."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from fitting import camera, energy, solver
from fitting.correspondence import LEFT_IRIS, RIGHT_IRIS
from fitting.energy import Frames, State, Weights
from fitting.landmark_model import OUTER_EYE_CORNERS, LandmarkModel

STABLE = (4, 6, 33, 263, 133, 362, 129, 358, 168, 197, 5, 61, 291, 152, 127, 356, 234, 454)  # for PnP: bones and corners


@dataclass(frozen=True)
class Observed:
    """Landmarks of a whole video, restricted to the placed ones."""

    points: np.ndarray  # [T, L, 2] px; zero where not found
    found: np.ndarray  # [T] bool
    scale_px: np.ndarray  # [T] inter-ocular distance as seen head-on
    expression_mean: np.ndarray  # [T, E]
    inside: np.ndarray  # [T, L] bool, the point lies in the picture
    centre_px: np.ndarray  # [2]

    def frames(self, rows: np.ndarray, keep: np.ndarray | None = None) -> Frames:
        """Observations of some frames; keep [L] bool hides landmarks."""
        weight = self.inside[rows] * self.found[rows, None].astype(np.float64)
        weight = weight if keep is None else weight * keep
        return Frames(self.points[rows], weight, self.scale_px[rows], self.centre_px, self.expression_mean[rows])


def observe(
    model: LandmarkModel,
    points: np.ndarray,
    found: np.ndarray,
    blendshapes: np.ndarray,
    blendshape_names: list[str],
    expression_names: tuple[str, ...],
    centre_px: np.ndarray,
    size: tuple[int, int],
    prior_from_scores: float,
) -> Observed:
    """Collect what the detector saw.

    Args:
        points: [T, 478, 3] px, depth in px too; found: [T] bool; blendshapes: [T, 51] by name; size: (H, W) px.
        prior_from_scores: how much of a blendshape score becomes the centre of the expression prior (0: neutral).
    """
    points = np.where(found[:, None, None], points, 0.0).astype(np.float64)
    usable = found & np.isfinite(points).all((1, 2))
    corners = points[:, list(OUTER_EYE_CORNERS)]
    scale = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=1)  # with depth: does not shrink with yaw
    usable &= scale > 2.0
    chosen = points[:, model.ids, :2]
    inside = ((chosen > 1) & (chosen < np.array(size[::-1]) - 1)).all(-1)
    usable &= inside.mean(1) > 0.5
    names = list(blendshape_names)
    score = np.stack([blendshapes[:, names.index(n)] if n in names else np.zeros(len(found)) for n in expression_names], 1)
    return Observed(
        chosen,
        usable,
        np.where(usable, scale, 1.0),
        prior_from_scores * np.where(usable[:, None], score, 0.0),
        inside,
        np.asarray(centre_px),
    )


def neutral(model: LandmarkModel, count: int, log_focal: float) -> State:
    """Mean head, no expression, identity poses half a metre away."""
    return State(
        np.tile(np.eye(3), (count, 1, 1)),
        np.tile([0, 0, 0.5], (count, 1)),
        np.zeros((count, len(model.low))),
        np.zeros((count, energy.GAZE)),
        log_focal,
        np.zeros(len(model.shape_basis)),
        np.zeros_like(model.base),
    )


def pnp(model: LandmarkModel, observed: Observed, rows: np.ndarray, state: State) -> State:
    """Poses of `rows` by Perspective-n-Point on stable landmarks of the neutral head, expression and gaze set to neutral.

    A frame where PnP fails or puts the face behind the camera or turned away keeps a frontal pose at a plausible depth.
    """
    stable = np.flatnonzero(np.isin(model.ids, STABLE))
    neutral_points = model.base + state.bias + np.tensordot(state.shape, model.shape_basis, 1)
    matrix = np.array([[state.focal_px, 0, observed.centre_px[0]], [0, state.focal_px, observed.centre_px[1]], [0, 0, 1.0]])
    eyes = np.linalg.norm(neutral_points[model.pupil[0]] - neutral_points[model.pupil[1]]) * 1.45  # corner to corner
    rotation, translation = [], []
    for row in rows:
        object_points = np.ascontiguousarray(neutral_points[stable])
        image_points = np.ascontiguousarray(observed.points[row, stable])
        depth = state.focal_px * eyes / observed.scale_px[row]
        guess = np.array([*((observed.points[row].mean(0) - observed.centre_px) * depth / state.focal_px), depth])
        solved = _solve_pnp(object_points, image_points, matrix, 0.2 * depth)
        turn, guess = (np.eye(3), guess) if solved is None else solved
        rotation.append(turn)
        translation.append(guess)
    blank = neutral(model, len(rows), state.log_focal)
    return replace(blank, rotation=np.stack(rotation), translation=np.stack(translation), shape=state.shape, bias=state.bias)


def _solve_pnp(
    object_points: np.ndarray, image_points: np.ndarray, matrix: np.ndarray, nearest_m: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Rotation [3, 3] and translation [3] m by SQPnP, refined; None for a degenerate, too near or turned-away solution."""
    try:
        ok, vector, offset = cv2.solvePnP(object_points, image_points, matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        if not ok or not np.isfinite(vector).all() or not np.isfinite(offset).all():
            return None
        if offset[2, 0] < nearest_m or camera.exp_rotation(vector[:, 0])[2, 2] <= 0:
            return None
        vector, offset = cv2.solvePnPRefineLM(object_points, image_points, matrix, None, vector, offset)
    except cv2.error:  # OpenCV's way of saying that the points lie on top of each other
        return None
    good = np.isfinite(vector).all() and np.isfinite(offset).all() and offset[2, 0] > nearest_m
    return (camera.exp_rotation(vector[:, 0]), offset[:, 0]) if good else None


def choose_keyframes(observed: Observed, rows: np.ndarray, poses: State, sharpness: np.ndarray, count: int) -> np.ndarray:
    """Keyframes out of `rows`: spread in yaw and pitch by farthest-point choice, sharp and near neutral where there is a choice.

    Args:
        poses: of `rows`, from PnP; sharpness: [T] variance of the Laplacian.

    Returns:
        frame numbers, sorted.
    """
    angles = camera.log_rotation(poses.rotation)[:, :2]
    calm = np.abs(observed.expression_mean[rows]).sum(1)
    rank = lambda values: np.argsort(np.argsort(values)) / max(len(values) - 1, 1)  # noqa: E731
    penalty = 0.5 * rank(calm) + 0.5 * rank(-sharpness[rows])
    good = np.flatnonzero(penalty <= np.quantile(penalty, 0.7)) if len(rows) > 2 * count else np.arange(len(rows))
    chosen = [int(good[np.argmin(np.abs(angles[good]).sum(1) + 0.1 * penalty[good])])]
    distance = np.full(len(good), np.inf)
    while len(chosen) < min(count, len(good)):
        distance = np.minimum(distance, np.linalg.norm(angles[good] - angles[chosen[-1]], axis=1))
        chosen.append(int(good[np.argmax(distance + 0.02 * (1 - penalty[good]))]))
        distance[good == chosen[-1]] = -np.inf
    return np.sort(rows[np.unique(chosen)])


@dataclass(frozen=True)
class Calibration:
    """Shared unknowns and how well the clip determines them."""

    state: State  # of the keyframes
    keyframes: np.ndarray
    focal_sd: float  # relative standard deviation of the focal length without its prior
    focal_kept_prior: bool
    iterations: int


def calibrate(
    model: LandmarkModel,
    observed: Observed,
    keyframes: np.ndarray,
    weights: Weights,
    log_focal: float,
    bias_sd_m: float,
    max_focal_sd: float,
    rounds: int = 3,
) -> Calibration:
    """Focal length, shape, per-landmark bias and the keyframes' own unknowns, jointly (Schur complement).

    Where the clip does not determine the focal length (relative standard deviation above max_focal_sd), the prior's value is
    kept and the solve repeated with it fixed.
    """
    frames = observed.frames(keyframes)
    state = pnp(model, observed, keyframes, neutral(model, 1, log_focal))
    state = _solve(model, frames, weights, state, 4, pose_only=True)[0]
    iterations = 0
    focal_sd = 0.0
    for attempt in range(2):
        used = weights if attempt == 0 else replace(weights, log_focal_sd=1e-3)
        for _ in range(rounds):
            state, report = _solve_jointly(model, frames, used, state, log_focal)
            state = energy.solve_bias(model, frames, used, state, bias_sd_m)
            iterations += report.iterations
        if attempt == 0:
            information = 1 / report.shared_covariance[0, 0] - 1 / weights.log_focal_sd**2
            focal_sd = float(1 / np.sqrt(information)) if information > 0 else float("inf")
            if focal_sd <= max_focal_sd:
                return Calibration(state, keyframes, focal_sd, False, iterations)
            state = replace(pnp(model, observed, keyframes, neutral(model, 1, log_focal)), shape=state.shape)
    return Calibration(state, keyframes, focal_sd, True, iterations)


def _solve_jointly(
    model: LandmarkModel, frames: Frames, weights: Weights, state: State, log_focal: float
) -> tuple[State, solver.Report]:
    """Levenberg-Marquardt on the frames' own and the shared unknowns together."""
    return solver.minimise(
        state,
        lambda s: energy.linearise(model, frames, weights, s, log_focal),
        energy.update,
        lambda s: energy.cost(model, frames, weights, s, log_focal),
        15,
    )


def _solve(
    model: LandmarkModel, frames: Frames, weights: Weights, state: State, iterations: int, pose_only: bool = False
) -> tuple[State, solver.Report]:
    """Levenberg-Marquardt on per-frame unknowns, shared ones held."""
    return solver.minimise(
        state,
        lambda s: energy.linearise(model, frames, weights, s, None, pose_only),
        energy.update,
        lambda s: energy.cost(model, frames, weights, s),
        iterations,
    )


def track_block(
    model: LandmarkModel, observed: Observed, rows: np.ndarray, weights: Weights, shared: State, iterations: int
) -> State:
    """Track consecutive frames: the first by PnP and a neutral expression, each next one from the frame before.

    Blocks do not read each other (the paper re-initialises every 200 frames, supplement "3DMM Fitting Details"), so they can run
    in any order.  Frames that were not found keep the last state.
    """
    state: State | None = None
    done = []
    for row in rows:
        if observed.found[row]:
            frames = observed.frames(np.array([row]))
            if state is None:
                state = pnp(model, observed, np.array([row]), shared)
                state = _solve(model, frames, weights, state, 6, pose_only=True)[0]
                state = _solve(model, frames, weights, state, 3 * iterations)[0]
            else:
                state = _solve(model, frames, weights, state, iterations)[0]
        done.append(state)
    first = next((s for s in done if s is not None), None)
    if first is None:
        raise ValueError(f"no face in any of the frames {rows[0]} to {rows[-1]}")
    done = [first if s is None else s for s in done]
    return replace(
        done[0],
        **{name: np.concatenate([getattr(s, name) for s in done]) for name in ("rotation", "translation", "expression", "gaze")},
    )


def reprojection_px(model: LandmarkModel, observed: Observed, rows: np.ndarray, state: State) -> np.ndarray:
    """Root mean square distance [B] px between fitted and detected landmarks that lie inside the picture."""
    points = np.einsum("bij,blj->bli", state.rotation, energy.head_points(model, state)) + state.translation[:, None]
    away = np.linalg.norm(camera.project(points, state.focal_px, observed.centre_px) - observed.points[rows], axis=-1)
    inside = observed.inside[rows]
    return np.sqrt((away**2 * inside).sum(1) / inside.sum(1).clip(1))


def held_out_px(
    model: LandmarkModel, observed: Observed, rows: np.ndarray, weights: Weights, state: State, iterations: int
) -> np.ndarray:
    """Root mean square distance [B] px on a fixed fifth of the landmarks, each frame's own unknowns solved from the other four.

    Shape, camera and bias come from all points; the irises are never held out (nothing else tells the gaze).
    """
    random = np.random.default_rng(0)
    held = random.permutation(len(model.ids)) < len(model.ids) // 5
    held &= ~np.isin(model.ids, (LEFT_IRIS, RIGHT_IRIS))
    out = []
    for k, row in enumerate(rows):
        frames = observed.frames(np.array([row]), ~held)
        start = replace(state.frame(slice(k, k + 1)), expression=np.zeros_like(state.expression[:1]))
        fitted = _solve(model, frames, weights, start, 2 * iterations)[0]
        points = np.einsum("bij,blj->bli", fitted.rotation, energy.head_points(model, fitted)) + fitted.translation[:, None]
        away = np.linalg.norm(camera.project(points, fitted.focal_px, observed.centre_px) - observed.points[row], axis=-1)[0]
        keep = held & observed.inside[row]
        out.append(np.sqrt((away[keep] ** 2).mean()) if keep.any() else np.nan)
    return np.array(out)
