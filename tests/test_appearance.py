"""What the video's skin looks like: which samples are seen, and albedo and light from keyframes."""

from dataclasses import replace

import numpy as np
import pytest

from fitting import camera, photometric
from fitting.photometric import LEVELS, Level
from fitting.rig import Rig, Surface, posed
from tests.landmarked import LENS, SIZE, landmarked_head, model_of, random_state


@pytest.fixture(scope="module")
def made():
    """Rig and a frontal pose."""
    rig, model = model_of(landmarked_head())
    return rig, random_state(model, 1).pose(0)


def with_a_nose(rig: Rig) -> tuple[Surface, np.ndarray]:
    """The toy head with a small copy of itself in front of it."""
    points = np.concatenate([rig.template, 0.35 * rig.template + [0, 0, -0.16]])
    empty = lambda *size: np.zeros((len(points), 3, *size))  # noqa: E731
    joints = np.zeros((3, 3))
    surface = Surface(
        points,
        empty(4),
        empty(3),
        empty(),
        np.zeros((len(points), 3)),
        empty(0),
        joints,
        np.zeros((3, 3, 4)),
        np.zeros((3, 3, 3)),
    )
    return surface, np.concatenate([rig.triangles, rig.triangles + len(rig.template)])


def hidden_by(points: np.ndarray, mesh: np.ndarray, triangles: np.ndarray, slack: float) -> np.ndarray:
    """Whether the way from the camera to each point meets the mesh more than `slack` of it before the point."""
    first, second, third = (mesh[triangles[:, k]] for k in range(3))
    out = []
    for point in points:
        side, other = second - first, third - first
        across = np.cross(point, other)
        determinant = (side * across).sum(1)
        determinant = np.where(np.abs(determinant) < 1e-15, np.nan, determinant)
        u = (-first * across).sum(1) / determinant
        turned = np.cross(-first, side)
        v, t = (point * turned).sum(1) / determinant, (other * turned).sum(1) / determinant
        out.append(((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t * point[2] < point[2] - slack)).any())
    return np.array(out)


@pytest.mark.parametrize("yaw", [0.0, 0.25, -0.35])
def test_visibility_against_rays(made, yaw):
    """The far side of the head and what lies behind the nose are hidden; the rest is seen."""
    rig, pose = made
    surface, triangles = with_a_nose(rig)
    pose = replace(pose, rotation=camera.exp_rotation(np.array([0, yaw, 0])))
    random, mesh = np.random.default_rng(0), posed(surface, pose).points
    pixel = camera.project(mesh[triangles].mean(1), LENS.focal_px, LENS.centre_px)
    near = np.linalg.norm(pixel - pixel[len(rig.triangles) :].mean(0), axis=1) < 35  # about the nose
    chosen = np.concatenate(
        [random.integers(0, len(triangles), 400), random.choice(np.flatnonzero(near[: len(rig.triangles)]), 400)]
    )
    corners = mesh[triangles[chosen]]
    points = np.einsum("pk,pkd->pd", random.dirichlet([1, 1, 1], len(chosen)), corners)
    seen = photometric.visible(surface, triangles, pose, LENS, SIZE, points)
    deep, grazing = (hidden_by(points, mesh, triangles, slack) for slack in (0.012, 1e-4))
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    toward = (outward * -points).sum(1) > 0.2 * np.linalg.norm(outward, axis=1) * np.linalg.norm(points, axis=1)
    far = (points - mesh[: len(rig.template)].mean(0))[:, 2] > 0.03
    assert (deep & far).sum() > 40 and not seen[deep & far].any()
    assert (deep & toward).sum() > 15  # behind the nose, facing the camera: nothing else would leave them out
    assert seen[deep & toward].mean() < 0.3  # the buffer is coarse: a rim of about a pixel stays
    assert seen[~grazing].mean() > 0.94


