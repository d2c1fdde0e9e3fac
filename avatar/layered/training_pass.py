"""The compiled passes behind `avatar.layered.composite`: draw with what gradients need, and hand gradients to texels and maps.

As `avatar.layered.compiled`, whose vector types it uses: a texel is one vector, and a row of pixels passes stage by stage, so
that one pixel waits for its texels while others are computed with. But nothing is approximate here: the sigmoid is right to
float32, a layer is fetched only where light is left, and what is not a number stays so (a step with such a loss is not taken).

nerface.mp4, 256 x 256 samples, 8 layers of 512 x 512 texels, one thread, ms against loops in plain numba: forward 16 (42),
backward 19 (38; without asking for texels ahead 28). Not faster: blocks of 32 or 128, and pages of 2 MiB for the textures
(24 and 32: lines of a power of two fall on the same places of the cache).
Letters: L layers, R texels a side of a texture, r of a frame's map, K bases, C = 4 (1 + K), h x w samples. All arrays are flat.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numba import njit

from avatar.layered.compiled import _lane, _load, _nothing, _prefetch, _sort, _store
from avatar.layered.training_lanes import (
    CAREFUL,
    LEAD,
    _add_to,
    _bilinear,
    _count,
    _of_map,
    _of_texel,
    _shown,
    padded_fields,
)

__all__ = ["LEAD", "drawing", "logit_gradients", "padded_fields", "scattering"]

BLOCK = 64  # items that pass each stage together
DARK = np.float32(0.002)  # light below which what lies behind is not looked at: half a level of 8 bits
HALF, ONE, NONE = np.float32(0.5), np.float32(1), np.float32(0)


@njit
def _tap(at, size):  # noqa: ANN001, ANN202
    """The first of two texels around a coordinate in texels, the second one's share, and whether the coordinate was free."""
    x, most = at - HALF, np.float32(size - 1)
    free = x > NONE and x < most
    x = x if x > NONE else NONE  # of a NaN too
    x = x if x < most else most
    first = min(np.int64(x), size - 2)
    return first, x - np.float32(first), free


@lru_cache
def drawing(bases: int) -> Callable[..., None]:
    """The forward pass for K bases."""
    channels, fields = 4 * (1 + bases), padded_fields(bases)

    @njit(nogil=True, fastmath=set(CAREFUL), error_model="numpy", cache=True)
    def run(texture, maps, near, uv, image, depth, visited, shown, looked, size, layers, share, shares):  # noqa: ANN001, ANN202
        """image: [h w 4], depth: [h w], visited: [h] int64, looked: [h w] uint8 layers fetched of a pixel, all to be filled;
        shown: [L h w 4] colour and opacity where they were, or empty; near: [L h w] 1/m; size: h, w, R, r.
        """
        height, width, side, small = size
        plane, keeps = height * width, len(shown) > 0
        keys, order, counts = np.empty(layers, np.float32), np.empty(BLOCK * layers, np.int32), np.empty(BLOCK, np.int32)
        light, along, colour = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(4 * BLOCK, np.float32)
        pixel, place, texel = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)  # of each item
        within, lanes = np.empty(2 * BLOCK, np.float32), np.empty(BLOCK * fields, np.float32)
        for row in range(share, height, shares):
            seen = 0
            for begin in range(0, width, BLOCK):
                first, number = row * width + begin, min(BLOCK, width - begin)
                for p in range(number):  # a pixel's layers, nearest first
                    counts[p] = _sort(near, first + p, plane, layers, order, p * layers, keys)
                    light[p], along[p] = ONE, NONE
                    looked[first + p] = 0
                    _store(colour, 4 * p, _nothing(4))
                for rank in range(layers):
                    items = 0
                    for p in range(number):
                        pixel[items] = p
                        items += rank < counts[p] and not light[p] < DARK
                    if items == 0:
                        break
                    seen += items
                    for i in range(items):  # the map, and where to read the texture
                        layer = order[pixel[i] * layers + rank]
                        place[i] = layer * plane + first + pixel[i]
                        u, v = uv[2 * place[i]], uv[2 * place[i] + 1]
                        (column, x, _), (line, y, _) = _tap(u * small, small), _tap((ONE - v) * small, small)
                        mix = _bilinear(maps, ((layer * small + line) * small + column) * fields, small * fields, x, y, fields)
                        _store(lanes, i * fields, mix)
                        column, within[2 * i], _ = _tap((u + _lane(mix, 0)) * side, side)
                        line, within[2 * i + 1], _ = _tap((ONE - v - _lane(mix, 1)) * side, side)
                        texel[i] = ((layer * side + line) * side + column) * channels
                        _ask(texture, texel[i], side, channels)
                    for i in range(items):  # colour and opacity, and on top of what is nearer
                        p = pixel[i]
                        fetched = _bilinear(texture, texel[i], side * channels, within[2 * i], within[2 * i + 1], channels)
                        result = _shown(fetched, _load(lanes, i * fields, fields), bases)
                        if keeps:
                            _store(shown, 4 * place[i], result)
                        weight = light[p] * _lane(result, 3)
                        _add_to(colour, 4 * p, result, weight)
                        along[p] += weight / near[place[i]]
                        light[p] -= weight
                        looked[first + p] = rank + 1
                for p in range(number):
                    at, rest = first + p, light[p]
                    for c in range(3):
                        image[4 * at + c] = colour[4 * p + c] + rest
                    image[4 * at + 3] = ONE - rest
                    depth[at] = along[p] / (ONE - rest) if rest < ONE else NONE
            visited[row] = seen

    return run


