"""The compiled pass behind `avatar.layered.draw`: fetch, mix and composite every layer of a pixel, in vector instructions.

LLVM does not vectorise such short loops over channels by itself, so a texel is a vector type of its own here, `Lanes`, with
the few operations that are needed, each in LLVM's portable vector instructions. A row is drawn block by block in four stages
(order, coarse map, texture, compositing) without jumps that depend on what was fetched: one stage's latencies overlap.
nerface.mp4, one thread, 8-bit textures, one sample a pixel, ms a frame: plain numba 57, with vectors 28, in stages 19; on a
computer whose other cores are busy 30 in stages, 19.5 with cache lines asked for ahead.

Letters: L layers, R texels a side of a texture, r of a frame's map, K bases, h x w pixels of S samples. All arrays are flat.
All of it is one file because numba's cache of compiled code only notices changes of the caller's file.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.extending import intrinsic, register_model

BLOCK = 64  # pixels of a row that pass each stage together: their items stay in the first cache
ROUND = 4  # layers of a pixel that pass the stages together, before those behind are asked whether light is left
DARK = np.float32(0.0005)  # light below which what lies behind is not looked at: an eighth of a level of 8 bits
HALF, ONE, FULL = np.float32(0.5), np.float32(1), np.float32(255)
FLOAT, FAST = ir.FloatType(), ("fast",)
POWER = tuple(np.polynomial.polynomial.polyfit(np.linspace(0, 1, 2001), 2 ** np.linspace(0, 1, 2001), 3))  # of 2^f, to 1e-4


def padded_fields(bases: int, lead: int) -> int:
    """Numbers a texel of the coarse map takes: a multiple of four."""
    return -(-(lead + 4 + bases) // 4) * 4


@njit(nogil=True, cache=True)
def pad(maps, padded):  # noqa: ANN001, ANN201
    """Copy maps [L, r, r, D] into [L, r, r, D or more]; whether all of them are finite."""
    finite = True
    for layer in range(maps.shape[0]):
        for row in range(maps.shape[1]):
            for column in range(maps.shape[2]):
                for field in range(maps.shape[3]):
                    value = maps[layer, row, column, field]
                    finite &= np.isfinite(value)
                    padded[layer, row, column, field] = value
    return finite


@lru_cache
def compiled(bases: int, lead: int) -> Callable[..., None]:
    """The pass for K bases, and maps that begin with `lead` offsets (2 or 0)."""
    channels, fields = 4 * (1 + bases), padded_fields(bases, lead)

    @njit(nogil=True, fastmath=True, error_model="numpy", cache=True)
    def run(texture, step, low, maps, depth, uv, out, side, coarse, height, width, samples, layers, share, shares):  # noqa: ANN001, ANN202
        plane, most, part = samples * height * width, BLOCK * ROUND, ONE / np.float32(samples)
        keys, order, counts = np.empty(layers, np.float32), np.empty(BLOCK * layers, np.int32), np.empty(BLOCK, np.int32)
        light, colour, mean = np.empty(BLOCK, np.float32), np.empty(4 * BLOCK, np.float32), np.empty(4 * BLOCK, np.float32)
        pixel, layer, place = np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, np.int32)  # of each item
        texel, within, lanes = np.empty(most, np.int64), np.empty(2 * most, np.float32), np.empty(most * fields, np.float32)
        for row in range(share, height, shares):  # every thread gets its share of the head
            for begin in range(0, width, BLOCK):
                number = min(BLOCK, width - begin)
                mean[:] = 0
                for sample in range(samples):
                    first = (samples * row + sample) * width + begin
                    for p in range(number):  # a pixel's layers, nearest first
                        counts[p] = _sort(depth, first + p, plane, layers, order, p * layers, keys)
                        light[p] = ONE
                        _store(colour, 4 * p, _nothing(4))
                    for start in range(0, layers, ROUND):
                        items = 0
                        for p in range(number):
                            if light[p] >= DARK:
                                for rank in range(start, min(start + ROUND, counts[p])):
                                    pixel[items], layer[items] = p, order[p * layers + rank]
                                    place[items] = layer[items] * plane + first + p
                                    _prefetch(uv, 2 * place[items])
                                    items += 1
                        for i in range(items):  # the coarse map, and where to read the texture
                            u, v = uv[2 * place[i]], uv[2 * place[i] + 1]
                            column, line, x, y = _place(u, v, coarse)
                            corner = ((layer[i] * coarse + line) * coarse + column) * fields
                            mix = _bilinear(maps, corner, coarse * fields, x, y, fields)
                            if lead:
                                u, v = u + _lane(mix, 0), v + _lane(mix, 1)
                            column, line, x, y = _place(u, v, side)
                            texel[i] = ((layer[i] * side + line) * side + column) * channels
                            for ahead in (0, 2 * channels - 1):  # both ends: a pair of texels may lie in two cache lines
                                _prefetch(texture, texel[i] + ahead)
                                _prefetch(texture, texel[i] + side * channels + ahead)
                            within[2 * i], within[2 * i + 1] = x, y
                            _store(lanes, i * fields, mix)
                        for i in range(items):  # colour and opacity
                            fetched = _bilinear(texture, texel[i], side * channels, within[2 * i], within[2 * i + 1], channels)
                            unit, zero = _load(step, layer[i] * channels, channels), _load(low, layer[i] * channels, channels)
                            mix = _load(lanes, i * fields, fields)
                            _store(lanes, i * fields, _shown(fetched, unit, zero, mix, bases, lead))
                        for i in range(items):
                            p, shown = pixel[i], _load(lanes, i * fields, 4)
                            weight = light[p] * _lane(shown, 3)
                            _store(colour, 4 * p, _add_scaled(_load(colour, 4 * p, 4), shown, weight))
                            light[p] -= weight
                    for p in range(number):
                        for channel in range(3):
                            mean[4 * p + channel] += part * (colour[4 * p + channel] + light[p])
                        mean[4 * p + 3] += part * (ONE - light[p])
                at = 4 * (row * width + begin)
                for i in range(4 * number):
                    out[at + i] = np.uint8(mean[i] * FULL + HALF)

    return run


@njit
def _sort(depth, at, plane, layers, layer, items, keys):  # noqa: ANN001, ANN202
    """Write the layers seen at a pixel to layer[items:], nearest first; returns their number."""
    count = 0
    for candidate in range(layers):
        near = depth[candidate * plane + at]
        if near > 0:
            i = count
            while i > 0 and keys[i - 1] < near:
                layer[items + i], keys[i] = layer[items + i - 1], keys[i - 1]
                i -= 1
            layer[items + i], keys[i] = candidate, near
            count += 1
    return count


@njit
def _place(u, v, size):  # noqa: ANN001, ANN202
    """Column and row of the upper left of the four texels around a UV, and the place between them; also for a NaN."""
    x, y, most = u * np.float32(size) - HALF, (ONE - v) * np.float32(size) - HALF, np.float32(size - 1)
    x, y = x if x > 0 else np.float32(0), y if y > 0 else np.float32(0)
    x, y = x if x < most else most, y if y < most else most
    column, row = min(np.int32(x), np.int32(size - 2)), min(np.int32(y), np.int32(size - 2))
    return column, row, x - np.float32(column), y - np.float32(row)


class Lanes(types.Type):
    """A vector of `count` float32 in registers."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"Lanes({count})")


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind) -> None:  # noqa: ANN001
        super().__init__(manager, kind, ir.VectorType(FLOAT, kind.count))


