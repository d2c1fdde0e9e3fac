"""Each term's Jacobian against differences of its residual; costs, priors, walls, elimination of nuisance unknowns."""

from dataclasses import replace

import numpy as np
import pytest

from fitting import camera, energy
from fitting.energy import Problem, Rows, Term
from fitting.rig import GAZE, JAW, POSE, posed
from tests.landmarked import (
    FOCAL_PX,
    LENS,
    WEIGHTS,
    detected,
    differences,
    landmarked_head,
    model_of,
    points_of,
    random_pose,
    random_state,
    statistical_head,
)

QUADRATIC = replace(WEIGHTS, robust_sigmas=1e9)  # with Huber the weights depend on the residual, and differences see that
E = slice(POSE, POSE + 3)
SIZE = POSE + 3 + GAZE + JAW


@pytest.fixture(scope="module")
def model():
    return model_of(landmarked_head())[1]


@pytest.fixture(scope="module")
def made(model):
    truth = random_state(model, 3)
    return truth, detected(model, truth, 2.0)


@pytest.fixture
def frozen(monkeypatch):
    """The weight by facing is held within a step, as the solver holds it."""
    pose = random_pose(3, 0, 0.1)
    value = energy.facing
    monkeypatch.setattr(energy, "facing", lambda normal, _: value(normal, pose))


def frame_of(model, made, row=1, **changes):
    truth, observed = made
    return truth.fold(model), replace(observed.frame(model, row), **changes), truth.pose(row)


def near(pose, seed=0, size=0.02):
    """A pose beside another one."""
    return pose.moved(np.random.default_rng(seed).normal(0, size, SIZE) * np.repeat([1, 0.3, 3], [3, 3, SIZE - 6]))


