"""LPIPS v0.1 with AlexNet: perceptual distance of image pairs [Zhang et al., CVPR 2018], for scoring only.

Weights: the file `lpips_alexnet.ckpt` (AlexNet's five convolutions and the five linear heads), read by `fitting.safe_pickle`.
A training loss must never use this network: figures would then be scored by what was optimised.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from fitting.safe_pickle import load_arrays

MIN_SIZE_PX = 31
"""Smallest height or width for which AlexNet's last feature map has one element."""

NETWORK = "LPIPS v0.1, AlexNet, linear heads"
INPUT_RANGE = "RGB in [0, 1], mapped to [-1, 1], then LPIPS's own shift and scale"
_LAYERS = ((4, 2, False), (1, 2, True), (1, 1, True), (1, 1, False), (1, 1, False))  # stride, padding, max-pooled before
_SHAPES = ((64, 3, 11), (192, 64, 5), (384, 192, 3), (256, 384, 3), (256, 256, 3))  # out, in, kernel


class Lpips(nn.Module):
    """The metric with its weights; nothing in it is trainable."""

    def __init__(self, weights: dict) -> None:
        """Put the arrays of the checkpoint in place.

        Args:
            weights: `AlexNet_0/Conv_i/{kernel [h, w, in, out], bias [out]}` and `NetLinLayer_i/Conv_0/kernel [1, 1, C, 1]`.

        Raises:
            ValueError: an array is missing or has another shape.
        """
        super().__init__()
        for index, (channels, inputs, size) in enumerate(_SHAPES):
            for name, keys, shape in (
                ("kernel", ("AlexNet_0", f"Conv_{index}", "kernel"), (size, size, inputs, channels)),
                ("bias", ("AlexNet_0", f"Conv_{index}", "bias"), (channels,)),
                ("head", (f"NetLinLayer_{index}", "Conv_0", "kernel"), (1, 1, channels, 1)),
            ):
                array = _lookup(weights, keys, shape)
                tensor = torch.from_numpy(np.ascontiguousarray(array.transpose(3, 2, 0, 1) if array.ndim == 4 else array))
                self.register_buffer(f"{name}_{index}", tensor)
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188]).view(3, 1, 1))
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450]).view(3, 1, 1))

    def features(self, images: Tensor) -> list[Tensor]:
        """Unit-length activations of the five layers of images [B, 3, H, W] in [0, 1]: each [B, C, h, w]."""
        signal, activations = (images * 2 - 1 - self.shift) / self.scale, []
        for index, (stride, padding, pooled) in enumerate(_LAYERS):
            if pooled:
                signal = F.max_pool2d(signal, 3, 2)
            kernel, bias = self.get_buffer(f"kernel_{index}"), self.get_buffer(f"bias_{index}")
            signal = F.relu(F.conv2d(signal, kernel, bias, stride=stride, padding=padding))
            activations.append(signal / (signal.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return activations

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
        count = len(prediction)
        total = prediction.new_zeros(count)
        for index, activation in enumerate(self.features(torch.cat([prediction, truth]))):
            difference = (activation[:count] - activation[count:]).square()
            total = total + F.conv2d(difference, self.get_buffer(f"head_{index}")).mean((1, 2, 3))
        return total


def load(path: Path | str, device: torch.device | str = "cpu") -> Lpips:
    """The metric from its checkpoint.

    Raises:
        ValueError: the file is not that checkpoint; the message names it.
    """
    weights = load_arrays(path)
    try:
        return Lpips(weights).to(device).eval()
    except ValueError as error:
        raise ValueError(f"{path}: not the LPIPS AlexNet checkpoint ({error})") from error


def _lookup(weights: dict, keys: tuple[str, ...], shape: tuple[int, ...]) -> np.ndarray:
    """The float32 array under nested keys, of a given shape."""
    found = weights
    for key in keys:
        found = found.get(key) if isinstance(found, dict) else None
    if not isinstance(found, np.ndarray) or found.shape != shape:
        what = f"shape {found.shape}" if isinstance(found, np.ndarray) else "nothing"
        raise ValueError(f"{'/'.join(keys)} must have shape {shape}, found {what}")
    return found.astype(np.float32)
