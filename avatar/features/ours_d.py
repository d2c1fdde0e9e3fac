"""Ours-D: displacement in UV -> residual U-Net -> sampled back at the vertices (paper, section 3.2)."""

from __future__ import annotations

from torch import nn

from avatar.features import Condition, Features
from avatar.features.shared import DISPLACEMENT_UNIT_M, add_table, new_table
from avatar.networks import UNet
from avatar.radiance import RadianceAvatar
from avatar.uv import UVMap
from fitting.head_model import HeadModel


class DisplacementFeatures(nn.Module):
    """Vertex features from the head model's own deformation."""

    def __init__(self, head: HeadModel, channels: int, uv_size: int, static: bool) -> None:
        """channels: values per vertex; uv_size: texels a side; static: add a learned constant to each vertex's features."""
        super().__init__()
        self.channels = channels
        self.uv = UVMap(head.uvs, head.uv_triangles, head.triangles, head.vertex_count, uv_size)
        self.unet = UNet(3, channels)
        self.static = new_table(head, channels) if static else None

    def forward(self, condition: Condition) -> Features:
        """Features [B, V, channels] from the displacement; no loss terms."""
        features = self.uv.at_vertices(self.unet(self.uv.to_map(condition.displacement_m / DISPLACEMENT_UNIT_M)))
        return Features(add_table(features, self.static), {})


def create(settings: dict, head: HeadModel) -> RadianceAvatar:
    """The avatar of this representation; settings as in `avatar.build`."""
    source = DisplacementFeatures(head, settings["feature_channels"], settings["uv_size"], settings["static_features"])
    return RadianceAvatar(source, settings, head)
