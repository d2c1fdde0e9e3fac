"""The photometric term: reading pictures, visibility, light, and the pull that it has on a shifted head."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from fitting import camera, energy, photometric, settings, solver
from fitting.energy import Problem, Term
from fitting.photometric import LEVELS, Level
from fitting.pictures import FINEST, Pictures
from fitting.rig import posed
from tests.landmarked import LENS, SIZE, differences, landmarked_head, model_of, picture, random_state, texture

D = 16


@pytest.fixture(scope="module")
def made():
    """Rig, truth of eight frames and their painted pictures."""
    rig, model = model_of(landmarked_head())
    truth = random_state(model, 8, yaw=0.0)
    turn = np.stack([0.1 * np.sin(np.arange(8)), 0.35 * np.sin(np.arange(8) * 0.9), 0 * np.arange(8)], 1)
    truth = replace(truth, rotation=camera.exp_rotation(turn))
    grey = (120, 120, 120)
    frames, alpha = (np.stack(v) for v in zip(*(picture(rig, truth, k, background=grey) for k in range(8)), strict=True))
    return rig, model, truth, frames, alpha


def pictures_of(rig, frames, alpha, samples=1200):
    return Pictures(rig, frames, alpha, np.full(len(frames), 75.0), settings.STRENGTH, samples)


def ramp(across=0.8, down=-0.5, start=120.0, size=SIZE, corner=(0, 0)):
    """A level whose grey value is a plane: bilinear reading and its slope are exact."""
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    plane = start + across * (x + corner[0]) + down * (y + corner[1])
    return Level(np.stack([plane, 0 * x + across, 0 * x + down], -1).astype(np.float32), np.array(corner))


def test_pyramid_gradients_are_differences_of_its_values():
    image = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    pixels = np.array([[0.0, 0.0], [80.0, 60.0]])
    levels = photometric.pyramid(image, pixels, 80.0, range(FINEST + 1))
    assert len(levels) == len(LEVELS)
    for level, blur in zip(levels, LEVELS, strict=True):
        value = level.values[..., 0]
        np.testing.assert_allclose(level.values[:, 1:-1, 1], (value[:, 2:] - value[:, :-2]) / 2, atol=1e-3)
        np.testing.assert_allclose(level.values[1:-1, :, 2], (value[2:] - value[:-2]) / 2, atol=1e-3)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float64)
        sigma = max(blur * 80.0, photometric.LEAST_BLUR_PX)
        near = np.exp(-0.5 * (np.arange(-12, 13) / sigma) ** 2)
        twin = (grey[18:43, 28:53] * np.outer(near, near)).sum() / near.sum() ** 2
        assert value[30, 40] == pytest.approx(twin, abs=0.5)


def test_a_part_of_the_picture_is_read_where_it_lies():
    """The pyramid cuts a part out: what is read does not depend on where the cut is, pixel centres are at +0.5."""
    y, x = np.mgrid[:200, :220] + 0.5
    image = np.repeat((20 + 0.6 * x + 0.3 * y)[..., None], 3, -1).round().astype(np.uint8)
    pixels = np.array([[100.0, 90.0], [140.3, 120.8], [120.5, 100.5]])
    level = photometric.pyramid(image, pixels, 60.0, [FINEST])[0]
    assert level.corner_px.min() > 0 and level.values.shape[0] < 100
    value, inside = photometric.read(level, pixels)
    assert inside.all()
    np.testing.assert_allclose(value[:, 0], 20 + 0.6 * pixels[:, 0] + 0.3 * pixels[:, 1], atol=0.25)
    np.testing.assert_allclose(value[:, 1:], np.tile([0.6, 0.3], (3, 1)), atol=0.05)
    assert not photometric.read(level, np.array([[5.0, 5.0]]))[1].any()


@pytest.mark.parametrize("pixels", [[[-90.0, -50.0], [-60.0, -20.0]], [[900.0, 900.0], [950.0, 990.0]], [[219.5, 100.0]]])
def test_a_face_outside_the_picture_gives_levels_that_nothing_is_read_from(pixels):
    image = np.zeros((200, 220, 3), np.uint8)
    for level in photometric.pyramid(image, np.array(pixels), 60.0, range(FINEST + 1)):
        assert np.isfinite(level.values).all()
        assert not photometric.read(level, np.array(pixels))[1].any()


def test_reading_against_a_slow_twin():
    random = np.random.default_rng(1)
    level = Level(random.normal(size=(7, 9, 3)).astype(np.float32), np.array([3, 2]))
    pixels = random.uniform(0, 14, (200, 2))
    value, inside = photometric.read(level, pixels)
    for p, (x, y) in enumerate(pixels - [3.5, 2.5]):
        c, r = int(np.floor(x)), int(np.floor(y))
        assert inside[p] == (c >= 0 and c + 1 <= 8 and r >= 0 and r + 1 <= 6)
        if inside[p]:
            corners = {(i, j): level.values[r + i, c + j] for i in (0, 1) for j in (0, 1)}
            weight = {(i, j): (y - r if i else 1 - y + r) * (x - c if j else 1 - x + c) for i in (0, 1) for j in (0, 1)}
            np.testing.assert_allclose(value[p], sum(weight[k] * corners[k] for k in corners), atol=1e-5)


def test_samples_are_skin_spread_by_area(made):
    rig = made[0]
    samples = photometric.choose_samples(rig, 3000)
    face = rig.region[rig.triangles[samples.triangles]]
    assert (face == 0).all()
    np.testing.assert_allclose(samples.barycentric.sum(1), 1)
    assert samples.barycentric.min() >= 0
    again = photometric.choose_samples(rig, 3000)
    np.testing.assert_array_equal(samples.triangles, again.triangles)
    front = (samples.surface.base[:, 2] < 0).mean()
    assert 0.6 < front < 0.75  # twice as dense at the front


def test_weights_fall_with_the_angle(made):
    rig, _, truth, *_ = made
    surface = photometric.choose_samples(rig, 200).surface
    pose = replace(truth.pose(0), rotation=np.eye(3), translation=np.array([0, 0, 0.6]))
    weight = photometric.weights_of(surface, pose, np.arange(200) != 7)
    cosine = -surface.normal[:, 2]
    np.testing.assert_allclose(weight, np.where((cosine > 0.2) & (np.arange(200) != 7), cosine**2, 0), atol=1e-12)


def problem_of(rows, surface, free=None):
    free = np.ones(D, bool) if free is None else free
    return Problem((Term(surface, rows),), lambda _: (0.0, np.zeros(D), np.zeros((D, D))), free)


@pytest.mark.parametrize("robust", [1e9, 1.5])
def test_gradient_against_differences(made, robust):
    """On a plane of grey values, where reading is exact; gain and offset are eliminated."""
    rig, _, truth, *_ = made
    random = np.random.default_rng(0)
    surface, level = photometric.choose_samples(rig, 300).surface, ramp()
    pose = truth.pose(1)
    value = photometric.read(level, camera.project(posed(surface, pose).points, LENS.focal_px, LENS.centre_px))[0][:, 0]
    colour = 0.7 * value + 20 + random.normal(0, 4, 300)
    weight = random.uniform(0, 1, 300)
    problem = problem_of(lambda at: photometric.photometric_rows(level, colour, weight, 3.0, 0.1, LENS, robust, at), surface)
    moved = pose.moved(random.normal(0, 0.005, D))
    cost, evaluated = problem.evaluate(moved)
    expected = differences(lambda p: problem.evaluate(p)[0], moved)
    tolerance = 1e-4 if robust > 10 else 0.05  # the robust gain is found by three steps only
    np.testing.assert_allclose(
        problem.gradient(moved, evaluated), expected, rtol=tolerance, atol=tolerance * np.abs(expected).max()
    )
    assert cost > 1


def test_a_head_that_turns_as_a_whole_is_told_less_than_lids_that_move(made):
    """With rigid=0 the term says nothing about pose; with 1 all; in between it is the weighted mean of both."""
    rig, _, truth, *_ = made
    random = np.random.default_rng(0)
    surface, level, pose = photometric.choose_samples(rig, 300).surface, ramp(), truth.pose(1)
    value = photometric.read(level, camera.project(posed(surface, pose).points, LENS.focal_px, LENS.centre_px))[0][:, 0]
    colour, weight = 0.7 * value + 20 + random.normal(0, 4, 300), random.uniform(0.1, 1, 300)
    told, moved = {}, pose.moved(random.normal(0, 0.005, D))
    for rigid in (0.0, 0.2, 1.0):
        rows = partial(photometric.photometric_rows, level, colour, weight, 3.0, 0.1, LENS, 1e9, rigid=rigid)
        problem = problem_of(rows, surface)
        cost, evaluated = problem.evaluate(moved)
        told[rigid] = cost, *problem.normal(moved, evaluated)
    assert np.abs(told[0.0][1][:6, :6]).max() < 1e-8 * np.abs(told[1.0][1][:6, :6]).max()
    for mixed, none, all_ in zip(told[0.2], told[0.0], told[1.0], strict=True):
        np.testing.assert_allclose(mixed, 0.8 * none + 0.2 * all_, atol=1e-6 * np.abs(all_).max())
    assert told[0.0][1][10, 10] > 0  # an expression is told


def test_with_part_of_the_rigid_motion_the_derivative_still_points_downhill(made):
    """It leaves out how that motion's columns change with the pose: near a minimum its direction is right, its length nearly."""
    rig, _, truth, *_ = made
    random = np.random.default_rng(0)
    y, x = np.mgrid[:240, :260] + 0.5
    wave = 120 + 30 * np.sin(x * 2 * np.pi / 45) * np.cos(y * 2 * np.pi / 60)
    level = Level(np.stack([wave, *np.gradient(wave)[::-1]], -1).astype(np.float32), np.zeros(2, int))
    surface, pose = photometric.choose_samples(rig, 300).surface, truth.pose(1)
    value = photometric.read(level, camera.project(posed(surface, pose).points, LENS.focal_px, LENS.centre_px))[0][:, 0]
    colour, weight = value + random.normal(0, 2, 300), random.uniform(0.1, 1, 300)
    rows = partial(photometric.photometric_rows, level, colour, weight, 3.0, 0.1, LENS, 1e9, rigid=0.3)
    problem, moved = problem_of(rows, surface), pose.moved(random.normal(0, 0.001, D))
    found, expected = problem.gradient(moved, problem.evaluate(moved)[1]), differences(lambda p: problem.evaluate(p)[0], moved)
    scale = np.sqrt(np.diag(problem.normal(moved, problem.evaluate(moved)[1])[0]))  # rad, m and codes are not comparable
    found, expected = found / scale, expected / scale
    assert found @ expected > 0.95 * np.linalg.norm(found) * np.linalg.norm(expected)
    assert 0.8 < np.linalg.norm(found) / np.linalg.norm(expected) < 1.25


