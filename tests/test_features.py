"""Sources of the vertex features: shapes, scale, what each one reads, slow twins in float64, gradients, repeatability."""

from __future__ import annotations

from importlib import import_module

import pytest
import torch
from torch import Tensor, nn
from toy_head import toy_head, toy_track

from avatar import build
from avatar.config import TrainConfig
from avatar.dataset import Scene
from avatar.features import Condition
from avatar.features import codes_mlp as vae
from avatar.features.ours_c import doublings
from avatar.features.shared import DISPLACEMENT_UNIT_M, FEATURE_SCALE, POSITION_BANDS, STATIC_GAIN, VertexMLP
from avatar.field import HEAD_SIZE_M
from avatar.networks import positional_encoding

SOURCES = ("ours_d", "ours_c", "codes_mlp", "codes", "static", "displacement_mlp")
READ_CODES = ("ours_c", "codes_mlp", "codes")
READ_DISPLACEMENT = ("ours_d", "displacement_mlp")
WITH_OPTIONAL_TABLE = ("ours_d", "ours_c", "codes_mlp", "displacement_mlp")
HEAD = toy_head()
CODES = HEAD.expression_basis.shape[0] + 3


def source_of(name: str, **changes: object) -> nn.Module:
    torch.manual_seed(0)
    settings = build.settings_of(TrainConfig()) | changes
    return import_module(f"avatar.features.{name}").create(settings, HEAD).source


def condition(count: int = 2, dtype: torch.dtype = torch.float32, time: bool = True, seed: int = 1) -> Condition:
    random = torch.Generator().manual_seed(seed)
    expression = torch.rand(count, CODES - 3, generator=random)
    jaw = torch.rand(count, 3, generator=random) * torch.tensor([0.3, 0.02, 0.02])
    shape = torch.zeros(HEAD.shape_basis.shape[0])
    neutral = HEAD.shaped(shape)
    displacement = HEAD.local(shape, expression, jaw) - neutral
    places = torch.linspace(0.1, 0.9, count) if time else None
    found = Condition(displacement, torch.cat([expression, jaw], 1), neutral, places)
    return Condition(*(value if value is None else value.to(dtype) for value in found))


def root_mean_square(values: Tensor) -> float:
    return float(values.square().mean().sqrt())


@pytest.mark.parametrize("static", [False, True])
@pytest.mark.parametrize("name", SOURCES)
def test_features_of_every_vertex_and_known_terms(name: str, static: bool) -> None:
    source = source_of(name, static_features=static)
    for known in (False, True):
        found = source(condition(3, time=known))
        assert found.values.shape == (3, HEAD.vertex_count, source.channels)
        assert source.channels == 64 + (CODES if name == "codes" else 0)
        assert set(found.terms) == ({"kl"} if known and name == "codes_mlp" else set())
        assert all(term.shape == () and term >= 0 for term in found.terms.values())


@pytest.mark.parametrize("name", SOURCES)
def test_an_avatar_of_every_source_reads_its_channels(name: str) -> None:
    avatar = import_module(f"avatar.features.{name}").create(build.settings_of(TrainConfig(feature_channels=8)), HEAD)
    features = avatar.source(condition()).values
    assert features.shape[-1] == avatar.source.channels == avatar.field.from_feature.in_features
    assert torch.isfinite(avatar.field.vertex_terms(features, torch.bfloat16)).all()


