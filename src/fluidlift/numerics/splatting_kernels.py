"""The compiled loops of `splatting` (Numba), with their constants. See there for conventions and sources.

How it is fast: a picture is cut into tiles of 16 x 16. Gaussians are sorted by depth once and dealt to the tiles in
that order. Within a tile, each row of a Gaussian is a loop of 16 lanes without branches over one flat buffer, which
compiles to SIMD. The backward pass runs in the same front-to-back order: what lies behind Gaussian i is the finished
pixel minus what has been composited so far. It writes one record per pair of tile and Gaussian and sums records per
Gaussian afterwards: no atomics, the same bits on every run.
"""

from __future__ import annotations

import numba as nb
import numpy as np

BLUR = 0.3
"""px^2 added to the diagonal of a 2D covariance"""
ALPHA_MAX = 0.999
ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4
TILE = 16
_SAFE = {"reassoc", "contract", "arcp", "nsz"}  # reorders sums, but keeps NaN and infinity checks


@nb.njit(cache=True, inline="always")
def _exp_negative(p):
    """exp(-p) for 0 <= p <= 6, relative error below 1e-6: a Taylor polynomial of p/16, squared four times."""
    q = p * np.float32(-0.0625)
    e = np.float32(1.0 / 120.0)
    e = e * q + np.float32(1.0 / 24.0)
    e = e * q + np.float32(1.0 / 6.0)
    e = e * q + np.float32(0.5)
    e = e * q + np.float32(1.0)
    e = e * q + np.float32(1.0)
    e = e * e
    e = e * e
    e = e * e
    return e * e


@nb.njit(cache=True)
def _camera_covariance(view, quats, scales, i, r, m, s):
    """Rotation `r` of Gaussian i, half matrix `m` = W r diag(scale), camera covariance `s` = m m^T; all 3x3."""
    qw, qx, qy, qz = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    k = np.float32(1.0) / max(np.sqrt(qw * qw + qx * qx + qy * qy + qz * qz), np.float32(1e-12))
    qw, qx, qy, qz = qw * k, qx * k, qy * k, qz * k
    r[0, 0], r[0, 1], r[0, 2] = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)
    r[1, 0], r[1, 1], r[1, 2] = 2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)
    r[2, 0], r[2, 1], r[2, 2] = 2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)
    for a in range(3):
        for b in range(3):
            m[a, b] = (view[3 * a] * r[0, b] + view[3 * a + 1] * r[1, b] + view[3 * a + 2] * r[2, b]) * scales[i, b]
    for a in range(3):
        for b in range(3):
            s[a, b] = m[a, 0] * m[b, 0] + m[a, 1] * m[b, 1] + m[a, 2] * m[b, 2]


@nb.njit(cache=True)
def _tangent(view, x, z, axis):
    """x/z, held within the picture and 0.3 of half its width beyond (gsplat), and whether it was held."""
    size, focal, center = view[16 + axis], view[12 + axis], view[14 + axis]
    margin = np.float32(0.15) * size / focal
    t = x / z
    low, high = -center / focal - margin, (size - center) / focal + margin
    held = min(max(t, low), high)
    return held, t < low or t > high


