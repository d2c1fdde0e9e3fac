"""A head model with more or fewer vertices, to see what their number costs.

More: the longest edges are halved. Fewer: the shortest ones that can go are taken out, one end staying where it is. What a vertex
has (bases, skinning, texture coordinates) is the mean of two or stays. Letters as in `fitting.head_model`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree

from fitting.head_model import HeadModel

LEAST_TURN = 0.2  # cosine between a triangle's normals before and after: below it the surface folds


@dataclass
class Mesh:
    """Corners by vertex and by texture vertex, and how each comes from the old ones."""

    triangles: np.ndarray  # [F, 3] int64
    uv_triangles: np.ndarray  # [F, 3] int64
    mix: sparse.csr_matrix  # [V, old V], rows sum to 1
    uv_mix: sparse.csr_matrix  # [U, old U]

    def points(self, template: np.ndarray) -> np.ndarray:
        """[V, 3] m."""
        return self.mix @ template


def resampled(head: HeadModel, vertices: int) -> HeadModel:
    """The head with about as many vertices: a pass that would go beyond the number stops there.

    Landmarks move to the nearest vertex, which is enough to find mouth and eyes.
    Raises ValueError when the mesh cannot be made that coarse.
    """
    template = head.template.double().cpu().numpy()
    count, uvs = len(template), len(head.uvs)
    corners = (part.cpu().numpy() for part in (head.triangles, head.uv_triangles))
    mesh = Mesh(*corners, sparse.identity(count, format="csr"), sparse.identity(uvs, format="csr"))
    flat = head.uvs.double().cpu().numpy()
    while mesh.mix.shape[0] != vertices:
        before = mesh.mix.shape[0]
        missing = vertices - before
        mesh = refined(mesh, template, missing) if missing > 0 else coarsened(mesh, template, flat, -missing)
        if mesh.mix.shape[0] == before:
            raise ValueError(f"{head.name}: the mesh has no {vertices} vertices: it stays at {before}")
    return carried(head, mesh)


def edges_of(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges [n, 2], each once, lower end first, and the edge [F, 3] that leaves each corner."""
    corners = np.stack([triangles, np.roll(triangles, -1, 1)], -1).reshape(-1, 2)
    edges, inverse = np.unique(np.sort(corners, 1), axis=0, return_inverse=True)
    return edges, inverse.reshape(-1, 3)


def refined(mesh: Mesh, template: np.ndarray, wanted: int) -> Mesh:
    """The longest edges halved, at most one a triangle and `wanted` in all."""
    points = mesh.points(template)
    edges, of_corner = edges_of(mesh.triangles)
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    longest = of_corner[np.arange(len(of_corner)), length[of_corner].argmax(1)]
    around = np.bincount(of_corner.ravel(), minlength=len(edges))
    chosen = np.flatnonzero(np.bincount(longest, minlength=len(edges)) == around)  # the longest of all triangles beside it
    chosen = chosen[np.argsort(-length[chosen], kind="stable")][:wanted]
    number = np.full(len(edges), -1)
    number[chosen] = len(points) + np.arange(len(chosen))
    face, corner = np.nonzero(number[of_corner] >= 0)
    turned = (corner[:, None] + np.arange(3)) % 3  # corners a, b, c with the edge between a and b
    a, b, c = mesh.triangles[face[:, None], turned].T
    ua, ub, uc = mesh.uv_triangles[face[:, None], turned].T
    middle = number[of_corner[face, corner]]
    pairs, uv_number = np.unique(np.sort(np.stack([ua, ub], -1), 1), axis=0, return_inverse=True)
    uv_middle = mesh.uv_mix.shape[0] + uv_number.ravel()
    kept = np.ones(len(mesh.triangles), bool)
    kept[face] = False

    def split(old: np.ndarray, first: np.ndarray, second: np.ndarray, third: np.ndarray, new: np.ndarray) -> np.ndarray:
        return np.concatenate([old[kept], np.stack([first, new, third], 1), np.stack([new, second, third], 1)])

    return Mesh(
        split(mesh.triangles, a, b, c, middle),
        split(mesh.uv_triangles, ua, ub, uc, uv_middle),
        halves(mesh.mix, edges[chosen]),
        halves(mesh.uv_mix, pairs),
    )


def halves(mix: sparse.csr_matrix, pairs: np.ndarray) -> sparse.csr_matrix:
    """The rows and the means of pairs of them."""
    return sparse.vstack([mix, (mix[pairs[:, 0]] + mix[pairs[:, 1]]) / 2], format="csr")


def coarsened(mesh: Mesh, template: np.ndarray, flat: np.ndarray, wanted: int) -> Mesh:
    """The shortest edges taken out, far enough from each other in one pass, and at most `wanted`. flat: [old U, 2] UVs."""
    points, triangles, uvs = mesh.points(template), mesh.triangles, mesh.uv_mix @ flat
    edges, of_corner = edges_of(triangles)
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    rim = np.zeros(len(points), bool)
    rim[edges[np.bincount(of_corner.ravel(), minlength=len(edges)) != 2]] = True
    copies = np.unique(np.stack([triangles.ravel(), mesh.uv_triangles.ravel()], 1), axis=0)
    rim |= np.bincount(copies[:, 0], minlength=len(points)) > 1  # a seam stays
    around = [set() for _ in points]
    for first, second in edges:
        around[first].add(second), around[second].add(first)
    of_vertex = sparse.csr_matrix(
        (np.ones(triangles.size), (triangles.ravel(), np.repeat(np.arange(len(triangles)), 3))), (len(points), len(triangles))
    )
    touched, goes_to = np.zeros(len(points), bool), np.arange(len(points))
    left = wanted
    for place in np.argsort(length, kind="stable"):
        if not left:
            break
        for gone, stays in (edges[place], edges[place][::-1]):
            ring = around[gone] | {gone}
            if rim[gone] or touched[list(ring)].any() or len(around[gone] & around[stays]) != 2:
                continue
            faces = of_vertex.indices[of_vertex.indptr[gone] : of_vertex.indptr[gone + 1]]
            if folds(points, triangles[faces], gone, stays):
                continue
            if crosses(uvs, triangles[faces], mesh.uv_triangles[faces], gone, stays):
                continue
            goes_to[gone], left = stays, left - 1
            touched[list(ring)] = True
            break
    return joined(mesh, goes_to)


