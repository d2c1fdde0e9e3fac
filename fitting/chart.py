"""Texture charts of a mesh that has none: each component cut open at the back and laid flat without a fold.

A plain cylindrical projection would fold at ears, nostrils, lips and eye sockets, so that one texel would have to serve several
places.  So the cut and the outline are those of a cylinder (seam at the back, crown on top, neck below) and the inside is
solved: every vertex is a positive mean of its neighbours, which cannot fold inside a convex outline (Tutte 1963; mean value
weights, Floater 2003).  Weights are then divided by the local stretch, a few times (Yoshizawa 2004), so that the face is not
squeezed by the far outline.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph, linalg

ROUNDS = 6  # of stretch correction; the best round is kept
MIDLINE_M = 0.01  # the seam's length counts twice this far from the symmetry plane
SKIN_HEIGHT = 0.84  # of the square; eyeballs and mouth cavity lie above
CORNER = 0.13  # side of an eyeball's square


def components(triangles: np.ndarray, count: int) -> np.ndarray:
    """Connected component [V] of each of `count` vertices, joined by triangles [F, 3]."""
    ends = triangles[:, [0, 1]].T, triangles[:, [1, 2]].T
    first, second = (np.concatenate(pair) for pair in zip(*ends, strict=True))
    graph = sparse.coo_matrix((np.ones(len(first)), (first, second)), (count, count))
    return csgraph.connected_components(graph, directed=False)[1]


def directed_edges(triangles: np.ndarray) -> np.ndarray:
    """[3 F, 2] edges as the triangles run through them."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def boundary_loops(triangles: np.ndarray) -> list[np.ndarray]:
    """Vertices of each boundary loop, in the direction of the triangles' own edges."""
    edges = directed_edges(triangles)
    size = int(triangles.max()) + 1
    code, opposite = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    following = dict(edges[~np.isin(code, opposite)].tolist())
    loops = []
    while following:
        start = vertex = next(iter(following))
        loop = []
        while vertex in following:
            loop.append(vertex)
            vertex = following.pop(vertex)
        if vertex != start:
            raise ValueError(f"the boundary through vertex {start} is not a loop")
        loops.append(np.array(loop))
    return loops


