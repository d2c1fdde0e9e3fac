"""Loss terms and their schedules (paper, section 3.3 and supplement B); the warp's own terms are in `avatar.warp`."""

from __future__ import annotations

import math

import torch
from torch import Tensor

PAPER_STEPS = 400_000
SQUARED_UNTIL = 500  # of PAPER_STEPS: squared L2 first, then the L2 norm (the paper's commented-out notes)
SQUARED_LEAST = 60  # steps, where whole rays are sampled
NORM_EPSILON = 1e-6
WARM_UP = 8_000  # of PAPER_STEPS
WARP_FROM = 5_000  # of PAPER_STEPS: the warp is off before
WINDOW_OPEN = 80_000  # of PAPER_STEPS: all bands of the warp's encoding are open
# Learning rates by group of parameters, as parts of `train.learning_rate`. The warp's and its latents' is the paper's (1e-4 by
# 1e-3). The sources' networks are ours: at the full rate the U-Net moves all features at once faster than the field can follow
# (nerface.mp4, 6000 steps: the loss jumped to 0.8 at step 758 and the field died at 773; at 0.3 of it none of the same steps had
# a loss above 0.09. Clipping gradients to 1 or to 0.3 let it jump as before).
RATES = {"field": 1.0, "table": 1.0, "source": 0.3, "warp": 0.1}
ELASTIC_WEIGHTS = (1e-4, 1e-5)
ELASTIC_FALL = (55_000, 155_000)  # of PAPER_STEPS: Nerfies' 50k constant, then 100k of cosine, after the warp's delay
MAGNITUDE_WEIGHT = 1e-2
OUTSIDE_WEIGHT = 1e-2
KL_WEIGHT = 1e-4  # of the conditional VAE; the paper does not say


def scaled(point: int, steps: int) -> int:
    """A point of the paper's 400k-step schedule in a schedule of `steps`."""
    return round(point * steps / PAPER_STEPS)


def squared_until(steps: int, whole_rays: bool) -> int:
    """Steps of the squared distance at the start of a schedule of `steps`; whole_rays: sampled outside the shell too.

    There at least SQUARED_LEAST. The norm pulls at every wrong ray with the same strength, so that a majority of white rays
    empties everything, and what is empty gets no gradient (toy subject, 120 steps, white is 11.2 dB: without these steps 11.2,
    with 60 of them 17.6).
    """
    return max(scaled(SQUARED_UNTIL, steps), SQUARED_LEAST if whole_rays else 0)


def photometric(rendered: Tensor, truth: Tensor, squared_loss: bool) -> Tensor:
    """Mean over rays of the squared L2 distance (at the start), or of the L2 norm, not squared.

    rendered, truth: [N, 3] in [0, 1].
    Returns a scalar; 0 for no rays.
    """
    squared = (rendered - truth).square().sum(-1)
    if not len(squared):
        return rendered.sum()
    if squared_loss:
        return squared.mean()
    return torch.sqrt(squared + NORM_EPSILON**2).mean()  # epsilon: the norm has no gradient at 0


def opacity(rendered: Tensor, matte: Tensor) -> Tensor:
    """Mean squared difference of rendered opacity [N] and matte [N]; 0 for no rays.

    Not in the paper: on a white background it keeps a short training from explaining light skin as holes.
    """
    return (rendered - matte).square().sum() / max(len(matte), 1)


def learning_rate(start: float, step: int, steps: int) -> float:
    """Exponential decay to a tenth over the schedule, `start * 0.1 ** (step / steps)`, after a short linear rise.

    The rise (WARM_UP of the paper's 400k, 2 % of any schedule) is ours: large first steps can empty the whole shell, and
    a network of dead units stays white.
    """
    return start * 0.1 ** (step / steps) * min(1.0, (step + 1) / max(scaled(WARM_UP, steps), 1))


def group_of(parameter: str) -> str:
    """The entry of RATES for a parameter's name in an avatar; a table holds constants of single vertices."""
    if parameter == "source.static":
        return "table"
    first = parameter.split(".")[0]
    return first if first in ("source", "warp") else "field"


def warp_on(step: int, steps: int) -> bool:
    """Whether points are warped; a schedule of fewer than 41 steps has no delay."""
    return step >= scaled(WARP_FROM, steps)


def warp_window(step: int, steps: int, bands: int = 6) -> float:
    """Open bands of the warp's encoding: linear from 0 at step 0 (also Nerfies' start) to `bands` at WINDOW_OPEN."""
    return bands * min(1.0, step * PAPER_STEPS / (steps * WINDOW_OPEN))


def elastic_weight(step: int, steps: int) -> float:
    """Weight of the elastic term: constant, then half a cosine down to a tenth."""
    (first, last), (begin, end) = ELASTIC_WEIGHTS, ELASTIC_FALL
    progress = min(max((step * PAPER_STEPS / steps - begin) / (end - begin), 0.0), 1.0)
    return last + (first - last) * (1 + math.cos(math.pi * progress)) / 2


def weight_of(term: str, step: int, steps: int) -> float:
    """Weight at a step of a loss term: elastic, magnitude (supplement A), kl (`codes_mlp`) or outside (`radiance.clearing`)."""
    constant = {"magnitude": MAGNITUDE_WEIGHT, "kl": KL_WEIGHT, "outside": OUTSIDE_WEIGHT}
    return elastic_weight(step, steps) if term == "elastic" else constant[term]


def psnr(rendered: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of values in [0, 1], for the training curve only."""
    return float(-10 * torch.log10((rendered - truth).square().mean().clamp_min(1e-10)))
