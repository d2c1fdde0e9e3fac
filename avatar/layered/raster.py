"""Which point of each surface a pixel sees: inverse depth and texture coordinates of a stack of meshes, each its own z-buffer.

All layers share triangles and texture coordinates; only their vertices differ.  On the CPU rows of the window are split among
the threads, and each thread draws every layer in its rows, span by span.  A span runs from one edge of a triangle to the next;
where an edge crosses a row is computed from the edge alone, always from its upper end, so that neighbours agree to the last
bit: a sample between them belongs to exactly one (left edges included, right ones not, likewise up and down).

A pixel has one sample, its centre, or two, the centres of its upper left and its lower right quarter, as two rows of the result.
Those double the work of the spans alone: triangles are a few pixels small, and most of what they cost is set up once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numba import njit
from torch import Tensor

from avatar.layered import threads

NEAR_M, FAR_M = 1e-3, 1e4  # triangles with a corner nearer to the camera's plane, or farther, are left out
FAR_PX = 1e5  # and those with a corner farther from the window, in columns or rows: there float32 has no pixels any more
CANDIDATES = 2**21  # pixels in triangles' boxes that the tensor path looks at in one go


class Fragments(NamedTuple):
    """What L layers show in a window of h x w pixels of S samples: arrays, or tensors of one device."""

    inverse_depth: np.ndarray  # [L, S h, w] float32 1/m, greater is nearer; 0 where a layer shows nothing
    uv: np.ndarray  # [L, S h, w, 2] float32, v upwards; without meaning where the inverse depth is 0


def empty(layers: int, height: int, width: int) -> Fragments:
    """Buffers for `rasterise`, to be used again from frame to frame; height: rows of samples."""
    return Fragments(np.zeros((layers, height, width), np.float32), np.zeros((layers, height, width, 2), np.float32))


def rasterise(
    points: np.ndarray,
    triangles: np.ndarray,
    corner_uv: np.ndarray,
    drawn: np.ndarray,
    window: tuple[int, int, int, int],
    out: Fragments | None = None,
    shares: int | None = None,
    samples: int = 1,
) -> Fragments:
    """Draw each layer's front faces, perspective-correct; the nearest triangle of a layer wins.

    Args:
        points: [L, V, 3] float32, each layer's vertices: x, y in pixels (centres at +0.5), z in metres along the optical axis.
        triangles: [F, 3] int32, outward by the right-hand rule in camera axes (OpenCV).
        corner_uv: [F, 3, 2] float32, texture coordinates of each triangle's corners.
        drawn: [L, F] bool, which triangles a layer draws.
        window: x, y of its first pixel, width and height.
        out: buffers to overwrite, as `empty` makes them.
        shares: bands of rows, each drawn by a thread; None: as many as `threads.count`. The result does not depend on it.
        samples: of a pixel, S = 1 or 2.

    Returns:
        the fragments, in `out` if given; sample s of a pixel in row y lies in row S y + s. Triangles with a
        corner behind the camera or with coordinates that are not finite are left out, those without an area too.

    Raises:
        ValueError: shapes do not fit each other, or `out` not the window, or so many samples are not known.
    """
    layers, (left, top, width, height) = len(points), window
    _check(points, triangles, corner_uv, drawn, samples)
    height = samples * height
    out = empty(layers, height, width) if out is None else out
    if out.inverse_depth.shape != (layers, height, width) or out.uv.shape != (layers, height, width, 2):
        raise ValueError(f"buffers of {out.inverse_depth.shape} do not fit {layers} layers of {height}x{width} pixels")
    bands = _bands(samples * (points[:, :, 1] - top), height, threads.count() if shares is None else shares)
    arrays = (
        np.ascontiguousarray(points, np.float32),
        np.ascontiguousarray(triangles, np.int32),
        np.ascontiguousarray(corner_uv, np.float32),
        np.ascontiguousarray(drawn, np.bool_),
    )
    buffers = out.inverse_depth.reshape(layers, -1), out.uv.reshape(layers, -1)
    place = float(left), float(top), samples
    threads.run(lambda i: _fill(*arrays, *place, bands[i], bands[i + 1], width, *buffers), len(bands) - 1)
    return out


def _check(points, triangles, corner_uv, drawn, samples) -> None:  # noqa: ANN001
    if samples not in (1, 2):
        raise ValueError(f"a pixel has one or two samples, not {samples}")
    layers, faces = len(points), len(triangles)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"points are [L, V, 3], found {tuple(points.shape)}")
    if tuple(triangles.shape) != (faces, 3) or tuple(corner_uv.shape) != (faces, 3, 2):
        raise ValueError(f"triangles [F, 3] and their corners' uv [F, 3, 2], found {triangles.shape} and {corner_uv.shape}")
    if tuple(drawn.shape) != (layers, faces):
        raise ValueError(f"{layers} layers of {faces} triangles need flags [{layers}, {faces}], found {tuple(drawn.shape)}")
    if faces and not 0 <= triangles.min() <= triangles.max() < points.shape[1]:
        raise ValueError(f"triangles name vertices {triangles.min()}..{triangles.max()} of {points.shape[1]}")


def _bands(rows: np.ndarray, height: int, shares: int) -> np.ndarray:
    """First row of each thread's band, and the end: about as many vertices [L, V] in each, [shares + 1] int64."""
    inside = rows[:, ::7][(rows[:, ::7] > 0) & (rows[:, ::7] < height)]
    if not len(inside):
        return np.array([0, height])
    cuts = np.quantile(inside, np.arange(1, shares) / shares).astype(np.int64) if shares > 1 else []
    return np.array([0, *cuts, height])


