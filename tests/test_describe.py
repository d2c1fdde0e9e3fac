"""What is said about an avatar against sizes worked out by hand and the paper's."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn
from toy_head import toy_head

from avatar import build
from avatar.config import TrainConfig
from avatar.describe import Row, counted, describe, layers_of, main, scaled
from avatar.field import Field
from avatar.networks import UNET_LEVELS

HEAD = toy_head()
SOURCES = ("ours_d", "ours_c", "codes_mlp", "codes", "static", "displacement_mlp")


def settings_of(name: str, **changes: object) -> dict:
    return build.settings_of(TrainConfig()) | {"representation": name} | changes


def rows_of(name: str, **changes: object) -> dict[str, Row]:
    return {row.name: row for row in layers_of(build.build(settings_of(name, **changes), HEAD), HEAD)}


def test_a_sample_costs_what_the_papers_sizes_say() -> None:
    rows = rows_of("ours_d").values()
    assert sum(row.flop_test for row in rows if row.unit == "sample") / 1e6 == pytest.approx(0.51, abs=0.01)
    text = describe(settings_of("ours_d"), HEAD, "paper")
    assert text.startswith("paper: ours_d on toy") and "a sample: 512 kFLOP" in text
    for block in ("source", "MLP0", "weighted sum", "MLP1", "density", "colour MLP"):
        assert f"\n{block}: " in text
    assert "\nwarp" not in text


def test_field_layers_by_hand() -> None:
    rows = rows_of("ours_d")
    expected = {"from_offset": 4 * 63 * 128, "from_feature": 4 * 64 * 128, "mlp0.layers.1": 4 * 128**2, "": 4 * 128}
    expected |= {"mlp1.layers.0": 128**2, "density": 128, "mlp2.layers.0": 155 * 64, "colour": 64 * 3}
    assert {name: rows[name].flop_test for name in expected} == {name: 2 * products for name, products in expected.items()}


def test_unet_has_the_papers_channels_and_operations_by_hand() -> None:
    rows = rows_of("ours_d", uv_size=256)
    down = [rows[f"unet.down.{i}.second"].shape for i in range(6)]
    up = [rows[f"unet.up.{i}"].shape for i in range(6)]
    assert [int(shape.split()[0]) for shape in down] == list(UNET_LEVELS) == [8, 16, 32, 64, 128, 256]
    assert [int(shape.split()[2].strip(",")) for shape in up] == [128, 64, 64, 64, 64, 64]
    assert rows["unet.up.0"].shape == "256 -> 128, transposed 4 x 4 / 2"
    assert rows["unet.down.0.first"].flop_test == 2 * 128**2 * 3 * 8 * 9
    assert rows["unet.merge.5.first"].flop_test == 2 * 256**2 * 64 * 64 * 9
    assert rows["unet.up.5"].flop_test == 2 * 128**2 * 64 * 64 * 16  # each texel that is read writes 4 x 4
    assert rows["unet.out"].flop_test == 2 * 256**2 * 64 * 64


def test_layers_of_the_other_sources_by_hand() -> None:
    vertices, codes = HEAD.vertex_count, HEAD.expression_basis.shape[0] + 3
    rows = rows_of("displacement_mlp")
    assert rows["network.first"].flop_test == 2 * vertices * (63 + 3) * 256 and rows["network.first"].shape == "66 -> 256"
    rows = rows_of("codes_mlp")
    at_test, by_latent = 2 * 256 * (vertices * 63 + codes), 2 * 256 * vertices * 16
    assert (rows["decoder.first"].flop_test, rows["decoder.first"].flop_training) == (at_test, at_test + by_latent)
    assert rows["encoder.out"].flop_test == 0 and rows["encoder.out"].flop_training == 2 * vertices * 128 * 32
    rows = rows_of("codes")
    assert rows["static"].shape == f"{vertices} x 64" and rows["from_feature"].shape == f"{64 + codes} -> 128"
    assert rows_of("ours_c")["first"].flop_test == 2 * codes * 4096


@pytest.mark.parametrize("name", SOURCES)
def test_every_parameter_stands_in_one_row(name: str) -> None:
    avatar = build.build(settings_of(name, static_features=True), HEAD)
    avatar.correct_errors(7)
    rows = layers_of(avatar, HEAD)
    assert sum(row.parameters for row in rows) == sum(value.numel() for value in avatar.parameters())
    assert len({(row.block, row.name) for row in rows}) == len(rows)
    text = describe(settings_of(name, static_features=True), HEAD, "v")
    assert text.count(", in training only") == (3 if name == "codes_mlp" else 0)


def test_the_warp_runs_in_training_only() -> None:
    text = describe(settings_of("ours_d"), HEAD, "v", warp_frames=7)
    assert "\nwarp: " in text and "7 x 64" in text and "0 FLOP a sample, 284 kFLOP in training" in text


def test_coarse_and_fine_are_mentioned() -> None:
    text = describe(settings_of("ours_d", sampling="hierarchical"), HEAD, "v")
    single = describe(settings_of("ours_d"), HEAD, "v")
    assert "a coarse and a fine network" in text and "coarse" not in single


def test_counting_attributes_products_to_layers() -> None:
    network = nn.Sequential(nn.Linear(3, 5), nn.ReLU(), nn.Conv1d(5, 2, 1)).double()
    rows = torch.zeros(7, 3, dtype=torch.float64)
    assert counted(network[0], rows) == {"weight": 2 * 7 * 3 * 5}
    assert counted(network[2], torch.zeros(1, 5, 9, dtype=torch.float64)) == {"weight": 2 * 9 * 5 * 2}
    assert counted(network[1], rows) == {}


def test_prefixes() -> None:
    assert [scaled(value) for value in (0, 256, 1024, 512_000, 1.7e10)] == [
        "0 FLOP",
        "256 FLOP",
        "1.02 kFLOP",
        "512 kFLOP",
        "17 GFLOP",
    ]


def test_a_field_of_other_sizes_is_counted_as_it_is() -> None:
    torch.manual_seed(0)
    small = Field(channels=6, width=16, depth=2, colour_width=8, neighbours=3, bands=2, view_bands=1)
    avatar = build.build(settings_of("static"), HEAD)
    avatar.field = small
    rows = {row.name: row for row in layers_of(avatar, HEAD)}
    assert rows["from_feature"].flop_test == 2 * 3 * 6 * 16 and rows["mlp0.layers.0"].flop_test == 2 * 3 * 16 * 16
    assert rows[""].flop_test == 2 * 3 * 16


def test_the_command_line_describes_presets_and_refuses_what_it_does_not_know(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    HEAD.save(tmp_path / "head.npz")
    for name in ("demo", "paper"):
        main(["--describe", name, "--head", str(tmp_path / "head.npz")])
        text = capsys.readouterr().out
        assert text.startswith(f"{name}: ours_d on toy") and ("\nwarp: " in text) == (name == "paper")
    assert "512 kFLOP" in text and "a coarse and a fine network" in text
    with pytest.raises(SystemExit, match="there is no preset 'papers'"):
        main(["--describe", "papers", "--head", str(tmp_path / "head.npz")])
    with pytest.raises(SystemExit, match="there is no head model"):
        main(["--describe", "demo", "--head", str(tmp_path / "none.npz")])


def test_a_layered_avatar() -> None:
    avatar = build.build(settings_of("layers", layers=4, bases=1, texture_size=32), HEAD)
    rows = {row.name: row for row in layers_of(avatar, HEAD)}
    assert rows["out"].flop_test == 2 * 64 * 4 * (2 + 4 + 1) * 64 * 64 and rows["out"].unit == "frame"
    assert rows[""].parameters == 4 * 32 * 32 * 8 and "textures" in describe(settings_of("layers"), HEAD, "layers")
