"""The k-NN field against a brute-force, loop-by-loop twin in float64; the pole of the inverse-distance weights."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.field import DENSITY_LENGTH_M, HEAD_SIZE_M, Field, inverse_distance_weights
from avatar.neighbours import nearest_by_blocks, nearest_by_tree, tree_of
from avatar.networks import positional_encoding


def small_field() -> Field:
    torch.manual_seed(0)
    return Field(channels=6, width=16, depth=3, colour_width=8, neighbours=4, bands=3, view_bands=2).double()


def twin(
    field: Field, point: torch.Tensor, direction: torch.Tensor, vertices: torch.Tensor, features: torch.Tensor
) -> tuple[float, list[float]]:
    """Equation 1 at one point: sort by distance, MLP0 on [PE, z] as one layer, explicit sums."""
    distance = (vertices - point).norm(dim=1)
    nearest = torch.argsort(distance)[: field.neighbours]
    first = torch.cat([field.from_offset.weight, field.from_feature.weight], 1)
    total, mixed = sum(1 / distance[j] for j in nearest), 0.0
    for j in nearest:
        row = torch.cat([positional_encoding((vertices[j] - point) / HEAD_SIZE_M, field.bands), features[j]])
        hidden = torch.relu(first @ row + field.from_feature.bias)
        for layer in field.mlp0.layers:
            hidden = torch.relu(layer.weight @ hidden + layer.bias)
        mixed = mixed + (1 / distance[j]) / total * hidden
    for layer in field.mlp1.layers:
        mixed = torch.relu(layer.weight @ mixed + layer.bias)
    density = torch.log1p(torch.exp(field.density.weight @ mixed + field.density.bias))[0] / DENSITY_LENGTH_M
    row = torch.cat([mixed, positional_encoding(direction, field.view_bands)])
    row = torch.relu(field.mlp2.layers[0].weight @ row + field.mlp2.layers[0].bias)
    return float(density), (1 / (1 + torch.exp(-(field.colour.weight @ row + field.colour.bias)))).tolist()


@torch.no_grad()
def test_field_equals_its_twin() -> None:
    field = small_field()
    vertices, features = torch.randn(40, 3).double() * 0.05, torch.randn(40, 6).double()
    points, directions = torch.randn(12, 3).double() * 0.05, torch.nn.functional.normalize(torch.randn(12, 3).double(), dim=1)
    index = torch.from_numpy(nearest_by_tree(tree_of(vertices.numpy()), points.numpy(), 4))
    density, colour = field(points, directions, vertices, index, field.vertex_terms(features, torch.float64), torch.float64)
    for i in range(len(points)):
        expected_density, expected_colour = twin(field, points[i], directions[i], vertices, features)
        assert float(density[i]) == pytest.approx(expected_density, rel=1e-10)
        assert colour[i].tolist() == pytest.approx(expected_colour, rel=1e-10)


def test_gradients_of_points_and_features() -> None:
    field = small_field()
    vertices, directions = torch.randn(20, 3).double() * 0.05, torch.nn.functional.normalize(torch.randn(3, 3).double(), dim=1)
    points = (torch.randn(3, 3).double() * 0.05).requires_grad_()
    features = torch.randn(20, 6).double().requires_grad_()
    index = torch.from_numpy(nearest_by_tree(tree_of(vertices.numpy()), points.detach().numpy(), 4))

    def both(points: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        density, colour = field(points, directions, vertices, index, field.vertex_terms(features, torch.float64), torch.float64)
        return torch.cat([density[:, None] * DENSITY_LENGTH_M, colour], 1)

    torch.autograd.gradcheck(both, (points, features))


def test_neighbours_by_tree_and_by_blocks_equal_brute_force() -> None:
    random = np.random.default_rng(0)
    vertices, points = random.normal(size=(300, 3)).astype(np.float32), random.normal(size=(70, 3)).astype(np.float32)
    expected = np.argsort(((points[:, None].astype(float) - vertices[None]) ** 2).sum(-1), axis=1)[:, :4]
    np.testing.assert_array_equal(nearest_by_tree(tree_of(vertices), points, 4), expected)
    np.testing.assert_array_equal(nearest_by_blocks(torch.from_numpy(vertices), torch.from_numpy(points), 4), expected)
    assert nearest_by_tree(tree_of(vertices), points[:0], 4).shape == (0, 4)
    assert nearest_by_tree(tree_of(vertices), points, 1).shape == (70, 1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("gap", [0.0, 1e-9, 1e-7, 1e-5])
def test_weights_at_and_near_a_vertex(gap: float, dtype: torch.dtype) -> None:
    offsets = torch.tensor([[[gap, 0, 0], [0.004, 0, 0], [0, 0.005, 0], [0, 0, -0.006]]], dtype=dtype, requires_grad=True)
    weights = inverse_distance_weights(offsets)
    assert float(weights.sum()) == pytest.approx(1, abs=1e-6)
    exact = 1 / max(gap, 1e-300) if gap else None
    if gap:
        inverse = np.array([exact, 1 / 0.004, 1 / 0.005, 1 / 0.006])
        np.testing.assert_allclose(weights.detach()[0], inverse / inverse.sum(), atol=1e-5)
    else:
        assert float(weights[0, 0]) == pytest.approx(1, abs=1e-5)
    weights[0, 0].backward()
    assert torch.isfinite(offsets.grad).all() and offsets.grad.abs().max() < 1e4


def test_four_coincident_neighbours_share_equally() -> None:
    for value in (0.0, 0.003):
        offsets = torch.full((1, 4, 3), value, requires_grad=True)
        weights = inverse_distance_weights(offsets)
        torch.testing.assert_close(weights, torch.full((1, 4), 0.25))
        weights.square().sum().backward()
        assert torch.isfinite(offsets.grad).all()


def test_weights_change_little_for_a_small_move() -> None:
    offsets = torch.tensor([[[0.002, 0, 0], [-0.002, 0, 0], [0, 0.003, 0], [0, -0.003, 0.0]]], dtype=torch.float64)
    moved = offsets + torch.tensor([1e-7, 0, 0])
    assert (inverse_distance_weights(moved) - inverse_distance_weights(offsets)).abs().max() < 1e-3


@torch.no_grad()
def test_bfloat16_hidden_layers_cost_little() -> None:
    torch.manual_seed(0)
    field = Field(64, 128, 3, 64, 4, 10, 4)
    vertices, features = torch.randn(200, 3) * 0.05, torch.randn(200, 64)
    points, directions = torch.randn(500, 3) * 0.05, torch.nn.functional.normalize(torch.randn(500, 3), dim=1)
    index = torch.from_numpy(nearest_by_tree(tree_of(vertices.numpy()), points.numpy(), 4))
    exact, rough = (
        field(points, directions, vertices, index, field.vertex_terms(features, p), p) for p in (torch.float32, torch.bfloat16)
    )
    assert (exact[1] - rough[1]).abs().mean() < 4e-3  # one level of 8 bits
    assert rough[0].dtype == rough[1].dtype == torch.float32


def test_sizes_are_the_papers() -> None:
    field = Field(64, 128, 3, 64, 4, 10, 4)
    weights = {name: tuple(value.shape) for name, value in field.named_parameters() if value.ndim == 2}
    assert weights["from_offset.weight"] == (128, 63) and weights["from_feature.weight"] == (128, 64)
    assert weights["mlp2.layers.0.weight"] == (64, 128 + 27)
    products = sum(a * b * (4 if name.startswith(("from_", "mlp0")) else 1) for name, (a, b) in weights.items())
    assert 2 * products / 1e6 == pytest.approx(0.51, abs=0.01)  # MFLOP a sample
