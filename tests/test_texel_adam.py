"""Adam on the texels that a step touched, against PyTorch's Adam and against moments that decay while a texel rests."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from avatar.layered import threads
from avatar.layered.texel_adam import BETAS, EPSILON, KEPT, TexelAdam

SHAPE = (2, 3, 3, 4)


def stepped(adam: TexelAdam, gradient: torch.Tensor, touched: torch.Tensor) -> None:
    adam.gradient += gradient * touched[..., None]
    adam.touched |= touched.to(torch.uint8)
    adam.step()


def test_all_touched_is_adam() -> None:
    values = torch.randn(SHAPE)
    twin = values.double().requires_grad_()
    adam, slow = TexelAdam(values), torch.optim.Adam([twin], lr=0.02, betas=BETAS, eps=EPSILON)
    adam.rates[:] = 0.02
    for seed in range(20):
        gradient = torch.from_numpy(np.random.default_rng(seed).normal(size=SHAPE)).float()
        twin.grad = gradient.double()
        slow.step()
        stepped(adam, gradient, torch.ones(SHAPE[:3], dtype=torch.bool))
    torch.testing.assert_close(values.double(), twin.detach(), atol=1e-5, rtol=0)


def test_a_texel_at_rest_stays_and_its_moments_decay() -> None:
    values = torch.zeros(SHAPE)
    adam = TexelAdam(values)
    adam.rates[:] = 0.1
    everywhere, one = torch.ones(SHAPE[:3], dtype=torch.bool), torch.zeros(SHAPE[:3], dtype=torch.bool)
    one[0, 0, 0] = True
    stepped(adam, torch.ones(SHAPE), everywhere)
    before = values.clone()
    for _ in range(4):
        stepped(adam, torch.ones(SHAPE), one)
    assert torch.equal(values[~one], before[~one]) and (values[one] < before[one]).all()
    stepped(adam, torch.zeros(SHAPE), everywhere)
    assert torch.allclose(adam.first[~one], torch.tensor(BETAS[0] ** 5 * (1 - BETAS[0])))
    assert torch.allclose(adam.second[~one], torch.tensor(BETAS[1] ** 5 * (1 - BETAS[1])))


def test_a_step_that_is_not_taken_leaves_nothing() -> None:
    values = torch.randn(SHAPE)
    before, adam = values.clone(), TexelAdam(values)
    adam.rates[:] = 0.1
    adam.gradient[0, 0], adam.touched[0, 0] = torch.nan, 1
    assert adam.largest().isnan().all()
    adam.gradient[0, 0, 1:] = -3.0
    adam.gradient[0, 0, 0] = torch.inf
    assert adam.largest().isinf().all()
    adam.zero_grad()
    adam.step()
    assert torch.equal(values, before) and not adam.gradient.isnan().any()


def test_tiny_gradients_move_as_far_as_large_ones() -> None:
    """Adam does not know the loss's unit; float32 has to hold the squares of 1e-9."""
    moved = []
    for size in (1.0, 1e-9):
        values = torch.zeros(SHAPE)
        adam = TexelAdam(values)
        adam.rates[:] = 0.01
        stepped(adam, torch.full(SHAPE, size), torch.ones(SHAPE[:3], dtype=torch.bool))
        moved.append(float(values.mean()))
    assert abs(moved[0] - moved[1]) < 1e-5 and moved[0] < -0.009


def test_a_continued_run_is_the_same() -> None:
    values = torch.randn(SHAPE)
    adam = TexelAdam(values)
    adam.rates[:] = 0.1
    everywhere = torch.ones(SHAPE[:3], dtype=torch.bool)
    stepped(adam, torch.ones(SHAPE), everywhere)
    again = TexelAdam(values.clone())
    again.load_state_dict(adam.state_dict())
    again.rates[:] = 0.1
    for one in (adam, again):
        stepped(one, torch.full(SHAPE, -2.0), everywhere)
    assert torch.equal(adam.values, again.values)


def test_after_a_long_rest_the_moments_are_gone() -> None:
    values = torch.zeros(SHAPE)
    adam = TexelAdam(values)
    adam.rates[:] = 0.1
    everywhere = torch.ones(SHAPE[:3], dtype=torch.bool)
    stepped(adam, torch.ones(SHAPE), everywhere)
    assert all(kept[-1] == 0 and kept[0] == 1 for kept in KEPT)
    adam.number += 10 * len(KEPT[0])
    stepped(adam, torch.full(SHAPE, 2.0), everywhere)
    assert torch.allclose(adam.first, torch.tensor(2 * (1 - BETAS[0]))) and torch.allclose(
        adam.second, torch.tensor(4 * (1 - BETAS[1]))
    )


def test_the_number_of_threads_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    """More texels than are looked through together, and a number of them that is no multiple of it."""
    shape, results = (3, 17, 17, 16), []
    for number in (1, 2, 3):
        monkeypatch.setattr(threads, "count", lambda number=number: number)
        random = torch.Generator().manual_seed(0)
        adam = TexelAdam(torch.randn(shape, generator=random))
        adam.rates[:] = 0.1
        for _ in range(3):
            touched = torch.rand(shape[:3], generator=random) < 0.3
            adam.gradient += torch.randn(shape, generator=random) * touched[..., None]
            adam.touched |= touched.to(torch.uint8)
            assert adam.largest() == adam.gradient.abs().max()
            adam.step()
            assert not adam.gradient.any() and not adam.touched.any() and (adam.last[touched] == adam.number).all()
        results.append(torch.cat([part.flatten() for part in (adam.values, adam.first, adam.second)]))
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])
