"""Fragments to pixels, with gradients: fetch, mix, squash, and composite front to back by each pixel's own depth order.

A texel of a layer holds C = 4 (1 + K) values: the static logits of red, green, blue and opacity, and K bases of the same.
A frame's map, low in resolution, holds D = 2 + 4 + K: by how much the fetch moves in UV, logits to add, and a weight per basis:

    value = texture(uv + move)[static] + direct + sum_k weight_k texture(uv + move)[basis k], colour, opacity = sigmoid(value)

On the CPU by the compiled `training_pass`, threaded; `reference` is the same in plain PyTorch for any device, the tests' twin.
Letters: L layers, R texels a side of a texture, r of a frame's map, h x w pixels, or their samples (see `averaged`).
"""

from __future__ import annotations

from queue import Empty, SimpleQueue

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from avatar.layered import threads, training_pass
from avatar.layered.raster import Fragments

MOVE, DIRECT = training_pass.LEAD, 4  # channels of a frame's map before the K weights
MOST_LAYERS = 16
LEAST = 1e-9  # opacity: less than any that a sample has


def map_channels(bases: int) -> int:
    """D of a frame's map."""
    return MOVE + DIRECT + bases


def texture_channels(bases: int) -> int:
    """C of a texel."""
    return 4 * (1 + bases)