def test_exposure_changes_nothing(made):
    """Gain and offset of a frame, or of the albedo: same rows, same minimum."""
    rig, _, truth, *_ = made
    random = np.random.default_rng(0)
    surface, level, at = photometric.choose_samples(rig, 300).surface, ramp(), None
    at = posed(surface, truth.pose(1))
    colour, weight = random.uniform(60, 200, 300), random.uniform(0.1, 1, 300)
    rows = lambda level, colour, sigma: energy.eliminated(  # noqa: E731
        photometric.photometric_rows(level, colour, weight, sigma, 0.1, LENS, 3.0, at)
    )
    plain = rows(level, colour, 20.0)
    other = rows(level, 1.7 * colour - 30, 20.0)
    brighter = Level(level.values * np.float32(1.4) + np.float32([25, 0, 0]), level.corner_px)
    exposed = rows(brighter, colour, 28.0)  # the noise is amplified too
    for changed in (other, exposed):
        assert changed.cost == pytest.approx(plain.cost, rel=1e-5)
        np.testing.assert_allclose(changed.residual, plain.residual, atol=1e-4)
        np.testing.assert_allclose(energy.row_jacobian(at, changed), energy.row_jacobian(at, plain), rtol=1e-3, atol=1e-4)


def test_unknown_and_hidden_samples_say_nothing(made):
    rig, _, truth, *_ = made
    random = np.random.default_rng(0)
    surface, level = photometric.choose_samples(rig, 300).surface, ramp()
    at = posed(surface, truth.pose(1))
    colour, weight = random.uniform(60, 200, 300), random.uniform(0.1, 1, 300)
    rows = lambda colour, weight: photometric.photometric_rows(level, colour, weight, 20.0, 0.1, LENS, 3.0, at)  # noqa: E731
    part = rows(np.where(np.arange(300) % 3, colour, np.nan), weight)
    assert len(part.residual) == 200 and np.isfinite(part.cost) and np.isfinite(part.residual).all()
    assert rows(colour, np.where(np.arange(300) % 3, weight, 0)).cost == pytest.approx(part.cost)
    few = rows(np.where(np.arange(300) < 49, colour, np.nan), weight)
    assert few.cost == 0 and not len(few.residual)
    cost, evaluated = problem_of(lambda _: few, surface).evaluate(truth.pose(1))
    assert cost == 0 and not problem_of(lambda _: few, surface).gradient(truth.pose(1), evaluated).any()


