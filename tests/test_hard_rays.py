"""Hard cases along one ray: densities from nothing to 1e30, rays that graze, start inside or miss.

Each has a slow twin in float64, gradients compared as well, and the naive formula that fails stands beside it.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
import torch
from torch import Tensor

from avatar import shell
from avatar.volume import composite

DEPTHS = (0.0, 1e-12, 0.3, 20.0, 1e6, 1e30)


def twin(depth: Tensor, colour: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """One ray's weights [S], colour [3] on white and opacity, one sample after another."""
    light, weights, shade = torch.ones((), dtype=depth.dtype), [], torch.zeros(3, dtype=depth.dtype)
    for one, tint in zip(depth, colour, strict=True):
        weights.append(light * -torch.expm1(-one))
        shade = shade + weights[-1] * tint
        light = light * torch.exp(-one)
    return torch.stack(weights), shade + light, 1 - light


def naive_by_logarithm(depth: Tensor) -> Tensor:
    """Weights [S] from products of 1 - alpha by way of their logarithms."""
    passed = torch.log(1 - (1 - torch.exp(-depth)))
    return torch.exp(torch.cumsum(passed, 0) - passed) * (1 - torch.exp(-depth))


def naive_by_difference(depth: Tensor) -> Tensor:
    """Weights [S] whose transmittance is the running sum less the sample's own depth."""
    return torch.exp(-(torch.cumsum(depth, 0) - depth)) * -torch.expm1(-depth)


