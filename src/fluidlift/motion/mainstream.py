"""Mainstream correction (paper: section on fluid surface velocity): motion where optical flow failed.

First the direction of the bulk flow everywhere on the screen, then the neighbours' motion along that direction
fills the failed pixels; last a projection makes the filled motion consistent with an incompressible fluid.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.types import PinholeCamera, SolveReport

DIRECTIONS = 16
"""the cosine with the mainstream is tabulated for so many directions and interpolated between them"""
OBSERVED_CONFIDENCE = 0.4
"""flow of at least this confidence is left alone"""


def mainstream_direction(
    displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    *,
    smoothing: float = 0.12,
) -> Float[np.ndarray, "h w 2"]:
    """Unit direction of the bulk flow on the screen (paper: n_k), float32, defined on the whole picture.

    Where confident flow is at hand and agrees with itself, it is that flow smoothed by a normalised convolution.
    Elsewhere the fluid follows its banks: the direction in which the distance to the rim of the mask does not change,
    smoothed, with the sign of the flow at large. A mask without a long direction takes the flow at large; without any
    flow the longest axis of the mask, pointing down (or to the right where it is level).

    Args:
        displacement: px/frame.
        confidence: 0 to 1.
        mask: the fluid.
        smoothing: standard deviation of the convolution as a share of the root of the mask's area.

    Raises:
        ValueError: an empty mask or shapes that do not fit.
    """
    d, mask = _checked(displacement, confidence, mask)
    inside = mask.astype(np.float32)
    weight = inside * np.asarray(confidence, np.float32) ** 2
    speed = np.hypot(d[..., 0], d[..., 1])
    extent = math.sqrt(mask.sum())

    def smooth(sigma: float) -> tuple[np.ndarray, np.ndarray]:
        terms = np.dstack([weight[..., None] * d, weight * speed, weight, inside])
        vx, vy, total, density, area = np.moveaxis(_blur(terms, sigma), -1, 0)
        length = np.hypot(vx, vy)
        coherence = length / np.maximum(total, 1e-9)
        share = density / np.maximum(area, 1e-9)
        unit = np.stack([vx, vy], axis=-1) / np.maximum(length, 1e-9)[..., None]
        return unit, (coherence**2 * share / (share + 0.05))[..., None]

    near, trust_near = smooth(smoothing * extent)
    far, trust_far = smooth(4 * smoothing * extent)
    axis, elongation = bank_direction(mask, sigma=smoothing * extent)
    mean = (weight[..., None] * d).sum(axis=(0, 1))
    fallback = mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 1e-6 * mask.sum() else _major_axis(mask)
    large = _unit(trust_far * far + 0.01 * fallback, fallback)
    along = np.where((axis * large).sum(axis=-1, keepdims=True) < 0, -axis, axis)
    rest = elongation[..., None] * along + (1 - elongation[..., None]) * large
    return _unit(trust_near * near + (1 - trust_near) * rest, fallback).astype(np.float32)


def bank_direction(
    mask: Bool[np.ndarray, "h w"], *, sigma: float
) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]:
    """Axis along the banks (sign arbitrary) and how pronounced it is, 0 to 1.

    The distance to the rim grows straight away from a bank, so the smaller eigenvector of the smoothed structure
    tensor of the distance lies along it. The fluid is thought to go on beyond the border of the picture.

    Args:
        mask: the fluid.
        sigma: smoothing in px.
    """
    pad = max(2, int(math.ceil(2 * sigma)))
    wide = cv2.copyMakeBorder(mask.astype(np.uint8), pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    if wide.all():
        return np.zeros((*mask.shape, 2), np.float32), np.zeros(mask.shape, np.float32)
    distance = cv2.GaussianBlur(cv2.distanceTransform(wide, cv2.DIST_L2, 5), (0, 0), 1.5)
    gx = cv2.Sobel(distance, cv2.CV_32F, 1, 0, scale=0.125) * wide
    gy = cv2.Sobel(distance, cv2.CV_32F, 0, 1, scale=0.125) * wide
    tensor = _blur(np.dstack([gx * gx, gy * gy, gx * gy]), sigma)[pad:-pad, pad:-pad]
    xx, yy, xy = np.moveaxis(tensor, -1, 0)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy) + 0.5 * np.pi  # across the larger eigenvector
    elongation = np.sqrt((xx - yy) ** 2 + 4 * xy**2) / np.maximum(xx + yy, 1e-9)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32), elongation


def complete_flow(
    displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    direction: Float[np.ndarray, "h w 2"],
    depth: Float[np.ndarray, "h w"] | None = None,
    *,
    threshold: float = OBSERVED_CONFIDENCE,
    stall: float = 0.1,
    finest: float = 4.0,
) -> tuple[Float[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]:
    """Motion of the failed pixels from their neighbours (paper: the interpolation of v_opz).

    v_k = sum_i w_i max(0, n_k . v_i / |v_i|) v_i / sum_i w_i max(0, n_k . v_i / |v_i|)

    The paper leaves the weights w open. Here they are Gaussian in the distance times the confidence, over the observed
    pixels, and the sum is divided by the sum of all factors of v_i, so that the neighbours' speed ("comparable kinetic
    energy") is kept: a uniform flow is continued as it is, whatever the distance. The window is the narrowest that
    holds enough observed pixels: Gaussians of doubled width take over one after the other. The cosine depends on k and
    i; it is tabulated for `DIRECTIONS` directions of n and interpolated, so that every sum is a convolution.

    Flow does not fail all at once: a pixel of confidence c below the threshold takes 1 - c of the neighbours' motion
    and keeps c of its own.

    Flow also fails with full confidence, where the eye looks through still water onto the bed or sees a fixed
    reflection: it finds no motion. A pixel much slower than its surroundings loses confidence for that (`stall`).

    With depth, motion is averaged as px times depth, that is as metres across the line of sight: the same stream far
    away moves fewer pixels.

    Args:
        displacement: px/frame.
        confidence: 0 to 1.
        mask: the fluid.
        direction: n, from `mainstream_direction`.
        depth: camera z in m, positive inside the mask.
        threshold: confidence from which flow counts as observed.
        stall: share of the surrounding speed at which confidence is halved; 0 believes in standstill.
        finest: standard deviation of the narrowest window, px.

    Returns:
        completed float32 [H,W,2] px/frame, equal to the input where observed and 0 outside the mask; observed
        bool [H,W]. Without a single observed pixel the flow is returned as it is, with nothing observed.

    Raises:
        ValueError: an empty mask, shapes that do not fit, depth that is not positive inside the mask.
    """
    d, mask = _checked(displacement, confidence, mask)
    confidence = np.asarray(confidence, np.float32) * _moving(d, np.asarray(confidence) * mask, stall, 3 * finest)
    observed = mask & (confidence >= threshold)
    failed = mask & ~observed
    if not observed.any() or not failed.any():
        return np.where(mask[..., None], d, 0.0).astype(np.float32), observed
    reach = np.ones(mask.shape, np.float32)
    if depth is not None:
        require(bool((np.asarray(depth)[mask] > 0).all()), "depth that is not positive inside the mask")
        reach = np.where(mask, depth, 1.0).astype(np.float32)
    rows, cols = np.nonzero(failed)
    filled = _directed_mean(
        d * reach[..., None], np.where(observed, confidence, 0.0), np.asarray(direction, np.float32), rows, cols, finest
    )
    completed = np.where(observed[..., None], d, 0.0).astype(np.float32)
    own = np.clip(confidence[rows, cols], 0.0, 1.0)[:, None]
    completed[rows, cols] = own * d[rows, cols] + (1 - own) * filled / reach[rows, cols, None]
    return completed, observed


def screen_divergence(
    displacement: Float[np.ndarray, "h w 2"],
    mask: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    depth_rate: Float[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    form: str = "exact",
    axial_rate: Float[np.ndarray, "h w"] | None = None,
) -> Float[np.ndarray, "h w"]:
    """The divergence that an incompressible fluid shows on the screen (paper: `eq::div2DV`), 1/frame.

    A point (x, y, z) in camera axes is seen at u = x/z, v = y/z, which move with u' = (v_x - u v_z)/z and
    v' = (v_y - v v_z)/z. On a plane z = const, d/du = z d/dx, so with div v = 0

        div_2D v_2D = d_x v_x + d_y v_y - 2 v_z / z - (u d_x + v d_y) v_z
                    = -(1/z) (u d_u + v d_v + 2) v_z - d_z v_z.

    The paper writes this without the last term, d_z v_z at fixed (x, y): form "paper". A camera does not see it.
    It also holds only on a plane z = const; on a surface z(u, v) the chain rule adds grad z . d_z v_2D along the ray.
    Form "exact" closes both with one assumption, that just below the surface velocity does not change along the line
    of sight, (u d_x + v d_y + d_z) v = 0. Then d_z v_z = -(1/z) (u d_u + v d_v) v_z and d_z v_2D = -v_2D / z, so

        div_2D v_2D = -(2 v_z + v_2D . grad z) / z,

    which is exact for a rigid translation of any surface, where the paper's form is not. Where d_z v_z is known, give
    it as `axial_rate`; it then takes the place of that closure: paper's right side - axial_rate - v_2D . grad z / z.

    Pixels and normalised coordinates have the same divergence (both axes scale alike above and below the line).

    Args:
        displacement: v_2D, px/frame; used by "exact" for the slope term only.
        mask: the fluid; derivatives do not look beyond it.
        depth: camera z, m.
        depth_rate: v_z, camera z gained by the material in a frame, m/frame.
        camera: gives u and v of the pixels.
        form: "exact" or "paper".
        axial_rate: d_z v_z at fixed x and y, 1/frame.

    Raises:
        ValueError: an unknown form.
    """
    require(form in ("exact", "paper"), f"form '{form}'", "exact or paper")
    mask = np.asarray(mask, bool)
    z = np.where(mask, depth, 1.0).astype(np.float64)
    v_z = np.where(mask, depth_rate, 0.0).astype(np.float64)
    out = -2.0 * v_z
    if form == "paper" or axial_rate is not None:
        from_axis = camera.pixel_grid() - np.asarray(camera.center)
        out -= (from_axis * masked_gradient(v_z, mask)).sum(axis=-1)
    if form == "exact":
        out -= (np.asarray(displacement) * masked_gradient(z, mask)).sum(axis=-1)
        if axial_rate is not None:
            out -= z * axial_rate
    return np.where(mask, out / z, 0.0).astype(np.float32)


def project_screen_divergence(
    displacement: Float[np.ndarray, "h w 2"],
    mask: Bool[np.ndarray, "h w"],
    observed: Bool[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    depth_rate: Float[np.ndarray, "h w"],
    camera: PinholeCamera,
    *,
    form: str = "exact",
    axial_rate: Float[np.ndarray, "h w"] | None = None,
    reach: float = 4.0,
    tolerance: float = 1e-3,
) -> tuple[Float[np.ndarray, "h w 2"], SolveReport]:
    """The completed flow with the divergence of `screen_divergence` in the failed pixels; observed ones stay.

    The least change is a gradient: v - grad q with -laplace q = wanted - div v on the failed pixels. Through the
    borders of the picture the fluid may pass (q = 0 outside). Observed neighbours and banks are fixed (no gradient
    across); a patch enclosed by them can only meet its divergence up to a constant, which then is left in it, spread
    evenly.

    A visible surface also rises and sinks, which the screen does not show, so the constraint does not hold pixel by
    pixel: on a simulated turbulent river the true divergence hardly correlates with either form, and the hard
    constraint made failed patches between observed pixels half as wrong again. It is therefore met softly, as the
    least |v' - v|^2 + reach^2 (div v' - wanted)^2, that is -laplace q + q / reach^2 = wanted - div v: a pixel answers
    to divergence within `reach` of it. An infinite reach is the paper's hard constraint.

    Args:
        displacement: from `complete_flow`, px/frame.
        mask: the fluid.
        observed: from `complete_flow`.
        depth: camera z, m.
        depth_rate: m/frame, see `screen_divergence`.
        camera: of the picture.
        form: see `screen_divergence`.
        axial_rate: see `screen_divergence`.
        reach: px, see above.
        tolerance: share of the excess divergence that may stay.

    Returns:
        displacement float32 [H,W,2] and the report of the solve.
    """
    d, mask = np.asarray(displacement, np.float32), np.asarray(mask, bool)
    failed = mask & ~np.asarray(observed, bool)
    wanted = screen_divergence(d, mask, depth, depth_rate, camera, form=form, axial_rate=axial_rate)
    faces, weights = [], []
    for axis, component in ((0, d[..., 1]), (1, d[..., 0])):
        low, high = _sides(mask, axis)
        count = np.maximum(low.astype(np.float32) + high, 1.0)
        first, second = _sides(np.where(mask, component, 0.0), axis)
        faces.append((first + second) / count)
        failed_low, failed_high = _sides(failed, axis)
        open_face = failed_low & failed_high
        border = [slice(None), slice(None)]
        border[axis] = slice(None, None, mask.shape[axis])
        open_face[tuple(border)] = (failed_low | failed_high)[tuple(border)]
        weights.append(open_face.astype(np.float32)[..., None])
    # the term q / reach^2: one layer of cells leaks through its two faces to q = 0 above and below
    leak = np.where(failed, 0.5 / reach**2, 0.0).astype(np.float32)
    system = PoissonSystem(failed[..., None], *weights, np.stack([leak, leak], axis=-1), 1.0)
    excess = np.where(failed, wanted - np.diff(faces[0], axis=0) - np.diff(faces[1], axis=1), 0.0)
    # within a short reach plain conjugate gradients are done before a multigrid hierarchy is built
    method = "conjugate_gradient" if reach <= 8 else "multigrid"
    q, report = solve(system, excess[..., None].astype(np.float32), method=method, tolerance=tolerance)
    out = d.copy()
    for axis, channel in ((0, 1), (1, 0)):
        pad = [(0, 0), (0, 0)]
        pad[axis] = (1, 1)
        change = np.diff(np.pad(np.where(failed, q[..., 0], 0.0), pad), axis=axis) * weights[axis][..., 0]
        low, high = [slice(None)] * 2, [slice(None)] * 2
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        out[..., channel] -= np.where(failed, 0.5 * (change[tuple(low)] + change[tuple(high)]), 0.0)
    return out, report


def masked_gradient(field: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 2"]:
    """(d/du, d/dv) per px from neighbours inside the mask: central, one-sided at its rim, 0 where there is none."""
    parts = []
    for axis in (1, 0):
        pair = np.diff(np.where(mask, field, 0.0), axis=axis)
        both = np.logical_and(*(np.take(mask, range(a, mask.shape[axis] - 1 + a), axis=axis) for a in (0, 1)))
        step_low, step_high = _sides(np.where(both, pair, 0.0), axis)
        there_low, there_high = _sides(both, axis)
        parts.append((step_low + step_high) / np.maximum(there_low.astype(np.float32) + there_high, 1.0))
    return np.where(np.asarray(mask, bool)[..., None], np.stack(parts, axis=-1), 0.0)


def _sides(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Values before and after each face across `axis`, 0 beyond the ends."""
    before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
    before[axis], after[axis] = (1, 0), (0, 1)
    return np.pad(values, before), np.pad(values, after)


