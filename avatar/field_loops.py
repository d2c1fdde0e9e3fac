"""The field's work between its matrix products, in compiled loops over samples; forward and backward.

Each loop reads and writes the products' own type: float64, float32, or bfloat16 as the uint16 of its bits (numba has no such
type); arithmetic is float32 or more. Letters: P samples, K neighbours, W width of a layer; row p K + k of a matrix is neighbour k
of sample p.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload

TILE = 64  # encodings side by side
SERIES_WITHIN = 1.0  # rad: the series below are exact to rounding there; offsets and directions are, in their units


@intrinsic
def _float_of_bits(typing, bits):  # noqa: ANN001, ANN202
    return types.float32(types.uint32), lambda context, builder, signature, values: builder.bitcast(values[0], ir.FloatType())


@intrinsic
def _bits_of_float(typing, value):  # noqa: ANN001, ANN202
    return types.uint32(types.float32), lambda context, builder, signature, values: builder.bitcast(values[0], ir.IntType(32))


def widen(value):  # noqa: ANN001, ANN201
    """A stored number as one to calculate with."""


@overload(widen, inline="always")
def _widen(value):  # noqa: ANN001, ANN202
    if value == types.uint16:
        return lambda value: _float_of_bits(np.uint32(value) << np.uint32(16))
    return lambda value: value


def narrow(value, like):  # noqa: ANN001, ANN201
    """A number as it is stored in the type of `like`: to bfloat16 rounded to nearest, ties to even.

    NaN stays NaN, as its low bits are 0 where arithmetic made it.
    """


@overload(narrow, inline="always")
def _narrow(value, like):  # noqa: ANN001, ANN202
    if like != types.uint16:
        return lambda value, like: value

    def to_bfloat16(value, like):  # noqa: ANN001, ANN202
        bits = _bits_of_float(np.float32(value))
        return np.uint16((bits + np.uint32(0x7FFF) + ((bits >> np.uint32(16)) & np.uint32(1))) >> np.uint32(16))

    return to_bfloat16


compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
summing = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})


@numba.njit(cache=True, nogil=True)
def _sines_and_cosines(angles, sine, cosine):  # noqa: ANN001, ANN202
    """Of angles [TILE] in rad."""
    for t in range(len(angles)):
        square = angles[t] * angles[t]
        tail = 1 - square * (1 / 210) * (1 - square * (1 / 272) * (1 - square * (1 / 342)))
        tail = 1 - square * (1 / 72) * (1 - square * (1 / 110) * (1 - square * (1 / 156) * tail))
        sine[t] = angles[t] * (1 - square * (1 / 6) * (1 - square * (1 / 20) * (1 - square * (1 / 42) * tail)))
        tail = 1 - square * (1 / 240) * (1 - square * (1 / 306) * (1 - square * (1 / 380)))
        tail = 1 - square * (1 / 90) * (1 - square * (1 / 132) * (1 - square * (1 / 182) * tail))
        cosine[t] = 1 - square * (1 / 2) * (1 - square * (1 / 12) * (1 - square * (1 / 30) * (1 - square * (1 / 56) * tail)))
    for t in range(len(angles)):
        if not abs(angles[t]) <= SERIES_WITHIN:
            sine[t], cosine[t] = math.sin(angles[t]), math.cos(angles[t])


@numba.njit(cache=True, nogil=True)
def _encode(coordinates, bands, sine, cosine, values):  # noqa: ANN001, ANN202
    """`networks.positional_encoding` of a tile of points [3, TILE], into values [3 (1 + 2 bands), TILE]; octaves by doubling."""
    for axis in range(3):
        along = coordinates[axis]
        _sines_and_cosines(along, sine, cosine)
        row = values[axis]
        for t in range(len(along)):
            row[t] = along[t]
        for band in range(bands):
            sines, cosines = values[3 + 3 * band + axis], values[3 + 3 * (bands + band) + axis]
            for t in range(len(along)):
                s, c = sine[t], cosine[t]
                sines[t], cosines[t] = s, c
                sine[t], cosine[t] = 2 * s * c, (c - s) * (c + s)


@compiled
def encode_offsets(points, vertices, index, bands, unit, nearest, encoded, weights):  # noqa: ANN001, ANN201
    """Encoded offsets [P K, at least 3 (1 + 2 bands)] to each sample's neighbours, and their weights [P, K].

    points: [P, 3]; vertices: [V, 3]; index: [P, K]; unit: metres by which offsets are divided; nearest: least distance in m.
    Columns of `encoded` beyond the encoding become 0.
    """
    count, neighbours = index.shape
    columns, like = encoded.shape[1], encoded[0, 0]
    values, packed = np.zeros((columns, TILE), weights.dtype), np.zeros((columns, TILE), encoded.dtype)
    sine, cosine = np.empty(TILE), np.empty(TILE)
    offsets, flat, stored = np.zeros((3, TILE)), values.reshape(-1), packed.reshape(-1)
    at = 0
    for p in range(count):
        for k in range(neighbours):
            v = index[p, k]
            x, y, z = vertices[v, 0] - points[p, 0], vertices[v, 1] - points[p, 1], vertices[v, 2] - points[p, 2]
            squared = np.float64(x) * x + np.float64(y) * y + np.float64(z) * z
            weights[p, k] = math.sqrt(max(squared, nearest * nearest))
            offsets[0, at], offsets[1, at], offsets[2, at] = x / unit, y / unit, z / unit
            at += 1
            if at < TILE and (p < count - 1 or k < neighbours - 1):
                continue
            _encode(offsets, bands, sine, cosine, values)
            for c in range(len(flat)):
                stored[c] = narrow(flat[c], like)
            for t in range(at):
                row = encoded[p * neighbours + k + 1 - at + t]
                for c in range(columns):
                    row[c] = packed[c, t]
            at = 0
    for p in range(count):
        least, total = weights[p, 0], 0.0
        for k in range(1, neighbours):
            least = min(least, weights[p, k])
        for k in range(neighbours):
            total += least / weights[p, k]  # the common factor cancels: no overflow at the pole
        for k in range(neighbours):
            weights[p, k] = least / weights[p, k] / total


@compiled
def add_terms(hidden, terms, index):  # noqa: ANN001, ANN201
    """ReLU of hidden [P K, W] plus the term [V, W] of each row's vertex, in place."""
    like = hidden[0, 0]
    for p in range(index.shape[0]):
        for k in range(index.shape[1]):
            row, term = hidden[p * index.shape[1] + k], terms[index[p, k]]
            for c in range(len(row)):
                value = widen(row[c]) + widen(term[c])
                row[c] = narrow(value - value if value < 0 else value, like)


