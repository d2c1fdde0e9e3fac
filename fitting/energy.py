"""The fit's energy: every term is a function from a posed surface to weighted residual rows, and one place adds them up.

Pure float64 numpy.  Letters: L landmarks, M residual rows, E expression and S shape coefficients, d unknowns of
a frame (fitting.rig).
Robust costs are Huber's, by iteratively reweighted least squares.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fitting import camera
from fitting.landmark_model import LandmarkModel
from fitting.rig import GAZE, JAW, POSE, Pose, Posed, Surface, jacobian, posed

# Standard deviation of the lid gap of a shut eye over that of an open one; in between by how open it looks (`observed`).
# Tighter (0.25), lids on the far side that are only guessed to be shut turn the head (`tests/test_hard_landmarks.py`, case 3).
SHUT_SIGMA = 0.5


@dataclass(frozen=True)
class Weights:
    """Standard deviations of the terms; the values stand in `fitting.settings`."""

    landmark_sigma: float  # of the inter-ocular distance
    robust_sigmas: float  # Huber's threshold
    correlated: float  # neighbouring landmarks err together: this many count as one
    iris: float  # weight of the irises among the landmarks
    eyelid_sigma: float  # of the lid gap, in inter-ocular distances
    expression_sd: float  # of an action in [0, 1]
    statistical_sd: float  # of a coefficient of a statistical basis (unit variance)
    action_wall_sd: float  # softness of the wall at the ends of an action's range
    gaze_sd_rad: float
    vergence_sd_rad: float
    shut_gaze_sd_rad: float  # how far the gaze may wander behind a shut lid
    jaw_sd_rad: tuple[float, float, float]
    jaw_wall_rad: float  # an angle below this is pushed back
    log_focal_sd: float
    shape_sd: float
    shape_wall: float  # identity coefficients beyond this many standard deviations are pushed back
    shape_wall_sd: float


@dataclass(frozen=True)
class Camera:
    """Pinhole camera at the origin."""

    focal_px: float
    centre_px: np.ndarray  # [2]


@dataclass(frozen=True)
class Frame:
    """What was seen of one frame."""

    points: np.ndarray  # [L, 2] px, rows of LandmarkModel.ids
    weight: np.ndarray  # [L] 0 hides a point (outside the picture, held out, iris behind a lid)
    scale_px: float  # inter-ocular distance as seen head-on
    expression_mean: np.ndarray  # [E] centre of the expression prior
    open_eyes: np.ndarray  # [2] 1 open, 0 shut; left, right
    gaze_mean: np.ndarray  # [4] where the gaze is held while an eye is shut


@dataclass(frozen=True)
class Rows:
    """Residual rows of one term in one frame, weighted so that the cost is half their sum of squares to first order."""

    cost: float  # robust
    residual: np.ndarray  # [M]
    parts: tuple[tuple[np.ndarray, np.ndarray], ...]  # (covector [M, 3], point [M]): the residual moves with each of these points
    nuisance: np.ndarray | None = None  # [M, N] weighted columns of unknowns that are eliminated (gain, bias)
    kept: np.ndarray | None = None  # [N] part of each column's own direction (beyond those before it) that stays; None: nothing


@dataclass(frozen=True)
class Term:
    """One term of one frame: a folded surface and the function that compares it with the picture."""

    surface: Surface
    rows: Callable[[Posed], Rows]


def huber(norm: np.ndarray, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Huber cost and weight of residual norms [...]."""
    inside = norm <= threshold
    return (
        np.where(inside, 0.5 * norm**2, threshold * (norm - 0.5 * threshold)),
        np.where(inside, 1.0, threshold / np.where(inside, 1.0, norm)),
    )


def facing(normal: np.ndarray, pose: Pose) -> np.ndarray:
    """Weight [P] of points with template normals [P, 3]: 1 towards the camera, falling to 0.02 where it is turned away."""
    toward = -(normal @ (pose.rotation.T @ pose.translation)) / np.linalg.norm(pose.translation)
    return np.clip((toward + 0.1) / 0.4, 0.02, 1.0)


def landmark_rows(model: LandmarkModel, frame: Frame, weights: Weights, lens: Camera, at: Posed) -> Rows:
    """Distance between projected and detected landmarks, irises among them, in standard deviations."""
    sigma = weights.landmark_sigma * frame.scale_px * model.group_sigma * np.sqrt(weights.correlated)
    weight = frame.weight * facing(model.surface.normal, at.pose)
    weight[model.pupil] *= weights.iris
    scale = np.sqrt(weight) / sigma
    residual = (camera.project(at.points, lens.focal_px, lens.centre_px) - frame.points) * scale[:, None]
    cost, influence = huber(np.linalg.norm(residual, axis=1), weights.robust_sigmas)
    root = np.sqrt(influence)
    covector = camera.project_jacobian(at.points, lens.focal_px) * (scale * root)[:, None, None]
    used = np.flatnonzero(scale > 0)
    return Rows(
        float(cost.sum()),
        (residual * root[:, None])[used].ravel(),
        ((covector[used].reshape(-1, 3), np.repeat(used, 2)),),
    )