@njit(inline="always")
def _first_from(at, within, low, high):  # noqa: ANN001, ANN202
    """The first pixel from `low` to `high` whose sample, `within` of a pixel after its edge, lies at or after a coordinate."""
    return int(np.ceil(min(max(at - within, low), high)))


@njit(error_model="numpy", cache=True)
def _triangle(points, triangles, corner_uv, f, left, top, samples, first, end, width, depth, uv):  # noqa: ANN001, ANN202
    """Rows first..end, of samples, of one triangle. depth: [S h * w]; uv: [S h * w * 2]."""
    a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
    ya, yb, yc = samples * (points[a, 1] - top), samples * (points[b, 1] - top), samples * (points[c, 1] - top)
    if min(ya, yb, yc) > end or max(ya, yb, yc) < first:
        return
    xa, xb, xc = float(points[a, 0]) - left, float(points[b, 0]) - left, float(points[c, 0]) - left
    area = (xb - xa) * (yc - ya) - (yb - ya) * (xc - xa)
    if not area < 0.0:  # faces away, flat, or not a number
        return
    za, zb, zc = float(points[a, 2]), float(points[b, 2]), float(points[c, 2])
    if not (NEAR_M < za < FAR_M and NEAR_M < zb < FAR_M and NEAR_M < zc < FAR_M):
        return
    if not max(max(abs(xa), abs(xb), abs(xc)), max(abs(ya), abs(yb), abs(yc))) < FAR_PX:
        return
    x1, y1, x2, y2, x3, y3 = xa, ya, xb, yb, xc, yc  # from the top down
    if y2 < y1:
        x1, y1, x2, y2 = x2, y2, x1, y1
    if y3 < y2:
        x2, y2, x3, y3 = x3, y3, x2, y2
        if y2 < y1:
            x1, y1, x2, y2 = x2, y2, x1, y1
    row1, row2, row3 = _first_from(y1, 0.5, first, end), _first_from(y2, 0.5, first, end), _first_from(y3, 0.5, first, end)
    upper = 0.5 / samples  # where in its pixel the first sample lies, from the left; the second as far from the right
    leftmost, rightmost = min(xa, xb, xc), max(xa, xb, xc)
    if row3 <= row1 or _first_from(leftmost, 1 - upper, 0, width) >= _first_from(rightmost, upper, 0, width):
        return
    # 1/z, u/z and v/z are linear on the screen: value at corner a, then change a pixel to the right and a row down.
    ia, ib, ic, inverse_area = 1.0 / za, 1.0 / zb, 1.0 / zc, 1.0 / area
    bx, by, cx, cy = (xb - xa) * inverse_area, (yb - ya) * inverse_area, (xc - xa) * inverse_area, (yc - ya) * inverse_area
    ua, va = corner_uv[f, 0, 0] * ia, corner_uv[f, 0, 1] * ia
    db, dc = ib - ia, ic - ia
    z_right, z_down = db * cy - dc * by, dc * bx - db * cx
    db, dc = corner_uv[f, 1, 0] * ib - ua, corner_uv[f, 2, 0] * ic - ua
    u_right, u_down = db * cy - dc * by, dc * bx - db * cx
    db, dc = corner_uv[f, 1, 1] * ib - va, corner_uv[f, 2, 1] * ic - va
    v_right, v_down = db * cy - dc * by, dc * bx - db * cx
    z_step, u_step, v_step = np.float32(z_right), np.float32(u_right), np.float32(v_right)
    long_slope = (x3 - x1) / (y3 - y1)
    middle_right = (x2 - x1) * (y3 - y1) > (x3 - x1) * (y2 - y1)
    x_from, y_from, slope = x1, y1, (x2 - x1) / (y2 - y1)
    for row in range(row1, row3):
        y, within = row + 0.5, 1 - upper if row & 1 else upper  # with one sample both are its centre
        if row == row2:
            x_from, y_from, slope = x2, y2, (x3 - x2) / (y3 - y2)
        start, stop = x1 + (y - y1) * long_slope, x_from + (y - y_from) * slope
        if not middle_right:
            start, stop = stop, start
        begin, over = _first_from(start, within, 0, width), _first_from(stop, within, 0, width)
        if begin >= over:
            continue
        x, y, at = begin + within - xa, y - ya, row * width + begin
        z = np.float32(ia + x * z_right + y * z_down)
        u, v = np.float32(ua + x * u_right + y * u_down), np.float32(va + x * v_right + y * v_down)
        for i in range(over - begin):
            step = np.float32(i)
            nearness = z + step * z_step
            if nearness > depth[at + i]:
                depth[at + i] = nearness
                metres = np.float32(1) / nearness
                uv[2 * (at + i)] = (u + step * u_step) * metres
                uv[2 * (at + i) + 1] = (v + step * v_step) * metres


