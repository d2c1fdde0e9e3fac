"""Network parts: positional encoding, MLP in a chosen precision, residual U-Net. Letters: N rows, C channels, H, W."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

UNET_LEVELS = (8, 16, 32, 64, 128, 256)  # channels after each halving (paper, supplement B)
DECODER_LEAST = 64  # channels below which the decoder does not go
SLOPE = 0.2


def positional_encoding(values: Tensor, bands: int) -> Tensor:
    """The input itself, then sin and cos of it at frequencies 2^0 .. 2^(bands-1), without pi as in NeRF's code.

    values: [..., C], float32 or float64 (never less: the highest band multiplies rounding errors by 2^(bands-1)).
    Returns [..., C (1 + 2 bands)]: values, then all sines (band-major), then all cosines.
    """
    if not bands:
        return values
    frequencies = 2.0 ** torch.arange(bands, dtype=values.dtype, device=values.device)
    angles = (values[..., None, :] * frequencies[:, None]).flatten(-2)
    return torch.cat([values, torch.sin(angles), torch.cos(angles)], -1)


def encoded_size(channels: int, bands: int) -> int:
    """Length of `positional_encoding` of `channels` values."""
    return channels * (1 + 2 * bands)


def best_precision(device: torch.device | str) -> torch.dtype:
    """bfloat16 where matrix units or instructions for it exist, else float32.

    Measured on two AMX cores, (65536 x 128) @ (128 x 128) with ReLU: float32 120-217, bfloat16 645 GFLOP/s.
    """
    if torch.device(device).type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float32
    capable = torch.cpu._is_amx_tile_supported() or torch.cpu._is_avx512_bf16_supported()
    return torch.bfloat16 if capable else torch.float32


def linear_in(precision: torch.dtype, layer: nn.Linear, rows: Tensor) -> Tensor:
    """`layer` applied to rows [..., C] with the product in `precision`; its weights stay float32 (master weights)."""
    bias = None if layer.bias is None else layer.bias.to(precision)
    return functional.linear(rows.to(precision), layer.weight.to(precision), bias)


class MLP(nn.Module):
    """Fully connected layers, ReLU after each."""

    def __init__(self, sizes: list[int]) -> None:
        """sizes: input, then each layer's output width."""
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(before, after) for before, after in pairwise(sizes))
        for layer in self.layers:
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)

    def forward(self, rows: Tensor, precision: torch.dtype = torch.float32) -> Tensor:
        """rows: [..., sizes[0]]. Returns [..., sizes[-1]] in `precision`."""
        for layer in self.layers:
            rows = torch.relu_(linear_in(precision, layer, rows))
        return rows


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a shortcut; the first may halve the resolution.

    A halving shortcut is a mean over 2x2 texels and a 1x1 convolution, not a strided one: oneDNN's gradient of a strided 1x1
    convolution of fewer than 16 channels writes past its workspace (uxlfoundation/oneDNN #6035, seen here as random crashes).
    """

    def __init__(self, before: int, after: int, stride: int = 1) -> None:
        super().__init__()
        self.first = nn.Conv2d(before, after, 3, stride, 1)
        self.second = nn.Conv2d(after, after, 3, 1, 1)
        pool = [nn.AvgPool2d(stride, ceil_mode=True)] if stride > 1 else []
        self.shortcut = nn.Sequential(*pool, *([nn.Conv2d(before, after, 1)] if before != after else []))

    def forward(self, maps: Tensor) -> Tensor:
        """maps: [B, before, H, W]. Returns [B, after, ceil(H / stride), ceil(W / stride)]."""
        inner = self.second(functional.leaky_relu(self.first(maps), SLOPE))
        return functional.leaky_relu(inner + self.shortcut(maps), SLOPE)


def enlarging_blocks(before: int, skips: list[int]) -> tuple[nn.ModuleList, nn.ModuleList]:
    """Decoder blocks of supplement B: transposed convolutions that double the size, and the residual block after each.

    before: channels of the smallest maps; they are halved block by block, down to `DECODER_LEAST`.
    skips: for each block the channels that join after its transposed convolution.
    """
    up = [before]
    for _ in skips:
        up.append(max(up[-1] // 2, DECODER_LEAST))
    enlarge = nn.ModuleList(nn.ConvTranspose2d(up[i], up[i + 1], 4, 2, 1) for i in range(len(skips)))
    merge = nn.ModuleList(ResidualBlock(up[i + 1] + skips[i], up[i + 1]) for i in range(len(skips)))
    return enlarge, merge


def decode(maps: Tensor, enlarge: nn.ModuleList, merge: nn.ModuleList, skips: list[Tensor]) -> Tensor:
    """maps: [B, C, h, w] through the blocks; the last of skips joins first, none are left for the last blocks."""
    skips = list(skips)
    for larger, block in zip(enlarge, merge, strict=True):
        maps = functional.leaky_relu(larger(maps), SLOPE)
        maps = block(torch.cat([maps, skips.pop()], 1) if skips else maps)
    return maps


def keep_size(module: nn.Module) -> None:
    """Start a convolution with weights that keep a signal's size from layer to layer and a bias of zero; for `Module.apply`.

    PyTorch's own start shrinks the signal with each convolution and adds random constants: after 17 of them the maps are the same
    for every frame (nerface.mp4: features of 0.07 whose standard deviation over 15 frames is 0.0002, with this one 0.14).
    """
    if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
        nn.init.kaiming_normal_(module.weight, SLOPE, "fan_out" if isinstance(module, nn.ConvTranspose2d) else "fan_in")
        nn.init.zeros_(module.bias)
    if isinstance(module, nn.ConvTranspose2d):  # stride 2: each output is a sum over a quarter of the kernel
        with torch.no_grad():
            module.weight.mul_(2)
    if isinstance(module, ResidualBlock):
        with torch.no_grad():  # the block's two paths are added
            module.second.weight.mul_(0.7)


class UNet(nn.Module):
    """The 6-level residual U-Net of supplement B: down 8..256, up 128, 64, 64, ... with transposed convolutions.

    Skips are concatenations (the paper does not say), none at full resolution, where only the input could join. The output
    layer is a 1x1 convolution without activation.
    """

    def __init__(self, before: int, after: int, levels: tuple[int, ...] = UNET_LEVELS) -> None:
        """before, after: channels of the input and of the output; levels: channels after each halving."""
        super().__init__()
        self.halvings = len(levels)
        down = [before, *levels]
        self.down = nn.ModuleList(ResidualBlock(down[i], down[i + 1], 2) for i in range(len(levels)))
        self.up, self.merge = enlarging_blocks(levels[-1], [*reversed(levels[:-1]), 0])
        self.out = nn.Conv2d(self.up[-1].out_channels, after, 1)
        self.apply(keep_size)
        self.precision = torch.float32  # of training's convolutions; see `train_in`

    def forward(self, maps: Tensor) -> Tensor:
        """maps: [B, before, H, W] with H and W multiples of 2^levels. Returns [B, after, H, W] of the same type.

        Without gradients always in the weights' own type.
        Raises ValueError when the size cannot be halved that often.
        """
        if maps.shape[-1] % 2**self.halvings or maps.shape[-2] % 2**self.halvings:
            raise ValueError(f"maps of {tuple(maps.shape[-2:])} texels cannot be halved {self.halvings} times")
        lower = self.precision == torch.bfloat16 and torch.is_grad_enabled()
        with torch.autocast(maps.device.type, torch.bfloat16, enabled=lower):
            skips, inner = [], maps
            for block in self.down:
                inner = block(inner)
                skips.append(inner)
            skips.pop()  # the bottleneck itself
            return self.out(decode(inner, self.up, self.merge, skips)).to(maps.dtype)


def train_in(avatar: nn.Module, precision: torch.dtype) -> nn.Module:
    """Let the avatar's U-Nets learn in `precision`, with channels last in memory, as these convolutions are fastest.

    Forward and backward of four maps of 128 texels on one AMX core: 557 ms, channels last 482, bfloat16 285, both 179.
    """
    for module in avatar.modules():
        if isinstance(module, UNet):
            module.precision = precision
    return avatar.to(memory_format=torch.channels_last)
