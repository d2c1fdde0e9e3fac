"""Calibration: focal length, identity and landmark bias, solved together on keyframes that are chosen automatically."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fitting import camera, energy, solver, stages
from fitting.energy import Problem, Weights
from fitting.landmark_model import LandmarkModel
from fitting.observed import Observed
from fitting.pictures import Extra
from fitting.rig import POSE, Surface, posed, shape_columns
from fitting.state import State, neutral


@dataclass(frozen=True)
class Calibration:
    """Shared unknowns and how well the clip determines them."""

    state: State  # of the keyframes
    keyframes: np.ndarray
    focal_sd: float  # relative standard deviation of the focal length without its prior
    focal_kept_prior: bool
    iterations: int
    actions: np.ndarray  # [E] bool, expression coefficients that the keyframes determine
    held: np.ndarray  # [E] values of the others
    certainty: np.ndarray  # [E] posterior over prior standard deviation, median over keyframes


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


class _Joint:
    """The joint problem of all keyframes: a frame's own unknowns in blocks, focal length and identity shared."""

    def __init__(
        self,
        model: LandmarkModel,
        observed: Observed,
        keyframes: np.ndarray,
        weights: Weights,
        log_focal: float,
        free: np.ndarray,
        extra: Extra,
    ) -> None:
        self.model, self.observed, self.keyframes, self.weights = model, observed, keyframes, weights
        self.log_focal, self.free, self.extra = log_focal, free, extra

    def problem(self, state: State, folded: LandmarkModel, k: int) -> tuple[Problem, dict[int, Surface]]:
        """The problem of one keyframe and the unfolded surface of each folded one, by identity."""
        row = self.keyframes[k]
        extra = self.extra(state, k)
        frame = self.observed.frame(self.model, row, state.gaze[k])
        problem = energy.landmark_problem(
            folded, frame, self.weights, state.lens(self.observed.centre_px), self.free, tuple(term for term, _ in extra)
        )
        return problem, {id(folded.surface): self.model.surface} | {id(term.surface): surface for term, surface in extra}

    def cost(self, state: State) -> float:
        """Total robust cost with the shared priors."""
        folded = state.fold(self.model)
        total = sum(self.problem(state, folded, k)[0].evaluate(state.pose(k))[0] for k in range(len(state)))
        return total + self._shared_prior(state)[0]

    def _shared_prior(self, state: State) -> tuple[float, np.ndarray, np.ndarray]:
        """Cost, gradient and Hessian: normal distributions, and a soft wall where no real head lies.

        What all frames share is told by all of them with the same error (a detector that sees the nose too long sees it so in
        every frame), so K keyframes count as INDEPENDENT_VIEWS: the prior gains what the data lose.
        """
        beyond = np.concatenate([[0.0], np.sign(state.shape) * np.maximum(np.abs(state.shape) - self.weights.shape_wall, 0)])
        wall = 1 / self.weights.shape_wall_sd**2
        precision = np.concatenate([[1 / self.weights.log_focal_sd**2], np.full(len(state.shape), 1 / self.weights.shape_sd**2)])
        alike = max(1.0, len(self.keyframes) / INDEPENDENT_VIEWS)
        precision, wall = precision * alike, wall * alike
        away = np.concatenate([[state.log_focal - self.log_focal], state.shape])
        cost = 0.5 * float(precision @ away**2 + wall * (beyond @ beyond))
        return cost, precision * away + wall * beyond, np.diag(precision + wall * (beyond != 0))

    def linearise(self, state: State) -> solver.Normal:
        """Normal equations of the blocks and of the shared unknowns (log focal length, then shape)."""
        folded = state.fold(self.model)
        shared_cost, shared_gradient, shared_hessian = self._shared_prior(state)
        blocks = []
        for k in range(len(state)):
            problem, unfolded = self.problem(state, folded, k)
            cost, evaluated = problem.evaluate(state.pose(k))
            hessian, gradient = problem.normal(state.pose(k), evaluated)
            cross = np.zeros((len(gradient), len(shared_gradient)))
            for at, rows in evaluated:
                own = energy.row_jacobian(at, rows)
                own[:, ~self.free] = 0.0
                columns = np.zeros((len(rows.residual), len(shared_gradient)))
                for covector, point in rows.parts:
                    # A longer focal length moves a pixel as a sideways stretch of its point does.
                    columns[:, 0] += (covector[:, :2] * at.points[point, :2]).sum(1)
                    columns[:, 1:] += shape_columns(at, unfolded[id(at.surface)], covector, point)
                cross += own.T @ columns
                shared_hessian = shared_hessian + columns.T @ columns
                shared_gradient = shared_gradient + columns.T @ rows.residual
            blocks.append((cost, hessian, gradient, cross))
        cost, hessian, gradient, cross = (np.stack(values) for values in zip(*blocks, strict=True))
        return solver.Normal(cost, hessian, gradient, cross, shared_hessian, shared_gradient, shared_cost)

    @staticmethod
    def update(state: State, block: np.ndarray, shared: np.ndarray) -> State:
        """Apply a step."""
        moved = state.with_poses([state.pose(k).moved(step) for k, step in enumerate(block)])
        return replace(moved, log_focal=state.log_focal + shared[0], shape=state.shape + shared[1:])

    def solve(self, state: State, iterations: int) -> tuple[State, solver.Report]:
        """Levenberg-Marquardt on all of it."""
        return solver.minimise(state, self.linearise, self.update, self.cost, iterations)


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
    """Focal length, identity, per-landmark bias and the keyframes' own unknowns from landmarks.

    Where the clip does not determine the focal length (relative standard deviation above max_focal_sd), the prior's value is
    kept and the solve repeated with it fixed.  A coefficient of expression that the landmarks hardly see is found too.
    """
    free = energy.free_unknowns(model)
    iterations, focal_sd, kept = 0, 0.0, False
    start = _start(model, observed, keyframes, weights, neutral(model, 1, log_focal))
    state = start
    for attempt in range(2):
        used = weights if attempt == 0 else replace(weights, log_focal_sd=1e-3)
        joint = _Joint(model, observed, keyframes, used, log_focal, free, lambda *_: ())
        for _ in range(rounds):
            state, report = joint.solve(state, 15)
            state = solve_bias(model, observed, keyframes, used, state, bias_sd_m)
            iterations += report.iterations
        if attempt == 0:
            alike = max(1.0, len(keyframes) / INDEPENDENT_VIEWS)
            information = 1 / (alike * report.shared_covariance[0, 0]) - 1 / weights.log_focal_sd**2
            focal_sd = float(1 / np.sqrt(information)) if information > 0 else float("inf")
            kept = focal_sd > max_focal_sd
            if not kept:
                break
            state = replace(start, shape=state.shape)
    certainty = _certainty(joint, state)
    held = np.median(observed.expression_mean[keyframes], 0)
    return Calibration(state, keyframes, focal_sd, kept, iterations, certainty < HELD_ABOVE, held, certainty)


