"""Image metrics on batches: PSNR, SSIM, L1 and the overlap of masks (paper, section 4.1). Images are [B, 3, H, W] in [0, 1]."""

from __future__ import annotations

import math

import torch
from torch import Tensor

PSNR_CAP_DB = 100.0
"""PSNR of equal images: the true value is infinite, and a mean over frames must stay finite."""

SSIM_WINDOW_PX = 11
SSIM_SIGMA_PX = 1.5


def _same(prediction: Tensor, truth: Tensor) -> None:
    if prediction.shape != truth.shape or prediction.ndim != 4:
        raise ValueError(f"metrics want two [B, C, H, W] of one shape, found {tuple(prediction.shape)} and {tuple(truth.shape)}")


def _mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean of [B, C, H, W] over all but B, or over the pixels of mask [B, H, W] (weights; every mask must have one)."""
    if mask is None:
        return values.mean((1, 2, 3))
    weight = mask.to(values.dtype).sum((1, 2))
    if bool((weight <= 0).any()):
        raise ValueError("a mask is empty: the metric has no pixels")
    return (values.mean(1) * mask).sum((1, 2)) / weight


def psnr(prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Peak signal-to-noise ratio in dB, at most 100 (`PSNR_CAP_DB`).

    Args:
        prediction, truth: [B, 3, H, W] in [0, 1].
        mask: [B, H, W] weights of the pixels that count; None counts all.

    Returns:
        [B] dB.

    Raises:
        ValueError: shapes differ, or a mask is empty.
    """
    _same(prediction, truth)
    error = _mean((prediction - truth).square(), mask)
    # torch.maximum hands NaN on, so that a broken image is never scored as perfect.
    return -10 * torch.log10(torch.maximum(error, error.new_tensor(10 ** (-PSNR_CAP_DB / 10))))


def l1(prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean absolute error [B] in [0, 1]; arguments and errors as in `psnr`."""
    _same(prediction, truth)
    return _mean((prediction - truth).abs(), mask)


def ssim(prediction: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Structural similarity: the mean of `ssim_map`.

    Args:
        prediction, truth: [B, C, H, W] in [0, 1], at least 11 px a side.
        mask: [B, H, W] weights of the pixels that count, less the 5 px at the border, which the map lacks; None counts all.

    Returns:
        [B].

    Raises:
        ValueError: as `ssim_map`, or a mask is empty inside that border.
    """
    return inner_mean(ssim_map(prediction, truth), mask)


def inner_mean(values: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean of a map without border, [B, H - 10, W - 10], over a mask [B, H, W]: [B]; ValueError where no pixel is left."""
    rim = SSIM_WINDOW_PX // 2
    return _mean(values[:, None], None if mask is None else mask[:, rim:-rim, rim:-rim])


def ssim_map(prediction: Tensor, truth: Tensor) -> Tensor:
    """Structural similarity of each pixel [Wang et al. 2004]: Gaussian window 11 px, sigma 1.5 px, range 1, K1 0.01, K2 0.03.

    As scikit-image's `structural_similarity(gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1)`:
    the mean over channels, and no value within 5 px of the border, where the window would leave the picture.

    Args:
        prediction, truth: [B, C, H, W] in [0, 1], at least 11 px a side.

    Returns:
        [B, H - 10, W - 10].

    Raises:
        ValueError: shapes differ or an image is smaller than the window.
    """
    _same(prediction, truth)
    height, width = prediction.shape[2:]
    if min(height, width) < SSIM_WINDOW_PX:
        raise ValueError(f"SSIM wants at least {SSIM_WINDOW_PX} px a side, found {(height, width)}")
    weights = [math.exp(-(place**2) / (2 * SSIM_SIGMA_PX**2)) for place in range(-(SSIM_WINDOW_PX // 2), SSIM_WINDOW_PX // 2 + 1)]
    weights = [weight / math.fsum(weights) for weight in weights]

    def blurred(values: Tensor) -> Tensor:
        """Separable Gaussian without padding: [B, C, H, W] -> [B, C, H - 10, W - 10].

        Shifted sums are nine times faster than conv2d on a CPU, which has no good path for one channel.
        """
        for axis in (2, 3):
            size = values.shape[axis] - SSIM_WINDOW_PX + 1
            total = values.narrow(axis, 0, size) * weights[0]
            for place, weight in enumerate(weights[1:], 1):
                total.add_(values.narrow(axis, place, size), alpha=weight)
            values = total
        return values

    mean_a, mean_b = blurred(prediction), blurred(truth)
    variance_a = blurred(prediction.square()) - mean_a.square()
    variance_b = blurred(truth.square()) - mean_b.square()
    covariance = blurred(prediction * truth) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + 0.01**2) / (mean_a.square() + mean_b.square() + 0.01**2)
    structure = (2 * covariance + 0.03**2) / (variance_a + variance_b + 0.03**2)
    return (luminance * structure).mean(1)


def mask_iou(prediction: Tensor, truth: Tensor, threshold: float = 0.5) -> Tensor:
    """Intersection over union of two opacities [B, H, W] in [0, 1] cut at `threshold`: [B], 1 where both are empty."""
    if prediction.shape != truth.shape or prediction.ndim != 3:
        raise ValueError(f"mask_iou wants two [B, H, W] of one shape, found {tuple(prediction.shape)} and {tuple(truth.shape)}")
    if not bool(torch.isfinite(prediction).all() and torch.isfinite(truth).all()):
        raise ValueError("an opacity is not finite")
    first, second = prediction > threshold, truth > threshold
    union = (first | second).sum((1, 2))
    both = (first & second).sum((1, 2))
    return torch.where(union > 0, both / union.clamp_min(1), torch.ones_like(union, dtype=torch.float32))
