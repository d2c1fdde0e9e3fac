"""The photometric loss at its switch, its gradient at zero, and the schedules against the paper's figures."""

from __future__ import annotations

from itertools import pairwise

import pytest
import torch

from avatar.losses import (
    MAGNITUDE_WEIGHT,
    RATES,
    SQUARED_LEAST,
    elastic_weight,
    group_of,
    learning_rate,
    photometric,
    psnr,
    scaled,
    squared_until,
    warp_on,
    warp_window,
)


def test_squared_first_then_the_norm() -> None:
    rendered, truth = torch.tensor([[0.5, 0.5, 0.5], [1.0, 1.0, 1.0]]), torch.tensor([[0.5, 0.1, 0.2], [1.0, 1.0, 1.0]])
    assert float(photometric(rendered, truth, True)) == pytest.approx(0.25 / 2)
    assert float(photometric(rendered, truth, False)) == pytest.approx(0.5 / 2, rel=1e-5)
    assert squared_until(400_000, False) == squared_until(400_000, True) == 500
    assert squared_until(100, False) == 0 and squared_until(100, True) == SQUARED_LEAST


def test_gradient_is_finite_where_render_equals_truth() -> None:
    rendered = torch.rand(4, 3, requires_grad=True)
    photometric(rendered, rendered.detach().clone(), False).backward()
    assert torch.isfinite(rendered.grad).all() and rendered.grad.abs().max() == 0


def test_norm_gradient_equals_finite_differences() -> None:
    truth = torch.rand(4, 3, dtype=torch.float64)
    torch.autograd.gradcheck(lambda x: photometric(x, truth, False), torch.rand(4, 3, dtype=torch.float64, requires_grad=True))


def test_no_rays_is_zero() -> None:
    assert float(photometric(torch.empty(0, 3), torch.empty(0, 3), False)) == 0


def test_schedules() -> None:
    assert scaled(500, 400_000) == 500 and scaled(5_000, 4_000) == 50 and scaled(155_000, 400_000) == 155_000
    assert learning_rate(1e-3, 0, 400_000) == pytest.approx(1e-3 / 8_000)
    assert learning_rate(1e-3, 8_000, 400_000) == pytest.approx(1e-3 * 0.1**0.02)
    assert learning_rate(1e-3, 0, 10) == 1e-3  # no rise in a schedule of few steps
    assert learning_rate(1e-3, 400_000, 400_000) == pytest.approx(1e-4)
    assert learning_rate(1e-3, 200_000, 400_000) == pytest.approx(1e-3 * 0.1**0.5)


PAPER = 400_000


@pytest.mark.parametrize("steps", [PAPER, 2_000])
def test_the_papers_points_at_any_length(steps: int) -> None:
    """Step, learning rate of the networks, window and elastic weight, from the paper's text and Nerfies' formulas."""
    rows = (
        (40_000, 1e-3 * 0.1**0.1, 3, 1e-4),
        (55_000, 1e-3 * 0.1**0.1375, 6 * 55 / 80, 1e-4),
        (80_000, 1e-3 * 0.1**0.2, 6, 1e-5 + 9e-5 * (1 + 2**-0.5) / 2),
        (105_000, 1e-3 * 0.1**0.2625, 6, 5.5e-5),
        (155_000, 1e-3 * 0.1**0.3875, 6, 1e-5),
        (200_000, 1e-3 * 0.1**0.5, 6, 1e-5),
        (400_000, 1e-4, 6, 1e-5),
    )
    for point, rate, window, weight in rows:
        step = scaled(point, steps)
        assert learning_rate(1e-3, step, steps) == pytest.approx(rate)
        assert RATES["warp"] * learning_rate(1e-3, step, steps) == pytest.approx(rate / 10)
        assert warp_window(step, steps) == pytest.approx(window)
        assert elastic_weight(step, steps) == pytest.approx(weight)
    assert elastic_weight(0, steps) == 1e-4 and warp_window(0, steps) == 0


def test_the_warp_starts_at_its_step() -> None:
    assert [warp_on(step, PAPER) for step in (0, 4_999, 5_000, 399_999)] == [False, False, True, True]
    assert [warp_on(step, 2_000) for step in (0, 24, 25, 1_999)] == [False, False, True, True]
    assert MAGNITUDE_WEIGHT == 1e-2


def test_every_parameter_of_an_avatar_has_a_rate() -> None:
    names = ("field.mlp0.layers.0.weight", "coarse.density.bias", "source.static", "source.unet.out.weight", "warp.latents")
    assert [group_of(name) for name in names] == ["field", "field", "table", "source", "warp"]
    assert set(map(group_of, names)) == set(RATES) and RATES["field"] == 1


def test_schedules_fall_or_rise_without_jumps() -> None:
    weights, windows = zip(*((elastic_weight(step, 4_000), warp_window(step, 4_000)) for step in range(4_001)), strict=True)
    assert all(0 <= before - after < 2e-7 for before, after in pairwise(weights))
    assert all(0 <= after - before < 0.01 for before, after in pairwise(windows))


@pytest.mark.parametrize("steps", [1, 10])
def test_a_very_short_schedule_is_sane(steps: int) -> None:
    assert warp_on(0, steps) and warp_window(0, steps) == 0 and warp_window(steps, steps) == 6
    assert elastic_weight(0, steps) == 1e-4 and elastic_weight(steps, steps) == pytest.approx(1e-5)
    assert warp_window(1, 10) == 3 and warp_window(2, 10, bands=4) == 4


def test_psnr() -> None:
    assert psnr(torch.zeros(4, 3), torch.full((4, 3), 0.1)) == pytest.approx(20, abs=1e-4)
