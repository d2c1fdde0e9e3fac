"""The photometric term: surface samples keep their colour.  No differentiable rasteriser is needed (Face2Face's residual, sampled
on the surface instead of the screen): a z-buffer says which samples are seen, the picture is read at their projections.

Model of a sample's grey value: I(pi(x_p)) = gain_t * albedo_p * (1 + light . H(n_p)) + offset_t, with one albedo a sample and one
light a video, from training keyframes, and gain and offset a frame, eliminated in closed form.  H are the spherical harmonics of
order 1 and 2 (8 values).  Letters: P samples, K keyframes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit

from fitting import camera, raster
from fitting.energy import Camera, Rows, huber
from fitting.head_model import REGIONS
from fitting.rig import POSE, Pose, Posed, Rig, Surface, posed

SAMPLED = ("face", "ears")
DEPTH_TOLERANCE_M = 0.004
Z_BUFFER = 192  # longer side of the visibility buffer
LEVELS = (0.030, 0.012)  # blur of the pyramid's levels, in inter-ocular distances
LEAST_EXPLAINED = 0.05  # a light that explains less than this of keyframes kept out is left out
LEAST_BLUR_PX = 1.5  # blur of the finest level is never smaller


@dataclass(frozen=True)
class Samples:
    """Points on the skin that are compared."""

    triangles: np.ndarray  # [P]
    barycentric: np.ndarray  # [P, 3]
    surface: Surface  # unfolded


@dataclass(frozen=True)
class Appearance:
    """What the video's skin looks like, one per pyramid level."""

    albedo: np.ndarray  # [levels, P] grey, NaN where a sample was never seen
    light: np.ndarray  # [8] spherical harmonics of order 1 and 2 over the constant one; zeros: no light model
    sigma: np.ndarray  # [levels] robust standard deviation of the residual on keyframes, grey values
    explained: float  # part of the residual variance that the light explains on keyframes it was not learned from


def choose_samples(rig: Rig, count: int, seed: int = 0) -> Samples:
    """Area-weighted random points of face and ears, twice as dense at the front of the face where features are.

    Eyeballs, mouth cavity and scalp are left out: they move or look otherwise than the mesh says.
    """
    random = np.random.default_rng(seed)
    wanted = np.isin(rig.region, [REGIONS.index(name) for name in SAMPLED])[rig.triangles].all(1)
    corners = rig.template[rig.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) * wanted
    front = corners.mean(1)[:, 2] < np.quantile(corners.mean(1)[wanted, 2], 0.5)
    weight = area * (1 + front)
    triangles = random.choice(len(area), count, p=weight / weight.sum())
    root, second = np.sqrt(random.random(count)), random.random(count)
    barycentric = np.stack([1 - root, root * (1 - second), root * second], 1)
    return Samples(triangles, barycentric, rig.surface(triangles, barycentric))


@dataclass(frozen=True)
class Level:
    """One level of a frame's pyramid: the part of the picture around the face, blurred."""

    values: np.ndarray  # [h, w, 3] float32 grey value (0 to 255), its x and y derivative a pixel
    corner_px: np.ndarray  # [2] where it lies in the picture


def pyramid(image: np.ndarray, pixels: np.ndarray, scale_px: float, levels: Sequence[int]) -> list[Level]:
    """Blurred grey pictures with their gradients.

    Args:
        image: [H, W, 3] uint8; pixels: [P, 2] points that will be looked at, the part around them is cut out;
        scale_px: inter-ocular distance; levels: which ones, numbers into LEVELS.
    """
    margin = 3 * LEVELS[0] * scale_px + 4
    low = np.clip(np.floor(pixels.min(0) - margin), 0, None).astype(int)
    high = np.ceil(pixels.max(0) + margin).astype(int)
    part = np.ascontiguousarray(image[low[1] : max(high[1], low[1] + 2), low[0] : max(high[0], low[0] + 2)])
    if not part.size:
        return [Level(np.zeros((2, 2, 3), np.float32), low) for _ in levels]
    grey = cv2.cvtColor(part, cv2.COLOR_RGB2GRAY).astype(np.float32)
    out = []
    for level in levels:
        blurred = cv2.GaussianBlur(grey, (0, 0), max(LEVELS[level] * scale_px, LEAST_BLUR_PX))
        slope = [cv2.filter2D(blurred, -1, kernel) for kernel in (np.float32([[-0.5, 0, 0.5]]), np.float32([[-0.5], [0], [0.5]]))]
        out.append(Level(cv2.merge([blurred, *slope]), low))
    return out