@pytest.mark.parametrize("name", WITH_OPTIONAL_TABLE)
def test_a_table_is_added_where_the_settings_ask(name: str) -> None:
    plain, more = source_of(name, static_features=False), source_of(name, static_features=True)
    assert plain.static is None
    given = condition(time=False)
    torch.testing.assert_close(more(given).values - more.static * STATIC_GAIN, plain(given).values, atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", SOURCES)
def test_features_start_at_a_comparable_scale(name: str) -> None:
    """Of what is learned: codes are appended as they are. The U-Net keeps the size of what it reads and tells frames apart."""
    values = source_of(name, static_features=False)(condition(4)).values[..., :64]
    if name == "ours_d":
        assert 2 * FEATURE_SCALE < root_mean_square(values) < 6 * FEATURE_SCALE
        assert root_mean_square(values - values.mean(0)) > 0.3 * root_mean_square(values)
    else:
        assert 0.5 * FEATURE_SCALE < root_mean_square(values) < 2 * FEATURE_SCALE


@pytest.mark.parametrize("name", SOURCES)
def test_gradients_reach_every_parameter(name: str) -> None:
    source = source_of(name, static_features=True)
    found = source(condition())
    (found.values.square().mean() + sum(found.terms.values())).backward()
    for label, parameter in source.named_parameters():
        assert parameter.grad is not None and torch.isfinite(parameter.grad).all() and parameter.grad.abs().sum() > 0, label


@pytest.mark.parametrize("name", SOURCES)
def test_the_same_seed_gives_the_same_step_to_the_bit(name: str) -> None:
    torch.use_deterministic_algorithms(True)  # an operation without a repeatable version raises
    try:
        runs = []
        for _ in range(2):
            source = source_of(name, static_features=True)
            found = source(condition())
            (found.values.square().mean() + sum(found.terms.values())).backward()
            runs.append([found.values.detach(), *(parameter.grad for parameter in source.parameters())])
    finally:
        torch.use_deterministic_algorithms(False)
    assert all(torch.equal(a, b) for a, b in zip(*runs, strict=True))


@torch.no_grad()
@pytest.mark.parametrize("name", SOURCES)
def test_two_heads_equal_one_by_one(name: str) -> None:
    source, both = source_of(name, static_features=True).eval().double(), condition(2, torch.float64)
    for given in (both, both._replace(time=None)):
        together = source(given).values
        for i in range(2):
            alone = Condition(*(value if value is None or value is given.neutral_m else value[i : i + 1] for value in given))
            torch.testing.assert_close(source(alone).values[0], together[i], rtol=1e-10, atol=1e-12)


@torch.no_grad()
@pytest.mark.parametrize("factor", [0.0, 2.0, 10.0])
@pytest.mark.parametrize("name", SOURCES)
def test_exaggerated_codes_give_finite_features(name: str, factor: float) -> None:
    """Also in training, and for the standard normal codes of FLAME."""
    source, given = source_of(name), condition(3)
    normal = torch.randn(3, CODES, generator=torch.Generator().manual_seed(2))
    for codes in (given.codes, normal):
        for time in (given.time, None):
            changed = given._replace(codes=codes * factor, displacement_m=given.displacement_m * factor, time=time)
            found = source(changed)
            assert torch.isfinite(found.values).all() and found.values.abs().max() < 100
            assert all(torch.isfinite(term) for term in found.terms.values())


@torch.no_grad()
@pytest.mark.parametrize("name", SOURCES)
def test_a_source_reads_its_own_input_and_no_other(name: str) -> None:
    source, given, other = source_of(name).eval(), condition(time=False), condition(time=False, seed=5)
    before = source(given).values
    differs = {
        part: not torch.equal(source(given._replace(**{part: getattr(other, part)})).values, before)
        for part in ("codes", "displacement_m")
    }
    assert differs == {"codes": name in READ_CODES, "displacement_m": name in READ_DISPLACEMENT}
    moved = source(given._replace(neutral_m=given.neutral_m + 0.01)).values
    assert torch.equal(moved, before) == (name not in ("codes_mlp", "displacement_mlp"))


@torch.no_grad()
@pytest.mark.parametrize("name", SOURCES)
def test_eye_pose_is_never_read(name: str) -> None:
    assert not any("eye" in field for field in Condition._fields)
    track, source = toy_track(HEAD, 3), source_of(name).eval()
    looking = track | {"eyes": track["eyes"] + 0.3}
    values = []
    for each in (track, looking):
        scene = Scene(HEAD, each, [0, 1, 2])
        values.append(source(scene.heads([0, 2], "cpu")[1]).values)
    assert torch.equal(*values)


@pytest.mark.parametrize("name", READ_CODES)
def test_codes_of_another_head_model_are_an_error(name: str) -> None:
    avatar = import_module(f"avatar.features.{name}").create(build.settings_of(TrainConfig()), HEAD)
    given = condition()
    with pytest.raises(RuntimeError):
        avatar.field.vertex_terms(avatar.source(given._replace(codes=given.codes[:, :-1])).values, torch.float32)


def test_static_features_and_concatenated_codes_are_what_they_say() -> None:
    given = condition(3)
    source = source_of("static")
    values = source(given).values
    assert all(torch.equal(values[i], source.static * STATIC_GAIN) for i in range(3))
    source = source_of("codes")
    values = source(given).values
    for i in range(3):
        for vertex in (0, 7, HEAD.vertex_count - 1):
            assert torch.equal(values[i, vertex], torch.cat([source.static[vertex] * STATIC_GAIN, given.codes[i]]))


def slow_mlp(network: VertexMLP, row: Tensor) -> Tensor:
    """One vertex, the whole input in one row."""
    row = torch.relu(network.first.weight @ row + network.first.bias)
    for layer in network.hidden.layers:
        row = torch.relu(layer.weight @ row + layer.bias)
    return network.out.weight @ row + network.out.bias


@torch.no_grad()
def test_displacement_mlp_equals_a_loop_over_vertices() -> None:
    source, given = source_of("displacement_mlp").double(), condition(2, torch.float64)
    values = source(given).values
    assert [source.network.first.in_features, len(source.network.hidden.layers)] == [63 + 3, 3]
    for head in range(2):
        for vertex in range(0, HEAD.vertex_count, 9):
            place = positional_encoding(given.neutral_m[vertex] / HEAD_SIZE_M, POSITION_BANDS)
            row = torch.cat([place, given.displacement_m[head, vertex] / DISPLACEMENT_UNIT_M])
            torch.testing.assert_close(values[head, vertex], slow_mlp(source.network, row), rtol=1e-10, atol=1e-12)


@torch.no_grad()
def test_displacement_mlp_has_no_spatial_context_and_ours_d_has() -> None:
    given = condition(1, time=False)
    moved = given.displacement_m.clone()
    moved[0, 50] += 0.01
    for name, context in (("displacement_mlp", False), ("ours_d", True)):
        source = source_of(name)
        changed = (source(given).values != source(given._replace(displacement_m=moved)).values).any(-1)[0]
        assert changed[50] and (changed.sum() > 1) == context


@torch.no_grad()
def test_codes_mlp_equals_a_loop_over_vertices() -> None:
    source, given = source_of("codes_mlp").double().eval(), condition(2, torch.float64)
    values, still = source(given).values, source(given._replace(time=None)).values
    for head in range(2):
        for vertex in range(0, HEAD.vertex_count, 17):
            place = positional_encoding(given.neutral_m[vertex] / HEAD_SIZE_M, POSITION_BANDS)
            time = positional_encoding(given.time[head : head + 1], vae.TIME_BANDS)
            latent = slow_mlp(source.encoder, torch.cat([place, given.codes[head], time]))[: vae.LATENT]
            for found, z in ((values, latent), (still, torch.zeros_like(latent))):  # no time: the prior's mean
                row = torch.cat([place, given.codes[head], z])
                torch.testing.assert_close(found[head, vertex], slow_mlp(source.decoder, row), rtol=1e-10, atol=1e-12)


def test_divergence_equals_torch_distributions() -> None:
    random = torch.Generator().manual_seed(0)
    mean = torch.randn(2, 5, 16, dtype=torch.float64, generator=random).requires_grad_()
    log_variance = torch.randn(2, 5, 16, dtype=torch.float64, generator=random).requires_grad_()
    normal = torch.distributions.Normal
    expected = torch.distributions.kl_divergence(normal(mean, (log_variance / 2).exp()), normal(0.0, 1.0)).sum(-1).mean()
    torch.testing.assert_close(vae.divergence(mean, log_variance), expected, rtol=1e-12, atol=0)
    torch.autograd.gradcheck(vae.divergence, (mean, log_variance))
    assert vae.divergence(torch.zeros(3, 4), torch.zeros(3, 4)) == 0
    source, given = source_of("codes_mlp").double(), condition(2, torch.float64)
    place = positional_encoding(given.neutral_m / HEAD_SIZE_M, POSITION_BANDS)
    torch.testing.assert_close(source(given).terms["kl"], vae.divergence(*source.posterior(given, place)))


@torch.no_grad()
def test_latents_are_drawn_from_the_posterior() -> None:
    source, given = source_of("codes_mlp"), condition(1)
    seen: list[Tensor] = []
    source.decoder.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[2]))
    for _ in range(400):
        source(given)
    drawn = torch.stack(seen)
    mean, log_variance = source.posterior(given, positional_encoding(given.neutral_m / HEAD_SIZE_M, POSITION_BANDS))
    error = (drawn.mean(0) - mean) / (log_variance / 2).exp() * 400**0.5
    assert root_mean_square(error) == pytest.approx(1, abs=0.05)
    assert float((drawn.std(0) / (log_variance / 2).exp()).mean()) == pytest.approx(1, abs=0.02)
    first, second = drawn[0] - mean, drawn[0, :, ::2] - mean[:, ::2]
    assert not torch.equal(drawn[0], drawn[1]) and first.std() > 0.5 and second.std() > 0.5  # vertices draw apart


