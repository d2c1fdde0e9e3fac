"""The surfaces that carry the avatar: offset shells of the posed mesh, and the parts inside the mouth and the eyes.

Shell 0 lies farthest out, at each vertex's thickness along its normal, the last but one just beneath the skin; all of them are
drawn with the mesh's triangles without the inner parts (eyeballs, mouth cavity, teeth, tongue), which are a layer of their own at
their true place. Letters: L layers, V vertices, F triangles.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from fitting.head_model import REGIONS, HeadModel
from fitting.landmark_model import EYES, LIPS

INNER = ("eyeballs", "mouth_cavity", "teeth", "tongue")
BENEATH_M = 0.0024  # how far the innermost shell lies under the skin: the fitted surface is a little too full here and there
SKIN_M = 0.004  # the outermost shell over bare skin
BARE_M = 0.0125  # a face vertex whose measured thickness is below this has nothing that stands off it
THIN_M, THINNEST = 0.015, 0.2  # towards lids and lips the shells come closer, down to this part of it: they open and close
NEAR_M = (0.004, -0.003)  # the shells around a surface that is known, from the outermost of them to the innermost
SMOOTHING = 8  # steps of averaging over neighbours: a shell must not fold


def inner_triangles(head: HeadModel) -> np.ndarray:
    """[F] bool: triangles of the inner parts."""
    region = head.region.cpu().numpy()[head.triangles.cpu().numpy()[:, 0]]
    return np.isin(region, [REGIONS.index(name) for name in INNER])


def lids_and_lips(head: HeadModel) -> np.ndarray:
    """Landmarks [Q, 3] of the lids and lips on the neutral head, those that have a place on it."""
    marks = head.landmarks(head.template)[[*LIPS, *EYES]].double().cpu().numpy()
    return marks[np.isfinite(marks).all(1)]


def drawn(head: HeadModel, layers: int) -> np.ndarray:
    """[L, F] bool: which triangles each layer draws."""
    inner = inner_triangles(head)
    return np.stack([~inner] * (layers - 1) + [inner])


def averaging(head: HeadModel) -> sparse.csr_matrix:
    """[V, V]: each vertex's mean over itself and those beside it."""
    triangles, count = head.triangles.cpu().numpy(), head.vertex_count
    ends = triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()
    beside = sparse.coo_matrix((np.ones(len(ends[0])), ends), (count, count))
    beside = ((beside + beside.T + sparse.eye(count)) > 0).astype(np.float64).tocsr()
    return sparse.diags(1 / np.asarray(beside.sum(1)).ravel()) @ beside


def near(layers: int) -> np.ndarray:
    """Heights m above a surface that is known, of the shells that lie around it: from the second to the one above the skin's."""
    between = layers - 4
    return np.linspace(*NEAR_M, between) if between > 1 else np.zeros(max(between, 0))


def at_surface(layers: int) -> int:
    """Number of the first shell that is not above a known surface; the skin's own where none lies around it."""
    return 1 + int(np.argmax(near(layers) <= 0)) if layers > 4 else layers - 3


def around(head: HeadModel, offsets_m: np.ndarray, surface_m: np.ndarray) -> np.ndarray:
    """Offsets [L, V] whose shells lie close around a surface [V] m above the skin, where it is known, NaN elsewhere.

    The outermost stays: what sticks out alone is nowhere on the surface. So do the skin and the inner parts.
    """
    known = np.isfinite(surface_m)
    placed = offsets_m.astype(np.float64)
    between = len(offsets_m) - 4  # shells from the second to the one above the skin's
    if between > 0 and known.any():
        steps = near(len(offsets_m))[:, None]
        skin = offsets_m[-3]
        placed[1:-3] = np.where(
            known, np.clip(surface_m + steps, skin + 1e-4, np.maximum(offsets_m[0], skin + 2e-4)), placed[1:-3]
        )
    average = averaging(head)
    for _ in range(SMOOTHING // 2):
        placed[1:-3] = (average @ placed[1:-3].T).T
    placed[1:-3] = np.minimum(placed[1:-3], placed[0])
    return placed.astype(np.float32)


def offsets(head: HeadModel, thickness_m: np.ndarray, layers: int) -> np.ndarray:
    """Where each layer lies along the vertex normals, [L, V] float32 m, from the measured thickness [V] m of the shell.

    Raises ValueError for fewer than 3 layers.
    """
    if layers < 3:
        raise ValueError(f"an avatar has at least 3 layers, found {layers}")
    region = head.region.cpu().numpy()
    reach = np.asarray(thickness_m, np.float64).copy()
    reach[(region == REGIONS.index("face")) & (reach <= BARE_M)] = SKIN_M
    if len(marks := lids_and_lips(head)):
        away = cKDTree(marks).query(head.template.double().cpu().numpy())[0]
        reach *= np.clip(away / THIN_M, THINNEST, 1)
    average, count = averaging(head), len(region)
    for _ in range(SMOOTHING):
        reach = average @ reach
    fractions = np.linspace(1, 0, layers - 1)[:-1, None] * reach
    # The shells above the skin share the way to it evenly; one lies beneath, and the inner parts where they are.
    return np.concatenate([fractions, np.full((1, count), -BENEATH_M), np.zeros((1, count))]).astype(np.float32)
