"""The error-correction warp against a point-by-point twin in float64; its Jacobian, turns of every size, the encoding."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from avatar.field import HEAD_SIZE_M
from avatar.networks import positional_encoding
from avatar.warp import WarpField, elastic, magnitude, rigid, windowed_encoding

HEADS = ("rotation", "centre", "translation")


def strong_warp(dtype: torch.dtype = torch.float64) -> WarpField:
    """A small warp with outputs of all signs and a size that a turn does not hide behind rounding."""
    torch.manual_seed(0)
    warp = WarpField(frames=3, latent_size=4, width=8, depth=6, bands=3)
    for layer in warp.out.values():
        torch.nn.init.normal_(layer.weight, std=0.3)
        torch.nn.init.normal_(layer.bias, std=0.3)
    for layer in (*warp.trunk, *warp.hidden.values()):
        torch.nn.init.normal_(layer.bias, std=0.3)
    return warp.to(dtype)


def cloud(count: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    return torch.randn(count, 3, dtype=dtype) * 0.08, torch.arange(count) % 3


def twin(warp: WarpField, point_m: np.ndarray, frame: int, window: float) -> np.ndarray:
    """Supplement A at one point, with NumPy and SciPy."""
    array = {name: value.detach().double().numpy() for name, value in warp.named_parameters()}
    point = point_m / HEAD_SIZE_M
    sines, cosines = [], []
    for band in range(warp.bands):
        weight = (1 - math.cos(math.pi * min(max(window - band, 0), 1))) / 2
        sines += [weight * math.sin(2**band * coordinate) for coordinate in point]
        cosines += [weight * math.cos(2**band * coordinate) for coordinate in point]
    inputs = np.concatenate([point, sines, cosines, array["latents"][frame]])
    hidden = inputs
    for i in range(len(warp.trunk)):
        hidden = np.concatenate([hidden, inputs]) if i == 4 else hidden
        hidden = np.maximum(array[f"trunk.{i}.weight"] @ hidden + array[f"trunk.{i}.bias"], 0)
    found = []
    for name in HEADS:
        inner = np.maximum(array[f"hidden.{name}.weight"] @ hidden + array[f"hidden.{name}.bias"], 0)
        found.append(array[f"out.{name}.weight"] @ inner + array[f"out.{name}.bias"])
    return move(point, *found) * HEAD_SIZE_M


def move(point: np.ndarray, log_quaternion: np.ndarray, centre: np.ndarray, shift: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(log_quaternion)
    axis = log_quaternion / size if size else log_quaternion
    rotation = Rotation.from_quat([*(math.sin(size) * axis), math.cos(size)])
    return rotation.apply(point + centre) - centre + shift


@torch.no_grad()
@pytest.mark.parametrize("window", [0.0, 0.4, 1.5, 3.0])
def test_warp_equals_its_twin(window: float) -> None:
    for dtype, rounding in ((torch.float64, 1e-14), (torch.float32, 1e-6)):
        warp, (points, frame) = strong_warp(dtype), cloud(9, dtype)
        found = warp(points, frame, window)
        expected = [twin(warp, point.double().numpy(), int(i), window) for point, i in zip(points, frame, strict=True)]
        np.testing.assert_allclose(found, expected, atol=rounding)
        assert found.dtype == dtype and (found - points).norm(dim=1).min() > 0.01


@pytest.mark.parametrize("window", [0.0, 1.5, 3.0])
def test_jacobian_equals_autograd_and_finite_differences(window: float) -> None:
    warp, (points, frame) = strong_warp(), cloud(6)
    warped, jacobian = warp.with_jacobian(points, frame, window)
    torch.testing.assert_close(warped, warp(points, frame, window))
    for i in range(len(points)):
        one = frame[i : i + 1]
        whole = torch.autograd.functional.jacobian(lambda point, one=one: warp(point[None], one, window)[0], points[i])
        torch.testing.assert_close(jacobian[i], whole, rtol=1e-10, atol=1e-12)
    step_m = 1e-7
    for k in range(3):
        offset = step_m * torch.eye(3, dtype=torch.float64)[k]
        ahead, behind = warp(points + offset, frame, window), warp(points - offset, frame, window)
        torch.testing.assert_close(jacobian[:, :, k], (ahead - behind) / (2 * step_m), rtol=1e-5, atol=1e-6)


def test_jacobian_without_bands() -> None:
    warp, (points, frame) = WarpField(3, bands=0).double(), cloud(2)
    whole = torch.autograd.functional.jacobian(lambda points: warp(points, frame, 0.0).sum(0), points).transpose(0, 1)
    torch.testing.assert_close(warp.with_jacobian(points, frame, 0.0)[1], whole)


@torch.no_grad()
def test_jacobian_in_float32() -> None:
    torch.manual_seed(1)
    warp, (points, frame) = WarpField(3), cloud(50, torch.float32)
    torch.nn.init.normal_(warp.out["rotation"].weight, std=0.1)
    rough = warp.with_jacobian(points, frame, 6.0)[1]
    exact = warp.double().with_jacobian(points.double(), frame, 6.0)[1]
    assert rough.dtype == torch.float32 and (exact - torch.eye(3)).abs().max() > 0.1
    torch.testing.assert_close(rough.double(), exact, rtol=1e-4, atol=1e-5)


def test_gradients_of_points_latents_and_weights() -> None:
    warp, (points, frame) = strong_warp(), cloud(4)
    names = ("latents", "trunk.0.weight", "trunk.4.weight", "hidden.centre.weight", "out.rotation.weight", "out.translation.bias")
    start = {name: value.detach() for name, value in warp.named_parameters()}

    class Both(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.warp = warp

        def forward(self, points: Tensor) -> Tensor:
            warped, jacobian = self.warp.with_jacobian(points, frame, 1.5)
            return torch.cat([warped / HEAD_SIZE_M, jacobian.flatten(1), elastic(jacobian)[:, None]], 1)

    both = Both()

    def outputs(points: Tensor, *values: Tensor) -> Tensor:
        given = {f"warp.{name}": value for name, value in {**start, **dict(zip(names, values, strict=True))}.items()}
        return torch.func.functional_call(both, given, (points,))

    leaves = [value.clone().requires_grad_() for value in (points, *(start[name] for name in names))]
    assert torch.autograd.gradcheck(outputs, leaves, eps=1e-7, atol=1e-6, fast_mode=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [0.0, 1e-20, 1e-8, 1e-4, 0.2, 0.4999, 0.5, 0.5001, math.pi / 4, math.pi / 2, math.pi, 7.0])
def test_turns_of_every_size(size: float, dtype: torch.dtype) -> None:
    """Value and gradient of R p by the log-quaternion, through a twin in the type's own rounding. 0.5: where series end."""
    axis, point = np.array([1.0, -2.0, 2.0]) / 3, np.array([0.3, -0.5, 0.7])
    centre, shift = np.array([0.1, 0.2, -0.3]), np.array([-0.02, 0.01, 0.03])
    given = [torch.from_numpy(value)[None].to(dtype).requires_grad_() for value in (size * axis, centre, shift)]
    found = rigid(torch.from_numpy(point)[None].to(dtype), given, None)[0][0]
    rounding = 1e-6 if dtype == torch.float32 else 1e-14
    np.testing.assert_allclose(found.detach(), move(point, size * axis, centre, shift), atol=rounding)
    for i in range(3):
        gradient = torch.autograd.grad(found[i], given[0], retain_graph=True)[0][0]
        for k in range(3):
            offset = 1e-6 * np.eye(3)[k]
            ahead, behind = (move(point, size * axis + sign * offset, centre, shift)[i] for sign in (1, -1))
            assert float(gradient[k]) == pytest.approx((ahead - behind) / 2e-6, abs=1e-5 if dtype == torch.float32 else 1e-9)


