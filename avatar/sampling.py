"""Where along the rays the field is asked: packed samples in the shell, or the paper's dense and hierarchical ones.

Geometry without gradients, in numpy. Letters: N rays, P samples, S samples a ray.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from avatar import shell
from avatar.volume import Rays

MARGIN_M = 0.08  # hair and beard stand off the mesh by no more (as `coverage.LARGEST_M`)
OUTSIDE_SLOT = -1
BESIDE_M = 0.04
FLOOR = 1e-5  # of the weights that importance sampling follows (NeRF's), so that no stratum is ever without a chance


class Packed(NamedTuple):
    """P samples of the rays of several posed heads, rays in order, front to back on each."""

    points_m: np.ndarray  # [P, 3] float32
    directions: np.ndarray  # [P, 3] float32, unit
    distance_m: np.ndarray  # [P] float32 along the ray
    step_m: np.ndarray  # [P] float32 length that the sample stands for
    ray: np.ndarray  # [P] int64 over all heads
    slot: np.ndarray  # [P] int64 rank on its ray
    closed: np.ndarray  # [P] bool: no light passes this sample
    head: np.ndarray  # [P] int64


def pack(rays: Rays, samples: shell.Samples, head: int = 0, first_ray: int = 0) -> Packed:
    """Samples of one head's rays as points; first_ray: number of this head's first ray among all heads' rays."""
    points = rays.origins_m[samples.ray] + samples.distance_m[:, None] * rays.directions[samples.ray]
    heads = np.full(len(samples.ray), head, np.int64)
    return Packed(points, rays.directions[samples.ray], *samples[:2], samples.ray + first_ray, *samples[3:], heads)


def join(parts: list[Packed]) -> Packed:
    """The samples of several heads as one batch."""
    return Packed(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def in_shell(grid: shell.Grid, rays: Rays, step_m: float, most: int, jitter: np.ndarray | None) -> shell.Samples:
    """Stratified samples inside the shell; a ray that ends at the core is closed. jitter: [N, most] or None."""
    found, count, met = shell.intervals(grid, rays.origins_m, rays.directions)
    return shell.sample(found, count, step_m, most, jitter, met)


def bounds(vertices_m: np.ndarray, origins_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Near and far [N] m of dense sampling, for rays from `origins_m` [N, 3]: where a sphere around the head begins and ends.

    The sphere holds the posed vertices [V, 3] and MARGIN_M more; like the shell it ends at `shell.REACH_M` whatever the codes.
    The paper leaves the bounds silent; from the posed head of each frame they hold at any distance from the camera.
    """
    centre, radius = ball(vertices_m)
    away = np.linalg.norm(origins_m - centre, axis=1)
    return np.maximum(away - radius, 0), away + radius


def ball(vertices_m: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre [3] and radius in m of the sphere in which `bounds` looks."""
    within = np.clip(vertices_m.astype(np.float64), -shell.REACH_M, shell.REACH_M)
    centre = within.mean(0)
    return centre, float(np.linalg.norm(within - centre, axis=1).max() + MARGIN_M)


def outside(grid: shell.Grid, vertices_m: np.ndarray, numbers: np.ndarray, head: int = 0, core: cKDTree | None = None) -> Packed:
    """Points of the sphere of `bounds` that lie neither in the shell nor beneath it; on no ray: slot OUTSIDE_SLOT.

    numbers: [M, 3] in [0, 1), for a point each: every second is spread evenly over the sphere, the others lie up to BESIDE_M
    from a vertex, where the field has most to forget. They are seen along no direction. core: tree of the core's points: what
    lies between shell and core is skull, and no ray of training may have asked for it.
    """
    centre, radius = ball(vertices_m)
    height, turn = 2 * numbers[:, 1] - 1, 2 * np.pi * numbers[:, 2]
    flat = np.sqrt(1 - height**2)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], 1)
    points = centre + radius * np.cbrt(numbers[:, :1]) * directions
    vertex, away = np.divmod(numbers[1::2, :1] * np.float64(len(vertices_m)), 1)
    points[1::2] = vertices_m[vertex[:, 0].astype(np.int64)] + BESIDE_M * away * directions[1::2]
    voxel = np.floor((points - grid.origin) / shell.VOXEL_M)
    empty = ~((voxel >= 0) & (voxel < grid.labels.shape)).all(1)
    empty[~empty] = grid.labels[tuple(voxel[~empty].astype(np.int64).T)] == shell.EMPTY
    if core is not None:
        empty[empty] = core.query(points[empty], distance_upper_bound=shell.CORE_DEPTH_M)[0] > shell.CORE_DEPTH_M
    points, count = points[empty].astype(np.float32), int(empty.sum())
    zeros, none = np.zeros(count, np.float32), np.zeros(count, np.int64)
    return Packed(points, np.zeros_like(points), zeros, zeros, none, none + OUTSIDE_SLOT, none > 0, none + head)


