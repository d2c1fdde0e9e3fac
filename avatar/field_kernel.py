"""The field on a CPU: blocks of samples that stay in the cache, matrix products by PyTorch, the rest in compiled loops.

The same function as `Field.plainly`, its twin in the tests, with one restriction: samples and vertices are constants, so that
encodings and weights have no gradient. Of a training step by `plainly` (nerface.mp4, 1024 rays, 12,000 samples, one core) 0.24 s
were the field's and 0.05 of these its products; what took the time were copies between types, ReLUs and their gradients as
passes over memory, and fresh pages for each result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from avatar import field_loops

if TYPE_CHECKING:
    from avatar.field import Field

BLOCK = 1024  # samples at a time: a layer of 128 units on four neighbours is 1 MB in bfloat16
# The last block is padded to a multiple: oneDNN keeps a compiled product for each of the last 1024 shapes, and no two steps of
# training have as many samples (nerface.mp4, whole steps: 2.5 GB after 160 steps and 7.7 after 6,000, growing).
ROWS = 128
COLUMNS = 32  # inputs of a product are padded to a multiple: the matrix unit's tiles
FUSED = hasattr(torch.ops.mkldnn, "_linear_pointwise")


class Layers(NamedTuple):
    """The networks' weights in the products' type, inputs padded to COLUMNS."""

    offset: Tensor  # [W, E]
    mlp0: list[tuple[Tensor, Tensor]]
    mlp1: list[tuple[Tensor, Tensor]]
    mlp2: tuple[Tensor, Tensor]  # [C, J], [C]
    heads: tuple[np.ndarray, float, np.ndarray, np.ndarray]  # density [W], its bias, colour [3, C], its biases


class Block(NamedTuple):
    """What the backward pass reads again of n samples; rows beyond them are padding."""

    first: int
    count: int
    index: np.ndarray  # [n, K]
    weights: np.ndarray  # [n, K]
    encoded: Tensor
    hidden: list[Tensor]  # of MLP0, its first layer included
    mixed: Tensor
    shared: list[Tensor]  # of MLP1
    joined: Tensor
    shade: Tensor


def fits(field: Field, points_m: Tensor, directions: Tensor, vertices_m: Tensor, terms: Tensor) -> bool:
    """Whether `evaluate` may be used: on CPU, with constant samples and vertices, and nothing that is not finite.

    oneDNN's fused ReLU makes 0 of NaN, which must show.
    """
    constant = not torch.is_grad_enabled() or not (points_m.requires_grad or vertices_m.requires_grad)
    if points_m.device.type != "cpu" or not constant:
        return False
    with torch.no_grad():
        read = (points_m, directions, vertices_m, terms, *field.parameters())
        return all(bool(torch.isfinite(values.sum())) for values in read)


def parameters_of(field: Field) -> list[Tensor]:
    """Weights and biases in the order of `Backward.sums`."""
    layers = [field.density, field.colour, *field.mlp2.layers, *reversed(field.mlp1.layers), *reversed(field.mlp0.layers)]
    return [tensor for layer in layers for tensor in (layer.weight, layer.bias)] + [field.from_offset.weight]


def evaluate(
    field: Field, points_m: Tensor, directions: Tensor, vertices_m: Tensor, index: Tensor, terms: Tensor, precision: torch.dtype
) -> tuple[Tensor, Tensor]:
    """Density [P] per optical depth of 1 and colour [P, 3]; arguments as of `Field.forward`."""
    parameters = parameters_of(field)
    tracked = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (terms, *parameters))
    constants = Constants(field, points_m.detach(), directions.detach(), vertices_m.detach(), index, precision)
    if tracked:
        return Evaluation.apply(constants, terms, *parameters)
    return constants.forward(terms, keep=False)[:2]


@cache
def pool(threads: int) -> ThreadPoolExecutor:
    """Threads that each take a block, their products on one thread."""
    return ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,))


def each(work: Callable, items: Iterable) -> list:
    """Results of `work` on all items in their order, on as many threads as PyTorch has."""
    items, threads = list(items), torch.get_num_threads()
    return list(map(work, items)) if threads == 1 or len(items) == 1 else list(pool(threads).map(work, items))


def active(layer: tuple[Tensor, Tensor], rows: Tensor) -> Tensor:
    """ReLU of a layer on rows [P, C]."""
    if FUSED and rows.dtype in (torch.bfloat16, torch.float32):
        return torch.ops.mkldnn._linear_pointwise(rows, *layer, "relu", [], "")
    return torch.relu_(functional.linear(rows, *layer))


def product(one: Tensor, other: Tensor) -> Tensor:
    """Matrix product [A, B] of [A, C] and [C, B]."""
    return one @ other


def stored(tensor: Tensor) -> np.ndarray:
    """The same memory for `field_loops`."""
    return (tensor.view(torch.uint16) if tensor.dtype == torch.bfloat16 else tensor).numpy()


def wider(matrix: Tensor, columns: int) -> Tensor:
    """matrix [A, B] with zeros up to `columns`."""
    return functional.pad(matrix, (0, columns - matrix.shape[1]))


def rounded(count: int, multiple: int) -> int:
    """count, raised to a multiple."""
    return -(-count // multiple) * multiple


class Constants:
    """What a call of the field holds constant: samples, vertices, neighbours."""

    def __init__(
        self, field: Field, points_m: Tensor, directions: Tensor, vertices_m: Tensor, index: Tensor, precision: torch.dtype
    ) -> None:
        """Arguments as of `Field.forward`."""
        self.precision, self.bands, self.view_bands = precision, field.bands, field.view_bands
        self.points, self.directions = points_m.contiguous().numpy(), directions.contiguous().numpy()
        self.vertices, self.index = vertices_m.contiguous().numpy(), index.contiguous().numpy()
        self.units = field.units
        self.depth = len(field.mlp0.layers), len(field.mlp1.layers)
        self.width = field.from_offset.out_features
        self.encoded, self.joined = rounded(field.encoded, COLUMNS), rounded(field.mlp2.layers[0].in_features, COLUMNS)
        self.layers = self._layers(field)

    @torch.no_grad()
    def _layers(self, field: Field) -> Layers:
        def of(layer: nn.Linear, columns: int = 0) -> tuple[Tensor, Tensor]:
            return wider(layer.weight, columns or layer.in_features).to(self.precision), layer.bias.to(self.precision)

        heads = [
            t.detach().to(torch.from_numpy(self.points).dtype).numpy()
            for t in (*field.density.parameters(), *field.colour.parameters())
        ]
        return Layers(
            wider(field.from_offset.weight, self.encoded).to(self.precision),
            [of(layer) for layer in field.mlp0.layers],
            [of(layer) for layer in field.mlp1.layers],
            of(field.mlp2.layers[0], self.joined),
            (heads[0][0], heads[1][0], heads[2], heads[3]),
        )

    def room(self, rows: int, columns: int, used: int) -> Tensor:
        """An empty matrix [rows, columns], zero below its `used` first rows."""
        matrix = torch.empty(rows, columns, dtype=self.precision)
        matrix[used:] = 0
        return matrix

    @torch.no_grad()
    def forward(self, terms: Tensor, keep: bool) -> tuple[Tensor, Tensor, list[Block]]:
        """Density [P], colour [P, 3], and what the backward pass needs if it is to be kept."""
        density = np.empty(len(self.points), self.points.dtype)
        colour = np.empty((len(self.points), 3), self.points.dtype)
        terms = stored(terms.detach().to(self.precision).contiguous())

        def work(first: int) -> Block | None:
            block = self._block(first, terms)
            places = slice(first, first + block.count)
            heads = self.layers.heads
            field_loops.outputs(stored(block.shared[-1]), stored(block.shade), *heads, density[places], colour[places])
            return block if keep else None

        blocks = each(work, range(0, len(self.points), BLOCK))
        return torch.from_numpy(density), torch.from_numpy(colour), blocks

    @torch.no_grad()  # which is a thread's own
    def _block(self, first: int, terms: np.ndarray) -> Block:
        points, index = self.points[first : first + BLOCK], self.index[first : first + BLOCK]
        count, neighbours = index.shape
        padded = rounded(count, ROWS)
        encoded = self.room(padded * neighbours, self.encoded, count * neighbours)
        weights = np.empty((count, neighbours), points.dtype)
        field_loops.encode_offsets(points, self.vertices, index, self.bands, *self.units, stored(encoded), weights)
        hidden = [product(encoded, self.layers.offset.t())]
        field_loops.add_terms(stored(hidden[0]), terms, index)
        for layer in self.layers.mlp0:
            hidden.append(active(layer, hidden[-1]))
        mixed = self.room(padded, self.width, count)
        field_loops.mix(stored(hidden[-1]), weights, stored(mixed))
        shared = [mixed]
        for layer in self.layers.mlp1:
            shared.append(active(layer, shared[-1]))
        joined = self.room(padded, self.joined, count)
        along = self.directions[first : first + BLOCK]
        field_loops.join_views(stored(shared[-1]), along, self.view_bands, count, stored(joined))
        shade = active(self.layers.mlp2, joined)
        return Block(first, count, index, weights, encoded, hidden, mixed, shared[1:], joined, shade)


class Evaluation(torch.autograd.Function):
    """`Constants.forward` with the gradients of terms and weights by hand."""

    @staticmethod
    def forward(context, constants: Constants, terms: Tensor, *parameters: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ANN001
        """terms: [V, W]; parameters: as of `parameters_of`, read through `constants`."""
        density, colour, blocks = constants.forward(terms, keep=True)
        context.constants, context.blocks, context.shapes = constants, blocks, [p.shape for p in parameters]
        context.vertices = len(terms)
        context.save_for_backward(density, colour)
        return density, colour

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(context, along_density: Tensor, along_colour: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN001
        """None for the constants, then gradients of terms and parameters."""
        density, colour = (tensor.numpy() for tensor in context.saved_tensors)
        along = along_density.contiguous().numpy(), along_colour.contiguous().numpy()
        constants = context.constants
        terms = np.zeros((context.vertices, constants.width), density.dtype)
        total = [torch.zeros(shape, dtype=torch.from_numpy(density).dtype) for shape in context.shapes]

        def work(block: Block) -> tuple[list[Tensor], Tensor]:
            places = slice(block.first, block.first + block.count)
            return block_back(constants, block, density[places], colour[places], along[0][places], along[1][places])

        for start in range(0, len(context.blocks), torch.get_num_threads()):  # few gradients at a time
            some = context.blocks[start : start + torch.get_num_threads()]
            for block, (sums, into) in zip(some, each(work, some), strict=True):
                field_loops.add_terms_back(stored(into), stored(block.hidden[0]), block.index, terms)
                sums.append(product(into.t(), block.encoded))
                for whole, part in zip(total, sums, strict=True):
                    whole += part[:, : whole.shape[1]] if part.dim() == 2 else part
        return None, torch.from_numpy(terms), *total


@torch.no_grad()
def block_back(
    constants: Constants,
    block: Block,
    density: np.ndarray,
    colour: np.ndarray,
    along_density: np.ndarray,
    along_colour: np.ndarray,
) -> tuple[list[Tensor], Tensor]:
    """Gradients of a block's parameters in the order of `parameters_of` but for the last, and of the first layer's sum."""
    layers, count, kind = constants.layers, block.count, density.dtype
    room, rows, neighbours = constants.room, len(block.mixed), block.index.shape[1]
    slope, slopes, width = np.empty(count, kind), np.empty((count, 3), kind), constants.width
    into, last = room(rows, block.shade.shape[1], count), block.shared[-1]
    by_density, _, by_colour, _ = layers.heads
    field_loops.outputs_back(
        density, colour, along_density, along_colour, stored(block.shade), by_colour, slope, slopes, stored(into)
    )
    by_unit, by_units = torch.from_numpy(slope), torch.from_numpy(slopes)
    exact = by_unit.dtype
    sums = [(by_unit @ last[:count].to(exact))[None], by_unit.sum()[None]]
    sums += [by_units.t() @ block.shade[:count].to(exact), by_units.sum(0), product(into.t(), block.joined), into.sum(0)]
    joined, into = product(into, layers.mlp2[0]), room(rows, width, count)
    field_loops.join_back(stored(joined), slope, by_density, stored(last), stored(into))
    before = [block.mixed, *block.shared[:-1]]
    for layer in range(len(layers.mlp1) - 1, -1, -1):
        sums += [product(into.t(), before[layer]), into.sum(0)]
        into = product(into, layers.mlp1[layer][0])
        if layer:
            field_loops.relu_back(stored(into), stored(before[layer]), count)
    mixed, into = into, room(rows * neighbours, width, count * neighbours)
    field_loops.mix_back(stored(mixed), block.weights, stored(block.hidden[-1]), stored(into))
    for layer in range(len(layers.mlp0) - 1, -1, -1):
        sums += [product(into.t(), block.hidden[layer]), into.sum(0)]
        into = product(into, layers.mlp0[layer][0])
        if layer:
            field_loops.relu_back(stored(into), stored(block.hidden[layer]), count * neighbours)
    return sums, into
