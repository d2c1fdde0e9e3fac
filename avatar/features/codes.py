"""3DMM Codes: the learned table with the expression and jaw codes appended at every vertex (paper, section 4.4)."""

from __future__ import annotations

import torch
from torch import nn

from avatar.features import Condition, Features
from avatar.features.shared import STATIC_GAIN, code_count, new_table
from avatar.radiance import RadianceAvatar
from fitting.head_model import HeadModel


class CodeConcatenation(nn.Module):
    """Vertex features [table, codes]; the MLP before the weighted sum has to make something of them.

    The codes pass as they are ("directly concatenating"): actions in [0, 1] or standard deviations, the jaw in rad.
    """

    def __init__(self, head: HeadModel, channels: int) -> None:
        """channels: of the table; the codes come on top."""
        super().__init__()
        self.channels = channels + code_count(head)
        self.static = new_table(head, channels)

    def forward(self, condition: Condition) -> Features:
        """Features [B, V, channels]; no loss terms."""
        count = len(condition.codes), len(self.static), -1
        table, codes = self.static * STATIC_GAIN, condition.codes[:, None]
        return Features(torch.cat([table.expand(*count), codes.expand(*count)], -1), {})


def create(settings: dict, head: HeadModel) -> RadianceAvatar:
    """The avatar of this representation; settings as in `avatar.build`. The table is there with or without `static_features`."""
    return RadianceAvatar(CodeConcatenation(head, settings["feature_channels"]), settings, head)