def _directed_mean(
    v: np.ndarray, weight: np.ndarray, n: np.ndarray, rows: np.ndarray, cols: np.ndarray, finest: float
) -> np.ndarray:
    """The weighted mean of v, along n, at the pixels (rows, cols): float32 [k,2]."""
    unit = v / np.maximum(np.hypot(v[..., 0], v[..., 1]), 1e-6)[..., None]
    bins = np.mod(np.arctan2(n[rows, cols, 1], n[rows, cols, 0]) / (2 * np.pi) * DIRECTIONS, DIRECTIONS)
    low = np.floor(bins).astype(int) % DIRECTIONS
    share = bins - np.floor(bins)
    needed = np.zeros(DIRECTIONS, bool)
    needed[low] = needed[(low + 1) % DIRECTIONS] = True
    sigmas = [finest * 2.0**k for k in range(20) if finest * 2.0**k < 2 * max(weight.shape)]
    tables = {b: _sums(v, weight * _cosine(unit, b), rows, cols, sigmas) for b in np.flatnonzero(needed)}
    out = np.zeros((len(rows), 2), np.float32)
    left = np.ones(len(rows), np.float32)
    for k in range(len(sigmas)):
        sums = np.zeros((len(rows), 3), np.float32)
        for b in np.flatnonzero(needed):
            part = np.where(low == b, 1 - share, np.where((low + 1) % DIRECTIONS == b, share, 0.0))
            sums += part[:, None].astype(np.float32) * tables[b][k]
        # the observed share of the window at which it is trusted by half; the widest window must do in any case
        enough = 0.05 if k + 1 < len(sigmas) else 0.0
        take = left * sums[:, 2] / np.maximum(sums[:, 2] + enough, 1e-12)
        out += take[:, None] * sums[:, :2] / np.maximum(sums[:, 2:], 1e-12)
        left = left - take
    stranded = left > 0.5  # every neighbour runs against n: their speed, along n
    if stranded.any():
        speed = (weight * np.hypot(v[..., 0], v[..., 1])).sum() / max(float(weight.sum()), 1e-12)
        out[stranded] = n[rows, cols][stranded] * speed
    return out