def test_robust_gain_leaves_outliers_out():
    random = np.random.default_rng(0)
    colour = random.uniform(60, 200, 500)
    value = 1.3 * colour - 12 + random.normal(0, 1, 500)
    value[:80] += 90
    fitted = photometric.robust_gain(np.stack([colour, np.ones(500)], 1), value, np.ones(500), 1.0, 3.0)
    assert np.abs(1.3 * colour - 12 - fitted[0] * colour - fitted[1]).max() < 3
    exact = photometric.robust_gain(np.stack([colour, np.ones(500)], 1), 2 * colour + 5, np.ones(500), 1.0, 3.0)
    np.testing.assert_allclose(exact, [2, 5], rtol=1e-3)


def shifted_pixels(rig, truth, pose, k):
    """Mean distance (px) of the seen vertices from where they belong."""
    whole = rig.vertices().folded(truth.shape)
    front = rig.template[:, 2] < -0.03
    first, second = (camera.project(posed(whole, p).points[front], LENS.focal_px, LENS.centre_px) for p in (pose, truth.pose(k)))
    return np.linalg.norm(first - second, axis=1).mean()


def pulled_back(pictures, truth, k, away, free):
    """A frame's pose after the photometric term alone, coarse level first."""
    pose = truth.pose(k).moved(away)
    for _ in range(2):
        look = pictures.look(k, pose, truth.shape, LENS)
        for level in range(FINEST + 1):
            terms = tuple(pictures.photometric_terms(k, look, truth.shape, LENS, (level,)))
            problem = Problem(terms, lambda _: (0.0, np.zeros(D), np.zeros((D, D))), free)
            pose = solver.solve_frame(problem, pose, 12, tolerance=1e-6)[0]
    return pose


