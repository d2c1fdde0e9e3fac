"""Hard cases of what surrounds one point: the pole of the weights, triangles without area and UV seams.

Each has a twin in float64 without the difficulty, and where it is cheap the naive formula that fails stands beside it.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional
from toy_head import RADII_M, toy_head

from avatar import shell
from avatar.field import HEAD_SIZE_M, NEAREST_M, Field, inverse_distance_weights
from avatar.networks import positional_encoding
from avatar.uv import UVMap, rasterise
from fitting.raster import vertex_normals

DIRECTION = functional.normalize(torch.tensor([[0.3, -0.5, 0.8]], dtype=torch.float64), dim=1)


def naive_weights(offsets: Tensor) -> Tensor:
    inverse = 1 / offsets.norm(dim=-1)
    return inverse / inverse.sum(-1, keepdim=True)


def twin_weights(offsets: Tensor) -> Tensor:
    """Equation 1 without its pole, one point's offsets [K, 3]: both sides times all distances; on vertices, their share."""
    distance = [offset.norm() for offset in offsets]
    here = [float(d.detach()) == 0 for d in distance]
    if any(here):
        return torch.tensor(here, dtype=offsets.dtype) / sum(here)
    products = [torch.stack(distance[:j] + distance[j + 1 :]).prod() for j in range(len(distance))]
    return torch.stack(products) / sum(products)


def twin(field: Field, point: Tensor, vertices: Tensor, features: Tensor) -> Tensor:
    """Density and colour [4] of a float64 field at one point [3] that reads all of its K vertices [K, 3]."""
    first = torch.cat([field.from_offset.weight, field.from_feature.weight], 1)
    mixed = 0
    for weight, vertex, feature in zip(twin_weights(vertices - point), vertices, features, strict=True):
        row = torch.cat([positional_encoding((vertex - point) / HEAD_SIZE_M, field.bands), feature])
        hidden = torch.relu(first @ row + field.from_feature.bias)
        for layer in field.mlp0.layers:
            hidden = torch.relu(layer.weight @ hidden + layer.bias)
        mixed = mixed + weight * hidden
    for layer in field.mlp1.layers:
        mixed = torch.relu(layer.weight @ mixed + layer.bias)
    row = torch.cat([mixed, positional_encoding(DIRECTION[0], field.view_bands)])
    shade = torch.relu(field.mlp2.layers[0].weight @ row + field.mlp2.layers[0].bias)
    return torch.cat([functional.softplus(field.density(mixed)) / 0.003, torch.sigmoid(field.colour(shade))])


def small_field() -> Field:
    torch.manual_seed(1)
    return Field(channels=5, width=24, depth=3, colour_width=12, neighbours=4, bands=6, view_bands=2).double()


def near_a_vertex(gap_m: float) -> tuple[Tensor, Tensor, Tensor]:
    """Point [3], its vertices [4, 3] and features [4, 5]: values that float32 holds exactly, given as float64."""
    torch.manual_seed(2)
    vertices = torch.tensor([[0.05, -0.03, 0.07]]) + torch.tensor([[0, 0, 0], [0.004, 0, 0], [0, 0.005, 0], [0, 0.001, -0.006]])
    point = vertices[0] + functional.normalize(torch.tensor([1.0, 2.0, -1.0]), dim=0) * gap_m
    return point.double(), vertices.double(), torch.randn(4, 5).double()


def compared(field: Field, point: Tensor, vertices: Tensor, features: Tensor, dtype: torch.dtype) -> list[tuple[Tensor, Tensor]]:
    """(fast, twin) pairs in float64: value, gradient by point, gradient by features, gradients by every parameter."""
    mix = torch.tensor([0.001, 1.0, -2.0, 0.5], dtype=torch.float64)
    exact = [point.clone().requires_grad_(), features.clone().requires_grad_()]
    expected = twin(field, exact[0], vertices, exact[1])
    right = torch.autograd.grad((expected * mix).sum(), [*exact, *field.parameters()], allow_unused=True)
    copy = small_field().to(dtype)
    copy.load_state_dict(field.state_dict())
    given = [point.to(dtype).requires_grad_(), features.to(dtype).requires_grad_()]
    terms = copy.vertex_terms(given[1], dtype)
    density, colour = copy(given[0][None], DIRECTION.to(dtype), vertices.to(dtype), torch.arange(4)[None], terms, dtype)
    found = torch.cat([density, colour[0]])
    left = torch.autograd.grad((found * mix.to(dtype)).sum(), [*given, *copy.parameters()])
    pairs = [(found.detach().double(), expected.detach())]
    return pairs + [(a.double(), torch.zeros_like(a).double() if b is None else b) for a, b in zip(left, right, strict=True)]


