"""The fit's energy: landmark residuals with analytic Jacobians, and priors.  Pure float64 numpy, batched over frames.

Letters: B frames at once, L landmarks, S shape, E expression coefficients.  Unknowns of one frame, in this order:
    rotation update (3, left-multiplicative: R <- exp(w) R), translation (3, m), expression (E), gaze (4: left pitch, left yaw,
    right pitch, right yaw, rad).
Shared unknowns: log focal length (1), shape (S).  The neck stays straight and the jaw joint neutral: landmarks cannot tell the
neck from the root, and this head model opens its jaw by actions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fitting import camera
from fitting.landmark_model import LandmarkModel
from fitting.solver import Normal

POSE = 6  # rotation and translation
GAZE = 4


@dataclass(frozen=True)
class Weights:
    """Standard deviations of the terms; the values stand in `fitting.fit`."""

    landmark_sigma: float  # of the inter-ocular distance
    robust_sigmas: float  # Huber's threshold
    correlated: float  # neighbouring landmarks err together: this many count as one
    expression_sd: float
    action_wall_sd: float  # softness of the wall at the ends of an action's range
    gaze_sd_rad: float
    vergence_sd_rad: float
    log_focal_sd: float
    shape_sd: float


@dataclass(frozen=True)
class Frames:
    """Observations of B frames."""

    points: np.ndarray  # [B, L, 2] px, rows of LandmarkModel.ids
    weight: np.ndarray  # [B, L] 0 hides a point (outside the picture, held out)
    scale_px: np.ndarray  # [B] inter-ocular distance as seen head-on
    centre_px: np.ndarray  # [2]
    expression_mean: np.ndarray  # [B, E] centre of the expression prior


@dataclass(frozen=True)
class State:
    """Unknowns of B frames and the shared ones."""

    rotation: np.ndarray  # [B, 3, 3]
    translation: np.ndarray  # [B, 3] m
    expression: np.ndarray  # [B, E]
    gaze: np.ndarray  # [B, 4] rad
    log_focal: float
    shape: np.ndarray  # [S]
    bias: np.ndarray  # [L, 3] m in the head frame, constant per landmark: detector and embedding disagree

    @property
    def focal_px(self) -> float:
        return float(np.exp(self.log_focal))

    def frame(self, rows: slice | np.ndarray) -> State:
        """The same shared unknowns, some of the frames."""
        return replace(
            self,
            rotation=self.rotation[rows],
            translation=self.translation[rows],
            expression=self.expression[rows],
            gaze=self.gaze[rows],
        )


def update(state: State, block: np.ndarray, shared: np.ndarray | None) -> State:
    """Apply a step: block [B, 6 + E + 4], shared [1 + S] or None."""
    count = state.expression.shape[1]
    return replace(
        state,
        rotation=camera.exp_rotation(block[:, :3]) @ state.rotation,
        translation=state.translation + block[:, 3:POSE],
        expression=state.expression + block[:, POSE : POSE + count],
        gaze=state.gaze + block[:, POSE + count :],
        log_focal=state.log_focal if shared is None else state.log_focal + shared[0],
        shape=state.shape if shared is None else state.shape + shared[1:],
    )


def head_points(model: LandmarkModel, state: State) -> np.ndarray:
    """Landmarks in the head frame [B, L, 3] m."""
    points = model.base + state.bias + np.tensordot(state.shape, model.shape_basis, 1)
    points = points + np.tensordot(state.expression, model.expression_basis, 1)
    joint = model.eye_joint + np.tensordot(state.shape, model.eye_joint_basis, 1)
    turn = camera.exp_rotation(gaze_vectors(state.gaze))  # [B, 2, 3, 3]
    points[:, model.pupil] = joint + np.einsum("beij,bej->bei", turn, points[:, model.pupil] - joint)
    return points


def gaze_vectors(gaze: np.ndarray) -> np.ndarray:
    """Axis-angle vectors [B, 2, 3] of gaze [B, 4]; the eye does not roll."""
    angles = gaze.reshape(-1, 2, 2)
    return np.concatenate([angles, np.zeros_like(angles[..., :1])], -1)


def residuals(
    model: LandmarkModel, frames: Frames, weights: Weights, state: State
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Landmark residuals in standard deviations.

    Returns:
        residual [B, L, 2]; its scale [B, L] (1 / px); points in the head frame and in camera axes [B, L, 3].
    """
    local = head_points(model, state)
    points = np.einsum("bij,blj->bli", state.rotation, local) + state.translation[:, None]
    sigma = weights.landmark_sigma * frames.scale_px[:, None] * model.group_sigma * np.sqrt(weights.correlated)
    scale = np.sqrt(frames.weight * visibility(model, state)) / sigma
    return (camera.project(points, state.focal_px, frames.centre_px) - frames.points) * scale[..., None], scale, local, points


