"""Operations of an avatar: FLOP of one evaluation and of what is done once a frame, as it is run here.

Two per multiply-accumulate of matrix products and convolutions. Encodings, activations, look-ups and compositing are left out, as
in `avatar.describe`, which tells layer by layer what these sums are made of.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from avatar.features import Condition
from avatar.features.shared import code_count
from fitting.head_model import HeadModel

COLOUR = 4  # red, green, blue and opacity of a texel


@torch.no_grad()
def operations(avatar: nn.Module, head: HeadModel) -> tuple[float, float] | None:
    """FLOP of one evaluation (of the field's network, or of a texel) and of one frame; None for an avatar of another kind."""
    if hasattr(avatar, "field"):
        return of_field(avatar, head)
    if hasattr(avatar, "textures"):
        return of_layers(avatar)
    return None


def of_field(avatar: nn.Module, head: HeadModel) -> tuple[float, float]:
    """A radiance field: MLP0 at every neighbour, their weighted sum, the rest once; the features once a frame.

    The part of MLP0's first layer that reads features runs once a vertex.
    """
    field = avatar.field
    each = matrices(field.from_offset, field.mlp0) + field.from_offset.out_features
    once = matrices(field.mlp1, field.density, field.mlp2, field.colour)
    once += 0 if avatar.warp is None else matrices(avatar.warp) - avatar.warp.latents.numel()
    weight = field.from_feature.weight
    displacement, codes = weight.new_zeros(1, head.vertex_count, 3), weight.new_zeros(1, code_count(head))
    with FlopCounterMode(display=False) as counter:
        avatar.source(Condition(displacement, codes, head.template.to(weight), None))
    frame = counter.get_total_flops() + 2 * weight.numel() * head.vertex_count
    return float(2 * (field.neighbours * each + once)), float(frame)


def of_layers(avatar: nn.Module) -> tuple[float, float]:
    """A stack of textured surfaces: a texel is mixed from its bases; the maps are made once a frame."""
    side, first = len(avatar.skin_corners), next(avatar.unet.parameters())
    with FlopCounterMode(display=False) as counter:
        avatar.out(avatar.unet(first.new_zeros(1, first.shape[1], side, side)))
    return float(2 * COLOUR * avatar.bases), float(counter.get_total_flops())


def matrices(*modules: nn.Module) -> int:
    """Multiply-accumulates of one row through all weight matrices."""
    return sum(value.numel() for module in modules for value in module.parameters() if value.ndim > 1)