def layout(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Charts of a head: the largest component below, the others in the corners above it.

    Args:
        points: [V, 3] m in our axes (y down, face along -z); triangles: [F, 3].

    Returns:
        uvs [U, 2] in [0, 1], v upwards; uv_triangles [F, 3].

    Raises:
        ValueError: more than three components, or one that cannot be cut open to a disk.
    """
    part = components(triangles, len(points))[triangles[:, 0]]
    labels, sizes = np.unique(part, return_counts=True)
    if len(labels) > 3:
        raise ValueError(f"the mesh has {len(labels)} components, expected skin and two eyeballs")
    uvs, uv_triangles, used = [], np.zeros_like(triangles), 0
    low = [(0.01, 0.01), (0.01, 0.99 - CORNER), (0.99 - CORNER, 0.99 - CORNER)]
    size = [(0.98, SKIN_HEIGHT - 0.01), (CORNER, CORNER), (CORNER, CORNER)]
    for place, label in enumerate(labels[np.argsort(-sizes, kind="stable")]):
        rows = part == label
        flat, corners = unwrap(points, triangles[rows])
        uvs.append(np.array(low[place]) + flat * size[place])
        uv_triangles[rows] = corners + used
        used += len(flat)
    return np.concatenate(uvs), uv_triangles


def unwrap(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One component, cut open at the back, as a flat disk: uvs [U, 2] in [0, 1], uv_triangles [F, 3]."""
    path = _seam(points, triangles)
    corners = _cut(triangles, path)
    where = np.zeros(corners.max() + 1, np.int64)
    where[corners] = triangles
    solid = points[where]
    loops = boundary_loops(corners)
    outer = next((k for k, loop in enumerate(loops) if path[0] in where[loop]), None)
    if outer is None:
        raise ValueError("the seam does not open the mesh")
    rim = loops.pop(outer)
    rim = np.roll(rim, -int(np.flatnonzero(where[rim] == path[0])[0]))
    filled = [corners]  # a hole, such as the mouth, is closed by a fan while the chart is solved
    for loop in loops:
        filled.append(np.stack([np.roll(loop, -1), loop, np.full_like(loop, len(solid))], 1))
        solid = np.concatenate([solid, points[where[loop]].mean(0)[None]])
    euler = len(solid) - len(np.unique(np.sort(directed_edges(np.concatenate(filled)), 1), axis=0)) + sum(map(len, filled))
    if euler != 1:
        raise ValueError(f"the mesh cannot be laid flat: Euler characteristic {euler} after the cut, expected 1")
    flat = _solve(solid, np.concatenate(filled), rim)[: len(where)]
    return (flat + 1) / 2, corners


def _seam(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Vertices of the cut: from the top down the back, to the lowest opening's rearmost vertex or to the bottom."""
    used = np.unique(triangles)
    top = used[points[used, 1].argmin()]
    loops = boundary_loops(triangles)
    if loops:
        rim = max(loops, key=lambda loop: points[loop, 1].mean())
        stops = [top, rim[points[rim, 2].argmax()]]
    else:
        stops = [top, used[points[used, 2].argmax()], used[points[used, 1].argmax()]]
    edges = np.unique(np.sort(directed_edges(triangles), 1), axis=0)
    middle = points[edges].mean(1)
    aside = np.abs(middle[:, 0] - points[top, 0]) / MIDLINE_M
    front = np.clip((np.median(points[used, 2]) - middle[:, 2]) / MIDLINE_M, 0, None)
    cost = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1) * (1 + aside + 10 * front)
    graph = sparse.coo_matrix((cost, (edges[:, 0], edges[:, 1])), (len(points), len(points))).tocsr()
    path = [stops[0]]
    for start, end in zip(stops[:-1], stops[1:], strict=True):
        before = csgraph.dijkstra(graph, directed=False, indices=start, return_predecessors=True)[1]
        leg = [end]
        while leg[-1] != start:
            leg.append(before[leg[-1]])
        path += leg[-2::-1]
    return np.array(path)


def _cut(triangles: np.ndarray, path: np.ndarray) -> np.ndarray:
    """[F, 3] triangles over new vertices: corners are one vertex when triangles that meet in an uncut edge share it."""
    size = int(triangles.max()) + 1
    edges = directed_edges(triangles)
    count = len(triangles)
    corner = np.arange(3 * count).reshape(count, 3)
    ends = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    code = edges[:, 0] * size + edges[:, 1]
    order = np.argsort(code)
    other = order[np.searchsorted(code, edges[:, 1] * size + edges[:, 0], sorter=order).clip(max=len(order) - 1)]
    shared = (edges[other, 0] == edges[:, 1]) & (edges[other, 1] == edges[:, 0])
    low, high = np.minimum(path[:-1], path[1:]), np.maximum(path[:-1], path[1:])
    shared &= ~np.isin(edges.min(1) * size + edges.max(1), low * size + high)
    joined = np.concatenate([np.stack([ends[shared, k], ends[other[shared], 1 - k]], 1) for k in (0, 1)])
    graph = sparse.coo_matrix((np.ones(len(joined)), joined.T), (3 * count, 3 * count))
    return csgraph.connected_components(graph, directed=False)[1].reshape(count, 3).astype(np.int64)


def _outline(lengths: np.ndarray) -> np.ndarray:
    """Points [R, 2] on a rounded square around the origin at the given steps along it, the first in the middle of its top."""
    way = np.concatenate([[0], np.cumsum(lengths[:-1])]) / lengths.sum() * 8
    corners = np.array([[0, 1], [-1, 1], [-1, -1], [1, -1], [1, 1], [0, 1]], float)  # the way that triangles run
    square = np.stack([np.interp(way, [0, 1, 3, 5, 7, 8], corners[:, axis]) for axis in (0, 1)], 1)
    return square / (square**4).sum(1, keepdims=True) ** 0.25  # no three points in a line: a triangle of them would vanish


def _solve(solid: np.ndarray, triangles: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Flat positions [U, 2] of vertices [U, 3] m with the rim on the outline, of least stretch over the rounds."""
    step = np.linalg.norm(solid[rim] - solid[np.roll(rim, -1)], axis=1)
    outline = _outline(np.maximum(step, 1e-3 * step.mean()))
    row, column, weight = _mean_value_weights(solid, triangles)
    inner = np.setdiff1d(np.arange(len(solid)), rim)
    stretch, best = np.ones(len(solid)), (np.inf, None)
    for _ in range(ROUNDS):
        scaled = sparse.coo_matrix((weight / stretch[column], (row, column)), (len(solid),) * 2).tocsr()
        scaled = sparse.diags(1 / np.asarray(scaled.sum(1)).ravel()) @ scaled
        flat = np.zeros((len(solid), 2))
        flat[rim] = outline
        system = sparse.identity(len(inner), format="csc") - scaled[inner][:, inner].tocsc()
        flat[inner] = linalg.splu(system).solve(scaled[inner][:, rim] @ outline)
        total, local = _stretch(solid, triangles, flat)
        if total >= best[0]:
            break
        best = total, flat
        stretch = stretch * np.sqrt(local)
        stretch /= np.exp(np.log(stretch).mean())
    return best[1]


def _mean_value_weights(solid: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and weight of each corner's pull on the two other corners of its triangle: tan(angle / 2) / distance."""
    rows, columns, weights = [], [], []
    for k in range(3):
        i, a, b = (triangles[:, (k + j) % 3] for j in range(3))
        to_a, to_b = solid[a] - solid[i], solid[b] - solid[i]
        far_a, far_b = (np.maximum(np.linalg.norm(way, axis=1), 1e-7) for way in (to_a, to_b))
        angle = np.arccos(np.clip((to_a * to_b).sum(1) / (far_a * far_b), -0.999, 0.999))
        rows += [i, i]
        columns += [a, b]
        weights += [np.tan(angle / 2) / far_a, np.tan(angle / 2) / far_b]
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(weights)


def _stretch(solid: np.ndarray, triangles: np.ndarray, flat: np.ndarray) -> tuple[float, np.ndarray]:
    """Root mean square stretch from the chart to the surface (Sander 2001): of all, and around each vertex [U]."""
    first, second = (solid[triangles[:, k]] - solid[triangles[:, 0]] for k in (1, 2))
    (a, c), (b, d) = ((flat[triangles[:, k]] - flat[triangles[:, 0]]).T for k in (1, 2))
    area = np.maximum(np.linalg.norm(np.cross(first, second), axis=1), 1e-12)
    across = a * d - b * c
    across = np.where(np.abs(across) < 1e-12, 1e-12, across)
    along_u = (first * d[:, None] - second * c[:, None]) / across[:, None]
    along_v = (second * a[:, None] - first * b[:, None]) / across[:, None]
    squared = ((along_u**2).sum(1) + (along_v**2).sum(1)) / 2
    total = np.sqrt((area * squared).sum() / area.sum())
    around = np.bincount(triangles.T.ravel(), np.tile(area * squared, 3), len(solid))
    return float(total), np.sqrt(around / np.bincount(triangles.T.ravel(), np.tile(area, 3), len(solid))) / total