def one_ray(depth: Tensor, colour: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    count = len(depth)
    where = torch.linspace(0.5, 0.6, count, dtype=depth.dtype)
    rendered, weight = composite(depth, colour, where, torch.zeros(count, dtype=torch.int64), torch.arange(count), 1)
    return weight, rendered.colour[0], rendered.opacity[0]


@pytest.mark.parametrize("dtype, bound", [(torch.float64, 1e-12), (torch.float32, 1e-6)])
def test_any_order_of_densities_equals_the_loop_with_gradients(dtype: torch.dtype, bound: float) -> None:
    torch.manual_seed(0)
    tint, pull = torch.rand(4, 3), torch.tensor([1.0, -2.0, 0.5])
    for chosen in permutations(DEPTHS, 4):
        exact = [torch.tensor(chosen).double().requires_grad_(), tint.double().requires_grad_()]
        given = [value.detach().to(dtype).requires_grad_() for value in exact]
        expected, found = twin(*exact), one_ray(*given)
        for left, right in zip(found, expected, strict=True):
            assert (left.double() - right).abs().max() < bound
        assert (found[0] >= 0).all() and float(found[0].sum()) <= 1 + 2e-7
        losses = [(shade * pull.to(shade.dtype)).sum() + 0.7 * opacity for _, shade, opacity in (expected, found)]
        right, left = (torch.autograd.grad(loss, of) for loss, of in zip(losses, (exact, given), strict=True))
        for mine, other in zip(left, right, strict=True):
            assert (mine.double() - other).abs().max() < 10 * bound


def test_naive_compositing_fails_on_these() -> None:
    depth = torch.tensor([0.3, 1e6, 0.3], requires_grad=True)
    naive = naive_by_logarithm(depth)
    assert naive.isnan().any() or torch.autograd.grad(naive.sum(), depth)[0].isnan().any()
    assert float(naive_by_difference(torch.tensor([0.3, 1e8])).sum()) > 1.2  # light from nowhere
    assert float(one_ray(torch.tensor([0.3, 1e8]), torch.ones(2, 3))[0].sum()) <= 1


def test_gradients_behind_an_opaque_sample_are_zero_and_before_it_pull() -> None:
    depth = torch.tensor([1e-3, 1e6, 0.3, 1e6], requires_grad=True)
    _, shade, _ = one_ray(depth, torch.tensor([[0.2] * 3, [0.9] * 3, [0.5] * 3, [0.5] * 3]))
    (gradient,) = torch.autograd.grad(shade.sum(), depth)
    assert float(gradient[0]) == pytest.approx(3 * (0.2 - 0.9) * np.exp(-1e-3), rel=1e-5) and (gradient[1:] == 0).all()


def test_ten_thousand_samples_of_a_millionth_in_float32() -> None:
    """Thin fog: 1 - exp(-d) would lose half of its digits; the twin is exact."""
    depth = torch.full((10_000,), 1e-6)
    weight, shade, opacity = one_ray(depth, torch.zeros(10_000, 3))
    assert float(opacity) == pytest.approx(-np.expm1(-0.01), rel=1e-4)
    assert float(weight.sum()) == pytest.approx(float(opacity), rel=1e-4)
    naive = 1 - torch.exp(-depth[:1])
    assert abs(float(naive) / 1e-6 - 1) > 0.01


# Rays through voxels.


def slow_intervals(grid: shell.Grid, origin: np.ndarray, direction: np.ndarray) -> tuple[list[list[float]], bool]:
    """Every voxel against the ray by slabs; stretches longer than 1e-9 m, joined, cut where the first core voxel begins."""
    spans = {shell.SHELL: [], shell.CORE: []}
    for cell in np.argwhere(grid.labels != shell.EMPTY):
        near, far = 0.0, np.inf
        for axis in range(3):
            low = grid.origin[axis] + cell[axis] * shell.VOXEL_M
            o, d = origin[axis], direction[axis]
            if d == 0:
                if not low <= o < low + shell.VOXEL_M:
                    far = -1.0
                continue
            ends = sorted(((low - o) / d, (low + shell.VOXEL_M - o) / d))
            near, far = max(near, ends[0]), min(far, ends[1])
        if far > near + 1e-9:
            spans[grid.labels[tuple(cell)]].append([near, far])
    stop = min((span[0] for span in spans[shell.CORE]), default=np.inf)
    joined = []
    for near, far in sorted(spans[shell.SHELL]):
        if near >= stop - 1e-12:
            continue
        if joined and near <= joined[-1][1] + 1e-9:
            joined[-1][1] = max(joined[-1][1], far)
        else:
            joined.append([near, far])
    return joined, bool(np.isfinite(stop))


def a_grid(seed: int, core: float = 0.1) -> shell.Grid:
    """8 x 7 x 6 voxels at random, a corner at 0 so that faces lie at multiples of the voxel's side."""
    labels = np.random.default_rng(seed).choice(3, (8, 7, 6), p=[0.45, 0.55 - core, core]).astype(np.uint8)
    return shell.Grid(np.zeros(3), labels)


def cast(grid: shell.Grid, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, bool]:
    found, count, met = shell.intervals(grid, origin[None], direction[None])
    return found[0, : count[0]], bool(met[0])


def check(grid: shell.Grid, origin: np.ndarray, direction: np.ndarray) -> None:
    expected, stopped = slow_intervals(grid, origin, direction)
    found, met = cast(grid, origin, direction)
    assert met == stopped
    np.testing.assert_allclose(found, np.array(expected).reshape(-1, 2), atol=1e-9)


def test_rays_from_anywhere_equal_every_voxel_tested() -> None:
    """From outside, from inside the shell and from inside the core, in any direction and along the axes."""
    random = np.random.default_rng(0)
    size = np.array([8, 7, 6]) * shell.VOXEL_M
    started = dict.fromkeys(range(3), 0)
    for turn in range(240):
        grid = a_grid(turn % 5, 0.05 + 0.15 * (turn % 2))
        origin = random.random(3) * size * 1.6 - 0.3 * size
        direction = random.normal(size=3)
        if turn % 3 == 0:
            direction = np.eye(3)[turn % 9 // 3] * random.choice([-1, 1])
        cell = np.floor(origin / shell.VOXEL_M).astype(int)
        if ((cell >= 0) & (cell < grid.labels.shape)).all():
            started[int(grid.labels[tuple(cell)])] += 1
        check(grid, origin, direction / np.linalg.norm(direction))
    assert min(started.values()) >= 3


def test_a_ray_through_edges_and_corners_exactly() -> None:
    """Along a plane's and along the cube's diagonal: voxels that it only touches neither end it nor break its stretch."""
    for pattern in range(6):
        grid = a_grid(10 + pattern)
        for axes in ([0, 1], [1, 2], [0, 2], [0, 1, 2]):
            direction = np.zeros(3)
            direction[axes] = 1 / np.sqrt(len(axes))
            for back in (1, -1):
                start = np.full(3, 0.5) * shell.VOXEL_M
                start[axes] = 0.0 if back == 1 else 6 * shell.VOXEL_M
                check(grid, start - 0.02 * back * direction, back * direction)
    sheet = np.zeros((6, 6, 1), np.uint8)
    sheet[np.arange(6), np.arange(6)] = shell.SHELL
    sheet[np.arange(5) + 1, np.arange(5)] = shell.CORE  # touched at edges only
    diagonal = np.array([1, 1, 0]) / np.sqrt(2)
    found, met = cast(shell.Grid(np.zeros(3), sheet), np.array([0, 0, 0.002]) - 0.1 * diagonal, diagonal)
    assert not met and len(found) == 1
    np.testing.assert_allclose(found[0], 0.1 + np.array([0, 6]) * shell.VOXEL_M * np.sqrt(2))


def test_a_ray_within_a_face_is_the_limit_from_one_side() -> None:
    random = np.random.default_rng(0)
    for turn in range(40):
        grid = a_grid(turn % 4)
        across, along = random.permutation(3)[:2]
        origin = random.random(3) * 0.02
        origin[across], origin[along] = random.integers(1, 6) * shell.VOXEL_M, -0.01
        direction = np.eye(3)[along]
        found, met = cast(grid, origin, direction)
        limits = [cast(grid, origin + shift * np.eye(3)[across], direction) for shift in (-1e-8, 1e-8)]
        assert any(met == m and found.shape == f.shape and np.allclose(found, f, atol=1e-9) for f, m in limits)
    with np.errstate(invalid="ignore", divide="ignore"):  # what slabs without a case for it make of such a ray
        assert np.isnan((np.array([0.0]) - 0.0) / np.array([0.0])).all()


@pytest.mark.parametrize("tilt", [1e-6, 1e-9, 1e-11, 1e-13, 1e-16, 1e-300])
def test_a_ray_almost_along_an_axis(tilt: float) -> None:
    for turn, sign in enumerate((1, -1, 1, -1)):
        grid = a_grid(turn)
        direction = np.array([sign * tilt, 1.0, -tilt])
        check(grid, np.array([0.0141, -0.5, 0.0093]), direction / np.linalg.norm(direction))


def test_starting_in_the_core_or_seeing_it_first_is_background_and_starting_in_the_shell_is_not() -> None:
    labels = np.full((5, 5, 5), shell.SHELL, np.uint8)
    labels[2, 2, 2] = shell.CORE
    labels[2, 2, :2] = shell.EMPTY
    grid, middle = shell.Grid(np.zeros(3), labels), 2.5 * shell.VOXEL_M
    origins = np.array([[middle, middle, middle], [middle, middle, -0.1], [middle, middle, 4.5 * shell.VOXEL_M]])
    directions = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, 0, -1.0]])
    found, count, met = shell.intervals(grid, origins, directions)
    assert count.tolist() == [0, 0, 1] and met.all()
    assert found[2, 0].tolist() == pytest.approx([0, 1.5 * shell.VOXEL_M])
    samples = shell.sample(found, count, 0.002, 8, None, met)
    assert set(samples.ray.tolist()) == {2} and samples.closed.tolist() == [False] * (len(samples.ray) - 1) + [True]
    depth = torch.from_numpy(samples.step_m * 100 + 20 * samples.closed)
    rendered, _ = composite(
        depth, torch.zeros(len(depth), 3), *(torch.from_numpy(samples[i]) for i in (0, 2, 3)), rays=3, background=1.0
    )
    assert (rendered.colour[:2] == 1).all() and (rendered.colour[2] < 1e-6).all()


