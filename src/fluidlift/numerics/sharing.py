"""How the work of a parallel loop is shared out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numba

PIECES = 16
"""per thread"""


@contextmanager
def in_pieces(count: int) -> Iterator[None]:
    """Parallel loops over `count` things within are dealt out piece by piece to whichever thread is free.

    Else each thread gets one equal share, and all wait for the last: for the slower core, for the one that another
    program uses as well, or for the share that holds more. For loops over a few thousand things at most that take
    milliseconds; others are better off with whole shares. Which thread does what changes no bit of what is written.
    """
    with numba.parallel_chunksize(max(1, count // (PIECES * numba.get_num_threads()))):
        yield
