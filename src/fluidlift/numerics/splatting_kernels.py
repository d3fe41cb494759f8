"""The compiled loops over pixels of `splatting` (Numba), with their constants. See there for conventions and sources.

How it is fast: a picture is cut into square tiles. Within a tile a row is dealt with 16 pixels at a time, in one loop
of 16 lanes without branches that compiles to SIMD: falloff, alpha, weight and the first four channels. All that such a
group of pixels needs lies side by side in one block of a flat buffer: the distances between loads and stores are
constants, so that the compiler need not guard against overlaps. A finished pixel keeps its light with the sign
turned. The backward pass runs in the same front-to-back order: what lies behind Gaussian i is the finished pixel minus
what has been composited so far. It writes one record per pair of tile and Gaussian, and sums records per Gaussian
afterwards: no atomics, the same bits on every run and with any number of threads.

The loops take float32 or, for exact comparisons, float64. Positions are those of the pixel, not of the tile, and no sum
over Gaussians is reordered: a picture has the same bits for any size of tile.
"""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numba.extending import overload

from fluidlift.numerics.sharing import PIECES, shared
from fluidlift.numerics.splatting_binning import LEAD
from fluidlift.numerics.splatting_projection import ALPHA_MIN, BLUR

__all__ = ["ALPHA_MAX", "ALPHA_MIN", "BLUR", "TILE", "TRANSMITTANCE_MIN", "WIDE_TILE"]

ALPHA_MAX = np.float32(0.999)
TRANSMITTANCE_MIN = np.float32(1e-4)
TILE = 16
"""px, width and height of a tile unless asked otherwise"""
WIDE_TILE = 32
"""px, of pictures that are only looked at: lists are half as long, and Gaussians are fetched less often. Gradients are
written per tile and Gaussian, and are faster with the smaller ones"""
LANES = 16
BATCH = 16
"""Gaussians of a tile that are fetched together; between two batches it is checked which of its rows are finished"""
SUMS = 6
"""numbers of a record before those of the features"""
_FALLOFF_MAX = np.float32(6.0)  # exp(-6) is under the cut
_FUSED = {"contract"}  # multiply-add in one; sums are not reordered
_C1, _C2, _C3 = np.float32(0.99999472), np.float32(0.49989989), np.float32(0.16603111)
_C4, _C5 = np.float32(0.03985597), np.float32(0.00589132)


def exp_negative(p):
    """exp(-p) for 0 <= p <= ln 255, the largest that counts."""
    return np.exp(-p)


@overload(exp_negative, inline="always")
def _exp_negative_compiled(p):
    if p == nb.float64:
        return lambda p: math.exp(-p)

    def polynomial(p):
        # exp(-p / 8), least squares of the relative error with 1 at 0, raised to the eighth power: good to 3e-6
        q = p * np.float32(-0.125)
        e = _C5 * q + _C4
        e = e * q + _C3
        e = e * q + _C2
        e = e * q + _C1
        e = e * q + np.float32(1.0)
        e = e * e
        e = e * e
        return e * e

    return polynomial


@nb.njit(cache=True, inline="always")
def _alive(buf, tile, groups, size, rows):
    """First and last row of a tile with a pixel that still takes light (the last is smaller if none has), and whether
    each of its `rows` has one. Rows that had none are not looked at again."""
    first, last = tile, -1
    for r in range(tile):
        if not rows[r]:
            continue
        takes = False
        for g in range(groups):
            base = np.uint64((r * groups + g) * size)
            for lane in range(np.uint64(LANES)):
                if buf[base + lane] > 0:
                    takes = True
                    break
            if takes:
                break
        rows[r] = takes
        if takes:
            first, last = min(first, r), r
    return first, last


@nb.njit(cache=True)
def _fetch(packed, gaussians, begin, end, near):
    """Copy the next Gaussians of a tile's list together: one by one, each would wait for memory."""
    for n in range(begin, end):
        k, m = gaussians[n], n - begin
        for c in range(LEAD + 4):  # as many at least, without a loop
            near[m, c] = packed[k, c]
        for c in range(LEAD + 4, packed.shape[1]):
            near[m, c] = packed[k, c]


