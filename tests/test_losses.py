"""The photometric loss at its switch, its gradient at zero, and the schedules against the paper's figures."""

from __future__ import annotations

import pytest
import torch

from avatar.losses import learning_rate, photometric, psnr, scaled


def test_squared_first_then_the_norm() -> None:
    rendered, truth = torch.tensor([[0.5, 0.5, 0.5], [1.0, 1.0, 1.0]]), torch.tensor([[0.5, 0.1, 0.2], [1.0, 1.0, 1.0]])
    assert float(photometric(rendered, truth, 499, 400_000)) == pytest.approx(0.25 / 2)
    assert float(photometric(rendered, truth, 500, 400_000)) == pytest.approx(0.5 / 2, rel=1e-5)
    assert float(photometric(rendered, truth, 0, 100)) == pytest.approx(0.5 / 2, rel=1e-5)  # 500 of 400k is no step of 100


def test_gradient_is_finite_where_render_equals_truth() -> None:
    rendered = torch.rand(4, 3, requires_grad=True)
    photometric(rendered, rendered.detach().clone(), 10, 10).backward()
    assert torch.isfinite(rendered.grad).all() and rendered.grad.abs().max() == 0


def test_norm_gradient_equals_finite_differences() -> None:
    truth = torch.rand(4, 3, dtype=torch.float64)
    torch.autograd.gradcheck(lambda x: photometric(x, truth, 10, 10), torch.rand(4, 3, dtype=torch.float64, requires_grad=True))


def test_no_rays_is_zero() -> None:
    assert float(photometric(torch.empty(0, 3), torch.empty(0, 3), 10, 10)) == 0


def test_schedules() -> None:
    assert scaled(500, 400_000) == 500 and scaled(5_000, 4_000) == 50 and scaled(155_000, 400_000) == 155_000
    assert learning_rate(1e-3, 0, 400_000) == pytest.approx(1e-3 / 8_000)
    assert learning_rate(1e-3, 8_000, 400_000) == pytest.approx(1e-3 * 0.1**0.02)
    assert learning_rate(1e-3, 0, 10) == 1e-3  # no rise in a schedule of few steps
    assert learning_rate(1e-3, 400_000, 400_000) == pytest.approx(1e-4)
    assert learning_rate(1e-3, 200_000, 400_000) == pytest.approx(1e-3 * 0.1**0.5)


def test_psnr() -> None:
    assert psnr(torch.zeros(4, 3), torch.full((4, 3), 0.1)) == pytest.approx(20, abs=1e-4)
