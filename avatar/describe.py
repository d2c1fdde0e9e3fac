"""What an avatar is made of: each block's layers, parameters and operations, counted while the built modules run.

FLOP are two per multiply-accumulate of matrix products and convolutions. Encodings, activations, the interpolation between UV
and vertices, the search for neighbours and compositing are left out, as in the paper's and others' figures.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from avatar.build import build, settings_of
from avatar.config import RenderConfig, TrainConfig
from avatar.features import Condition
from avatar.features.shared import code_count
from avatar.field import ROWS, Field
from avatar.layered.model import SAMPLES
from avatar.settings import Settings, VariantConfig
from fitting.head_model import HeadModel
from workflow.settings import SettingsError, resolve_variants, validated

ROOT = Path(__file__).parents[1]
PAPER_FRAMES = 1500  # training frames that a described warp has latents for: the paper trains on 1000 to 1500
LAYERS = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)
WEIGHTED_SUM = "weighted sum"
# Blocks of the field by the first part of a parameter's name.
FIELD_BLOCKS = {
    "from_offset": "MLP0",
    "from_feature": "MLP0",
    "mlp0": "MLP0",
    WEIGHTED_SUM: WEIGHTED_SUM,
    "mlp1": "MLP1",
    "density": "density",
    "mlp2": "colour MLP",
    "colour": "colour MLP",
}
BLOCKS = ("source", *dict.fromkeys(FIELD_BLOCKS.values()), "warp", "textures")


class Row(NamedTuple):
    """One layer, or one learned array that is no layer's."""

    block: str
    name: str
    shape: str  # channels in -> out of a layer, extents of an array
    parameters: int
    flop_training: float  # per unit
    flop_test: float  # per unit
    unit: str  # "frame" or "sample"


class LayerCounter(TorchDispatchMode):
    """Counts FLOP of what runs inside, by the parameter whose memory a product reads; others count as `WEIGHTED_SUM`."""

    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.name = {value.untyped_storage().data_ptr(): name for name, value in module.named_parameters()}
        self.flop: dict[str, int] = defaultdict(int)

    def __torch_dispatch__(self, function: Any, types: Any, arguments: tuple = (), keywords: dict | None = None) -> Any:
        """Run the operation and count it."""
        result = function(*arguments, **keywords or {})
        if (formula := flop_registry.get(function.overloadpacket)) is not None:
            tensors = [value for value in arguments if isinstance(value, Tensor) and value.ndim > 1]  # not biases
            names = [self.name[p] for p in (t.untyped_storage().data_ptr() for t in tensors) if p in self.name]
            self.flop[names[0] if names else WEIGHTED_SUM] += formula(*arguments, **keywords or {}, out_val=result)
        return result


def counted(module: nn.Module, *arguments: Any, call: Callable[..., Any] | None = None) -> dict[str, int]:
    """FLOP of one call of a module, or of a method of its, by the name of its parameters, without gradients."""
    with torch.no_grad(), LayerCounter(module) as counter:
        (call or module)(*arguments)
    return counter.flop


def shape_of(layer: nn.Module) -> str:
    """Channels in and out, and kernel and stride of a convolution."""
    if isinstance(layer, nn.Linear):
        return f"{layer.in_features} -> {layer.out_features}"
    kind = "transposed " if isinstance(layer, nn.ConvTranspose2d) else ""
    stride = f" / {layer.stride[0]}" if layer.stride[0] > 1 else ""
    return f"{layer.in_channels} -> {layer.out_channels}, {kind}{layer.kernel_size[0]} x {layer.kernel_size[1]}{stride}"


