"""The head model's forward pass against a slow joint-by-joint twin, its normalisation, and its file.

The second half asks the same of both real models: the anny head and a FLAME-shaped one.
"""

import dataclasses

import numpy as np
import pytest
import torch

from fitting import flame
from fitting.camera import exp_rotation
from fitting.head_model import PARENTS, REGIONS, HeadModel, axis_angle_to_matrix
from tests import flame_file
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
        joint_expression_basis=1e-2 * torch.randn(3, 5, 3, generator=g),
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
    rest = rest + np.tensordot(p["expression"][t].numpy(), head.joint_expression_basis.numpy(), 1)
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
    matrix, offset = head.rigid(p["shape"], p["rotation"], p["neck"], p["translation"], p["expression"])
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


def test_rigid_without_expression_is_exact_where_expressions_leave_the_joints(head):
    still = dataclasses.replace(head, joint_expression_basis=None)
    p = random_pose(head)
    where = p["shape"], p["rotation"], p["neck"], p["translation"]
    for plain, full in zip(still.rigid(*where), still.rigid(*where, p["expression"]), strict=True):
        assert torch.equal(plain, full)
    assert (head.rigid(*where)[1] - head.rigid(*where, p["expression"])[1]).abs().max() > 1e-4


@pytest.mark.parametrize("name", [f.name for f in dataclasses.fields(HeadModel) if f.type == "Tensor"])
def test_digest_follows_what_gives_a_track_its_meaning(head, name):
    value = getattr(head, name)
    changed = dataclasses.replace(head, **{name: value + 1})
    assert (changed.content_digest() != head.content_digest()) == (name != "landmark_barycentric")


def test_digest_ignores_what_rounding_does_and_not_infinite_ranges(head):
    assert dataclasses.replace(head, template=head.template + 1e-9).content_digest() == head.content_digest()
    assert dataclasses.replace(head, expression_low=head.expression_low - torch.inf).content_digest() != head.content_digest()


def test_a_file_without_the_later_fields_still_loads(head, tmp_path):
    head.save(tmp_path / "new.npz")
    with np.load(tmp_path / "new.npz") as file:
        old = {name: file[name] for name in file.files if name not in ("joint_expression_basis", "source", "version")}
    np.savez(tmp_path / "old.npz", **old)
    loaded = HeadModel.load(tmp_path / "old.npz")
    assert loaded.source == "" and loaded.joint_expression_basis.shape == (3, 5, 3) and not loaded.joint_expression_basis.any()


# Both real models


@pytest.fixture(scope="module", params=["anny", "flame"])
def real(request, tmp_path_factory) -> HeadModel:
    """In float64: the sums below are to be exact."""
    path = tmp_path_factory.mktemp("real") / "head.npz"
    anny = flame_file.real_head()
    head = anny if request.param == "anny" else flame.bake(flame_file.checked(), 100, 50)
    head.save(path)
    return HeadModel.load(path, torch.float64)


def neutral(head, **changed):
    """Parameters of one neutral frame, with changes."""
    still = {"expression": (len(head.expression_names),), "rotation": (3,), "neck": (3,), "jaw": (3,), "eyes": (2, 3)}
    frame = {name: torch.zeros(1, *size, dtype=torch.float64) for name, size in still.items()}
    frame |= {"shape": torch.zeros(len(head.shape_basis), dtype=torch.float64), "translation": frame["rotation"]}
    return frame | changed


def vector(*values):
    return torch.tensor([values], dtype=torch.float64)


def open_mouth(head):
    """Parameters that open the mouth widely: by the jaw joint where it carries weight, by the action else."""
    if head.skinning_weights[:, 2].any():
        return neutral(head, jaw=vector(0.35, 0, 0))
    expression = torch.zeros(1, len(head.expression_names), dtype=torch.float64)
    expression[0, head.expression_names.index("jawOpen")] = 1
    return neutral(head, expression=expression)


def ball_of(head, joint):
    return (head.region == REGIONS.index("eyeballs")) & (head.skinning_weights[:, joint] > 0.5)


def test_real_neutral_pose_is_the_template(real):
    moved = real.forward(**neutral(real, translation=vector(0.1, -0.2, 0.9)))[0] - vector(0.1, -0.2, 0.9)
    assert (moved - real.template).abs().max() < SUM


def test_real_counts_and_ranges(real):
    assert real.triangles.max() < real.vertex_count and real.uv_triangles.max() < len(real.uvs)
    assert real.triangles.shape == real.uv_triangles.shape
    assert real.uvs.min() >= 0 and real.uvs.max() <= 1
    assert (real.expression_low < real.expression_high).all()
    assert len(real.expression_names) == len(real.expression_basis) == len(set(real.expression_names))
    assert (real.skinning_weights.sum(1) - 1).abs().max() < 1e-6
    assert real.joints.shape == (len(PARENTS), 3) and real.licence and real.source is not None
    present = {REGIONS[k] for k in real.region.unique().tolist()}
    assert {"face", "scalp", "ears", "neck", "eyeballs"} <= present


