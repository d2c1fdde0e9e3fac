"""Where each part of the head lies in the textures: the head model's charts, packed and stretched to where detail is looked at.

The skin's triangles fill the square of every shell, the inner parts (eyeballs, mouth cavity, teeth, tongue) that of their own
layer.
Texel (row r, column c) of an R x R texture has its centre at u = (c + 0.5) / R, v = 1 - (r + 0.5) / R, as in `avatar.uv`.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from avatar.layered.shells import inner_triangles, lids_and_lips
from avatar.uv import pack
from fitting.head_model import REGIONS, HeadModel
from fitting.landmark_model import EYES, LIPS

# Texels a millimetre, relative to each other: lids, lips and eyeballs are small, and what people look at.
WANTED = {"face": 1.5, "ears": 1.2, "eyeballs": 2.5, "scalp": 0.8, "neck": 0.7}
LOOKED_AT, LOOKED_AT_M = 3.0, 0.012  # around lids and lips
MAGNIFIED = {"eyes": 1.6, "mouth": 0.9}  # how much larger the middle of an eye or of the mouth becomes, before the stretch
AROUND = 1.6  # the magnification's reach, in half-diagonals of the landmarks' box
BINS, SMOOTH = 256, 3.0  # of the stretch along an axis, and its Gaussian blur in bins
HIGH = 0.8  # quantile of the triangles across a bin that get what they want
LEAST = 0.15  # of the mean: no row or column vanishes
ROUNDS = 3  # the axes depend on each other


def layout(head: HeadModel) -> np.ndarray:
    """Texture coordinates [F, 3, 2] float32 in [0, 1] of the triangles' corners.

    Skin and inner parts by themselves: charts as `avatar.uv.pack` lays them out, then each axis stretched by a monotone function,
    so that a chart stays a chart and nothing overlaps that did not.
    """
    triangles, uv_triangles = head.triangles.cpu().numpy(), head.uv_triangles.cpu().numpy()
    points, uvs, inner = head.template.double().cpu().numpy(), head.uvs.double().cpu().numpy(), inner_triangles(head)
    wanted = np.array([WANTED.get(name, 1.0) for name in REGIONS])[head.region.cpu().numpy()[triangles[:, 0]]]
    if len(marks := lids_and_lips(head)):
        near = cKDTree(marks).query(points[triangles].mean(1))[0] < LOOKED_AT_M
        wanted = np.where(near, LOOKED_AT, wanted)
    placed = np.zeros((*triangles.shape, 2), np.float32)
    for part in (~inner, inner):
        if part.any():
            corners = pack(uvs, uv_triangles[part])[uv_triangles[part]]
            if part is not inner:
                corners = _closer(head, uvs, uv_triangles, part, corners)
            placed[part] = stretched(corners, points[triangles[part]], wanted[part])
    return placed


def magnified(points: np.ndarray, centre: np.ndarray, reach: np.ndarray, gain: float) -> np.ndarray:
    """Points [..., 2] moved away from a centre [2]: the middle grows 1 + gain times, far away nothing moves.

    reach: [2], the magnification's half axes. Along a ray r becomes r (1 + gain exp(-r^2)), which rises for any gain below 2.2.
    """
    offset = points - centre
    return centre + offset * (1 + gain * np.exp(-((offset / reach) ** 2).sum(-1, keepdims=True)))


def _closer(head: HeadModel, uvs: np.ndarray, uv_triangles: np.ndarray, part: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Corners [Q, 3, 2] of the skin's triangles, `part` [F] bool, with eyes and mouth, where it has landmarks, magnified."""
    everywhere = np.zeros((len(uv_triangles), 3, 2))
    everywhere[part] = corners
    face = head.landmark_triangles.cpu().numpy()
    marks = np.einsum("lk,lkd->ld", head.landmark_barycentric.cpu().numpy(), everywhere[np.clip(face, 0, None)])
    half = len(EYES) // 2
    for name, ids in (("eyes", EYES[:half]), ("eyes", EYES[half:]), ("mouth", LIPS)):
        known = marks[[mark for mark in ids if face[mark] >= 0 and part[face[mark]]]]
        if len(known) > 2:
            low, high = np.quantile(known, 0.1, axis=0), np.quantile(known, 0.9, axis=0)  # a few may lie on another chart
            corners = magnified(corners, (low + high) / 2, AROUND * (high - low) / np.sqrt(2), MAGNIFIED[name])
    return corners


def stretched(corners: np.ndarray, points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Corners [F, 3, 2] in [0, 1] after a stretch of both axes that gives each triangle its share of texels.

    points: [F, 3, 3] m; wanted: [F] texels a length, relative to each other.
    """
    for _ in range(ROUNDS):
        lengths = _lengths(corners, points) * wanted[:, None]  # [F, 2]
        for axis in (0, 1):
            place = corners[..., axis]
            low, high = (np.clip((edge * BINS).astype(int), 0, BINS - 1) for edge in (place.min(1), place.max(1)))
            across: list[list[float]] = [[] for _ in range(BINS)]
            for first, last, length in zip(low, high, lengths[:, axis], strict=True):
                for bin_ in range(first, last + 1):
                    across[bin_].append(length)
            width = np.array([np.quantile(found, HIGH) if found else 0.0 for found in across])
            width = np.maximum(ndimage.gaussian_filter1d(width, SMOOTH), LEAST * width.mean())
            edges = np.concatenate([[0], np.cumsum(width)]) / width.sum()
            corners = corners.copy()
            corners[..., axis] = np.interp(place, np.linspace(0, 1, BINS + 1), edges)
    return corners.astype(np.float32)


def _lengths(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Metres on the surface for a unit of u, and of v, [F, 2]; 0 for triangles without an area in UV."""
    edges, sides = corners[:, 1:] - corners[:, :1], points[:, 1:] - points[:, :1]  # [F, 2, 2], [F, 2, 3]
    area = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    flat = np.abs(area) < 1e-12
    inverse = np.stack([edges[:, 1, 1], -edges[:, 0, 1], -edges[:, 1, 0], edges[:, 0, 0]], -1).reshape(-1, 2, 2)
    slopes = inverse / np.where(flat, 1, area)[:, None, None] @ sides  # [F, 2, 3]
    return np.where(flat[:, None], 0, np.linalg.norm(slopes, axis=-1))
