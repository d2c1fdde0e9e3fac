"""The fit's small linear model against the head model, its derivatives against differences."""

import dataclasses
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from fitting import camera, flame
from fitting.head_model import HeadModel
from fitting.rig import POSE, Pose, Rig, jacobian, posed, shape_columns
from tests import flame_file
from tests.landmarked import all_columns, differences, landmarked_head, model_of, random_pose, statistical_head

ANNY = Path(__file__).parents[1] / "resources" / "heads" / "anny.npz"


def doubled(head: HeadModel) -> HeadModel:
    """The head model in float64, its float32 weights made to sum to 1 there too (the neck joint takes the rest)."""
    values = {item.name: getattr(head, item.name) for item in dataclasses.fields(head)}
    real = {name: value.double() for name, value in values.items() if torch.is_tensor(value) and value.is_floating_point()}
    real["skinning_weights"][:, 1] += 1 - real["skinning_weights"].sum(1)
    return HeadModel(**(values | real))


def twin(head: HeadModel, pose: Pose, shape: np.ndarray) -> np.ndarray:
    """The head model's own posing, about the origin as the rig turns (the head model turns about its root joint)."""
    head = doubled(head)
    row = lambda values: torch.from_numpy(np.asarray(values, np.float64))[None]  # noqa: E731
    shape = torch.from_numpy(shape)
    root = head.joints_of(shape, row(pose.expression))[0, 0].numpy()
    translation = pose.translation + pose.rotation @ root - root
    vector, zero = camera.log_rotation(pose.rotation), np.zeros(3)
    return head.forward(
        shape, row(pose.expression), row(vector), row(zero), row(pose.jaw), row(pose.vectors[1:]), row(translation)
    )[0].numpy()


def the_flame_head() -> HeadModel:
    return flame.bake(flame_file.checked(), 20, 12)


@pytest.mark.parametrize("make", [landmarked_head, statistical_head, the_flame_head, lambda: HeadModel.load(ANNY)])
def test_posed_equals_the_head_model(make):
    if make.__name__ == "<lambda>" and not ANNY.exists():
        pytest.skip("anny is not baked")
    head = make()
    rig, random = Rig(head), np.random.default_rng(5)
    shape, pose = random.normal(size=len(head.shape_basis)), random_pose(len(head.expression_basis), 2)
    ours = posed(rig.vertices().folded(shape), pose)
    np.testing.assert_allclose(ours.points, twin(head, pose, shape), atol=1e-12)
    np.testing.assert_allclose(ours.head @ pose.rotation.T + pose.translation, ours.points, atol=1e-14)


def test_a_joint_at_rest_changes_nothing():
    rig = Rig(statistical_head())
    pose = replace(random_pose(3), gaze=np.zeros(4), jaw=np.zeros(3))
    expected = rig.template + rig.expression_basis @ pose.expression
    np.testing.assert_allclose(posed(rig.vertices(), pose).head, expected, atol=1e-15)


def test_surface_points_are_mixtures_of_vertices():
    rig = Rig(landmarked_head())
    random = np.random.default_rng(0)
    triangles, weights = random.integers(0, len(rig.triangles), 30), random.dirichlet([1, 1, 1], 30)
    surface, pose = rig.surface(triangles, weights), replace(random_pose(3), jaw=np.zeros(3), gaze=np.zeros(4))
    corners = posed(rig.vertices(), pose).points[rig.triangles[triangles]]
    np.testing.assert_allclose(posed(surface, pose).points, np.einsum("pk,pkd->pd", weights, corners), atol=1e-14)
    first, second, third = rig.template[rig.triangles[triangles]].swapaxes(0, 1)
    outward = np.cross(second - first, third - first)
    np.testing.assert_allclose(surface.normal, outward / np.linalg.norm(outward, axis=1, keepdims=True), atol=1e-14)
    assert (np.einsum("pi,pi->p", surface.normal, surface.base) > 0).all()


@pytest.mark.parametrize(("make", "points"), [(landmarked_head, 60), (statistical_head, 60), (the_flame_head, 200)])
@pytest.mark.parametrize("spread", [0.0, 0.3, 1.2])
def test_jacobian_against_differences(make, points, spread):
    head = make()
    rig = Rig(head)
    random = np.random.default_rng(1)
    rig.joint_expression_basis = np.zeros_like(rig.joint_expression_basis)  # left out of the Jacobian on purpose
    surface = rig.surface(random.integers(0, len(rig.triangles), points), random.dirichlet([1, 1, 1], points))
    surface = surface.folded(random.normal(size=len(head.shape_basis)), 0.001 * random.normal(size=(points, 3)))
    pose = random_pose(len(head.expression_basis), 3, spread)
    if not spread:  # joints exactly at rest: the series of the left Jacobian
        pose = replace(pose, gaze=np.zeros(4), jaw=np.zeros(3))
    at = posed(surface, pose)
    expected = differences(lambda p: posed(surface, p).points, pose, 1e-5).reshape(3 * points, -1)
    ours = jacobian(at, *all_columns(at))
    np.testing.assert_allclose(ours, expected, rtol=1e-6, atol=1e-9)
    assert np.abs(ours).max(0).min() > (1e-6 if make is not landmarked_head else 0) - 1e-12  # each unknown moves something


