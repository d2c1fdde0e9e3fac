"""Where on each ray a picture's samples go: where the field's density at voxel centres says that light ends.

One evaluation of the field at the centre of each voxel of the shell that a ray can see, then every ray's samples between the
cells that matter to it; `marching` goes on where these leave light. Geometry without gradients, in numpy and numba. Letters: N
rays, P samples.
"""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np

from avatar import shell
from avatar.volume import Rays

UNKNOWN = np.float32(-1)  # density of a voxel that no ray was seen to need
AHEAD = 6  # voxels that a ray asks for at a time: 24 mm
LOOKS = 16384  # rays that look for voxels at a time
FAINT = 2e-4  # share of a ray's light below which a cell between two others like it is empty
# Samples follow the length by this part and the weights by the rest. nerface.mp4, three frames, dB to 0.5 mm steps in the shell:
# by half 52.1, by 0.7 52.4.
EVEN = 0.7
LEAST = 2 / 3  # samples on a ray that stops at a surface, as a part of the most


def seen_density(
    grid: shell.Grid, rays: Rays, density_at: Callable[[np.ndarray], np.ndarray], end: float
) -> tuple[np.ndarray, int]:
    """Density [X, Y, Z] per metre at the centres of the voxels that rays meet before less than `end` of the light is left.

    density_at: of points [P, 3]. UNKNOWN elsewhere. Returns it and the number of evaluations.
    """
    density, evaluations = np.full(grid.labels.shape, UNKNOWN), 0
    for first in range(0, len(rays.origins_m), LOOKS):
        origins, directions = (np.asarray(array[first : first + LOOKS], np.float64) for array in rays)
        origins = origins - grid.origin
        while len(origins):
            wanted, waiting = np.zeros(grid.labels.shape, bool), np.zeros(len(origins), bool)
            _look(grid.labels, shell.VOXEL_M, origins, directions, density, end, AHEAD, wanted, waiting)
            place = np.argwhere(wanted)
            if not len(place):
                break
            centres = ((place + 0.5) * shell.VOXEL_M + grid.origin).astype(np.float32)
            density[tuple(place.T)] = np.maximum(density_at(centres), 0)
            origins, directions, evaluations = origins[waiting], directions[waiting], evaluations + len(place)
    return density, evaluations


def guided(
    grid: shell.Grid, density: np.ndarray, rays: Rays, step_m: float, most: int, end: float
) -> tuple[shell.Samples, np.ndarray]:
    """Samples of each ray over the cells of the shell that hold its light or lie beside those, and where [N] m they stop.

    They stop before the shell does where the densities say that light has ended. A voxel's centre may know less than the ray:
    what light is left there by the samples themselves goes on. Infinite where they go on to the end of the shell or to the core.

    density: from `seen_density`; step_m: length for one sample, most: samples on a ray, at least LEAST of it on each.
    A sample stands for the length of shell around it, halfway in weight to its neighbours; the last one of a ray that the core
    ends is closed. Where the density is UNKNOWN a cell is kept.
    """
    size, least = len(rays.origins_m) * most, max(1, round(LEAST * most))
    distance, step = np.empty(size, np.float32), np.empty(size, np.float32)
    ray, slot, closed = np.empty(size, np.int64), np.empty(size, np.int64), np.zeros(size, bool)
    origins, directions = np.asarray(rays.origins_m, np.float64) - grid.origin, np.asarray(rays.directions, np.float64)
    arrays, stops = (distance, step, ray, slot, closed), np.full(len(origins), np.inf)
    count = _guide(grid.labels, shell.VOXEL_M, origins, directions, density, step_m, least, most, end, *arrays, stops)
    return shell.Samples(*(array[:count].copy() for array in arrays)), stops


@numba.njit(cache=True)
def _look(labels, voxel, origins, directions, density, end, ahead, wanted, waiting):  # noqa: ANN001, ANN202
    """Marks the next `ahead` voxels without density on each ray that has light there, and the rays that asked."""
    start, stop, place = shell.room(labels.shape)
    flat, wishes = density.reshape(-1), wanted.reshape(-1)
    for n in range(len(origins)):
        count, _ = shell.cells(labels, voxel, origins[n], directions[n], np.inf, start, stop, place)
        light, asked = 1.0, 0
        for i in range(count):
            if light < end or asked == ahead:
                break
            if flat[place[i]] < 0:
                wishes[place[i]] = True
                asked += 1
            else:
                light *= np.exp(-flat[place[i]] * (stop[i] - start[i]))
        waiting[n] = asked > 0


@numba.njit(cache=True)
def _guide(
    labels, voxel, origins, directions, density, step_m, least, most, end, distance, step, ray, slot, closed, stops
):  # fmt: skip # noqa: ANN001, ANN202
    start, stop, place = shell.room(labels.shape)
    weight, share, flat = np.empty(len(start)), np.empty(len(start)), density.reshape(-1)
    at = 0
    for n in range(len(origins)):
        count, met = shell.cells(labels, voxel, origins[n], directions[n], np.inf, start, stop, place)
        count, stopped = _shares(met, count, start, stop, place, flat, end, weight, share)
        stops[n] = stopped
        if not count:
            continue
        kept = 0.0
        for i in range(count):
            kept += stop[i] - start[i]
        number = min(max(int(np.ceil(kept / step_m)), least), most)
        i, passed = 0, 0.0  # the cell, and the share of those before it
        for s in range(number):
            middle, high = (s + 0.5) / number, (s + 1) / number
            stood, position = 0.0, -1.0
            low = s / number
            while True:
                edge = passed + share[i] if i < count - 1 else 2.0
                stood += max(min(edge, high) - max(low, passed), 0.0) / share[i] * (stop[i] - start[i])
                if position < 0 and middle <= edge:
                    position = start[i] + min((middle - passed) / share[i], 1.0) * (stop[i] - start[i])
                if high <= edge:
                    break
                passed, i = edge, i + 1
            distance[at], step[at], ray[at], slot[at] = position, stood, n, s
            closed[at] = met and stopped == np.inf and s == number - 1
            at += 1
    return at


@numba.njit(cache=True)
def _shares(met, count, start, stop, place, flat, end, weight, share):  # noqa: ANN001, ANN202
    """Keeps a ray's cells that hold light or lie beside such, in place, with the share of its samples.

    Returns their number and where they stop.
    """
    light, beyond, lit, stopped = 1.0, 0, 0, np.inf
    for i in range(count):
        density = flat[place[i]]
        through = np.exp(-density * (stop[i] - start[i])) if density >= 0 else 1.0
        weight[i] = light * (1 - through) if density >= 0 else 2 * FAINT
        light *= through
        lit = i + 1
        if light < end:
            beyond += 1
        if beyond == 2:  # one more than the cell in which light ended: its centre may lie behind the surface
            if lit < count:
                stopped = stop[i]
            break
    if met and lit and beyond < 2:
        weight[lit - 1] += light  # the core ends it
    kept, whole, total = 0, 0.0, 0.0
    for i in range(lit):
        widest = weight[i]
        if i:
            widest = max(widest, weight[i - 1])
        if i < lit - 1:
            widest = max(widest, weight[i + 1])
        if widest > FAINT:
            start[kept], stop[kept], share[kept] = start[i], stop[i], widest
            whole, total, kept = whole + stop[i] - start[i], total + widest, kept + 1
    for i in range(kept):
        share[i] = (1 - EVEN) * share[i] / total + EVEN * (stop[i] - start[i]) / whole
    return kept, stopped