def rows_of(module: nn.Module, block: str, training: dict[str, float], test: dict[str, float], unit: str) -> Iterable[Row]:
    """A row a layer, and one for each parameter that is no layer's."""
    inside = set()
    for name, layer in module.named_modules():
        if isinstance(layer, LAYERS):
            weight = f"{name}.weight"
            inside |= {f"{name}.{part}" for part, _ in layer.named_parameters()}
            size = sum(value.numel() for value in layer.parameters())
            yield Row(block, name, shape_of(layer), size, training.get(weight, 0), test.get(weight, 0), unit)
    for name, value in module.named_parameters():
        if name not in inside:
            shape = " x ".join(str(extent) for extent in value.shape)
            yield Row(block, name, shape, value.numel(), training.get(name, 0), test.get(name, 0), unit)


def source_rows(source: nn.Module, head: HeadModel) -> list[Row]:
    """The source of the features, for one head."""
    weight = next(source.parameters())
    displacement, codes = weight.new_zeros(1, head.vertex_count, 3), weight.new_zeros(1, code_count(head))
    condition = Condition(displacement, codes, head.template.to(weight), weight.new_zeros(1))
    return list(rows_of(source, "source", counted(source, condition), counted(source, condition._replace(time=None)), "frame"))


def field_rows(field: Field) -> list[Row]:
    """One network of the field at one sample, MLP0 as the paper writes it: its first layer on every neighbour.

    Here the part of it that reads the feature runs once a vertex and frame, which is the same sum (`Field.vertex_terms`).
    """
    weight, width = field.from_feature.weight, field.from_feature.out_features
    points, vertices = weight.new_zeros(ROWS, 3), weight.new_zeros(field.neighbours, 3)  # the field pads fewer
    index = torch.arange(field.neighbours, device=weight.device).expand(ROWS, -1)
    terms = weight.new_zeros(field.neighbours, width)
    total = counted(field, points, points, vertices, index, terms, weight.dtype, call=field.plainly)
    flop = {name: value // ROWS for name, value in total.items()}
    flop["from_feature.weight"] = 2 * field.neighbours * weight.numel()
    rows = [row._replace(block=FIELD_BLOCKS[row.name.split(".")[0]]) for row in rows_of(field, "", flop, flop, "sample")]
    mixed = Row(WEIGHTED_SUM, "", f"{field.neighbours} x {width} -> {width}", 0, flop[WEIGHTED_SUM], flop[WEIGHTED_SUM], "sample")
    return sorted([*rows, mixed], key=lambda row: BLOCKS.index(row.block))


def warp_rows(warp: nn.Module) -> list[Row]:
    """The error-correction warp at one sample of a training ray, without its Jacobian."""
    weight = next(warp.parameters())
    frame = torch.zeros(1, dtype=torch.int64, device=weight.device)
    return list(rows_of(warp, "warp", counted(warp, weight.new_zeros(1, 3), frame, float(warp.bands)), {}, "sample"))


def layered_rows(avatar: nn.Module) -> list[Row]:
    """The network of a layered avatar for one frame, and its textures, which are looked up and not multiplied."""
    weight = avatar.out.weight
    told = weight.new_zeros(1, next(avatar.unet.parameters()).shape[1], *avatar.skin_corners.shape[:2])
    network = nn.Sequential(avatar.unet, avatar.out)
    flop = counted(network, told)
    rows = rows_of(network, "source", flop, flop, "frame")
    names = {"0": "unet", "1": "out"}
    rows = [row._replace(name=".".join([names[row.name.split(".")[0]], *row.name.split(".")[1:]])) for row in rows]
    fading, textures = (" x ".join(str(extent) for extent in part.shape) for part in (avatar.fading, avatar.textures))
    rows.append(Row("source", "fading", fading, avatar.fading.numel(), 0, 0, "frame"))
    return [*rows, Row("textures", "", textures, avatar.textures.numel(), 0, 0, "frame")]


def layers_of(avatar: nn.Module, head: HeadModel) -> list[Row]:
    """Every layer of an avatar, block by block; a coarse network, which equals the fine one in size, is left out."""
    if not hasattr(avatar, "field"):
        return layered_rows(avatar)
    warp = getattr(avatar, "warp", None)
    return source_rows(avatar.source, head) + field_rows(avatar.field) + ([] if warp is None else warp_rows(warp))


def scaled(flop: float) -> str:
    """A number of operations with a prefix."""
    for size, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if flop >= size:
            return f"{flop / size:.3g} {prefix}FLOP"
    return f"{flop:.0f} FLOP"


def note_of(row: Row) -> str:
    """What a row costs, in words."""
    if not row.flop_training:
        return ""
    return f"{scaled(row.flop_training)} a {row.unit}" + ("" if row.flop_test else ", in training only")


def describe(settings: dict[str, Any], head: HeadModel, name: str, warp_frames: int = 0) -> str:
    """The avatar that the settings make, as text.

    settings: as in `avatar.build`; name: of the preset or variant, for the first line; warp_frames: training frames of the
    error-correction warp, 0 for none.
    """
    avatar = build(settings, head)
    if warp_frames:
        avatar.correct_errors(warp_frames)
    rows, coarse = layers_of(avatar, head), getattr(avatar, "coarse", None)
    total = sum(value.numel() for value in avatar.parameters())
    lines = [f"{name}: {settings['representation']} on {head.name}, {head.vertex_count} vertices, {total:,} parameters"]
    for block in BLOCKS:
        chosen = [row for row in rows if row.block == block]
        if not chosen:
            continue
        training, test = (sum(row[at] for row in chosen) for at in (4, 5))
        extra = f", {scaled(training)} in training" if training != test else ""
        parameters = sum(row.parameters for row in chosen)
        lines += ["", f"{block}: {parameters:,} parameters, {scaled(test)} a {chosen[0].unit}{extra}"]
        lines += [f"  {row.name:<28}{row.shape:<34}{row.parameters:>10,}  {note_of(row)}".rstrip() for row in chosen]
    if not hasattr(avatar, "field"):
        return (
            "\n".join([*lines, "", f"each of a pixel's {SAMPLES} samples: a texel of each layer until the light is gone"]) + "\n"
        )
    sample = sum(row.flop_test for row in rows if row.unit == "sample")
    vertex = 2 * avatar.field.from_feature.weight.numel() * head.vertex_count
    saved = sum(row.flop_test for row in rows if row.name == "from_feature")
    lines += ["", f"a sample: {scaled(sample)} with MLP0's first layer on every neighbour, as the paper writes it"]
    lines += [f"here: {scaled(sample - saved)} a sample and {scaled(vertex)} a frame, the part that reads features once a vertex"]
    if coarse is not None:
        lines += ["the field exists twice: a coarse and a fine network of these sizes on one source"]
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> None:
    """Command line of `python -m avatar.build`: describe a preset, or a variant of config/config.yaml."""
    parser = argparse.ArgumentParser(prog="python -m avatar.build", description=main.__doc__)
    parser.add_argument("--describe", required=True, metavar="VARIANT", help="name of a preset or of a variant in the config")
    parser.add_argument("--head", type=Path, default=Path("resources/heads/anny.npz"), help="a baked head model")
    chosen = parser.parse_args(arguments)
    try:
        if not chosen.head.is_file():
            raise ValueError(f"{chosen.head}: there is no head model; `snakemake resources/heads/anny.npz` bakes one")
        origin = ROOT / "config" / "config.yaml"
        variants = validated(Settings, yaml.safe_load(origin.read_text(encoding="utf-8")), str(origin)).variants
        variant = variants.get(chosen.describe, VariantConfig(preset=chosen.describe))
        models = {"train": TrainConfig, "render": RenderConfig}
        config = resolve_variants({chosen.describe: variant}, ROOT / "config" / "presets", models, str(origin))[chosen.describe][
            "train"
        ]
        text = describe(settings_of(config), HeadModel.load(chosen.head), chosen.describe, PAPER_FRAMES if config.warp else 0)
    except (ValueError, SettingsError) as mistake:
        raise SystemExit(str(mistake)) from None
    sys.stdout.write(text)
