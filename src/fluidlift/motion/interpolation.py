"""Interpolation by diffusion inside a mask: the values of some pixels spread to the others, faster along a direction.

The equation is (W - div D grad) x = W values, with the weights W of the given values on the diagonal and a tensor D
that conducts more along a unit vector n than across it. Its solution at a pixel is a mean of the given values: with the
Green's function G of the operator, x_k = sum_i G_ki W_i values_i, and sum_i G_ki W_i = 1 as a constant solves it too.
Nothing diffuses out of the mask, so values do not pass through a rock or from one arm of a stream to the other.
"""

from __future__ import annotations

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
    diagonal: np.ndarray
    """[H+2,W+2] W and the sum of the edges; 0 outside the mask"""


def diffusion_interpolation(
    values: Float[np.ndarray, "h w c"],
    weight: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    direction: Float[np.ndarray, "h w 2"] | None = None,
    *,
    anisotropy: float = 1.0,
    depth: Float[np.ndarray, "h w"] | None = None,
    tolerance: float = 3e-4,
    iterations: int = 200,
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
        tolerance: of the residual over the diagonal, relative to that at the start (the given values, and their mean
            elsewhere).
        iterations: of conjugate gradients at most.

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
    known = np.bincount(parts.ravel(), weight.ravel()) > 0
    reached = known[parts] & mask
    levels = _hierarchy(conductances(reached, direction, anisotropy, depth), np.pad(np.where(reached, weight, 0.0), 1))
    given = (reached & (weight > 0))[..., None]
    right = np.pad(np.where(given, weight[..., None] * np.where(given, values, 0.0), 0.0), _RIM).astype(np.float32)
    x, report = _conjugate_gradient(levels, right, tolerance, iterations)
    return x[1:-1, 1:-1], reached, report


_RIM = ((1, 1), (1, 1), (0, 0))


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


def _hierarchy(edges: np.ndarray, weight: np.ndarray) -> list[_Level]:
    levels = [_Level(edges, weight.astype(np.float32), _diagonal(edges, weight.astype(np.float32)))]
    while max(levels[-1].weight.shape) - 2 > COARSEST:
        fine = levels[-1]
        shape = tuple((n - 1) // 2 + 2 for n in fine.weight.shape)
        coarse, total = np.zeros((4, *shape), np.float32), np.zeros(shape, np.float32)
        _coarsen(fine.edges, fine.weight, COARSE_SHARE, coarse, total)
        levels.append(_Level(coarse, total, _diagonal(coarse, total)))
    return levels


def _conjugate_gradient(
    levels: list[_Level], right: np.ndarray, tolerance: float, iterations: int
) -> tuple[np.ndarray, SolveReport]:
    """Preconditioned with one symmetric V-cycle; every channel has its own steps."""
    edges, weight, diagonal = levels[0]
    scratch = [tuple(np.zeros((*lv.weight.shape, right.shape[-1]), np.float32) for _ in range(3)) for lv in levels]
    given = weight[..., None] > 0
    mean = right.sum(axis=(0, 1)) / max(float(weight.sum()), 1e-30)
    x = np.where(given, right / np.where(given, weight[..., None], 1.0), np.where(diagonal[..., None] > 0, mean, 0.0))
    x, image = x.astype(np.float32), np.zeros_like(right)
    _apply(edges, diagonal, x, image)
    r = right - image
    over = np.where(diagonal > 0, 1.0 / np.maximum(diagonal, 1e-30), 0.0).astype(np.float32)[..., None]
    aim = tolerance * float(np.sqrt(np.max(_dots(over * r, over * r), initial=0.0))) + 1e-30
    z = _v_cycle(levels, scratch, r)
    p, rho = z.copy(), _dots(r, z)
    step = 0
    while step < iterations and (np.sqrt(_dots(over * r, over * r)) > aim).any():
        _apply(edges, diagonal, p, image)
        alpha = (rho / np.maximum(_dots(p, image), 1e-30)).astype(np.float32)
        x += alpha * p
        r -= alpha * image
        z = _v_cycle(levels, scratch, r)
        new = _dots(r, z)
        p = z + (new / np.maximum(rho, 1e-30)).astype(np.float32) * p
        rho, step = new, step + 1
    left = float(np.sqrt(np.max(_dots(over * r, over * r), initial=0.0))) / aim * tolerance
    return x, SolveReport(left <= tolerance, step, left, "conjugate gradients, aggregation multigrid")


def _dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ijc,ijc->c", a, b, dtype=np.float64)


def _v_cycle(levels: list[_Level], scratch: list[tuple[np.ndarray, ...]], right: np.ndarray) -> np.ndarray:
    """One V-cycle from zero: a forward sweep on the way down, a backward one on the way up."""
    scratch[0][0][...] = right
    last = len(levels) - 1
    for k, (level, (b, x, rest)) in enumerate(zip(levels, scratch, strict=True)):
        x[...] = 0.0
        _sweep(level.edges, level.diagonal, b, x, True)
        if k < last:
            _apply(level.edges, level.diagonal, x, rest)
            np.subtract(b, rest, out=rest)
            _restrict(rest, scratch[k + 1][0])
    for k in range(last, -1, -1):
        (b, x, _), level = scratch[k], levels[k]
        if k < last:
            _prolong(scratch[k + 1][1], level.diagonal, x)
        for again in range(1 if k < last else 8):
            _sweep(level.edges, level.diagonal, b, x, False)
            if again:
                _sweep(level.edges, level.diagonal, b, x, True)
    return scratch[0][1]


@njit(cache=True, nogil=True)
def _diagonal(edges, weight):
    out = weight.copy()
    for i in range(1, weight.shape[0] - 1):
        for j in range(1, weight.shape[1] - 1):
            out[i, j] += (
                edges[0, i, j] + edges[0, i, j - 1] + edges[1, i, j] + edges[1, i - 1, j]
                + edges[2, i, j] + edges[2, i - 1, j - 1] + edges[3, i, j] + edges[3, i - 1, j + 1]
            )  # fmt: skip
    return out


@njit(cache=True, nogil=True)
def _around(edges, x, i, j, c):
    """Sum of the neighbours times their edges."""
    return (
        edges[0, i, j] * x[i, j + 1, c] + edges[0, i, j - 1] * x[i, j - 1, c]
        + edges[1, i, j] * x[i + 1, j, c] + edges[1, i - 1, j] * x[i - 1, j, c]
        + edges[2, i, j] * x[i + 1, j + 1, c] + edges[2, i - 1, j - 1] * x[i - 1, j - 1, c]
        + edges[3, i, j] * x[i + 1, j - 1, c] + edges[3, i - 1, j + 1] * x[i - 1, j + 1, c]
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _apply(edges, diagonal, x, out):
    for i in range(1, x.shape[0] - 1):
        for j in range(1, x.shape[1] - 1):
            if diagonal[i, j] > 0.0:
                for c in range(x.shape[2]):
                    out[i, j, c] = diagonal[i, j] * x[i, j, c] - _around(edges, x, i, j, c)


@njit(cache=True, nogil=True)
def _sweep(edges, diagonal, right, x, forward):
    """One sweep of Gauss and Seidel, row by row from the upper left, or backwards from the lower right."""
    h, w = diagonal.shape[0] - 2, diagonal.shape[1] - 2
    for s in range(h):
        i = s + 1 if forward else h - s
        for t in range(w):
            j = t + 1 if forward else w - t
            if diagonal[i, j] > 0.0:
                for c in range(x.shape[2]):
                    x[i, j, c] = (right[i, j, c] + _around(edges, x, i, j, c)) / diagonal[i, j]


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
            for c in range(fine.shape[2]):
                coarse[(i + 1) // 2, (j + 1) // 2, c] += fine[i, j, c]


@njit(cache=True, nogil=True)
def _prolong(coarse, diagonal, fine):
    for i in range(1, fine.shape[0] - 1):
        for j in range(1, fine.shape[1] - 1):
            if diagonal[i, j] > 0.0:
                for c in range(fine.shape[2]):
                    fine[i, j, c] += coarse[(i + 1) // 2, (j + 1) // 2, c]