def visibility(model: LandmarkModel, state: State) -> np.ndarray:
    """Weight [B, L]: 1 for a point that faces the camera, falling to 0.02 for one that is turned away (guessed)."""
    facing = (
        -np.einsum("bij,lj,bi->bl", state.rotation, model.normal, state.translation)
        / np.linalg.norm(state.translation, axis=1)[:, None]
    )
    return np.clip((facing + 0.1) / 0.4, 0.02, 1.0)


def robust(residual: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Huber cost and weight [B, L] of residuals [B, L, 2]."""
    norm = np.linalg.norm(residual, axis=-1)
    inside = norm <= threshold
    return np.where(inside, 0.5 * norm**2, threshold * (norm - 0.5 * threshold)), np.where(
        inside, 1.0, threshold / np.where(inside, 1.0, norm)
    )


def prior(model: LandmarkModel, frames: Frames, weights: Weights, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Prior cost [B], gradient [B, E + 4] and diagonal-plus-vergence Hessian [B, E + 4, E + 4] of expression and gaze."""
    count = state.expression.shape[1]
    away = (state.expression - frames.expression_mean) / weights.expression_sd
    below = np.minimum(state.expression - model.low, 0) / weights.action_wall_sd
    above = np.maximum(state.expression - model.high, 0) / weights.action_wall_sd
    look = state.gaze / weights.gaze_sd_rad
    apart = (state.gaze[:, :2] - state.gaze[:, 2:]) / weights.vergence_sd_rad
    cost = 0.5 * ((away**2).sum(1) + (below**2).sum(1) + (above**2).sum(1) + (look**2).sum(1) + (apart**2).sum(1))
    gradient = np.concatenate(
        [away / weights.expression_sd + (below + above) / weights.action_wall_sd, look / weights.gaze_sd_rad], 1
    )
    gradient[:, count : count + 2] += apart / weights.vergence_sd_rad
    gradient[:, count + 2 :] -= apart / weights.vergence_sd_rad
    hessian = np.zeros((len(away), count + GAZE, count + GAZE))
    rows = np.arange(count)
    hessian[:, rows, rows] = 1 / weights.expression_sd**2 + ((below < 0) | (above > 0)) / weights.action_wall_sd**2
    rows = np.arange(count, count + GAZE)
    hessian[:, rows, rows] = 1 / weights.gaze_sd_rad**2 + 1 / weights.vergence_sd_rad**2
    for left in (count, count + 1):
        hessian[:, left, left + 2] = hessian[:, left + 2, left] = -1 / weights.vergence_sd_rad**2
    return cost, gradient, hessian


def cost(model: LandmarkModel, frames: Frames, weights: Weights, state: State, focal_prior: float | None = None) -> float:
    """Total robust cost; with focal_prior (log px) the shared priors count too."""
    residual, *_ = residuals(model, frames, weights, state)
    total = robust(residual, weights.robust_sigmas)[0].sum() + prior(model, frames, weights, state)[0].sum()
    if focal_prior is not None:
        total += (
            0.5 * ((state.log_focal - focal_prior) / weights.log_focal_sd) ** 2
            + 0.5 * (state.shape**2).sum() / weights.shape_sd**2
        )
    return float(total)


def linearise(
    model: LandmarkModel,
    frames: Frames,
    weights: Weights,
    state: State,
    focal_prior: float | None = None,
    pose_only: bool = False,
) -> Normal:
    """Normal equations of the frames' blocks; with focal_prior (log px) also of the shared unknowns.

    Args:
        pose_only: expression and gaze are held (their rows are replaced by the identity).
    """
    residual, scale, local, points = residuals(model, frames, weights, state)
    value, influence = robust(residual, weights.robust_sigmas)
    root = np.sqrt(influence) * scale
    to_pixel = camera.project_jacobian(points, state.focal_px) * root[..., None, None]  # [B, L, 2, 3]
    to_head = to_pixel @ state.rotation[:, None]  # with respect to a point of the head frame
    count, batch = state.expression.shape[1], len(points)
    jacobian = np.zeros((batch, len(model.ids), 2, POSE + count + GAZE))
    jacobian[..., :3] = -to_pixel @ camera.cross_matrix(points - state.translation[:, None])
    jacobian[..., 3:POSE] = to_pixel
    vectors = gaze_vectors(state.gaze)
    turn = camera.exp_rotation(vectors)
    joint = model.eye_joint + np.tensordot(state.shape, model.eye_joint_basis, 1)
    if not pose_only:
        basis = np.moveaxis(model.expression_basis, 0, -1)  # [L, 3, E]
        jacobian[..., POSE : POSE + count] = np.matmul(to_head, basis)
        for eye, row in enumerate(model.pupil):
            arm = local[:, row] - joint[eye]
            turned = -camera.cross_matrix(arm) @ camera.left_jacobian(vectors[:, eye])
            columns = slice(POSE + count + 2 * eye, POSE + count + 2 * eye + 2)
            jacobian[:, row, :, columns] = to_head[:, row] @ turned[..., :2]
            jacobian[:, row, :, POSE : POSE + count] = to_head[:, row] @ turn[:, eye] @ basis[row]
    flat = jacobian.reshape(batch, -1, POSE + count + GAZE)
    right = (residual * np.sqrt(influence)[..., None]).reshape(batch, -1)
    hessian = flat.swapaxes(1, 2) @ flat
    gradient = np.einsum("bmd,bm->bd", flat, right)
    prior_cost, prior_gradient, prior_hessian = prior(model, frames, weights, state)
    if pose_only:
        rows = np.arange(POSE, POSE + count + GAZE)
        hessian[:, rows, rows] = 1.0
    else:
        gradient[:, POSE:] += prior_gradient
        hessian[:, POSE:, POSE:] += prior_hessian
    normal = Normal(value.sum(1) + prior_cost, hessian, gradient)
    if focal_prior is None:
        return normal
    shared = np.zeros((batch, len(model.ids), 2, 1 + len(state.shape)))
    offset = (points[..., :2] / points[..., 2:]) * state.focal_px
    shared[..., 0] = offset * root[..., None]  # d pixel / d log f
    moved = np.broadcast_to(np.moveaxis(model.shape_basis, 0, -1), (batch, *model.base.shape, len(state.shape))).copy()
    for eye, row in enumerate(model.pupil):
        at_joint = model.eye_joint_basis[:, eye].T
        moved[:, row] = at_joint + turn[:, eye] @ (moved[:, row] - at_joint)
    shared[..., 1:] = to_head @ moved
    columns = shared.reshape(batch, -1, 1 + len(state.shape))
    precision = np.concatenate([[1 / weights.log_focal_sd**2], np.full(len(state.shape), 1 / weights.shape_sd**2)])
    away = np.concatenate([[state.log_focal - focal_prior], state.shape])
    stacked = columns.reshape(-1, columns.shape[-1])
    return replace(
        normal,
        cross=flat.swapaxes(1, 2) @ columns,
        shared_hessian=stacked.T @ stacked + np.diag(precision),
        shared_gradient=stacked.T @ right.reshape(-1) + precision * away,
        shared_cost=0.5 * float((precision * away**2).sum()),
    )


def solve_bias(model: LandmarkModel, frames: Frames, weights: Weights, state: State, bias_sd_m: float) -> State:
    """Closed-form ridge update of the constant per-landmark offset [L, 3], everything else held."""
    residual, scale, _, points = residuals(model, frames, weights, state)
    _, influence = robust(residual, weights.robust_sigmas)
    root = np.sqrt(influence)
    jacobian = camera.project_jacobian(points, state.focal_px) @ state.rotation[:, None] * (scale * root)[..., None, None]
    hessian = np.einsum("bkpi,bkpj->kij", jacobian, jacobian) + np.eye(3) / bias_sd_m**2
    gradient = np.einsum("bkpi,bkp->ki", jacobian, residual * root[..., None]) + state.bias / bias_sd_m**2
    bias = state.bias - np.linalg.solve(hessian, gradient[..., None])[..., 0]
    bias[model.pupil] = 0.0  # a biased pupil would be a squint
    return replace(state, bias=bias)
