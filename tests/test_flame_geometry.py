"""What is made of a FLAME-shaped mesh by geometry: texture charts, regions, eyelids, the locked jaw, the mouth cavity."""

import pickle

import numpy as np
import pytest
import torch

from avatar.uv import UVMap, rasterise
from fitting import chart, eyelids, flame
from fitting.head_model import REGIONS, HeadModel
from tests import flame_file


@pytest.fixture(scope="module")
def head() -> HeadModel:
    return flame.bake(flame_file.checked(), 100, 50)


@pytest.fixture
def arrays() -> dict:
    return dict(flame_file.checked())


def test_own_charts_do_not_fold_and_reach_every_vertex(head):
    """All triangles run the same way and cover no texel twice; at 512 texels nearly every vertex has one of its own."""
    uvs, corners = head.uvs.numpy().astype(np.float64), head.uv_triangles.numpy()
    first, second = (uvs[corners[:, k]] - uvs[corners[:, 0]] for k in (1, 2))
    area = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / 2
    assert (area > 0).all()
    point = uvs[corners[::23]].mean(1)[:, None] - uvs[corners[:, 0]]  # [M, F, 2]
    along = (point[..., 0] * second[:, 1] - point[..., 1] * second[:, 0]) / (2 * area)
    beside = (first[:, 0] * point[..., 1] - first[:, 1] * point[..., 0]) / (2 * area)
    holding = (along >= 0) & (beside >= 0) & (along + beside <= 1)
    assert (holding.sum(1) == 1).all()
    part = chart.components(head.triangles.numpy(), 5023)
    solid = head.template.numpy()[head.triangles.numpy()]
    true_area = np.linalg.norm(np.cross(solid[:, 1] - solid[:, 0], solid[:, 2] - solid[:, 0]), axis=1) / 2
    skin = part[head.triangles.numpy()[:, 0]] == np.bincount(part).argmax()
    density = area[skin] / true_area[skin]
    assert np.percentile(density, 1) > 0.05 * np.median(density)
    triangle, _ = rasterise(uvs, corners, 512)
    assert len(np.unique(head.triangles.numpy()[triangle])) > 0.98 * 5023


def test_attributes_survive_the_charts(head):
    """Positions written to maps come back to the vertices within a texel's length."""
    maps = UVMap(head.uvs, head.uv_triangles, head.triangles, head.vertex_count, 256)
    back = maps.at_vertices(maps.to_map(head.template[None]))[0]
    away = (back - head.template).norm(dim=1)
    assert away.median() < 5e-4 and away.quantile(0.99) < 4e-3


def test_users_texture_in_any_order(tmp_path, arrays):
    """Triangles shuffled and turned in the file come back in the model's order; positions in the file are ignored."""
    random = np.random.default_rng(0)
    uvs, corners = chart.layout(arrays["v_template"] * flame.AXES, arrays["f"])
    order, turn = random.permutation(len(corners)), random.integers(0, 3, len(corners))
    lines = [f"v {k} 0 0" for k in range(5023)] + [f"vt {u:.9f} {v:.9f}" for u, v in uvs]
    for row, shift in zip(order, turn, strict=True):
        pairs = np.roll(np.stack([arrays["f"][row], corners[row]], 1) + 1, shift, 0)
        lines.append("f " + " ".join(f"{v}/{vt}" for v, vt in pairs))
    path = tmp_path / "head_template_mesh.obj"
    path.write_text("\n".join(lines))
    read_uvs, read_corners = flame.read_texture(path, arrays["f"])
    np.testing.assert_allclose(read_uvs[read_corners], uvs[corners], atol=1e-8)
    path.write_text("\n".join(lines[:-10]))
    with pytest.raises(ValueError, match=r"head_template_mesh\.obj: 10 of the model's 9976 triangles"):
        flame.read_texture(path, arrays["f"])


def test_regions_by_geometry_are_near_annys(head):
    mix, _ = flame_file._skin(flame_file.real_head())
    anny = flame_file.real_head().region.numpy()
    for name, least in (("face", 0.95), ("scalp", 0.7), ("ears", 0.7), ("neck", 0.9)):
        expected = mix @ (anny == REGIONS.index(name)).astype(float) > 0.5
        found = head.region.numpy()[:3931] == REGIONS.index(name)
        assert (expected & found).sum() / (expected | found).sum() > least, name
    assert torch.equal(head.region == REGIONS.index("eyeballs"), torch.arange(5023) >= 3931)


