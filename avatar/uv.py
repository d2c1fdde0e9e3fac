"""Vertex attributes in UV space and back: triangles rasterised once, then a gather each way.

Texel (row r, column c) of an H x W map has its centre at u = (c + 0.5) / W, v = 1 - (r + 0.5) / H (v upwards).
Scattering vertices to texels would lose those that share one; triangles are rasterised instead, and a vertex with several
UVs (a seam) reads the mean of its copies.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy import ndimage, sparse
from torch import Tensor, nn
from torch.nn import functional

MAIN_CHART = 0.8  # of the square's height, when there are other charts
GUTTER = 0.012  # around each chart
FLAT = 1e-6  # twice the area in texels below which a triangle covers nothing; the coordinates' rounding makes up to 1e-10


def rasterise(uvs: np.ndarray, uv_triangles: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Which triangle covers each texel's centre, and where in it; empty texels take their nearest covered neighbour's.

    uvs: [U, 2] in [0, 1]; uv_triangles: [F, 3] into uvs, either winding; size: texels a side.
    Returns triangle [size, size] int64 and barycentric [size, size, 3] float64.
    Where triangles overlap the one of the lowest index stays. Raises ValueError when no texel is covered.
    """
    corners = np.asarray(uvs, np.float64)[uv_triangles]
    corners = np.stack([corners[..., 0] * size - 0.5, (1 - corners[..., 1]) * size - 0.5], -1)  # [F, 3, 2] column, row
    triangle = np.full((size, size), -1, np.int64)
    barycentric = np.zeros((size, size, 3))
    low = np.clip(np.ceil(corners.min(1) - 1e-9), 0, size).astype(int)
    high = np.clip(np.floor(corners.max(1) + 1e-9), -1, size - 1).astype(int)
    for index in range(len(corners) - 1, -1, -1):
        a, b, c = corners[index]
        doubled_area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if abs(doubled_area) < FLAT or (high[index] < low[index]).any():
            continue
        columns, rows = np.meshgrid(np.arange(low[index, 0], high[index, 0] + 1), np.arange(low[index, 1], high[index, 1] + 1))
        second = ((columns - a[0]) * (c[1] - a[1]) - (rows - a[1]) * (c[0] - a[0])) / doubled_area
        third = ((b[0] - a[0]) * (rows - a[1]) - (b[1] - a[1]) * (columns - a[0])) / doubled_area
        weights = np.stack([1 - second - third, second, third], -1)
        inside = (weights >= -1e-9).all(-1)
        triangle[rows[inside], columns[inside]] = index
        barycentric[rows[inside], columns[inside]] = weights[inside]
    if (triangle < 0).all():
        raise ValueError("no texel of the UV map is covered by a triangle")
    row, column = ndimage.distance_transform_edt(triangle < 0, return_distances=False, return_indices=True)
    return triangle[row, column], barycentric[row, column]


def pack(uvs: np.ndarray, uv_triangles: np.ndarray) -> np.ndarray:
    """The same charts laid out to fill the square: the largest below, stretched to it, the others side by side above.

    The head takes a fifth of the default model's square; packed, a map of 64 texels resolves it like one of 150.
    uvs: [U, 2]; uv_triangles: [F, 3]. Returns [U, 2] in [0, 1]. Charts are sets of triangles joined by UV vertices.
    """
    uvs = np.asarray(uvs, np.float64)
    ends = uv_triangles[:, [0, 1, 2]].ravel(), uv_triangles[:, [1, 2, 0]].ravel()
    chart = sparse.csgraph.connected_components(sparse.coo_matrix((np.ones(len(ends[0])), ends), (len(uvs), len(uvs))), False)[1]
    used = np.unique(chart[uv_triangles])
    low = np.array([uvs[chart == c].min(0) for c in used])
    extent = np.maximum(np.array([uvs[chart == c].max(0) for c in used]) - low, 1e-9)
    order = np.argsort(-extent.prod(1), kind="stable")
    widths = np.sqrt(extent.prod(1))[order[1:]]
    split = MAIN_CHART if len(order) > 1 else 1.0
    left = np.concatenate([[0.0], np.cumsum(widths) / max(widths.sum(), 1e-9)])
    packed = uvs.copy()
    for rank, place in enumerate(order):
        box = np.array([0, 0, 1, split]) if rank == 0 else np.array([left[rank - 1], split, left[rank], 1])
        inner, size = box[:2] + GUTTER, np.maximum(box[2:] - box[:2] - 2 * GUTTER, 1e-3)
        members = chart == used[place]
        packed[members] = inner + (uvs[members] - low[place]) / extent[place] * size
    return packed


class UVMap(nn.Module):
    """The two gathers between the vertices of one mesh and one UV resolution."""

    def __init__(self, uvs: Tensor, uv_triangles: Tensor, triangles: Tensor, vertex_count: int, size: int) -> None:
        """uvs: [U, 2]; uv_triangles, triangles: [F, 3] into uvs and into vertices; size: texels a side."""
        super().__init__()
        dtype, uvs = uvs.dtype, torch.from_numpy(pack(uvs.cpu().numpy(), uv_triangles.cpu().numpy()))
        face, barycentric = rasterise(uvs.numpy(), uv_triangles.cpu().numpy(), size)
        corners = triangles.cpu()[torch.from_numpy(face)]  # [size, size, 3] vertices
        copies = torch.unique(torch.stack([triangles.cpu().flatten(), uv_triangles.cpu().flatten()], 1), dim=0)
        copies = copies[torch.argsort(copies[:, 0], stable=True)]
        count = torch.bincount(copies[:, 0], minlength=vertex_count)
        grid = torch.stack([uvs[copies[:, 1], 0] * 2 - 1, 1 - uvs[copies[:, 1], 1] * 2], -1)
        self.register_buffer("corners", corners, persistent=False)
        self.register_buffer("barycentric", torch.from_numpy(barycentric).to(dtype), persistent=False)
        self.register_buffer("grid", grid.to(dtype), persistent=False)  # [copies, 2] as grid_sample wants it
        self.register_buffer("copy_vertex", copies[:, 0], persistent=False)
        self.register_buffer("copy_weight", (1 / count.clamp_min(1))[copies[:, 0]].to(dtype), persistent=False)
        self.vertex_count = vertex_count

    def to_map(self, attributes: Tensor) -> Tensor:
        """attributes: [B, V, C]. Returns [B, C, H, W], interpolated over the triangles."""
        corners = attributes[:, self.corners]  # [B, H, W, 3, C]
        return (corners * self.barycentric[..., None]).sum(3).permute(0, 3, 1, 2)

    def at_vertices(self, maps: Tensor) -> Tensor:
        """maps: [B, C, H, W]. Returns [B, V, C]: bilinear at the UVs of each vertex, mean over its copies; 0 without any."""
        grid = self.grid[None, None].expand(len(maps), -1, -1, -1).to(maps.dtype)
        read = functional.grid_sample(maps, grid, mode="bilinear", padding_mode="border", align_corners=False)
        read = read[:, :, 0].transpose(1, 2) * self.copy_weight[:, None].to(maps.dtype)  # [B, copies, C]
        empty = read.new_zeros(len(maps), self.vertex_count, maps.shape[1])
        return empty.index_add(1, self.copy_vertex, read)
