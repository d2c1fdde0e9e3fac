"""FLAME as a head model: the user's own file (2020, 2023, 2023 Open, with or without jaw), checked and turned into a HeadModel.

FLAME is not shipped and its loader is not copied: the equations are SMPL's, which `HeadModel` computes; a file brings arrays.
What is done to them, and why:
- axes become ours (FLAME: y up, face along +z), a half turn about x; FLAME's origin is kept, so that its parameters are ours
  with the signs of y and z changed;
- which eye joint is the left one is decided by the eyeball that it moves, for names in the wild disagree; exporters need the
  file's own order, so it is kept (`source_joints`);
- joints follow shape and expression, as J_regressor says;
- the jaw of a `no_jaw` file is locked: its weights go to the neck, whose motion it then shares;
- FLAME's components close the eyes poorly: two are added, `eyelid_left` and `eyelid_right`, from 0 (open) to 1 (closed).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fitting import chart, eyelids, mouth_cavity
from fitting.head_model import REGIONS, HeadModel
from fitting.safe_pickle import load_model

VERTICES, IDENTITIES = 5023, 300
AXES = np.array([1.0, -1.0, -1.0])  # FLAME's -> ours; a half turn about x, so triangles keep their sense
PARENTS = (-1, 0, 1, 1, 1)
EYELIDS = ("eyelid_left", "eyelid_right")
WHERE = "get FLAME at https://flame.is.tue.mpg.de (registration needed) and name your file"
LICENCES = {
    "2023 Open": "FLAME 2023 Open: CC-BY-4.0 with use restrictions, attribution to the Max Planck Society; the user's own file",
    "": "FLAME: licence of the Max Planck Society, non-commercial research, no redistribution; the user's own file",
}
# Where FLAME_masks.pkl and we speak of the same skin; later rows win.
MASKS = {"face": "face", "neck": "neck", "boundary": "neck", "scalp": "scalp", "left_ear": "ears", "right_ear": "ears"}


def read(path: Path) -> dict[str, Any]:
    """Arrays of a FLAME file (`.pkl` or `.npz`) by FLAME's names, checked; real ones float64, indices int64.

    Raises:
        ValueError: not such a file; the message names file, key, what was expected and found.
    """
    raw = _read_any(path)
    shapes = {
        "v_template": (VERTICES, 3),
        "f": (None, 3),
        "shapedirs": (VERTICES, 3, None),
        "posedirs": (VERTICES, 3, 36),
        "J_regressor": (5, VERTICES),
        "weights": (VERTICES, 5),
        "kintree_table": (2, 5),
    }
    found: dict[str, Any] = {}
    for key, shape in shapes.items():
        array = raw.get(key)
        has = array.shape if isinstance(array, np.ndarray) else "nothing" if array is None else type(array).__name__
        wanted = "(" + ", ".join("any" if side is None else str(side) for side in shape) + ")"
        if len(has) != len(shape) or any(want not in (None, side) for want, side in zip(shape, has, strict=True)):
            raise ValueError(f"{path}: {key}: expected an array of shape {wanted}, found {has}; {WHERE}")
        kinds, to = ("iu", np.int64) if key in ("f", "kintree_table") else ("f", np.float64)
        if array.dtype.kind not in kinds:
            raise ValueError(f"{path}: {key}: expected {'integers' if to is np.int64 else 'reals'}, found {array.dtype}")
        found[key] = array.astype(np.int32).astype(to) if key == "kintree_table" else array.astype(to)  # root: 2^32 - 1 is -1
    _check(path, found)
    found["open"] = "supr_expression_metadata" in raw
    return found


def _read_any(path: Path) -> dict[str, Any]:
    if path.suffix != ".npz":
        return load_model(path)
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"{path}: refused, it must be an npz of plain arrays ({error})") from error


def _check(path: Path, found: dict[str, Any]) -> None:
    """Raise ValueError for values that cannot be a head's."""
    for key, array in found.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{path}: {key}: expected finite numbers, found {np.sum(~np.isfinite(array))} that are not")
    faces, template = found["f"], found["v_template"]
    if not len(faces) or faces.min() < 0 or faces.max() >= VERTICES:
        raise ValueError(f"{path}: f: expected vertex numbers below {VERTICES}, found up to {faces.max(initial=-1)}")
    if tuple(found["kintree_table"][0]) != PARENTS:
        raise ValueError(f"{path}: kintree_table: expected parents {PARENTS}, found {tuple(found['kintree_table'][0].tolist())}")
    for key, slack in (("weights", 1e-3), ("J_regressor", 1e-2)):
        far = np.abs(found[key].sum(1) - 1).max()
        if far > slack:
            raise ValueError(f"{path}: {key}: expected rows that sum to 1, found one that is {far:.3g} off")
    if found["shapedirs"].shape[2] <= IDENTITIES:
        raise ValueError(f"{path}: shapedirs: expected more than {IDENTITIES} columns, found {found['shapedirs'].shape[2]}")
    low, high = template.min(0), template.max(0)
    if (low >= 0).any() or (high <= 0).any() or not 0.1 < np.ptp(template[:, 1]) < 1:
        raise ValueError(f"{path}: v_template: expected a head around the origin in m, found {low.round(3)} to {high.round(3)}")


