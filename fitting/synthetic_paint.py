"""What a simulated head is painted with: all that does not change over a clip, and wrinkles that do.

Albedo is evaluated a pixel at a time from the template coordinates under it (so that it sticks to the surface): noise and
freckles from a periodic volume, lips, brows and lid lines from a frontal map drawn around MediaPipe's landmarks, iris and
pupil from the distance to the gaze axis, hair from a hairline.  Shadow in folds is the ambient occlusion of the neutral head.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from fitting import raster
from fitting.head_model import REGIONS, HeadModel
from fitting.synthetic_wrinkles import Wrinkles, wrinkles

SKIN, EYE, CLOTH, SHELL = range(4)  # kinds of triangle
LIP, BROW, LINE, BLUSH, FOLD = range(5)  # channels of the frontal map
MAP_STEP_M = 0.0004
MAP_LOW, MAP_HIGH = np.array([-0.085, -0.075]), np.array([0.085, 0.115])  # x, y m of the template
UPPER_BROWS, LOWER_BROWS = ((70, 63, 105, 66, 107), (300, 293, 334, 296, 336)), ((46, 53, 52, 65, 55), (276, 283, 282, 295, 285))
UPPER_LIDS = ((33, 246, 161, 160, 159, 158, 157, 173, 133), (263, 466, 388, 387, 386, 385, 384, 398, 362))
LOWER_LIDS = ((33, 7, 163, 144, 145, 153, 154, 155, 133), (263, 249, 390, 373, 374, 380, 381, 382, 362))
OUTER_LIPS = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
BLUSH_AT = ((50, 0.018, 1.0), (280, 0.018, 1.0), (4, 0.012, 0.8), (152, 0.02, 0.4))  # landmark, radius m, amount
SKIN_TONES = np.array([[0.60, 0.37, 0.28], [0.52, 0.31, 0.22], [0.40, 0.23, 0.155], [0.25, 0.135, 0.085], [0.15, 0.08, 0.052]])
IRIS_TONES = np.array([[0.10, 0.19, 0.30], [0.12, 0.17, 0.09], [0.11, 0.055, 0.022], [0.05, 0.025, 0.012]])
HAIR_TONES = np.array([[0.012, 0.010, 0.009], [0.035, 0.02, 0.012], [0.09, 0.05, 0.025], [0.20, 0.13, 0.06]])
HAIRLINE_M = np.array(
    [[-0.1, -0.088], [-0.065, -0.078], [-0.035, -0.05], [-0.018, 0.0], [0.0, 0.015], [0.03, 0.035], [0.12, 0.055]]
)
"""Depth z and height y of the template: hair grows above."""
# Height, half width, half depth and depth of the middle (m, template axes) of the rings of neck and shoulders.
TORSO = np.array([
    [0.095, 0.046, 0.033, 0.045], [0.14, 0.050, 0.050, 0.036], [0.143, 0.062, 0.062, 0.035],
    [0.155, 0.075, 0.068, 0.035], [0.175, 0.13, 0.082, 0.03], [0.20, 0.185, 0.10, 0.03],
    [0.24, 0.215, 0.115, 0.03], [0.32, 0.225, 0.12, 0.03], [0.7, 0.22, 0.12, 0.03],
])  # fmt: skip
CLOTH_FROM_RING = 2
NAPE_M = 0.013  # the first ring is this much higher behind than in the middle: the head's mesh ends high at the nape
RING_POINTS = 48


@dataclass(frozen=True)
class Paint:
    """Constant inputs of the shader; V' vertices are the head's, then the torso's, then the hair shell's."""

    triangles: np.ndarray  # [F', 3]
    kind: np.ndarray  # [F'] of SKIN, EYE, CLOTH, SHELL
    constant: np.ndarray  # [V', 6] float32: template coordinates (m), occlusion, shares of the mouth's inside and of the ears
    front: np.ndarray  # [Y, X, 5] float32 frontal map; its last channel, the wrinkles', is of a face at rest
    wrinkles: Wrinkles
    volume: np.ndarray  # [64, 64, 64, 2] float32 periodic noise: smooth and grainy, unit variance
    torso: np.ndarray  # [N, 3] m before the translation
    shell: np.ndarray  # [N] vertex numbers of the hair shell
    shell_m: np.ndarray  # [N] its height over the skin
    eyes: np.ndarray  # [2, 3] eye joints, left, right, m
    colours: np.ndarray  # [6, 3] linear: skin, lips, iris, hair, cloth, background
    hair: bool
    freckles: float


def paint(head: HeadModel, neutral: np.ndarray, hair: str, seed: int, shell_m: float = 0.015) -> Paint:
    """Paint of one subject.

    Args:
        head: the rich model (its template gives the coordinates, its landmarks the places of lips, brows and lids).
        neutral: [V, 3] m, the subject's neutral head, for occlusion.
        hair: `bald`, `short` (darker scalp) or `full` (and a shell of shell_m over the scalp).
    """
    random = np.random.default_rng([seed, 5])
    template, region = head.template.numpy().astype(np.float64), head.region.numpy()
    triangles = head.triangles.numpy()
    eyeball = region == REGIONS.index("eyeballs")
    inside = np.isin(region, [REGIONS.index("mouth_cavity"), REGIONS.index("tongue")])
    occlusion = ambient_occlusion(neutral, triangles)
    ears = region == REGIONS.index("ears")
    constant = np.concatenate([template, occlusion[:, None], inside[:, None], ears[:, None]], 1)
    torso, torso_triangles, ring = _torso()
    torso_constant = np.concatenate([torso, np.tile([0.95, 0.0, 0.0], (len(torso), 1))], 1)
    covered = np.flatnonzero(_haired(template, region)) if hair == "full" else np.zeros(0, np.int64)
    number = np.full(len(template), -1)
    number[covered] = len(template) + len(torso) + np.arange(len(covered))
    shell_triangles = number[triangles[(number[triangles] >= 0).all(1)]]
    above = (np.interp(template[covered, 2], *HAIRLINE_M.T) - template[covered, 1]) / 0.02
    shell_constant = constant[covered].copy()
    shell_constant[:, 3] = 1.0
    tone = random.integers(len(SKIN_TONES))
    skin = SKIN_TONES[tone] * random.uniform(0.93, 1.07, 3)
    lips = skin * [0.80, 0.46, 0.50] + [0.03, 0.0, 0.005]
    hair_tone = HAIR_TONES[min(random.integers(len(HAIR_TONES)), 3 if tone < 2 else 0)]
    iris = IRIS_TONES[random.integers(len(IRIS_TONES)) if tone < 2 else 2 + random.integers(2)]
    cloth = random.uniform(0.04, 0.25) * random.uniform(0.6, 1.4, 3)
    background = random.uniform(0.25, 0.6) * random.uniform(0.9, 1.1, 3)
    return Paint(
        np.concatenate([triangles, torso_triangles + len(template), shell_triangles]),
        np.concatenate([
            np.where(eyeball[triangles].all(1), EYE, SKIN),
            np.where((ring[torso_triangles] >= CLOTH_FROM_RING).all(1), CLOTH, SKIN),
            np.full(len(shell_triangles), SHELL),
        ]),
        np.concatenate([constant, torso_constant, shell_constant]).astype(np.float32),
        _front_map(head, random),
        wrinkles(head.landmarks(head.template).numpy()[:, :2], head.expression_names, MAP_LOW, MAP_STEP_M, _map_size(), seed),
        _volume(random),
        torso,
        covered,
        shell_m * above.clip(0, 1),
        head.joints.numpy().astype(np.float64)[3:],
        np.stack([skin, lips, iris, hair_tone, cloth, background]),
        hair != "bald",
        random.uniform(0.0, 0.35) if tone < 3 else 0.1,
    )  # fmt: skip


def ambient_occlusion(vertices: np.ndarray, triangles: np.ndarray, directions: int = 80, size: int = 224) -> np.ndarray:
    """Part of the sky above each vertex's surface that it sees [V] in [0, 1], cosine-weighted, by parallel z-buffers."""
    normal = raster.vertex_normals(vertices, triangles)
    golden = np.pi * (3 - np.sqrt(5))
    height = 1 - 2 * (np.arange(directions) + 0.5) / directions
    radius = np.sqrt(1 - height**2)
    sky = np.stack([radius * np.cos(golden * np.arange(directions)), height, radius * np.sin(golden * np.arange(directions))], 1)
    middle = (vertices.max(0) + vertices.min(0)) / 2
    extent = np.linalg.norm(vertices - middle, axis=1).max() * 1.02
    seen, total = np.zeros(len(vertices)), np.zeros(len(vertices))
    for towards in sky:
        side = np.cross(towards, [0.0, 0.0, 1.0] if abs(towards[2]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        turned = (vertices - middle) @ np.stack([side, np.cross(towards, side), -towards], 1)
        pixel = (turned[:, :2] / extent + 1) * size / 2
        depth = raster.rasterise(np.concatenate([pixel, turned[:, 2:] + 100.0], 1), triangles, (size, size))[1]
        at = np.floor(pixel).astype(int).clip(0, size - 1)
        near = depth[at[:, 1], at[:, 0]] - 100.0
        cosine = (normal @ towards).clip(0)
        seen += cosine * (turned[:, 2] < near + 0.0025)
        total += cosine
    return seen / total.clip(1e-9)


def _haired(template: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Vertices [V] bool above the hairline."""
    return (template[:, 1] < np.interp(template[:, 2], *HAIRLINE_M.T)) & np.isin(
        region, [REGIONS.index("scalp"), REGIONS.index("face"), REGIONS.index("neck")]
    )


def _torso() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Neck stump and shoulders: vertices [N, 3] m, triangles, ring of each vertex [N]."""
    around = np.arange(RING_POINTS)
    cosine, sine = np.cos(2 * np.pi * around / RING_POINTS), np.sin(2 * np.pi * around / RING_POINTS)
    y, width, depth, middle = TORSO.T[:, :, None]
    high = np.where(np.arange(len(TORSO))[:, None] == 0, NAPE_M * sine, 0.0)
    points = np.stack([width * cosine, y - high, middle + depth * sine], -1).reshape(-1, 3)
    ring = np.arange(len(TORSO) - 1)[:, None] * RING_POINTS
    first, after = ring + around, ring + (around + 1) % RING_POINTS
    quads = np.stack([first, first + RING_POINTS, after + RING_POINTS, after], -1).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]]])
    return points, triangles, np.repeat(np.arange(len(TORSO)), RING_POINTS)