def test_real_head_is_a_face_in_our_axes(real):
    """The face looks along -z, y runs down, the origin lies inside, left and right are mirror images."""
    from scipy.spatial import cKDTree

    template = real.template.numpy()
    centre = {
        name: template[real.region.numpy() == REGIONS.index(name)].mean(0) for name in ("face", "scalp", "neck", "eyeballs")
    }
    assert centre["face"][2] < centre["scalp"][2] and centre["scalp"][1] < centre["eyeballs"][1] < centre["neck"][1]
    assert (template.min(0) < -0.05).all() and (template.max(0) > 0.05).all()
    distance = cKDTree(template).query(template * [-1, 1, 1])[0]
    assert np.percentile(distance, 90) < 1e-3
    corner = template[real.triangles.numpy()]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    scalp = (real.region.numpy() == REGIONS.index("scalp"))[real.triangles.numpy()].all(1)
    assert ((normal * corner.mean(1)).sum(1)[scalp] > 0).mean() > 0.99


def test_real_joints_lie_where_they_turn(real):
    for joint, side in ((3, 1), (4, -1)):
        ball = real.template[ball_of(real, joint)]
        assert real.joints[joint, 0] * side > 0.02
        assert (real.joints[joint] - ball.mean(0)).norm() < 2e-3
    assert real.joints[:3, 0].abs().max() < 2e-3
    assert real.joints[1, 1] > real.joints[3, 1] and real.joints[1, 2] > real.joints[3, 2]  # the neck: lower and further back
    shape = torch.zeros(len(real.shape_basis), dtype=torch.float64)
    shape[0] = 2
    moved = real.shaped(shape)[ball_of(real, 3)].mean(0) - real.template[ball_of(real, 3)].mean(0)
    assert (real.joints_of(shape)[3] - real.joints[3] - moved).norm() < 1e-3


@pytest.mark.parametrize(("eye", "joint"), [(0, 3), (1, 4)])
def test_real_eyes_turn_alone(real, eye, joint):
    """A positive turn about y moves the front of one eyeball, its pupil, to the subject's right (-x)."""
    eyes = torch.zeros(1, 2, 3, dtype=torch.float64)
    eyes[0, eye, 1] = 0.3
    moved = real.forward(**neutral(real, eyes=eyes))[0] - real.template
    ball = ball_of(real, joint)
    assert (real.template[ball, 0] > 0).all() == (joint == 3)
    pupil = torch.where(ball, real.template[:, 2], torch.inf).argmin()
    assert moved[pupil, 0] < -3e-3
    others = moved[~ball].norm(dim=1)
    assert others.max() < (1e-7 if not len(real.pose_basis) else 2e-3)  # correctives may follow


def test_real_jaw_moves_the_lower_face_only(real):
    moved = real.forward(**open_mouth(real))[0] - real.template
    chin = ((real.template[:, 0].abs() < 0.01) & (real.region == REGIONS.index("face"))) * real.template[:, 1]
    assert moved[chin.argmax(), 1] > 0.01  # down
    upper = (real.template[:, 1] < real.joints[3, 1]) & (real.region != REGIONS.index("ears"))
    assert moved[upper].norm(dim=1).max() < 2e-3
    assert moved[ball_of(real, 3) | ball_of(real, 4)].norm(dim=1).max() < 2e-3


def test_real_normalised_vertices_ignore_neck_and_root(real):
    """What hangs from the neck looks the same in the head's frame, wherever the body turns it; correctives of the neck aside."""
    plain = dataclasses.replace(real, pose_basis=real.pose_basis[:0])
    p = random_pose(plain)
    p["expression"] = p["expression"].abs().clamp(0, 1)
    matrix, offset = plain.rigid(p["shape"], p["rotation"], p["neck"], p["translation"], p["expression"])
    back = torch.einsum("tji,tvj->tvi", matrix, plain.forward(**p) - offset[:, None])
    hangs = plain.skinning_weights[:, 0] == 0
    straight = plain.local(p["shape"], p["expression"], p["jaw"], p["eyes"])
    assert hangs.float().mean() > 0.8
    assert (back - straight)[:, hangs].abs().max() < 1e-7


def test_real_gradients_are_finite_at_rest(real):
    p = {name: value.clone().requires_grad_() for name, value in neutral(real).items()}
    real.forward(**p)[:, ::50].square().sum().backward()
    assert all(value.grad.isfinite().all() for value in p.values())
    assert all(p[name].grad.any() for name in ("shape", "expression", "rotation", "neck", "eyes", "translation"))


def test_real_file_round_trip(real, tmp_path):
    real.save(tmp_path / "head.npz")
    loaded = HeadModel.load(tmp_path / "head.npz", torch.float64)
    for field in dataclasses.fields(HeadModel):
        first, second = getattr(real, field.name), getattr(loaded, field.name)
        if isinstance(first, torch.Tensor):  # an unknown spread is NaN
            assert first.shape == second.shape and torch.allclose(first, second, rtol=0, atol=0, equal_nan=True), field.name
        else:
            assert first == second, field.name
    assert loaded.content_digest() == real.content_digest()
