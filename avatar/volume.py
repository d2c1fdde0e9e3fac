"""Volume rendering of packed samples (paper, section 3.1): P samples of N rays, S at most on a ray.

Transmittance is exp(-cumulative optical depth): no log(1 - alpha), no product, no underflow whose gradient is NaN; and no
sample at infinity, which a density that never reaches 0 would make opaque.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

CLOSED = 20.0  # optical depth where a ray ends at the core: the head is opaque, white never shines through it


class Rays(NamedTuple):
    """N rays of one posed head, in its neck-normalised frame; geometry, so numpy and without gradients."""

    origins_m: np.ndarray  # [N, 3] float32
    directions: np.ndarray  # [N, 3] float32, unit


class Rendered(NamedTuple):
    """What a representation returns for N rays."""

    colour: Tensor  # [N, 3] on the background
    opacity: Tensor  # [N] in [0, 1]
    depth: Tensor  # [N] m along the ray, mean over the weights; 0 where the opacity is 0


def composite(
    optical_depth: Tensor, colour: Tensor, distance_m: Tensor, ray: Tensor, slot: Tensor, rays: int, background: float = 1.0
) -> tuple[Rendered, Tensor]:
    """Front-to-back compositing.

    optical_depth: [P] density times step, >= 0; colour: [P, 3]; distance_m: [P].
    ray: [P] in [0, rays), slot: [P] the sample's rank on its ray, front first.
    Returns the rays and the weight [P] of each sample. Rays without samples are exactly the background.
    """
    slots = int(slot.max()) + 1 if len(slot) else 1
    place = ray * slots + slot
    padded = optical_depth.new_zeros(rays * slots).index_put((place,), optical_depth).view(rays, slots)
    # The sum of those in front, never the running sum less the sample's own: beside 1e6 that difference loses what is in front.
    before = functional.pad(torch.cumsum(padded[:, :-1], 1), (1, 0))
    weights = (torch.exp(-before) * -torch.expm1(-padded)).view(-1)
    weight = weights[place]
    dense_colour = colour.new_zeros(rays * slots, 3).index_put((place,), colour).view(rays, slots, 3)
    weights = weights.view(rays, slots)
    opacity = -torch.expm1(-padded.sum(1))
    shade = (weights[..., None] * dense_colour).sum(1) + (1 - opacity)[:, None] * background
    distances = distance_m.new_zeros(rays * slots).index_put((place,), distance_m).view(rays, slots)
    total = weights.sum(1)
    depth = (weights * distances).sum(1) / torch.where(total > 0, total, torch.ones_like(total))
    return Rendered(shade, opacity, depth), weight