def _volume(random: np.random.Generator, side: int = 64) -> np.ndarray:
    """Two periodic noises [side, side, side, 2] of unit variance: blotches and grain."""
    white = random.normal(size=(side, side, side, 2))
    smooth, grain = gaussian_filter(white[..., 0], 3.0, mode="wrap"), gaussian_filter(white[..., 1], 0.9, mode="wrap")
    return np.stack([smooth / smooth.std(), grain / grain.std()], -1).astype(np.float32)


def _map_size() -> tuple[int, int]:
    """Y, X of the frontal map."""
    width, height = np.ceil((MAP_HIGH - MAP_LOW) / MAP_STEP_M).astype(int)
    return int(height), int(width)


def _front_map(head: HeadModel, random: np.random.Generator) -> np.ndarray:
    """Lips, brows, lid lines and redness [Y, X, 5] as seen from the front of the template; zero where landmarks have no place."""
    height, width = _map_size()
    points = head.landmarks(head.template).numpy()[:, :2]
    pixel = (points - MAP_LOW) / MAP_STEP_M
    out = np.zeros((height, width, 5), np.float32)

    def placed(ids: tuple[int, ...]) -> np.ndarray:
        return pixel[[k for k in ids if np.isfinite(pixel[k, 0])]]

    def filled(polygon: np.ndarray, sigma: float) -> np.ndarray:
        canvas = np.zeros((height, width), np.float32)
        if len(polygon) > 2:
            cv2.fillPoly(canvas, [np.round(polygon * 16).astype(np.int32)], 1.0, shift=4)
        return cv2.GaussianBlur(canvas, (0, 0), sigma)

    out[..., LIP] = filled(placed(OUTER_LIPS), 2.0)
    for upper, lower in zip(UPPER_BROWS, LOWER_BROWS, strict=True):
        out[..., BROW] = np.maximum(out[..., BROW], filled(np.concatenate([placed(upper), placed(lower)[::-1]]), 3.0))
    hairs = gaussian_filter(random.normal(size=(height, width)), (2.0, 0.8))  # strokes that stand
    out[..., BROW] *= 0.85 + 0.25 * np.tanh(hairs / hairs.std()).astype(np.float32)
    for lids, strength, thickness in ((UPPER_LIDS, 1.0, 6), (LOWER_LIDS, 0.35, 3)):  # lashes hang from the upper lid
        for ids in lids:
            canvas = np.zeros((height, width), np.float32)
            cv2.polylines(canvas, [np.round(placed(ids) * 16).astype(np.int32)], False, 1.0, thickness, cv2.LINE_8, 4)
            out[..., LINE] = np.maximum(out[..., LINE], strength * cv2.GaussianBlur(canvas, (0, 0), 1.4))
    y, x = np.mgrid[:height, :width]
    for landmark, radius, amount in BLUSH_AT:
        if np.isfinite(pixel[landmark, 0]):
            away = np.hypot(x - pixel[landmark, 0], y - pixel[landmark, 1]) * MAP_STEP_M
            out[..., BLUSH] += (amount * np.exp(-0.5 * (away / radius) ** 2)).astype(np.float32)
    return np.ascontiguousarray(out.clip(0, 1))