def eyelid_rows(model: LandmarkModel, frame: Frame, weights: Weights, lens: Camera, at: Posed) -> Rows:
    """Gap between the lids as seen against as detected: a blink moves few landmarks by little, so it gets its own term.

    Tightest where an eye is shut: an open eye's gap, held as tightly, would turn the head.
    """
    upper, lower = model.lids[..., 0].ravel(), model.lids[..., 1].ravel()
    seen = np.sqrt(frame.weight[upper] * frame.weight[lower] * facing(model.surface.normal[upper], at.pose))
    shut = 1 - np.repeat(frame.open_eyes, model.lids.shape[1])
    scale = seen / (weights.eyelid_sigma * (1 - shut * (1 - SHUT_SIGMA)) * frame.scale_px)
    pixel = camera.project(at.points, lens.focal_px, lens.centre_px)
    gap = (pixel[upper] - pixel[lower]) - (frame.points[upper] - frame.points[lower])
    residual = gap * scale[:, None]
    cost, influence = huber(np.linalg.norm(residual, axis=1), weights.robust_sigmas)
    root = (scale * np.sqrt(influence))[:, None, None]
    rows = lambda points, sign: (  # noqa: E731
        (sign * root * camera.project_jacobian(at.points[points], lens.focal_px)).reshape(-1, 3),
        np.repeat(points, 2),
    )
    return Rows(float(cost.sum()), (residual * np.sqrt(influence)[:, None]).ravel(), (rows(upper, 1.0), rows(lower, -1.0)))


@dataclass(frozen=True)
class Prior:
    """Priors of one frame's expression, gaze and jaw: quadratics, with soft walls at the ends of an action's range."""

    mean: np.ndarray  # [d]
    precision: np.ndarray  # [d, d] of everything but the walls; zero for rotation and translation
    low: np.ndarray  # [d] lower wall, -inf where there is none
    high: np.ndarray  # [d]
    wall: np.ndarray  # [d] precision beyond a wall

    def __call__(self, pose: Pose) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost, gradient [d] and Hessian [d, d]."""
        value = np.concatenate([np.zeros(POSE), pose.expression, pose.gaze, pose.jaw])
        away = value - self.mean
        beyond = np.minimum(value - self.low, 0) + np.maximum(value - self.high, 0)
        pull, push = self.precision @ away, self.wall * beyond
        hessian = self.precision.copy()
        hessian[np.diag_indices_from(hessian)] += self.wall * (beyond != 0)
        return 0.5 * float(away @ pull + beyond @ push), pull + push, hessian


def prior(model: LandmarkModel, frame: Frame, weights: Weights) -> Prior:
    """The priors of one frame: expression about the scores, gaze straight ahead (held while an eye is shut), jaw shut."""
    count = len(model.low)
    size = POSE + count + GAZE + JAW
    deviation = np.ones(size)
    bounded = np.isfinite(model.low) | np.isfinite(model.high)
    deviation[POSE : POSE + count] = np.where(bounded, weights.expression_sd, weights.statistical_sd)
    shut = np.repeat(frame.open_eyes < 0.1, 2)
    deviation[POSE + count : -JAW] = np.where(shut, weights.shut_gaze_sd_rad, weights.gaze_sd_rad)
    deviation[-JAW:] = weights.jaw_sd_rad
    precision = np.diag(1 / deviation**2)
    precision[:POSE, :POSE] = 0.0
    for left in (POSE + count, POSE + count + 1):  # both eyes look at the same thing
        for row, column, sign in ((left, left, 1), (left + 2, left + 2, 1), (left, left + 2, -1), (left + 2, left, -1)):
            precision[row, column] += sign / weights.vergence_sd_rad**2
    mean, low, high, wall = np.zeros(size), np.full(size, -np.inf), np.full(size, np.inf), np.zeros(size)
    mean[POSE : POSE + count] = frame.expression_mean
    eyes = slice(POSE + count, POSE + count + GAZE)
    held = np.where(shut, frame.gaze_mean, 0.0) / deviation[eyes] ** 2
    mean[eyes] = np.linalg.solve(precision[eyes, eyes], held)  # vergence compares the angles, not their distances to a mean
    low[POSE : POSE + count], high[POSE : POSE + count] = model.low, model.high
    wall[POSE : POSE + count] = 1 / weights.action_wall_sd**2
    low[-JAW], wall[-JAW] = weights.jaw_wall_rad, 1 / np.radians(0.5) ** 2
    return Prior(mean, precision, low, high, wall)


@dataclass(frozen=True)
class Problem:
    """All terms of one frame: its cost and normal equations."""

    terms: tuple[Term, ...]
    prior: Callable[[Pose], tuple[float, np.ndarray, np.ndarray]]
    free: np.ndarray  # [d] bool, unknowns that are solved for

    def evaluate(self, pose: Pose) -> tuple[float, list[tuple[Posed, Rows]]]:
        """Total robust cost and the terms' rows; one surface is posed once however many terms read it."""
        done: dict[int, Posed] = {}
        out = []
        for term in self.terms:
            if id(term.surface) not in done:
                done[id(term.surface)] = posed(term.surface, pose)
            at = done[id(term.surface)]
            out.append((at, eliminated(term.rows(at))))
        return self.prior(pose)[0] + sum(rows.cost for _, rows in out), out

    def normal(self, pose: Pose, evaluated: list[tuple[Posed, Rows]]) -> tuple[np.ndarray, np.ndarray]:
        """Gauss-Newton Hessian [d, d] and gradient [d]; rows and columns of held unknowns are the identity and zero."""
        _, gradient, hessian = self.prior(pose)
        for at, rows in evaluated:
            columns = row_jacobian(at, rows)
            hessian = hessian + columns.T @ columns
            gradient = gradient + columns.T @ rows.residual
        held = ~self.free
        hessian[held], hessian[:, held], gradient[held] = 0.0, 0.0, 0.0
        hessian[held, held] = 1.0
        return hessian, gradient

    def gradient(self, pose: Pose, evaluated: list[tuple[Posed, Rows]]) -> np.ndarray:
        """Gradient [d] of the cost alone; zero for held unknowns."""
        total = self.prior(pose)[1]
        for at, rows in evaluated:
            total = total + row_jacobian(at, rows).T @ rows.residual
        return np.where(self.free, total, 0.0)


