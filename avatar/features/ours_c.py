"""Ours-C: codes -> transposed convolutions in UV -> sampled at the vertices (paper, section 3.2 and 4.4).

The decoder of Ours-D's U-Net without an encoder: a fully connected layer makes the 4 x 4 maps that it starts from.
"""

from __future__ import annotations

from torch import nn
from torch.nn import functional

from avatar.features import Condition, Features
from avatar.features.shared import add_table, code_count, new_table
from avatar.networks import SLOPE, UNET_LEVELS, decode, enlarging_blocks
from avatar.radiance import RadianceAvatar
from avatar.uv import UVMap
from fitting.head_model import HeadModel

START_SIDE = 4  # texels, at least: the bottleneck of the U-Net at 256


def doublings(uv_size: int) -> int:
    """How often the smallest maps are doubled: down to START_SIDE (for 64, 128, 256), or just above it (192 = 6 x 2^5)."""
    count = 0
    while uv_size % 2 == 0 and uv_size >= 2 * START_SIDE:
        uv_size, count = uv_size // 2, count + 1
    return count


class CodeFeatures(nn.Module):
    """Vertex features from the codes alone, through a map."""

    def __init__(self, head: HeadModel, channels: int, uv_size: int, static: bool) -> None:
        """channels: values per vertex; uv_size: texels a side; static: add a learned constant to each vertex's features."""
        super().__init__()
        self.channels = channels
        self.uv = UVMap(head.uvs, head.uv_triangles, head.triangles, head.vertex_count, uv_size)
        blocks = doublings(uv_size)
        self.start = UNET_LEVELS[-1], uv_size // 2**blocks, uv_size // 2**blocks
        self.first = nn.Linear(code_count(head), self.start[0] * self.start[1] * self.start[2])
        # Codes count as of size one; the bias keeps torch's start, so that the map varies over the head at neutral codes too.
        nn.init.kaiming_uniform_(self.first.weight, SLOPE)
        self.up, self.merge = enlarging_blocks(self.start[0], [0] * blocks)
        self.out = nn.Conv2d(self.up[-1].out_channels, channels, 1)
        self.static = new_table(head, channels) if static else None

    def forward(self, condition: Condition) -> Features:
        """Features [B, V, channels]; no loss terms."""
        maps = functional.leaky_relu(self.first(condition.codes), SLOPE).unflatten(1, self.start)
        maps = self.out(decode(maps, self.up, self.merge, []))
        return Features(add_table(self.uv.at_vertices(maps), self.static), {})


def create(settings: dict, head: HeadModel) -> RadianceAvatar:
    """The avatar of this representation; settings as in `avatar.build`."""
    source = CodeFeatures(head, settings["feature_channels"], settings["uv_size"], settings["static_features"])
    return RadianceAvatar(source, settings, head)