@nb.njit(cache=True, parallel=True, error_model="numpy")
def project_kernel(view, means, quats, scales, opacities, uv, conics, depths, extents):
    for i0 in nb.prange(means.shape[0]):
        i = np.int64(i0)
        x = view[0] * means[i, 0] + view[1] * means[i, 1] + view[2] * means[i, 2] + view[9]
        y = view[3] * means[i, 0] + view[4] * means[i, 1] + view[5] * means[i, 2] + view[10]
        z = view[6] * means[i, 0] + view[7] * means[i, 1] + view[8] * means[i, 2] + view[11]
        uv[i, 0], uv[i, 1], depths[i] = 0, 0, z
        conics[i, 0], conics[i, 1], conics[i, 2] = 1, 0, 1
        extents[i, 0], extents[i, 1] = 0, 0
        o = opacities[i]
        # comparisons with NaN are False, so that a Gaussian with any NaN stays undrawn
        if not (z > view[18] and z < np.float32(1e12) and o > np.float32(ALPHA_MIN)):
            continue
        r, m, s = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
        _camera_covariance(view, quats, scales, i, r, m, s)
        fx, fy = view[12] / z, view[13] / z
        tx, _ = _tangent(view, x, z, 0)
        ty, _ = _tangent(view, y, z, 1)
        a = fx * fx * (s[0, 0] - 2 * tx * s[0, 2] + tx * tx * s[2, 2]) + np.float32(BLUR)
        b = fx * fy * (s[0, 1] - tx * s[1, 2] - ty * s[0, 2] + tx * ty * s[2, 2])
        c = fy * fy * (s[1, 1] - 2 * ty * s[1, 2] + ty * ty * s[2, 2]) + np.float32(BLUR)
        det = a * c - b * b
        u, v = fx * x + view[14], fy * y + view[15]
        reach = np.sqrt(2 * np.log(min(o, np.float32(1.0)) * np.float32(255.0)))
        hx, hy = reach * np.sqrt(a), reach * np.sqrt(c)
        if not (det > np.float32(1e-12) * a * c and a + c < np.float32(1e12)):
            continue
        if not (u + hx > 0 and u - hx < view[16] and v + hy > 0 and v - hy < view[17]):
            continue
        uv[i, 0], uv[i, 1] = u, v
        conics[i, 0], conics[i, 1], conics[i, 2] = c / det, -b / det, a / det
        extents[i, 0], extents[i, 1] = hx, hy


@nb.njit(cache=True, parallel=True, error_model="numpy")
def project_backward_kernel(view, means, quats, scales, conics, extents, g_uv, g_conics, g_means, g_quats, g_scales):
    for i0 in nb.prange(means.shape[0]):
        i = np.int64(i0)
        if extents[i, 0] <= 0:
            continue
        x = view[0] * means[i, 0] + view[1] * means[i, 1] + view[2] * means[i, 2] + view[9]
        y = view[3] * means[i, 0] + view[4] * means[i, 1] + view[5] * means[i, 2] + view[10]
        z = view[6] * means[i, 0] + view[7] * means[i, 1] + view[8] * means[i, 2] + view[11]
        r, m, s = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
        _camera_covariance(view, quats, scales, i, r, m, s)
        fx, fy = view[12] / z, view[13] / z
        tx, held_x = _tangent(view, x, z, 0)
        ty, held_y = _tangent(view, y, z, 1)
        # inverse: d cov = -conic (d conic) conic, with the off-diagonal entry counted twice
        p, q, w = conics[i, 0], conics[i, 1], conics[i, 2]
        gp, gq, gw = g_conics[i, 0], g_conics[i, 1], g_conics[i, 2]
        ga = -(p * p * gp + p * q * gq + q * q * gw)
        gb = -(2 * p * q * gp + (p * w + q * q) * gq + 2 * q * w * gw)
        gc = -(q * q * gp + q * w * gq + w * w * gw)
        # cov = J s J^T with rows j1 = fx (1, 0, -tx), j2 = fy (0, 1, -ty)
        xs0, xs1, xs2 = s[0, 0] - tx * s[0, 2], s[0, 1] - tx * s[1, 2], s[0, 2] - tx * s[2, 2]
        ys1, ys2 = s[1, 1] - ty * s[1, 2], s[1, 2] - ty * s[2, 2]
        xx, xy, yy = xs0 - tx * xs2, xs1 - ty * xs2, ys1 - ty * ys2
        g_fx = 2 * fx * xx * ga + fy * xy * gb
        g_fy = 2 * fy * yy * gc + fx * xy * gb
        g_tx = -2 * fx * fx * xs2 * ga - fx * fy * ys2 * gb
        g_ty = -2 * fy * fy * ys2 * gc - fx * fy * xs2 * gb
        # u = fx x + cx, with fx = focal / z; t = x / z unless held
        gx, gy = fx * g_uv[i, 0], fy * g_uv[i, 1]
        g_fx += x * g_uv[i, 0]
        g_fy += y * g_uv[i, 1]
        gz = -(fx * g_fx + fy * g_fy) / z
        if not held_x:
            gx += g_tx / z
            gz -= tx * g_tx / z
        if not held_y:
            gy += g_ty / z
            gz -= ty * g_ty / z
        for k in range(3):
            g_means[i, k] = view[k] * gx + view[3 + k] * gy + view[6 + k] * gz
        # s = m m^T: g_m = (G + G^T) m, where G is the gradient of the quadratic form in s
        e00, e11, e01 = fx * fx * ga, fy * fy * gc, fx * fy * gb
        e02, e12 = -2 * e00 * tx - e01 * ty, -2 * e11 * ty - e01 * tx
        e22 = e00 * tx * tx + e11 * ty * ty + e01 * tx * ty
        gr = np.empty((3, 3), np.float32)
        for b in range(3):
            m0 = 2 * e00 * m[0, b] + e01 * m[1, b] + e02 * m[2, b]
            m1 = e01 * m[0, b] + 2 * e11 * m[1, b] + e12 * m[2, b]
            m2 = e02 * m[0, b] + e12 * m[1, b] + 2 * e22 * m[2, b]
            total = np.float32(0)
            for a in range(3):
                d = view[a] * m0 + view[3 + a] * m1 + view[6 + a] * m2
                total += d * r[a, b]
                gr[a, b] = d * scales[i, b]
            g_scales[i, b] = total
        _quat_backward(quats, i, gr, g_quats)


