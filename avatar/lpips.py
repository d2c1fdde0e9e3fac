"""LPIPS v0.1 with AlexNet or VGG16: perceptual distance of image pairs [Zhang et al., CVPR 2018], for scoring only.

Weights: the files `lpips_alexnet.ckpt` and `lpips_vgg16.ckpt` (convolutions, five linear heads), read by `fitting.safe_pickle`.
A training loss must never use the network that scores: figures would then be scored by what was optimised.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fitting.safe_pickle import load_arrays

MIN_SIZE_PX = 31
"""Smallest height or width for which AlexNet's last feature map has one element. VGG16's would do with 16; both get one size,
so that both see the same pixels."""
CHUNK_PX = 1 << 19
"""Pixels in one pass, at least one pair: VGG16's first layers hold 64 values a pixel, 0.13 GB a tensor of this size."""

INPUT_RANGE = "RGB in [0, 1], mapped to [-1, 1], then LPIPS's own shift and scale"


class Layer(NamedTuple):
    """A convolution, its rectifier, and what comes before and after them."""

    channels: int
    inputs: int
    kernel: int
    stride: int
    padding: int
    pool: int  # side of the max-pooling (stride 2) before it, 0 for none
    compared: bool  # whether a head reads its output


def _vgg16() -> tuple[Layer, ...]:
    layers, inputs = [], 3
    for block, (channels, count) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
        for place in range(count):
            layers.append(Layer(channels, inputs, 3, 1, 1, 2 if block and not place else 0, place == count - 1))
            inputs = channels
    return tuple(layers)


@dataclass(frozen=True)
class Network:
    """One of LPIPS's networks."""

    name: str
    """As the protocol shows it."""
    folder: str
    """Of its arrays in the checkpoint."""
    layers: tuple[Layer, ...]


NETWORKS = {
    "alexnet": Network(
        "LPIPS v0.1, AlexNet, linear heads",
        "AlexNet_0",
        (
            Layer(64, 3, 11, 4, 2, 0, True),
            Layer(192, 64, 5, 1, 2, 3, True),
            Layer(384, 192, 3, 1, 1, 3, True),
            Layer(256, 384, 3, 1, 1, 0, True),
            Layer(256, 256, 3, 1, 1, 0, True),
        ),
    ),
    "vgg16": Network("LPIPS v0.1, VGG16, linear heads", "VGG16_0", _vgg16()),
}
METRIC = {"alexnet": "lpips", "vgg16": "lpips_vgg"}
"""Under which name each network's figures stand."""


class Lpips(nn.Module):
    """The metric with its weights; nothing in it is trainable."""

    def __init__(self, weights: dict, network: Network) -> None:
        """Put the arrays of the checkpoint in place.

        Args:
            weights: `{folder}/Conv_i/{kernel [h, w, in, out], bias [out]}` and `NetLinLayer_i/Conv_0/kernel [1, 1, C, 1]`.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        super().__init__()
        self.network = network
        for index, layer in enumerate(network.layers):
            shape = (layer.kernel, layer.kernel, layer.inputs, layer.channels)
            kernel = _lookup(weights, (network.folder, f"Conv_{index}", "kernel"), shape)
            self.register_buffer(f"kernel_{index}", _convolution(kernel))
            bias = _lookup(weights, (network.folder, f"Conv_{index}", "bias"), (layer.channels,))
            self.register_buffer(f"bias_{index}", torch.from_numpy(bias))
        for index, layer in enumerate(layer for layer in network.layers if layer.compared):
            head = _lookup(weights, (f"NetLinLayer_{index}", "Conv_0", "kernel"), (1, 1, layer.channels, 1))
            self.register_buffer(f"head_{index}", _convolution(head))
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(3, 1, 1))
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(3, 1, 1))

    def features(self, images: Tensor) -> Iterator[Tensor]:
        """Unit-length activations of the five compared layers of images [B, 3, H, W] in [0, 1]: each [B, C, h, w].

        One at a time: VGG16's of a 512 px frame would take 0.2 GB together.
        """
        signal = (images * 2 - 1 - self.shift) / self.scale
        for index, layer in enumerate(self.network.layers):
            if layer.pool:
                signal = F.max_pool2d(signal, layer.pool, 2)
            kernel, bias = self.get_buffer(f"kernel_{index}"), self.get_buffer(f"bias_{index}")
            signal = F.relu(F.conv2d(signal, kernel, bias, stride=layer.stride, padding=layer.padding))
            if layer.compared:
                yield signal / (signal.square().sum(1, keepdim=True).sqrt() + 1e-10)

    @torch.no_grad()
    def forward(self, prediction: Tensor, truth: Tensor) -> Tensor:
        """Distance of each pair.

        Args:
            prediction, truth: [B, 3, H, W] RGB in [0, 1], at least 31 px a side.

        Returns:
            [B], 0 for equal images.

        Raises:
            ValueError: shapes differ or an image is too small.
        """
        if prediction.shape != truth.shape or prediction.ndim != 4 or prediction.shape[1] != 3:
            raise ValueError(f"LPIPS wants two [B, 3, H, W], found {tuple(prediction.shape)} and {tuple(truth.shape)}")
        if min(prediction.shape[2:]) < MIN_SIZE_PX:
            raise ValueError(f"LPIPS wants at least {MIN_SIZE_PX} px a side, found {tuple(prediction.shape[2:])}")
        pairs = max(1, CHUNK_PX // (2 * prediction.shape[2] * prediction.shape[3]))
        parts = zip(prediction.split(pairs), truth.split(pairs), strict=True)
        return torch.cat([self._distance(first, second) for first, second in parts])

    def _distance(self, prediction: Tensor, truth: Tensor) -> Tensor:
        """`forward` of few pairs."""
        count = len(prediction)
        total = prediction.new_zeros(count)
        for index, activation in enumerate(self.features(torch.cat([prediction, truth]))):
            difference = (activation[:count] - activation[count:]).square()
            total = total + F.conv2d(difference, self.get_buffer(f"head_{index}")).mean((1, 2, 3))
        return total


def load(path: Path | str, device: torch.device | str = "cpu", network: str = "alexnet") -> Lpips:
    """The metric from its checkpoint; network: a key of NETWORKS.

    Raises:
        ValueError: the file is not that checkpoint; the message names it.
    """
    weights = load_arrays(path)
    try:
        return Lpips(weights, NETWORKS[network]).to(device).eval()
    except ValueError as error:
        shown = NETWORKS[network].folder.removesuffix("_0")
        raise ValueError(f"{path}: not the LPIPS {shown} checkpoint ({error})") from error


def _convolution(kernel: np.ndarray) -> Tensor:
    """[h, w, in, out] as PyTorch has it, [out, in, h, w]."""
    return torch.from_numpy(np.ascontiguousarray(kernel.transpose(3, 2, 0, 1)))


def _lookup(weights: dict, keys: tuple[str, ...], shape: tuple[int, ...]) -> np.ndarray:
    """The float32 array under nested keys, of a given shape."""
    found = weights
    for key in keys:
        found = found.get(key) if isinstance(found, dict) else None
    if not isinstance(found, np.ndarray) or found.shape != shape:
        what = f"shape {found.shape}" if isinstance(found, np.ndarray) else "nothing"
        raise ValueError(f"{'/'.join(keys)} must have shape {shape}, found {what}")
    return found.astype(np.float32)
