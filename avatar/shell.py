"""Where samples are worth taking: a shell around the posed mesh, as a voxel grid, and ray samples inside it.

A voxel belongs to the shell when its centre is within a vertex's thickness of that vertex. Deep inside the rigid skull lies
the core, at which rays end: what a ray has not met before it is background, so training learns opaque fronts and nothing is
spent on the back of the head. Everything here is geometry without gradients, in numpy and numba, in the neck-normalised
head frame (metres).
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from scipy.spatial import cKDTree

EMPTY, SHELL, CORE = 0, 1, 2
VOXEL_M = 0.004
CORE_DEPTH_M = 0.025
REACH_M = 0.6  # nothing is modelled farther than this from the head's origin, whatever the expression codes
MAX_INTERVALS = 12


class Grid(NamedTuple):
    """Voxel labels of one posed head."""

    origin: np.ndarray  # [3] m, corner of voxel (0, 0, 0)
    labels: np.ndarray  # [X, Y, Z] uint8: EMPTY, SHELL or CORE


class PackedGrid(NamedTuple):
    """A grid in a quarter of its memory."""

    origin: np.ndarray  # [3] m
    shape: tuple[int, ...]
    bits: tuple[np.ndarray, np.ndarray]  # of SHELL and of CORE, [ceil(X Y Z / 8)] uint8 each


class Samples(NamedTuple):
    """P packed samples of N rays, rays in order, front to back on each."""

    distance_m: np.ndarray  # [P] float32 along the ray
    step_m: np.ndarray  # [P] float32 length of shell that the sample stands for
    ray: np.ndarray  # [P] int64
    slot: np.ndarray  # [P] int64 rank on its ray
    closed: np.ndarray  # [P] bool: the last sample of a ray that ends at the core; no light passes it


def core_points(vertices_m: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Voxel centres deep inside the neutral head: at least CORE_DEPTH_M from every vertex, behind those around.

    vertices_m, normals: [V, 3] of the neutral head, outward normals. Returns [Q, 3] float32 m.
    """
    low, high = vertices_m.min(0), vertices_m.max(0)
    axes = [np.arange(np.ceil(low[i] / VOXEL_M), np.floor(high[i] / VOXEL_M)) for i in range(3)]
    centres = (np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3) + 0.5) * VOXEL_M
    distance, nearest = cKDTree(vertices_m).query(centres, k=16)
    behind = ((centres[:, None] - vertices_m[nearest]) * normals[nearest]).sum(-1) < 0  # [Q, 16]
    return centres[(distance[:, 0] > CORE_DEPTH_M) & (behind.mean(1) > 0.9)].astype(np.float32)


def occupancy(vertices_m: np.ndarray, thickness_m: np.ndarray, core_m: np.ndarray) -> Grid:
    """The shell of one posed head.

    vertices_m: [V, 3]; thickness_m: [V]; core_m: [Q, 3] from `core_points`.
    The grid is aligned to multiples of VOXEL_M, so that a voxel is the same place in every frame.
    """
    reach = np.asarray(thickness_m, np.float64)[:, None]
    low = np.floor(np.clip((vertices_m - reach).min(0), -REACH_M, REACH_M) / VOXEL_M)
    high = np.ceil(np.clip((vertices_m + reach).max(0), -REACH_M, REACH_M) / VOXEL_M)
    shape = np.maximum(high - low, 1).astype(int)
    labels = np.zeros(tuple(shape), np.uint8)
    origin = low * VOXEL_M
    index = np.floor((core_m - origin) / VOXEL_M).astype(int)
    index = index[((index >= 0) & (index < shape)).all(1)]
    points, radii = np.asarray(vertices_m, np.float64) - origin, np.asarray(thickness_m, np.float64)
    _mark(labels, points, radii, VOXEL_M)
    labels[tuple(index.T)] = CORE  # thick hair reaches as far into the skull as out of it
    _mark(
        labels, points, np.minimum(radii, CORE_DEPTH_M), VOXEL_M
    )  # but a jaw that opens moves into the core of the neutral head
    return Grid(origin, labels)


def pack(grid: Grid) -> PackedGrid:
    """What `unpack` makes the same grid of."""
    return PackedGrid(grid.origin, grid.labels.shape, (np.packbits(grid.labels == SHELL), np.packbits(grid.labels == CORE)))


