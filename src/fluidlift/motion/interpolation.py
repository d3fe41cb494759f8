"""Inpainting by anisotropic diffusion inside a mask: values of some pixels spread to others, faster along a direction.

The equation is (W - div D grad) x = W values, with the weights W of the given values on the diagonal and a tensor D
that conducts more along a unit vector n than across it. Its solution at a pixel is a mean of the given values: with the
Green's function G of the operator, x_k = sum_i G_ki W_i values_i, and sum_i G_ki W_i = 1 as a constant solves it too.
Nothing diffuses out of the mask, so values do not pass through a rock or from one arm of a stream to the other.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numba import njit

from fluidlift.errors import require
from fluidlift.types import SolveReport

STEPS = ((0, 1), (1, 0), (1, 1), (1, -1))
"""(row, column) to the neighbours of a pixel across its four kinds of edges; each edge is stored at its first pixel"""
DEPTH_JUMP = 0.02
"""Change of depth from pixel to pixel, as a share of it, at which two pixels count half as neighbours: a jet in front
of its pool. A level surface seen at 6 degrees through a lens of 500 px changes by that much. Between 0.01 and 0.1 the
filling's error changes by 8 % on the one simulated clip with such jumps, and by 1 % on the others."""
RESOLVED = 1e-5
"""1/px^2, mean weight of what hangs together, at least: ten times what float32 holds beside edges of up to
`anisotropy` a pixel. Below it only the ratios of the weights count (the solution is their mean, all but constant), and
the operator that rounding leaves is singular: on a real clip, a piece of 106 px with 6e-9 made all values NaN"""
MOST_STEPS = 200
"""of conjugate gradients: with the hierarchy a few tens do; what takes more is told as not converged"""
COARSEST = 8
"""px on the longer side of the coarsest picture of the hierarchy"""
COARSE_SHARE = 0.5
"""A correction that is constant over 2 x 2 pixels is twice as stiff as a smooth one of the same height (all its slope
lies on half of the edges), so the coarse edges are made half as strong (over-correction; Braess 1995)."""


class _Level(NamedTuple):
    """The operator on one picture of the hierarchy, with a rim of one empty pixel."""

    edges: np.ndarray
    """[4,H+2,W+2] conductance of the edges of `STEPS`"""
    weight: np.ndarray
    """[H+2,W+2] W"""
    inverse: np.ndarray
    """[H+2,W+2] 1 / (W and the sum of the edges): 1 over the diagonal; 0 outside the mask"""


def diffusion_interpolation(
    values: Float[np.ndarray, "h w c"] | Bool[np.ndarray, "h w c"],
    weight: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    direction: Float[np.ndarray, "h w 2"] | None = None,
    *,
    anisotropy: float = 1.0,
    depth: Float[np.ndarray, "h w"] | None = None,
    tolerance: float = 1e-3,
) -> tuple[Float[np.ndarray, "h w c"], Bool[np.ndarray, "h w"], SolveReport]:
    """Values everywhere in the mask from those that have a weight.

    Args:
        values: read where weight > 0.
        weight: W, 1/px^2: within sqrt(1/W) px the given value gives way to its neighbours; 0 where there is none.
        mask: where the values live. Values reach what hangs together through the sides of pixels.
        direction: n, unit; None: the same in all directions.
        anisotropy: conductance along n over that of the mean; across n it is the inverse. Influence reaches
            `anisotropy` times as far along n as across it.
        depth: positive inside the mask; what lies in front of something else does not speak to it (`DEPTH_JUMP`).
        tolerance: of the residual over the diagonal, relative to that at the start (the given values, and elsewhere
            the mean of those that reach there, as in pieces that are hardly known). With 1e-3 flow of simulated clips
            is filled as with 1e-5 to 0.002 px/frame in the mean.

    Returns:
        values float32, 0 outside the mask and where no value reaches; whether a value reaches, bool; the report of the
        solve.

    Raises:
        ValueError: an anisotropy below 1, negative weights or shapes that do not fit.
    """
    values, mask = np.asarray(values, np.float32), np.asarray(mask, bool)
    require(
        values.ndim == 3 and values.shape[:2] == mask.shape == np.shape(weight), "values, weight, mask of unlike shapes"
    )
    require(anisotropy >= 1, f"anisotropy {anisotropy}", "1 or more")
    weight = np.where(mask, weight, 0.0).astype(np.float32)
    require(bool((weight >= 0).all()), "a negative weight")
    parts = np.asarray(cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[1], np.int32)
    held, size = np.bincount(parts.ravel(), weight.ravel()), np.bincount(parts.ravel())
    known = held > 0
    reached = known[parts] & mask
    raised = np.where(known, np.maximum(1.0, RESOLVED * size / np.maximum(held, 1e-30)), 1.0)
    weight = (weight * raised[parts]).astype(np.float32)
    box = _bounding_box(reached)
    inside = reached[box]
    strength = np.pad(np.where(inside, weight[box], 0.0), 1)
    edge = None if depth is None else np.asarray(depth)[box]
    along = None if direction is None else np.asarray(direction)[box]
    levels = _hierarchy(conductances(inside, along, anisotropy, edge), strength)

    label = parts[box]
    faint = (raised > 1.0)[label]  # given their mean itself, as no tolerance would find it
    total = np.maximum(np.bincount(label.ravel(), strength[1:-1, 1:-1].ravel()), 1e-30)

    def solved(channel: int) -> tuple[np.ndarray, SolveReport]:
        given = np.where(strength[1:-1, 1:-1] > 0, values[box][..., channel], 0.0)
        mean = np.bincount(label.ravel(), (strength[1:-1, 1:-1] * given).ravel()) / total
        start = np.where((strength[1:-1, 1:-1] > 0) & ~faint, given, np.where(inside, mean[label], 0.0))
        return _conjugate_gradient(levels, np.pad(start, 1).astype(np.float32), tolerance)

    # the kernels release the lock, so the channels, each with its own steps, run side by side
    with ThreadPoolExecutor() as pool:
        channels = list(pool.map(solved, range(values.shape[-1])))
    out = np.zeros_like(values)
    for channel, (x, _) in enumerate(channels):
        out[box][..., channel] = x[1:-1, 1:-1]
    return out, reached, max((report for _, report in channels), key=lambda report: report.residual)