class _Composite(torch.autograd.Function):
    """`composite` on the CPU. The textures' gradient goes to a buffer of their size, made once: a step touches a part of it."""

    @staticmethod
    def forward(context, maps, textures, gradient, touched, inverse_depth, uv):  # noqa: ANN001, ANN205
        shown = np.empty((*inverse_depth.shape, 4), np.float32)
        padded = _padded(maps)
        image, depth, evaluations, looked = _drawn(textures, padded, inverse_depth, uv, shown)
        context.saved = textures, padded, gradient, touched, inverse_depth, uv, shown, looked
        context.mark_non_differentiable(depth)
        context.set_materialize_grads(False)
        return image, depth, evaluations

    @staticmethod
    def backward(context, upstream, _depth, _evaluations):  # noqa: ANN001, ANN205
        textures, padded, *saved = context.saved
        to_maps = np.zeros_like(padded)
        if upstream is not None:
            _handed_back(upstream, textures, padded, *saved, to_maps)
        return torch.from_numpy(to_maps[..., : map_channels(textures.shape[3] // 4 - 1)]), None, None, None, None, None


def _padded(maps: Tensor) -> np.ndarray:
    """Maps [L, r, r, D] as [L, r, r, a multiple of four]."""
    layers, small, _, channels = maps.shape
    padded = np.zeros((layers, small, small, training_pass.padded_fields(channels - MOVE - DIRECT)), np.float32)
    padded[..., :channels] = maps.detach().numpy()
    return padded


def _drawn(
    textures: Tensor, padded: np.ndarray, inverse_depth: np.ndarray, uv: np.ndarray, shown: np.ndarray
) -> tuple[Tensor, Tensor, int, np.ndarray]:
    """Image, depth, count of texels, and how many layers of each pixel were looked at, [h, w] uint8; fills shown."""
    layers, height, width = inverse_depth.shape
    image, depth = np.empty((height, width, 4), np.float32), np.empty((height, width), np.float32)
    visited, looked = np.empty(height, np.int64), np.empty((height, width), np.uint8)
    flat = [part.reshape(-1) for part in (textures.numpy(), padded, inverse_depth, uv, image, depth, visited, shown, looked)]
    size, shares = (height, width, textures.shape[1], padded.shape[1]), threads.count()
    run = training_pass.drawing(textures.shape[3] // 4 - 1)
    threads.run(lambda share: run(*flat, size, layers, share, shares), shares)
    return torch.from_numpy(image), torch.from_numpy(depth), int(visited.sum()), looked


def _handed_back(  # noqa: PLR0913
    upstream: Tensor,
    textures: Tensor,
    padded: np.ndarray,
    gradient: Tensor,
    touched: Tensor,
    inverse_depth: np.ndarray,
    uv: np.ndarray,
    shown: np.ndarray,
    looked: np.ndarray,
    to_maps: np.ndarray,
) -> None:
    """The image's gradient [h, w, 4] added to those of textures and maps; `shown` is used up.

    A thread takes whole layers, one after the other, so that sums do not depend on the number of threads.
    """
    layers, height, width = inverse_depth.shape
    used, shares = np.zeros(inverse_depth.shape, np.uint8), threads.count()
    of_logits = [part.reshape(-1) for part in (inverse_depth, upstream.contiguous().numpy(), shown, looked, used)]
    threads.run(lambda share: training_pass.logit_gradients(*of_logits, layers, height, width, share, shares), shares)
    scattered = textures.numpy(), padded, uv, shown, used, gradient.view(-1).numpy(), to_maps, touched.view(-1).numpy()
    flat, size = [part.reshape(-1) for part in scattered], (height, width, textures.shape[1], padded.shape[1])
    run, waiting = training_pass.scattering(textures.shape[3] // 4 - 1), SimpleQueue()
    for layer in sorted(range(layers), key=lambda layer: -np.count_nonzero(used[layer])):  # the longest first
        waiting.put(layer)

    def work(_share: int) -> None:
        while True:
            try:
                layer = waiting.get_nowait()
            except Empty:
                return
            run(*flat, size, layer)

    threads.run(work, shares)


def composite(
    textures: Tensor, maps: Tensor, fragments: Fragments, gradient: Tensor | None = None, touched: Tensor | None = None
) -> tuple[Tensor, Tensor, int]:
    """Draw fragments on white, on the CPU.

    textures: [L, R, R, C] float32; maps: [L, r, r, D] float32, may ask for a gradient.
    gradient: [L, R, R, C], to which the backward pass adds the textures' gradient; touched: [L, R, R] uint8, set to 1 where
    it does; both contiguous. The same whatever the number of threads.
    Returns the image [h, w, 4] (red, green, blue on white, and opacity), the depth [h, w] in m along the optical axis, weighted
    by opacity, 0 where nothing is (without gradient), and how many texels were asked for.
    Raises ValueError where channels or layers do not fit.
    """
    layers, channels, local = len(textures), textures.shape[3], maps.shape[3]
    if channels != texture_channels(local - MOVE - DIRECT) or len(maps) != layers or len(fragments.inverse_depth) != layers:
        raise ValueError(
            f"textures {tuple(textures.shape)}, maps {tuple(maps.shape)}, {len(fragments.inverse_depth)} layers drawn"
        )
    if layers > MOST_LAYERS:
        raise ValueError(f"at most {MOST_LAYERS} layers, found {layers}")
    if gradient is None:
        return _drawn(textures.detach(), _padded(maps), *fragments, np.empty(0, np.float32))[:3]
    return _Composite.apply(maps, textures.detach(), gradient, touched, *fragments)


def averaged(image: Tensor, depth: Tensor, samples: int) -> tuple[Tensor, Tensor]:
    """Pixels from S samples each: image [S h, w, 4] and depth [S h, w] of `composite` become [h, w, 4] and [h, w].

    The mean of the samples' light; of their depths weighted by opacity, 0 where there is none.
    """
    if samples == 1:
        return image, depth
    image, depth = image.unflatten(0, (-1, samples)), depth.unflatten(0, (-1, samples))
    opacity = image[..., 3].detach()
    return image.mean(1), (depth * opacity).sum(1) / opacity.sum(1).clamp_min(LEAST)


def reference(textures: Tensor, maps: Tensor, fragments: Fragments) -> tuple[Tensor, Tensor, int]:
    """As `composite` in plain PyTorch, differentiable in textures and maps on any device; fragments: tensors. None ends early."""
    inverse_depth, uv = fragments
    grid = torch.stack([uv[..., 0] * 2 - 1, 1 - uv[..., 1] * 2], -1)  # [L, h, w, 2]
    local = _sampled(maps, grid)
    move = torch.stack([local[:, 0], -local[:, 1]], -1) * 2
    texel = _sampled(textures, grid + move).unflatten(1, (-1, 4))  # [L, 1 + K, 4, h, w]
    value = texel[:, 0] + local[:, MOVE : MOVE + DIRECT] + (local[:, MOVE + DIRECT :, None] * texel[:, 1:]).sum(1)
    shown = torch.sigmoid(value)
    opacity = shown[:, 3] * (inverse_depth > 0)
    order = torch.argsort(inverse_depth, dim=0, descending=True, stable=True)
    opacity, near = opacity.gather(0, order), inverse_depth.gather(0, order)
    colour = shown[:, :3].gather(0, order[:, None].expand(-1, 3, -1, -1))
    light = torch.cumprod(1 - opacity, 0)
    weight = opacity * torch.cat([torch.ones_like(light[:1]), light[:-1]])
    image = torch.cat([(weight[:, None] * colour).sum(0) + light[-1], 1 - light[-1:]]).permute(1, 2, 0)
    total = weight.sum(0)
    depth = (weight / near.clamp_min(1e-6)).sum(0) / torch.where(total > 0, total, torch.ones_like(total))
    return image, depth.detach(), int((inverse_depth > 0).sum())


def _sampled(maps: Tensor, grid: Tensor) -> Tensor:
    """maps: [L, S, S, N]; grid: [L, h, w, 2]. Returns [L, N, h, w]."""
    return functional.grid_sample(maps.permute(0, 3, 1, 2), grid.to(maps.dtype), padding_mode="border", align_corners=False)
