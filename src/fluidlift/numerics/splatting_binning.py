"""The compiled loops that deal Gaussians to the tiles of a picture (Numba). Conventions: `splatting`.

A tile gets a Gaussian only if the ellipse outside which alpha is under the cut meets it, not its box: for every row of
tiles the ellipse's widest part within that row says which tiles it meets. Gaussians come in order of depth, in fixed
chunks; each chunk knows from a count of the chunks before where its pairs begin. So the lists are the same for any
number of threads, and every list is in order of depth.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from fluidlift.numerics.sharing import shared

LEAD = 8
"""numbers of a packed Gaussian before its features: u, v, a/2, b, c/2, opacity, and the half height and width of its
box; [[a, b], [b, c]] is the inverse covariance"""


@shared(lambda uv, conics, opacities, extents, features, order, *_: (0, order.shape[0]))
def pack_kernel(begin, end, uv, conics, opacities, extents, features, order, drawn_only, packed):
    """The drawn Gaussians in order of depth, one row each: the loops over pixels read no more than these. With
    `drawn_only` the rows of `features` come in that order already."""
    for k in range(begin, end):
        i = order[k]
        packed[k, 0], packed[k, 1] = uv[i, 0], uv[i, 1]
        packed[k, 2], packed[k, 3], packed[k, 4] = 0.5 * conics[i, 0], conics[i, 1], 0.5 * conics[i, 2]
        packed[k, 5], packed[k, 6], packed[k, 7] = opacities[i], extents[i, 1], extents[i, 0]
        row = k if drawn_only else i
        for c in range(features.shape[1]):
            packed[k, LEAD + c] = features[row, c]
        for c in range(LEAD + features.shape[1], packed.shape[1]):
            packed[k, c] = 0


@shared(lambda uv, conics, extents, order, *_: (0, order.shape[0]))
def sketch_kernel(begin, end, uv, conics, extents, order, sketch):
    """What binning reads, in order of depth: see `_columns`."""
    for k in range(begin, end):
        i = order[k]
        hx, hy = nb.float64(extents[i, 0]), nb.float64(extents[i, 1])
        lean = -nb.float64(conics[i, 1]) / nb.float64(conics[i, 0])
        sketch[k, 0], sketch[k, 1], sketch[k, 2], sketch[k, 3] = uv[i, 0], uv[i, 1], hx, hy
        # hx^2 = w^2 + (lean hy)^2
        sketch[k, 4], sketch[k, 5] = lean, math.sqrt(max(hx * hx - lean * lean * hy * hy, 0.0))
        sketch[k, 6], sketch[k, 7] = lean * hy * hy / hx, 1.0 / hy


@nb.njit(cache=True, nogil=True)
def met_kernel(extents, tile, width, height):
    """Pairs of tile and box, were the boxes nowhere near the picture's edges, but never larger than the picture."""
    total = 0.0
    for i in range(extents.shape[0]):
        if extents[i, 0] > 0:
            across = min(2.0 * extents[i, 0] / tile + 1.0, width / tile + 1.0)
            total += across * min(2.0 * extents[i, 1] / tile + 1.0, height / tile + 1.0)
    return total


@nb.njit(cache=True)
def _box(sketch, k, tile, tiles_x, tiles_y):
    """First and last column and row of tiles that the box of the k-th Gaussian meets."""
    scale = np.float32(1.0) / np.float32(tile)
    u, v, hx, hy = sketch[k, 0], sketch[k, 1], sketch[k, 2], sketch[k, 3]
    x0, x1 = int(math.floor((u - hx) * scale)), int(math.floor((u + hx) * scale))
    y0, y1 = int(math.floor((v - hy) * scale)), int(math.floor((v + hy) * scale))
    return max(0, x0), min(tiles_x - 1, x1), max(0, y0), min(tiles_y - 1, y1)