def version_of(name: str, is_open: bool) -> str:
    """FLAME's version from the file's name and content: `2020`, `2023`, `2023 no_jaw`, `2023 Open` or `unknown`."""
    lower = name.lower()
    if is_open or "open" in lower:
        return "2023 Open"
    if "2023" in lower:
        return "2023 no_jaw" if "no_jaw" in lower else "2023"
    return "2020" if lower.startswith(("generic", "male", "female", "flame2020", "flame_neutral")) else "unknown"


def bake(
    arrays: dict[str, Any],
    shape_components: int,
    expression_components: int,
    jaw: bool = True,
    cavity: bool = False,
    texture: tuple[np.ndarray, np.ndarray] | None = None,
    masks: dict[str, np.ndarray] | None = None,
    version: str = "unknown",
    source: str = "",
) -> HeadModel:
    """Build the head model; landmarks are all unplaced (-1) until `correspondence` places them.

    Args:
        arrays: what `read` gives.
        shape_components, expression_components: first columns of each that are kept.
        jaw: whether the jaw joint moves; a `no_jaw` file opens its mouth by expressions.
        cavity: whether a mouth cavity is added.
        texture: uvs [U, 2] and uv_triangles [F, 3] that belong to `f`; None makes charts (`chart.layout`).
        masks: vertex lists by FLAME's names; None labels by geometry.
        version, source: see HeadModel.

    Raises:
        ValueError: more components than the file has, or no two eyeballs.
    """
    identities, expressions = np.split(arrays["shapedirs"].transpose(2, 0, 1) * AXES, [IDENTITIES])
    if shape_components > IDENTITIES or expression_components > len(expressions):
        raise ValueError(f"expected at most {IDENTITIES} shape and {len(expressions)} expression components")
    template, triangles = arrays["v_template"] * AXES, arrays["f"]
    regress = lambda points: np.einsum("jv,...vd->...jd", arrays["J_regressor"], points)  # noqa: E731
    balls, order = _eyes(template, triangles, arrays["weights"])
    weights, pose_basis = _in_our_order(arrays, order, jaw)
    lids = eyelids.eyelids(template, triangles, balls)
    own = expressions[:expression_components]
    kept = np.concatenate([own, lids])
    joint_expression = np.concatenate([regress(own), np.zeros((2, 5, 3))])  # lids move no joint
    uvs, uv_triangles = texture or chart.layout(template, triangles)
    region = label(template, balls, (template[balls[0]].mean(0) + template[balls[1]].mean(0)) / 2, masks)
    low, high = np.full(len(kept), -np.inf), np.full(len(kept), np.inf)
    low[-2:], high[-2:] = 0, 1
    head = HeadModel(
        template=_real(template),
        shape_basis=_real(identities[:shape_components]),
        expression_basis=_real(kept),
        expression_low=_real(low),
        expression_high=_real(high),
        expression_names=(*(f"expression_{k:03d}" for k in range(expression_components)), *EYELIDS),
        pose_basis=_real(pose_basis),
        joints=_real(regress(template)[order]),
        joint_shape_basis=_real(regress(identities[:shape_components])[:, order]),
        joint_expression_basis=_real(joint_expression[:, order]),
        skinning_weights=_real(weights),
        triangles=torch.from_numpy(triangles),
        uvs=_real(uvs),
        uv_triangles=torch.from_numpy(np.asarray(uv_triangles, np.int64)),
        region=torch.from_numpy(region),
        landmark_triangles=torch.full((478,), -1, dtype=torch.int64),
        landmark_barycentric=torch.full((478, 3), 1 / 3),
        name="flame",
        licence=LICENCES.get(version, LICENCES[""]),
        digest="",
        source=source,
        version=version,
        source_joints=torch.tensor(order),
    )
    return mouth_cavity.add(head) if cavity else head


