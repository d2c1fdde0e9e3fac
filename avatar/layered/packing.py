"""A layered avatar's weights in a file of a few megabytes: textures in 8 bits, compressed; networks in bfloat16."""

from __future__ import annotations

import zlib

import numpy as np
import torch
from torch import Tensor

LEVEL = 6  # of zlib


def packed_textures(textures: Tensor) -> dict[str, Tensor]:
    """Textures [L, R, R, C] as `low` and `step` [L, C], and `bytes` [N] uint8: levels, differences along rows, zlib.

    A level is (value - low) / step: the largest error is half a step, the range of a layer's channel over 510.
    """
    low, high = textures.amin((1, 2)), textures.amax((1, 2))
    step = ((high - low) / 255).clamp_min(1e-12)
    levels = ((textures - low[:, None, None]) / step[:, None, None]).round().clamp(0, 255).byte().numpy()
    planes = np.ascontiguousarray(levels.transpose(0, 3, 1, 2))  # [L, C, R, R]: neighbours are alike
    planes[..., 1:] -= planes[..., :-1].copy()  # modulo 256
    packed = torch.from_numpy(np.frombuffer(zlib.compress(planes, LEVEL), np.uint8).copy())
    return {"low": low, "step": step, "bytes": packed}


def unpacked_textures(stored: dict[str, Tensor], shape: tuple[int, int, int, int]) -> Tensor:
    """Textures [L, R, R, C] from `packed_textures`; raises ValueError when they are not of this shape."""
    stored = {name: value.cpu() for name, value in stored.items()}
    layers, rows, columns, channels = shape
    try:
        planes = np.frombuffer(zlib.decompress(stored["bytes"].numpy().tobytes()), np.uint8)
    except zlib.error as error:
        raise ValueError(f"the textures cannot be read ({error})") from error
    if planes.size != np.prod(shape) or tuple(stored["low"].shape) != (layers, channels):
        raise ValueError(f"textures of {planes.size} values, expected {shape}")
    levels = np.cumsum(planes.reshape(layers, channels, rows, columns), -1, dtype=np.uint8).transpose(0, 2, 3, 1)
    return torch.from_numpy(np.ascontiguousarray(levels)).float() * stored["step"][:, None, None] + stored["low"][:, None, None]
