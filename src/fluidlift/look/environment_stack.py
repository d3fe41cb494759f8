"""An environment's pictures one after the other in one array, for compiled loops that pick one of them in every pixel.

A tuple of arrays would be copied for that, and who holds them counted, which takes longer than to look up light. The
values are those of `environment_lookup`: `picture_place` up to 1e-6 of the picture's size, without calls.
"""

# pyright: reportCallIssue=false
# numba's stub of `njit` does not know `_nrt`, without which a kernel does not count references to arrays

from __future__ import annotations

from collections.abc import Sequence

import numba as nb
import numpy as np
from jaxtyping import Float, Int

_HALF, _QUARTER, _ZERO, _ONE = np.float32(0.5), np.float32(0.25), np.float32(0.0), np.float32(1.0)
_TURN = np.float32(0.5 / np.pi)
_TINY = np.float32(1e-30)
_LOG2_E = np.float32(1.4426950408889634)


def stacked(
    pictures: Sequence[Float[np.ndarray, "h 2*h 3"]],
) -> tuple[Float[np.ndarray, " values"], Int[np.ndarray, "k 2"]]:
    """All values, and of each picture where it begins and its rows."""
    rows = np.array([len(p) for p in pictures], np.int64)
    starts = np.concatenate([[0], np.cumsum(6 * rows * rows)[:-1]])
    values = np.concatenate([np.ravel(np.asarray(p, np.float32)) for p in pictures])
    return values, np.stack([starts, rows], axis=-1)


@nb.njit(cache=True, inline="always")
def _turns(y, x):
    """atan2(y, x) / (2 pi). Abramowitz and Stegun 1964, 4.4.49: good to 2e-8 up to float32's rounding."""
    wide, high = abs(x), abs(y)
    a = min(wide, high) / max(max(wide, high), _TINY)
    s = a * a
    r = np.float32(0.0028662257) * s - np.float32(0.0161657367)
    r = r * s + np.float32(0.0429096138)
    r = r * s - np.float32(0.0752896400)
    r = r * s + np.float32(0.1065626393)
    r = r * s - np.float32(0.1420889944)
    r = r * s + np.float32(0.1999355085)
    r = r * s - np.float32(0.3333314528)
    r = (r * s + _ONE) * a * _TURN
    r = _QUARTER - r if high > wide else r
    r = _HALF - r if x < _ZERO else r
    return -r if y < _ZERO else r


@nb.njit(cache=True, inline="always")
def place_of(x, y, z):
    """`environment_lookup.picture_place` of a direction (float32)."""
    return _turns(x, y) + _HALF, np.float32(2.0) * _turns(np.sqrt(x * x + y * y), z)


@nb.njit(cache=True, inline="always")
def _corner(row, column, h):
    """Place of a pixel up to one beyond the edges: over the pole lies the same row, on the other side."""
    if row < 0 or row >= h:
        row = min(max(row, 0), h - 1)
        column += h
    column = column + 2 * h if column < 0 else column
    column = column - 2 * h if column >= 2 * h else column
    return 3 * (2 * h * row + column)


@nb.njit(cache=True, error_model="numpy", _nrt=False)
def value_at(values, start, h, across, down):
    """Red, green and blue of one picture at a place of `place_of`, bilinear."""
    column, row = across * np.float32(2 * h) - _HALF, down * np.float32(h) - _HALF
    j, i = np.int64(np.floor(column)), np.int64(np.floor(row))
    a, b = column - np.float32(j), row - np.float32(i)
    n0, n1 = start + _corner(i, j, h), start + _corner(i, j + 1, h)
    n2, n3 = start + _corner(i + 1, j, h), start + _corner(i + 1, j + 1, h)
    p, q, r, s = (_ONE - a) * (_ONE - b), a * (_ONE - b), (_ONE - a) * b, a * b
    return (
        p * values[n0] + q * values[n1] + r * values[n2] + s * values[n3],
        p * values[n0 + 1] + q * values[n1 + 1] + r * values[n2 + 1] + s * values[n3 + 1],
        p * values[n0 + 2] + q * values[n1 + 2] + r * values[n2 + 2] + s * values[n3 + 2],
    )


@nb.njit(cache=True, inline="always")
def fading(x):
    """exp(-x) for x of 0 or more, float32: 2^f as a series (|f| up to 1/2, good to 1e-7) times a whole power of 2."""
    t = min(np.float32(x) * _LOG2_E, np.float32(126.0))
    k = np.int32(t + _HALF)
    f = np.float32(k) - t
    e = np.float32(1.5403530e-4) * f + np.float32(1.3333558e-3)
    e = e * f + np.float32(9.6181291e-3)
    e = e * f + np.float32(5.5504109e-2)
    e = e * f + np.float32(2.4022651e-1)
    e = e * f + np.float32(6.9314718e-1)
    e = e * f + _ONE
    return e * np.int32((np.int32(127) - k) << np.int32(23)).view(np.float32)
