"""A small z-buffer: which triangle each pixel sees, in numba on the CPU.

Used wherever pixels ask for geometry without gradients: visibility, overlays, trimming, grey renders for the landmark embedding
and for simulated clips.  The slow twin in the tests casts one ray a pixel at every triangle.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fitting import camera

EMPTY = -1
FLAT = 1e-5  # height over length below which triangles stored in float32 have no side of their own


@njit(cache=True, fastmath=False)
def _fill(points, triangles, height, width, depth, index, bary):
    for f in range(triangles.shape[0]):
        a, b, c = triangles[f, 0], triangles[f, 1], triangles[f, 2]
        xa, ya, za = points[a, 0], points[a, 1], points[a, 2]
        xb, yb, zb = points[b, 0], points[b, 1], points[b, 2]
        xc, yc, zc = points[c, 0], points[c, 1], points[c, 2]
        if za <= 1e-6 or zb <= 1e-6 or zc <= 1e-6:
            continue
        area = (xb - xa) * (yc - ya) - (yb - ya) * (xc - xa)
        if area == 0.0 or not np.isfinite(area):
            continue
        left = max(0, int(np.floor(min(xa, xb, xc) - 0.5)))
        right = min(width - 1, int(np.ceil(max(xa, xb, xc) - 0.5)))
        top = max(0, int(np.floor(min(ya, yb, yc) - 0.5)))
        bottom = min(height - 1, int(np.ceil(max(ya, yb, yc) - 0.5)))
        for y in range(top, bottom + 1):
            py = y + 0.5
            for x in range(left, right + 1):
                px = x + 0.5
                u = ((xb - px) * (yc - py) - (yb - py) * (xc - px)) / area
                v = ((xc - px) * (ya - py) - (yc - py) * (xa - px)) / area
                w = 1.0 - u - v
                if u < 0.0 or v < 0.0 or w < 0.0:
                    continue
                inverse = u / za + v / zb + w / zc  # 1/z is linear on the screen
                z = 1.0 / inverse
                if z < depth[y, x]:
                    depth[y, x] = z
                    index[y, x] = f
                    bary[y, x, 0] = u / za * z
                    bary[y, x, 1] = v / zb * z
                    bary[y, x, 2] = w / zc * z


def rasterise(points: np.ndarray, triangles: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest triangle of every pixel, both faces of a triangle drawn, perspective-correct.

    Args:
        points: [V, 3] x and y in pixels (pixel centres at +0.5), z > 0 in metres along the optical axis.
        triangles: [F, 3] int.
        size: (H, W).

    Returns:
        index [H, W] int32, EMPTY where nothing is seen; depth [H, W] float32 m, inf where empty; barycentric [H, W, 3] float32.
        Triangles with a corner at or behind the camera are left out.
    """
    height, width = size
    depth = np.full((height, width), np.inf, np.float32)
    index = np.full((height, width), EMPTY, np.int32)
    bary = np.zeros((height, width, 3), np.float32)
    _fill(np.ascontiguousarray(points, np.float64), np.ascontiguousarray(triangles, np.int64), height, width, depth, index, bary)
    return index, depth, bary


def project(vertices: np.ndarray, focal_px: float, centre_px: np.ndarray) -> np.ndarray:
    """Pinhole projection of camera-space points [..., 3] m to (x px, y px, z m)."""
    return np.concatenate([camera.project(vertices, focal_px, np.asarray(centre_px)), vertices[..., 2:]], -1)


def vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals [V, 3] of one mesh [V, 3].

    Exactly zero where a vertex has no area around it, or where opposite triangles cancel: what is left then is rounding.
    """
    corners = np.asarray(vertices, np.float64)[triangles]
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(first, second)
    scale = np.sqrt(np.einsum("fc,fc->f", first, first) * np.einsum("fc,fc->f", second, second))
    flat = triangles.T.ravel()  # bincount is ten times np.add.at
    values = np.concatenate([normal, scale[:, None]], 1)
    total = np.stack([np.bincount(flat, np.tile(values[:, axis], 3), len(vertices)) for axis in range(4)], 1)
    length = np.linalg.norm(total[:, :3], axis=1, keepdims=True)
    seen = length > FLAT * total[:, 3:]
    return np.where(seen, total[:, :3] / np.where(seen, length, 1), 0.0)


def shade(
    vertices: np.ndarray,
    triangles: np.ndarray,
    focal_px: float,
    centre_px: np.ndarray,
    size: tuple[int, int],
    colour: np.ndarray,
    background: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Head-lit Lambert picture of one camera-space mesh.

    Args:
        vertices: [V, 3] m; colour: [V, 3] or [3] in [0, 1].

    Returns:
        image [H, W, 3] float32 in [0, 1] and index [H, W] as `rasterise` gives it.
    """
    index, _, bary = rasterise(project(vertices, focal_px, centre_px), triangles, size)
    seen = index >= 0
    normals = vertex_normals(vertices, triangles)
    paint = np.broadcast_to(colour, vertices.shape)
    values = np.concatenate([normals, vertices, paint], 1).astype(np.float32)  # [V, 9]
    pixel = np.einsum("nk,nkc->nc", bary[seen], values[triangles[index[seen]]])
    normal, point, colours = pixel[:, :3], pixel[:, 3:6], pixel[:, 6:]
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(point, axis=1)
    light = 0.25 + 0.75 * np.abs(np.einsum("nc,nc->n", normal, point)) / np.where(length > 0, length, 1)
    image = np.full((*size, 3), background, np.float32)
    image[seen] = colours * light[:, None]
    return image, index
