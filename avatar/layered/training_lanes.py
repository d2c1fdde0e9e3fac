"""Vector operations of `avatar.layered.training_pass`, beside those of `avatar.layered.compiled`: right to float32, NaN is kept.

Numba's cache of compiled code only notices changes of the file of the loop that calls these: after a change here, touch that one.
Letters: C channels of a texel, K bases.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from avatar.layered.compiled import Lanes, _address, _read, _shuffled, _splat

LEAD = 2  # offsets that a map's texel begins with
CAREFUL = ("nsz", "arcp", "contract", "reassoc", "afn")  # all liberties with rounding, none with what is not finite
POWER = tuple(np.polynomial.polynomial.polyfit(np.linspace(0, 1, 2001), 2 ** np.linspace(0, 1, 2001), 6))  # of 2^f, to 1e-8
STEEP = 126  # 2^126 is the largest power whose inverse is not denormal


def padded_fields(bases: int) -> int:
    """Numbers that a texel of the map takes here: a multiple of four."""
    return -(-(LEAD + 4 + bases) // 4) * 4


def _times(builder, a, b):  # noqa: ANN001, ANN202
    return builder.fmul(a, b, flags=CAREFUL)


def _less(builder, a, b):  # noqa: ANN001, ANN202
    return builder.fsub(a, b, flags=CAREFUL)


def _plus(builder, a, b):  # noqa: ANN001, ANN202
    return builder.fadd(a, b, flags=CAREFUL)


def _constant(value: float, count: int) -> ir.Constant:
    return ir.Constant(ir.VectorType(ir.FloatType(), count), [float(np.float32(value))] * count)


def _part(builder, vector, start: int, count: int):  # noqa: ANN001, ANN202
    return _shuffled(builder, vector, list(range(start, start + count)))


def _sum(builder, vector):  # noqa: ANN001, ANN202
    """Sum of all lanes."""
    kind = ir.FunctionType(ir.FloatType(), [ir.FloatType(), vector.type])
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.vector.reduce.fadd.v{vector.type.count}f32")
    return builder.call(function, [ir.FloatType()(0.0), vector], fastmath=CAREFUL)


def _corners(context, builder, signature, values, size: int):  # noqa: ANN001, ANN202
    """Texels at a start and those `line` numbers later: left ones, and what the right ones have more."""
    kind = signature.args[0]
    upper = _address(context, builder, kind, values[0], values[1])
    found = []
    for pointer in (upper, builder.gep(upper, [values[2]], inbounds=True)):
        left = _read(builder, pointer, kind, size)
        right = _read(builder, builder.gep(pointer, [ir.IntType(64)(size)], inbounds=True), kind, size)
        found += [left, _less(builder, right, left)]
    return found


@intrinsic(prefer_literal=True)
def _bilinear(_, array, start, line, x, y, count):  # noqa: ANN001, ANN202
    """Texels at start, the next, and those `line` numbers later, mixed by x and y."""

    def code(context, builder, signature, values):  # noqa: ANN001, ANN202
        size = count.literal_value
        upper, more, lower, less = _corners(context, builder, signature, values, size)
        right, down = _splat(builder, values[3], size), _splat(builder, values[4], size)
        upper, lower = _plus(builder, upper, _times(builder, right, more)), _plus(builder, lower, _times(builder, right, less))
        return _plus(builder, upper, _times(builder, down, _less(builder, lower, upper)))

    return Lanes(count.literal_value)(array, types.intp, types.intp, types.float32, types.float32, count), code


@intrinsic(prefer_literal=True)
def _shown(_, texel, mix, bases):  # noqa: ANN001, ANN202
    """sigmoid(static + direct + sum_k weight_k basis_k): red, green, blue, opacity."""

    def code(_context, builder, _signature, values):  # noqa: ANN001, ANN202
        total = _plus(builder, _part(builder, values[0], 0, 4), _part(builder, values[1], LEAD, 4))
        for base in range(bases.literal_value):
            weight = _shuffled(builder, values[1], [LEAD + 4 + base] * 4)
            total = _plus(builder, total, _times(builder, weight, _part(builder, values[0], 4 + 4 * base, 4)))
        return _sigmoid(builder, total, 4)

    return Lanes(4)(texel, mix, bases), code


def _sigmoid(builder, logits, count: int):  # noqa: ANN001, ANN202
    """1 / (1 + 2^y) with y = -x / log 2: the whole part of y makes the exponent, a polynomial the rest; NaN of a NaN."""
    vector, whole = ir.VectorType(ir.FloatType(), count), ir.VectorType(ir.IntType(32), count)
    y = _times(builder, logits, _constant(-1 / np.log(2), count))
    for limit, test in ((-STEEP, "<"), (STEEP, ">")):
        bound = _constant(limit, count)
        y = builder.select(builder.fcmp_ordered(test, y, bound), bound, y)
    floor = cgutils.get_or_insert_function(builder.module, ir.FunctionType(vector, [vector]), f"llvm.floor.v{count}f32")
    below = builder.call(floor, [y])
    rest, power = _less(builder, y, below), _constant(POWER[-1], count)
    for coefficient in POWER[-2::-1]:
        power = _plus(builder, _times(builder, power, rest), _constant(coefficient, count))
    number = builder.select(builder.fcmp_ordered("ord", y, y), below, _constant(0, count))
    exponent = builder.add(builder.fptosi(number, whole), ir.Constant(whole, [127] * count))
    scale = builder.bitcast(builder.shl(exponent, ir.Constant(whole, [23] * count)), vector)
    return builder.fdiv(_constant(1, count), _plus(builder, _times(builder, scale, power), _constant(1, count)), flags=CAREFUL)


@intrinsic(prefer_literal=True)
def _of_texel(_, logits, mix, bases):  # noqa: ANN001, ANN202
    """Gradient of a fetched texel: of the logits, and as often times a weight."""

    def code(_context, builder, _signature, values):  # noqa: ANN001, ANN202
        repeated = _shuffled(builder, values[0], [0, 1, 2, 3] * (1 + bases.literal_value))
        weights = [LEAD + 4 + base for base in range(bases.literal_value) for _ in range(4)]
        fields = mix.count
        both = ir.Constant(ir.VectorType(ir.IntType(32), 4 + len(weights)), [fields] * 4 + weights)
        return _times(builder, repeated, builder.shuffle_vector(values[1], _constant(1, fields), both))

    return Lanes(4 * (1 + bases.literal_value))(logits, mix, bases), code


@intrinsic
def _of_map(_, texture, start, line, x, y, across, along, logits, of_texel):  # noqa: ANN001, ANN202
    """Gradient of a fetched map texel; across and along: texels that a move of one in UV goes, 0 at the border."""
    size = of_texel.count
    bases = size // 4 - 1

    def code(context, builder, signature, values):  # noqa: ANN001, ANN202
        upper, more, lower, less = _corners(context, builder, signature, values, size)
        right, down = _splat(builder, values[3], size), _splat(builder, values[4], size)
        upper, lower = _plus(builder, upper, _times(builder, right, more)), _plus(builder, lower, _times(builder, right, less))
        below = _less(builder, lower, upper)  # slope along a column
        beside = _plus(builder, more, _times(builder, down, _less(builder, less, more)))
        texel, logits = _plus(builder, upper, _times(builder, down, below)), values[7]
        found = [_times(builder, _sum(builder, _times(builder, values[8], beside)), values[5])]
        found.append(_times(builder, _sum(builder, _times(builder, values[8], below)), values[6]))
        found += [builder.extract_element(logits, ir.IntType(32)(c)) for c in range(4)]
        for base in range(bases):
            found.append(_sum(builder, _times(builder, _part(builder, texel, 4 + 4 * base, 4), logits)))
        result = _constant(0, padded_fields(bases))
        for n, value in enumerate(found):
            result = builder.insert_element(result, value, ir.IntType(32)(n))
        return result

    numbers = [types.intp] * 2 + [types.float32] * 4
    return Lanes(padded_fields(bases))(texture, *numbers, logits, of_texel), code


@intrinsic
def _add_to(_, array, start, lanes, factor):  # noqa: ANN001, ANN202
    """array[start:] += factor * lanes."""

    def code(context, builder, signature, values):  # noqa: ANN001, ANN202
        pointer = _address(context, builder, signature.args[0], values[0], values[1])
        before = _read(builder, pointer, signature.args[0], signature.args[2].count)
        after = _plus(builder, before, _times(builder, values[2], _splat(builder, values[3], signature.args[2].count)))
        builder.store(after, builder.bitcast(pointer, after.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, lanes, types.float32), code


@intrinsic
def _count(_, lanes):  # noqa: ANN001, ANN202
    return types.intp(lanes), lambda *_: ir.IntType(64)(lanes.count)