@njit(nogil=True, error_model="numpy", cache=True)
def _fill(points, triangles, corner_uv, drawn, left, top, samples, first, end, width, depth, uv):  # noqa: ANN001, ANN202
    """Rows first..end, of samples, of all layers. depth: [L, S h * w]; uv: [L, S h * w * 2]."""
    for layer in range(points.shape[0]):
        of_points, of_drawn, of_depth, of_uv = points[layer], drawn[layer], depth[layer], uv[layer]
        of_depth[first * width : end * width] = 0
        for f in range(triangles.shape[0]):
            if of_drawn[f]:
                _triangle(of_points, triangles, corner_uv, f, left, top, samples, first, end, width, of_depth, of_uv)


def rasterise_tensors(
    points: Tensor, triangles: Tensor, corner_uv: Tensor, drawn: Tensor, window: tuple[int, int, int, int], samples: int = 1
) -> Fragments:
    """`rasterise` in plain PyTorch, on the tensors' device: every pixel of every triangle's box is tried, without a loop.

    The same pixels are covered (edges are computed in float64 where the device has it), at several times the cost.
    Arguments, result and errors as there, but tensors.
    """
    _check(points, triangles, corner_uv, drawn, samples)
    layers, (left, top, width, height) = len(points), window
    height = samples * height
    real = torch.float32 if points.device.type == "mps" else torch.float64
    depth = points.new_zeros(layers * height * width, dtype=torch.float32)
    uv = points.new_zeros(layers * height * width, 2, dtype=torch.float32)
    for layer in range(layers):
        kept = torch.nonzero(drawn[layer])[:, 0]
        corners = points[layer][triangles[kept].long()].to(real)  # [F', 3, 3]
        xy, z = (corners[..., :2] - corners.new_tensor([left, top])) * corners.new_tensor([1, samples]), corners[..., 2]
        first, second = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
        area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        seen = (area < 0) & (z > NEAR_M).all(1) & (z < FAR_M).all(1) & (xy.abs() < FAR_PX).all((1, 2))
        xy, z, area, texture = xy[seen], z[seen], area[seen], corner_uv[kept[seen]].to(real)
        limits = xy.new_tensor([width, height])
        upper = 0.5 / samples
        low = torch.ceil((xy.amin(1) - xy.new_tensor([1 - upper, 0.5])).clamp_min(0).minimum(limits)).long()
        size = (torch.ceil((xy.amax(1) - xy.new_tensor([upper, 0.5])).clamp_min(0).minimum(limits)).long() - low).clamp_min(0)
        count = size[:, 0] * size[:, 1]
        chunk = torch.div(torch.cumsum(count, 0), CANDIDATES, rounding_mode="floor")
        start = layer * height * width
        area_of = slice(start, start + height * width)
        for part in torch.split(torch.arange(len(xy), device=xy.device), torch.bincount(chunk).tolist()):
            of = xy[part], z[part], area[part], texture[part], low[part], size[part]
            _boxes(*of, upper, width, depth[area_of], uv[area_of])
    return Fragments(depth.view(layers, height, width), uv.view(layers, height, width, 2))