def apart(pair: tuple[Tensor, Tensor]) -> float:
    """Largest difference over the largest value."""
    return float((pair[0] - pair[1]).abs().max() / pair[1].abs().max().clamp_min(1e-12))


@pytest.mark.parametrize("dtype, bound", [(torch.float64, 1e-6), (torch.float32, 3e-3)])
@pytest.mark.parametrize("gap_m", [1e-7, 1e-6, 1e-4])
def test_field_near_a_vertex_equals_its_twin_with_gradients(gap_m: float, dtype: torch.dtype, bound: float) -> None:
    pairs = compared(small_field(), *near_a_vertex(gap_m), dtype)
    assert pairs[1][1].norm() > 1  # the twin's gradient by the point does not vanish towards the vertex
    assert max(apart(pair) for pair in pairs) < bound


@pytest.mark.parametrize("dtype, bound", [(torch.float64, 1e-4), (torch.float32, 3e-4)])
def test_field_on_a_vertex_is_the_limit(dtype: torch.dtype, bound: float) -> None:
    """Value, and gradients by features and parameters; by the point the limit is another one from each side, so 0 stands."""
    field, (point, vertices, features) = small_field(), near_a_vertex(0.0)
    value, by_point, *others = compared(field, point, vertices, features, dtype)
    assert max(apart(pair) for pair in (value, *others)) < bound
    assert torch.isfinite(by_point[0]).all()
    beside = compared(field, *near_a_vertex(1e-7), dtype)
    assert apart((value[0], beside[0][1])) < 1e-3
    offsets = (vertices - point)[None].requires_grad_()
    naive = naive_weights(offsets)
    assert naive.isnan().any() and torch.autograd.grad(naive[0, 0], offsets)[0].isnan().any()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_moving_onto_a_vertex_changes_the_weights_without_a_step(dtype: torch.dtype) -> None:
    """From 1e-5 m down through the clamp to 0: the twin's weights at each gap, and never a gradient above the cone's slope."""
    others = torch.tensor([[0.004, 0, 0], [0, 0.005, 0], [0, 0, -0.006]], dtype=torch.float64)
    slope = float((1 / others.norm(dim=1)).sum())
    for gap in (1e-5, 1e-6, 1e-7, 2e-8, NEAREST_M, 1e-9, 1e-20, 0.0):  # 1e-20 squared is 0 in float32
        offsets = torch.cat([torch.tensor([[gap, 0, 0]], dtype=torch.float64), others])
        given = offsets.to(dtype)[None].requires_grad_()
        weights = inverse_distance_weights(given)
        assert (weights[0].detach().double() - twin_weights(offsets)).abs().max() < 1e-5
        (gradient,) = torch.autograd.grad(weights[0, 0], given)
        assert torch.isfinite(gradient).all() and float(gradient.norm(dim=-1).max()) < slope * 1.05
        if gap >= 2e-8:
            assert float(gradient[0, 0].norm()) == pytest.approx(slope, rel=0.05)


@pytest.mark.parametrize("dtype, bound", [(torch.float64, 1e-10), (torch.float32, 1e-5)])
@pytest.mark.parametrize("gap_m", [0.0, 0.002])
def test_four_coincident_vertices_of_different_features(gap_m: float, dtype: torch.dtype, bound: float) -> None:
    """Each has a quarter, at the place itself and beside it, and the gradient reaches all four."""
    point, vertices, features = near_a_vertex(gap_m)
    pairs = compared(small_field(), point, vertices[:1].expand(4, 3), features, dtype)
    checked = pairs if gap_m else [pairs[0], *pairs[2:]]
    assert max(apart(pair) for pair in checked) < bound and torch.isfinite(pairs[1][0]).all()
    assert (pairs[2][0].abs().amax(1) > 0).all()


