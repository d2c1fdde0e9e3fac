"""Static features: a learned table, the same in every frame (paper, section 4.4)."""

from __future__ import annotations

from torch import nn

from avatar.features import Condition, Features
from avatar.features.shared import STATIC_GAIN, new_table
from avatar.radiance import RadianceAvatar
from fitting.head_model import HeadModel


class StaticFeatures(nn.Module):
    """Vertex features that know nothing of the frame."""

    def __init__(self, head: HeadModel, channels: int) -> None:
        """channels: values per vertex."""
        super().__init__()
        self.channels = channels
        self.static = new_table(head, channels)

    def forward(self, condition: Condition) -> Features:
        """Features [B, V, channels], the same for every head; no loss terms."""
        return Features((self.static * STATIC_GAIN).expand(len(condition.codes), -1, -1), {})


def create(settings: dict, head: HeadModel) -> RadianceAvatar:
    """The avatar of this representation; settings as in `avatar.build`. It is a table with or without `static_features`."""
    return RadianceAvatar(StaticFeatures(head, settings["feature_channels"]), settings, head)
