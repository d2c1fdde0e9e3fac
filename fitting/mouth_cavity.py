"""A mouth cavity for a head model that has none, as a draft section of the MonoAvatar paper has it ("Improving Mouth Region").

Two anchor vertices, one on each side of the face, span a line behind the mouth; the innermost vertices lie on it, and rings
between them and the lips are interpolated.  Each new vertex is a fixed mean of existing vertices, so bases and skinning follow.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from fitting.chart import boundary_loops
from fitting.head_model import REGIONS, HeadModel

RINGS = 4  # from the lips, which stay, to the line
DEPTH_M = 0.045  # of the line behind the lips
NEAR_M = 0.012  # anchors are sought so near the line's height and depth
CHARTS_BELOW = 0.92  # the other charts' share of the square's height
STRIP = (0.16, 0.93, 0.68, 0.06)  # of the cavity: left, low, width, height


def add(head: HeadModel) -> HeadModel:
    """The head with its mouth's rim continued to a cavity, whose uvs are a strip above the other charts.

    Raises:
        ValueError: the mesh has no mouth opening, or no skin beside the line.
    """
    points, triangles = head.template.numpy().astype(np.float64), head.triangles.numpy()
    loops = boundary_loops(triangles)
    if len(loops) < 2:
        raise ValueError(f"the mesh has {len(loops)} openings; a mouth cavity needs an open mouth and an open neck")
    lips = min(loops, key=lambda loop: points[loop, 2].mean())
    mix = _mix(points, lips, _anchors(points, lips, head.region.numpy()))
    count, ring = head.vertex_count, len(lips)
    rows = np.concatenate([lips[None], count + np.arange(RINGS * ring).reshape(RINGS, ring)])
    uv_rows = len(head.uvs) + np.arange((RINGS + 1) * (ring + 1)).reshape(RINGS + 1, ring + 1)
    beside = np.concatenate([rows, rows[:, :1]], 1)
    u, v = np.meshgrid(np.linspace(0, 1, ring + 1), np.linspace(0, 1, RINGS + 1))
    strip = np.stack([STRIP[0] + STRIP[2] * u, STRIP[1] + STRIP[3] * v], -1).reshape(-1, 2)

    def carry(values: Tensor) -> Tensor:
        """Values [..., V, 3] with the new vertices' own appended."""
        flat = values.movedim(-2, 0).reshape(count, -1)
        new = torch.from_numpy((mix @ flat.numpy().astype(np.float64)).astype(np.float32))
        return torch.cat([values, new.reshape(len(new), *values.shape[:-2], 3).movedim(0, -2)], -2)

    weights = torch.from_numpy((mix @ head.skinning_weights.numpy().astype(np.float64)).astype(np.float32))
    cavity = torch.full((RINGS * ring,), REGIONS.index("mouth_cavity"), dtype=torch.int64)
    return dataclasses.replace(
        head,
        template=carry(head.template),
        shape_basis=carry(head.shape_basis),
        expression_basis=carry(head.expression_basis),
        pose_basis=carry(head.pose_basis),
        skinning_weights=torch.cat([head.skinning_weights, weights]),
        triangles=torch.cat([head.triangles, torch.from_numpy(_strips(beside))]),
        uvs=torch.cat([head.uvs * torch.tensor([1, CHARTS_BELOW]), torch.from_numpy(strip.astype(np.float32))]),
        uv_triangles=torch.cat([head.uv_triangles, torch.from_numpy(_strips(uv_rows))]),
        region=torch.cat([head.region, cavity]),
    )


def _anchors(points: np.ndarray, lips: np.ndarray, region: np.ndarray) -> tuple[int, int]:
    """Outermost skin vertices beside the line, on the subject's left and right."""
    height, depth = points[lips, 1].mean(), points[lips, 2].mean() + DEPTH_M
    near = (np.hypot(points[:, 1] - height, points[:, 2] - depth) < NEAR_M) & (region != REGIONS.index("eyeballs"))
    if not (near & (points[:, 0] > 0)).any() or not (near & (points[:, 0] < 0)).any():
        raise ValueError(f"no skin beside the mouth at y = {height:.3f} m, z = {depth:.3f} m")
    return int(np.where(near, points[:, 0], -np.inf).argmax()), int(np.where(near, points[:, 0], np.inf).argmin())


def _mix(points: np.ndarray, lips: np.ndarray, anchors: tuple[int, int]) -> sparse.csr_matrix:
    """Weights [N, V] of the new vertices, ring by ring inwards; a vertex on the line lies straight behind its lip vertex."""
    left, right = points[list(anchors), 0]
    share = np.clip((points[lips, 0] - right) / (left - right), 0, 1)  # of the left anchor
    mix = sparse.lil_matrix((RINGS * len(lips), len(points)))
    for ring in range(RINGS):
        inwards = (ring + 1) / RINGS
        for place, lip in enumerate(lips):
            row = ring * len(lips) + place
            for vertex, weight in zip(
                (lip, *anchors), (1 - inwards, inwards * share[place], inwards * (1 - share[place])), strict=True
            ):
                mix[row, vertex] += weight
    return mix.tocsr()


def _strips(rows: np.ndarray) -> np.ndarray:
    """Triangles between neighbouring rows [R + 1, C + 1] of indices, running against the skin's own edges at the lips."""
    a, b, inner_a, inner_b = rows[:-1, :-1], rows[:-1, 1:], rows[1:, :-1], rows[1:, 1:]
    return np.concatenate([np.stack(part, -1).reshape(-1, 3) for part in ((b, a, inner_a), (b, inner_a, inner_b))])
