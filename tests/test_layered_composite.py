"""Drawing fragments with gradients: against plain PyTorch in float64, and against what must hold at the limits."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from avatar.layered import composite, threads
from avatar.layered.raster import Fragments

LAYERS, SIDE, SMALL, BASES, HEIGHT, WIDTH = 4, 12, 5, 2, 7, 9


def scene(seed: int = 0, spread: float = 1.0) -> tuple[Tensor, Tensor, Fragments]:
    """Random textures [L, R, R, C], maps [L, r, r, D] and fragments; a third of them show nothing."""
    random = np.random.default_rng(seed)
    textures = torch.from_numpy(random.normal(0, spread, (LAYERS, SIDE, SIDE, composite.texture_channels(BASES))))
    maps = torch.from_numpy(random.normal(0, spread, (LAYERS, SMALL, SMALL, composite.map_channels(BASES))))
    maps[..., : composite.MOVE] *= 0.05
    textures[..., 3] -= 2 * spread  # seldom so opaque that the kernel ends early and the twin goes on
    inverse_depth = random.uniform(0.5, 2, (LAYERS, HEIGHT, WIDTH)) * (random.random((LAYERS, HEIGHT, WIDTH)) > 0.3)
    uv = random.uniform(0.12, 0.88, (LAYERS, HEIGHT, WIDTH, 2))
    return textures.float(), maps.float(), Fragments(inverse_depth.astype(np.float32), uv.astype(np.float32))


def exact(textures: Tensor, maps: Tensor, fragments: Fragments) -> tuple[Tensor, Tensor, int]:
    """The twin in float64."""
    there = Fragments(*(torch.from_numpy(part).double() for part in fragments))
    return composite.reference(textures.double(), maps.double(), there)


def test_values_against_the_twin() -> None:
    textures, maps, fragments = scene()
    fragments.uv[:, 0] = np.random.default_rng(7).uniform(-0.1, 1.1, fragments.uv[:, 0].shape)  # outside the texture: its border
    image, depth, evaluations = composite.composite(textures, maps, fragments)
    expected, far, shown = exact(textures, maps, fragments)
    assert image.shape == (HEIGHT, WIDTH, 4) and depth.shape == (HEIGHT, WIDTH)
    torch.testing.assert_close(image.double(), expected, atol=2e-5, rtol=0)
    torch.testing.assert_close(depth.double(), far, atol=2e-5, rtol=0)
    assert evaluations == shown == int((fragments.inverse_depth > 0).sum())


@pytest.mark.parametrize("samples", [1, 2])
def test_gradients_against_the_twin(samples: int) -> None:
    textures, maps, fragments = scene(1)
    rows = HEIGHT // samples
    fragments = Fragments(*(np.ascontiguousarray(part[:, : rows * samples]) for part in fragments))
    weight = torch.from_numpy(np.random.default_rng(2).normal(size=(rows, WIDTH, 4)))

    def pixels(drawn: tuple[Tensor, Tensor, int]) -> Tensor:
        return composite.averaged(*drawn[:2], samples)[0]

    slow_textures, slow_maps = textures.double().requires_grad_(), maps.double().requires_grad_()
    (pixels(exact(slow_textures, slow_maps, fragments)) * weight).sum().backward()
    gradient, touched = torch.zeros_like(textures), torch.zeros(textures.shape[:3], dtype=torch.uint8)
    fast = maps.clone().requires_grad_()
    (pixels(composite.composite(textures, fast, fragments, gradient, touched)) * weight.float()).sum().backward()
    torch.testing.assert_close(gradient.double(), slow_textures.grad, atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(fast.grad.double(), slow_maps.grad, atol=1e-4, rtol=1e-3)
    assert torch.equal(touched.bool(), touched.bool() | (gradient != 0).any(-1)) and touched.any() and not touched.all()


def test_pixels_are_means_of_their_samples() -> None:
    textures, maps, fragments = scene(5)
    even = Fragments(*(np.ascontiguousarray(part[:, :6]) for part in fragments))
    even.inverse_depth[:, :2, 0] = 0  # both samples of a pixel empty
    even.inverse_depth[:, 2, 0] = 0  # and one of another
    image, depth, _ = composite.composite(
        textures, maps.requires_grad_(), even, torch.zeros_like(textures), torch.zeros(textures.shape[:3], dtype=torch.uint8)
    )
    pixels, along = composite.averaged(image, depth, 2)
    assert pixels.shape == (3, WIDTH, 4) and along.shape == (3, WIDTH)
    torch.testing.assert_close(pixels, (image[0::2] + image[1::2]) / 2)
    assert along[0, 0] == 0 and torch.isclose(along[1, 0], depth[3, 0])  # nothing is no depth, and does not count as one
    assert pixels.requires_grad and not along.requires_grad
    same = composite.averaged(image, depth, 1)
    assert same[0] is image and same[1] is depth


def test_what_lies_behind_an_opaque_layer_is_not_asked_for() -> None:
    textures, maps, fragments = scene(3)
    textures[..., 3], maps[...] = 20.0, 0.0
    image, _, evaluations = composite.composite(textures, maps, fragments)
    covered = (fragments.inverse_depth > 0).any(0)
    assert evaluations == covered.sum() and np.allclose(image[..., 3].numpy(), covered, atol=1e-3)


def test_the_nearest_layer_wins_whatever_its_number() -> None:
    textures, maps, fragments = scene(4)
    textures[...], maps[...], fragments.uv[...] = 0.0, 0.0, 0.5
    textures[..., 3] = 20.0
    for layer in range(LAYERS):
        textures[layer, ..., :3] = 4.0 * (layer - 1.5)
    fragments.inverse_depth[...] = np.array([1, 3, 2, 0.5])[:, None, None]
    image, depth, _ = composite.composite(textures, maps, fragments)
    assert torch.allclose(image[..., 0], torch.sigmoid(torch.tensor(-2.0)), atol=1e-5) and torch.allclose(
        depth, torch.tensor(1 / 3)
    )


def test_nothing_seen_is_white_without_gradient() -> None:
    textures, maps, fragments = scene(5)
    fragments.inverse_depth[...] = 0
    gradient, touched = torch.zeros_like(textures), torch.zeros(textures.shape[:3], dtype=torch.uint8)
    maps.requires_grad_()
    image, depth, evaluations = composite.composite(textures, maps, fragments, gradient, touched)
    image.sum().backward()
    assert (image[..., :3] == 1).all() and (image[..., 3] == 0).all() and (depth == 0).all() and evaluations == 0
    assert not gradient.any() and not touched.any() and not maps.grad.any()


@pytest.mark.parametrize("size", [1e4, 1e8])
def test_huge_logits_stay_finite(size: float) -> None:
    textures, maps, fragments = scene(6, size)
    gradient, touched = torch.zeros_like(textures), torch.zeros(textures.shape[:3], dtype=torch.uint8)
    maps = maps.clone()
    maps[..., : composite.MOVE] = 0.01
    maps.requires_grad_()
    image, _, _ = composite.composite(textures, maps, fragments, gradient, touched)
    image.sum().backward()
    assert torch.isfinite(image).all() and torch.isfinite(gradient).all() and torch.isfinite(maps.grad).all()


def test_shapes_that_do_not_fit() -> None:
    textures, maps, fragments = scene()
    with pytest.raises(ValueError, match="layers drawn"):
        composite.composite(textures[:-1], maps, fragments)
    with pytest.raises(ValueError, match="layers drawn"):
        composite.composite(textures[..., :-4], maps, fragments)
    many = composite.MOST_LAYERS + 1
    wide = Fragments(np.zeros((many, 1, 1), np.float32), np.zeros((many, 1, 1, 2), np.float32))
    with pytest.raises(ValueError, match="at most"):
        composite.composite(textures[:1].repeat(many, 1, 1, 1), maps[:1].repeat(many, 1, 1, 1), wide)


def wide(seed: int) -> tuple[Tensor, Tensor, Fragments]:
    """Three rows of more pixels than pass a stage together, 3 bases, and all layers in each pixel somewhere."""
    random = np.random.default_rng(seed)
    textures = torch.from_numpy(random.normal(0, 1, (LAYERS, SIDE, SIDE, composite.texture_channels(3)))).float()
    textures[..., 3] -= 2
    maps = torch.from_numpy(random.normal(0, 1, (LAYERS, SMALL, SMALL, composite.map_channels(3)))).float()
    maps[..., : composite.MOVE] *= 0.05
    inverse_depth = random.uniform(0.5, 2, (LAYERS, 3, 150)) * (random.random((LAYERS, 3, 150)) > 0.2)
    uv = random.uniform(0.12, 0.88, (LAYERS, 3, 150, 2))
    return textures, maps, Fragments(inverse_depth.astype(np.float32), uv.astype(np.float32))


def drawn_and_back(textures: Tensor, maps: Tensor, fragments: Fragments) -> list[Tensor]:
    """Image, depth, and the gradients of textures and maps of a weighted sum of the image; what was touched."""
    gradient, touched = torch.zeros_like(textures), torch.zeros(textures.shape[:3], dtype=torch.uint8)
    fast = maps.clone().requires_grad_()
    image, depth, _ = composite.composite(textures, fast, fragments, gradient, touched)
    weight = torch.from_numpy(np.random.default_rng(9).normal(size=image.shape)).float()
    (image * weight).sum().backward()
    return [image.detach(), depth, gradient, fast.grad, touched]


def test_a_row_of_several_blocks_against_the_twin() -> None:
    textures, maps, fragments = wide(10)
    image, depth, gradient, to_maps, _ = drawn_and_back(textures, maps, fragments)
    slow_textures, slow_maps = textures.double().requires_grad_(), maps.double().requires_grad_()
    there = Fragments(*(torch.from_numpy(part).double() for part in fragments))
    expected, far, _ = composite.reference(slow_textures, slow_maps, there)
    weight = torch.from_numpy(np.random.default_rng(9).normal(size=image.shape)).float().double()
    (expected * weight).sum().backward()
    torch.testing.assert_close(image.double(), expected.detach(), atol=2e-5, rtol=0)
    torch.testing.assert_close(depth.double(), far, atol=2e-5, rtol=0)
    torch.testing.assert_close(gradient.double(), slow_textures.grad, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(to_maps.double(), slow_maps.grad, atol=1e-3, rtol=1e-3)


def test_the_number_of_threads_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for number in (1, 2, 5):
        monkeypatch.setattr(threads, "count", lambda number=number: number)
        results.append(drawn_and_back(*wide(11)))
    for other in results[1:]:
        assert all(torch.equal(one, two) for one, two in zip(results[0], other, strict=True))


def test_what_is_hidden_gets_no_gradient() -> None:
    """Only what was drawn is read again: what was kept of the others is whatever the memory held."""
    textures, maps, fragments = wide(12)
    textures[..., 3], maps[...], fragments.inverse_depth[...] = 20.0, 0.0, np.arange(LAYERS, 0, -1)[:, None, None]
    _, _, gradient, to_maps, touched = drawn_and_back(textures, maps, fragments)
    assert gradient[0].any() and touched[0].any() and to_maps[0].any()
    assert not gradient[1:].any() and not touched[1:].any() and not to_maps[1:].any()


@pytest.mark.parametrize("which", ["texture", "map", "move"])
def test_what_is_not_a_number_is_not_hidden(which: str) -> None:
    """A step whose loss is not a number is not taken: so it must arrive there."""
    textures, maps, fragments = wide(13)
    broken = textures if which == "texture" else maps
    broken[...] = torch.nan
    if which == "move":
        maps[..., composite.MOVE :] = 0.0  # nothing to see of it, but no place outside the texture may be read
    image = composite.composite(textures, maps, fragments)[0]
    covered = torch.from_numpy((fragments.inverse_depth > 0).any(0))
    assert torch.isfinite(image).all() if which == "move" else image[covered].isnan().all()


def test_a_gradient_that_is_a_view_is_refused() -> None:
    textures, maps, fragments = scene(8)
    gradient, touched = torch.zeros(2, *textures.shape).transpose(0, 1)[:, 0], torch.zeros(textures.shape[:3], dtype=torch.uint8)
    image, _, _ = composite.composite(textures, maps.requires_grad_(), fragments, gradient.transpose(1, 2), touched)
    with pytest.raises(RuntimeError, match="view"):
        image.sum().backward()