INDEPENDENT_VIEWS = 3  # on simulated clips focal lengths were 13 to 26 % off where 40 independent keyframes promised 7 %
HELD_ABOVE = 0.97  # posterior over prior deviation from which a coefficient counts as not determined


def _start(model: LandmarkModel, observed: Observed, keyframes: np.ndarray, weights: Weights, shared: State) -> State:
    """Poses of the keyframes by PnP, then by a pose-only solve."""
    state = stages.pnp(model, observed, keyframes, shared)
    folded, rigid = state.fold(model), energy.free_unknowns(model, pose_only=True)
    poses = []
    for k, row in enumerate(keyframes):
        frame = observed.frame(model, row)
        problem = energy.landmark_problem(folded, frame, weights, state.lens(observed.centre_px), rigid)
        poses.append(solver.solve_frame(problem, state.pose(k), 4)[0])
    return state.with_poses(poses)


def _certainty(joint: _Joint, state: State) -> np.ndarray:
    """Posterior over prior standard deviation [E] of each expression coefficient, median over keyframes, shared unknowns held."""
    folded, count = state.fold(joint.model), state.expression.shape[1]
    bounded = np.isfinite(joint.model.low) | np.isfinite(joint.model.high)
    deviation = np.where(bounded, joint.weights.expression_sd, joint.weights.statistical_sd)
    out = []
    for k in range(len(state)):
        problem, _ = joint.problem(state, folded, k)
        pose = state.pose(k)
        inside = replace(
            pose, expression=np.clip(pose.expression, joint.model.low + 1e-3, joint.model.high - 1e-3)
        )  # off the walls
        hessian, _ = problem.normal(inside, problem.evaluate(inside)[1])
        variance = np.diag(np.linalg.inv(hessian))[POSE : POSE + count]
        out.append(np.sqrt(variance) / deviation)
    return np.median(out, 0)


def refine(
    model: LandmarkModel,
    observed: Observed,
    calibration: Calibration,
    weights: Weights,
    extra_of: Callable[[State], Extra],
    rounds: int,
) -> Calibration:
    """Identity and poses of the keyframes again, with further terms (the silhouette); focal length and bias stay.

    Args:
        extra_of: builds the further terms anew in each round, around the state that it is given.
    """
    state = calibration.state
    fixed = replace(weights, log_focal_sd=1e-3)
    iterations = calibration.iterations
    for _ in range(rounds):
        joint = _Joint(
            model, observed, calibration.keyframes, fixed, state.log_focal, energy.free_unknowns(model), extra_of(state)
        )
        state, report = joint.solve(state, 6)
        iterations += report.iterations
    return replace(calibration, state=state, iterations=iterations)


def solve_bias(
    model: LandmarkModel, observed: Observed, keyframes: np.ndarray, weights: Weights, state: State, bias_sd_m: float
) -> State:
    """Closed-form ridge update of the constant per-landmark offset [L, 3], everything else held."""
    folded, lens = state.fold(model), state.lens(observed.centre_px)
    hessian = np.tile(np.eye(3) / bias_sd_m**2, (len(model.ids), 1, 1))
    gradient = state.bias / bias_sd_m**2
    for k, row in enumerate(keyframes):
        at = posed(folded.surface, state.pose(k))
        rows = energy.landmark_rows(folded, observed.frame(model, row, state.gaze[k]), weights, lens, at)
        covector, point = rows.parts[0]
        local = covector @ state.rotation[k]
        np.add.at(hessian, point, local[:, :, None] * local[:, None, :])
        np.add.at(gradient, point, local * rows.residual[:, None])
    bias = state.bias - np.linalg.solve(hessian, gradient[..., None])[..., 0]
    bias[model.pupil] = 0.0  # a biased pupil would be a squint
    return replace(state, bias=bias)
