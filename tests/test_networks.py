"""Positional encoding against its definition, MLP precision, U-Net shapes, sizes and gradients."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn

from avatar.networks import (
    MLP,
    SLOPE,
    ResidualBlock,
    UNet,
    best_precision,
    decode,
    encoded_size,
    enlarging_blocks,
    keep_size,
    linear_in,
    positional_encoding,
    train_in,
)


def test_positional_encoding_equals_its_definition() -> None:
    values = torch.tensor([[0.3, -1.2, 2.0]], dtype=torch.float64)
    expected = list(values[0])
    for function in (math.sin, math.cos):
        expected += [function(2.0**band * float(value)) for band in range(4) for value in values[0]]
    found = positional_encoding(values, 4)
    assert found.shape == (1, encoded_size(3, 4)) == (1, 27)
    torch.testing.assert_close(found[0], torch.tensor([float(value) for value in expected], dtype=torch.float64))
    assert positional_encoding(values, 0) is values
    assert (encoded_size(3, 10), encoded_size(3, 4)) == (63, 27)  # the paper's sizes


def test_encoding_in_float32_stays_close_at_the_highest_band() -> None:
    values = torch.rand(500, 3, dtype=torch.float64) * 2 - 1
    error = (positional_encoding(values.float(), 10).double() - positional_encoding(values, 10)).abs().max()
    assert error < 1e-4


def test_mlp_gradients_and_bfloat16_error() -> None:
    torch.manual_seed(0)
    network = MLP([20, 128, 128, 128])
    rows = torch.randn(256, 20)
    exact = network(rows)
    rough = network(rows, torch.bfloat16)
    assert rough.dtype == torch.bfloat16
    assert (rough.float() - exact).norm() / exact.norm() < 0.02
    small = MLP([3, 4, 2]).double()
    torch.autograd.gradcheck(lambda x: small(x, torch.float64), torch.randn(5, 3, dtype=torch.float64, requires_grad=True))
    rough.float().sum().backward()
    assert network.layers[0].weight.grad.dtype == torch.float32  # master weights


def test_linear_in_own_precision_is_the_layer() -> None:
    layer, rows = nn.Linear(5, 7), torch.randn(3, 5)
    torch.testing.assert_close(linear_in(torch.float32, layer, rows), layer(rows))


@pytest.mark.parametrize("size", [64, 128])
def test_unet_keeps_the_resolution_and_uses_every_parameter(size: int) -> None:
    torch.manual_seed(0)
    network = UNet(3, 64)
    maps = torch.randn(2, 3, size, size)
    result = network(maps)
    assert result.shape == (2, 64, size, size)
    result.square().mean().backward()
    assert all(parameter.grad is not None and parameter.grad.abs().sum() > 0 for parameter in network.parameters())


def test_a_new_unet_keeps_the_size_of_what_it_reads() -> None:
    """Maps of two frames differ as much as the frames do: with PyTorch's own start by a thousandth of it."""
    torch.manual_seed(0)
    with torch.no_grad():
        for size in (0.01, 1.0):
            frames = nn.functional.interpolate(size * torch.randn(4, 3, 4, 4), (64, 64), mode="bicubic")
            maps = UNet(3, 64)(frames)
            assert 0.3 < maps.std(0).mean() / frames.std(0).mean() < 3 and maps.std(0).mean() > 0.3 * maps.square().mean().sqrt()
        assert not UNet(3, 64)(torch.zeros(1, 3, 64, 64)).any()  # biases of zero
        block = ResidualBlock(64, 64)
        rows, before = torch.randn(8, 64, 16, 16), block.second.weight.clone()
        assert not torch.equal(block.apply(keep_size).second.weight, before)
        assert 0.6 < block(rows).square().mean().sqrt() < 1.7


def test_unet_has_the_papers_channels() -> None:
    network = UNet(3, 64)
    assert [block.second.out_channels for block in network.down] == [8, 16, 32, 64, 128, 256]
    assert [block.out_channels for block in network.up] == [128, 64, 64, 64, 64, 64]


def test_unet_refuses_a_size_that_cannot_be_halved() -> None:
    with pytest.raises(ValueError, match="cannot be halved 6 times"):
        UNet(3, 8)(torch.zeros(1, 3, 48, 64))


def test_decoder_blocks_double_the_maps_and_the_last_skip_joins_first() -> None:
    torch.manual_seed(0)
    blocks = [part.double() for part in enlarging_blocks(256, [5, 3, 0])]
    assert [layer.out_channels for layer in blocks[0]] == [128, 64, 64]
    assert [block.first.in_channels for block in blocks[1]] == [128 + 5, 64 + 3, 64]
    start, wide, deep = (torch.randn(2, c, s, s, dtype=torch.float64) for c, s in ((256, 2), (3, 8), (5, 4)))
    found, maps = decode(start, *blocks, [wide, deep]), start
    for enlarge, merge, skip in zip(*blocks, (deep, wide, None), strict=True):
        maps = nn.functional.leaky_relu(enlarge(maps), SLOPE)
        maps = merge(maps if skip is None else torch.cat([maps, skip], 1))
    assert found.shape == (2, 64, 16, 16) and torch.equal(found, maps)


def test_no_strided_pointwise_convolution() -> None:
    """Its gradient writes past its workspace in the pinned torch (random crashes seen on two threads)."""
    strided = [
        layer for layer in ResidualBlock(3, 8, 2).modules() if isinstance(layer, nn.Conv2d) and layer.kernel_size == (1, 1)
    ]
    assert all(layer.stride == (1, 1) for layer in strided)


def test_best_precision_is_bfloat16_or_float32() -> None:
    assert best_precision("cpu") in (torch.bfloat16, torch.float32)


def test_training_in_bfloat16_stays_near_and_pictures_are_exact() -> None:
    torch.manual_seed(0)
    unet, maps = UNet(3, 8), torch.randn(2, 3, 64, 64)
    with torch.no_grad():
        exact = unet(maps)
    unet(maps).square().sum().backward()
    gradients = [parameter.grad.clone() for parameter in unet.parameters()]
    unet.zero_grad()
    train_in(nn.Sequential(unet), torch.bfloat16)
    near = unet(maps)
    assert near.dtype == torch.float32 and 1e-6 < (near - exact).norm() / exact.norm() < 0.03
    near.square().sum().backward()
    cosines = [
        torch.cosine_similarity(p.grad.flatten(), g.flatten(), 0) for p, g in zip(unet.parameters(), gradients, strict=True)
    ]
    assert all(parameter.grad.dtype == torch.float32 for parameter in unet.parameters()) and min(cosines) > 0.95
    with torch.no_grad():
        torch.testing.assert_close(unet(maps), exact, atol=1e-5, rtol=1e-4)
