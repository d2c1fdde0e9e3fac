"""Ours-D: displacement in UV -> residual U-Net -> sampled back at the vertices (paper, section 3.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from avatar.layers import UNet
from avatar.radiance import RadianceAvatar
from avatar.uv import UVMap
from fitting.head_model import HeadModel

DISPLACEMENT_UNIT_M = 0.01  # expressions move the skin by millimetres: inputs of about one
# The constant's own learning rate, so to say: it is read by few rays and the network by all. Toy subject, 120 steps: 19.2 dB
# at 1, 24.9 dB at 10.
STATIC_GAIN = 10.0


class DisplacementFeatures(nn.Module):
    """Vertex features from the head model's own deformation."""

    def __init__(self, head: HeadModel, channels: int, uv_size: int, static: bool) -> None:
        """channels: values per vertex; uv_size: texels a side; static: add a learned constant to each vertex's features."""
        super().__init__()
        self.uv = UVMap(head.uvs, head.uv_triangles, head.triangles, head.vertex_count, uv_size)
        self.unet = UNet(3, channels)
        self.static = nn.Parameter(torch.randn(head.vertex_count, channels) * 0.1 / STATIC_GAIN) if static else None

    def forward(self, displacement_m: Tensor) -> Tensor:
        """displacement_m: [B, V, 3] m, eye pose left out. Returns [B, V, channels]."""
        features = self.uv.at_vertices(self.unet(self.uv.to_map(displacement_m / DISPLACEMENT_UNIT_M)))
        return features if self.static is None else features + self.static * STATIC_GAIN


def create(settings: dict, head: HeadModel) -> RadianceAvatar:
    """The avatar of this representation; settings as in `avatar.build`."""
    source = DisplacementFeatures(head, settings["feature_channels"], settings["uv_size"], settings["static_features"])
    return RadianceAvatar(source, settings, head.vertex_count)