def test_two_coincident_pairs_and_one_vertex_read_four_times() -> None:
    for rows in ([0, 0, 1, 1], [0, 0, 0, 0]):  # the same vertex several times is what too few neighbours are filled up with
        for gap in (0.0, 1e-7, 1e-3):
            point, vertices, _ = near_a_vertex(gap)
            offsets = (vertices[rows] - point).requires_grad_()
            weights = inverse_distance_weights(offsets[None])[0]
            assert (weights.detach() - twin_weights(offsets.detach())).abs().max() < 1e-5
            assert torch.isfinite(torch.autograd.grad(weights[0], offsets)[0]).all()


# Triangles without area and flipped ones.


def naive_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    corners, total = vertices[triangles], np.zeros_like(vertices)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    with np.errstate(invalid="ignore"):
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        for corner in range(3):
            np.add.at(total, triangles[:, corner], normal)
        return total / np.linalg.norm(total, axis=1, keepdims=True)


def test_triangles_without_area_leave_normals_and_core_as_they_are() -> None:
    head = toy_head(24, 36)
    vertices, triangles = head.template.numpy().astype(np.float64), head.triangles.numpy()
    degenerate = np.stack([triangles[:, 0], triangles[:, 0], triangles[:, 1]], 1)
    expected = vertex_normals(vertices, triangles)
    found = vertex_normals(vertices, np.concatenate([triangles, degenerate, triangles[:, [1, 1, 1]]]))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_array_equal(shell.core_points(vertices, found), shell.core_points(vertices, expected))
    assert np.isnan(naive_normals(vertices, np.concatenate([triangles, degenerate]))).any()


def test_a_vertex_without_area_of_its_own_has_the_zero_normal() -> None:
    """Needles from float32 and sheets of opposite triangles leave rounding, which must not become a unit vector."""
    random = np.random.default_rng(0)
    start, along = random.normal(size=(50, 3)) * 0.1, random.normal(size=(50, 3)) * 0.01
    needles = np.stack([start, start + along, start + 0.37 * along], 1).astype(np.float32).reshape(-1, 3).astype(np.float64)
    assert (vertex_normals(needles, np.arange(150).reshape(50, 3)) == 0).all()
    sheet = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 2, 1], [0, 3, 2], [0, 4, 3]])
    for seed in range(20):
        points = np.random.default_rng(seed).normal(size=(5, 3)) * 0.1
        assert (vertex_normals(points, sheet) == 0).all()
    thin = np.array([[0.0, 0, 0], [0.01, 0, 0], [0.005, 1e-6, 0]])  # a real triangle, 1 um high
    np.testing.assert_allclose(vertex_normals(thin, np.array([[0, 1, 2]])), [[0, 0, 1]] * 3, atol=1e-9)