def _constant(value: float, count: int) -> ir.Constant:
    return ir.Constant(ir.VectorType(FLOAT, count), [float(np.float32(value))] * count)


def _shuffled(builder, vector, order: list[int]):  # noqa: ANN001, ANN202
    return builder.shuffle_vector(vector, vector, ir.Constant(ir.VectorType(ir.IntType(32), len(order)), order))


def _splat(builder, value, count: int):  # noqa: ANN001, ANN202
    one = builder.insert_element(ir.Constant(ir.VectorType(FLOAT, count), ir.Undefined), value, ir.IntType(32)(0))
    return _shuffled(builder, one, [0] * count)


def _multiply_add(builder, a, b, c):  # noqa: ANN001, ANN202
    return builder.fadd(builder.fmul(a, b, flags=FAST), c, flags=FAST)


def _address(context, builder, kind, array, index):  # noqa: ANN001, ANN202
    return builder.gep(cgutils.create_struct_proxy(kind)(context, builder, array).data, [index], inbounds=True)


def _read(builder, pointer, kind, count: int):  # noqa: ANN001, ANN202
    """`count` numbers of an array of `kind` from a pointer on, as float32."""
    element = FLOAT if kind.dtype == types.float32 else ir.IntType(kind.dtype.bitwidth)
    vector = ir.VectorType(element, count)
    raw = builder.load(builder.bitcast(pointer, vector.as_pointer()), align=kind.dtype.bitwidth // 8)
    if element is FLOAT:
        return raw
    return (builder.sitofp if kind.dtype.signed else builder.uitofp)(raw, ir.VectorType(FLOAT, count))


@intrinsic(prefer_literal=True)
def _load(_, array, start, count):  # noqa: ANN001, ANN202
    def code(context, builder, signature, values):  # noqa: ANN001, ANN202
        pointer = _address(context, builder, signature.args[0], values[0], values[1])
        return _read(builder, pointer, signature.args[0], count.literal_value)

    return Lanes(count.literal_value)(array, types.intp, count), code


@intrinsic
def _store(_, array, start, lanes):  # noqa: ANN001, ANN202
    def code(context, builder, signature, values):  # noqa: ANN001, ANN202
        pointer = _address(context, builder, signature.args[0], values[0], values[1])
        builder.store(values[2], builder.bitcast(pointer, values[2].type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, lanes), code


@intrinsic(prefer_literal=True)
def _bilinear(_, array, start, line, x, y, count):  # noqa: ANN001, ANN202
    """Texels at start, the next, and those `line` numbers later, mixed by x and y."""

    def code(context, builder, signature, values):  # noqa: ANN001, ANN202
        kind, size = signature.args[0], count.literal_value
        upper = _address(context, builder, kind, values[0], values[1])
        lower = builder.gep(upper, [values[2]], inbounds=True)
        right, down = _splat(builder, values[3], size), _splat(builder, values[4], size)
        lines = []
        for pointer in (upper, lower):
            left = _read(builder, pointer, kind, size)
            other = _read(builder, builder.gep(pointer, [ir.IntType(64)(size)], inbounds=True), kind, size)
            lines.append(_multiply_add(builder, right, builder.fsub(other, left, flags=FAST), left))
        return _multiply_add(builder, down, builder.fsub(lines[1], lines[0], flags=FAST), lines[0])

    return Lanes(count.literal_value)(array, types.intp, types.intp, types.float32, types.float32, count), code


@intrinsic(prefer_literal=True)
def _shown(_, texels, step, low, mix, bases, lead):  # noqa: ANN001, ANN202
    """sigmoid(static + direct + sum_k weight_k basis_k): red, green, blue, opacity."""

    def code(context, builder, signature, values):  # noqa: ANN001, ANN202
        logits, first = _multiply_add(builder, values[0], values[1], values[2]), lead.literal_value
        direct = _shuffled(builder, values[3], list(range(first, first + 4)))
        total = builder.fadd(_shuffled(builder, logits, [0, 1, 2, 3]), direct, flags=FAST)
        for base in range(bases.literal_value):
            weight = _shuffled(builder, values[3], [first + 4 + base] * 4)
            total = _multiply_add(builder, weight, _shuffled(builder, logits, list(range(4 + 4 * base, 8 + 4 * base))), total)
        return _sigmoid(builder, total, 4)

    return Lanes(4)(texels, step, low, mix, bases, lead), code


def _sigmoid(builder, logits, count: int):  # noqa: ANN001, ANN202
    """1 / (1 + 2^y) with y = -x / log 2: the whole part of y makes the exponent, a cubic the rest; within 1e-4."""
    vector, whole = ir.VectorType(FLOAT, count), ir.VectorType(ir.IntType(32), count)
    y = builder.fmul(logits, _constant(-1 / np.log(2), count), flags=FAST)
    for limit, test in ((-30, "<"), (30, ">")):  # of a NaN too: any number will do
        bound = _constant(limit, count)
        y = builder.select(builder.fcmp_unordered(test, y, bound), bound, y)
    floor = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector]), f"llvm.floor.v{count}f32")
    below = builder.call(floor, [y])
    rest, power = builder.fsub(y, below, flags=FAST), _constant(POWER[-1], count)
    for coefficient in POWER[-2::-1]:
        power = _multiply_add(builder, power, rest, _constant(coefficient, count))
    exponent = builder.add(builder.fptosi(below, whole), ir.Constant(whole, [127] * count))
    scale = builder.bitcast(builder.shl(exponent, ir.Constant(whole, [23] * count)), vector)
    return builder.fdiv(_constant(1, count), _multiply_add(builder, scale, power, _constant(1, count)), flags=FAST)


@intrinsic
def _add_scaled(_, total, lanes, factor):  # noqa: ANN001, ANN202
    def code(context, builder, signature, values):  # noqa: ANN001, ANN202
        return _multiply_add(builder, values[1], _splat(builder, values[2], signature.args[0].count), values[0])

    return total(total, lanes, types.float32), code


@intrinsic(prefer_literal=True)
def _nothing(_, count):  # noqa: ANN001, ANN202
    return Lanes(count.literal_value)(count), lambda *_: _constant(0, count.literal_value)


@intrinsic(prefer_literal=True)
def _lane(_, lanes, which):  # noqa: ANN001, ANN202
    def code(context, builder, signature, values):  # noqa: ANN001, ANN202
        return builder.extract_element(values[0], ir.IntType(32)(which.literal_value))

    return types.float32(lanes, which), code


@intrinsic
def _prefetch(_, array, start):  # noqa: ANN001, ANN202
    """Ask for a texel's cache line before it is needed."""

    def code(context, builder, signature, values):  # noqa: ANN001, ANN202
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        pointer = builder.bitcast(_address(context, builder, signature.args[0], values[0], values[1]), byte)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.none(array, types.intp), code
