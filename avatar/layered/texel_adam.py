"""Adam for textures of which a step touches a part: the other texels and their moments rest, and cost nothing."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
import torch
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from torch import Tensor

from avatar.layered import threads
from avatar.layered.compiled import FAST, _address, _constant, _load, _multiply_add, _prefetch, _read, _splat

BETAS = (0.9, 0.99)
EPSILON = 1e-15  # a texel of a basis has gradients of 1e-8: the usual 1e-8 would hold it back
BLOCK = 64  # texels that are looked through and asked for together
KEPT = tuple(np.power(beta, np.arange(12000)).astype(np.float32) for beta in BETAS)  # of a moment after n steps; then nothing


@lru_cache
def _updating(channels: int) -> Callable[..., None]:
    """Adam on texels of C channels."""

    @njit(nogil=True, fastmath=True, error_model="numpy", cache=True)
    def run(values, gradient, first, second, touched, last, number, rates, keep1, keep2, scale1, scale2, share, shares):  # noqa: ANN001, ANN202
        """All flat [Q C] but touched: [Q] uint8, last: [Q] int32, rates: [C]. Gradient and marks of what was used are cleared.

        keep1, keep2: [N] what n steps leave of the moments; scale1, scale2: what corrects them for their start from zero.
        """
        one, rate = np.float32(1), _load(rates, 0, channels)
        mine = np.empty(BLOCK, np.int64)
        for begin in range(share * BLOCK, len(touched), shares * BLOCK):
            items = _gathered(touched, begin, mine)
            for i in range(items):
                for array in (values, gradient, first, second):
                    _prefetch(array, mine[i] * channels)
            for i in range(items):
                q = mine[i]
                gap = min(number - last[q], len(keep1) - 1)
                last[q], touched[q] = number, 0
                factors = keep1[gap], one - keep1[1], keep2[gap], one - keep2[1], scale1, scale2, np.float32(EPSILON)
                _adam(values, gradient, first, second, q * channels, rate, factors)

    return run


@lru_cache
def _seeking(channels: int) -> Callable[..., np.int32]:
    """The largest size of touched texels of C channels."""

    @njit(nogil=True, cache=True)
    def run(bits, touched, share, shares):  # noqa: ANN001, ANN202
        """bits: [Q C] int32 of float32, and so is what is returned: without their sign they sort as the numbers do, NaN last."""
        most, mine = np.int32(0), np.empty(BLOCK, np.int64)
        for begin in range(share * BLOCK, len(touched), shares * BLOCK):
            items = _gathered(touched, begin, mine)
            for i in range(items):
                for c in range(channels):
                    most = max(most, bits[mine[i] * channels + c] & np.int32(0x7FFFFFFF))
        return most

    return run


@njit
def _gathered(touched, begin, mine):  # noqa: ANN001, ANN202
    """Write which of BLOCK texels are touched to `mine`; returns how many."""
    end, some, items = min(begin + BLOCK, len(touched)), np.uint8(0), 0
    for q in range(begin, end):
        some |= touched[q]
    if some:
        for q in range(begin, end):
            mine[items] = q
            items += touched[q] != 0
    return items


@intrinsic
def _adam(_, values, gradient, first, second, start, rate, factors):  # noqa: ANN001, ANN202
    """One step of the texel at `start`; its gradient becomes 0."""

    def code(context, builder, signature, given):  # noqa: ANN001, ANN202
        count = rate.count
        at = [_address(context, builder, signature.args[n], given[n], given[4]) for n in range(4)]
        value, slope, mean, square = (_read(builder, pointer, signature.args[n], count) for n, pointer in enumerate(at))
        factor = [_splat(builder, builder.extract_value(given[6], n), count) for n in range(7)]
        mean = _multiply_add(builder, slope, factor[1], builder.fmul(mean, factor[0], flags=FAST))
        squared = builder.fmul(slope, slope, flags=FAST)
        square = _multiply_add(builder, squared, factor[3], builder.fmul(square, factor[2], flags=FAST))
        kind = ir.FunctionType(value.type, [value.type])
        root = cgutils.get_or_insert_function(builder.module, kind, f"llvm.sqrt.v{count}f32")
        size = builder.fadd(builder.call(root, [builder.fmul(square, factor[5], flags=FAST)]), factor[6], flags=FAST)
        move = builder.fmul(given[5], builder.fmul(mean, factor[4], flags=FAST), flags=FAST)
        value = builder.fsub(value, builder.fdiv(move, size, flags=FAST), flags=FAST)
        for pointer, lanes in zip(at, (value, _constant(0, count), mean, square), strict=True):
            builder.store(lanes, builder.bitcast(pointer, lanes.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.none(values, gradient, first, second, types.intp, rate, factors), code


class TexelAdam:
    """Adam (Kingma and Ba, 2015) on the texels of a step; moments of one that was left out for n steps decay n times at once.

    A dense Adam would move texels that no pixel has seen for a while by their old momentum, and pass over 0.5 GB each step.
    """

    def __init__(self, values: Tensor) -> None:
        """values: [L, R, R, C] float32 on the CPU, changed in place by `step`."""
        self.values = values
        self.gradient, self.first, self.second = (torch.zeros_like(values) for _ in range(3))
        self.touched = torch.zeros(values.shape[:3], dtype=torch.uint8)
        self.last = torch.zeros(values.shape[:3], dtype=torch.int32)
        self.number = 0
        self.rates = torch.zeros(values.shape[3])  # [C]

    def zero_grad(self) -> None:
        """Forget the gradient of a step that was not taken; after one that was there is nothing to forget."""
        if self.touched.any():
            self.gradient[self.touched.bool()] = 0
            self.touched.zero_()

    def step(self) -> None:
        """One step with the present `rates`; clears the gradient."""
        self.number += 1
        keep1, keep2 = KEPT
        scales = (np.float32(1 / (1 - beta**self.number)) for beta in BETAS)
        flat = [part.view(-1).numpy() for part in (self.values, self.gradient, self.first, self.second, self.touched, self.last)]
        given, shares = (*flat, self.number, self.rates.numpy(), keep1, keep2, *scales), threads.count()
        run = _updating(self.values.shape[3])
        threads.run(lambda share: run(*given, share, shares), shares)

    def largest(self) -> Tensor:
        """Largest size of the gradient of any texel that the step touched, [1]; not a number where one is not."""
        bits, touched = self.gradient.view(-1).numpy().view(np.int32), self.touched.view(-1).numpy()
        run, shares = _seeking(self.values.shape[3]), threads.count()
        found = np.zeros(shares, np.int32)

        def work(share: int) -> None:
            found[share] = run(bits, touched, share, shares)

        threads.run(work, shares)
        return torch.from_numpy(found).max().view(torch.float32)[None]

    def state_dict(self) -> dict:
        """All that a continued run needs besides the values."""
        return {"first": self.first, "second": self.second, "last": self.last, "number": self.number}

    def load_state_dict(self, state: dict) -> None:
        """Take over what `state_dict` gave."""
        self.first.copy_(state["first"])
        self.second.copy_(state["second"])
        self.last.copy_(state["last"])
        self.number = int(state["number"])