@nb.njit(cache=True, inline="always")
def _span(packed, k, x0, y0, tile):
    """Rows first..last of a tile that the ellipse of Gaussian k meets, and groups of lanes first..last that its box
    holds.

    As for the columns of a row of tiles (`splatting_binning`), with the axes exchanged: the ellipse's upper edge is a
    concave function of dx, whose highest point within the tile is that of the whole ellipse or at one of its sides.
    """
    u, v, a, b, c = packed[k, 0], packed[k, 1], packed[k, 2], packed[k, 3], packed[k, 4]
    hy, hx = packed[k, 6], packed[k, 7]
    half, one, zero = packed.dtype.type(0.5), packed.dtype.type(1.0), packed.dtype.type(0.0)
    lean, peak = -half * b / c, -half * b / a * hy
    width, inverse = math.sqrt(max(hy * hy - lean * lean * hx * hx, zero)), one / hx
    left = np.float32(x0) + half - u
    low, high = max(left, -hx), min(left + np.float32(tile - 1), hx)
    xt, xb = min(max(peak, low), high), min(max(-peak, low), high)
    slack = packed.dtype.type(0.01) + packed.dtype.type(1e-3) * hy  # more than the rounding of `width`, a difference
    top = lean * xt + width * math.sqrt(max(one - (xt * inverse) * (xt * inverse), zero))
    bottom = lean * xb - width * math.sqrt(max(one - (xb * inverse) * (xb * inverse), zero))
    r0 = max(0, int(math.ceil(v + max(bottom - slack, -hy) - half)) - y0)
    r1 = min(tile - 1, int(math.floor(v + min(top + slack, hy) - half)) - y0)
    g1 = (tile - 1) // LANES
    if g1 == 0:
        return r0, r1, 0, 0
    return (
        r0,
        r1,
        max(0, int(math.ceil(u - hx - half)) - x0) // LANES,
        min(g1, (int(math.floor(u + hx - half)) - x0) // LANES),
    )


@shared(
    lambda packed, starts, gaussians, first, last, *_: (0, last - first),
    fastmath=_FUSED,
    error_model="numpy",
    pieces=PIECES,
)
def raster_kernel(lead, stop, packed, starts, gaussians, first, last, tile, stride, image, apart, light):
    """Tiles first <= t < last of the picture; where nothing is, the pictures stay as they were. `apart` takes the
    channel after those of `image`, unless it is empty. Block of 16 pixels: light, weights, then 16 per channel."""
    height, width = light.shape
    tiles_x = (width + tile - 1) // tile
    groups = (tile + LANES - 1) // LANES
    channels = packed.shape[1] - LEAD
    size = (2 + channels) * LANES
    more = np.uint64(channels)
    one = packed.dtype.type(1.0)
    for t0 in range(lead, stop):
        t = first + (t0 * stride) % (last - first)  # scattered: every thread gets dense and empty tiles
        x0, y0 = (t % tiles_x) * tile, (t // tiles_x) * tile
        begin, end = starts[t] - starts[first], starts[t + 1] - starts[first]
        rows, columns = min(tile, height - y0), min(tile, width - x0)
        if begin == end:
            continue
        buf = np.zeros(tile * groups * size, packed.dtype)
        for r in range(rows):
            for j in range(columns):
                buf[(r * groups + j // LANES) * size + j % LANES] = one
        near, alive, top, bottom = np.empty((BATCH, packed.shape[1]), packed.dtype), np.ones(tile, np.bool_), 0, tile
        for n in range(begin, end):
            k = (n - begin) % BATCH
            if k == 0:
                if n > begin:
                    top, bottom = _alive(buf, tile, groups, size, alive)
                    if top > bottom:
                        break
                _fetch(packed, gaussians, n, min(n + BATCH, end), near)
            r0, r1, g0, g1 = _span(near, k, x0, y0, tile)
            u, v, a, b, c, o = near[k, 0], near[k, 1], near[k, 2], near[k, 3], near[k, 4], near[k, 5]
            f0, f1, f2, f3 = near[k, LEAD], near[k, LEAD + 1], near[k, LEAD + 2], near[k, LEAD + 3]
            for g in range(g0, g1 + 1):
                px = np.float32(x0 + g * LANES) + np.float32(0.5)
                for r in range(max(r0, top), min(r1, bottom) + 1):
                    if not alive[r]:
                        continue
                    dy = np.float32(y0 + r) + np.float32(0.5) - v
                    bend, rise = b * dy, c * dy * dy
                    base = np.uint64((r * groups + g) * size)
                    for lane in range(np.uint64(LANES)):
                        dx = np.float32(np.int32(lane)) + px - u
                        p = (a * dx + bend) * dx + rise
                        raw = o * exp_negative(min(max(p, np.float32(0.0)), _FALLOFF_MAX))
                        alpha = min(raw, ALPHA_MAX) if raw >= ALPHA_MIN else np.float32(0.0)
                        kept = buf[base + lane]
                        passed = max(kept, np.float32(0.0))
                        w = alpha * passed
                        rest = passed - w
                        goes_on = rest > TRANSMITTANCE_MIN
                        w = w if goes_on else np.float32(0.0)
                        buf[base + lane] = rest if goes_on else -abs(kept)
                        buf[base + np.uint64(16) + lane] = w
                        buf[base + np.uint64(32) + lane] += w * f0
                        buf[base + np.uint64(48) + lane] += w * f1
                        buf[base + np.uint64(64) + lane] += w * f2
                        buf[base + np.uint64(80) + lane] += w * f3
                    for ch in range(np.uint64(4), more):
                        f = near[k, np.uint64(LEAD) + ch]
                        at = base + (np.uint64(2) + ch) * np.uint64(LANES)
                        for lane in range(np.uint64(LANES)):
                            buf[at + lane] += buf[base + np.uint64(16) + lane] * f
        for r in range(rows):
            for j in range(columns):
                at = (r * groups + j // LANES) * size + j % LANES
                light[y0 + r, x0 + j] = abs(buf[at])
                for ch in range(image.shape[2]):
                    image[y0 + r, x0 + j, ch] = buf[at + (2 + ch) * LANES]
                if apart.size > 0:
                    apart[y0 + r, x0 + j] = buf[at + (2 + image.shape[2]) * LANES]


@nb.njit(cache=True, fastmath={"reassoc", "contract"})
def _sum(buf, at):
    total = buf.dtype.type(0.0)
    for lane in range(np.uint64(LANES)):
        total += buf[at + lane]
    return total


@nb.njit(cache=True, fastmath={"reassoc", "contract"})
def _moments(buf, at, shift):
    """Sums over lanes of x and x^2 times the buffer, x = lane + shift."""
    first, second = buf.dtype.type(0.0), buf.dtype.type(0.0)
    for lane in range(np.uint64(LANES)):
        dx = np.float32(np.int32(lane)) + shift
        first += buf[at + lane] * dx
        second += buf[at + lane] * dx * dx
    return first, second


@nb.njit(cache=True, inline="always")
def _backward_block(buf, base, sums, packed, k, dy, px):
    """16 pixels of one Gaussian: moves light and remainder on, and adds to the lanes' sums."""
    u, a, b, c, o = packed[k, 0], packed[k, 2], packed[k, 3], packed[k, 4], packed[k, 5]
    f0, f1, f2, f3 = packed[k, LEAD], packed[k, LEAD + 1], packed[k, LEAD + 2], packed[k, LEAD + 3]
    more = np.uint64(packed.shape[1] - LEAD)
    bend, rise = b * dy, c * dy * dy
    if more > np.uint64(4):
        for lane in range(np.uint64(LANES)):
            buf[base + np.uint64(48) + lane] = np.float32(0.0)
        for ch in range(np.uint64(4), more):
            f = packed[k, np.uint64(LEAD) + ch]
            at = base + (np.uint64(4) + ch) * np.uint64(LANES)
            for lane in range(np.uint64(LANES)):
                buf[base + np.uint64(48) + lane] += buf[at + lane] * f
    for lane in range(np.uint64(LANES)):
        dx = np.float32(np.int32(lane)) + px - u
        p = (a * dx + bend) * dx + rise
        raw = o * exp_negative(min(max(p, np.float32(0.0)), _FALLOFF_MAX))
        alpha = min(raw, ALPHA_MAX) if raw >= ALPHA_MIN else np.float32(0.0)
        kept = buf[base + lane]
        passed = max(kept, np.float32(0.0))
        w = alpha * passed
        rest = passed - w
        goes_on = rest > TRANSMITTANCE_MIN
        w = w if goes_on else np.float32(0.0)
        buf[base + lane] = rest if goes_on else -abs(kept)
        g0, g1 = buf[base + np.uint64(64) + lane], buf[base + np.uint64(80) + lane]
        g2, g3 = buf[base + np.uint64(96) + lane], buf[base + np.uint64(112) + lane]
        seen = buf[base + np.uint64(48) + lane] + g0 * f0 + g1 * f1 + g2 * f2 + g3 * f3
        behind = buf[base + np.uint64(16) + lane] - w * seen
        buf[base + np.uint64(16) + lane] = behind
        buf[base + np.uint64(32) + lane] = w
        # -alpha dL/dalpha, dL/dalpha = T g.f - behind / (1 - alpha); a clamped alpha does not move with its Gaussian
        v = w * (behind / max(rest, TRANSMITTANCE_MIN) - seen)
        v = v if raw <= ALPHA_MAX else np.float32(0.0)
        sums[lane] += v
        sums[np.uint64(16) + lane] += v * dy
        sums[np.uint64(32) + lane] += v * dy * dy
        sums[np.uint64(48) + lane] += w * g0
        sums[np.uint64(64) + lane] += w * g1
        sums[np.uint64(80) + lane] += w * g2
        sums[np.uint64(96) + lane] += w * g3
    for ch in range(np.uint64(4), more):
        at, to = base + (np.uint64(4) + ch) * np.uint64(LANES), (np.uint64(3) + ch) * np.uint64(LANES)
        for lane in range(np.uint64(LANES)):
            sums[to + lane] += buf[base + np.uint64(32) + lane] * buf[at + lane]


@nb.njit(cache=True, inline="always")
def _load_tile(buf, size, groups, tile, x0, y0, image, light, g_image, g_light):
    """Light 1, what is behind the front of the tile's pixels (times the gradients), and the gradients."""
    height, width, channels = image.shape
    for r in range(min(tile, height - y0)):
        for j in range(min(tile, width - x0)):
            at = (r * groups + j // LANES) * size + j % LANES
            rest = g_light[y0 + r, x0 + j] * light[y0 + r, x0 + j]
            for ch in range(channels):
                g = g_image[y0 + r, x0 + j, ch]
                buf[at + (4 + ch) * LANES] = g
                rest += g * image[y0 + r, x0 + j, ch]
            buf[at] = np.float32(1.0)
            buf[at + LANES] = rest


@shared(
    lambda packed, starts, gaussians, first, last, *_: (0, last - first),
    fastmath=_FUSED,
    error_model="numpy",
    pieces=PIECES,
)
def raster_backward_kernel(
    lead, stop, packed, starts, gaussians, first, last, tile, stride, image, light, g_image, g_light, records
):
    """One record per pair: sums of v, v dx, v dx^2, v dy, v dx dy, v dy^2 (v = dL/dp), then of w g per channel.

    Block of 16 pixels: light, what is behind, weights, g.f of the channels from the fifth on, gradients per channel.
    """
    width = light.shape[1]
    tiles_x = (width + tile - 1) // tile
    groups = (tile + LANES - 1) // LANES
    channels = packed.shape[1] - LEAD
    size = (4 + channels) * LANES
    for t0 in range(lead, stop):
        t = first + (t0 * stride) % (last - first)
        x0, y0 = (t % tiles_x) * tile, (t // tiles_x) * tile
        buf = np.zeros(tile * groups * size, packed.dtype)
        sums = np.zeros((3 + channels) * LANES, packed.dtype)
        _load_tile(buf, size, groups, tile, x0, y0, image, light, g_image, g_light)
        near, alive = np.empty((BATCH, packed.shape[1]), packed.dtype), np.ones(tile, np.bool_)
        begin, end = starts[t] - starts[first], starts[t + 1] - starts[first]
        top, bottom = 0, tile
        for pair in range(begin, end):
            k = (pair - begin) % BATCH
            if k == 0:
                if pair > begin:
                    top, bottom = _alive(buf, tile, groups, size, alive)
                    if top > bottom:
                        break
                _fetch(packed, gaussians, pair, min(pair + BATCH, end), near)
            r0, r1, g0, g1 = _span(near, k, x0, y0, tile)
            for g in range(g0, g1 + 1):
                px = np.float32(x0 + g * LANES) + np.float32(0.5)
                sums[:] = 0
                for r in range(max(r0, top), min(r1, bottom) + 1):
                    if not alive[r]:
                        continue
                    dy = np.float32(y0 + r) + np.float32(0.5) - near[k, 1]
                    _backward_block(buf, np.uint64((r * groups + g) * size), sums, near, k, dy, px)
                shift = px - near[k, 0]
                one, two = _moments(sums, np.uint64(0), shift)
                cross, _ = _moments(sums, np.uint64(16), shift)
                records[pair, 0] += _sum(sums, np.uint64(0))
                records[pair, 1] += one
                records[pair, 2] += two
                records[pair, 3] += _sum(sums, np.uint64(16))
                records[pair, 4] += cross
                records[pair, 5] += _sum(sums, np.uint64(32))
                for ch in range(records.shape[1] - SUMS):
                    records[pair, SUMS + ch] += _sum(sums, np.uint64((3 + ch) * LANES))


@shared(lambda packed, order, *_: (0, order.shape[0]), error_model="numpy")
def gather_kernel(begin, end, packed, order, offsets, slots, records, g_uv, g_conics, g_opacities, g_features):
    """Sum the records of every Gaussian and add them, turned into gradients."""
    for k in range(begin, end):
        if offsets[k] == offsets[k + 1]:
            continue
        i = order[k]
        total = np.zeros(records.shape[1], packed.dtype)
        for n in range(offsets[k], offsets[k + 1]):
            for j in range(records.shape[1]):
                total[j] += records[slots[n], j]
        a, b, c = packed[k, 2] + packed[k, 2], packed[k, 3], packed[k, 4] + packed[k, 4]
        g_uv[i, 0] -= a * total[1] + b * total[3]
        g_uv[i, 1] -= b * total[1] + c * total[3]
        g_conics[i, 0] += np.float32(0.5) * total[2]
        g_conics[i, 1] += total[4]
        g_conics[i, 2] += np.float32(0.5) * total[5]
        g_opacities[i] -= total[0] / packed[k, 5]
        for j in range(g_features.shape[1]):
            g_features[i, j] += total[SUMS + j]