@njit(cache=True)
def _read(picture, pixel, out, inside):
    height, width = picture.shape[0], picture.shape[1]
    for p in range(len(pixel)):
        x, y = pixel[p, 0] - 0.5, pixel[p, 1] - 0.5
        inside[p] = x >= 0 and y >= 0 and x < width - 1 and y < height - 1
        if not inside[p]:
            continue
        c, r = int(x), int(y)
        u, v = x - c, y - r
        for k in range(3):
            top = picture[r, c, k] * (1 - u) + picture[r, c + 1, k] * u
            bottom = picture[r + 1, c, k] * (1 - u) + picture[r + 1, c + 1, k] * u
            out[p, k] = top * (1 - v) + bottom * v


def read(level: Level, pixel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bilinear values [P, 3] of a level at pixels [P, 2] of the picture (centres at +0.5), and which lie inside [P] bool."""
    out, inside = np.zeros((len(pixel), 3)), np.zeros(len(pixel), np.bool_)
    _read(level.values, pixel - level.corner_px, out, inside)
    return out, inside


def visible(
    rig_vertices: Surface, triangles: np.ndarray, pose: Pose, lens: Camera, size: tuple[int, int], points: np.ndarray
) -> np.ndarray:
    """Which points [P, 3] m (camera axes) nothing of the mesh hides [P] bool.

    Args:
        rig_vertices: all vertices, folded; size: (H, W) of the picture.
    """
    shrink = Z_BUFFER / max(size)
    shape = (round(size[0] * shrink), round(size[1] * shrink))
    mesh = raster.project(posed(rig_vertices, pose).points, lens.focal_px * shrink, lens.centre_px * shrink)
    first, second, third = (mesh[triangles[:, k], :2] for k in range(3))
    side, other = second - first, third - first
    front = side[:, 0] * other[:, 1] < side[:, 1] * other[:, 0]  # seen from outside, outward triangles run anticlockwise
    _, depth, _ = raster.rasterise(mesh, triangles[front], shape)
    pixel = camera.project(points, lens.focal_px * shrink, lens.centre_px * shrink).astype(int)
    inside = ((pixel >= 0) & (pixel < [shape[1], shape[0]])).all(1)
    pixel = np.clip(pixel, 0, [shape[1] - 1, shape[0] - 1])
    # The buffer is coarse: a sample on a slope may lie behind its pixel's centre, so the farthest of its neighbours counts.
    far = cv2.dilate(np.where(np.isfinite(depth), depth, 0), np.ones((3, 3), np.uint8))
    return inside & (points[:, 2] < far[pixel[:, 1], pixel[:, 0]] + DEPTH_TOLERANCE_M)


def harmonics(normal: np.ndarray) -> np.ndarray:
    """Real spherical harmonics of order 1 and 2 without their constants [P, 8] of unit normals [P, 3]."""
    x, y, z = normal.T
    return np.stack([x, y, z, x * y, y * z, 3 * z**2 - 1, x * z, x**2 - y**2], 1)


def weights_of(surface: Surface, pose: Pose, seen: np.ndarray) -> np.ndarray:
    """Weight [P] of samples: squared cosine towards the camera, nothing below 0.2, nothing for hidden ones."""
    toward = -(surface.normal @ (pose.rotation.T @ pose.translation)) / np.linalg.norm(pose.translation)
    return np.where(seen & (toward > 0.2), toward**2, 0.0)


def photometric_rows(
    picture: Level,
    colour: np.ndarray,
    weight: np.ndarray,
    sigma: float,
    strength: float,
    lens: Camera,
    robust: float,
    at: Posed,
    rigid: float = 1.0,
) -> Rows:
    """Difference between a frame's picture and the samples' shaded colours, gain and offset of the frame eliminated.

    What a motion of all samples together explains may count less than the rest: with a wrong identity or focal length the
    skin's colours sit a little wrong in every view, which should not turn the head; lids, brows and lips move against the rest.
    The derivative leaves out how that motion's columns change with the pose; a step still counts only if the cost falls.

    Args:
        picture: one pyramid level; colour: [P] albedo times light, NaN where unknown; weight: [P]; sigma: grey values;
        strength: how much the whole term counts (a sum of weights of this size is one landmark's worth, see `fitting.settings`);
        rigid: strength, relative to that, of what a rigid motion of the samples explains, in [0, 1].
    """
    pixel = camera.project(at.points, lens.focal_px, lens.centre_px)
    value, inside = read(picture, pixel)
    used = np.flatnonzero(inside & (weight > 0) & np.isfinite(colour))
    if len(used) < 50:
        return Rows(0.0, np.zeros(0), ((np.zeros((0, 3)), np.zeros(0, int)),))
    root = np.sqrt(weight[used])
    columns = np.stack([colour[used], np.ones(len(used))], 1)
    fitted = robust_gain(columns, value[used, 0], root, sigma, robust)
    away = (value[used, 0] - columns @ fitted) / sigma
    cost, influence = huber(np.abs(away), robust)
    factor = root * np.sqrt(influence * strength)
    slope = value[used, 1:] / sigma * factor[:, None]
    covector = np.einsum("pi,pij->pj", slope, camera.project_jacobian(at.points[used], lens.focal_px))
    total = float((cost * weight[used]).sum() * strength)
    columns = columns * (factor / sigma)[:, None]
    if rigid == 1:
        return Rows(total, away * factor, ((covector, used),), columns)
    moved = np.concatenate([np.cross(at.points[used] - at.pose.translation, covector), covector], 1)
    kept = np.sqrt(np.repeat([0.0, rigid], [columns.shape[1], POSE]))
    return Rows(total, away * factor, ((covector, used),), np.concatenate([columns, moved], 1), kept)


def robust_gain(columns: np.ndarray, value: np.ndarray, root: np.ndarray, sigma: float, robust: float) -> np.ndarray:
    """Gain and offset [2] of a frame: weighted least squares, three times reweighted."""
    weight = root**2
    for _ in range(3):
        normal = columns.T @ (columns * weight[:, None])
        fitted = np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(2), columns.T @ (weight * value))
        away = np.abs(value - columns @ fitted) / sigma
        weight = root**2 * np.where(away > robust, robust / np.maximum(away, 1e-9), 1.0)
    return fitted


def inside(alpha: np.ndarray, pixels: np.ndarray, margin_px: float) -> np.ndarray:
    """Which pixels [P, 2] lie inside a matte [H, W] uint8, at least margin_px from its edge [P] bool."""
    height, width = alpha.shape
    reach = int(np.ceil(margin_px))
    place = pixels.astype(int)
    out = ((place >= 0) & (place < [width, height])).all(1)
    for across, down in (
        (0, 0),
        (-reach, 0),
        (reach, 0),
        (0, -reach),
        (0, reach),
    ):  # beyond the picture's border is not background
        near = np.clip(place + [across, down], 0, [width - 1, height - 1])
        out &= alpha[near[:, 1], near[:, 0]] > 127
    return out


def learn(pictures: list[list[Level]], pixels: np.ndarray, weights: np.ndarray, normals: np.ndarray) -> Appearance:
    """Albedo, light and residual spread from keyframes, by alternation.

    The light is modelled only where it explains keyframes that it was not learned from: every other one is kept out once.

    Args:
        pictures: K pyramids; pixels: [K, P, 2]; weights: [K, P] 0 where not seen; normals: [K, P, 3] camera axes.
    """
    keyframes, count = weights.shape
    values = np.zeros((len(LEVELS), keyframes, count))
    weights = weights.copy()
    for k in range(keyframes):
        for level, picture in enumerate(pictures[k]):
            value, seen = read(picture, pixels[k])
            values[level, k] = value[:, 0]
        weights[k] *= seen
    shapes = np.stack([harmonics(normal) for normal in normals])  # [K, P, 8]
    explained = _explained(values[-1], weights, shapes) if keyframes >= 6 else 0.0
    light = _alternate(values[-1], weights, shapes)[1] if explained > LEAST_EXPLAINED else np.zeros(8)
    shade = np.clip(1 + shapes @ light, 0.3, None)
    fitted = [_alternate(value / shade, weights, None) for value in values]
    sigma = np.array([max(one[2], 1.0) for one in fitted])
    return Appearance(np.stack([one[0] for one in fitted]), light, sigma, explained)


def _explained(values: np.ndarray, weights: np.ndarray, shapes: np.ndarray) -> float:
    """Part of the residual variance of every other keyframe that the light of the others explains (negative: it harms)."""
    learned, kept = slice(0, None, 2), slice(1, None, 2)
    spreads = []
    for basis in (None, shapes):
        albedo, light, _ = _alternate(values[learned], weights[learned], None if basis is None else basis[learned])
        known = np.where(np.isfinite(albedo), weights[kept], 0.0)
        told = np.where(np.isfinite(albedo), albedo, 0.0) * np.clip(1 + shapes[kept] @ light, 0.3, None)  # these weigh nothing
        gain = (known * told * values[kept]).sum(1) / np.maximum((known * told**2).sum(1), 1e-9)
        spreads.append(np.median(np.abs(values[kept] - gain[:, None] * told)[known > 0]) if (known > 0).any() else 1.0)
    return float(1 - (spreads[1] / max(spreads[0], 1e-9)) ** 2)


def _alternate(values: np.ndarray, weights: np.ndarray, shapes: np.ndarray | None) -> tuple[np.ndarray, np.ndarray, float]:
    """Albedo [P] (NaN where seen in fewer than two keyframes' worth), light [8], robust residual spread.

    Gains are per keyframe with mean one; offsets are left to the term itself.
    """
    keyframes, count = values.shape
    gain, light = np.ones(keyframes), np.zeros(8)
    robust = weights.copy()
    for _ in range(8):
        shade = np.clip(1 + (0 if shapes is None else shapes @ light), 0.3, None) * gain[:, None]
        total = (robust * shade**2).sum(0)
        albedo = (robust * shade * values).sum(0) / np.maximum(total, 1e-9)
        shade = shade / gain[:, None]
        told = (robust * (albedo * shade) ** 2).sum(1)
        gain = np.where(told > 0, (robust * values * albedo * shade).sum(1) / np.where(told > 0, told, 1), 1.0)
        gain = np.maximum(gain / (gain[told > 0].mean() if told.any() else 1), 1e-3)  # told 0: sees nothing, or only black
        if shapes is not None:
            base = albedo * gain[:, None]
            target = values - base
            columns = shapes * base[..., None]
            normal = np.einsum("kp,kpi,kpj->ij", robust, columns, columns, optimize=True)
            normal += (1e-3 * np.trace(normal) / 8 + 1e-9) * np.eye(8)  # nothing may be seen of it
            light = np.linalg.solve(normal, np.einsum("kp,kpi,kp->i", robust, columns, target, optimize=True))
        shade = np.clip(1 + (0 if shapes is None else shapes @ light), 0.3, None) * gain[:, None]
        away = values - albedo * shade
        spread = 1.4826 * np.median(np.abs(away[weights > 0])) if (weights > 0).any() else 1.0
        robust = weights / (1 + (away / (2.5 * max(spread, 0.5))) ** 2)
    return np.where((weights > 0.04).sum(0) >= 2, albedo, np.nan), light, float(spread)
