"""The baked anny head: symmetric, one parameter a motion, landmarks where a face has them."""

import numpy as np
import pytest
import torch

from fitting import anny_head, correspondence
from fitting.head_model import REGIONS, HeadModel


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return anny_head.bake(20, 100)


def test_counts_and_names(head):
    assert len(head.shape_basis) == 20 and len(head.expression_names) == 43
    assert not any(name.startswith("eyeLook") or name == "tongueOut" for name in head.expression_names)
    assert head.triangles.max() < head.vertex_count and head.uv_triangles.max() < len(head.uvs)
    assert head.uvs.min() >= 0 and head.uvs.max() <= 1
    np.testing.assert_allclose(head.skinning_weights.sum(1).numpy(), 1, atol=1e-6)


def test_left_and_right_alike(head):
    """Every vertex has a mirror partner, in the template and in every identity component."""
    from scipy.spatial import cKDTree

    mirror = np.array([-1.0, 1, 1])
    for points in (head.template.numpy(), head.template.numpy() + 2 * head.shape_basis[0].numpy()):
        distance = cKDTree(points).query(points * mirror)[0]
        assert np.percentile(distance, 99) < 3e-4


def test_both_eyes_are_whole_and_turn_alone(head):
    ball = head.region == REGIONS.index("eyeballs")
    left = ball & (head.skinning_weights[:, 3] > 0.5)
    right = ball & (head.skinning_weights[:, 4] > 0.5)
    assert left.sum() == right.sum() == 72
    assert head.template[left, 0].min() > 0 > head.template[right, 0].max()
    eyes = torch.zeros(1, 2, 3)
    eyes[0, 0, 1] = 0.3
    shape = torch.zeros(20)
    moved = (head.local(shape, torch.zeros(1, 43), torch.zeros(1, 3), eyes)[0] - head.shaped(shape)).norm(dim=1)
    assert moved[left].max() > 1e-3 and moved[~left].max() < 1e-7
    assert head.expression_basis[:, ball].abs().max() == 0


def test_triangles_face_outwards(head):
    corner = head.template[head.triangles]
    normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    scalp = (head.region == REGIONS.index("scalp"))[head.triangles].all(1)
    assert ((normal * corner.mean(1)).sum(1)[scalp] > 0).float().mean() > 0.99


def test_every_region_but_teeth_is_there(head):
    present = {REGIONS[k] for k in head.region.unique().tolist()}
    assert present == set(REGIONS) - {"teeth"}  # anny's head topology has none


def test_baking_again_gives_the_same_model(head):
    assert anny_head.bake(20, 100).content_digest() == head.content_digest()


def test_a_detector_that_sees_nothing_is_an_error(head):
    with pytest.raises(ValueError, match="found the rendered head in 0 of 21 views"):
        correspondence.place(head, lambda image: None)


def test_placement_recovers_known_points(head):
    """A perfect detector: the projections of known surface points come back to where they were."""
    random = np.random.default_rng(0)
    triangles, template = head.triangles.numpy(), head.template.numpy().astype(np.float64)
    # a patch that faces the camera in all views: cheeks, nose, forehead
    middle = template[triangles].mean(1)
    front = np.flatnonzero(
        (head.region.numpy()[triangles] == REGIONS.index("face")).all(1) & (middle[:, 2] < -0.085) & (middle[:, 1] < 0.02)
    )
    chosen, weight = random.choice(front, 478), random.dirichlet([1, 1, 1], 478)
    views = iter([(yaw, pitch) for yaw in correspondence.YAWS_RAD for pitch in correspondence.PITCHES_RAD])
    expression = torch.zeros(1, 43)
    expression[0, head.expression_names.index("jawOpen")] = correspondence.MOUTH_OPEN["jawOpen"]
    posed = head.local(torch.zeros(20), expression, torch.zeros(1, 3))[0].numpy().astype(np.float64)

    def detect(image):
        yaw, pitch = next(views)
        turn = anny_rotation(pitch, yaw)
        point = (posed[triangles[chosen]] * weight[..., None]).sum(1) @ turn.T + [0, 0.01, correspondence.DISTANCE_M]
        pixel = correspondence.FOCAL_PX * point[:, :2] / point[:, 2:] + correspondence.SIZE_PX / 2
        return np.concatenate([pixel, point[:, 2:]], 1)

    placed = correspondence.place(head, detect)
    found = np.flatnonzero(placed.triangles[:468] >= 0)
    assert len(found) > 400
    truth = (template[triangles[chosen]] * weight[..., None]).sum(1)[found]
    ours = (template[triangles[placed.triangles[found]]] * placed.barycentric[found][..., None]).sum(1)
    assert np.median(np.linalg.norm(ours - truth, axis=1)) < 2e-4


def anny_rotation(pitch, yaw):
    from fitting.camera import exp_rotation

    return exp_rotation(np.array([pitch, 0.0, 0.0])) @ exp_rotation(np.array([0.0, yaw, 0.0]))
