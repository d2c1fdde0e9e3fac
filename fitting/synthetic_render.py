"""Draws simulated clips: z-buffer, procedural albedo a pixel, second-order spherical harmonic light, 2 x 2 samples a pixel."""

from __future__ import annotations

import numpy as np
from numba import njit

from fitting import raster
from fitting.synthetic import Clip
from fitting.synthetic_paint import BLUSH, BROW, CLOTH, EYE, FOLD, HAIRLINE_M, LINE, LIP, MAP_LOW, MAP_STEP_M, SKIN, Paint, paint

IRIS_M, PUPIL_M, LIMBUS_M = 0.0062, 0.0024, 0.0009
SAMPLES = 2  # a side of each pixel
SMOOTH_PERIOD_M, GRAIN_PERIOD_M = 0.35, 0.045  # of the noise volume
GAMMA = 1 / 2.2


class Renderer:
    """Draws the frames of one clip."""

    def __init__(
        self, clip: Clip, hair: str = "bald", noise: float = 0.006, samples: int = SAMPLES, wrinkles: float = 1.0
    ) -> None:
        """Prepare the paint.

        Args:
            hair: `bald`, `short` or `full`; noise: standard deviation of the sensor noise, part of full scale.
            wrinkles: depth of the lines that come with expressions, as a multiple of the usual one.
        """
        self.clip, self.noise, self.samples, self.wrinkles = clip, noise, samples, wrinkles
        self.paint: Paint = paint(clip.head, clip.neutral.astype(np.float64), hair, clip.seed)
        self._front = self.paint.front.copy()
        self._hairline = np.ascontiguousarray(HAIRLINE_M)

    def frame(self, row: int) -> tuple[np.ndarray, np.ndarray]:
        """Picture [H, W, 3] uint8 sRGB over the background, and matte [H, W] uint8 of the whole person."""
        clip, paint = self.clip, self.paint
        height, width = clip.camera.size
        points, normals = self._mesh(row)
        pixel = np.concatenate([clip.camera.project(points) * self.samples, points[:, 2:]], 1)
        size = (height * self.samples, width * self.samples)
        index, _, bary = raster.rasterise(pixel, paint.triangles, size)
        values = np.concatenate([normals, points, paint.constant], 1).astype(np.float32)  # [V', 12]
        self._front[..., FOLD] = self.wrinkles * paint.wrinkles.darkness(self._actions(row))
        picture = _shade(
            index, bary, paint.triangles, paint.kind, values, self._front, paint.volume, paint.eyes, paint.colours,
            self._hairline, paint.hair, paint.freckles, clip.light, self.samples,
        )  # fmt: skip
        alpha = picture[..., 3]
        linear = picture[..., :3] + (1 - alpha[..., None]) * self._background()
        random = np.random.default_rng([clip.seed, 6, row])
        colour = (linear * clip.exposure[row]).clip(0, 1) ** GAMMA
        colour = colour + self.noise * random.standard_normal(colour.shape, dtype=np.float32)
        return (colour.clip(0, 1) * 255 + 0.5).astype(np.uint8), (alpha.clip(0, 1) * 255 + 0.5).astype(np.uint8)

    def _actions(self, row: int) -> np.ndarray:
        """Actions [E] of a frame, and zeros for the bumps behind them: no action's name, no wrinkle."""
        actions = self.clip.motion.expression[row]
        return np.concatenate([actions, np.zeros(len(self.clip.head.expression_names) - len(actions))])

    def _mesh(self, row: int) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and normals [V', 3] of head, torso and hair shell in camera axes."""
        paint, head = self.paint, self.clip.vertices[row].astype(np.float64)
        torso = paint.torso + self.clip.motion.translation[row]
        both = np.concatenate([head, torso])
        of_both = paint.triangles[(paint.triangles < len(both)).all(1)]
        normals = raster.vertex_normals(both, of_both)
        if not len(paint.shell):
            return both, normals
        lifted = head[paint.shell] + paint.shell_m[:, None] * normals[paint.shell]
        points = np.concatenate([both, lifted])
        return points, np.concatenate([normals, raster.vertex_normals(points, paint.triangles)[len(both) :]])

    def _background(self) -> np.ndarray:
        """Wall [H, 1, 3], linear, a little darker below."""
        height = self.clip.camera.size[0]
        return (self.paint.colours[5] * np.linspace(1.1, 0.8, height)[:, None, None]).astype(np.float32)


@njit(cache=True, fastmath=True)
def _noise(volume, x, y, z, channel):
    """Trilinear look-up in the periodic volume; coordinates in cells."""
    n = volume.shape[0]
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = int(fx) % n, int(fy) % n, int(fz) % n
    u, v, w = x - fx, y - fy, z - fz
    i1, j1, k1 = (i + 1) % n, (j + 1) % n, (k + 1) % n
    a = volume[i, j, k, channel] * (1 - w) + volume[i, j, k1, channel] * w
    b = volume[i, j1, k, channel] * (1 - w) + volume[i, j1, k1, channel] * w
    c = volume[i1, j, k, channel] * (1 - w) + volume[i1, j, k1, channel] * w
    d = volume[i1, j1, k, channel] * (1 - w) + volume[i1, j1, k1, channel] * w
    return (a * (1 - v) + b * v) * (1 - u) + (c * (1 - v) + d * v) * u


@njit(cache=True, fastmath=True)
def _step(low, high, value):
    t = min(1.0, max(0.0, (value - low) / (high - low)))
    return t * t * (3 - 2 * t)


@njit(cache=True, fastmath=True)
def _look_up(front, x, y, out):
    """Bilinear look-up of the frontal map at template x, y (m); zero outside."""
    px, py = (x - MAP_LOW[0]) / MAP_STEP_M, (y - MAP_LOW[1]) / MAP_STEP_M
    out[:] = 0.0
    if px < 0 or py < 0 or px >= front.shape[1] - 1 or py >= front.shape[0] - 1:
        return
    i, j = int(py), int(px)
    v, u = py - i, px - j
    for c in range(front.shape[2]):
        top = front[i, j, c] * (1 - u) + front[i, j + 1, c] * u
        bottom = front[i + 1, j, c] * (1 - u) + front[i + 1, j + 1, c] * u
        out[c] = top * (1 - v) + bottom * v


@njit(cache=True, fastmath=True)
def _skin(value, colours, front, volume, hairline, hair, freckles, masks, out):
    """Albedo of skin, lips, brows, hair and the inside of the mouth at template coordinates value[6:9]."""
    x, y, z = value[6], value[7], value[8]
    s, g = volume.shape[0] / SMOOTH_PERIOD_M, volume.shape[0] / GRAIN_PERIOD_M
    low = _noise(volume, x * s, y * s, z * s, 0)
    middle = _noise(volume, x * g * 0.3, y * g * 0.3, z * g * 0.3, 1)
    grain = _noise(volume, x * g, y * g, z * g, 1)
    masks[:] = 0.0
    facing = _step(-0.03, -0.05, z)
    if facing > 0:
        _look_up(front, x, y, masks)
    spots = freckles * _step(0.9, 1.6, middle) * _step(0.02, -0.03, abs(y) - 0.05)
    for c in range(3):
        redness = 0.0 if c == 0 else (0.16 if c == 1 else 0.10)
        skin = colours[0, c] * (1 + 0.05 * low + 0.06 * grain + 0.03 * middle)
        skin *= 1 - redness * masks[BLUSH] * facing
        skin *= 1 - spots * (0.35 if c == 0 else 0.5)
        skin *= 1 - masks[FOLD] * (0.9 if c == 0 else 1.0) * facing
        lip = colours[1, c] * (1 + 0.10 * grain)
        skin += (lip - skin) * masks[LIP] * facing
        skin += (colours[3, c] * 1.3 - skin) * min(1.0, 0.9 * masks[BROW]) * facing
        skin += (0.015 - skin) * 0.9 * masks[LINE] * facing
        if hair:
            edge = np.interp(z, hairline[:, 0], hairline[:, 1]) - y + 0.0015 * middle
            cover = _step(-0.002, 0.006, edge) * _step(0.083, 0.078, abs(x))
            skin += (colours[3, c] * (1 + 0.35 * grain) - skin) * 0.92 * cover * (1 - value[11])
        inside = value[10]
        gum = 0.30 if c == 0 else 0.07
        out[c] = skin + (gum - skin) * inside


@njit(cache=True, fastmath=True)
def _eye(value, eyes, colours, volume, out):
    """Albedo of an eyeball: white, limbus, iris with spokes, pupil, by the distance from the resting gaze axis."""
    side = 0 if value[6] > 0 else 1
    x, y = value[6] - eyes[side, 0], value[7] - eyes[side, 1]
    r = np.sqrt(x * x + y * y)
    if value[8] > eyes[side, 2]:
        r = 0.02
    white = 0.62 - 0.12 * _step(0.007, 0.014, r)
    spokes = _noise(volume, 9.0 * np.arctan2(y, x), r * 2500.0, 3.0, 1)
    iris = 1 + 0.35 * spokes
    ring = _step(IRIS_M - 2 * LIMBUS_M, IRIS_M - 0.3 * LIMBUS_M, r)
    outer = _step(IRIS_M - 0.4 * LIMBUS_M, IRIS_M + 0.6 * LIMBUS_M, r)
    hole = _step(PUPIL_M + 0.0002, PUPIL_M - 0.0002, r)
    for c in range(3):
        tint = 1.0 if c == 0 else (0.93 - 0.06 * _step(0.007, 0.013, r))
        colour = colours[2, c] * iris * (1 - 0.75 * ring)
        colour += (0.004 - colour) * hole
        out[c] = colour + (white * tint - colour) * outer


@njit(cache=True, fastmath=True)
def _shade(index, bary, triangles, kinds, values, front, volume, eyes, colours, hairline, hair, freckles, light, samples):
    """Linear premultiplied colour and coverage [H, W, 4]: the mean of samples x samples z-buffer cells a pixel."""
    height, width = index.shape[0] // samples, index.shape[1] // samples
    out = np.zeros((height, width, 4), np.float32)
    value, albedo, masks = np.zeros(values.shape[1]), np.zeros(3), np.zeros(front.shape[2])
    share = 1.0 / (samples * samples)
    for row in range(height * samples):
        for column in range(width * samples):
            f = index[row, column]
            if f < 0:
                continue
            for c in range(values.shape[1]):
                value[c] = (
                    bary[row, column, 0] * values[triangles[f, 0], c]
                    + bary[row, column, 1] * values[triangles[f, 1], c]
                    + bary[row, column, 2] * values[triangles[f, 2], c]
                )
            length = np.sqrt(value[0] ** 2 + value[1] ** 2 + value[2] ** 2) + 1e-12
            x, y, z = value[0] / length, value[1] / length, value[2] / length
            away = np.sqrt(value[3] ** 2 + value[4] ** 2 + value[5] ** 2) + 1e-12
            vx, vy, vz = -value[3] / away, -value[4] / away, -value[5] / away
            if x * vx + y * vy + z * vz < 0:  # a back face: the inside of the mouth seen through a gap
                x, y, z = -x, -y, -z
            kind = kinds[f]
            occlusion = value[9]
            if kind == EYE:
                _eye(value, eyes, colours, volume, albedo)
                occlusion = 0.35 + 0.65 * occlusion
                gloss, power = 0.9, 400.0
            elif kind == SKIN:
                _skin(value, colours, front, volume, hairline, hair, freckles, masks, albedo)
                occlusion = occlusion**1.35 * (1 - value[10]) + (0.12 + 0.5 * occlusion) * value[10]
                gloss, power = 0.045 + 0.05 * masks[LIP], 18.0
            else:
                cell = 1600.0 if kind == CLOTH else 900.0
                g = _noise(volume, value[6] * cell, value[7] * cell * 0.4, value[8] * cell, 1)
                for c in range(3):
                    albedo[c] = colours[4 if kind == CLOTH else 3, c] * (1 + (0.12 if kind == CLOTH else 0.4) * g)
                gloss, power = (0.0, 1.0) if kind == CLOTH else (0.03, 12.0)
            irradiance = light[0] + light[1] * y + light[2] * z + light[3] * x
            irradiance += light[4] * x * y + light[5] * y * z + light[6] * 0.5 * (3 * z * z - 1) / np.sqrt(3.0)
            irradiance += light[7] * x * z + light[8] * 0.5 * (x * x - y * y)
            irradiance = max(0.03, irradiance) * occlusion
            hx, hy, hz = light[3] + vx * 0.4, light[1] + vy * 0.4, light[2] + vz * 0.4
            h = np.sqrt(hx * hx + hy * hy + hz * hz) + 1e-12
            shine = gloss * max(0.0, (x * hx + y * hy + z * hz) / h) ** power * occlusion
            i, j = row // samples, column // samples
            for c in range(3):
                out[i, j, c] += share * (albedo[c] * irradiance * 1.5 + shine)
            out[i, j, 3] += share
    return out
