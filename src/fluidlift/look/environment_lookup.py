"""Directions and equirectangular pictures: where a direction lies, and the picture's value there.

`lookup_kernel` and `lookup_plain` are the same function, compiled and for reading. A direction that is no number sees
nothing (0), one of no length what lies above. The axes are those of `look.environment`.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from jaxtyping import Float

from fluidlift.numerics.sharing import shared

_CHUNK = 2048


def grid_directions(rows: int) -> Float[np.ndarray, "h 2*h 3"]:
    """Unit directions (float32) of the pixel centres of an equirectangular picture."""
    polar = (np.arange(rows) + 0.5) * math.pi / rows
    azimuth = ((np.arange(2 * rows) + 0.5) / rows - 1.0) * math.pi
    out = np.empty((rows, 2 * rows, 3), np.float32)
    out[..., 0] = np.sin(polar)[:, None] * np.sin(azimuth)
    out[..., 1] = np.sin(polar)[:, None] * np.cos(azimuth)
    out[..., 2] = np.cos(polar)[:, None]
    return out


def lookup(picture: Float[np.ndarray, "h 2*h 3"], directions: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """The picture towards directions of any length, float32, bilinear and continuous across the poles and the seam."""
    flat = np.ascontiguousarray(np.reshape(directions, (-1, 3)), np.float32)
    out = np.empty_like(flat)
    lookup_kernel(np.ascontiguousarray(picture, np.float32), flat, out)
    return out.reshape(np.shape(directions))


def lookup_plain(
    picture: Float[np.ndarray, "h 2*h 3"], directions: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """The twin of `lookup_kernel`."""
    h, w = picture.shape[:2]
    x, y, z = np.asarray(directions, np.float64).T
    column = (np.arctan2(x, y) / (2 * math.pi) + 0.5) * w - 0.5
    row = np.arctan2(np.hypot(x, y), z) / math.pi * h - 0.5
    j, i = np.floor(column), np.floor(row)
    a, b = (column - j)[:, None], (row - i)[:, None]
    out = np.zeros((len(x), 3))
    for down, weight in ((0, 1 - b), (1, b)):
        r = i.astype(int) + down
        beyond = (r < 0) | (r >= h)  # over the pole: the same row, on the other side
        c = j.astype(int) + np.where(beyond, h, 0)
        r = np.clip(r, 0, h - 1)
        out += weight * ((1 - a) * picture[r, c % w] + a * picture[r, (c + 1) % w])
    return out.astype(np.float32)


@nb.njit(cache=True, inline="always")
def _row_and_column(row, column, h, w):
    """Of a pixel up to one beyond the edges: over the pole lies the same row, on the other side."""
    if row < 0 or row >= h:
        row = min(max(row, 0), h - 1)
        column += h
    if column < 0:
        column += w
    return row, column - w if column >= w else column


@nb.njit(cache=True, inline="always")
def picture_place(x, y, z):
    """Column and row of a direction as shares of the picture's width and height; no numbers if it is none."""
    column = math.atan2(x, y) * np.float32(0.5 / math.pi) + np.float32(0.5)
    return column, math.atan2(math.sqrt(x * x + y * y), z) * np.float32(1 / math.pi)


@nb.njit(cache=True)
def picture_value(picture, across, down):
    """Red, green and blue at a place of `picture_place`, bilinear."""
    h, w = picture.shape[0], picture.shape[1]
    column, row = across * w - np.float32(0.5), down * h - np.float32(0.5)
    j, i = np.int64(math.floor(column)), np.int64(math.floor(row))
    a, b = np.float32(column - j), np.float32(row - i)
    i0, j0 = _row_and_column(i, j, h, w)
    i1, j1 = _row_and_column(i, j + 1, h, w)
    i2, j2 = _row_and_column(i + 1, j, h, w)
    i3, j3 = _row_and_column(i + 1, j + 1, h, w)
    one = np.float32(1)
    p, q, r, s = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
    return (
        p * picture[i0, j0, 0] + q * picture[i1, j1, 0] + r * picture[i2, j2, 0] + s * picture[i3, j3, 0],
        p * picture[i0, j0, 1] + q * picture[i1, j1, 1] + r * picture[i2, j2, 1] + s * picture[i3, j3, 1],
        p * picture[i0, j0, 2] + q * picture[i1, j1, 2] + r * picture[i2, j2, 2] + s * picture[i3, j3, 2],
    )


@shared(lambda picture, directions, *_: (0, -(-directions.shape[0] // _CHUNK)), error_model="numpy")
def lookup_kernel(begin, end, picture, directions, out):
    n = directions.shape[0]
    for chunk in range(begin, end):
        for k in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            across, down = picture_place(directions[k, 0], directions[k, 1], directions[k, 2])
            if math.isfinite(across + down):
                out[k, 0], out[k, 1], out[k, 2] = picture_value(picture, across, down)
            else:
                out[k, :] = np.float32(0)
