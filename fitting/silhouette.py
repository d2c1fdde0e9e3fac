"""The silhouette term: skull, ears, jaw and neck, which no landmark sees, against the edge of the person's matte.

The rim of the mesh (where its own picture ends) is compared with the signed distance to the matte's edge.  Two forces:
- outside: mesh that sticks out of the person is pulled in, everywhere;
  A scalp under something that does not look like skin is kept a hair's thickness inside;
- edge: where the strip between the rim and the matte's edge looks like this person's skin, the rim belongs on the edge (jaw,
  cheek, ear, a bald skull); where it looks like hair, a collar or a hand, nothing is known and nothing pulls.

Letters: N rim points.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fitting import camera, raster
from fitting.energy import Camera, Rows, Term, huber
from fitting.head_model import REGIONS
from fitting.rig import Pose, Posed, Rig, Surface, posed

BUFFER = 256  # longer side of the mask in which the rim is found
RIM_POINTS = 160
FAR = 0.35  # a rim farther inside than this (of the inter-ocular distance) says nothing about the edge: shoulders, thick hair
HAIR_M = 0.008  # hair lifts the person's edge off the skull by at least this
STEPS = (0.25, 0.5, 0.75)  # places between rim and edge where the colour is looked at


@dataclass(frozen=True)
class Edge:
    """What a frame's matte says: signed distance to the edge of the person."""

    distance: np.ndarray  # [H, W, 3] px of the buffer: signed (positive outside), its x and y derivative
    shrink: float  # buffer pixels a picture pixel
    border: np.ndarray  # [H, W] bool, so near the picture's border that the matte's edge is only the picture's


@dataclass(frozen=True)
class Skin:
    """Colour of this person's skin: a normal distribution of (chroma, chroma, logarithm of brightness)."""

    mean: np.ndarray  # [3]
    precision: np.ndarray  # [3, 3]

    def likeness(self, colour: np.ndarray) -> np.ndarray:
        """1 for skin, falling to 0 beyond three standard deviations [...], of RGB [..., 3] in 0..255."""
        away = _features(colour) - self.mean
        squared = np.einsum("...i,ij,...j->...", away, self.precision, away)
        return np.exp(-0.5 * np.maximum(squared / 6.0 - 1.0, 0.0))


def _features(colour: np.ndarray) -> np.ndarray:
    colour = colour.astype(np.float64) + 4.0
    total = colour.sum(-1)
    return np.stack([colour[..., 0] / total, colour[..., 1] / total, np.log(total)], -1)


def skin_of(images: list[np.ndarray], pixels: list[np.ndarray]) -> Skin:
    """Skin colour from pictures [H, W, 3] uint8 at pixels [N, 2] that show the face.

    Raises:
        ValueError: fewer than 50 of the pixels lie inside the pictures.
    """
    colours = []
    for image, pixel in zip(images, pixels, strict=True):
        place = pixel.astype(int)
        place = place[((place >= 0) & (place < [image.shape[1], image.shape[0]])).all(1)]
        colours.append(_features(image[place[:, 1], place[:, 0]]))
    features = np.concatenate(colours)
    if len(features) < 50:
        raise ValueError(f"only {len(features)} pixels of skin")
    mean = np.median(features, 0)
    away = features - mean
    keep = (
        np.linalg.norm(away / (1.4826 * np.median(np.abs(away), 0) + 1e-3), axis=1) < 4
    )  # brows, lips and nostrils are not skin
    covariance = np.cov(away[keep].T) + np.diag([0.006, 0.006, 0.12]) ** 2
    return Skin(features[keep].mean(0), np.linalg.inv(covariance))


def edge_of(alpha: np.ndarray) -> Edge:
    """Signed distance to the 0.5 level of a matte [H, W] uint8."""
    shrink = BUFFER / max(alpha.shape)
    small = cv2.resize(np.ascontiguousarray(alpha), None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    inside = (small > 127).astype(np.uint8)
    distance = cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5) - cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    distance = np.where(distance > 0, distance - 0.5, distance + 0.5)
    distance = np.clip(cv2.GaussianBlur(distance.astype(np.float32), (0, 0), 1.0), -80, 80)
    slope = [cv2.filter2D(distance, -1, kernel) for kernel in (np.float32([[-0.5, 0, 0.5]]), np.float32([[-0.5], [0], [0.5]]))]
    border = np.ones(small.shape, bool)
    border[4:-4, 4:-4] = False
    return Edge(np.stack([distance, *slope], -1), small.shape[1] / alpha.shape[1], border)


@dataclass(frozen=True)
class Rim:
    """Points on the outline of the mesh in one frame and what pulls at them."""

    triangles: np.ndarray  # [N]
    barycentric: np.ndarray  # [N, 3]
    attraction: np.ndarray  # [N] 0 to 1, likeness of the strip outside to skin
    margin_px: np.ndarray  # [N] how far inside the edge a point must stay (hair), picture pixels
    surface: Surface  # unfolded