@compiled
def mix(hidden, weights, mixed):  # noqa: ANN001, ANN201
    """The weighted sums [P, W] of the rows of each sample's neighbours; hidden: [P K, W]; weights: [P, K]."""
    like, neighbours = hidden[0, 0], weights.shape[1]
    total = np.empty(hidden.shape[1], weights.dtype)
    for p in range(weights.shape[0]):
        total[:] = 0
        for k in range(neighbours):
            row, weight = hidden[p * neighbours + k], weights[p, k]
            for c in range(len(row)):
                total[c] += weight * widen(row[c])
        out = mixed[p]
        for c in range(len(out)):
            out[c] = narrow(total[c], like)


@compiled
def join_views(shared, directions, bands, count, joined):  # noqa: ANN001, ANN201
    """Rows [P, at least W + 3 (1 + 2 bands)]: shared [P, W], then the encoded direction [P, 3], then zeros."""
    width, like = shared.shape[1], shared[0, 0]
    values = np.zeros((joined.shape[1] - width, 1), directions.dtype)
    view = np.zeros(joined.shape[1] - width, joined.dtype)
    along, sine, cosine = np.zeros((3, 1)), np.empty(1), np.empty(1)
    for p in range(count):
        x, y, z = directions[p, 0], directions[p, 1], directions[p, 2]
        if p == 0 or x != directions[p - 1, 0] or y != directions[p - 1, 1] or z != directions[p - 1, 2]:
            along[0, 0], along[1, 0], along[2, 0] = x, y, z  # samples of a ray share it
            _encode(along, bands, sine, cosine, values)
            for c in range(len(view)):
                view[c] = narrow(values[c, 0], like)
        row, first = joined[p], shared[p]
        for c in range(width):
            row[c] = first[c]
        for c in range(len(view)):
            row[width + c] = view[c]


