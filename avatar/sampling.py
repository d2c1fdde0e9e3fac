"""Where along the rays the field is asked: packed samples in the shell, or the paper's dense and hierarchical ones.

Geometry without gradients, in numpy. Letters: N rays, P samples, S samples a ray.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from avatar import shell
from avatar.volume import Rays

MARGIN_M = 0.08  # hair and beard stand off the mesh by no more (as `coverage.LARGEST_M`)
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
    within = np.clip(vertices_m.astype(np.float64), -shell.REACH_M, shell.REACH_M)
    centre = within.mean(0)
    radius = np.linalg.norm(within - centre, axis=1).max() + MARGIN_M
    away = np.linalg.norm(origins_m - centre, axis=1)
    return np.maximum(away - radius, 0), away + radius


def uniform(near_m: np.ndarray, far_m: np.ndarray, count: int, jitter: np.ndarray | None) -> shell.Samples:
    """`count` stratified samples between near and far [N] of every ray; jitter: [N, count] in [0, 1) or None (middles)."""
    offset = np.full((len(near_m), count), 0.5, np.float32) if jitter is None else jitter
    step = (far_m - near_m) / count
    return _flat(near_m[:, None] + (np.arange(count) + offset) * step[:, None], np.broadcast_to(step[:, None], offset.shape))


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


def refine(
    found: np.ndarray, count: np.ndarray, coarse: shell.Samples, weights: np.ndarray, met: np.ndarray
) -> tuple[shell.Samples, np.ndarray]:
    """The samples in the middles of a shell's strata, and as many more on each ray where these saw something.

    found, count, met: from `shell.intervals`; coarse: P samples without jitter; weights: [P] of their rendering.
    The new ones invert the coarse weights' distribution, constant inside a stratum, at evenly spaced levels. A sample stands
    for the stretch of shell halfway to its neighbours; the last one of a ray that ends at the core is closed.
    Returns 2 P samples, and for each its place among the coarse ones, or -1 for a new one.
    """
    size = 2 * len(coarse.ray)
    distance, step = np.empty(size, np.float32), np.empty(size, np.float32)
    ray, slot, old = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    arrays = np.asarray(coarse.step_m, np.float64), coarse.ray, np.asarray(weights, np.float64)
    _refine(found, count, *arrays, distance, step, ray, slot, old)
    last = np.append(ray[1:] != ray[:-1], True) if size else np.zeros(0, bool)
    return shell.Samples(distance, step, ray, slot, last & met[ray]), old


@numba.njit(cache=True)
def _refine(found, count, stratum, rays, weights, distance, step, ray, slot, old):  # noqa: ANN001, ANN202
    first, at = 0, 0
    while first < len(rays):
        n, last = rays[first], first
        while last < len(rays) and rays[last] == n:
            last += 1
        number, width = last - first, stratum[first]
        total = 0.0
        for i in range(first, last):
            total += weights[i] + FLOOR
        along = np.empty(2 * number)  # in the shell, from its start
        passed, bin_, drawn, taken = 0.0, 0, 0, 0
        for rank in range(2 * number):
            fine = np.inf
            if drawn < number:
                wanted = (drawn + 0.5) / number * total
                while bin_ < number - 1 and passed + weights[first + bin_] + FLOOR < wanted:
                    passed += weights[first + bin_] + FLOOR
                    bin_ += 1
                fine = (bin_ + min(max((wanted - passed) / (weights[first + bin_] + FLOOR), 0.0), 1.0)) * width
            middle = (taken + 0.5) * width if taken < number else np.inf
            if middle <= fine:
                along[rank], old[at + rank], taken = middle, first + taken, taken + 1
            else:
                along[rank], old[at + rank], drawn = fine, -1, drawn + 1
        interval, before = 0, 0.0
        for rank in range(2 * number):
            low = (along[rank] + along[rank - 1]) / 2 if rank else 0.0
            high = (along[rank] + along[rank + 1]) / 2 if rank < 2 * number - 1 else number * width
            while interval < count[n] - 1 and along[rank] > before + found[n, interval, 1] - found[n, interval, 0]:
                before += found[n, interval, 1] - found[n, interval, 0]
                interval += 1
            distance[at + rank] = min(found[n, interval, 0] + along[rank] - before, found[n, interval, 1])
            step[at + rank], ray[at + rank], slot[at + rank] = high - low, n, rank
        at, first = at + 2 * number, last


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