def rim_of(
    rig: Rig,
    whole: Surface,
    pose: Pose,
    lens: Camera,
    size: tuple[int, int],
    image: np.ndarray,
    edge: Edge,
    skin: Skin,
    scale_px: float,
) -> Rim | None:
    """The outline of the mesh in one frame; None where too little of it lies inside the picture.

    Args:
        whole: all vertices, folded; size: (H, W) of the picture; image: [H, W, 3] uint8; scale_px: inter-ocular distance.
    """
    shrink = edge.shrink
    shape = edge.distance.shape[:2]
    mesh = raster.project(posed(whole, pose).points, lens.focal_px * shrink, lens.centre_px * shrink)
    index, _, barycentric = raster.rasterise(mesh, rig.triangles, shape)
    filled = (index >= 0).astype(np.uint8)
    inner = cv2.erode(filled, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=1)
    rows, columns = np.nonzero(filled & (1 - inner) & ~edge.border)
    if len(rows) < 30:
        return None
    chosen = np.linspace(0, len(rows) - 1, min(RIM_POINTS, len(rows))).round().astype(int)
    order = np.argsort(np.arctan2(rows - rows.mean(), columns - columns.mean()))  # evenly around the outline
    rows, columns = rows[order][chosen], columns[order][chosen]
    triangles = index[rows, columns]
    region = rig.region[rig.triangles[triangles][:, 0]]
    keep = ~_cut_of_neck(rig, triangles)
    rows, columns, triangles, region = rows[keep], columns[keep], triangles[keep], region[keep]
    value = edge.distance[rows, columns]
    inward = np.clip(-value[:, 0], 0, None)  # buffer px from the rim to the edge of the person
    length = np.linalg.norm(value[:, 1:], axis=1, keepdims=True)
    direction = value[:, 1:] / np.where(length > 1e-6, length, 1)

    def look(way: np.ndarray) -> np.ndarray:  # likeness to skin this far (buffer px) along the way to the edge
        place = (np.stack([columns, rows], 1) + 0.5 + direction * way[:, None]) / shrink
        place = np.clip(place.astype(int), 0, [size[1] - 1, size[0] - 1])
        return skin.likeness(image[place[:, 1], place[:, 0]])

    likeness = np.min([look(inward * step) for step in STEPS], 0)
    near = inward < FAR * scale_px * shrink
    attraction = np.where(near & (region != REGIONS.index("neck")), likeness, 0.0)
    under_hair = (region == REGIONS.index("scalp")) * (1 - look(-value[:, 0] - 2.0))  # two pixels inside the edge
    margin = HAIR_M * lens.focal_px / pose.translation[2] * under_hair
    barycentric = barycentric[rows, columns].astype(np.float64)
    return Rim(triangles, barycentric, attraction, margin, rig.surface(triangles, barycentric))


def _cut_of_neck(rig: Rig, triangles: np.ndarray) -> np.ndarray:
    """Triangles [N] bool at the lower end of the mesh, where it is cut off: that edge is none of the person's."""
    lowest = rig.template[:, 1].max()
    return rig.template[rig.triangles[triangles], 1].max(1) > lowest - 0.012


def silhouette_rows(rim: Rim, edge: Edge, sigma_px: float, strength: float, lens: Camera, robust: float, at: Posed) -> Rows:
    """Signed distance of the rim to the matte's edge: full weight outside, weight by likeness inside.

    Args:
        sigma_px: standard deviation of the matte's edge, picture pixels; strength: weight of the whole term.
    """
    pixel = camera.project(at.points, lens.focal_px, lens.centre_px)
    place = pixel * edge.shrink - 0.5
    height, width = edge.distance.shape[:2]
    inside = (place > 0).all(1) & (place[:, 0] < width - 1) & (place[:, 1] < height - 1)
    across, down = place.astype(np.float32).T[..., None]  # [N, 1] each
    value = cv2.remap(edge.distance, across, down, cv2.INTER_LINEAR).reshape(-1, 3)
    away = value[:, 0] / edge.shrink
    outside = away + rim.margin_px > 0
    weight = np.where(outside, 1.0, rim.attraction) * inside * strength
    away = np.where(outside, away + rim.margin_px, away) / sigma_px
    # Huber outside; inside Geman-McClure, so that a far edge lets go.
    cost, influence = huber(np.abs(away), robust)
    soft = 1 / (1 + (away / (2 * robust)) ** 2)
    cost = np.where(outside, cost, 0.5 * away**2 * soft)
    influence = np.where(outside, influence, soft**2)
    root = np.sqrt(weight * influence)
    slope = value[:, 1:] / sigma_px * root[:, None]
    covector = np.einsum("ni,nij->nj", slope, camera.project_jacobian(at.points, lens.focal_px))
    used = np.flatnonzero(root > 0)
    return Rows(float((cost * weight).sum()), (away * root)[used], ((covector[used], used),))


def term_of(rim: Rim, edge: Edge, shape: np.ndarray, sigma_px: float, strength: float, lens: Camera, robust: float) -> Term:
    """The silhouette term of one frame, its surface folded with an identity [S]."""
    return Term(rim.surface.folded(shape), lambda at: silhouette_rows(rim, edge, sigma_px, strength, lens, robust, at))
