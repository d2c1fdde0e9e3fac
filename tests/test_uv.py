"""Rasterisation and sampling back against slow twins; seams, empty texels, flat, flipped and overlapping triangles."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from toy_head import toy_head

from avatar.uv import UVMap, pack, rasterise

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def twin(uvs: np.ndarray, triangles: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Every texel against every triangle by a 3x3 solve; -1 where none covers it."""
    triangle, weights = np.full((size, size), -1), np.zeros((size, size, 3))
    for row in range(size):
        for column in range(size):
            point = np.array([(column + 0.5) / size, 1 - (row + 0.5) / size, 1.0])
            for index, corners in enumerate(triangles):
                matrix = np.vstack([uvs[corners].T, np.ones(3)])
                if abs(np.linalg.det(matrix)) < 1e-12:
                    continue
                solved = np.linalg.solve(matrix, point)
                if (solved >= -1e-9).all():
                    triangle[row, column], weights[row, column] = index, solved
                    break
    return triangle, weights


def test_rasterise_equals_its_twin_and_fills_empty_texels_from_the_nearest() -> None:
    random = np.random.default_rng(0)
    uvs, triangles = random.random((9, 2)), np.array([[0, 1, 2], [3, 5, 4], [6, 7, 8]])
    expected, weights = twin(uvs, triangles, 24)
    found, barycentric = rasterise(uvs, triangles, 24)
    covered = expected >= 0
    assert covered.any() and not covered.all()
    np.testing.assert_array_equal(found[covered], expected[covered])
    np.testing.assert_allclose(barycentric[covered], weights[covered], atol=1e-9)
    rows, columns = np.nonzero(covered)
    for row, column in np.argwhere(~covered)[::7]:
        nearest = ((rows - row) ** 2 + (columns - column) ** 2).min()
        same = (found[covered] == found[row, column]) & np.isclose(barycentric[covered], barycentric[row, column]).all(1)
        assert ((rows - row) ** 2 + (columns - column) ** 2)[same].min() == nearest


def test_flipped_and_degenerate_triangles() -> None:
    straight = rasterise(SQUARE, np.array([[0, 1, 2], [0, 2, 3]]), 8)
    flipped = rasterise(SQUARE, np.array([[0, 2, 1], [1, 1, 2], [0, 2, 3]]), 8)  # reversed winding, and one without area
    assert np.isfinite(flipped[1]).all() and set(np.unique(flipped[0])) == {0, 2}
    assert set(np.unique(straight[0])) == {0, 1}
    with pytest.raises(ValueError, match="no texel"):
        rasterise(SQUARE, np.array([[0, 1, 1]]), 8)


def test_rows_point_down_while_v_points_up() -> None:
    uv = UVMap(torch.tensor(SQUARE), torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.tensor([[0, 1, 2], [0, 2, 3]]), 4, 64)
    values = torch.tensor(SQUARE)[None]  # attributes are the UVs themselves
    maps = uv.to_map(values)
    assert maps[0, 1, 0].mean() > 0.95 and maps[0, 1, -1].mean() < 0.05
    assert maps[0, 0, :, 0].mean() < 0.05 and maps[0, 0, :, -1].mean() > 0.95


def test_linear_attributes_survive_the_round_trip() -> None:
    head = toy_head()
    uv = UVMap(head.uvs.double(), head.uv_triangles, head.triangles, head.vertex_count, 128)
    smooth = head.template.double()[None] * 10
    back = uv.at_vertices(uv.to_map(smooth))
    assert (back - smooth).abs().mean() < 0.02 * smooth.abs().max()


def test_a_seam_vertex_reads_the_mean_of_its_copies_and_both_sides_are_written() -> None:
    head = toy_head()
    copies = {}
    for vertex, uv_vertex in zip(head.triangles.flatten().tolist(), head.uv_triangles.flatten().tolist(), strict=True):
        copies.setdefault(vertex, set()).add(uv_vertex)
    seam = next(vertex for vertex, found in copies.items() if len(found) == 2)
    uv = UVMap(head.uvs, head.uv_triangles, head.triangles, head.vertex_count, 64)
    left_right = torch.linspace(0, 1, 64).expand(1, 1, 64, 64)
    value = float(uv.at_vertices(left_right)[0, seam, 0])
    assert abs(value - 0.5) < 0.05  # copies at the left and at the right border
    attribute = torch.zeros(1, head.vertex_count, 1)
    attribute[0, seam] = 1
    written = uv.to_map(attribute)[0, 0]
    assert written[:, :8].max() > 0.5 and written[:, -8:].max() > 0.5
    assert abs(float(written[:, 0].max() - written[:, -1].max())) < 0.1  # no jump across the seam


def test_a_vertex_without_triangles_reads_zero() -> None:
    uv = UVMap(torch.tensor(SQUARE), torch.tensor([[0, 1, 2]]), torch.tensor([[0, 1, 2]]), 5, 64)
    read = uv.at_vertices(torch.ones(1, 2, 64, 64, dtype=torch.float64))
    assert read[0, 4].abs().sum() == 0 and read[0, 0].sum() == 2


def test_both_gathers_pass_gradients() -> None:
    uv = UVMap(torch.tensor(SQUARE), torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.tensor([[0, 1, 2], [0, 2, 3]]), 4, 6)
    torch.autograd.gradcheck(uv.to_map, torch.randn(2, 4, 3, dtype=torch.float64, requires_grad=True))
    torch.autograd.gradcheck(uv.at_vertices, torch.randn(2, 3, 6, 6, dtype=torch.float64, requires_grad=True))


def test_pack_keeps_charts_apart_inside_the_square_and_affine() -> None:
    corners = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.2]])
    uvs = np.concatenate([corners * 2 + 0.7, corners * 0.3 + 0.05, corners * 0.2 + [0.4, 0.9]])
    triangles = np.arange(9).reshape(3, 3)
    packed = pack(uvs, triangles)
    assert packed.min() >= 0 and packed.max() <= 1
    boxes = [(packed[t].min(0), packed[t].max(0)) for t in triangles]
    for i, (low, high) in enumerate(boxes):
        assert all(
            (high < other_low).any() or (other_high < low).any() for j, (other_low, other_high) in enumerate(boxes) if j != i
        )
    assert np.prod(boxes[0][1] - boxes[0][0]) > 0.7  # the largest fills the square
    assert (np.ptp(pack(SQUARE * 0.2, np.array([[0, 1, 2], [0, 2, 3]])), axis=0) > 0.95).all()