def test_a_shifted_head_is_moved_back(made):
    """Two pixels and a degree and a half off; one frame left out of learning, so that the albedo comes from the others."""
    rig, _, truth, frames, alpha = made
    pictures = pictures_of(rig, frames, alpha)
    pictures.learn([0, 1, 2, 3, 5, 6, 7], truth.frames(np.array([0, 1, 2, 3, 5, 6, 7])), LENS)
    away = np.zeros(D)
    away[:6] = [0.0, 0.02, 0.01, 0.003, -0.002, 0.0]
    pose = pulled_back(pictures, truth, 4, away, np.arange(D) < 6)
    assert shifted_pixels(rig, truth, truth.pose(4).moved(away), 4) > 2
    assert shifted_pixels(rig, truth, pose, 4) < 0.2


def test_a_face_without_texture_pulls_next_to_nothing(made):
    rig, _, truth, frames, alpha = made
    away = np.zeros(D)
    away[3] = 0.002
    strength = []
    for paint in (texture(rig), np.tile([165.0, 120, 100], (len(rig.template), 1))):
        plain = np.stack([picture(rig, truth, k, paint, background=(165, 120, 100))[0] for k in range(4)])
        pictures = pictures_of(rig, plain, alpha[:4])
        pictures.learn(range(4), truth.frames(slice(0, 4)), LENS)
        pose = truth.pose(1).moved(away)
        look = pictures.look(1, pose, truth.shape, LENS)
        problem = Problem(
            tuple(pictures.photometric_terms(1, look, truth.shape, LENS, (FINEST,))),
            lambda _: (0.0, np.zeros(D), np.zeros((D, D))),
            np.ones(D, bool),
        )
        strength.append(np.abs(problem.gradient(pose, problem.evaluate(pose)[1])[3]))
    assert strength[1] < 0.01 * strength[0]
