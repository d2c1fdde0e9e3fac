"""Hair as the photometric term sees it: samples above the scalp, each at the height where the keyframes agree on its colour.

The head model is bald, but what lies above its scalp moves with the skull.  A face alone, whose skin also moves by expression,
tells a turn of the head from raised brows badly.  The heights come from a plane sweep (Collins 1996), the planes being shells of
the scalp.  Letters: P samples, K keyframes, H heights.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from fitting import photometric
from fitting.head_model import REGIONS
from fitting.photometric import Samples
from fitting.rig import Rig

HEIGHTS_M = np.arange(0, 0.033, 0.004)
"""Above the scalp, [H]: from a shaven head to a quiff."""
NEIGHBOURS = 16  # samples over which the agreement is averaged


def choose_samples(rig: Rig, count: int) -> Samples | None:
    """Random points of the scalp; None for a head without one."""
    if not (rig.region[rig.triangles] == REGIONS.index("scalp")).all(1).any():
        return None
    return photometric.choose_samples(rig, count, regions=("scalp",))


def lifted(samples: Samples, height_m: np.ndarray | float) -> Samples:
    """The samples moved outward along the template's normals by heights [P]."""
    surface = samples.surface
    height = np.broadcast_to(height_m, len(surface.base))[:, None]
    return replace(samples, surface=replace(surface, base=surface.base + height * surface.normal))


def swept(rig: Rig, samples: Samples) -> Samples:
    """The samples at every height, H after H: [H P]."""
    triangles, barycentric = np.tile(samples.triangles, len(HEIGHTS_M)), np.tile(samples.barycentric, (len(HEIGHTS_M), 1))
    every = Samples(triangles, barycentric, rig.surface(triangles, barycentric))
    return lifted(every, np.repeat(HEIGHTS_M, len(samples.triangles)))


def settled(samples: Samples, values: np.ndarray, weights: np.ndarray) -> Samples:
    """Each sample at the height where its grey value changes least from keyframe to keyframe, averaged over its neighbours.

    Args:
        samples: on the scalp; values: [K, H P] grey values seen at each height (of `swept`); weights: [K, H P], 0 where not seen.
    """
    each = ((part.reshape(len(part), len(HEIGHTS_M), -1)[:, h] for part in (values, weights)) for h in range(len(HEIGHTS_M)))
    change = np.stack([photometric.disagreement(*one) for one in each])  # [H, P]
    near = cKDTree(samples.surface.base).query(samples.surface.base, min(NEIGHBOURS, len(samples.triangles)))[1]
    known = np.isfinite(change)
    share = known[:, near].mean(-1)
    change = np.where(known, change, 0)[:, near].mean(-1) / np.maximum(share, 1e-9)
    best = np.where(share > 0.5, change, np.inf).argmin(0)
    return lifted(samples, np.median(HEIGHTS_M[best][near], -1))
