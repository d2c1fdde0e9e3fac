"""Hair as the photometric term sees it: its height from how it moves, and the pull that it has on a turned head."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from fitting import camera, hair, photometric, raster, settings, solver
from fitting.energy import Problem
from fitting.head_model import REGIONS
from fitting.pictures import FINEST, Pictures
from tests.landmarked import LENS, degrees_apart, landmarked_head, model_of, picture, random_state, texture

D, FRAMES = 16, 8
TRUE_M = 0.012
STEP_M = float(np.diff(hair.HEIGHTS_M).max())


@pytest.fixture(scope="module")
def made():
    """Rig (bald) and the truth of frames that nod and turn."""
    rig, model = model_of(landmarked_head())
    time = np.arange(FRAMES)
    turn = np.stack([0.25 + 0.15 * np.sin(time * 1.7), 0.35 * np.sin(time * 0.9), 0 * time], 1)
    return rig, replace(random_state(model, FRAMES, yaw=0.0), rotation=camera.exp_rotation(turn))


def grown(rig, height_m):
    """The rig with its scalp moved outward: what the camera sees of hair."""
    out, normal = copy.copy(rig), raster.vertex_normals(rig.template, rig.triangles)
    out.template = rig.template + height_m * normal * (rig.region == REGIONS.index("scalp"))[:, None]
    return out


def pictures_of(rig, truth, height_m, plain_face=False):
    """A bald rig's pictures of a head with hair of one height, appearance learned at the true poses."""
    colour = texture(rig)
    if plain_face:
        colour[rig.region != REGIONS.index("scalp")] = [165, 120, 100]
    made = [picture(grown(rig, height_m), truth, k, colour, (120, 120, 120), supersample=2) for k in range(FRAMES)]
    frames, alpha = (np.stack(part) for part in zip(*made, strict=True))
    pictures = Pictures(rig, frames, alpha, np.full(FRAMES, 75.0), settings.STRENGTH, 1000)
    pictures.learn(range(FRAMES), truth, LENS)
    return pictures


def heights_of(rig, pictures):
    """Found height [P] m of the samples that several keyframes show."""
    patch = pictures.patches[1]
    scalp = hair.choose_samples(rig, len(patch.samples.triangles))
    height = ((patch.samples.surface.base - scalp.surface.base) * scalp.surface.normal).sum(1)
    return height[np.isfinite(patch.appearance.albedo[FINEST])]


def test_lifted_along_the_normals(made):
    samples = hair.choose_samples(made[0], 50)
    each = np.linspace(0, 0.02, 50)
    for height in (0.013, each):
        moved = hair.lifted(samples, height).surface.base - samples.surface.base
        np.testing.assert_allclose(moved, np.broadcast_to(height, 50)[:, None] * samples.surface.normal, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), each, atol=1e-12)
    assert (moved * samples.surface.base).sum(1).min() >= 0  # outward
    assert (made[0].region[made[0].triangles[samples.triangles]] == REGIONS.index("scalp")).all()


def test_swept_is_each_height_in_turn(made):
    samples = hair.choose_samples(made[0], 30)
    base = hair.swept(made[0], samples).surface.base.reshape(len(hair.HEIGHTS_M), 30, 3)
    for height, one in zip(hair.HEIGHTS_M, base, strict=True):
        np.testing.assert_allclose(one, hair.lifted(samples, height).surface.base, atol=1e-15)


@pytest.mark.parametrize("height_m", [0.0, TRUE_M])
def test_the_height_of_the_hair_is_found(made, height_m):
    rig, truth = made
    found = heights_of(rig, pictures_of(rig, truth, height_m))
    assert len(found) > 100
    assert abs(np.median(found) - height_m) <= (STEP_M + 1e-9 if height_m else 1e-9), np.quantile(found, [0.1, 0.5, 0.9])


def test_samples_never_seen_keep_a_finite_height(made):
    samples, random = hair.choose_samples(made[0], 200), np.random.default_rng(0)
    values = random.uniform(0, 255, (6, len(hair.HEIGHTS_M) * 200))
    weights = np.tile(samples.surface.base[:, 0] > 0, len(hair.HEIGHTS_M)) * np.ones((6, 1))
    with np.errstate(all="raise"):
        for some in (weights, 0 * weights):
            moved = hair.settled(samples, values, some).surface.base - samples.surface.base
            assert np.isfinite(moved).all() and np.linalg.norm(moved, axis=1).max() <= hair.HEIGHTS_M[-1] + 1e-12
    assert not moved.any()


def test_a_head_without_a_scalp_has_skin_alone(made):
    rig, truth = copy.copy(made[0]), made[1]
    rig.region = np.zeros_like(rig.region)
    assert hair.choose_samples(rig, 100) is None
    assert len(pictures_of(rig, truth, 0.0).patches) == 1