def unpack(packed: PackedGrid) -> Grid:
    """The grid of `pack`."""
    count = int(np.prod(packed.shape))
    inside, core = (np.unpackbits(bits, count=count) for bits in packed.bits)
    return Grid(packed.origin, (SHELL * inside + CORE * core).reshape(packed.shape))


@numba.njit(cache=True)
def _mark(labels, points, radii, voxel):  # noqa: ANN001, ANN202
    for v in range(points.shape[0]):
        radius = radii[v]
        low = np.empty(3, np.int64)
        high = np.empty(3, np.int64)
        for axis in range(3):
            low[axis] = max(0, int(np.floor((points[v, axis] - radius) / voxel)))
            high[axis] = min(labels.shape[axis] - 1, int(np.floor((points[v, axis] + radius) / voxel)))
        for x in range(low[0], high[0] + 1):
            dx = (x + 0.5) * voxel - points[v, 0]
            for y in range(low[1], high[1] + 1):
                dy = (y + 0.5) * voxel - points[v, 1]
                left = radius * radius - dx * dx - dy * dy
                if left < 0:
                    continue
                for z in range(low[2], high[2] + 1):
                    dz = (z + 0.5) * voxel - points[v, 2]
                    if dz * dz <= left:
                        labels[x, y, z] = SHELL


