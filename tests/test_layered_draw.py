"""The run-time compositor against grid_sample, sort and cumulative products in float64; fewer bits, hard maps, refusals."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional

from avatar.layered import threads
from avatar.layered.draw import Textures, draw, quantised
from avatar.layered.raster import Fragments

LAYERS, SIDE, COARSE, HEIGHT, WIDTH = 5, 24, 6, 33, 150  # rows longer than a block, and not a multiple of it


def case(bases: int = 3, lead: int = 2, seed: int = 0) -> tuple[np.ndarray, np.ndarray, Fragments]:
    """Random textures, maps and fragments: layers cross in depth, some pixels are empty, some places lie at or over the edge."""
    random = np.random.default_rng(seed)
    textures = random.normal(size=(LAYERS, SIDE, SIDE, 4 * (1 + bases))).astype(np.float32) * 2
    maps = random.normal(size=(LAYERS, COARSE, COARSE, lead + 4 + bases)).astype(np.float32)
    maps[..., :lead] *= 0.05
    depth = random.uniform(0.5, 3, (LAYERS, HEIGHT, WIDTH)).astype(np.float32)
    depth[random.random(depth.shape) < 0.3] = 0
    depth[:, 5:9, :40] = 0
    uv = random.uniform(-0.02, 1.02, (LAYERS, HEIGHT, WIDTH, 2)).astype(np.float32)
    uv[:, 0, :9] = np.array([0, 1, 0.5])[random.integers(0, 3, (LAYERS, 9, 2))]
    uv[depth == 0] = 1e30  # without meaning
    return textures, maps, Fragments(depth, uv)


def twin(textures: np.ndarray, maps: np.ndarray, fragments: Fragments) -> np.ndarray:
    """The definition, [h, w, 4] in [0, 1]."""
    seen = torch.from_numpy(fragments.inverse_depth > 0)
    uv = torch.where(seen[..., None], torch.from_numpy(fragments.uv), 0).double()

    def fetch(values: np.ndarray, at: torch.Tensor) -> torch.Tensor:
        grid = torch.stack([at[..., 0] * 2 - 1, 1 - at[..., 1] * 2], -1)
        stack = torch.from_numpy(values).double().permute(0, 3, 1, 2)
        return functional.grid_sample(stack, grid, padding_mode="border", align_corners=False).permute(0, 2, 3, 1)

    bases = textures.shape[-1] // 4 - 1
    lead = maps.shape[-1] - 4 - bases
    local = fetch(maps, uv)
    texel = fetch(textures, uv + local[..., :2] if lead else uv).unflatten(-1, (-1, 4))
    logits = texel[..., 0, :] + local[..., lead : lead + 4] + (local[..., lead + 4 :, None] * texel[..., 1:, :]).sum(-2)
    shown = torch.sigmoid(logits) * seen[..., None]
    order = torch.argsort(torch.from_numpy(fragments.inverse_depth), dim=0, descending=True, stable=True)
    shown = shown.gather(0, order[..., None].expand_as(shown))
    light = torch.cumprod(1 - shown[..., 3], 0)
    weight = shown[..., 3] * torch.cat([torch.ones_like(light[:1]), light[:-1]])
    colour = (weight[..., None] * shown[..., :3]).sum(0) + light[-1][..., None]
    return torch.cat([colour, 1 - light[-1][..., None]], -1).numpy()


@pytest.mark.parametrize(("bases", "lead"), [(3, 2), (0, 2), (1, 0), (5, 2)])
def test_equals_the_definition_within_half_a_level(bases: int, lead: int) -> None:
    textures, maps, fragments = case(bases, lead)
    wanted = twin(textures, maps, fragments) * 255
    drawn = draw(quantised(textures, np.float32), maps, fragments, samples=1)
    assert np.abs(drawn - wanted).max() < 0.5 + 0.2  # rounding, the last light that is not followed, and the fast sigmoid
    assert wanted.std() > 20
    empty = (fragments.inverse_depth == 0).all(0)
    assert empty.sum() >= 160 and (drawn[empty] == [255, 255, 255, 0]).all()


def test_fewer_bits_cost_what_their_steps_are() -> None:
    textures, maps, fragments = case()
    wanted = twin(textures, maps, fragments) * 255
    error = {kind: np.abs(draw(quantised(textures, kind), maps, fragments, samples=1) - wanted) for kind in (np.int16, np.uint8)}
    assert error[np.int16].max() < 0.7
    assert error[np.uint8].max() < 6 and error[np.uint8].mean() < 0.6
    levels, step, low = quantised(textures)
    again = levels * step[:, None, None] + low[:, None, None]
    assert np.abs(again - textures).max() <= step.max() * 0.501
    stored = quantised(again)
    assert (stored.levels == levels).all()  # nothing is lost a second time
    np.testing.assert_allclose(twin(again, maps, fragments) * 255, draw(stored, maps, fragments, samples=1), atol=0.7)


def test_every_logit_is_squashed_right() -> None:
    """One layer, one opaque pixel a logit, from deep black to white and over."""
    logits = np.linspace(-40, 40, 801, dtype=np.float32)
    textures = np.zeros((1, 2, 2, 4), np.float32)
    fragments = Fragments(np.ones((1, 1, 1), np.float32), np.full((1, 1, 1, 2), 0.5, np.float32))
    for start in (0, 400):
        for logit in logits[start : start + 401 : 8]:
            maps = np.full((1, 2, 2, 4), logit, np.float32)
            maps[..., 3] = 100  # opaque
            plain = Textures(textures, np.ones((1, 4), np.float32), np.zeros((1, 4), np.float32))
            pixel = draw(plain, maps, fragments, samples=1)[0, 0]
            assert pixel[3] == 255 and np.abs(pixel[:3] - 255 / (1 + np.exp(-float(logit)))).max() < 0.53


def test_wild_maps_draw_something_finite_and_nothing_else_is_touched() -> None:
    textures, maps, fragments = case()
    maps[..., :2] *= 1e30  # fetches far outside: clamped to the edge
    assert draw(quantised(textures), maps, fragments, samples=1).shape == (HEIGHT, WIDTH, 4)
    fragments.uv[:] = np.nan
    draw(quantised(textures), maps, fragments, samples=1)  # no pixel means anything, but no memory outside is read
    for wrong in (np.nan, np.inf):
        maps[0, 0, 0, 4] = wrong
        with pytest.raises(ValueError, match="not finite"):
            draw(quantised(textures), maps, fragments, samples=1)


def test_threads_strides_and_buffers_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    textures, maps, fragments = case()
    stored = quantised(textures)
    whole = draw(stored, maps, fragments, samples=1)
    for count in (1, 2, 5):
        monkeypatch.setattr(threads, "count", lambda count=count: count)
        assert (draw(stored, maps, fragments, samples=1) == whole).all()
    strided = np.ascontiguousarray(maps.transpose(0, 3, 1, 2)).transpose(0, 2, 3, 1)
    buffer = np.full((HEIGHT, WIDTH, 4), 7, np.uint8)
    assert draw(stored, strided, fragments, buffer, samples=1) is buffer and (buffer == whole).all()
    nothing = Fragments(np.zeros((LAYERS, 0, 4), np.float32), np.zeros((LAYERS, 0, 4, 2), np.float32))
    assert draw(stored, maps, nothing, samples=1).shape == (0, 4, 4)


def test_a_pixel_is_the_mean_of_its_samples() -> None:
    textures, maps, fragments = case()
    stored, inner = quantised(textures), 32
    depth, uv = fragments.inverse_depth[:, :inner], fragments.uv[:, :inner]
    parts = [Fragments(np.ascontiguousarray(depth[:, s::2]), np.ascontiguousarray(uv[:, s::2])) for s in (0, 1)]
    whole = draw(stored, maps, Fragments(np.ascontiguousarray(depth), np.ascontiguousarray(uv)), samples=2)
    each = [draw(stored, maps, part, samples=1).astype(float) for part in parts]
    assert whole.shape == (inner // 2, WIDTH, 4)
    assert np.abs(whole - (each[0] + each[1]) / 2).max() <= 1 and np.abs(each[0] - each[1]).mean() > 20


def test_what_does_not_fit_is_refused() -> None:
    textures, maps, fragments = case()
    stored = quantised(textures)
    with pytest.raises(ValueError, match="need maps"):
        draw(stored, maps[..., :-1], fragments, samples=1)
    with pytest.raises(ValueError, match="need maps"):
        draw(stored, maps[1:], fragments, samples=1)
    with pytest.raises(ValueError, match="do not fit fragments"):
        draw(stored, maps, Fragments(fragments.inverse_depth[1:], fragments.uv[1:]), samples=1)
    for samples in (0, 2):
        with pytest.raises(ValueError, match="33 rows of fragments"):
            draw(stored, maps, fragments, samples=samples)
    with pytest.raises(ValueError, match="the picture is"):
        draw(stored, maps, fragments, np.empty((HEIGHT, WIDTH, 3), np.uint8), samples=1)
    with pytest.raises(ValueError, match="textures are"):
        quantised(textures[..., :5])
    textures[0, 0, 0, 0] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        quantised(textures)