def _in_our_order(arrays: dict[str, Any], order: list[int], jaw: bool) -> tuple[np.ndarray, np.ndarray]:
    """Skinning weights [V, 5] and pose correctives [36, V, 3] by our joints, in our axes."""
    weights = arrays["weights"][:, order].copy()
    if not jaw:
        weights[:, 1] += weights[:, 2]
        weights[:, 2] = 0
    # R - I of one joint, row-major: entry (r, c) changes by the signs of axes r and c.
    turned = (arrays["posedirs"].transpose(2, 0, 1) * AXES).reshape(4, 9, VERTICES, 3) * np.outer(AXES, AXES).reshape(9, 1, 1)
    return weights, turned[np.array(order[1:]) - 1].reshape(36, VERTICES, 3)


def _real(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))


def _eyes(template: np.ndarray, triangles: np.ndarray, weights: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], list[int]]:
    """The left and right eyeball's vertices [V] bool, and the file's joints in our order {root, neck, jaw, left, right eye}.

    Raises:
        ValueError: the mesh has not skin and two eyeballs each of which hangs from a joint of its own.
    """
    part = chart.components(triangles, len(template))
    sizes = np.bincount(part)
    if len(sizes) != 3:
        raise ValueError(f"expected skin and two eyeballs, found {len(sizes)} components in f")
    balls = [part == k for k in np.argsort(sizes, kind="stable")[:2]]
    balls.sort(key=lambda ball: -template[ball, 0].mean())  # the subject's left is +x
    moving = [int(weights[ball].mean(0).argmax()) for ball in balls]
    if template[balls[0], 0].mean() <= 0 or template[balls[1], 0].mean() >= 0 or len({*moving, 0, 1}) != 4:
        raise ValueError(f"expected an eyeball on each side with a joint of its own, found them on joints {moving}")
    jaw = next(joint for joint in (2, 3, 4) if joint not in moving)
    return (balls[0], balls[1]), [0, 1, jaw, *moving]


def label(
    template: np.ndarray, balls: tuple[np.ndarray, np.ndarray], eyes: np.ndarray, masks: dict[str, np.ndarray] | None
) -> np.ndarray:
    """Region [V] int64: from the masks where they speak, else by place relative to the point between the eyes [3] m."""
    x, y, z = np.abs(template[:, 0]), template[:, 1] - eyes[1], template[:, 2] - eyes[2]
    region = np.full(len(template), REGIONS.index("scalp"))
    region[(z < 0.054) & (y > -0.059)] = REGIONS.index("face")
    region[y > 0.105 - 0.35 * z] = REGIONS.index("neck")
    beside = (y > -0.015) & (y < 0.06) & (z > 0.055) & (z < 0.11)
    behind = x[(y > -0.015) & (y < 0.06) & (z > 0.12)]  # the skull behind the ears
    region[beside & (x > behind.max(initial=0.0))] = REGIONS.index("ears")
    for name, ours in MASKS.items() if masks else ():
        region[masks[name]] = REGIONS.index(ours)
    region[balls[0] | balls[1]] = REGIONS.index("eyeballs")
    return region