@nb.njit(cache=True)
def _quat_backward(quats, i, g, g_quats):
    """Gradient of a quaternion that is normalised before use, from that of its rotation matrix."""
    qw, qx, qy, qz = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    k = np.float32(1.0) / max(np.sqrt(qw * qw + qx * qx + qy * qy + qz * qz), np.float32(1e-12))
    qw, qx, qy, qz = qw * k, qx * k, qy * k, qz * k
    gw = 2 * (qx * (g[2, 1] - g[1, 2]) + qy * (g[0, 2] - g[2, 0]) + qz * (g[1, 0] - g[0, 1]))
    gx = 2 * (qy * (g[0, 1] + g[1, 0]) + qz * (g[0, 2] + g[2, 0]) + qw * (g[2, 1] - g[1, 2])) - 4 * qx * (
        g[1, 1] + g[2, 2]
    )
    gy = 2 * (qx * (g[0, 1] + g[1, 0]) + qz * (g[1, 2] + g[2, 1]) + qw * (g[0, 2] - g[2, 0])) - 4 * qy * (
        g[0, 0] + g[2, 2]
    )
    gz = 2 * (qx * (g[0, 2] + g[2, 0]) + qy * (g[1, 2] + g[2, 1]) + qw * (g[1, 0] - g[0, 1])) - 4 * qz * (
        g[0, 0] + g[1, 1]
    )
    along = qw * gw + qx * gx + qy * gy + qz * gz
    g_quats[i, 0], g_quats[i, 1] = k * (gw - along * qw), k * (gx - along * qx)
    g_quats[i, 2], g_quats[i, 3] = k * (gy - along * qy), k * (gz - along * qz)