def _bounding_box(mask: np.ndarray) -> tuple[slice, slice]:
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if len(rows) == 0:
        return slice(0, 1), slice(0, 1)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)


def conductances(
    mask: Bool[np.ndarray, "h w"],
    direction: Float[np.ndarray, "h w 2"] | None,
    anisotropy: float,
    depth: Float[np.ndarray, "h w"] | None = None,
) -> Float[np.ndarray, "4 h+2 w+2"]:
    """Strength of the edges of `STEPS` between pixels of the mask, float32, with an empty rim.

    D = a n n^T + (1/a) m m^T with m across n is written as a sum of second differences along the sides and one
    diagonal: D_xy (both axes at once) on the diagonal of its sign, and what it takes from D_xx and D_yy off the sides.
    Strengths below 0 would let a mean leave the range of its values; they are cut off, which blunts an anisotropy of
    more than 1 + sqrt(2) in directions between side and diagonal. Between pixels whose depths differ by the share s the
    strength falls by 1 + (s / `DEPTH_JUMP`)^2.
    """
    shape = (4, *mask.shape)
    if direction is None or anisotropy == 1.0:
        strength = np.zeros(shape, np.float32)
        strength[:2] = 1.0
    else:
        n = np.asarray(direction, np.float32)
        a = np.float32(anisotropy)
        xx, yy = (a * n[..., k] ** 2 + n[..., 1 - k] ** 2 / a for k in (0, 1))
        xy = (a - 1 / a) * n[..., 0] * n[..., 1]
        least = 0.05 / a
        strength = np.stack([
            np.maximum(xx - np.abs(xy), least), np.maximum(yy - np.abs(xy), least),
            np.maximum(xy, 0.0), np.maximum(-xy, 0.0),
        ])  # fmt: skip
    inside = np.pad(mask, 1)
    out = np.zeros((4, *inside.shape), np.float32)
    strength = np.pad(strength, ((0, 0), (1, 1), (1, 1)))
    z = None if depth is None else np.pad(np.where(mask, depth, 1.0).astype(np.float32), 1, constant_values=1.0)
    for k, (down, right) in enumerate(STEPS):
        other = (slice(down, None), slice(max(right, 0), right if right < 0 else None))
        here = (slice(None, -down or None), slice(max(-right, 0), -right if right > 0 else None))
        both = inside[here] & inside[other]
        out[k][here] = np.where(both, 0.5 * (strength[k][here] + strength[k][other]), 0.0)
        if z is not None:
            jump = (z[here] - z[other]) / np.minimum(z[here], z[other])
            out[k][here] /= 1.0 + (jump / DEPTH_JUMP) ** 2
    return out


