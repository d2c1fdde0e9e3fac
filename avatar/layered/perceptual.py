"""A perceptual loss: distance of VGG16's first feature maps (Johnson et al., ECCV 2016). Never of the AlexNet that scores."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from avatar.lpips import NETWORKS, Lpips

BLOCKS = 3  # of VGG16: relu1_2, relu2_2, relu3_3 are compared


class Perceptual(nn.Module):
    """Mean absolute difference of VGG16's activations, added over the first blocks; nothing in it is trainable."""

    def __init__(self, weights: Lpips, precision: torch.dtype) -> None:
        """weights: `avatar.lpips.load(..., network="vgg16")`; precision: of the convolutions.

        Raises ValueError for another network.
        """
        super().__init__()
        if weights.network is not NETWORKS["vgg16"]:
            raise ValueError(f"the perceptual loss reads VGG16, found {weights.network.name}")
        self.precision = precision
        self.layers = []
        for number, layer in enumerate(weights.network.layers):
            kernel = weights.get_buffer(f"kernel_{number}").to(precision).contiguous(memory_format=torch.channels_last)
            self.register_buffer(f"kernel_{number}", kernel, persistent=False)
            self.register_buffer(f"bias_{number}", weights.get_buffer(f"bias_{number}").to(precision), persistent=False)
            self.layers.append((layer.pool, layer.compared))
            if sum(compared for _, compared in self.layers) == BLOCKS:
                break
        self.register_buffer("shift", weights.shift, persistent=False)
        self.register_buffer("scale", weights.scale, persistent=False)

    def features(self, images: Tensor) -> list[Tensor]:
        """Activations of the compared layers of images [B, 3, H, W] in [0, 1], in `precision`."""
        signal = ((images * 2 - 1 - self.shift) / self.scale).to(self.precision).contiguous(memory_format=torch.channels_last)
        found = []
        for number, (pool, compared) in enumerate(self.layers):
            if pool:
                signal = functional.max_pool2d(signal, pool, 2)
            signal = functional.conv2d(signal, self.get_buffer(f"kernel_{number}"), self.get_buffer(f"bias_{number}"), padding=1)
            signal = functional.relu(signal)
            if compared:
                found.append(signal)
        return found

    def forward(self, rendered: Tensor, truth: Tensor) -> Tensor:
        """rendered, truth: [B, 3, H, W] in [0, 1], at least 4 px a side. Returns a scalar; its gradient goes to `rendered`."""
        with torch.no_grad():
            wanted = self.features(truth)
        found = self.features(rendered)
        return sum((one - other).float().abs().mean() for one, other in zip(found, wanted, strict=True))