@nb.njit(cache=True)
def bin_kernel(uv, extents, order, tiles_x, tiles_y, starts, offsets, gaussians, slots, fill):
    """Count (fill = False) or deal out (fill = True) the pairs of tile and Gaussian."""
    total = 0
    for k in range(order.shape[0]):
        i = order[k]
        x0 = max(0, int((uv[i, 0] - extents[i, 0]) // TILE))
        x1 = min(tiles_x - 1, int((uv[i, 0] + extents[i, 0]) // TILE))
        y0 = max(0, int((uv[i, 1] - extents[i, 1]) // TILE))
        y1 = min(tiles_y - 1, int((uv[i, 1] + extents[i, 1]) // TILE))
        offsets[k] = total
        for ty in range(y0, y1 + 1):
            for tx in range(x0, x1 + 1):
                t = ty * tiles_x + tx
                if fill:
                    gaussians[starts[t]] = i
                    slots[total] = starts[t]
                starts[t] += 1
                total += 1
    offsets[order.shape[0]] = total
    return total


# Layout of the flat buffer of a tile, in float32: 256 transmittances, 256 flags, 256 remainders (backward),
# lanes of one row (16 each), then 256 values per channel.
_LIVE, _REST, _ROW, _SUM = 256, 512, 768, 896


@nb.njit(cache=True, inline="always")
def _row_alpha(buf, row, dx0, dy, a, b, c, o):
    """Alpha, weight and falloff of one Gaussian over the 16 pixels of a row; moves the transmittance on."""
    half_a, bend, rise = np.float32(0.5) * a, b * dy, np.float32(0.5) * c * dy * dy
    for lane in range(np.uint64(16)):
        dx = np.float32(np.int32(lane)) + dx0
        p = (half_a * dx + bend) * dx + rise
        p = min(max(p, np.float32(0.0)), np.float32(6.0))
        raw = o * _exp_negative(p)
        alpha = min(raw, np.float32(ALPHA_MAX))
        alpha = alpha if raw >= np.float32(ALPHA_MIN) else np.float32(0.0)
        t = buf[row + lane]
        live = buf[row + np.uint64(_LIVE) + lane]
        live = live if t * (np.float32(1.0) - alpha) > np.float32(TRANSMITTANCE_MIN) else np.float32(0.0)
        w = alpha * t * live
        buf[row + lane] = t - w
        buf[row + np.uint64(_LIVE) + lane] = live
        buf[np.uint64(_ROW) + lane] = w


@nb.njit(cache=True, parallel=True, fastmath=_SAFE, error_model="numpy")
def raster_kernel(uv, conics, opacities, features, extents, starts, gaussians, width, height, stride, image, light):
    tiles_x = (width + TILE - 1) // TILE
    tiles = starts.shape[0] - 1
    channels = np.uint64(features.shape[1])
    for k0 in nb.prange(tiles):
        tile = (np.int64(k0) * stride) % tiles  # scattered, so that every thread gets dense and empty tiles
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        buf = np.zeros(_SUM + 256 * features.shape[1], np.float32)
        buf[:512] = 1.0
        for n in range(starts[tile], starts[tile + 1]):
            i = gaussians[n]
            if (n - starts[tile]) % 32 == 31:
                alive = np.float32(0.0)
                for j in range(256):
                    alive += buf[_LIVE + j]
                if alive == 0:
                    break
            dx0 = np.float32(x0) + np.float32(0.5) - uv[i, 0]
            first = max(0, int(np.ceil(uv[i, 1] - extents[i, 1] - np.float32(0.5))) - y0)
            last = min(TILE - 1, int(np.floor(uv[i, 1] + extents[i, 1] - np.float32(0.5))) - y0)
            for r in range(first, last + 1):
                dy = np.float32(y0 + r) + np.float32(0.5) - uv[i, 1]
                row = np.uint64(r * 16)
                _row_alpha(buf, row, dx0, dy, conics[i, 0], conics[i, 1], conics[i, 2], opacities[i])
                for ch in range(channels):
                    f = features[i, ch]
                    base = np.uint64(_SUM) + ch * np.uint64(256) + row
                    for lane in range(np.uint64(16)):
                        buf[base + lane] += buf[np.uint64(_ROW) + lane] * f
        for r in range(min(TILE, height - y0)):
            for j in range(min(TILE, width - x0)):
                light[y0 + r, x0 + j] = buf[r * 16 + j]
                for ch in range(features.shape[1]):
                    image[y0 + r, x0 + j, ch] = buf[_SUM + ch * 256 + r * 16 + j]


@nb.njit(cache=True, parallel=True, fastmath=_SAFE, error_model="numpy")
def raster_backward_kernel(
    uv, conics, opacities, features, extents, starts, gaussians, stride, image, light, g_image, g_light, records
):
    """One record per pair: sums of v, v dx, v dx^2, v dy, v dx dy, v dy^2 (v = dL/dp), then of w g per channel."""
    height, width = light.shape
    tiles_x = (width + TILE - 1) // TILE
    tiles = starts.shape[0] - 1
    channels = np.uint64(features.shape[1])
    for k0 in nb.prange(tiles):
        tile = (np.int64(k0) * stride) % tiles
        x0, y0 = (tile % tiles_x) * TILE, (tile // tiles_x) * TILE
        buf = np.zeros(_SUM + 256 * features.shape[1], np.float32)
        buf[:256] = 1.0
        for r in range(min(TILE, height - y0)):
            for j in range(min(TILE, width - x0)):
                rest = g_light[y0 + r, x0 + j] * light[y0 + r, x0 + j]
                for ch in range(features.shape[1]):
                    g = g_image[y0 + r, x0 + j, ch]
                    buf[_SUM + ch * 256 + r * 16 + j] = g
                    rest += g * image[y0 + r, x0 + j, ch]
                buf[_REST + r * 16 + j] = rest
                buf[_LIVE + r * 16 + j] = 1.0
        for n in range(starts[tile], starts[tile + 1]):
            i = gaussians[n]
            if (n - starts[tile]) % 32 == 31:
                alive = np.float32(0.0)
                for j in range(256):
                    alive += buf[_LIVE + j]
                if alive == 0:
                    break
            dx0 = np.float32(x0) + np.float32(0.5) - uv[i, 0]
            first = max(0, int(np.ceil(uv[i, 1] - extents[i, 1] - np.float32(0.5))) - y0)
            last = min(TILE - 1, int(np.floor(uv[i, 1] + extents[i, 1] - np.float32(0.5))) - y0)
            for r in range(first, last + 1):
                dy = np.float32(y0 + r) + np.float32(0.5) - uv[i, 1]
                row = np.uint64(r * 16)
                for lane in range(np.uint64(16)):
                    buf[np.uint64(_ROW + 16) + lane] = buf[row + lane]
                    buf[np.uint64(_ROW + 32) + lane] = np.float32(0.0)
                _row_alpha(buf, row, dx0, dy, conics[i, 0], conics[i, 1], conics[i, 2], opacities[i])
                for ch in range(channels):
                    f = features[i, ch]
                    base = np.uint64(_SUM) + ch * np.uint64(256) + row
                    total = np.float32(0.0)
                    for lane in range(np.uint64(16)):
                        g = buf[base + lane]
                        buf[np.uint64(_ROW + 32) + lane] += g * f
                        total += g * buf[np.uint64(_ROW) + lane]
                    records[n, np.uint64(6) + ch] += total
                s0, s1, s2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                for lane in range(np.uint64(16)):
                    w = buf[np.uint64(_ROW) + lane]
                    t = buf[np.uint64(_ROW + 16) + lane]
                    seen = buf[np.uint64(_ROW + 32) + lane]
                    rest = buf[row + np.uint64(_REST) + lane] - w * seen
                    buf[row + np.uint64(_REST) + lane] = rest
                    # dL/dalpha = T g.f - rest / (1 - alpha); times alpha, in terms of w = alpha T and T - w
                    v = w * (rest / (t - w) - seen)
                    # clamped alpha does not move with its Gaussian
                    v = v if w < np.float32(ALPHA_MAX) * t else np.float32(0.0)
                    dx = np.float32(np.int32(lane)) + dx0
                    s0 += v
                    s1 += v * dx
                    s2 += v * dx * dx
                records[n, 0] += s0
                records[n, 1] += s1
                records[n, 2] += s2
                records[n, 3] += s0 * dy
                records[n, 4] += s1 * dy
                records[n, 5] += s0 * dy * dy


@nb.njit(cache=True, parallel=True, error_model="numpy")
def gather_kernel(conics, opacities, order, offsets, slots, records, g_uv, g_conics, g_opacities, g_features):
    """Sum the records of every Gaussian and turn them into gradients."""
    for k0 in nb.prange(order.shape[0]):
        k = np.int64(k0)
        i = order[k]
        total = np.zeros(records.shape[1], np.float32)
        for n in range(offsets[k], offsets[k + 1]):
            for j in range(records.shape[1]):
                total[j] += records[slots[n], j]
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        g_uv[i, 0] = -(a * total[1] + b * total[3])
        g_uv[i, 1] = -(b * total[1] + c * total[3])
        g_conics[i, 0] = np.float32(0.5) * total[2]
        g_conics[i, 1] = total[4]
        g_conics[i, 2] = np.float32(0.5) * total[5]
        g_opacities[i] = -total[0] / opacities[i]
        for j in range(g_features.shape[1]):
            g_features[i, j] = total[6 + j]