@pytest.mark.parametrize("name", ["landmark_rows", "eyelid_rows"])
@pytest.mark.parametrize("make", [landmarked_head, statistical_head])
def test_rows_jacobian_against_differences(make, name, frozen):
    model = model_of(make())[1]
    model = replace(model, surface=replace(model.surface, joint_expression_basis=np.zeros((3, 3, 3))))
    truth = random_state(model, 3)
    folded, frame, pose = frame_of(model, (truth, detected(model, truth, 2.0)))
    pose = near(pose)
    rows = lambda p: getattr(energy, name)(folded, frame, QUADRATIC, LENS, posed(folded.surface, p))  # noqa: E731
    at = posed(folded.surface, pose)
    ours = energy.row_jacobian(at, rows(pose))
    expected = differences(lambda p: rows(p).residual, pose)
    np.testing.assert_allclose(ours, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert rows(pose).cost == pytest.approx(0.5 * (rows(pose).residual ** 2).sum())


@pytest.mark.parametrize("robust", [1e9, 1.0])
def test_gradient_of_the_problem_against_differences_of_its_cost(model, made, frozen, robust):
    """Huber included: the gradient of the reweighted rows is the gradient of the robust cost."""
    folded, frame, pose = frame_of(model, made)
    weights, free = replace(WEIGHTS, robust_sigmas=robust), energy.free_unknowns(model)
    problem = energy.landmark_problem(folded, frame, weights, LENS, free)
    pose = near(pose)
    cost, evaluated = problem.evaluate(pose)
    hessian, gradient = problem.normal(pose, evaluated)
    expected = differences(lambda p: problem.evaluate(p)[0], pose)
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(problem.gradient(pose, evaluated), gradient, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-12)
    assert np.linalg.eigvalsh(hessian).min() > 0


def test_landmark_rows_against_a_slow_twin(model, made):
    folded, frame, pose = frame_of(model, made)
    hidden = np.random.default_rng(0).random(len(model.ids)) < 0.3
    frame = replace(frame, weight=np.where(hidden, 0.0, 1.0))
    at = posed(folded.surface, near(pose))
    total, residual = 0.0, []
    for k in np.flatnonzero(~hidden):
        x, y, z = at.points[k]
        away = np.array([FOCAL_PX * x / z + 128.0, FOCAL_PX * y / z + 120.0]) - frame.points[k]
        sigma = WEIGHTS.landmark_sigma * frame.scale_px * model.group_sigma[k] * WEIGHTS.correlated**0.5
        cosine = -(at.pose.rotation @ model.surface.normal[k]) @ at.pose.translation / np.linalg.norm(at.pose.translation)
        away = away * np.sqrt(np.clip((cosine + 0.1) / 0.4, 0.02, 1.0)) / sigma
        norm = np.linalg.norm(away)
        if norm > WEIGHTS.robust_sigmas:
            total += WEIGHTS.robust_sigmas * (norm - WEIGHTS.robust_sigmas / 2)
            residual.append(away * np.sqrt(WEIGHTS.robust_sigmas / norm))
        else:
            total += 0.5 * norm**2
            residual.append(away)
    rows = energy.landmark_rows(folded, frame, WEIGHTS, LENS, at)
    assert rows.cost == pytest.approx(total, rel=1e-12)
    np.testing.assert_allclose(rows.residual, np.ravel(residual), atol=1e-12)


def test_the_eyelid_term_sees_the_gap_alone(model, made):
    """All lid points moved together change nothing; the gap changed does."""
    truth, _ = made
    folded, frame, pose = frame_of(model, (truth, detected(model, truth, 0.0)))
    at = posed(folded.surface, pose)
    assert energy.eyelid_rows(folded, frame, WEIGHTS, LENS, at).cost < 1e-18
    shifted = replace(frame, points=frame.points + [3.0, -2.0])
    assert energy.eyelid_rows(folded, shifted, WEIGHTS, LENS, at).cost < 1e-18
    points = frame.points.copy()
    points[model.lids[0, 1, 0]] += [0.0, 0.02 * frame.scale_px]  # one standard deviation
    points[model.lids[1, 0, 0]] += [0.0, 9.0]
    hidden = replace(frame, points=points, weight=np.where(np.arange(len(model.ids)) == model.lids[1, 0, 0], 0.0, 1.0))
    facing = energy.facing(model.surface.normal[model.lids[0, 1, :1]], pose)[0]
    assert energy.eyelid_rows(folded, hidden, WEIGHTS, LENS, at).cost == pytest.approx(0.5 * facing, rel=1e-9)
    for open_eyes, tighter in (([0.0, 1.0], 1 / energy.SHUT_SIGMA), ([1.0, 0.0], 1.0), ([0.5, 1.0], 2 / (1 + energy.SHUT_SIGMA))):
        shut = replace(hidden, open_eyes=np.array(open_eyes))  # the left eye's gap is the one that is off
        cost = energy.eyelid_rows(folded, shut, WEIGHTS, LENS, at).cost
        assert cost == pytest.approx(0.5 * facing * tighter**2, rel=1e-9)


def test_huber_is_continuous_and_bounds_the_influence():
    cost, weight = energy.huber(np.array([2.999999, 3.000001, 300.0, 0.0]), 3.0)
    assert abs(cost[0] - cost[1]) < 1e-5
    assert weight[2] * 300 == pytest.approx(3.0) and weight[3] == 1.0 and cost[3] == 0.0
    assert cost[2] == pytest.approx(3 * 300 - 4.5)


def test_a_point_turned_away_counts_little(model):
    pose = random_state(model, 1).pose(0)
    front = energy.facing(np.array([[0, 0, -1.0], [0, 0, 1.0], [1.0, 0, 0]]), replace(pose, rotation=np.eye(3)))
    np.testing.assert_allclose(front, [1.0, 0.02, 0.25], atol=0.06)
    behind = energy.facing(model.surface.normal, replace(pose, rotation=np.diag([-1.0, 1.0, -1.0])))
    assert np.median(behind) == pytest.approx(0.02)


@pytest.mark.parametrize("make", [landmarked_head, statistical_head])
def test_prior_gradient_hessian_and_walls(make):
    model = model_of(make())[1]
    truth = random_state(model, 1)
    frame = detected(model, truth, 0.0).frame(model, 0)
    prior = energy.prior(model, frame, WEIGHTS)
    pose = replace(random_pose(3, 5), expression=np.array([-0.2, 0.4, 1.3]), jaw=np.array([-0.2, 0.1, 0.0]))
    cost, gradient, hessian = prior(pose)
    np.testing.assert_allclose(gradient, differences(lambda p: prior(p)[0], pose), rtol=1e-6, atol=1e-4)
    columns = differences(lambda p: prior(p)[1], pose)
    np.testing.assert_allclose(hessian, columns, rtol=1e-6, atol=1e-3)
    assert not gradient[:POSE].any() and not hessian[:POSE].any()
    inside = prior(replace(pose, expression=np.array([0.2, 0.4, 0.7])))[1]
    if np.isfinite(model.high).all():
        wall = 1 / WEIGHTS.action_wall_sd**2
        np.testing.assert_allclose(gradient[E] - inside[E], [-0.4 / 0.09 - 0.2 * wall, 0, 0.6 / 0.09 + 0.3 * wall], rtol=1e-9)
    else:
        np.testing.assert_allclose(gradient[E], pose.expression - 0.5, atol=1e-12)  # unit variance, no wall
    assert (
        cost
        > prior(replace(pose, jaw=np.array([0.0, 0.1, 0.0])))[0] + 0.5 * (0.2 - np.radians(3)) ** 2 / np.radians(0.5) ** 2 - 1
    )


def test_both_eyes_look_together_and_a_shut_one_stays(model):
    observed = detected(model, random_state(model, 1), 0.0)
    look = np.array([0.1, 0.2, 0.1, 0.2])
    frame = replace(observed.frame(model, 0, look), open_eyes=np.array([1.0, 0.05]))
    pose = replace(random_pose(3), gaze=look)
    start = POSE + 3
    gradient = energy.prior(model, frame, WEIGHTS)(pose)[1][start : start + 4]
    np.testing.assert_allclose(gradient[:2], look[:2] / WEIGHTS.gaze_sd_rad**2)  # open: straight ahead is likely
    np.testing.assert_allclose(gradient[2:], 0, atol=1e-9)  # shut: where it was
    squint = replace(pose, gaze=np.array([0.1, 0.3, 0.1, 0.2]))
    change = energy.prior(model, frame, WEIGHTS)(squint)[1][start : start + 4] - gradient
    vergence = 0.1 / WEIGHTS.vergence_sd_rad**2
    np.testing.assert_allclose(change, [0, vergence + 0.1 / WEIGHTS.gaze_sd_rad**2, 0, -vergence], rtol=1e-9, atol=1e-9)


def test_free_unknowns_and_what_held_ones_do(model, made):
    folded, frame, pose = frame_of(model, made)
    actions = np.array([True, False, True])
    free = energy.free_unknowns(model, actions=actions)
    assert free.tolist() == [True] * 6 + [True, False, True] + [True] * 7
    assert energy.free_unknowns(model, pose_only=True).sum() == POSE
    assert not energy.free_unknowns(replace(model, jaw_moves=False))[-JAW:].any()
    pose = near(pose)
    whole = energy.landmark_problem(folded, frame, WEIGHTS, LENS, np.ones(SIZE, bool))
    part = replace(whole, free=free)
    evaluated = whole.evaluate(pose)[1]
    (all_hessian, all_gradient), (hessian, gradient) = whole.normal(pose, evaluated), part.normal(pose, evaluated)
    np.testing.assert_array_equal(hessian[np.ix_(free, free)], all_hessian[np.ix_(free, free)])
    np.testing.assert_array_equal(gradient, np.where(free, all_gradient, 0))
    assert hessian[7, 7] == 1 and np.abs(hessian[7]).sum() == 1 and np.abs(hessian[:, 7]).sum() == 1
    np.testing.assert_allclose(part.gradient(pose, evaluated), gradient, atol=1e-9)


def nuisance_term(model, columns=2, seed=0, scale=1.0):
    """A term whose rows have unknowns of their own."""
    random = np.random.default_rng(seed)
    target, own = random.normal(0, 0.01, 40) + 0.5, random.normal(size=(40, columns)) * scale
    covector, point = random.normal(size=(40, 3)), random.integers(0, len(model.ids), 40)

    def rows(at):
        residual = np.einsum("mi,mi->m", covector, at.points[point]) - target
        return Rows(0.5 * float(residual @ residual), residual, ((covector, point),), own)

    return Term(model.surface, rows), own


def no_prior(_):
    return 0.0, np.zeros(SIZE), np.zeros((SIZE, SIZE))


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e4])
def test_elimination_equals_solving_all_together(model, scale):
    """The step and the cost are those of the dense problem with the nuisance unknowns among the unknowns."""
    term, own = nuisance_term(model, scale=scale)
    pose = random_pose(3, 1)
    free = np.zeros(SIZE, bool)
    free[:POSE] = True
    problem = Problem((term,), no_prior, free)
    cost, evaluated = problem.evaluate(pose)
    hessian, gradient = problem.normal(pose, evaluated)
    at = posed(model.surface, pose)
    plain = replace(term.rows(at), nuisance=None)
    dense = np.concatenate([energy.row_jacobian(at, plain)[:, :POSE], own], 1)
    expected = -np.linalg.lstsq(dense, plain.residual, rcond=None)[0]
    np.testing.assert_allclose(-np.linalg.solve(hessian, gradient)[:POSE], expected[:POSE], rtol=1e-6)
    amount = np.linalg.lstsq(own, plain.residual, rcond=None)[0]
    assert cost == pytest.approx(0.5 * ((plain.residual - own @ amount) ** 2).sum(), rel=1e-9)
    np.testing.assert_allclose(gradient, differences(lambda p: problem.evaluate(p)[0], pose) * free, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kept", [0.0, 0.3, 1.0])
def test_a_part_that_is_kept_is_a_weaker_term_beside_the_eliminated_one(model, kept):
    """Rows that keep a part k of a column's direction are k^2 of the plain term and 1 - k^2 of the one without that direction."""
    term, own = nuisance_term(model)
    pose = random_pose(3, 1)
    at = posed(model.surface, pose)
    plain, without = replace(term.rows(at), nuisance=None), energy.eliminated(term.rows(at))
    mixed = energy.eliminated(replace(term.rows(at), kept=np.full(own.shape[1], kept)))
    assert mixed.cost == pytest.approx(kept**2 * plain.cost + (1 - kept**2) * without.cost, rel=1e-12)

    def normal(rows):
        columns = energy.row_jacobian(at, rows)
        return np.concatenate([columns.T @ columns, (columns.T @ rows.residual)[:, None]], 1)

    np.testing.assert_allclose(normal(mixed), kept**2 * normal(plain) + (1 - kept**2) * normal(without), atol=1e-9)
    assert energy.eliminated(replace(term.rows(at), kept=np.array([0.0, kept]))).cost <= mixed.cost + 1e-12


def test_nuisance_columns_that_say_the_same_count_once(model):
    term, own = nuisance_term(model, 1)
    at = posed(model.surface, random_pose(3, 1))
    twice = replace(term.rows(at), nuisance=np.concatenate([own, 2 * own, 0 * own], 1))
    once, doubled = energy.eliminated(term.rows(at)), energy.eliminated(twice)
    np.testing.assert_allclose(doubled.residual, once.residual, atol=1e-12)
    assert doubled.cost == pytest.approx(once.cost) and doubled.nuisance.shape[1] == 1


def test_one_surface_is_posed_once(model, made, monkeypatch):
    folded, frame, pose = frame_of(model, made)
    calls, value = [], energy.posed
    monkeypatch.setattr(energy, "posed", lambda *given: calls.append(1) or value(*given))
    energy.landmark_problem(folded, frame, WEIGHTS, LENS, energy.free_unknowns(model)).evaluate(pose)
    assert len(calls) == 1


def test_a_hidden_landmark_says_nothing(model, made):
    truth, observed = made
    folded = truth.fold(model)
    points = observed.points.copy()
    points[1, ::3] += 500
    keep = np.arange(len(model.ids)) % 3 != 0
    rows = [
        energy.landmark_rows(folded, o.frame(model, 1, None, keep), WEIGHTS, LENS, posed(folded.surface, truth.pose(1)))
        for o in (observed, replace(observed, points=points))
    ]
    assert rows[0].cost == rows[1].cost and len(rows[0].residual) == 2 * keep.sum()
    np.testing.assert_allclose(camera.project(points_of(model, truth)[1], FOCAL_PX, LENS.centre_px), observed.points[1], atol=9)
