"""The shell against its definition by dense sampling of distances; rays that miss, graze, start inside or run along an axis."""

from __future__ import annotations

import numpy as np
import pytest
from toy_head import toy_head

from avatar import shell
from fitting.raster import vertex_normals

NONE = np.zeros((0, 3), np.float32)


def in_shell(points: np.ndarray, vertices: np.ndarray, thickness: np.ndarray) -> np.ndarray:
    """The definition: the centre of the point's voxel is within a vertex's thickness of that vertex."""
    centres = (np.floor(points / shell.VOXEL_M) + 0.5) * shell.VOXEL_M
    return (np.linalg.norm(centres[:, None] - vertices, axis=2) <= thickness).any(1)


def rays_at(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from 0.6 m away towards the head and past it."""
    random = np.random.default_rng(seed)
    origins = random.normal(size=(count, 3))
    origins *= 0.6 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = random.normal(size=(count, 3)) * 0.06 - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def head() -> tuple[np.ndarray, np.ndarray]:
    vertices = toy_head().template.numpy().astype(np.float64)
    return vertices, np.where(vertices[:, 1] < 0, 0.03, 0.016)


def test_intervals_equal_dense_sampling(head: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, thickness = head
    grid = shell.occupancy(vertices, thickness, NONE)
    origins, directions = rays_at(24)
    found, count, met = shell.intervals(grid, origins, directions)
    assert (count == 0).any() and (count >= 2).any()
    along = (np.arange(2000) + 0.5) * 0.5e-3 + 0.2
    for n in range(len(origins)):
        expected = in_shell(origins[n] + along[:, None] * directions[n], vertices, thickness)
        inside = np.zeros(len(along), bool)
        for start, end in found[n, : count[n]]:
            inside |= (along >= start) & (along <= end)
        assert (inside != expected).mean() < 0.004  # only where a sample lies on a voxel's face
        assert (np.diff(found[n, : count[n]].ravel()) > 0).all()  # ordered, apart, none of length zero


def test_a_ray_ends_at_the_core_and_the_core_is_deep_inside(head: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, thickness = head
    triangles = toy_head().triangles.numpy()
    core = shell.core_points(vertices, vertex_normals(vertices, triangles))
    assert len(core) > 1000
    assert ((core / (0.075, 0.105, 0.09)) ** 2).sum(1).max() < 1
    grid = shell.occupancy(vertices, thickness, core)
    origin, direction = np.array([[0.001, 0.001, -0.6]]), np.array([[0.0, 0.0, 1.0]])
    through, *_ = shell.intervals(shell.occupancy(vertices, thickness, NONE), origin, direction)
    stopped, count, met = shell.intervals(grid, origin, direction)
    assert count[0] == 1 and (through[0, :2, 0] > 0).all()
    assert stopped[0, 0, 0] == through[0, 0, 0] and 0 <= through[0, 0, 1] - stopped[0, 0, 1] < 2 * shell.VOXEL_M  # 30 mm thick
    assert met[0] and not shell.intervals(grid, origin + [0.3, 0, 0], direction)[2][0]
    samples = shell.sample(stopped, count, 0.002, 8, None, met)
    assert samples.closed.tolist() == [False] * (len(samples.ray) - 1) + [True]
    assert not shell.sample(stopped, count, 0.002, 8, None).closed.any()


def test_hair_thicker_than_the_skull_is_deep_leaves_the_core(head: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, _ = head
    core = shell.core_points(vertices, vertex_normals(vertices, toy_head().triangles.numpy()))
    grid = shell.occupancy(vertices, np.full(len(vertices), 0.07), core)
    assert (grid.labels == shell.CORE).sum() == len(core)
    assert shell.intervals(grid, np.array([[0.001, 0.001, -0.6]]), np.array([[0.0, 0.0, 1.0]]))[2][0]
    moved = vertices.copy()
    moved[0] = core[0]  # a vertex that moves into it clears its own surroundings
    near = np.linalg.norm(core - core[0], axis=1) < shell.CORE_DEPTH_M / 2
    labels = shell.occupancy(moved, np.full(len(vertices), 0.07), core)
    index = np.floor((core[near] - labels.origin) / shell.VOXEL_M).astype(int)
    assert (labels.labels[tuple(index.T)] == shell.SHELL).all()


@pytest.mark.parametrize("direction", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0], [1e-15, 0, 1]])
def test_axis_aligned_rays_and_cameras_inside(head: tuple[np.ndarray, np.ndarray], direction: list[float]) -> None:
    vertices, thickness = head
    grid = shell.occupancy(vertices, thickness, NONE)
    direction = np.array([direction], float)
    for origin in (np.zeros((1, 3)), vertices[:1], -0.5 * direction, np.full((1, 3), 5.0)):
        found, count, met = shell.intervals(grid, origin, direction)
        assert np.isfinite(found).all() and (found[0, : count[0], 0] >= 0).all()
        middles = found[0, : count[0]].mean(1)
        assert in_shell(origin + middles[:, None] * direction, vertices, thickness).all() if count[0] else True
    assert shell.intervals(grid, vertices[:1], direction)[0][0, 0, 0] == 0  # starts inside the shell
    assert shell.intervals(grid, np.full((1, 3), 5.0), direction)[1][0] == 0


def test_grazing_ray_has_a_short_interval_and_at_least_one_sample(head: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, thickness = head
    grid = shell.occupancy(vertices, thickness, NONE)
    top = (np.argwhere(grid.labels == shell.SHELL)[:, 0].max() + 1) * shell.VOXEL_M + grid.origin[0]
    cell = np.argwhere(grid.labels[-1 if grid.labels[-1].any() else -2] == shell.SHELL)[0]
    y, z = (cell + 0.5) * shell.VOXEL_M + grid.origin[1:]
    direction = np.array([[1.0, -1.0, 0.0]]) / np.sqrt(2)
    origin = np.array([[top - 1e-5, y + 0.002 - 1e-5, z]]) - 0.5 * direction
    found, count, met = shell.intervals(grid, origin, direction)
    samples = shell.sample(found, count, 0.002, 8, None)
    assert count[0] == 0 or len(samples.ray) >= 1
    assert np.isfinite(samples.distance_m).all() and (samples.step_m >= 0).all()


def test_samples_are_stratified_over_the_length_inside() -> None:
    found = np.zeros((4, shell.MAX_INTERVALS, 2))
    found[1, 0], found[1, 1] = (1.0, 1.010), (1.100, 1.130)
    found[2, 0] = (0.5, 0.5004)
    found[3, 0] = (0.5, 0.9)
    count = np.array([0, 2, 1, 1])
    samples = shell.sample(found, count, 0.005, 16, None)
    assert np.bincount(samples.ray, minlength=4).tolist() == [0, 8, 1, 16]
    np.testing.assert_allclose(
        samples.distance_m[:8], [1.0025, 1.0075, 1.1025, 1.1075, 1.1125, 1.1175, 1.1225, 1.1275], rtol=1e-6
    )
    np.testing.assert_allclose(np.bincount(samples.ray, samples.step_m), [0, 0.04, 0.0004, 0.4], rtol=1e-5)
    assert samples.slot.tolist() == [*range(8), 0, *range(16)]
    jitter = np.random.default_rng(0).random((4, 16)).astype(np.float32)
    moved = shell.sample(found, count, 0.005, 16, jitter)
    assert (np.diff(moved.distance_m[:8]) > 0).all() and (moved.step_m == samples.step_m).all()
    inside = (
        (moved.distance_m[:8, None] >= found[1, :2, 0] - 1e-6) & (moved.distance_m[:8, None] <= found[1, :2, 1] + 1e-6)
    ).any(1)
    assert inside.all()


def test_no_rays_and_no_hits_give_empty_arrays() -> None:
    empty = shell.sample(np.zeros((0, shell.MAX_INTERVALS, 2)), np.zeros(0, np.int64), 0.002, 8, None)
    missed = shell.sample(np.zeros((3, shell.MAX_INTERVALS, 2)), np.zeros(3, np.int64), 0.002, 8, None)
    assert len(empty.ray) == len(missed.ray) == 0


def test_wild_vertices_do_not_grow_the_grid_without_bound(head: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, thickness = head
    grid = shell.occupancy(vertices * 50, thickness, NONE)
    assert max(grid.labels.shape) <= 2 * shell.REACH_M / shell.VOXEL_M + 2


def test_normals_point_outwards_and_flat_triangles_do_no_harm(head: tuple[np.ndarray, np.ndarray]) -> None:
    vertices, _ = head
    triangles = np.concatenate([toy_head().triangles.numpy(), [[0, 0, 1]]])
    normals = vertex_normals(vertices, triangles)
    assert np.isfinite(normals).all() and ((normals * vertices).sum(1) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)


def test_a_packed_grid_is_the_same_in_a_quarter_of_the_memory() -> None:
    random = np.random.default_rng(0)
    for shape in ((5, 7, 3), (1, 1, 1), (8, 8, 8)):
        grid = shell.Grid(random.normal(size=3), random.integers(0, 3, shape).astype(np.uint8))
        packed = shell.pack(grid)
        found = shell.unpack(packed)
        np.testing.assert_array_equal(found.labels, grid.labels)
        assert found.labels.dtype == np.uint8 and (found.origin == grid.origin).all()
        assert sum(bits.nbytes for bits in packed.bits) <= grid.labels.size / 4 + 2
