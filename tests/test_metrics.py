"""PSNR, SSIM, L1 and mask overlap against scikit-image, against float64 twins and on their edges."""

import numpy as np
import pytest
import torch
from skimage import metrics as reference

from avatar import metrics


def images(height: int = 61, width: int = 47, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    """Two [2, 3, H, W]: waves with white flat areas (as composited heads have) and a noisy shifted copy."""
    generator = np.random.default_rng(7)
    y, x, c = np.meshgrid(np.arange(height), np.arange(width), np.arange(3), indexing="ij")
    truth = np.stack([0.5 + 0.5 * np.sin(0.2 * x + 0.1 * y + c + shift) for shift in (0, 1)])
    truth[:, :20] = 1
    prediction = np.clip(np.roll(truth, 2, 1) + generator.normal(0, 0.05, truth.shape), 0, 1)
    return tuple(torch.from_numpy(array.transpose(0, 3, 1, 2).copy()).to(dtype) for array in (prediction, truth))


def channels_last(image: torch.Tensor) -> np.ndarray:
    return image.numpy().transpose(1, 2, 0).astype(np.float64)


def test_psnr_and_ssim_equal_scikit_image() -> None:
    prediction, truth = images()
    psnr, ssim = metrics.psnr(prediction, truth), metrics.ssim(prediction, truth)
    for index in range(2):
        a, b = channels_last(prediction[index]), channels_last(truth[index])
        assert psnr[index].item() == pytest.approx(reference.peak_signal_noise_ratio(b, a, data_range=1), abs=1e-4)
        expected = reference.structural_similarity(
            a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=2
        )
        assert ssim[index].item() == pytest.approx(expected, abs=1e-4)


def test_ssim_of_a_region_is_the_mean_of_scikit_images_map() -> None:
    prediction, truth = images()
    mask = torch.zeros(2, 61, 47)
    mask[0, 30:50, 3:30] = 1  # reaches into the border that has no value
    mask[1, 20:24, 20:26] = 1  # smaller than the window
    found = metrics.ssim(prediction, truth, mask)
    torch.testing.assert_close(found, metrics.inner_mean(metrics.ssim_map(prediction, truth), mask))
    for index in range(2):
        settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1, "channel_axis": 2}
        whole = reference.structural_similarity(
            channels_last(prediction[index]), channels_last(truth[index]), full=True, **settings
        )[1]
        inside = mask[index].bool().numpy().copy()
        inside[:, :5] = False
        assert found[index].item() == pytest.approx(whole.mean(2)[inside].mean(), abs=1e-4)
    with pytest.raises(ValueError, match="empty"):
        metrics.ssim(prediction, truth, torch.eye(61, 47)[None] * torch.tensor([1.0, 0.0])[:, None, None])


def test_float32_equals_float64() -> None:
    for name in ("psnr", "ssim", "l1"):
        single, double = getattr(metrics, name)(*images()), getattr(metrics, name)(*images(dtype=torch.float64))
        torch.testing.assert_close(single.double(), double, atol=1e-4, rtol=1e-5)


def test_equal_images_are_capped_and_one() -> None:
    _, truth = images()
    assert metrics.psnr(truth, truth).tolist() == [metrics.PSNR_CAP_DB] * 2
    torch.testing.assert_close(metrics.ssim(truth, truth), torch.ones(2))
    assert metrics.l1(truth, truth).tolist() == [0, 0]


def test_psnr_of_a_known_error() -> None:
    truth = torch.full((1, 3, 8, 8), 0.5)
    assert metrics.psnr(truth + 0.1, truth).item() == pytest.approx(20, abs=1e-4)
    assert metrics.l1(truth + 0.1, truth).item() == pytest.approx(0.1, abs=1e-6)


def test_a_mask_keeps_out_what_is_outside() -> None:
    prediction, truth = images()
    mask = torch.zeros(2, 61, 47)
    mask[:, 30:50, 10:30] = 1
    inside = metrics.psnr(prediction[:, :, 30:50, 10:30], truth[:, :, 30:50, 10:30])
    torch.testing.assert_close(metrics.psnr(prediction, truth, mask), inside)
    prediction[:, :, :30] = 0
    torch.testing.assert_close(metrics.psnr(prediction, truth, mask), inside)


def test_nothing_not_finite_is_hidden() -> None:
    prediction, truth = images()
    prediction[0, 0, 30, 30] = torch.nan
    for name in ("psnr", "ssim", "l1"):
        values = getattr(metrics, name)(prediction, truth)
        assert torch.isnan(values[0]) and torch.isfinite(values[1])
    opacity = prediction[:, 0]
    with pytest.raises(ValueError, match="not finite"):
        metrics.mask_iou(opacity, truth[:, 0])


def test_mask_iou() -> None:
    a, b = torch.zeros(3, 4, 4), torch.zeros(3, 4, 4)
    a[0, :2], b[0, 1:3] = 1, 1  # one row of three
    a[1], b[1] = 0.4, 0.4  # both empty at 0.5
    a[2] = 1
    assert metrics.mask_iou(a, b).tolist() == pytest.approx([1 / 3, 1, 0])


def test_refusals() -> None:
    truth = images()[1]
    with pytest.raises(ValueError, match="shape"):
        metrics.psnr(truth, truth[:1])
    with pytest.raises(ValueError, match="empty"):
        metrics.psnr(truth, truth, torch.zeros(2, 61, 47))
    with pytest.raises(ValueError, match="11 px"):
        metrics.ssim(truth[..., :10], truth[..., :10])