def test_users_masks_win(tmp_path, arrays):
    lists = {name: np.arange(k * 50, k * 50 + 50) for k, name in enumerate(flame.MASKS)}
    path = tmp_path / "FLAME_masks.pkl"
    path.write_bytes(pickle.dumps(lists, protocol=2))
    region = flame.bake(arrays, 10, 10, masks=flame.read_masks(path)).region.numpy()
    for name, ours in flame.MASKS.items():
        assert (region[lists[name]] == REGIONS.index(ours)).all()
    path.write_bytes(pickle.dumps({**lists, "scalp": np.array([5023])}))
    with pytest.raises(ValueError, match=r"FLAME_masks\.pkl: scalp: expected vertex numbers below 5023, found up to 5023"):
        flame.read_masks(path)


@pytest.mark.parametrize(("name", "eye"), [("eyelid_left", 0), ("eyelid_right", 1)])
def test_an_eyelid_closes_its_eye_and_nothing_else(head, name, eye):
    row = head.expression_names.index(name)
    assert (head.expression_low[row], head.expression_high[row]) == (0, 1)
    assert head.expression_names[-2:] == flame.EYELIDS and torch.isinf(head.expression_low[:-2]).all()
    moved, template = head.expression_basis[row].numpy().astype(np.float64), head.template.numpy().astype(np.float64)
    balls = [(head.skinning_weights[:, joint] > 0.5).numpy() for joint in (3, 4)]
    seen = lambda points, ball: eyelids.opening(points, head.triangles.numpy(), ball)[0].sum()  # noqa: E731
    before, half, after = (seen(template + share * moved, balls[eye]) for share in (0, 0.5, 1))
    assert before > 1000 and 0.25 * before < half < 0.75 * before and after < 0.06 * before
    assert seen(template + moved, balls[1 - eye]) == seen(template, balls[1 - eye])
    touched = np.linalg.norm(moved, axis=1) > 1e-6
    assert not touched[balls[0] | balls[1]].any()
    assert (template[touched, 0] > 0).all() == (eye == 0)
    assert np.linalg.norm(template[touched] - template[balls[eye]].mean(0), axis=1).max() < 0.035
    assert 0.004 < np.linalg.norm(moved, axis=1).max() < 0.015


def test_eyeballs_that_cannot_be_seen_are_an_error(head):
    balls = tuple((head.skinning_weights[:, joint] > 0.5).numpy() for joint in (3, 4))
    behind = head.template.numpy() + np.where(balls[0] | balls[1], 0.05, 0)[:, None] * [0, 0, 1]
    with pytest.raises(ValueError, match="no eye opening is seen from the front"):
        eyelids.eyelids(behind, head.triangles.numpy(), balls)


def test_jaw_can_be_locked(arrays):
    locked, free = flame.bake(arrays, 10, 10, jaw=False), flame.bake(arrays, 10, 10)
    assert not locked.skinning_weights[:, 2].any() and free.skinning_weights[:, 2].max() > 0.9
    assert (locked.skinning_weights.sum(1) - 1).abs().max() < 1e-6
    still = torch.zeros(1, 3)
    shape, expression = torch.randn(10), torch.randn(1, 12)
    np.testing.assert_allclose(locked.local(shape, expression, still), free.local(shape, expression, still), atol=1e-7)


def test_mouth_cavity_follows_the_lips(arrays):
    plain, head = flame.bake(arrays, 10, 10), flame.bake(arrays, 10, 10, cavity=True)
    cavity = head.region == REGIONS.index("mouth_cavity")
    assert cavity.sum() == 4 * 32 and torch.equal(head.template[:5023], plain.template)
    assert sorted(len(loop) for loop in chart.boundary_loops(head.triangles.numpy())) == [30, 32]  # neck, and the line at the end
    lips = min(chart.boundary_loops(plain.triangles.numpy()), key=lambda loop: plain.template[loop, 2].mean())
    innermost = head.template[-32:]
    assert (innermost[:, 2] - head.template[lips, 2]).mean() > 0.03
    np.testing.assert_allclose(innermost[:, 0], head.template[lips, 0], atol=1e-6)  # each straight behind its lip vertex
    straight = innermost - innermost.mean(0)
    assert torch.linalg.svdvals(straight)[1] < 1e-4  # a line
    shape, expression = torch.randn(10), torch.randn(1, 12)
    neutral, opened = (head.local(shape, expression, torch.tensor([[angle, 0.0, 0.0]]))[0] for angle in (0.0, 0.35))
    gap = lambda points: points[5023 : 5023 + 32, 1].max() - points[5023 : 5023 + 32, 1].min()  # noqa: E731
    assert gap(opened) > gap(neutral) + 0.01
    corner = opened[head.triangles[cavity[head.triangles].all(1)]]
    assert corner.isfinite().all() and head.uvs.max() <= 1
    assert (head.skinning_weights.sum(1) - 1).abs().max() < 1e-6