def intervals(
    grid: Grid, origins_m: np.ndarray, directions: np.ndarray, max_length_m: float = np.inf
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stretches of each ray inside the shell, front to back, until it meets the core.

    origins_m, directions: [N, 3], unit directions.
    max_length_m: stop after this much shell.
    Returns start and end [N, MAX_INTERVALS, 2] float64 m along the ray, count [N] int64, and whether the ray ended
    at the core [N] bool.
    """
    found = np.zeros((len(origins_m), MAX_INTERVALS, 2))
    count = np.zeros(len(origins_m), np.int64)
    met = np.zeros(len(origins_m), bool)
    _march(
        grid.labels,
        VOXEL_M,
        np.asarray(origins_m, np.float64) - grid.origin,
        np.asarray(directions, np.float64),
        max_length_m,
        found,
        count,
        met,
    )
    return found, count, met


@numba.njit(cache=True)
def _march(labels, voxel, origins, directions, max_length, found, count, met):  # noqa: ANN001, ANN202
    """Neighbouring shell voxels join into one interval."""
    start, stop, place = room(labels.shape)
    for n in range(origins.shape[0]):
        crossed, met[n] = cells(labels, voxel, origins[n], directions[n], max_length, start, stop, place)
        number = 0
        for i in range(crossed):
            if i == 0 or start[i] != stop[i - 1]:
                if number == found.shape[1]:
                    met[n] = False
                    break
                found[n, number, 0] = start[i]
                number += 1
            found[n, number - 1, 1] = stop[i]
        count[n] = number


@numba.njit(cache=True)
def room(shape):  # noqa: ANN001, ANN201
    """Arrays that `cells` fills, for a grid of a shape: no ray crosses more voxels."""
    size = shape[0] + shape[1] + shape[2] + 3
    return np.empty(size), np.empty(size), np.empty(size, np.int64)


@numba.njit(cache=True)
def cells(labels, voxel, origin, direction, max_length, start, stop, place):  # noqa: ANN001, ANN201
    """The shell's voxels that a ray crosses before the core or after `max_length` of shell: Amanatides-Woo traversal.

    origin, direction: [3], from the grid's corner. Fills start, stop (along the ray) and place (in the flattened labels).
    Returns their number and whether the ray ended at the core; where, is one more entry of start.
    Voxels that a ray only touches, at an edge or a corner, count for nothing: neither the core nor a gap.
    """
    shape = labels.shape
    cell = np.empty(3, np.int64)
    step = np.empty(3, np.int64)
    next_t = np.empty(3)
    delta = np.empty(3)
    enter, leave = 0.0, np.inf
    for axis in range(3):
        o, d = origin[axis], direction[axis]
        size = shape[axis] * voxel
        if abs(d) < 1e-12:
            if o < 0 or o >= size:
                leave = -1.0
        else:
            near, far = -o / d, (size - o) / d
            if near > far:
                near, far = far, near
            enter, leave = max(enter, near), min(leave, far)
    if leave <= enter:
        return 0, False
    for axis in range(3):
        o, d = origin[axis], direction[axis]
        at = o + enter * d
        cell[axis] = min(max(int(np.floor(at / voxel)), 0), shape[axis] - 1)
        if abs(d) < 1e-12:
            step[axis], next_t[axis], delta[axis] = 0, np.inf, np.inf
        elif d > 0:
            step[axis], delta[axis] = 1, voxel / d
            next_t[axis] = ((cell[axis] + 1) * voxel - o) / d
        else:
            step[axis], delta[axis] = -1, -voxel / d
            next_t[axis] = (cell[axis] * voxel - o) / d
    t, length, number = enter, 0.0, 0
    while True:
        label = labels[cell[0], cell[1], cell[2]]
        axis = 0
        if next_t[1] < next_t[axis]:
            axis = 1
        if next_t[2] < next_t[axis]:
            axis = 2
        after = min(max(next_t[axis], t), leave)
        if label == CORE and after > t:
            start[number] = t
            return number, True
        if label == SHELL and after > t:
            start[number], stop[number] = t, after
            place[number] = (cell[0] * shape[1] + cell[1]) * shape[2] + cell[2]
            number += 1
            length += after - t
            if length >= max_length:
                return number, False
        t = after
        cell[axis] += step[axis]
        if cell[axis] < 0 or cell[axis] >= shape[axis] or t >= leave:
            return number, False
        next_t[axis] += delta[axis]


def core_distance(grid: Grid, origins_m: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Metres [N] along each ray at which it meets the core, inf where it does not; arguments as of `intervals`."""
    distance = np.full(len(origins_m), np.inf)
    origins = np.asarray(origins_m, np.float64) - grid.origin
    _meet(grid.labels, VOXEL_M, origins, np.asarray(directions, np.float64), distance)
    return distance


@numba.njit(cache=True)
def _meet(labels, voxel, origins, directions, distance):  # noqa: ANN001, ANN202
    start, stop, place = room(labels.shape)
    for n in range(origins.shape[0]):
        crossed, met = cells(labels, voxel, origins[n], directions[n], np.inf, start, stop, place)
        if met:
            distance[n] = start[crossed]


def sample(
    found: np.ndarray,
    count: np.ndarray,
    step_m: float,
    max_samples: int,
    jitter: np.ndarray | None,
    met: np.ndarray | None = None,
) -> Samples:
    """Stratified samples over the length inside the intervals of each ray.

    found, count: from `intervals`; step_m: wanted length for one sample; max_samples: a ray's longest list, its step grows.
    jitter: [N, max_samples] in [0, 1) places each sample in its stratum; None takes the middles.
    met: [N] bool from `intervals`: rays whose last sample is closed; None closes none.
    """
    length = (found[..., 1] - found[..., 0]).sum(1)
    number = np.where(count > 0, np.clip(np.ceil(length / step_m), 1, max_samples), 0).astype(np.int64)
    total = int(number.sum())
    distance, step = np.empty(total, np.float32), np.empty(total, np.float32)
    ray, slot = np.empty(total, np.int64), np.empty(total, np.int64)
    _place(found, count, length, number, np.empty((0, 0), np.float32) if jitter is None else jitter, distance, step, ray, slot)
    closed = np.zeros(total, bool) if met is None else met[ray] & (slot == number[ray] - 1)
    return Samples(distance, step, ray, slot, closed)


@numba.njit(cache=True)
def _place(found, count, length, number, jitter, distance, step, ray, slot):  # noqa: ANN001, ANN202
    at = 0
    for n in range(number.shape[0]):
        if number[n] == 0:
            continue
        stratum = length[n] / number[n]
        interval, passed = 0, 0.0
        for s in range(number[n]):
            wanted = (s + (jitter[n, s] if jitter.shape[0] else 0.5)) * stratum
            while interval < count[n] - 1 and wanted > passed + found[n, interval, 1] - found[n, interval, 0]:
                passed += found[n, interval, 1] - found[n, interval, 0]
                interval += 1
            distance[at] = min(found[n, interval, 0] + wanted - passed, found[n, interval, 1])
            step[at] = stratum
            ray[at], slot[at] = n, s
            at += 1