def test_flipped_triangles_stay_local_and_never_grow_the_core() -> None:
    head = toy_head(24, 36)
    vertices, triangles = head.template.numpy().astype(np.float64), head.triangles.numpy()
    chosen = np.random.default_rng(0).choice(len(triangles), len(triangles) // 20, replace=False)
    flipped = triangles.copy()
    flipped[chosen] = flipped[chosen][:, [0, 2, 1]]
    expected, found = vertex_normals(vertices, triangles), vertex_normals(vertices, flipped)
    assert np.isfinite(found).all()
    touched = np.unique(triangles[chosen])
    np.testing.assert_allclose(np.delete(found, touched, 0), np.delete(expected, touched, 0), atol=1e-12)
    core, whole = shell.core_points(vertices, found), shell.core_points(vertices, expected)
    assert 0.5 * len(whole) < len(core) <= 1.001 * len(whole)
    assert ((core / RADII_M) ** 2).sum(1).max() < 1
    assert len(shell.core_points(vertices, np.zeros_like(expected))) == 0


# The UV map.

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize("height", [0.0, 1e-17, 1e-14, 1e-12])
def test_a_needle_across_the_map_takes_no_texel(height: float) -> None:
    """Along the diagonal, through 64 texel centres, with the first index: its barycentric weights are rounding over rounding."""
    uvs = np.concatenate([SQUARE, [[0.0, 0.0], [1.0, 1.0], [0.3 + height, 0.3]]])
    triangle, weights = rasterise(uvs, np.concatenate([[[4, 5, 6]], HALVES]), 64)
    assert 0 not in triangle and np.isfinite(weights).all()
    rebuilt = (uvs[np.concatenate([[[4, 5, 6]], HALVES])[triangle]] * weights[..., None]).sum(2)
    centre = (np.arange(64) + 0.5) / 64
    np.testing.assert_allclose(rebuilt[..., 0], np.broadcast_to(centre, (64, 64)), atol=1e-9)
    np.testing.assert_allclose(rebuilt[..., 1], np.broadcast_to(1 - centre[:, None], (64, 64)), atol=1e-9)


def test_flipped_and_flat_triangles_give_the_same_map() -> None:
    head = toy_head(24, 36)
    random = np.random.default_rng(0)
    chosen = random.random(len(head.triangles)) < 0.3
    turned = [np.where(chosen[:, None], t.numpy()[:, [0, 2, 1]], t.numpy()) for t in (head.uv_triangles, head.triangles)]
    flat = [np.concatenate([t, t[::5][:, [0, 0, 1]]]) for t in turned]
    attribute = head.template[None].double() * 10
    plain = UVMap(head.uvs.double(), head.uv_triangles, head.triangles, head.vertex_count, 64)
    other = UVMap(head.uvs.double(), torch.from_numpy(flat[0]), torch.from_numpy(flat[1]), head.vertex_count, 64)
    torch.testing.assert_close(other.to_map(attribute), plain.to_map(attribute), atol=1e-6, rtol=0)
    torch.testing.assert_close(other.at_vertices(other.to_map(attribute)), plain.at_vertices(plain.to_map(attribute)))


def unfilled(uv: UVMap, maps: Tensor) -> Tensor:
    """The naive map: texels outside the chart are 0."""
    size = maps.shape[-1]
    inside = np.zeros((size, size), bool)
    corners = (uv.grid.numpy() + 1) / 2 * size - 0.5  # the copies' places after packing
    low, high = np.ceil(corners.min(0)).astype(int), np.floor(corners.max(0)).astype(int)
    inside[low[1] : high[1] + 1, low[0] : high[0] + 1] = True  # the toy's only chart is a rectangle
    return maps * torch.from_numpy(inside)


@pytest.mark.parametrize("size", [64, 128])
def test_no_step_across_a_seam(size: int) -> None:
    """A smooth attribute there and back: at the seam no worse than elsewhere, the copies apart by two texels' slope at most."""
    head = toy_head(24, 36)
    uv = UVMap(head.uvs.double(), head.uv_triangles, head.triangles, head.vertex_count, size)
    smooth = torch.sin(head.template.double()[None] * 20)
    maps = uv.to_map(smooth)
    back = uv.at_vertices(maps)
    count = torch.bincount(uv.copy_vertex, minlength=head.vertex_count)
    seam = (count == 2) & (head.template[:, 1].abs() < 0.09)
    assert seam.sum() >= 15
    middle = (count == 1) & (head.template[:, 1].abs() < 0.09)
    error = (back - smooth).abs()[0].amax(1)
    assert error[seam].mean() < 3 * error[middle].mean() and error[seam].max() < 0.06
    read = functional.grid_sample(maps, uv.grid[None, None], mode="bilinear", padding_mode="border", align_corners=False)[0, :, 0]
    left, right = (torch.stack([read[:, (uv.copy_vertex == v).nonzero()[i, 0]] for v in seam.nonzero()[:, 0]]) for i in (0, 1))
    texel = 20 * RADII_M[0] * 2 * np.pi / size  # of the steepest attribute; each copy may read a filled texel, one off
    assert (left - right).abs().max() < 2 * texel / 0.96
    naive = uv.at_vertices(unfilled(uv, maps))
    assert (naive - smooth).abs()[0].amax(1)[seam].max() > 0.2


def test_every_texel_is_filled_and_constant_attributes_stay_constant() -> None:
    """Texels outside the chart take a real neighbour: weights of 1 everywhere, so a constant is a constant to the rounding."""
    head = toy_head(24, 36)
    uv = UVMap(head.uvs, head.uv_triangles, head.triangles, head.vertex_count, 64)
    maps = uv.to_map(torch.full((1, head.vertex_count, 1), 7.0))
    torch.testing.assert_close(maps, torch.full_like(maps, 7.0))
    torch.testing.assert_close(uv.at_vertices(maps), torch.full((1, head.vertex_count, 1), 7.0))
