"""Sources of the per-vertex features: one module each, chosen by name in `avatar.build`. What they read and what they return.

Letters: B posed heads, V vertices, C channels, D codes.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Condition(NamedTuple):
    """What a source may read about B posed heads of one subject. Never the eye pose (paper's commented-out notes)."""

    displacement_m: Tensor  # [B, V, 3] expression and jaw against neutral, neck-normalised
    codes: Tensor  # [B, D] expression actions, then the jaw's rotation vector in rad
    neutral_m: Tensor  # [V, 3] the subject's neutral head
    time: Tensor | None = None  # [B] place among the training frames in [0, 1]; None at test


class Features(NamedTuple):
    """What a source returns: the features, and loss terms of its own by name (weights in `avatar.losses`)."""

    values: Tensor  # [B, V, C]
    terms: dict[str, Tensor]  # scalars
