"""Compiled work in shares, one a thread: plain threads, since compiled code that lets go of the interpreter runs beside others.

Not numba's parallel loops: their threads wait for each other by spinning, which on a computer that does something else too
(a browser, a camera) costs more than they bring: measured with one of two cores busy, a network of 6 ms in one thread took 200 in
two. Nor may some of numba's backends be called from two threads at once, as a server does.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache

import numba


@lru_cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "share")


def count() -> int:
    """How many threads compiled work may take: numba's setting (NUMBA_NUM_THREADS or `numba.set_num_threads`)."""
    return numba.get_num_threads()


def run(work: Callable[[int], None], shares: int) -> None:
    """work(0), ..., work(shares - 1), the first in this thread, each other in one of its own; returns when all are done.

    Raises what a share raised.
    """
    others = [_pool(shares - 1).submit(work, share) for share in range(1, shares)]
    try:
        work(0)
    finally:  # what they write into may be used again right after
        wait(others)
    for other in others:
        other.result()