def depth_jump(depth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Largest change of depth from a pixel of the mask to its neighbours in it, as a share of the nearer; float32."""
    jump = np.zeros(mask.shape, np.float32)
    for axis in (0, 1):
        low, high = [slice(None)] * 2, [slice(None)] * 2
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        a, b = depth[tuple(low)], depth[tuple(high)]
        both = mask[tuple(low)] & mask[tuple(high)]
        change = np.where(both, np.abs(a - b) / np.minimum(a, b), 0.0).astype(np.float32)
        for side in (tuple(low), tuple(high)):
            jump[side] = np.maximum(jump[side], change)
    return jump


def _hierarchy(edges: np.ndarray, weight: np.ndarray) -> list[_Level]:
    weight = weight.astype(np.float32)
    levels = [_Level(edges, weight, _inverse_diagonal(edges, weight))]
    while max(levels[-1].weight.shape) - 2 > COARSEST:
        fine = levels[-1]
        shape = tuple((n - 1) // 2 + 2 for n in fine.weight.shape)
        coarse, total = np.zeros((4, *shape), np.float32), np.zeros(shape, np.float32)
        _coarsen(fine.edges, fine.weight, COARSE_SHARE, coarse, total)
        levels.append(_Level(coarse, total, _inverse_diagonal(coarse, total)))
    return levels


def _conjugate_gradient(levels: list[_Level], start: np.ndarray, tolerance: float) -> tuple[np.ndarray, SolveReport]:
    """The solution [H+2,W+2] for the given values, which `start` holds where they have weight.

    Preconditioned with one symmetric V-cycle.
    """
    edges, weight, inverse = levels[0]
    scratch = [tuple(np.zeros(lv.weight.shape, np.float32) for _ in range(3)) for lv in levels]
    x = start.copy()
    image, p = np.zeros_like(x), np.zeros_like(x)
    _apply(edges, inverse, x, image)
    r = weight * start - image
    first = left = _size(r, inverse)
    rho, step = 1.0, 0
    while left > tolerance * first + 1e-30 and step < MOST_STEPS:
        z = _v_cycle(levels, scratch, r)
        before, rho = rho, _dot(r, z)
        _turn(z, rho / max(before, 1e-30) if step else 0.0, p)
        alpha = rho / max(_apply(edges, inverse, p, image), 1e-30)
        left, step = _advance(alpha, p, image, inverse, x, r), step + 1
    share = left / max(first, 1e-30)
    return x, SolveReport(left <= tolerance * first + 1e-30, step, share, "conjugate gradients, aggregation multigrid")


def _v_cycle(levels: list[_Level], scratch: list[tuple[np.ndarray, ...]], right: np.ndarray) -> np.ndarray:
    """One V-cycle from zero: a forward sweep on the way down, a backward one on the way up."""
    last = len(levels) - 1
    b = right
    for k, (level, (_, x, rest)) in enumerate(zip(levels, scratch, strict=True)):
        _sweep_from_zero(level.edges, level.inverse, b, x, rest)
        if k < last:
            b = scratch[k + 1][0]
            _restrict(rest, b)
    for k in range(last, -1, -1):
        (b, x, _), level = scratch[k], levels[k]
        if k < last:
            _prolong(scratch[k + 1][1], level.inverse, x)
        for again in range(1 if k < last else 8):
            _sweep(level.edges, level.inverse, right if k == 0 else b, x, False)
            if again:
                _sweep(level.edges, level.inverse, right if k == 0 else b, x, True)
    return scratch[0][1]


@njit(cache=True, nogil=True)
def _inverse_diagonal(edges, weight):
    out = np.zeros_like(weight)
    for i in range(1, weight.shape[0] - 1):
        for j in range(1, weight.shape[1] - 1):
            total = (
                weight[i, j] + edges[0, i, j] + edges[0, i, j - 1] + edges[1, i, j] + edges[1, i - 1, j]
                + edges[2, i, j] + edges[2, i - 1, j - 1] + edges[3, i, j] + edges[3, i - 1, j + 1]
            )  # fmt: skip
            if total > 0.0:
                out[i, j] = np.float32(1.0) / total
    return out


@njit(cache=True, nogil=True, inline="always")
def _before(edges, x, i, j):
    """Sum of the neighbours that come earlier, row by row, times their edges."""
    above = edges[1, i - 1, j] * x[i - 1, j] + edges[2, i - 1, j - 1] * x[i - 1, j - 1]
    return above + edges[3, i - 1, j + 1] * x[i - 1, j + 1] + edges[0, i, j - 1] * x[i, j - 1]


@njit(cache=True, nogil=True, inline="always")
def _after(edges, x, i, j):
    """Sum of the neighbours that come later, row by row, times their edges."""
    below = edges[1, i, j] * x[i + 1, j] + edges[2, i, j] * x[i + 1, j + 1]
    return below + edges[3, i, j] * x[i + 1, j - 1] + edges[0, i, j] * x[i, j + 1]


@njit(cache=True, nogil=True)
def _apply(edges, inverse, x, out):
    """out = A x; returns x A x."""
    product = 0.0
    for i in range(1, x.shape[0] - 1):
        for j in range(1, x.shape[1] - 1):
            if inverse[i, j] > 0.0:
                value = x[i, j] / inverse[i, j] - _before(edges, x, i, j) - _after(edges, x, i, j)
                out[i, j] = value
                product += x[i, j] * value
    return product


@njit(cache=True, nogil=True)
def _sweep(edges, inverse, right, x, forward):
    """One sweep of Gauss and Seidel, row by row from the upper left, or backwards from the lower right."""
    h, w = inverse.shape[0] - 2, inverse.shape[1] - 2
    for s in range(h):
        if forward:
            i = s + 1
            for j in range(1, w + 1):
                x[i, j] = (right[i, j] + _after(edges, x, i, j) + _before(edges, x, i, j)) * inverse[i, j]
        else:
            i = h - s
            for j in range(w, 0, -1):
                x[i, j] = (right[i, j] + _before(edges, x, i, j) + _after(edges, x, i, j)) * inverse[i, j]


@njit(cache=True, nogil=True)
def _sweep_from_zero(edges, inverse, right, x, rest):
    """A forward sweep that starts at x = 0, and what it leaves of the right side: what later neighbours add."""
    for i in range(1, x.shape[0] - 1):
        for j in range(1, x.shape[1] - 1):
            x[i, j] = (right[i, j] + _before(edges, x, i, j)) * inverse[i, j]
    for i in range(1, x.shape[0] - 1):
        for j in range(1, x.shape[1] - 1):
            rest[i, j] = _after(edges, x, i, j)


@njit(cache=True, nogil=True)
def _dot(a, b):
    total = 0.0
    for i in range(1, a.shape[0] - 1):
        for j in range(1, a.shape[1] - 1):
            total += a[i, j] * b[i, j]
    return total


@njit(cache=True, nogil=True)
def _size(r, inverse):
    """Root of the sum of squares of the residual over the diagonal."""
    total = 0.0
    for i in range(1, r.shape[0] - 1):
        for j in range(1, r.shape[1] - 1):
            total += (r[i, j] * inverse[i, j]) ** 2
    return np.sqrt(total)


@njit(cache=True, nogil=True)
def _turn(z, share, p):
    """p = z + share p."""
    share = np.float32(share)
    for i in range(1, p.shape[0] - 1):
        for j in range(1, p.shape[1] - 1):
            p[i, j] = z[i, j] + share * p[i, j]


@njit(cache=True, nogil=True)
def _advance(alpha, p, image, inverse, x, r):
    """A step of alpha along p; returns the size of the residual after it."""
    alpha = np.float32(alpha)
    total = 0.0
    for i in range(1, x.shape[0] - 1):
        for j in range(1, x.shape[1] - 1):
            x[i, j] += alpha * p[i, j]
            r[i, j] -= alpha * image[i, j]
            total += (r[i, j] * inverse[i, j]) ** 2
    return np.sqrt(total)


@njit(cache=True, nogil=True)
def _coarsen(edges, weight, share, coarse, total):
    """The operator on aggregates of 2 x 2 pixels: weights and edges between different aggregates add up."""
    for i in range(1, weight.shape[0] - 1):
        a = (i + 1) // 2
        for j in range(1, weight.shape[1] - 1):
            b = (j + 1) // 2
            total[a, b] += weight[i, j]
            for k in range(4):
                strength = share * edges[k, i, j]
                if strength == 0.0:
                    continue
                down = 1 if k > 0 else 0
                right = 1 if k == 0 or k == 2 else (-1 if k == 3 else 0)
                c, d = (i + down + 1) // 2, (j + right + 1) // 2
                if c == a and d > b:
                    coarse[0, a, b] += strength
                elif c == a and d < b:
                    coarse[0, c, d] += strength
                elif c > a and d == b:
                    coarse[1, a, b] += strength
                elif c > a and d > b:
                    coarse[2, a, b] += strength
                elif c > a:
                    coarse[3, a, b] += strength


@njit(cache=True, nogil=True)
def _restrict(fine, coarse):
    coarse[:] = 0.0
    for i in range(1, fine.shape[0] - 1):
        for j in range(1, fine.shape[1] - 1):
            coarse[(i + 1) // 2, (j + 1) // 2] += fine[i, j]


@njit(cache=True, nogil=True)
def _prolong(coarse, inverse, fine):
    for i in range(1, fine.shape[0] - 1):
        for j in range(1, fine.shape[1] - 1):
            if inverse[i, j] > 0.0:
                fine[i, j] += coarse[(i + 1) // 2, (j + 1) // 2]
