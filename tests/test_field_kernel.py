"""The compiled field against `Field.plainly` in float64, and in the types that it is for; threads, padding, NaN."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from avatar import field_kernel, field_loops
from avatar.field import HEAD_SIZE_M, NEAREST_M, Field, inverse_distance_weights
from avatar.neighbours import nearest_by_tree, tree_of
from avatar.networks import positional_encoding

Found = tuple[torch.Tensor, torch.Tensor, dict[str, torch.Tensor]]


def small_field(dtype: torch.dtype, **sizes: int) -> Field:
    torch.manual_seed(0)
    keys = {"channels": 6, "width": 24, "depth": 3, "colour_width": 8, "neighbours": 4, "bands": 5, "view_bands": 2}
    field = Field(**(keys | sizes)).to(dtype)
    for parameter in field.parameters():
        if parameter.dim() == 1:
            torch.nn.init.normal_(parameter, std=0.1)
    return field


def question(field: Field, count: int, dtype: torch.dtype) -> tuple[torch.Tensor, ...]:
    """Points [P, 3], some on a vertex and some far away, directions, vertices, neighbours and features."""
    random = np.random.default_rng(0)
    vertices = random.normal(size=(60, 3)) * 0.05
    points = random.normal(size=(count, 3)) * 0.05
    points[: count // 10] = vertices[random.integers(0, 60, count // 10)]
    points[count // 10 : count // 5] *= 8  # offsets beyond the series of sine and cosine
    directions = random.normal(size=(count, 3))
    directions[1::2] = directions[: 2 * (count // 2) : 2]
    index = nearest_by_tree(tree_of(vertices), points, field.neighbours)
    arrays = (points, directions / np.linalg.norm(directions, axis=1, keepdims=True), vertices, random.normal(size=(60, 6)))
    points, directions, vertices, features = (torch.from_numpy(array).to(dtype) for array in arrays)
    return points, directions, vertices, torch.from_numpy(index), features


def answer(field: Field, name: str, count: int, dtype: torch.dtype, precision: torch.dtype) -> Found:
    """Density, colour and all gradients by `forward` or `plainly`."""
    points, directions, vertices, index, features = question(field, count, dtype)
    features.requires_grad_()
    field.zero_grad()
    terms = field.vertex_terms(features, precision)
    density, colour = getattr(field, name)(points, directions, vertices, index, terms, precision)
    pull = torch.sin(torch.arange(3 * count, dtype=dtype)).view(count, 3)
    ((colour * pull).sum() + 0.003 * (density * (1 + pull[:, 0])).sum()).backward()
    gradients = {name: parameter.grad.clone() for name, parameter in field.named_parameters()}
    return density.detach(), colour.detach(), gradients | {"features": features.grad}


@pytest.mark.parametrize("count", [1, 127, 300])
@pytest.mark.parametrize("sizes", [{}, {"depth": 1, "bands": 0, "view_bands": 0}, {"neighbours": 1, "width": 40, "bands": 10}])
def test_values_and_gradients_equal_those_layer_by_layer_in_float64(count: int, sizes: dict, monkeypatch) -> None:  # noqa: ANN001
    monkeypatch.setattr(field_kernel, "BLOCK", 128)
    field = small_field(torch.float64, **sizes)
    quick = answer(field, "forward", count, torch.float64, torch.float64)
    slow = answer(field, "plainly", count, torch.float64, torch.float64)
    torch.testing.assert_close(quick[0], slow[0], rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(quick[1], slow[1], rtol=1e-10, atol=1e-10)
    assert quick[2].keys() == slow[2].keys()
    for name, gradient in slow[2].items():
        torch.testing.assert_close(quick[2][name], gradient, rtol=1e-9, atol=1e-11, msg=name)


@pytest.mark.parametrize("precision", [torch.float32, torch.bfloat16])
def test_in_lower_precision_as_near_to_float64_as_layer_by_layer(precision: torch.dtype) -> None:
    exact = answer(small_field(torch.float64), "plainly", 500, torch.float64, torch.float64)
    field = small_field(torch.float32)
    found = {name: answer(field, name, 500, torch.float32, precision) for name in ("forward", "plainly")}

    def away(name: str, pick) -> float:  # noqa: ANN001
        return float((pick(found[name]).double() - pick(exact)).norm() / pick(exact).norm())

    parts = [lambda f: f[0], lambda f: f[1], *(lambda f, name=name: f[2][name] for name in exact[2])]
    for pick in parts:
        assert away("forward", pick) < max(1.3 * away("plainly", pick), 1e-5)
    assert found["forward"][0].dtype == torch.float32 and found["forward"][2]["features"].dtype == torch.float32


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_any_number_of_threads_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """To the rounding of the products: on some processors their sums are split by the number of threads."""
    monkeypatch.setattr(field_kernel, "BLOCK", 128)
    field, found = small_field(torch.float32), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        found.append(answer(field, "forward", 700, torch.float32, torch.float32))
    for other in found[1:]:
        pairs = [*zip(found[0][:2], other[:2], strict=True), *((found[0][2][name], part) for name, part in other[2].items())]
        for one, another in pairs:
            assert (one - another).abs().max() <= 3e-6 * one.abs().max()


def test_weights_that_are_not_finite_show() -> None:
    """A fused ReLU makes 0 of NaN; the field is evaluated layer by layer then."""
    field = small_field(torch.float32)
    torch.nn.init.constant_(field.mlp0.layers[0].weight[:1], float("nan"))
    density, colour, gradients = answer(field, "forward", 20, torch.float32, torch.float32)
    assert density.isnan().all() and colour.isnan().all() and gradients["features"].isnan().any()


@pytest.mark.parametrize("which", ["points", "directions", "terms"])
def test_what_is_not_finite_shows(which: str) -> None:
    field = small_field(torch.float32)
    points, directions, vertices, index, features = question(field, 10, torch.float32)
    terms = field.vertex_terms(features, torch.float32)
    {"points": points, "directions": directions, "terms": terms}[which][:] = float("nan")
    with torch.no_grad():
        density, colour = field(points, directions, vertices, index, terms, torch.float32)
    assert colour.isnan().all() and (which == "directions" or density.isnan().all())


def test_points_or_vertices_with_gradients_and_no_points_go_layer_by_layer(monkeypatch: pytest.MonkeyPatch) -> None:
    field = small_field(torch.float64)
    points, directions, vertices, index, features = question(field, 10, torch.float64)
    terms = field.vertex_terms(features, torch.float64)
    monkeypatch.setattr(field_kernel, "evaluate", lambda *_: pytest.fail("constant samples only"))
    field(points[5:].clone().requires_grad_(), directions[5:], vertices, index[5:], terms, torch.float64)[0].sum().backward()
    density, colour = field(points[:0], directions[:0], vertices, index[:0], terms, torch.float64)
    assert density.shape == (0,) and colour.shape == (0, 3)
    with pytest.raises(pytest.fail.Exception):
        field(points, directions, vertices, index, terms, torch.float64)


@pytest.mark.parametrize("bands", [0, 1, 10])
def test_encodings_and_weights(bands: int) -> None:
    points, _, vertices, index, _ = question(small_field(torch.float64), 90, torch.float64)
    offsets = vertices[index] - points[:, None]
    expected = positional_encoding(offsets / HEAD_SIZE_M, bands).flatten(0, 1)
    encoded, weights = np.ones((360, expected.shape[1] + 5)), np.empty((90, 4))
    arrays = (array.numpy() for array in (points, vertices, index))
    field_loops.encode_offsets(*arrays, bands, HEAD_SIZE_M, NEAREST_M, encoded, weights)
    np.testing.assert_allclose(encoded[:, :-5], expected.numpy(), atol=1e-11)
    assert not encoded[:, -5:].any()
    np.testing.assert_allclose(weights, inverse_distance_weights(offsets).numpy(), atol=1e-14)


def test_numbers_are_stored_as_pytorch_rounds_them_to_bfloat16() -> None:
    random = np.random.default_rng(0).normal(size=4000) * 10.0 ** np.random.default_rng(1).integers(-30, 30, 4000)
    special = np.array([0, -0.0, 1 + 2**-8, 1 + 3 * 2**-8, 1 + 2**-8 + 2**-20, np.inf, -np.inf, np.nan, 3.4e38, 1e-44])
    values = torch.from_numpy(np.concatenate([random, special]).astype(np.float32))[None]
    rows = torch.zeros(1, values.shape[1], dtype=torch.bfloat16)
    wide = values.to(torch.bfloat16)
    field_loops.mix(field_kernel.stored(wide), np.ones((1, 1), np.float32), field_kernel.stored(rows))
    assert torch.equal(rows.nan_to_num(7), wide.nan_to_num(7))
    into, like = torch.zeros(1, values.shape[1], dtype=torch.bfloat16), torch.ones(1, values.shape[1], dtype=torch.bfloat16)
    nothing, slope = torch.zeros_like(into), np.ones(1, np.float32)
    arrays = (field_kernel.stored(tensor) for tensor in (like, into))
    field_loops.join_back(field_kernel.stored(nothing), slope, values[0].numpy(), *arrays)
    assert torch.equal(into.nan_to_num(7), wide.nan_to_num(7))