def uniform(near_m: np.ndarray, far_m: np.ndarray, count: int, jitter: np.ndarray | None) -> shell.Samples:
    """`count` stratified samples between near and far [N] of every ray; jitter: [N, count] in [0, 1) or None (middles)."""
    offset = np.full((len(near_m), count), 0.5, np.float32) if jitter is None else jitter
    step = (far_m - near_m) / count
    return _flat(near_m[:, None] + (np.arange(count) + offset) * step[:, None], np.broadcast_to(step[:, None], offset.shape))


def ended(grid: shell.Grid, rays: Rays, samples: shell.Samples) -> shell.Samples:
    """Samples of whole rays with those behind the core's front closed: the core is part of what the field was trained with."""
    behind = samples.distance_m >= shell.core_distance(grid, rays.origins_m, rays.directions)[samples.ray]
    return samples._replace(closed=samples.closed | behind)


def by_weight(
    near_m: np.ndarray, far_m: np.ndarray, coarse_m: np.ndarray, weights: np.ndarray, count: int, jitter: np.ndarray | None
) -> shell.Samples:
    """The coarse samples and `count` more a ray, drawn where the coarse network saw something (NeRF, section 5.2).

    near_m, far_m: [N]; coarse_m: [N, S] distances, one in each of S equal strata; weights: [N, S] of the coarse rendering.
    jitter: [N, count] in [0, 1) or None (middles). The density is constant inside a stratum. A sample stands for the
    stretch halfway to its neighbours, the first and last to the bounds: the steps of a ray add up to far - near.
    """
    strata = weights.shape[1]
    offset = np.full((len(near_m), count), 0.5) if jitter is None else jitter
    wanted = (np.arange(count) + offset) / count  # [N, count] rising
    cumulative = np.cumsum(weights.astype(np.float64) + FLOOR, 1)
    cumulative = np.concatenate([np.zeros((len(near_m), 1)), cumulative / cumulative[:, -1:]], 1)  # [N, S + 1]
    # One search for all rays: ray n's values lie in [n, n + 1].
    lift = np.arange(len(near_m))[:, None]
    place = np.searchsorted((cumulative[:, 1:] + lift).ravel(), (wanted + lift).ravel(), side="right")
    stratum = np.clip(place.reshape(wanted.shape) - lift * strata, 0, strata - 1)
    low, high = np.take_along_axis(cumulative, stratum, 1), np.take_along_axis(cumulative, stratum + 1, 1)
    inside = np.clip((wanted - low) / np.maximum(high - low, 1e-12), 0, 1)
    width = (far_m - near_m)[:, None] / strata
    distance = np.sort(np.concatenate([coarse_m, near_m[:, None] + (stratum + inside) * width], 1), 1)
    edges = np.concatenate([near_m[:, None], (distance[:, 1:] + distance[:, :-1]) / 2, far_m[:, None]], 1)
    return _flat(distance, np.diff(edges, axis=1))


def median_samples(weights: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """The sample of each ray at which half of its rendering weight is reached.

    weights: [P] >= 0; ray: [P] of packed samples, in order. Returns indices into them, one for each ray that has samples.
    """
    if not len(ray):
        return np.zeros(0, np.int64)
    first = np.flatnonzero(np.diff(ray, prepend=-1))
    last = np.append(first[1:], len(ray)) - 1
    cumulative = np.cumsum(weights, dtype=np.float64)
    before = np.concatenate([[0.0], cumulative])[first]
    return np.clip(np.searchsorted(cumulative, (before + cumulative[last]) / 2), first, last)


def _flat(distance: np.ndarray, step: np.ndarray) -> shell.Samples:
    """Dense samples [N, S] as packed ones; none is closed and none lies at infinity."""
    rays, count = distance.shape
    ray, slot = np.divmod(np.arange(rays * count), max(count, 1))
    return shell.Samples(
        distance.astype(np.float32).ravel(), step.astype(np.float32).ravel(), ray, slot, np.zeros(len(ray), bool)
    )