def test_the_naive_turn_has_no_gradient_at_zero() -> None:
    turn = torch.zeros(3, requires_grad=True)
    angle = turn.norm()
    (torch.sin(angle) * turn / angle.clamp_min(1e-8)).sum().backward()  # the formula with a clamp instead of a series
    assert not torch.allclose(turn.grad, torch.ones(3))


@pytest.mark.parametrize("size", [0.0, 1e-20, 1e-8, 0.49999, 0.50001, math.pi / 2, math.pi])
def test_tangents_of_turns_and_their_gradients(size: float) -> None:
    torch.manual_seed(0)
    point, around = torch.randn(1, 3).double(), torch.randn(3, 1, 3).double()
    turn = (size * torch.tensor([[1.0, -2.0, 2.0]], dtype=torch.float64) / 3).requires_grad_()
    parts, moves = [turn, *torch.randn(2, 1, 3).double()], list(torch.randn(3, 3, 1, 3).double())

    def along(offset: Tensor) -> Tensor:
        linear = [part + torch.einsum("k,kpi->pi", offset, move) for part, move in zip(parts, moves, strict=True)]
        return rigid(point + offset, linear, None)[0][0]

    expected = torch.autograd.functional.jacobian(along, torch.zeros(3).double())
    torch.testing.assert_close(rigid(point, parts, moves)[1][:, 0].T, expected)
    assert torch.autograd.gradcheck(lambda turn: rigid(point, [turn, *parts[1:]], moves)[1] * around, turn)


