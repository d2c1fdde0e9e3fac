"""Displacement MLP: the input of Ours-D without its convolutions, an MLP on each vertex's own displacement.

A control that the authors drafted ("w/ vs. w/o unet", commented out in section 4.5) and did not describe. That it also reads
the vertex's place on the neutral head is our reading: without it all vertices at rest would look the same, which no U-Net over
a UV map is limited to. What separates it from Ours-D is then the spatial context; from Codes MLP, codes against displacement.
"""

from __future__ import annotations

from torch import nn

from avatar.features import Condition, Features
from avatar.features.shared import DISPLACEMENT_UNIT_M, POSITION_SIZE, VertexMLP, add_table, encoded_position, new_table
from avatar.radiance import RadianceAvatar
from fitting.head_model import HeadModel

WIDTH, DEPTH = 256, 4  # those of the decoder of `codes_mlp`, so that only the condition differs


class DisplacementMLPFeatures(nn.Module):
    """Vertex features from the vertex's displacement and place alone."""

    def __init__(self, head: HeadModel, channels: int, static: bool) -> None:
        """channels: values per vertex; static: add a learned constant to each vertex's features."""
        super().__init__()
        self.channels = channels
        self.network = VertexMLP((POSITION_SIZE, 0, 3), WIDTH, DEPTH, channels)
        self.static = new_table(head, channels) if static else None

    def forward(self, condition: Condition) -> Features:
        """Features [B, V, channels]; no loss terms."""
        position = encoded_position(condition.neutral_m)
        return Features(add_table(self.network(position, None, condition.displacement_m / DISPLACEMENT_UNIT_M), self.static), {})


def create(settings: dict, head: HeadModel) -> RadianceAvatar:
    """The avatar of this representation; settings as in `avatar.build`."""
    source = DisplacementMLPFeatures(head, settings["feature_channels"], settings["static_features"])
    return RadianceAvatar(source, settings, head)