def read_masks(path: Path) -> dict[str, np.ndarray]:
    """Vertex lists of FLAME_masks.pkl.

    Raises:
        ValueError: not such a file.
    """
    masks = load_model(path)
    for name in MASKS:
        index = masks.get(name)
        if not isinstance(index, np.ndarray) or index.dtype.kind not in "iu" or index.ndim != 1:
            raise ValueError(f"{path}: {name}: expected a list of vertex numbers, as in FLAME_masks.pkl")
        if len(index) and (index.min() < 0 or index.max() >= VERTICES):
            raise ValueError(f"{path}: {name}: expected vertex numbers below {VERTICES}, found up to {index.max()}")
    return masks


def read_texture(path: Path, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """UVs [U, 2] and uv_triangles [F, 3] of head_template_mesh.obj in the order of the model's triangles [F, 3].

    Only `f` and `vt` are read: the positions in that file are not the model's.

    Raises:
        ValueError: its triangles are not the model's.
    """
    uvs, corners = [], []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        kind, *words = line.split() or [""]
        if kind == "vt":
            uvs.append([float(word) for word in words[:2]])
        elif kind == "f":
            corners.append([[int(part or 0) for part in (word + "/0").split("/")[:2]] for word in words])
    if not uvs or any(len(corner) != 3 for corner in corners):
        raise ValueError(f"{path}: expected triangles with texture coordinates (lines `vt` and `f v/vt v/vt v/vt`)")
    solid, flat = np.moveaxis(np.array(corners, np.int64) - 1, -1, 0)
    place = {tuple(np.roll(row, -row.argmin())): k for k, row in enumerate(solid)}
    rows = np.array([place.get(tuple(np.roll(row, -row.argmin())), -1) for row in triangles])
    if (rows < 0).any():
        raise ValueError(
            f"{path}: {np.sum(rows < 0)} of the model's {len(triangles)} triangles are not in it; it belongs to another mesh"
        )
    if flat[rows].min() < 0 or flat.max() >= len(uvs):
        raise ValueError(f"{path}: a triangle names a texture coordinate that is not there")
    shift = (solid[rows].argmin(1)[:, None] - triangles.argmin(1)[:, None] + np.arange(3)) % 3
    return np.array(uvs), np.take_along_axis(flat[rows], shift, 1)


def read_embedding(path: Path, triangle_count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Landmark numbers [L], triangles [L] and barycentric weights [L, 3] of mediapipe_landmark_embedding.npz.

    Raises:
        ValueError: not such a file, or not for this mesh.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            index, face, weights = (file[name] for name in ("landmark_indices", "lmk_face_idx", "lmk_b_coords"))
    except (ValueError, OSError, EOFError, KeyError) as error:
        raise ValueError(f"{path}: expected landmark_indices, lmk_face_idx and lmk_b_coords ({error})") from error
    index, face = index.astype(np.int64), face.astype(np.int64)
    if not len(index) == len(face) == len(weights) or weights.shape[1:] != (3,):
        raise ValueError(f"{path}: expected three arrays of one length, found {index.shape}, {face.shape}, {weights.shape}")
    if index.min() < 0 or index.max() >= 478 or face.min() < 0 or face.max() >= triangle_count:
        raise ValueError(f"{path}: a landmark or a triangle is out of range")
    if np.abs(weights.sum(1) - 1).max() > 1e-4:
        raise ValueError(f"{path}: lmk_b_coords: expected rows that sum to 1")
    return index, face, weights
