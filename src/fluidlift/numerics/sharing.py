"""How the work of a loop is shared out among threads.

Numba's own parallel loops compile three times as slowly as plain ones, and each of their calls waits until every
thread of a team has had its turn, which takes milliseconds where another program uses a core as well. Here a plain
compiled loop over `begin <= i < end`, which releases the interpreter's lock, is called piece by piece by whichever
thread is free. Which thread does what changes no bit of what is written.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np
from numba.core.compiler import Compiler

njit: Any = numba.njit
"""untyped: its stub does not know all options"""
X, Y, Z = np.int64(0), np.int64(1), np.int64(2)
"""axes, for compiled functions: one that is given literal numbers is compiled once more for each of them"""
PIECES = 16
"""per thread, of loops whose things take unequal times"""
SMALL = 20_000
"""elements of the largest array under which another thread costs more than it gains: waking it takes 0.05 ms"""


class _Apart(Compiler):
    """No array that a function writes to overlaps another one: without that, its loops are not vectorised.

    Numba takes the same for granted of its parallel loops.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.state.flags.noalias = True


def apart(function: Callable[..., None]) -> Any:
    """Decorator that compiles a part of a kernel whose arrays do not overlap, with divisions by zero as in C."""
    return njit(cache=True, nogil=True, no_cfunc_wrapper=True, pipeline_class=_Apart, error_model="numpy")(function)


class SharedLoop:
    """A compiled function whose first arguments are `begin` and `end`; it is called without them."""

    def __init__(self, kernel: Any, extent: Callable[..., tuple[int, int]], least: int, pieces: int) -> None:
        self.kernel, self.py_func, self.compile = kernel, kernel.py_func, kernel.compile
        self._extent, self._least, self._pieces = extent, least, pieces

    def __call__(self, *args: Any) -> None:
        """Do all of the loop; as many threads as Numba's parallel loops would take."""
        begin, end = map(int, self._extent(*args))
        threads = min(numba.get_num_threads(), (end - begin) // self._least)
        if threads < 2 or _largest(args) < SMALL:
            self.kernel(begin, end, *args)
            return
        count = min(self._pieces * threads, end - begin)
        ends = [begin + (end - begin) * n // count for n in range(count + 1)]
        pieces = zip(ends, ends[1:])  # one for all threads, each takes the next

        def work() -> None:
            for a, b in pieces:
                self.kernel(a, b, *args)

        others = [_pool().submit(work) for _ in range(threads - 1)]
        try:
            work()
        finally:
            for other in others:
                if not other.cancel():  # it has begun
                    other.result()


def _largest(args: tuple[Any, ...]) -> int:
    """Elements of the largest array, also of those in tuples."""
    sizes = (a.size if isinstance(a, np.ndarray) else _largest(a) if isinstance(a, tuple) else 0 for a in args)
    return max(sizes, default=0)


def shared(
    extent: Callable[..., tuple[int, int]], *, least: int = 4, pieces: int = 2, **options: Any
) -> Callable[[Callable[..., None]], Any]:
    """Decorator that compiles a loop over `begin <= i < end` whose steps do not depend on each other.

    Args:
        extent: begin and end, from the arguments that follow them.
        least: steps for which another thread is worth while.
        pieces: per thread; many (`PIECES`) where steps take unequal times.
        options: for `numba.njit`.
    """

    def decorate(function: Callable[..., None]) -> SharedLoop:
        kernel = njit(cache=True, nogil=True, no_cfunc_wrapper=True, pipeline_class=_Apart, **options)(function)
        return SharedLoop(kernel, extent, least, pieces)

    return decorate


@numba.njit(cache=True, nogil=True)
def in_order(sums):
    """Their sum, one after the other: the same for any number of threads, in and out of compiled code."""
    total = 0.0
    for value in sums:
        total += value
    return total


_pools: list[ThreadPoolExecutor] = []
os.register_at_fork(after_in_child=_pools.clear)


def _pool() -> ThreadPoolExecutor:
    if not _pools:
        _pools.append(ThreadPoolExecutor(numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    return _pools[0]