@nb.njit(cache=True)
def _columns(sketch, k, row, tile, tiles_x):
    """First and last tile of row `row` that the ellipse meets; the last is smaller than the first if it meets none.

    At height dy above the centre the ellipse's middle is at lean dy and its half width is w sqrt(1 - (dy/hy)^2), with w
    that of the cut through the centre. The right edge is a concave function of dy: within a row of tiles its extreme is
    that of the whole ellipse if the row holds it, and lies at the nearer end of the row if not. So does the left edge.
    A sketch holds u, v, the half sizes hx, hy of the box, lean, w, the dy of the rightmost point (the leftmost is
    opposite) and 1/hy.
    """
    u, v, hx, hy, lean, width = sketch[k, 0], sketch[k, 1], sketch[k, 2], sketch[k, 3], sketch[k, 4], sketch[k, 5]
    peak, inverse = sketch[k, 6], sketch[k, 7]
    one, zero, scale = np.float32(1.0), np.float32(0.0), np.float32(1.0) / np.float32(tile)
    low = max(np.float32(row * tile) - v, -hy)
    high = min(np.float32((row + 1) * tile) - v, hy)
    yr, yl = min(max(peak, low), high), min(max(-peak, low), high)
    right = lean * yr + width * math.sqrt(max(one - (yr * inverse) * (yr * inverse), zero))
    left = lean * yl - width * math.sqrt(max(one - (yl * inverse) * (yl * inverse), zero))
    # more than the rounding of `width`, a difference, and of the roots; costs next to nothing
    slack = np.float32(0.01) + np.float32(1e-3) * hx
    first = max(0, int(math.floor((u + left - slack) * scale)))
    last = min(tiles_x - 1, int(math.floor((u + right + slack) * scale)))
    return first, last


@shared(lambda sketch, tile, tiles_x, tiles_y, first, last, counts, *_: (0, counts.shape[0]))
def count_kernel(lead, stop, sketch, tile, tiles_x, tiles_y, first, last, counts, pairs):
    """Of the tiles first <= t < last: counts[chunk, t], Gaussians of a chunk that meet t; pairs[k], tiles that the k-th
    meets. `counts` is 0 before, and has one column more than there are tiles.

    A run of tiles is noted by its two ends, and the runs are summed up when all are in: no loop over pairs.
    """
    chunks, n = counts.shape[0], sketch.shape[0]
    size = -(-n // chunks)
    row0, row1 = first // tiles_x, (last - 1) // tiles_x
    for chunk in range(lead, stop):
        for k in range(chunk * size, min((chunk + 1) * size, n)):
            x0, x1, y0, y1 = _box(sketch, k, tile, tiles_x, tiles_y)
            plain = x0 == x1 or y0 == y1  # the ellipse meets all tiles of its box
            total = 0
            for ty in range(max(y0, row0), min(y1, row1) + 1):
                left, right = (x0, x1) if plain else _columns(sketch, k, ty, tile, tiles_x)
                begin, end = max(ty * tiles_x + left, first), min(ty * tiles_x + right + 1, last)
                if begin < end:
                    counts[chunk, begin] += 1
                    counts[chunk, end] -= 1
                    total += end - begin
            pairs[k] = total
        running = 0
        for t in range(first, last):
            running += counts[chunk, t]
            counts[chunk, t] = running


@shared(lambda counts, starts: (0, starts.shape[0]))
def places_kernel(begin, end, counts, starts):
    """Counts of chunks to where each chunk's part of each tile's list begins; `starts` are those of the lists."""
    for t in range(begin, end):
        place = starts[t]
        for chunk in range(counts.shape[0]):
            n = counts[chunk, t]
            counts[chunk, t] = place
            place += n


@shared(lambda sketch, tile, tiles_x, tiles_y, first, last, places, *_: (0, places.shape[0]))
def fill_kernel(begin, end, sketch, tile, tiles_x, tiles_y, first, last, places, offsets, gaussians, slots):
    """Deal out the pairs of tiles first <= t < last: gaussians[place] = k, and the places of each k in `slots`, unless
    that is empty."""
    chunks, n = places.shape[0], sketch.shape[0]
    size = -(-n // chunks)
    row0, row1 = first // tiles_x, (last - 1) // tiles_x
    for chunk in range(begin, end):
        for k in range(chunk * size, min((chunk + 1) * size, n)):
            x0, x1, y0, y1 = _box(sketch, k, tile, tiles_x, tiles_y)
            plain = x0 == x1 or y0 == y1
            slot = offsets[k]
            for ty in range(max(y0, row0), min(y1, row1) + 1):
                left, right = (x0, x1) if plain else _columns(sketch, k, ty, tile, tiles_x)
                for t in range(max(ty * tiles_x + left, first), min(ty * tiles_x + right + 1, last)):
                    place = places[chunk, t]
                    places[chunk, t] = place + 1
                    gaussians[place] = k
                    if slots.size > 0:
                        slots[slot] = place
                        slot += 1