def _moving(d: np.ndarray, confidence: np.ndarray, stall: float, sigma: float) -> np.ndarray:
    """1 for pixels at the speed of their surroundings, 1/2 at `stall` times that, 0 at rest."""
    if stall <= 0:
        return np.ones(d.shape[:2], np.float32)
    squared = (d**2).sum(axis=-1)
    weight = confidence**2
    around = _blur(np.dstack([weight * squared, weight]), sigma)
    slow = stall**2 * around[..., 0] / np.maximum(around[..., 1], 1e-9) + 1e-6
    return ((squared + 1e-6) / (squared + slow)).astype(np.float32)


def _cosine(unit: np.ndarray, index: int) -> np.ndarray:
    angle = 2 * np.pi * index / DIRECTIONS
    return np.maximum(0.0, unit[..., 0] * np.float32(math.cos(angle)) + unit[..., 1] * np.float32(math.sin(angle)))


def _sums(
    v: np.ndarray, weight: np.ndarray, rows: np.ndarray, cols: np.ndarray, sigmas: list[float]
) -> list[np.ndarray]:
    terms = np.dstack([v * weight[..., None], weight])
    return [_blur(terms, sigma)[rows, cols] for sigma in sigmas]


def _blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur, float32 [H,W,C]; wide ones on a reduced picture. Nothing lies beyond the border."""
    h, w = image.shape[:2]
    factor = 2 ** max(0, int(math.floor(math.log2(max(sigma, 1.0) / 2.0))))
    size = (max(1, -(-w // factor)), max(1, -(-h // factor)))
    wide, high = max(sigma * size[0] / w, 0.3), max(sigma * size[1] / h, 0.3)
    out = np.empty(image.shape, np.float32)
    for c in range(0, image.shape[2], 4):  # OpenCV resizes at most four channels
        part = np.ascontiguousarray(image[..., c : c + 4], np.float32)
        part = cv2.resize(part, size, interpolation=cv2.INTER_AREA) if factor > 1 else part
        part = cv2.GaussianBlur(part, (0, 0), wide, None, high, cv2.BORDER_CONSTANT)
        part = cv2.resize(part, (w, h), interpolation=cv2.INTER_LINEAR) if factor > 1 else part
        out[..., c : c + 4] = part.reshape(h, w, -1)
    return out


def _unit(v: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.where(length > 1e-6, v / np.maximum(length, 1e-6), fallback)


def _major_axis(mask: np.ndarray) -> np.ndarray:
    """Unit vector along the longest extent of the mask, pointing down, or to the right where it is level."""
    rows, cols = np.nonzero(mask)
    if len(rows) < 3:
        return np.array([0.0, 1.0])
    values, vectors = np.linalg.eigh(np.cov(np.stack([cols, rows]).astype(np.float64)))
    axis = vectors[:, int(np.argmax(values))]
    return -axis if axis[1] < -0.1 or (abs(axis[1]) <= 0.1 and axis[0] < 0) else axis


def _checked(displacement: np.ndarray, confidence: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    d, mask = np.asarray(displacement, np.float32), np.asarray(mask, bool)
    require(d.ndim == 3 and d.shape[-1] == 2, f"displacement {d.shape}", "[H,W,2]")
    require(mask.shape == d.shape[:2] == np.shape(confidence), "displacement, confidence and mask of unlike shapes")
    require(bool(mask.any()), "an empty mask", "at least one fluid pixel")
    return d, mask