def _crossing(upper: Tensor, lower: Tensor, y: Tensor) -> Tensor:
    """Column [P] where the edges from `upper` to `lower` [P, 2] cross the rows y [P]."""
    return upper[:, 0] + (y - upper[:, 1]) * ((lower[:, 0] - upper[:, 0]) / (lower[:, 1] - upper[:, 1]))


def _boxes(xy, z, area, texture, low, size, first_at, width, depth, uv) -> None:  # noqa: ANN001
    """Draw triangles xy [N, 3, 2], z [N, 3], area [N], texture [N, 3, 2] into depth [S h * w] and uv [S h * w, 2], in place."""
    count = size[:, 0] * size[:, 1]
    n = torch.repeat_interleave(torch.arange(len(xy), device=xy.device), count)  # [P] triangle of each candidate
    within = torch.arange(len(n), device=xy.device) - torch.repeat_interleave(torch.cumsum(count, 0) - count, count)
    column, row = low[n, 0] + within % size[n, 0], low[n, 1] + torch.div(within, size[n, 0], rounding_mode="floor")
    x, y = column + torch.where(row % 2 == 1, 1 - first_at, first_at).to(xy.dtype), row.to(xy.dtype) + 0.5
    order = torch.sort(xy[..., 1], dim=1, stable=True).indices
    upper, middle, lower = (xy[torch.arange(len(xy), device=xy.device), order[:, i]][n] for i in range(3))
    long = _crossing(upper, lower, y)
    short = torch.where(y < middle[:, 1], _crossing(upper, middle, y), _crossing(middle, lower, y))
    side = (middle - upper)[:, 0] * (lower - upper)[:, 1] > (lower - upper)[:, 0] * (middle - upper)[:, 1]
    start, stop = torch.where(side, long, short), torch.where(side, short, long)
    inside = (x >= start) & (x < stop) & (y >= upper[:, 1]) & (y < lower[:, 1])
    n, x, y, place = n[inside], x[inside], y[inside], (row * width + column)[inside]
    relative = torch.stack([x, y], -1) - xy[n, 0]
    first, second = (xy[n, 1] - xy[n, 0]) / area[n, None], (xy[n, 2] - xy[n, 0]) / area[n, None]
    weight_b = relative[:, 0] * second[:, 1] - relative[:, 1] * second[:, 0]
    weight_c = first[:, 0] * relative[:, 1] - first[:, 1] * relative[:, 0]
    weights = torch.stack([1 - weight_b - weight_c, weight_b, weight_c], -1) / z[n]
    inverse = weights.sum(1)
    nearness = inverse.to(depth.dtype)
    depth.scatter_reduce_(0, place, nearness, "amax")
    won = nearness >= depth[place]
    found = ((weights[:, :, None] * texture[n]).sum(1) / inverse[:, None]).to(uv.dtype)
    uv[place[won]] = found[won]