def folds(points: np.ndarray, triangles: np.ndarray, gone: int, stays: int) -> bool:
    """Whether a triangle turns over, or its area vanishes, when vertex `gone` goes to `stays`."""
    rest = triangles[~(triangles == stays).any(1)]
    before, after = points[rest], points[np.where(rest == gone, stays, rest)]
    normals = [np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]) for c in (before, after)]
    sizes = np.linalg.norm(normals[0], axis=1) * np.linalg.norm(normals[1], axis=1)
    return bool(((normals[0] * normals[1]).sum(1) <= LEAST_TURN * sizes).any())


def crosses(uvs: np.ndarray, triangles: np.ndarray, uv_triangles: np.ndarray, gone: int, stays: int) -> bool:
    """Whether the chart around vertex `gone` would fold when it goes to `stays`, or `stays` lies on it more than once."""
    beside = (triangles == stays).any(1)
    there, here = np.unique(uv_triangles[beside][triangles[beside] == stays]), uv_triangles[triangles == gone][0]
    if len(there) > 1:
        return True
    rest = uv_triangles[~beside]
    areas = []
    for corners in (uvs[rest], uvs[np.where(rest == here, there[0], rest)]):
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        areas.append(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    return bool((areas[0] * areas[1] < 0).any())


def joined(mesh: Mesh, goes_to: np.ndarray) -> Mesh:
    """The mesh with vertices [V] joined to others; a joined vertex's texture coordinate is the other's beside it."""
    triangles, uvs = mesh.triangles, mesh.uv_triangles
    uv_goes_to = np.arange(mesh.uv_mix.shape[0])
    for first, second in ((0, 1), (1, 2), (2, 0), (1, 0), (2, 1), (0, 2)):
        along = goes_to[triangles[:, first]] == triangles[:, second]
        uv_goes_to[uvs[along, first]] = uvs[along, second]
    moved, moved_uvs = goes_to[triangles], uv_goes_to[uvs]
    whole = (moved != np.roll(moved, 1, 1)).all(1)
    used, compact = np.unique(moved[whole], return_inverse=True)
    used_uvs, compact_uvs = np.unique(moved_uvs[whole], return_inverse=True)
    return Mesh(compact.reshape(-1, 3), compact_uvs.reshape(-1, 3), mesh.mix[used], mesh.uv_mix[used_uvs])


def carried(head: HeadModel, mesh: Mesh) -> HeadModel:
    """The head model on another mesh."""

    def along(basis: torch.Tensor) -> torch.Tensor:  # [n, V, 3]
        rows = basis.double().cpu().numpy().transpose(1, 0, 2).reshape(basis.shape[1], -1)
        mixed = (mesh.mix @ rows).reshape(mesh.mix.shape[0], len(basis), 3).transpose(1, 0, 2)
        return torch.from_numpy(np.ascontiguousarray(mixed)).to(basis)

    mixed = lambda values, mix: torch.from_numpy(mix @ values.double().cpu().numpy()).to(values)  # noqa: E731
    template = mixed(head.template, mesh.mix)
    first = np.asarray(mesh.mix.argmax(1)).ravel()
    triangles = torch.from_numpy(mesh.triangles)
    placed, barycentric = landmarks(head, template.double().numpy(), mesh.triangles)
    made = replace(
        head,
        template=template,
        shape_basis=along(head.shape_basis),
        expression_basis=along(head.expression_basis),
        pose_basis=along(head.pose_basis) if len(head.pose_basis) else head.pose_basis.new_zeros(0, len(template), 3),
        skinning_weights=mixed(head.skinning_weights, mesh.mix),
        triangles=triangles,
        uvs=mixed(head.uvs, mesh.uv_mix),
        uv_triangles=torch.from_numpy(mesh.uv_triangles),
        region=head.region[torch.from_numpy(first)],
        landmark_triangles=placed,
        landmark_barycentric=barycentric.to(head.landmark_barycentric),
        name=f"{head.name}_{len(template)}",
    )
    return replace(made, digest=made.content_digest())


def landmarks(head: HeadModel, template: np.ndarray, triangles: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Triangle [L] and barycentric [L, 3] of the vertex nearest to each landmark; -1 where there was none."""
    known = head.landmark_triangles.cpu().numpy() >= 0
    points = head.landmarks(head.template).double().cpu().numpy()
    placed, barycentric = np.full(len(known), -1), np.zeros((len(known), 3))
    if known.any():
        used = np.unique(triangles)
        nearest = used[cKDTree(template[used]).query(points[known])[1]]
        of_vertex = np.zeros(len(template), np.int64)
        of_vertex[triangles.ravel()] = np.arange(triangles.size)
        placed[known], corner = of_vertex[nearest] // 3, of_vertex[nearest] % 3
        barycentric[np.flatnonzero(known), corner] = 1
    return torch.from_numpy(placed), torch.from_numpy(barycentric)