@pytest.mark.parametrize("length", [1e-15, 1e-9, 1e-5, 0.0019999])
def test_one_sample_stands_for_all_of_a_short_stretch(length: float) -> None:
    found = np.zeros((1, shell.MAX_INTERVALS, 2))
    found[0, 0] = 0.7, 0.7 + length
    for jitter in (None, np.zeros((1, 4), np.float32), np.full((1, 4), 0.9999999, np.float32)):
        samples = shell.sample(found, np.array([1]), 0.002, 4, jitter, np.array([True]))
        assert samples.slot.tolist() == [0] and samples.closed.all()
        assert float(samples.step_m[0]) == pytest.approx(length, rel=1e-6, abs=3e-16)
        assert found[0, 0, 0] - 1e-7 <= samples.distance_m[0] <= found[0, 0, 1] + 1e-7
    tint, depth = torch.tensor([[0.2, 0.4, 0.6]]), torch.tensor([2.0])
    assert one_ray(depth, tint)[1].tolist() == pytest.approx((tint[0] * (1 - np.exp(-2)) + np.exp(-2)).tolist(), abs=1e-6)


def test_more_stretches_than_a_ray_keeps() -> None:
    """A comb: the first MAX_INTERVALS teeth, nothing written beyond, and no sample between teeth."""
    labels = np.zeros((1, 1, 60), np.uint8)
    labels[0, 0, ::2] = shell.SHELL
    found, met = cast(shell.Grid(np.zeros(3), labels), np.array([0.002, 0.002, -1.0]), np.array([0.0, 0, 1]))
    assert len(found) == shell.MAX_INTERVALS and not met
    np.testing.assert_allclose(found[:, 0], 1 + np.arange(shell.MAX_INTERVALS) * 2 * shell.VOXEL_M)
    samples = shell.sample(found[None], np.array([len(found)]), 0.001, 512, None)
    tooth = (samples.distance_m.astype(np.float64) - 1) / shell.VOXEL_M
    assert (tooth % 2 < 1 + 1e-4).all()