@njit(nogil=True, fastmath=set(CAREFUL), error_model="numpy", cache=True)
def logit_gradients(near, upstream, shown, looked, used, layers, height, width, share, shares):  # noqa: ANN001, ANN201
    """Turn `shown` of `drawing` into the gradient of the logits, and set used: [L h w] uint8 to 1 where it does.

    upstream: [h w 4] of the image.
    """
    plane = height * width
    keys, order, lights = np.empty(layers, np.float32), np.empty(layers, np.int32), np.empty(layers + 1, np.float32)
    for row in range(share, height, shares):
        for at in range(row * width, (row + 1) * width):
            last = looked[at]
            if last == 0:
                continue
            _sort(near, at, plane, layers, order, 0, keys)
            lights[0] = ONE
            for place in range(last):
                lights[place + 1] = lights[place] * (ONE - shown[4 * (order[place] * plane + at) + 3])
            red, green, blue = upstream[4 * at], upstream[4 * at + 1], upstream[4 * at + 2]
            # The image is sum_i light_i a_i colour_i + light_end on white, its opacity 1 - light_end.
            behind = red + green + blue - upstream[4 * at + 3]
            for place in range(last - 1, -1, -1):
                item, light = order[place] * plane + at, lights[place]
                r, g, b, opacity = shown[4 * item], shown[4 * item + 1], shown[4 * item + 2], shown[4 * item + 3]
                along, weight = red * r + green * g + blue * b, light * opacity
                shown[4 * item] = red * weight * r * (ONE - r)
                shown[4 * item + 1] = green * weight * g * (ONE - g)
                shown[4 * item + 2] = blue * weight * b * (ONE - b)
                shown[4 * item + 3] = (along - behind) * weight * (ONE - opacity)
                behind = behind * (ONE - opacity) + opacity * along
                used[item] = 1


@lru_cache
def scattering(bases: int) -> Callable[..., None]:
    """The backward pass for K bases, of one layer: no two may work on the same at once."""
    channels, fields = 4 * (1 + bases), padded_fields(bases)

    @njit(nogil=True, fastmath=set(CAREFUL), error_model="numpy", cache=True)
    def run(texture, maps, uv, gradient, used, to_texture, to_maps, touched, size, layer):  # noqa: ANN001, ANN202
        """Add the gradients of the logits, [L h w 4] where used, to those of texels and maps; touched: [L R R] uint8."""
        height, width, side, small = size
        place, texel, corner = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
        within, lanes = np.empty(6 * BLOCK, np.float32), np.empty(BLOCK * fields, np.float32)
        begin, end = layer * height * width, (layer + 1) * height * width
        while begin < end:
            items = 0
            while begin < end and items < BLOCK:
                place[items] = begin
                items += used[begin]
                begin += 1
            for i in range(items):
                u, v = uv[2 * place[i]], uv[2 * place[i] + 1]
                (column, x, _), (line, y, _) = _tap(u * small, small), _tap((ONE - v) * small, small)
                corner[i] = ((layer * small + line) * small + column) * fields
                mix = _bilinear(maps, corner[i], small * fields, x, y, fields)
                _store(lanes, i * fields, mix)
                column, right, across = _tap((u + _lane(mix, 0)) * side, side)
                line, down, along = _tap((ONE - v - _lane(mix, 1)) * side, side)
                start = (layer * side + line) * side + column
                touched[start] = touched[start + 1] = touched[start + side] = touched[start + side + 1] = 1
                texel[i] = start * channels
                _ask(texture, texel[i], side, channels)
                _ask(to_texture, texel[i], side, channels)
                within[6 * i], within[6 * i + 1], within[6 * i + 2], within[6 * i + 3] = x, y, right, down
                within[6 * i + 4] = np.float32(side) if across else NONE
                within[6 * i + 5] = -np.float32(side) if along else NONE
            for i in range(items):
                x, y, right, down = within[6 * i], within[6 * i + 1], within[6 * i + 2], within[6 * i + 3]
                logits, mix = _load(gradient, 4 * place[i], 4), _load(lanes, i * fields, fields)
                of_texel, free = _of_texel(logits, mix, bases), (within[6 * i + 4], within[6 * i + 5])
                of_map = _of_map(texture, texel[i], side * channels, right, down, free[0], free[1], logits, of_texel)
                _spread(to_texture, texel[i], side * channels, right, down, of_texel)
                _spread(to_maps, corner[i], small * fields, x, y, of_map)

    return run


@njit(inline="always")
def _ask(array, start, side, channels):  # noqa: ANN001, ANN202
    """Prefetch the four texels around a place."""
    for texel in range(2):
        _prefetch(array, start + texel * channels)
        _prefetch(array, start + (side + texel) * channels)


@njit(inline="always")
def _spread(array, start, line, x, y, lanes):  # noqa: ANN001, ANN202
    """The opposite of a bilinear fetch."""
    count = _count(lanes)
    _add_to(array, start, lanes, (ONE - x) * (ONE - y))
    _add_to(array, start + count, lanes, x * (ONE - y))
    _add_to(array, start + line, lanes, (ONE - x) * y)
    _add_to(array, start + line + count, lanes, x * y)