def sliding(head, points=60):
    """Points that wander with the view, as detected landmarks do."""
    rig, random = Rig(head), np.random.default_rng(7)
    rig.joint_expression_basis = np.zeros_like(rig.joint_expression_basis)
    surface = rig.surface(random.integers(0, len(rig.triangles), points), random.dirichlet([1, 1, 1], points))
    return replace(surface, view_basis=0.02 * random.normal(size=(points, 3, 2)))


def test_points_slide_with_the_view():
    surface, pose = sliding(statistical_head()), random_pose(3, 3)
    plain = posed(replace(surface, view_basis=None), pose)
    camera_in_head = pose.rotation.T @ -pose.translation
    view = (camera_in_head / np.linalg.norm(camera_in_head))[:2]
    np.testing.assert_allclose(posed(surface, pose).head, plain.head + surface.view_basis @ view, atol=1e-14)


@pytest.mark.parametrize("make", [landmarked_head, statistical_head])
def test_jacobian_of_sliding_points_against_differences(make):
    surface, pose = sliding(make()), random_pose(3, 3)
    at = posed(surface, pose)
    expected = differences(lambda p: posed(surface, p).points, pose, 1e-5).reshape(180, -1)
    np.testing.assert_allclose(jacobian(at, *all_columns(at)), expected, rtol=1e-6, atol=1e-9)
    unfolded = surface
    ours = shape_columns(at, unfolded, *all_columns(at))
    for unknown in range(4):
        step = 1e-5 * np.eye(4)[unknown]
        ahead, behind = (posed(unfolded.folded(sign * step), pose).points for sign in (1, -1))
        np.testing.assert_allclose(ours[:, unknown], ((ahead - behind) / 2e-5).ravel(), rtol=1e-6, atol=1e-9)


def test_what_the_jacobian_leaves_out_is_small():
    head = statistical_head()
    rig = Rig(head)
    surface = rig.surface(np.arange(40), np.full((40, 3), 1 / 3))
    pose = random_pose(3, 3)
    at = posed(surface, pose)
    exact = differences(lambda p: posed(surface, p).points, pose, 1e-5).reshape(120, -1)
    away = np.abs(jacobian(at, *all_columns(at)) - exact)
    columns = np.zeros(exact.shape[1], bool)
    columns[POSE : POSE + 3] = True
    assert away[:, ~columns].max() < 1e-8  # everything but the expression is exact
    assert 0 < away[:, columns].max() < 1e-3  # the joint's own movement times the turn


@pytest.mark.parametrize("make", [landmarked_head, statistical_head])
def test_shape_columns_against_differences(make):
    head = make()
    rig, random = Rig(head), np.random.default_rng(1)
    unfolded = rig.surface(random.integers(0, len(rig.triangles), 50), random.dirichlet([1, 1, 1], 50))
    shape, pose = random.normal(size=len(head.shape_basis)), random_pose(3, 8)
    at = posed(unfolded.folded(shape), pose)
    ours = shape_columns(at, unfolded, *all_columns(at))
    for unknown in range(len(shape)):
        step = 1e-5 * np.eye(len(shape))[unknown]
        ahead, behind = (posed(unfolded.folded(shape + sign * step), pose).points for sign in (1, -1))
        np.testing.assert_allclose(ours[:, unknown], ((ahead - behind) / 2e-5).ravel(), rtol=1e-6, atol=1e-9)


def test_covectors_pick_points_in_any_order():
    """A row reads the point that it names, whatever the order and however often."""
    surface = Rig(statistical_head()).surface(np.arange(20), np.full((20, 3), 1 / 3))
    at = posed(surface, random_pose(3, 4))
    full = jacobian(at, *all_columns(at)).reshape(20, 3, -1)
    point = np.array([7, 7, 0, 19, 3])
    covector = np.random.default_rng(0).normal(size=(5, 3))
    expected = np.einsum("mi,mid->md", covector, full[point])
    np.testing.assert_allclose(jacobian(at, covector, point), expected, atol=1e-13)
    assert jacobian(at, np.zeros((0, 3)), np.zeros(0, int)).shape == (0, full.shape[2])


def test_gaze_turns_only_its_own_pupil():
    _, model = model_of(landmarked_head())
    still = replace(random_pose(3), gaze=np.zeros(4))
    for column, pupil, other in ((1, 0, 1), (3, 1, 0)):
        turned = replace(still, gaze=0.2 * np.eye(4)[column])
        moved = posed(model.surface, turned).head - posed(model.surface, still).head
        assert moved[model.pupil[pupil], 0] < -0.003  # positive yaw about +y (down) takes a point at -z towards -x
        assert np.abs(moved[model.pupil[other]]).max() == 0


def test_bias_and_shape_fold_into_the_base():
    surface = Rig(statistical_head()).surface(np.arange(10), np.full((10, 3), 1 / 3))
    shape, bias = np.arange(4.0), np.full((10, 3), 0.01)
    folded = surface.folded(shape, bias)
    np.testing.assert_allclose(folded.base, surface.base + surface.shape_basis @ shape + bias)
    np.testing.assert_allclose(folded.joints, surface.joints + surface.joint_shape_basis @ shape)
    np.testing.assert_array_equal(surface.folded(0 * shape).base, surface.base)
