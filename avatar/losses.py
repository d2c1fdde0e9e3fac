"""Loss terms and their schedules (paper, section 3.3 and supplement B)."""

from __future__ import annotations

import torch
from torch import Tensor

PAPER_STEPS = 400_000
SQUARED_UNTIL = 500  # of PAPER_STEPS: squared L2 first, then the L2 norm (the paper's commented-out notes)
NORM_EPSILON = 1e-6
WARM_UP = 8_000  # of PAPER_STEPS


def scaled(point: int, steps: int) -> int:
    """A point of the paper's 400k-step schedule in a schedule of `steps`."""
    return round(point * steps / PAPER_STEPS)


def photometric(rendered: Tensor, truth: Tensor, step: int, steps: int) -> Tensor:
    """Mean over rays of the squared L2 distance at the start, of the L2 norm (not squared) afterwards.

    rendered, truth: [N, 3] in [0, 1]; step: 0-based; steps: length of the schedule.
    Returns a scalar; 0 for no rays.
    """
    squared = (rendered - truth).square().sum(-1)
    if not len(squared):
        return rendered.sum()
    if step < scaled(SQUARED_UNTIL, steps):
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


def psnr(rendered: Tensor, truth: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of values in [0, 1], for the training curve only."""
    return float(-10 * torch.log10((rendered - truth).square().mean().clamp_min(1e-10)))