def test_window_of_the_encoding() -> None:
    values = torch.randn(5, 3).double()
    torch.testing.assert_close(windowed_encoding(values, 4, 4.0), positional_encoding(values, 4), rtol=0, atol=1e-14)
    torch.testing.assert_close(windowed_encoding(values, 4, 9.0), positional_encoding(values, 4), rtol=0, atol=1e-14)
    for alpha in (0.0, -1.0):
        assert not windowed_encoding(values, 4, alpha)[:, 3:].any()
    for alpha in (0.25, 1.5, 2.75):
        found = windowed_encoding(values, 4, alpha)
        assert torch.equal(found[:, :3], values)
        for band in range(4):
            weight = (1 - math.cos(math.pi * min(max(alpha - band, 0), 1))) / 2
            torch.testing.assert_close(found[:, 3 + 3 * band : 6 + 3 * band], weight * torch.sin(2**band * values))
            torch.testing.assert_close(found[:, 15 + 3 * band : 18 + 3 * band], weight * torch.cos(2**band * values))
    assert torch.equal(windowed_encoding(values, 0, 0.0), values)


@torch.no_grad()
@pytest.mark.parametrize("window", [0.0, 6.0])
def test_starts_near_the_identity(window: float) -> None:
    torch.manual_seed(0)
    warp = WarpField(20)
    points, frame = torch.randn(500, 3) * 0.08, torch.randint(0, 20, (500,))
    warped, jacobian = warp.with_jacobian(points, frame, window)
    assert 0 < (warped - points).norm(dim=1).max() < 1e-3  # metres
    assert (jacobian - torch.eye(3)).abs().max() < 0.03 and magnitude(points, warped) < 1e-5
    assert warp.latents.min() >= 0 and warp.latents.max() <= 0.05


def test_sizes_are_the_papers() -> None:
    warp = WarpField(7)
    assert warp.latents.shape == (7, 64)
    assert [tuple(layer.weight.shape) for layer in warp.trunk] == [(128, 103), *[(128, 128)] * 3, (128, 231)]
    assert [tuple(warp.hidden[name].weight.shape) for name in HEADS] == [(128, 128)] * 3
    assert [tuple(warp.out[name].weight.shape) for name in HEADS] == [(3, 128)] * 3
    for layer in warp.out.values():
        assert layer.weight.min() >= 0 and layer.weight.max() <= 1e-4 and not layer.bias.any()


def test_only_latents_in_use_get_a_gradient() -> None:
    warp, points = WarpField(4), torch.randn(6, 3) * 0.08
    warp(points, torch.tensor([0, 2, 2, 0, 0, 2]), 2.0).square().sum().backward()
    assert warp.latents.grad[[0, 2]].abs().amax(1).min() > 0 and not warp.latents.grad[[1, 3]].any()


@pytest.mark.parametrize("frame", [3, -1])
def test_a_frame_without_a_latent_is_an_error(frame: int) -> None:
    warp = strong_warp()
    for call in (warp, warp.with_jacobian):
        with pytest.raises(IndexError):
            call(torch.zeros(2, 3).double(), torch.tensor([0, frame]), 1.0)


def test_fewer_frames_than_points_is_an_error() -> None:
    with pytest.raises(RuntimeError, match="Sizes of tensors must match"):
        strong_warp()(torch.zeros(2, 3).double(), torch.tensor([0]), 1.0)


def test_no_points() -> None:
    warp, nothing = strong_warp(), torch.empty(0, dtype=torch.int64)
    warped, jacobian = warp.with_jacobian(torch.empty(0, 3).double(), nothing, 1.0)
    assert warped.shape == (0, 3) and jacobian.shape == (0, 3, 3) and elastic(jacobian).shape == (0,)
    assert warp(torch.empty(0, 3).double(), nothing, 1.0).shape == (0, 3)
    total = magnitude(torch.empty(0, 3).double(), warped) + elastic(jacobian).sum()
    total.backward()
    assert float(total) == 0 and not warp.latents.grad.any()


def test_magnitude() -> None:
    points = torch.zeros(2, 3, dtype=torch.float64)
    warped = torch.tensor([[HEAD_SIZE_M, 0, 0], [0, 2 * HEAD_SIZE_M, 0]], dtype=torch.float64).requires_grad_()
    assert float(magnitude(points, warped)) == pytest.approx(2.5)
    assert torch.autograd.gradcheck(lambda warped: magnitude(points, warped), warped)


def test_the_warp_learns_a_known_move() -> None:
    """Two frames, moved opposite ways: the latents tell them apart."""
    torch.manual_seed(0)
    warp, points = WarpField(2), torch.randn(80, 3) * 0.05
    frame = torch.arange(80) % 2
    truth = points + (2 * frame[:, None] - 1) * torch.tensor([0.004, 0.0, -0.002])
    optimiser = torch.optim.Adam(warp.parameters(), lr=3e-3)
    for _ in range(60):
        warped, jacobian = warp.with_jacobian(points, frame, 1.0)
        loss = magnitude(warped, truth) + 1e-4 * elastic(jacobian).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    assert (warped - truth).norm(dim=1).median() < 5e-4
