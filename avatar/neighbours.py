"""The k nearest vertices of many points, exactly: a tree on CPU, blocked brute force elsewhere; and which may be read together.

Plain k-NN reads upper and lower lip at once in a fifth of the queries at a closed mouth, lid and eyeball in a tenth (measured on
FLAME), both lids in two thirds of those at a shut eye's seam (default head). `surface_mates` says which vertices belong together
along the mesh; `keep_mates` leaves a point those of its candidates that belong to its nearest vertex. On CPU the tree takes
0.7 us a query in the shell on one core; a numba cell grid was tried and took 1.0 us.
"""

from __future__ import annotations

from collections.abc import Sequence

import numba
import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from torch import Tensor

from fitting.head_model import HeadModel

BLOCK = 1 << 22  # pairs per block of the brute-force search
DETOUR, SLACK_M = 3.0, 0.003  # mates: the way along the mesh is at most DETOUR times the straight one plus SLACK_M
FARTHEST_M = 0.05  # along the mesh; vertices farther apart than this are no mates
LIDS = ("eyeBlinkLeft", "eyeBlinkRight", "eyelid_left", "eyelid_right")  # the actions of either head model that shut the eyes
ROWS = 512  # of the table of ways at a time


def tree_of(vertices_m: np.ndarray) -> cKDTree:
    """Search tree over one posed head's vertices [V, 3]; made in a millisecond, it lives for one step or one image."""
    return cKDTree(vertices_m)


def nearest_by_tree(tree: cKDTree, points_m: np.ndarray, k: int, workers: int = 1) -> np.ndarray:
    """points_m: [P, 3]. Returns [P, K] int64 indices of the k nearest vertices, nearest first."""
    index = tree.query(points_m, k=k, workers=workers)[1]
    return index.reshape(len(points_m), k).astype(np.int64)


def nearest_by_blocks(vertices_m: Tensor, points_m: Tensor, k: int) -> Tensor:
    """The same by brute force in blocks, for devices that have no tree. Returns [P, K] int64."""
    rows = max(1, BLOCK // len(vertices_m))
    found = [
        torch.cdist(block, vertices_m, compute_mode="donot_use_mm_for_euclid_dist").topk(k, largest=False).indices
        for block in points_m.split(rows)
    ]
    return torch.cat(found) if found else torch.empty(0, k, dtype=torch.int64, device=points_m.device)


def resting_and_shut(head: HeadModel) -> tuple[np.ndarray, np.ndarray]:
    """The template [V, 3] m, mouth closed and eyes open, and the same with its lids shut."""
    shut = [place for place, name in enumerate(head.expression_names) if name in LIDS]
    template = head.template.double().cpu().numpy()
    return template, template + head.expression_basis[shut].double().cpu().numpy().sum(0)


def surface_mates(poses_m: Sequence[np.ndarray], triangles: np.ndarray) -> np.ndarray:
    """Which vertices lie on the same piece of surface, seen from each of them.

    poses_m: [V, 3] each, the head at rest first, then poses in which other parts of it touch; triangles: [F, 3].
    Returns [V, V] bool, symmetric, true on the diagonal: the shortest way along edges at rest is at most DETOUR times the
    straight one, in whichever pose that is shortest, plus SLACK_M (and FARTHEST_M). Upper and lower lip are no mates though
    they touch, nor are the lids with each other or with the eyeball.
    """
    rest, count = np.asarray(poses_m[0]), len(poses_m[0])
    ends = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    ends = np.unique(np.sort(ends, 1), axis=0)
    length = np.maximum(np.linalg.norm(rest[ends[:, 0]] - rest[ends[:, 1]], axis=1), 1e-9)  # 0 would mean no edge
    graph = sparse.csr_matrix((length, (ends[:, 0], ends[:, 1])), (count, count))
    mates = np.zeros((count, count), bool)
    for start in range(0, count, ROWS):
        rows = np.arange(start, min(start + ROWS, count))
        way = dijkstra(graph, directed=False, indices=rows, limit=FARTHEST_M)
        here, there = np.nonzero(np.isfinite(way))
        straight = np.min([np.linalg.norm(pose[rows[here]] - pose[there], axis=1) for pose in poses_m], axis=0)
        near = way[here, there] <= DETOUR * straight + SLACK_M
        mates[rows[here[near]], there[near]] = True
    return mates


def nearest_mates(tree: cKDTree, points_m: np.ndarray, k: int, most: int, mates: np.ndarray, workers: int = 1) -> np.ndarray:
    """The k nearest mates of each point's nearest vertex, among its `most` nearest vertices: `keep_mates` of all of these.

    Where the k nearest are mates they are the answer (19 of 20 points), found in half the time of a search for `most`.
    """
    found = nearest_by_tree(tree, points_m, k, workers)
    mixed = np.flatnonzero(~all_mates(found, mates))
    if len(mixed) and k > 1:
        found[mixed] = keep_mates(nearest_by_tree(tree, points_m[mixed], most, workers), mates, k)
    return found


@numba.njit(cache=True)
def all_mates(index: np.ndarray, mates: np.ndarray) -> np.ndarray:
    """Whether all of [P, K] vertices are mates of the first: [P] bool."""
    result = np.ones(index.shape[0], np.bool_)
    for p in range(index.shape[0]):
        for k in range(1, index.shape[1]):
            result[p] &= mates[index[p, 0], index[p, k]]
    return result


@numba.njit(cache=True)
def keep_mates(index: np.ndarray, mates: np.ndarray, k: int) -> np.ndarray:
    """The first k candidates of each point that are mates of its nearest vertex.

    index: [P, M] candidates, nearest first, M >= k; mates: [V, V] from `surface_mates`.
    Returns [P, k]; where fewer are left, the nearest one stands again in the free places.
    """
    kept = np.empty((index.shape[0], k), np.int64)
    for p in range(index.shape[0]):
        nearest, number = index[p, 0], 0
        for m in range(index.shape[1]):
            if number < k and mates[nearest, index[p, m]]:
                kept[p, number] = index[p, m]
                number += 1
        kept[p, number:] = nearest
    return kept