def test_points_outside_the_picture_are_not_seen(made):
    rig, pose = made
    pose = replace(pose, translation=np.array([0.24, 0, 0.6]))
    points = posed(rig.vertices(), pose).points
    pixel = camera.project(points, LENS.focal_px, LENS.centre_px)
    seen = photometric.visible(rig.vertices(), rig.triangles, pose, LENS, SIZE, points)
    assert seen.any() and not seen[pixel[:, 0] > SIZE[1] + 1].any()


def test_harmonics_are_orthogonal_and_without_constant():
    k = np.arange(20000) + 0.5
    polar, around = np.arccos(1 - 2 * k / len(k)), np.pi * (1 + 5**0.5) * k
    normal = np.stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)], 1)
    value = photometric.harmonics(normal)
    gram = value.T @ value / len(k)
    assert np.abs(value.mean(0)).max() < 1e-3
    assert np.abs(gram - np.diag(np.diag(gram))).max() < 1e-3 and np.diag(gram).min() > 0.05


def row_level(row, columns):
    padded = np.pad(row.reshape(-1, columns), (0, 2))[..., None]
    return Level(np.repeat(padded, 3, -1).astype(np.float32), np.zeros(2, int))


def harmonics(normals):
    return np.stack([photometric.harmonics(normal) for normal in normals])


def learned(light, noise=0.5, seed=0, keyframes=12, count=1500, gains=True):
    """Appearance of a turning Lambert sphere, its truth: every sample lies on a pixel of its own."""
    random = np.random.default_rng(seed)
    normal = random.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    albedo = random.uniform(70, 180, count)
    turns = camera.exp_rotation(
        np.stack([0.3 * random.normal(size=keyframes), np.linspace(-0.8, 0.8, keyframes), np.zeros(keyframes)], 1)
    )
    normals = normal @ turns.swapaxes(1, 2)
    gain = random.uniform(0.9, 1.1, keyframes) if gains else np.ones(keyframes)
    gain /= gain.mean()
    value = gain[:, None] * albedo * (1 + harmonics(normals) @ light) + noise * random.normal(size=(keyframes, count))
    columns = 50
    pixels = np.stack([np.arange(count) % columns, np.arange(count) // columns], 1) + 0.5
    weight = np.where(-normals[..., 2] > 0.2, normals[..., 2] ** 2, 0.0)
    return [[row_level(row, columns)] * len(LEVELS) for row in value], np.tile(pixels, (keyframes, 1, 1)), weight, normals, albedo


def test_light_of_a_lambert_sphere_is_found():
    light = np.array([0.25, -0.12, -0.15, 0.05, 0.04, 0.02, -0.06, 0.03])
    pictures, pixels, weights, normals, albedo = learned(light)
    appearance = photometric.learn(pictures, pixels, weights, normals)
    shade, found = (1 + harmonics(normals) @ values for values in (light, appearance.light))
    seen = weights > 0
    assert np.corrcoef(found[seen], shade[seen])[0, 1] > 0.9 and appearance.explained > 0.9
    known = np.isfinite(appearance.albedo[-1])
    often = (weights > 0.04).sum(0)
    assert known[often >= 4].all() and not known[often < 2].any()
    for k in range(12):  # what the term reads: albedo times light, but for the frame's gain
        rows = seen[k] & known
        ratio = appearance.albedo[-1][rows] * found[k, rows] / (albedo[rows] * shade[k, rows])
        flat = appearance.albedo[-1][rows] / (albedo[rows] * shade[k, rows])
        assert ratio.std() / ratio.mean() < min(0.03, 0.4 * flat.std() / flat.mean())


def test_no_light_model_is_no_light():
    pictures, pixels, weights, normals, albedo = learned(np.zeros(8))
    plain = photometric.learn(pictures, pixels, weights, normals)
    assert not plain.light.any() and plain.explained < photometric.LEAST_EXPLAINED
    known = np.isfinite(plain.albedo[-1])
    np.testing.assert_allclose(plain.albedo[-1][known] / albedo[known], 1, atol=0.03)
    np.testing.assert_allclose(plain.sigma, 1.0, atol=0.3)