def eliminated(rows: Rows) -> Rows:
    """Rows with their nuisance unknowns solved for: an orthonormal basis replaces the columns and the residual is projected.

    The cost loses what the projection takes away (variable projection).
    """
    if rows.nuisance is None or not len(rows.residual):
        return rows
    basis, triangle = np.linalg.qr(rows.nuisance)
    size = np.zeros(rows.nuisance.shape[1])  # of what is a column's own; there may be fewer rows than columns
    size[: len(triangle)] = np.abs(np.diag(triangle))
    own = size > 1e-6 * np.maximum(1e-30, np.linalg.norm(triangle, axis=0))  # columns of any units, read from float32 pictures
    kept = (np.zeros(len(own)) if rows.kept is None else rows.kept)[own]
    if not own.all():  # those after a column that says nothing new must not be made orthogonal to its rounding errors
        basis = np.linalg.qr(rows.nuisance[:, own])[0]
    amount = basis.T @ rows.residual
    residual = rows.residual - basis @ ((1 - kept) * amount)
    return replace(rows, residual=residual, nuisance=basis, kept=kept, cost=rows.cost - 0.5 * float((1 - kept**2) @ amount**2))


def row_jacobian(at: Posed, rows: Rows) -> np.ndarray:
    """Jacobian [M, d] of a term's rows, nuisance unknowns eliminated."""
    columns = sum(jacobian(at, covector, point) for covector, point in rows.parts)
    if rows.nuisance is None:
        return columns
    lost = 1 if rows.kept is None else (1 - rows.kept)[:, None]
    return columns - rows.nuisance @ (lost * (rows.nuisance.T @ columns))


def free_unknowns(model: LandmarkModel, pose_only: bool = False, actions: np.ndarray | None = None) -> np.ndarray:
    """Which unknowns [d] are solved for: pose alone, or all that this head model has and the clip determines (actions [E])."""
    count = len(model.low)
    free = np.zeros(POSE + count + GAZE + JAW, bool)
    free[:POSE] = True
    if not pose_only:
        free[POSE : POSE + count] = True if actions is None else actions
        free[POSE + count : POSE + count + GAZE] = True
        free[POSE + count + GAZE :] = model.jaw_moves
    return free


def landmark_problem(
    model: LandmarkModel, frame: Frame, weights: Weights, lens: Camera, free: np.ndarray, extra: tuple[Term, ...] = ()
) -> Problem:
    """The landmark and eyelid terms and the priors of one frame, with further terms; the model's surface is folded."""
    terms = (
        Term(model.surface, lambda at: landmark_rows(model, frame, weights, lens, at)),
        Term(model.surface, lambda at: eyelid_rows(model, frame, weights, lens, at)),
    )
    return Problem((*terms, *extra), prior(model, frame, weights), free)
