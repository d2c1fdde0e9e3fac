"""The bundle's banded solve against dense algebra, its stencils on polynomials, and what it does to made sequences."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from fitting import bundle, camera, settings, stages
from fitting.energy import Problem, Rows, Term, huber
from fitting.rig import posed
from tests.landmarked import degrees_apart, detected, landmarked_head, model_of, random_state
from tests.test_stages import lose, track, tracker

D = 16
SMOOTH = settings.SMOOTHNESS.deviation(3)


@pytest.fixture(scope="module")
def model():
    return model_of(landmarked_head())[1]


def even(frames: int, cut: tuple[int, ...] = ()) -> np.ndarray:
    return bundle.stencils(np.arange(frames) / 30, np.isin(np.arange(frames), cut))


@pytest.mark.parametrize("cut", [(), (4,), (1, 5)])
def test_banded_step_equals_the_dense_one(cut):
    random = np.random.default_rng(len(cut))
    count, unknowns = 9, 5
    factor = random.normal(size=(count, 7, unknowns)) * 10.0 ** random.uniform(-1, 1, unknowns)
    hessian, gradient = factor.swapaxes(1, 2) @ factor, random.normal(size=(count, unknowns))
    stencil = bundle.stencils(np.cumsum(random.uniform(0.02, 0.06, count)), np.isin(np.arange(count), cut))
    bend, precision = random.normal(size=(count - 2, unknowns)), 10.0 ** random.uniform(-1, 3, (count - 2, unknowns))
    dense, right = np.zeros((count * unknowns,) * 2), gradient.ravel().copy()
    for k in range(count):
        dense[k * unknowns : (k + 1) * unknowns, k * unknowns : (k + 1) * unknowns] = hessian[k]
    for k in range(count - 2):
        for unknown in range(unknowns):
            row = np.zeros(count * unknowns)
            row[(k + np.arange(3)) * unknowns + unknown] = stencil[k]
            dense += precision[k, unknown] * np.outer(row, row)
            right += precision[k, unknown] * bend[k, unknown] * row
    dense[np.diag_indices_from(dense)] *= 1 + 1e-9  # what keeps a frame without any term solvable
    ours = bundle._solve(hessian, gradient, bend, precision, stencil)
    np.testing.assert_allclose(ours.ravel(), -np.linalg.solve(dense, right), rtol=1e-7, atol=1e-9)


def test_stencils_are_exact_on_parabolas_at_any_rate():
    time = np.cumsum([0, 0.03, 0.05, 0.02, 0.04, 0.033, 0.06])
    stencil = bundle.stencils(time, np.zeros(7, bool))
    value = 1.0 + 2.0 * time - 7.0 * time**2
    second = (stencil * np.stack([value[:-2], value[1:-1], value[2:]], 1)).sum(1)
    np.testing.assert_allclose(second, -14.0 / 900, rtol=1e-9)
    np.testing.assert_allclose(stencil.sum(1), 0, atol=1e-12)
    np.testing.assert_allclose(even(5), np.tile([1.0, -2.0, 1.0], (3, 1)), rtol=1e-9)


def test_duplicated_timestamps_stay_finite():
    time = np.arange(8) / 30
    time[4] = time[3]
    stencil = bundle.stencils(time, np.zeros(8, bool))
    assert np.isfinite(stencil).all() and np.abs(stencil).max() < 20


def test_no_stencil_reaches_across_a_cut():
    stencil = even(8, (4,))
    assert np.flatnonzero(~stencil.any(1)).tolist() == [2, 3]  # centred on frames 3 and 4


def test_cuts_are_jumps_of_pose_between_frames_with_a_face(model):
    truth = random_state(model, 12)
    assert not bundle.cuts(truth, np.ones(12, bool)).any()
    rotation, translation = truth.rotation.copy(), truth.translation.copy()
    rotation[5:] = rotation[5:] @ camera.exp_rotation(np.array([0, np.radians(20.0), 0]))
    translation[9:] += [0.07, 0, 0]
    jumped = replace(truth, rotation=rotation, translation=translation)
    assert np.flatnonzero(bundle.cuts(jumped, np.ones(12, bool))).tolist() == [5, 9]
    assert np.flatnonzero(bundle.cuts(jumped, np.arange(12) != 8)).tolist() == [5]
    assert not bundle.cuts(truth.frames(slice(0, 1)), np.ones(1, bool)).any()


def test_constant_velocity_costs_nothing_at_any_rate(model):
    time = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.05, 20))
    moving = replace(
        random_state(model, 20),
        rotation=camera.exp_rotation(time[:, None] * [0.3, -2.0, 0.5]) @ camera.exp_rotation(np.array([0.2, 0.9, 0.1])),
        translation=[0, 0, 0.6] + time[:, None] * [0.1, 0.0, 0.2],
        expression=0.2 + 0.5 * time[:, None] * np.ones(3),
        gaze=time[:, None] * np.ones(4),
        jaw=0.1 * time[:, None] * [1, 0, 0],
    )
    bend = bundle.acceleration(moving, bundle.stencils(time, np.zeros(20, bool)))
    assert bend.shape == (18, D) and np.abs(bend).max() < 1e-12
    stepped = replace(moving, translation=moving.translation + np.where(np.arange(20)[:, None] == 10, [0, 0, 0.01], 0))
    change = bundle.acceleration(stepped, even(20)) - bundle.acceleration(moving, even(20))
    np.testing.assert_allclose(change[7:12, 5], [0, 0.01, -0.02, 0.01, 0], atol=1e-9)


def pulled(model, targets, sigma_m=0.003):
    """A problem that knows no camera: some surface points are pulled to places in space."""
    surface, chosen = model.surface, np.arange(0, 470, 40)
    covector, point = np.tile(np.eye(3), (len(chosen), 1)) / sigma_m, np.repeat(chosen, 3)
    precision = np.diag(np.r_[np.zeros(6), np.ones(10)])

    def prior(pose):
        value = np.concatenate([np.zeros(6), pose.expression - 0.5, pose.gaze, pose.jaw])
        return 0.5 * float(value @ value), value, precision

    def problem_of(k, _):
        if targets[k] is None:
            return None

        def rows(at):
            residual = (at.points[chosen] - targets[k]).ravel() / sigma_m
            return Rows(0.5 * float(residual @ residual), residual, ((covector, point),))

        return Problem((Term(surface, rows),), prior, np.ones(D, bool))

    return problem_of, chosen


def shaken(model, frames=14, size=0.004, seed=1):
    """A smooth state, what its points look like with noise, and a start beside it."""
    truth = random_state(model, frames)
    random = np.random.default_rng(seed)
    chosen = np.arange(0, 470, 40)
    targets = [
        posed(model.surface, truth.pose(k)).points[chosen] + random.normal(0, size, (len(chosen), 3)) for k in range(frames)
    ]
    step = random.normal(0, 0.01, (frames, D)) * np.repeat([1, 0.3, 3], [3, 3, 10])
    return truth, targets, truth.with_poses([truth.pose(k).moved(step[k]) for k in range(frames)])


def test_cost_never_rises_and_ends_at_the_minimum(model):
    truth, targets, start = shaken(model, 3)
    problem_of, _ = pulled(model, targets)
    stencil = even(3)

    def cost(x):
        state = start.with_poses([start.pose(k).moved(x[k * D : k * D + D]) for k in range(3)])
        data = sum(problem_of(k, state).evaluate(state.pose(k))[0] for k in range(3))
        return data + huber(np.abs(bundle.acceleration(state, stencil)) / SMOOTH, bundle.ROBUST_SIGMAS)[0].sum()

    state, costs = bundle.smooth(problem_of, start, stencil, SMOOTH, 20)
    assert costs[0] == pytest.approx(cost(np.zeros(3 * D)))
    assert all(after < before for before, after in zip(costs, costs[1:], strict=False)) and len(costs) > 2
    scale = np.tile(SMOOTH, 3)
    best = minimize(lambda x: cost(x * scale), np.zeros(3 * D), method="BFGS", options={"maxiter": 40})
    assert costs[-1] < best.fun * 1.01


def test_a_sudden_move_is_not_smeared(model):
    """A turn of 12 degrees within one frame: a robust cost keeps it sharper than a quadratic one."""
    truth, _, _ = shaken(model, 16, 0.0)
    nod = np.where((np.arange(16) >= 8)[:, None], [np.radians(12.0), 0, 0], 0)
    truth = replace(truth, rotation=camera.exp_rotation(nod) @ truth.rotation)
    chosen = np.arange(0, 470, 40)
    problem_of, _ = pulled(model, [posed(model.surface, truth.pose(k)).points[chosen] for k in range(16)], 0.001)
    errors = []
    for robust in (bundle.ROBUST_SIGMAS, 1e9):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(bundle, "ROBUST_SIGMAS", robust)
            state, _ = bundle.smooth(problem_of, truth, even(16), SMOOTH, 8)
        errors.append(degrees_apart(state.rotation, truth.rotation)[6:10].max())
    assert errors[0] < 0.5 * errors[1]


def test_the_world_may_be_turned(model, monkeypatch):
    """Everything turned about the camera by any rotation: the same head motion comes out, turned (where no cost is robust)."""
    monkeypatch.setattr(bundle, "ROBUST_SIGMAS", 1e9)
    truth, targets, start = shaken(model)
    equal = SMOOTH.copy()
    equal[3:6] = 0.0005
    turn = camera.exp_rotation(np.array([0.7, -1.9, 1.1]))
    turned = replace(start, rotation=turn @ start.rotation, translation=start.translation @ turn.T)
    plain, costs = bundle.smooth(pulled(model, targets)[0], start, even(14), equal, 4)
    other, again = bundle.smooth(pulled(model, [t @ turn.T for t in targets])[0], turned, even(14), equal, 4)
    np.testing.assert_allclose(again, costs, rtol=1e-6)
    np.testing.assert_allclose(other.rotation, turn @ plain.rotation, atol=1e-6)
    np.testing.assert_allclose(other.translation, plain.translation @ turn.T, atol=1e-7)
    np.testing.assert_allclose(other.expression, plain.expression, atol=1e-5)


def test_frames_on_both_sides_of_a_cut_do_not_read_each_other(model):
    _, targets, start = shaken(model)
    spoiled = [t + (0.3 if k < 7 else 0.0) for k, t in enumerate(targets)]
    one, other = (bundle.smooth(pulled(model, t)[0], start, even(14, (7,)), SMOOTH, 1)[0] for t in (targets, spoiled))
    np.testing.assert_allclose(one.rotation[7:], other.rotation[7:], atol=1e-9)
    assert np.abs(one.translation[:7] - other.translation[:7]).max() > 0.05
    joined = bundle.smooth(pulled(model, spoiled)[0], start, even(14), SMOOTH, 1)[0]
    assert np.abs(joined.translation[7:] - one.translation[7:]).max() > 1e-3  # without the cut they do


def test_a_gap_is_carried_across(model):
    truth, targets, _ = shaken(model, 20, 0.0)
    held = np.arange(20)
    held[8:12] = 7
    start = truth.frames(held)
    missing = [None if 8 <= k < 12 else t for k, t in enumerate(targets)]
    state, _ = bundle.smooth(pulled(model, missing)[0], start, even(20), SMOOTH, 20)
    before, after = (degrees_apart(s.rotation, truth.rotation)[8:12].max() for s in (start, state))
    assert after < 0.15 * before
    assert np.linalg.norm(state.translation - truth.translation, axis=1)[8:12].max() < 0.001


def test_a_lost_tail_stays_finite(model):
    truth, targets, start = shaken(model, 12, 0.0)
    state, _ = bundle.smooth(pulled(model, targets[:6] + [None] * 6)[0], start, even(12), SMOOTH, 5)
    assert np.isfinite(state.rotation).all() and np.abs(state.translation - truth.translation).max() < 0.1


def test_two_frames_are_left_alone(model):
    _, targets, start = shaken(model, 2)
    state, costs = bundle.smooth(pulled(model, targets)[0], start, np.zeros((0, 3)), SMOOTH, 3)
    assert state is start and costs == []


def test_jitter_goes_and_the_truth_comes_nearer(model):
    """Tracking in blocks of 20 with noisy landmarks, then the bundle over all of them."""
    truth = random_state(model, 60)
    observed = detected(model, truth, 4.0)
    blocks = [track(model, observed, truth, np.arange(k, k + 20))[0] for k in (0, 20, 40)]
    rough = truth.with_poses([block.pose(k) for block in blocks for k in range(20)])
    made = tracker(model, observed, truth)
    calm, _ = bundle.smooth(lambda k, at: made.problem(k, at.pose(k).gaze), rough, even(60), SMOOTH, 3)
    before, after = (degrees_apart(s.rotation, truth.rotation)[2:-2] for s in (rough, calm))
    assert np.mean(after) < 0.8 * np.mean(before) and np.percentile(after, 95) < np.percentile(before, 95)
    depth = lambda s: np.abs(s.translation[2:-2, 2] - truth.translation[2:-2, 2]).mean()  # noqa: E731
    assert depth(calm) < depth(rough)
    error = [stages.reprojection_px(model, observed, np.arange(60), s).mean() for s in (rough, calm)]
    assert error[1] < 1.05 * error[0]  # not at the landmarks' expense


def test_lost_frames_of_a_tracked_clip_are_carried(model):
    truth = random_state(model, 40)
    observed = lose(detected(model, truth, 1.0), slice(20, 23))
    state, _ = track(model, observed, truth, np.arange(40))
    made = tracker(model, observed, truth)
    problem_of = lambda k, at: made.problem(k, at.pose(k).gaze) if observed.found[k] else None  # noqa: E731
    calm, _ = bundle.smooth(problem_of, state, even(40), SMOOTH, 5)
    held, carried = (degrees_apart(s.rotation, truth.rotation)[20:23].mean() for s in (state, calm))
    assert carried < 0.6 * held
