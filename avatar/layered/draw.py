"""The run-time compositor: what `avatar.layered.composite` trains, drawn without gradients, to 8-bit pixels, as fast as it goes.

Textures are kept in 8 bits as the avatar's file holds them, so nothing is lost against it; 16 bits and float32 are for comparing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from avatar.layered import threads
from avatar.layered.compiled import compiled, pad, padded_fields
from avatar.layered.raster import Fragments

SMALLEST = 1e-12


class Textures(NamedTuple):
    """Textures of L layers with K bases in whole steps: value = low + step * level."""

    levels: np.ndarray  # [L, R, R, 4 (1 + K)] uint8, int16, or float32 (then the values themselves)
    step: np.ndarray  # [L, 4 (1 + K)] float32
    low: np.ndarray  # [L, 4 (1 + K)] float32


def quantised(textures: np.ndarray, kind: type = np.uint8) -> Textures:
    """textures: [L, R, R, 4 (1 + K)] float32, rounded to even steps between the ends of each layer's channel.

    kind: uint8, int16, or float32, which rounds nothing. What `avatar.layered.packing` stored comes back as it was.
    Raises ValueError where the shape is another, or values are not finite.
    """
    if textures.ndim != 4 or textures.shape[3] % 4 or not textures.shape[3] or min(textures.shape[1:3]) < 2:
        raise ValueError(f"textures are [L, R, R, 4 (1 + K)] with R of at least 2, found {textures.shape}")
    if not np.isfinite(textures).all():
        raise ValueError("the textures are not finite; train the avatar again")
    shape = textures.shape[0], textures.shape[3]
    if kind is np.float32:
        return Textures(np.ascontiguousarray(textures, np.float32), np.ones(shape, np.float32), np.zeros(shape, np.float32))
    low, high, ends = textures.min((1, 2)), textures.max((1, 2)), np.iinfo(kind)
    step = np.maximum((high - low) / (ends.max - ends.min), SMALLEST).astype(np.float32)
    low = (low - ends.min * step).astype(np.float32)
    levels = np.empty(textures.shape, kind)
    for layer in range(len(textures)):  # one at a time: textures are large
        levels[layer] = np.clip(np.rint((textures[layer] - low[layer]) / step[layer]), ends.min, ends.max)
    return Textures(levels, step, low)


def draw(
    textures: Textures, maps: np.ndarray, fragments: Fragments, out: np.ndarray | None = None, *, samples: int
) -> np.ndarray:
    """Composite the layers front to back, by each pixel's own order of depth, on white.

    Args:
        textures: of L layers with K bases.
        maps: [L, r, r, D] float32 of this frame: by how much the fetch moves in UV (2, may be left out), logits to add (4), and
            the weight of each basis (K); any strides.
        fragments: of the same L layers in a window of h x w pixels.
        out: [h, w, 4] uint8 to overwrite.
        samples: of a pixel in the fragments; a pixel is their mean.

    Returns:
        [h, w, 4] uint8: red, green, blue on white, and opacity.

    Raises:
        ValueError: shapes do not fit each other, or the maps are not finite.
    """
    layers, rows, width = fragments.inverse_depth.shape
    channels, side, coarse = textures.levels.shape[3], textures.levels.shape[1], maps.shape[1]
    bases, lead = channels // 4 - 1, maps.shape[-1] - 4 - (channels // 4 - 1)
    if textures.levels.shape[:3] != (layers, side, side) or textures.step.shape != (layers, channels):
        raise ValueError(f"textures {textures.levels.shape} do not fit fragments of {layers} layers")
    if samples < 1 or rows % samples:
        raise ValueError(f"{rows} rows of fragments are not those of pixels with {samples} samples each")
    if maps.shape[:3] != (layers, coarse, coarse) or lead not in (0, 2) or coarse < 2:
        raise ValueError(
            f"{layers} layers with {bases} bases need maps [L, r, r, {4 + bases} or {6 + bases}], found {maps.shape}"
        )
    height = rows // samples
    out = np.empty((height, width, 4), np.uint8) if out is None else out
    if out.shape != (height, width, 4) or out.dtype != np.uint8 or not out.flags.c_contiguous:
        raise ValueError(f"the picture is [{height}, {width}, 4] uint8, found {out.shape} {out.dtype}")
    padded = np.zeros((layers, coarse, coarse, padded_fields(bases, lead)), np.float32)
    if not pad(maps, padded):
        raise ValueError("the maps of this frame are not finite; train the avatar again")
    flat = [array.reshape(-1) for array in (*textures, padded, *fragments, out)]
    run, shares = compiled(bases, lead), threads.count()
    threads.run(lambda share: run(*flat, side, coarse, height, width, samples, layers, share, shares), shares)
    return out
