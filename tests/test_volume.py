"""Packed volume rendering against a loop over each ray in float64; the hard cases of density and of empty rays."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from avatar.volume import composite


def twin(
    depths: list[list[float]], colours: list[list[np.ndarray]], distances: list[list[float]], background: float
) -> tuple[np.ndarray, list, list]:
    """One ray after another, one sample after another."""
    shades, opacities, means = [], [], []
    for depth, colour, distance in zip(depths, colours, distances, strict=True):
        light, shade, mean = 1.0, np.zeros(3), 0.0
        for d, c, t in zip(depth, colour, distance, strict=True):
            alpha = -math.expm1(-d)
            shade, mean = shade + light * alpha * c, mean + light * alpha * t
            light *= 1 - alpha
        shades.append(shade + light * background)
        opacities.append(1 - light)
        means.append(mean / (1 - light) if light < 1 else 0.0)
    return np.array(shades), opacities, means


@pytest.mark.parametrize("background", [0.0, 1.0])
def test_composite_equals_the_loop(background: float) -> None:
    random = np.random.default_rng(0)
    counts = [0, 1, 5, 0, 12, 3]
    depths = [list(random.exponential(0.7, n)) for n in counts]
    colours = [list(random.random((n, 3))) for n in counts]
    distances = [list(np.sort(random.random(n) + 0.5)) for n in counts]
    shades, opacities, means = twin(depths, colours, distances, background)
    flat = torch.tensor([x for row in depths for x in row], dtype=torch.float64, requires_grad=True)
    ray, slot = (
        torch.tensor([i for i, n in enumerate(counts) for _ in range(n)]),
        torch.tensor([s for n in counts for s in range(n)]),
    )
    tint = torch.tensor(np.array([c for row in colours for c in row]), requires_grad=True)
    far = torch.tensor([x for row in distances for x in row], dtype=torch.float64)
    rendered, weight = composite(flat, tint, far, ray, slot, len(counts), background)
    np.testing.assert_allclose(rendered.colour.detach(), shades, atol=1e-12)
    np.testing.assert_allclose(rendered.opacity.detach(), opacities, atol=1e-12)
    np.testing.assert_allclose(rendered.depth.detach(), means, atol=1e-12)
    np.testing.assert_allclose([float(weight[ray == i].sum()) for i in range(len(counts))], opacities, atol=1e-12)
    torch.autograd.gradcheck(lambda d, c: composite(d, c, far, ray, slot, len(counts), background)[0].colour, (flat, tint))


@pytest.mark.parametrize("density", [0.0, 1e-12, 1.0, 1e6, 1e30])
def test_any_density_gives_weights_in_range_and_finite_gradients(density: float) -> None:
    depth = torch.full((6,), density, requires_grad=True)
    tint = torch.rand(6, 3, requires_grad=True)
    rendered, weight = composite(depth, tint, torch.linspace(1, 2, 6), torch.zeros(6, dtype=torch.int64), torch.arange(6), 1)
    assert ((weight >= 0) & (weight <= 1)).all() and 0 <= float(rendered.opacity) <= 1
    (rendered.colour.sum() + rendered.depth.sum()).backward()
    assert torch.isfinite(depth.grad).all() and torch.isfinite(tint.grad).all()


def test_rays_without_samples_are_exactly_the_background() -> None:
    nothing = torch.empty(0)
    rendered, _ = composite(nothing, torch.empty(0, 3), nothing, nothing.long(), nothing.long(), 4)
    assert (rendered.colour == 1).all() and (rendered.opacity == 0).all() and (rendered.depth == 0).all()


def test_a_long_opaque_run_in_float32() -> None:
    depth = torch.full((512,), 5.0, requires_grad=True)
    rendered, weight = composite(
        depth, torch.full((512, 3), 0.25), torch.linspace(1, 2, 512), torch.zeros(512).long(), torch.arange(512), 1
    )
    torch.testing.assert_close(rendered.colour, torch.full((1, 3), 0.25))
    torch.testing.assert_close(weight.sum(), torch.tensor(1.0))
    rendered.colour.sum().backward()
    assert torch.isfinite(depth.grad).all()
