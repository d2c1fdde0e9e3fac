"""Layers: textured surfaces that move with the head, drawn without marching rays (see `avatar.layered`)."""

from __future__ import annotations

from avatar.layered.model import LayeredAvatar
from fitting.head_model import HeadModel


def create(settings: dict, head: HeadModel) -> LayeredAvatar:
    """The avatar of this representation; settings as in `avatar.build`."""
    return LayeredAvatar(settings, head)
