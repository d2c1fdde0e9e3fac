"""The head model's forward pass against a slow joint-by-joint twin, its normalisation, and its file."""

import dataclasses

import numpy as np
import pytest
import torch

from fitting.camera import exp_rotation
from fitting.head_model import HeadModel, axis_angle_to_matrix
from tests.toy_head import toy_head

SUM = 3e-8  # m: the file keeps float32, whose skinning weights sum to 1 within 1e-7


def random_pose(head, frames=3, seed=0):
    g = torch.Generator().manual_seed(seed)
    draw = lambda *size: 0.3 * torch.randn(*size, generator=g, dtype=torch.float64)  # noqa: E731
    return {
        "shape": draw(len(head.shape_basis)),
        "expression": draw(frames, len(head.expression_basis)),
        "rotation": draw(frames, 3),
        "neck": draw(frames, 3),
        "jaw": draw(frames, 3),
        "eyes": draw(frames, 2, 3),
        "translation": draw(frames, 3),
    }


@pytest.fixture(scope="module")
def head(tmp_path_factory):
    """The toy head in float64, with weight on every joint and pose correctives."""
    g = torch.Generator().manual_seed(3)
    plain = toy_head()
    weights = torch.rand(plain.vertex_count, 5, generator=g)
    mixed = dataclasses.replace(
        plain,
        skinning_weights=weights / weights.sum(1, keepdim=True),
        pose_basis=1e-3 * torch.randn(36, plain.vertex_count, 3, generator=g),
    )
    path = tmp_path_factory.mktemp("head") / "toy.npz"
    mixed.save(path)
    return HeadModel.load(path, dtype=torch.float64)


def twin(head, p, t):
    """SMPL's equations, one vertex and one joint at a time."""
    matrix = lambda v: exp_rotation(v.numpy())  # noqa: E731
    own = [matrix(p[k][t]) for k in ("rotation", "neck", "jaw")] + [matrix(p["eyes"][t, e]) for e in (0, 1)]
    correctives = np.concatenate([(r - np.eye(3)).ravel() for r in own[1:]])
    shaped = head.template.numpy() + np.tensordot(p["shape"].numpy(), head.shape_basis.numpy(), 1)
    rest = head.joints.numpy() + np.tensordot(p["shape"].numpy(), head.joint_shape_basis.numpy(), 1)
    shaped = (
        shaped
        + np.tensordot(p["expression"][t].numpy(), head.expression_basis.numpy(), 1)
        + np.tensordot(correctives, head.pose_basis.numpy(), 1)
    )
    about = lambda r, j: np.vstack([np.c_[r, j - r @ j], [0, 0, 0, 1]])  # noqa: E731
    root = about(own[0], rest[0])
    neck = root @ about(own[1], rest[1])
    world = [root, neck, *(neck @ about(own[k], rest[k]) for k in (2, 3, 4))]
    out = np.zeros_like(shaped)
    for v, point in enumerate(shaped):
        for j in range(5):
            out[v] += head.skinning_weights.numpy()[v, j] * (world[j] @ [*point, 1])[:3]
    return out + p["translation"][t].numpy()


def test_forward_equals_twin(head):
    p = random_pose(head)
    ours = head.forward(**p)
    for t in range(3):
        np.testing.assert_allclose(ours[t].numpy(), twin(head, p, t), atol=SUM)


def test_normalised_vertices_ignore_translation_and_rotation(head):
    p = random_pose(head)
    matrix, offset = head.rigid(p["shape"], p["rotation"], p["neck"], p["translation"])
    back = torch.einsum("tji,tvj->tvi", matrix, head.forward(**p) - offset[:, None])
    np.testing.assert_allclose(
        back.numpy(), head.local(p["shape"], p["expression"], p["jaw"], p["eyes"], p["neck"]).numpy(), atol=1e-12
    )


def test_neck_pose_does_not_reach_what_hangs_from_the_neck():
    head = toy_head()  # no weight on the root
    pose = {k: v.float() for k, v in random_pose(head).items()}
    bent = head.local(pose["shape"], pose["expression"], pose["jaw"], pose["eyes"], pose["neck"])
    straight = head.local(pose["shape"], pose["expression"], pose["jaw"], pose["eyes"])
    np.testing.assert_allclose(bent.numpy(), straight.numpy(), atol=1e-6)


def test_neutral_is_the_shaped_template(head):
    shape = random_pose(head)["shape"]
    zero = torch.zeros(1, 3, dtype=torch.float64)
    np.testing.assert_allclose(head.local(shape, zero, zero)[0].numpy(), head.shaped(shape).numpy(), atol=SUM)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-7, np.pi])
def test_rotation_value_and_gradient(angle):
    vector = torch.tensor([0.6, -0.48, 0.64], dtype=torch.float64) * angle
    np.testing.assert_allclose(axis_angle_to_matrix(vector).numpy(), exp_rotation(vector.numpy()), atol=1e-12)
    assert torch.autograd.gradcheck(axis_angle_to_matrix, (vector.requires_grad_(),), atol=1e-6)


def test_a_file_that_is_no_head_model_is_named(tmp_path):
    path = tmp_path / "broken.npz"
    path.write_bytes(b"not a zip")
    with pytest.raises(ValueError, match=r"broken\.npz: not a baked head model"):
        HeadModel.load(path)


def test_unplaced_landmarks_are_nan():
    head = toy_head()
    assert head.landmarks(head.template).isnan().all()