@summing
def outputs(shared, shade, by_density, bias, by_colour, biases, density, colour):  # noqa: ANN001, ANN201
    """softplus [P] of one unit on shared [P, W], and sigmoids [P, 3] of three on shade [P, C]; weights [W], [3, C]."""
    for p in range(len(density)):
        total, row = bias, shared[p]
        for c in range(len(row)):
            total += widen(row[c]) * by_density[c]
        density[p] = total if total > 20 else math.log1p(math.exp(total))
        row = shade[p]
        for i in range(3):
            total = biases[i]
            for c in range(len(row)):
                total += widen(row[c]) * by_colour[i, c]
            colour[p, i] = 1 / (1 + math.exp(-total))


@compiled
def outputs_back(density, colour, along_density, along_colour, shade, by_colour, slope, slopes, into):  # noqa: ANN001, ANN201
    """Backwards through `outputs` and the ReLU of shade.

    density, colour: its results; along_density [P], along_colour [P, 3]: of the loss by these. Writes slope [P] and slopes
    [P, 3], of the loss by the units before softplus and sigmoids, and into [P, C], by shade before its ReLU.
    """
    like = shade[0, 0]
    for p in range(len(density)):
        slope[p] = along_density[p] * -math.expm1(-density[p])
        for i in range(3):
            slopes[p, i] = along_colour[p, i] * colour[p, i] * (1 - colour[p, i])
        a, b, c = slopes[p, 0], slopes[p, 1], slopes[p, 2]
        row, out = shade[p], into[p]
        for i in range(len(row)):
            value = a * by_colour[0, i] + b * by_colour[1, i] + c * by_colour[2, i]
            out[i] = narrow(value if row[i] != 0 else value * 0, like)


@compiled
def join_back(joined, slope, by_density, shared, into):  # noqa: ANN001, ANN201
    """Of the loss by the last shared layer before its ReLU [P, W], from joined's [P, >= W] and the density's."""
    like = shared[0, 0]
    for p in range(len(slope)):
        row, out, active, along = joined[p], into[p], shared[p], slope[p]
        for c in range(len(active)):
            value = widen(row[c]) + along * by_density[c]
            out[c] = narrow(value if active[c] != 0 else value * 0, like)


@compiled
def relu_back(into, active, count):  # noqa: ANN001, ANN201
    """Backwards through a ReLU with outputs `active`, in place on the first `count` rows."""
    zero = into.dtype.type(0)
    for p in range(count):
        row, unit = into[p], active[p]
        for c in range(len(row)):
            row[c] = row[c] if unit[c] != 0 else zero


@compiled
def mix_back(mixed, weights, hidden, into):  # noqa: ANN001, ANN201
    """Backwards through `mix` (weights held constant) and the ReLU before it: into [P K, W] from mixed [P, W]."""
    like, neighbours = hidden[0, 0], weights.shape[1]
    for p in range(weights.shape[0]):
        row = mixed[p]
        for k in range(neighbours):
            out, active, weight = into[p * neighbours + k], hidden[p * neighbours + k], weights[p, k]
            for c in range(len(row)):
                value = weight * widen(row[c])
                out[c] = narrow(value if active[c] != 0 else value * 0, like)


@compiled
def add_terms_back(into, active, index, terms):  # noqa: ANN001, ANN201
    """Backwards through `add_terms`, in place on into [P K, W]; terms [V, W] grow by the rows of their vertices."""
    zero = into.dtype.type(0)
    for p in range(index.shape[0]):
        for k in range(index.shape[1]):
            row, unit = into[p * index.shape[1] + k], active[p * index.shape[1] + k]
            term = terms[index[p, k]]
            for c in range(len(row)):
                value = row[c] if unit[c] != 0 else zero
                row[c] = value
                term[c] += widen(value)