def test_a_continued_run_draws_what_it_would_have_drawn() -> None:
    """Whatever the global generators do meanwhile: noise follows from a count that is saved with the weights."""
    source, given = source_of("codes_mlp"), condition()
    source(given), source(given)
    other = source_of("codes_mlp")
    other.load_state_dict(source.state_dict())
    torch.manual_seed(99)
    assert torch.equal(source(given).values, other(given).values)
    count = int(source.draws)
    source(given._replace(time=None)), source.eval()(given)
    assert int(source.draws) == count == 3  # looking at test frames changes nothing


def test_posterior_stays_within_its_limit() -> None:
    source, given = source_of("codes_mlp"), condition()
    wild = given._replace(codes=given.codes * 1e4)
    _, log_variance = source.posterior(wild, positional_encoding(wild.neutral_m / HEAD_SIZE_M, POSITION_BANDS))
    assert log_variance.abs().max() <= vae.LOG_VARIANCE_LIMIT


def test_the_split_first_layer_passes_gradients() -> None:
    network = VertexMLP((2, 3, 1), 5, 2, 2).double()
    inputs = [torch.randn(shape, dtype=torch.float64, requires_grad=True) for shape in ((4, 2), (2, 3), (2, 4, 1))]
    torch.autograd.gradcheck(network, inputs)


@pytest.mark.parametrize(("size", "count", "side"), [(64, 4, 4), (128, 5, 4), (256, 6, 4), (512, 7, 4), (192, 5, 6), (320, 6, 5)])
def test_ours_c_grows_from_four_texels_to_the_map(size: int, count: int, side: int) -> None:
    assert doublings(size) == count and size == side * 2**count
    if size > 128:
        return
    source = source_of("ours_c", uv_size=size)
    assert source.start == (256, side, side) and source.first.out_features == 256 * side * side
    assert [block.out_channels for block in source.up] == [128, *[64] * (count - 1)]
    sizes: list[tuple[int, ...]] = []
    source.out.register_forward_hook(lambda _, inputs, output: sizes.append(tuple(output.shape)))
    source(condition())
    assert sizes == [(2, 64, size, size)]
