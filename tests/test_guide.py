"""Samples where light ends: against a loop over every voxel, against even samples of the shell, and what is never missed."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from avatar import guide, sampling, shell
from avatar.marching import Marcher
from avatar.volume import Rays

FULL = 500.0  # optical depth 2 across a voxel


def grid_of(seed: int) -> tuple[shell.Grid, np.ndarray]:
    """A small grid of all three labels, and densities: a wall, faint hair before it, holes, and voxels nobody asked for."""
    random = np.random.default_rng(seed)
    labels = np.where(random.random((9, 7, 11)) < 0.8, shell.SHELL, shell.EMPTY).astype(np.uint8)
    labels[3:6, 2:5, 8:] = shell.CORE
    density = random.choice([0.0, 3.0, 60.0], labels.shape, p=[0.6, 0.3, 0.1]).astype(np.float32)
    density[:, :, 6] = FULL
    density[random.random(labels.shape) < 0.1] = guide.UNKNOWN
    return shell.Grid(np.array([0.1, -0.2, 0.3]), labels), density


def rays_through(grid: shell.Grid, count: int, seed: int) -> Rays:
    random = np.random.default_rng(seed)
    size = np.array(grid.labels.shape) * shell.VOXEL_M
    start = grid.origin + random.random((count, 3)) * size * (1.2, 1.2, 0) - (0, 0, 0.05)
    towards = grid.origin + random.random((count, 3)) * size
    directions = (towards - start) / np.linalg.norm(towards - start, axis=1, keepdims=True)
    return Rays(start.astype(np.float32), directions.astype(np.float32))


def crossed(grid: shell.Grid, origin: np.ndarray, direction: np.ndarray) -> tuple[list[tuple[float, float, tuple]], bool]:
    """Shell voxels of a ray with entry and exit, by a slab test with every voxel, as far as the core; whether that is met."""
    found = []
    for place in np.argwhere(grid.labels != shell.EMPTY):
        low = grid.origin + place * shell.VOXEL_M - origin
        with np.errstate(divide="ignore"):
            ends = np.stack([low / direction, (low + shell.VOXEL_M) / direction])
        enter, leave = max(ends.min(0).max(), 0.0), ends.max(0).min()
        if leave > enter + 1e-9:
            found.append((enter, leave, tuple(place)))
    found.sort()
    for i, (_, _, place) in enumerate(found):
        if grid.labels[place] == shell.CORE:
            return found[:i], True
    return found, False


def twin(grid: shell.Grid, density: np.ndarray, origin: np.ndarray, direction: np.ndarray, step: float, most: int, end: float):
    """Distances and steps of one ray in float64, cumulative shares inverted; whether it is closed, and where it stops."""
    cells, met = crossed(grid, origin.astype(np.float64), direction.astype(np.float64))
    light, beyond, weights, stopped = 1.0, 0, [], np.inf
    for enter, leave, place in cells:
        known = density[place] >= 0
        through = np.exp(-float(density[place]) * (leave - enter)) if known else 1.0
        weights.append(light * (1 - through) if known else 2 * guide.FAINT)
        light *= through
        beyond += light < end
        if beyond == 2:
            stopped = leave if len(weights) < len(cells) else np.inf
            break
    if met and weights and beyond < 2:
        weights[-1] += light
    widest = [max(weights[max(i - 1, 0) : i + 2]) for i in range(len(weights))]
    kept = [(cell, w) for cell, w in zip(cells, widest, strict=False) if w > guide.FAINT]
    if not kept:
        return np.zeros(0), np.zeros(0), False, stopped
    length = np.array([leave - enter for (enter, leave, _), _ in kept])
    share = np.array([w for _, w in kept])
    share = (1 - guide.EVEN) * share / share.sum() + guide.EVEN * length / length.sum()
    number = int(np.clip(np.ceil(length.sum() / step), max(1, round(guide.LEAST * most)), most))
    passed, run = np.concatenate([[0], np.cumsum(share)]), np.concatenate([[0], np.cumsum(length)])
    edges = np.interp(np.arange(number + 1) / number, passed, run)
    middles = np.interp((np.arange(number) + 0.5) / number, passed, run)
    cell = np.clip(np.searchsorted(run, middles) - 1, 0, len(kept) - 1)
    ends = met and stopped == np.inf
    return np.array([kept[c][0][0] + m - run[c] for c, m in zip(cell, middles, strict=True)]), np.diff(edges), ends, stopped


@pytest.mark.parametrize(("step", "most", "end"), [(0.001, 16, 0.004), (0.004, 5, 0.0), (0.1, 1, 0.3)])
def test_guided_samples_equal_a_loop_over_every_voxel(step: float, most: int, end: float) -> None:
    grid, density = grid_of(1)
    rays = rays_through(grid, 60, 2)
    samples, stops = guide.guided(grid, density, rays, step, most, end)
    hit = 0
    for n in range(60):
        distance, stretch, met, stopped = twin(grid, density, rays.origins_m[n], rays.directions[n], step, most, end)
        assert stops[n] == pytest.approx(stopped, abs=1e-6)
        mine = samples.ray == n
        np.testing.assert_allclose(samples.distance_m[mine], distance, atol=1e-6)
        np.testing.assert_allclose(samples.step_m[mine], stretch, atol=1e-6)
        assert (samples.slot[mine] == np.arange(mine.sum())).all()
        if mine.any():
            assert samples.closed[mine].tolist() == [False] * (mine.sum() - 1) + [met]
            hit += 1
    assert 30 < hit <= 60 and samples.closed.any() and not samples.closed.all()


def test_only_voxels_that_light_reaches_are_evaluated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guide, "LOOKS", 64)  # several lots of rays, all of which look
    grid, density = grid_of(3)
    density = np.maximum(density, 0)
    rays, asked = rays_through(grid, 400, 4), []

    def density_at(points: np.ndarray) -> np.ndarray:
        place = np.floor((points - grid.origin) / shell.VOXEL_M).astype(int)
        asked.extend(map(tuple, place))
        return density[tuple(place.T)]

    found, evaluations = guide.seen_density(grid, rays, density_at, 0.004)
    assert evaluations == len(asked) == len(set(asked)) and all(grid.labels[place] == shell.SHELL for place in asked)
    known = found >= 0
    assert (found[known] == density[known]).all() and (grid.labels == shell.SHELL).sum() > evaluations
    unbounded = guide.guided(grid, np.where(grid.labels == shell.SHELL, density, guide.UNKNOWN), rays, 0.001, 8, 0.004)[0]
    lazy = guide.guided(grid, found, rays, 0.001, 8, 0.004)[0]
    for one, other in zip(lazy, unbounded, strict=True):  # no ray needs a voxel that was not asked for
        np.testing.assert_array_equal(one, other)


def test_where_samples_stop_before_the_shell_does() -> None:
    labels = np.full((3, 1, 12), shell.SHELL, np.uint8)
    labels[1, 0, 10], labels[2, 0, 7:] = shell.CORE, shell.EMPTY
    density = np.zeros(labels.shape, np.float32)
    density[:, 0, 5] = 4 * FULL
    rays = Rays(
        np.array([[0.002, 0.002, -1], [0.006, 0.002, -1], [0.01, 0.002, -1]], np.float32), np.array([[0, 0, 1]] * 3, np.float32)
    )
    samples, stops = guide.guided(shell.Grid(np.zeros(3), labels), density, rays, 0.001, 8, 0.004)
    assert stops == pytest.approx([1 + 7 * shell.VOXEL_M, 1 + 7 * shell.VOXEL_M, np.inf])  # more shell behind; the shell's end
    assert samples.distance_m[samples.ray == 0].max() < stops[0] and not samples.closed.any()
    labels[1, 0, 7] = shell.CORE
    samples, stops = guide.guided(shell.Grid(np.zeros(3), labels), density, rays, 0.001, 8, 0.004)
    assert stops[1] == np.inf and samples.closed.sum() == 1 and samples.closed[samples.ray == 1][-1]  # as far as the core


def test_lone_voxels_and_their_neighbours_are_sampled_and_clear_air_is_not() -> None:
    labels = np.full((1, 1, 40), shell.SHELL, np.uint8)
    density = np.zeros(labels.shape, np.float32)
    density[0, 0, 20] = 1.0  # an optical depth of 0.004
    grid = shell.Grid(np.zeros(3), labels)
    rays = Rays(np.array([[0.002, 0.002, -1]], np.float32), np.array([[0, 0, 1]], np.float32))
    samples = guide.guided(grid, density, rays, 0.001, 64, 0.004)[0]
    inside = samples.distance_m - 1
    assert samples.step_m.sum() == pytest.approx(3 * shell.VOXEL_M, rel=1e-4)
    assert 19 * shell.VOXEL_M < inside.min() < inside.max() < 22 * shell.VOXEL_M
    assert not len(guide.guided(grid, np.zeros_like(density), rays, 0.001, 64, 0.004)[0].ray)


def test_a_smooth_surface_is_integrated_as_by_many_even_samples() -> None:
    """A wall of smooth density at slanted rays: opacity and mean depth of 12 guided samples against 4,000 even ones."""
    labels = np.full((20, 20, 30), shell.SHELL, np.uint8)
    grid = shell.Grid(np.zeros(3), labels)
    rays = rays_through(grid, 200, 5)

    def density_at(points: np.ndarray) -> np.ndarray:
        return 1500 / (1 + np.exp(-(points[:, 2] + 0.1 * points[:, 0] - 0.06) / 0.0015))

    def picture(samples: shell.Samples) -> tuple[np.ndarray, np.ndarray]:
        tau = density_at(sampling.pack(rays, samples).points_m) * samples.step_m
        opacity, depth = np.zeros(200), np.zeros(200)
        for n in range(200):
            mine = samples.ray == n
            before = np.concatenate([[0], np.cumsum(tau[mine])])
            weight = np.exp(-before[:-1]) - np.exp(-before[1:])
            opacity[n], depth[n] = weight.sum(), (weight * samples.distance_m[mine]).sum()
        return opacity, depth

    found, count, _ = shell.intervals(grid, rays.origins_m, rays.directions)
    exact = picture(shell.sample(found, count, 1e-5, 4000, None))
    quick = picture(guide.guided(grid, guide.seen_density(grid, rays, density_at, 0.004)[0], rays, 0.001, 12, 0.004)[0])
    assert exact[0].max() > 0.99 and np.abs(quick[0] - exact[0]).max() < 0.02
    full = exact[0] > 0.99
    assert np.abs(quick[1] - exact[1])[full].mean() < 2e-4


def test_no_rays_and_no_shell() -> None:
    grid, density = grid_of(6)
    none = Rays(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    assert guide.seen_density(grid, none, lambda points: points[:, 0], 0.004)[1] == 0
    assert not len(guide.guided(grid, density, none, 0.001, 8, 0.004)[0].ray)
    empty = shell.Grid(np.zeros(3), np.zeros((1, 1, 1), np.uint8))
    rays = rays_through(grid, 5, 0)
    assert guide.seen_density(empty, rays, lambda points: points[:, 0], 0.004)[1] == 0
    assert not len(guide.guided(empty, np.zeros((1, 1, 1), np.float32), rays, 0.001, 8, 0.004)[0].ray)


def test_light_that_is_left_where_samples_stop_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Voxel centres see an opaque fence through which the rays pass: what stands behind it is drawn all the same, and once."""
    labels = np.full((2, 1, 40), shell.SHELL, np.uint8)
    rays = Rays(np.array([[0.001, 0.002, -1], [0.006, 0.002, -1]], np.float32), np.array([[0, 0, 1]] * 2, np.float32))

    def evaluate(_: Marcher, points: np.ndarray, directions: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        fence = (np.abs(points[:, 0] % shell.VOXEL_M - 0.002) < 0.0005) & (points[:, 2] > 0.03) & (points[:, 2] < 0.05)
        haze, wall = 20.0 * (points[:, 2] < 0.08), points[:, 2] > 0.1
        colour = np.where(wall[:, None], (0.0, 0.5, 1.0), 0.25).astype(np.float32)
        return torch.from_numpy((1e4 * fence + haze + 300 * wall).astype(np.float32)), torch.from_numpy(colour)

    monkeypatch.setattr(Marcher, "evaluate", evaluate)
    avatar, posed = SimpleNamespace(step_m=0.0005, max_samples=600), SimpleNamespace(grids=[shell.Grid(np.zeros(3), labels)])
    marcher = Marcher(avatar, posed, torch.zeros(1, 1), torch.float32)
    found, evaluations = marcher.render(marcher.seen(rays)[0], rays)
    hidden, light = np.exp(-20 * 0.08), np.exp(-20 * 0.08 - 300 * 0.06)
    colour = (1 - hidden) * 0.25 + (hidden - light) * np.array([0, 0.5, 1]) + light
    assert found.opacity[0].item() == pytest.approx(1 - light, abs=1e-3) and found.opacity[1].item() == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(found.colour[0], colour, atol=0.02)
    np.testing.assert_allclose(found.colour[1], 0.25, atol=0.02)
    along = np.arange(0.00005, 0.16, 0.0001)
    tau = np.where(along < 0.08, 20, np.where(along > 0.1, 300, 0)) * 0.0001
    weight = np.exp(-np.concatenate([[0], np.cumsum(tau)[:-1]])) * (1 - np.exp(-tau))
    assert found.depth[0].item() == pytest.approx(1 + (weight * along).sum() / weight.sum(), abs=1e-3)
    assert evaluations < 400 * 2
