"""Where MediaPipe's 478 points lie on a head model: render it, detect, cast each point back onto the surface, average over views.

The same detector that will look at the video places the points, so that its habits (where it thinks a brow ends) are part of
the embedding.  The mouth is rendered slightly open so that upper and lower lip cannot be confused.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
import trimesh

from fitting import raster
from fitting.head_model import REGIONS, HeadModel, axis_angle_to_matrix

POINTS = 478
RIGHT_IRIS, LEFT_IRIS = 468, 473  # centres, the subject's right and left
YAWS_RAD = (-0.6, -0.35, -0.15, 0.0, 0.15, 0.35, 0.6)
PITCHES_RAD = (-0.25, 0.0, 0.25)
FACING = 0.35  # least cosine between surface normal and view for a point to count
SIZE_PX, FOCAL_PX, DISTANCE_M = 768, 1500.0, 0.6
IRIS_RADIUS_M = 0.0058
UNSTABLE_M = 0.004  # a landmark that wanders further over the surface from view to view has no place
MOUTH_OPEN = {"jawOpen": 0.15}  # of a head whose actions open its mouth
JAW_OPEN_RAD = 0.06  # of a head whose jaw joint does


@dataclass
class Placement:
    """Result of `place`."""

    triangles: np.ndarray  # [478] int64, -1 where unplaced
    barycentric: np.ndarray  # [478, 3]
    spread_m: np.ndarray  # [478] rms distance of the views' points from their mean, NaN where unplaced
    views: int  # views in which the detector found the face


def place(head: HeadModel, detect: Callable[[np.ndarray], np.ndarray | None]) -> Placement:
    """Place the landmarks on a head model.

    Args:
        detect: uint8 RGB image [H, W, 3] -> points [478, 3] in pixels (centres at +0.5), or None where no face is found.

    Raises:
        ValueError: the face is found in fewer than three views.
    """
    open_mouth = torch.zeros(1, len(head.expression_names))
    for name, value in MOUTH_OPEN.items():
        if name in head.expression_names:
            open_mouth[0, head.expression_names.index(name)] = value
    shape = torch.zeros(len(head.shape_basis))
    by_joint = float((head.skinning_weights[:, 2] > 0.5).any()) * JAW_OPEN_RAD
    posed = head.local(shape, open_mouth, torch.tensor([[by_joint, 0.0, 0.0]]))[0].numpy().astype(np.float64)
    triangles, template = head.triangles.numpy(), head.template.numpy().astype(np.float64)
    seen: list[np.ndarray] = []  # a view each: surface points [478, 3], NaN where not seen well
    for yaw in YAWS_RAD:
        for pitch in PITCHES_RAD:
            rotation = (
                axis_angle_to_matrix(torch.tensor([pitch, 0.0, 0.0])) @ axis_angle_to_matrix(torch.tensor([0.0, yaw, 0.0]))
            ).numpy()
            camera = posed @ rotation.T + [0, 0.01, DISTANCE_M]
            found = _one_view(camera, triangles, paint(head), detect)
            if found is None:
                continue
            index, weights = found
            surface = (template[triangles[index.clip(0)]] * weights[..., None]).sum(1)
            seen.append(np.where((index >= 0)[:, None], surface, np.nan))
    if len(seen) < 3:
        raise ValueError(
            f"the detector found the rendered head in {len(seen)} of {len(YAWS_RAD) * len(PITCHES_RAD)} views; it needs 3"
        )
    return _average(head, template, triangles, np.stack(seen))


def paint(head: HeadModel) -> np.ndarray:
    """Vertex colours [V, 3]: grey-brown skin, pale eyeballs with a dark iris, dark mouth: enough for a face detector."""
    colour = np.tile(np.array([0.78, 0.65, 0.56]), (head.vertex_count, 1))
    region, template = head.region.numpy(), head.template.numpy()
    colour[region == REGIONS.index("eyeballs")] = (0.95, 0.95, 0.95)
    for joint in (3, 4):
        near = np.linalg.norm((template - head.joints.numpy()[joint])[:, :2], axis=1) < IRIS_RADIUS_M
        colour[near & (region == REGIONS.index("eyeballs"))] = (0.15, 0.1, 0.08)
    colour[region == REGIONS.index("mouth_cavity")] = (0.35, 0.12, 0.12)
    colour[region == REGIONS.index("tongue")] = (0.6, 0.3, 0.3)
    return colour


def _one_view(
    camera: np.ndarray, triangles: np.ndarray, colour: np.ndarray, detect: Callable
) -> tuple[np.ndarray, np.ndarray] | None:
    """Triangle [478] and barycentric weights [478, 3] under each detected point of one render; -1 where it is not seen well."""
    centre = np.array([SIZE_PX / 2, SIZE_PX / 2])
    picture, index = raster.shade(camera, triangles, FOCAL_PX, centre, (SIZE_PX, SIZE_PX), colour, background=0.55)
    points = detect(np.ascontiguousarray((picture * 255).astype(np.uint8)))
    if points is None:
        return None
    pixel = np.floor(points[:, :2]).astype(int)
    inside = ((pixel >= 0) & (pixel < SIZE_PX)).all(1)
    found = np.where(inside, index[pixel[:, 1].clip(0, SIZE_PX - 1), pixel[:, 0].clip(0, SIZE_PX - 1)], -1)
    corners = camera[triangles[found.clip(0)]]  # [478, 3, 3]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ray = np.concatenate([(points[:, :2] - centre) / FOCAL_PX, np.ones((POINTS, 1))], 1)
    cosine = np.abs((normal * ray).sum(1)) / (np.linalg.norm(normal, axis=1) * np.linalg.norm(ray, axis=1) + 1e-12)
    found = np.where(cosine > FACING, found, -1)
    hit = (
        ray
        * ((corners[:, 0] * normal).sum(1) / np.where(np.abs((ray * normal).sum(1)) > 1e-9, (ray * normal).sum(1), 1))[:, None]
    )
    return found, trimesh.triangles.points_to_barycentric(corners, hit).clip(-0.5, 1.5)


def _average(head: HeadModel, template: np.ndarray, triangles: np.ndarray, seen: np.ndarray) -> Placement:
    """Robust mean of each landmark over the views [views, 478, 3], put back onto the nearest triangle of the visible skin.

    Points that slide over the surface as the head turns (the face oval lies on the silhouette) stay unplaced: a spread of
    centimetres would pull the pose, and the silhouette is another term's work.
    """
    count = (~np.isnan(seen[..., 0])).sum(0)
    filled = np.where(count[:, None] > 0, seen, 0)  # a landmark that no view saw has no median
    middle = np.nanmedian(filled, 0)
    away = np.linalg.norm(filled - middle, axis=-1)
    near = away <= np.maximum(2.5 * np.nanmedian(away, 0), 5e-4)  # NaN compares as False
    mean = np.where(near[..., None], filled, 0).sum(0) / near.sum(0).clip(1)[:, None]
    spread = np.sqrt((np.where(near, np.linalg.norm(filled - mean, axis=-1), 0) ** 2).sum(0) / near.sum(0).clip(1))
    placed = (count >= 3) & (spread < UNSTABLE_M)
    skin = np.isin(head.region.numpy(), [REGIONS.index(name) for name in ("face", "scalp", "ears", "neck")])
    usable = np.flatnonzero(skin[triangles].all(1))
    mesh = trimesh.Trimesh(template, triangles[usable], process=False)
    points, _, nearest = trimesh.proximity.closest_point_naive(mesh, mean[placed])
    index = np.full(POINTS, -1, np.int64)
    weights = np.full((POINTS, 3), 1 / 3)
    index[placed] = usable[nearest]
    weights[placed] = trimesh.triangles.points_to_barycentric(template[triangles[usable[nearest]]], points)
    spread = np.where(placed, spread, np.nan)
    index[RIGHT_IRIS:], spread[RIGHT_IRIS:] = -1, np.nan
    for landmark, joint in ((RIGHT_IRIS, 4), (LEFT_IRIS, 3)):
        index[landmark], weights[landmark] = _pupil(head, template, triangles, joint)
    return Placement(index, weights, spread, len(seen))


def _pupil(head: HeadModel, template: np.ndarray, triangles: np.ndarray, joint: int) -> tuple[int, np.ndarray]:
    """Triangle and weights of the eyeball's front pole: where the axis from the eye joint along -z leaves the eyeball."""
    ball = np.flatnonzero((head.skinning_weights.numpy()[:, joint] > 0.5)[triangles].all(1))
    mesh = trimesh.Trimesh(template, triangles[ball], process=False)
    centre = head.joints.numpy()[joint]
    points, _, nearest = trimesh.proximity.closest_point_naive(mesh, (centre + [0, 0, -0.05])[None])
    return int(ball[nearest[0]]), trimesh.triangles.points_to_barycentric(template[triangles[ball[nearest]]], points)[0]