def slow_disagreement(values, weights):
    """The same by loops."""
    keyframes, count = values.shape
    gain, albedo, robust = [1.0] * keyframes, [0.0] * count, weights.tolist()
    for _ in range(8):
        for p in range(count):
            below = sum(robust[k][p] * gain[k] ** 2 for k in range(keyframes))
            albedo[p] = sum(robust[k][p] * gain[k] * values[k, p] for k in range(keyframes)) / max(below, 1e-9)
        for k in range(keyframes):
            below = sum(robust[k][p] * albedo[p] ** 2 for p in range(count))
            gain[k] = sum(robust[k][p] * albedo[p] * values[k, p] for p in range(count)) / below if below else 1.0
        mean = sum(gain) / keyframes
        gain = [one / mean for one in gain]
        away = [[values[k, p] - albedo[p] * gain[k] for p in range(count)] for k in range(keyframes)]
        spread = 1.4826 * np.median([abs(away[k][p]) for k in range(keyframes) for p in range(count) if weights[k, p] > 0])
        limit = 2.5 * max(spread, 0.5)
        robust = [[weights[k, p] / (1 + (away[k][p] / limit) ** 2) for p in range(count)] for k in range(keyframes)]
    known = [p for p in range(count) if sum(weights[k, p] > 0.04 for k in range(keyframes)) >= 2]
    for k in range(keyframes):
        below = sum(weights[k, p] * albedo[p] ** 2 for p in known)
        gain[k] = sum(weights[k, p] * albedo[p] * values[k, p] for p in known) / max(below, 1e-9)
    out = [np.nan] * count
    for p in known:
        squares = sum(weights[k, p] * (values[k, p] - gain[k] * albedo[p]) ** 2 for k in range(keyframes))
        out[p] = squares / weights[:, p].sum()
    return np.array(out)


def seen_samples():
    """Values [K, P] and weights of samples under changing exposure; the last one changes its colour, three are seldom seen."""
    random = np.random.default_rng(3)
    gain, albedo = random.uniform(0.8, 1.2, 6), random.uniform(60, 180, 40)
    values, weights = gain[:, None] * albedo, random.uniform(0.1, 1, (6, 40))
    values[:, -1] += 40 * np.sin(2.0 * np.arange(6))
    weights[:, 0], weights[1:, 1], weights[2:, 2] = 0, 0, 0
    return values, weights, random.normal(0, 2, values.shape)


def test_disagreement_against_a_slow_twin():
    values, weights, noise = seen_samples()
    found = photometric.disagreement(values + noise, weights)
    np.testing.assert_allclose(found, slow_disagreement(values + noise, weights), rtol=1e-9)
    assert np.flatnonzero(np.isnan(found)).tolist() == [0, 1]
    clean = photometric.disagreement(values, weights)  # exposure alone is no disagreement
    assert clean[-1] > 300 and np.nanmax(clean[:-1]) < 10


def test_a_blind_keyframe_spoils_nothing():
    """One that sees none of the hair, and a clip whose picture ends below it."""
    values, weights, noise = seen_samples()
    blind = np.insert(values + noise, 2, 0, 0), np.insert(weights, 2, 0, 0)
    normals = np.random.default_rng(0).normal(size=(7, 40, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    with np.errstate(all="raise"):
        np.testing.assert_allclose(photometric.disagreement(*blind), photometric.disagreement(values + noise, weights), rtol=1e-6)
        learned = photometric.learn(np.stack([blind[0]] * 2), blind[1], normals)
        nothing = photometric.learn(np.zeros((2, 7, 40)), np.zeros((7, 40)), normals)
    assert np.isfinite(learned.albedo[:, 2:]).all() and np.isfinite(learned.light).all() and np.isfinite(learned.sigma).all()
    assert np.isnan(nothing.albedo).all() and not nothing.light.any() and np.isfinite(nothing.sigma).all()


def degrees_left(pictures, truth, k):
    """Angle from the truth of a head that landmarks hold (to half a degree) a degree off about x, after its pixels."""
    start = truth.pose(k).moved(np.eye(D)[0] * np.radians(1.0))
    free = np.arange(D) < 3

    def landmarks(pose):
        away = np.zeros(D)
        away[:3] = camera.log_rotation(pose.rotation @ start.rotation.T)
        stiff = free / np.radians(0.5) ** 2
        return 0.5 * (stiff * away**2).sum(), stiff * away, np.diag(stiff)

    look = pictures.look(k, start, truth.shape, LENS)
    pose = start
    for level in range(FINEST + 1):
        terms = tuple(pictures.photometric_terms(k, look, truth.shape, LENS, (level,)))
        pose = solver.solve_frame(Problem(terms, landmarks, free), pose, 10, tolerance=1e-6)[0]
    return float(degrees_apart(pose.rotation, truth.rotation[k]))


def test_hair_turns_the_head_back(made):
    """A plain face tells a nod badly; the hair above it tells it."""
    rig, truth = made
    pictures = pictures_of(rig, truth, TRUE_M, plain_face=True)
    both = [degrees_left(pictures, truth, k) for k in (1, 4)]
    pictures.patches = pictures.patches[:1]
    skin = [degrees_left(pictures, truth, k) for k in (1, 4)]
    assert max(both) < 0.4 and min(skin) > 2 * max(both), (both, skin)
