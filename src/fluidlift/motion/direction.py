"""Direction of the bulk flow on the screen (paper: n_k): from confident flow, banks, open ends and the bed's slope."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.motion.interpolation import diffusion_interpolation
from fluidlift.motion.screen_divergence import masked_gradient
from fluidlift.types import PinholeCamera

SMOOTHING = 0.12
"""standard deviation over which flow is smoothed, over the root of the mask's area. Where flow is dense half of it is
used: a jet over its pool is then filled with a third less error, streams alike within 4 %"""
DOWNHILL_SHARE = 0.1
"""weight of the bed's slope beside confident flow that agrees with itself (1): flow decides where it is known"""
OPEN_END = 0.02
"""an open end of the mask is at least this share of the root of its area wide"""


def mainstream_direction(
    displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    *,
    downhill: Float[np.ndarray, "h w 2"] | None = None,
) -> Float[np.ndarray, "h w 2"]:
    """Unit direction of the bulk flow on the screen (paper: n_k), float32, defined on the whole picture.

    Where confident flow is at hand and agrees with itself, it is that flow smoothed by a normalised convolution.
    Elsewhere the fluid follows its banks: the direction in which the distance to the rim of the mask does not change,
    smoothed (`bank_direction`). Its sign, and the direction where banks say nothing, come from the flow that passes
    through the mask between its open ends (`through_direction`); where it has no two ends, from the flow at large and
    from the slope of the bed; without any of them it is the longest axis of the mask, pointing down (or to the right
    where it is level).

    Args:
        displacement: px/frame.
        confidence: 0 to 1.
        mask: the fluid.
        downhill: screen direction of steepest descent, of any length; 0 where it is level or unknown
            (`screen_downhill`).

    Raises:
        ValueError: an empty mask or shapes that do not fit.
    """
    d, mask = checked_flow(displacement, confidence, mask)
    inside = mask.astype(np.float32)
    weight = inside * np.asarray(confidence, np.float32) ** 2
    speed = np.hypot(d[..., 0], d[..., 1])
    sigma = SMOOTHING * math.sqrt(mask.sum())

    def smooth(sigma: float) -> tuple[np.ndarray, np.ndarray]:
        terms = np.dstack([weight[..., None] * d, weight * speed, weight, inside])
        vx, vy, total, density, area = np.moveaxis(gaussian_blur(terms, sigma), -1, 0)
        length = np.hypot(vx, vy)
        coherence = length / np.maximum(total, 1e-9)
        share = density / np.maximum(area, 1e-9)
        unit = np.stack([vx, vy], axis=-1) / np.maximum(length, 1e-9)[..., None]
        return unit, (coherence**2 * share / (share + 0.05))[..., None]

    near, trust_near = smooth(sigma)
    nearest, trust_nearest = smooth(0.5 * sigma)
    far, trust_far = smooth(4 * sigma)
    guide = trust_far * far
    mean = (weight[..., None] * d).sum(axis=(0, 1))
    if downhill is not None:
        require(np.shape(downhill) == d.shape, f"downhill {np.shape(downhill)}", f"{d.shape}")
        slope = np.where(mask[..., None], downhill, 0.0)
        guide = guide + DOWNHILL_SHARE * _unit(slope, np.zeros(2))
        mean = mean if np.linalg.norm(mean) > 1e-6 * mask.sum() else slope.sum(axis=(0, 1))
    fallback = mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 1e-6 * mask.sum() else _major_axis(mask)
    large = _unit(guide + 0.01 * fallback, fallback)
    through = through_direction(mask, large, weight[..., None] * d + 1e-6 * inside[..., None] * large)
    large = large if through is None else through
    axis, elongation = bank_direction(mask, sigma=sigma)
    along = np.where((axis * large).sum(axis=-1, keepdims=True) < 0, -axis, axis)
    rest = elongation[..., None] * along + (1 - elongation[..., None]) * large
    found = _unit(trust_near * near + (1 - trust_near) * rest, fallback)
    return _unit(trust_nearest * nearest + (1 - trust_nearest) * found, fallback).astype(np.float32)


def through_direction(
    mask: Bool[np.ndarray, "h w"], guide: Float[np.ndarray, "h w 2"], evidence: Float[np.ndarray, "h w 2"]
) -> Float[np.ndarray, "h w 2"] | None:
    """Direction of the potential flow through the mask from end to end, or None where it has not two open ends.

    The potential obeys Laplace's equation inside the mask, with walls where the mask ends and even inflow and outflow
    where it meets the border of the picture. Its gradient follows bends and goes round rocks, and has one sense
    throughout: a river that turns back on itself is no trouble. Two runs of the mask along the border are the two
    ends; of one run or of many, the parts through which the guide enters and leaves.

    Args:
        mask: the fluid.
        guide: unit direction of the flow at large.
        evidence: motion times trust; decides the sense.
    """
    h, w = mask.shape
    extent = math.sqrt(mask.sum())
    outwards = np.zeros((h, w, 2), np.float32)
    outwards[0, :, 1] -= 1
    outwards[-1, :, 1] += 1
    outwards[:, 0, 0] -= 1
    outwards[:, -1, 0] += 1
    edge = mask & (np.abs(outwards).sum(axis=-1) > 0)
    runs = np.asarray(cv2.connectedComponents(edge.astype(np.uint8), connectivity=8)[1])
    long = [k for k in range(1, int(runs.max()) + 1) if (runs == k).sum() >= OPEN_END * extent]
    if len(long) == 2:
        enters, leaves = runs == long[0], runs == long[1]
        strength = np.ones((h, w))
    else:
        strength = np.where(edge, (outwards * guide).sum(axis=-1), 0.0)
        enters, leaves = strength < -MOSTLY_ALONG, strength > MOSTLY_ALONG
    if min(enters.sum(), leaves.sum()) < OPEN_END * extent:
        return None
    # so weak a tie to the potential beyond the ends that it drops there, and not in the mask: the flow comes in evenly
    tie = np.where(enters | leaves, np.abs(strength) / extent, 0.0)
    potential, reached, _ = diffusion_interpolation(enters[..., None], tie, mask, tolerance=1e-4)
    slope = gaussian_blur(-masked_gradient(potential[..., 0], mask), 2.0)
    slope *= -1.0 if (slope * evidence).sum() < 0 else 1.0
    found = reached & (np.linalg.norm(slope, axis=-1) > 1e-6 / extent)
    return np.where(found[..., None], slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12), guide)


MOSTLY_ALONG = 0.35
"""the guide passes the border of the picture where it is within 70 degrees of straight across"""


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
    tensor = gaussian_blur(np.dstack([gx * gx, gy * gy, gx * gy]), sigma)[pad:-pad, pad:-pad]
    xx, yy, xy = np.moveaxis(tensor, -1, 0)
    angle = 0.5 * np.arctan2(2 * xy, xx - yy) + 0.5 * np.pi  # across the larger eigenvector
    elongation = np.sqrt((xx - yy) ** 2 + 4 * xy**2) / np.maximum(xx + yy, 1e-9)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32), elongation


def screen_downhill(
    depth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], camera: PinholeCamera, *, smoothing: float = 4.0
) -> Float[np.ndarray, "h w 2"]:
    """Screen direction of the surface's steepest descent, unit, float32; 0 where it is level, or outside the mask.

    With the tangents t_u, t_v of the surface (m/px) and their heights h_u, h_v, a step (a, b) on the screen is one of
    a t_u + b t_v; descent per metre is steepest along -G^-1 (h_u, h_v), where G holds the products of the tangents.

    Args:
        depth: camera z, m, positive inside the mask.
        mask: the fluid.
        camera: its pose says where down is (the world's z points up).
        smoothing: standard deviation in px; a depth map has steps that are no slope.
    """
    mask = np.asarray(mask, bool)
    require(bool((np.asarray(depth)[mask] > 0).all()), "depth that is not positive inside the mask")
    z = np.where(mask, depth, 1.0)
    # the slope of 1/z is the same all over a plane: its mean inside the mask stays right up to the rim
    part = gaussian_blur(np.dstack([masked_gradient(np.where(mask, 1.0 / z, 0.0), mask), mask]), smoothing)
    change = -(z**2)[..., None] * part[..., :2] / np.maximum(part[..., 2:], 1e-12)
    grid = camera.pixel_grid()
    ray = camera.unproject(grid, np.ones(mask.shape)) - camera.unproject(grid, np.zeros(mask.shape))
    aside = [(camera.unproject(grid + e, z) - camera.unproject(grid, z)) for e in np.eye(2)]
    tangents = np.stack([aside[k] + change[..., k, None] * ray for k in (0, 1)], axis=-1)  # [H,W,3,2], m/px
    rise = tangents[..., 2, :]
    metric = np.einsum("hwki,hwkj->hwij", tangents, tangents)
    size = np.maximum(np.trace(metric, axis1=-2, axis2=-1), 1e-30)[..., None, None]
    step = -np.linalg.solve(metric + 1e-9 * size * np.eye(2), rise[..., None])[..., 0]
    slope = np.sqrt(np.maximum(-(step * rise).sum(axis=-1), 0.0))  # rise over run along the steepest way
    steep = mask & (slope > LEVEL)
    return np.where(steep[..., None], _unit(step, np.zeros(2)), 0.0).astype(np.float32)


LEVEL = 0.02
"""rise over run below which a surface from a picture counts as level: half a degree of camera pitch gives half of it"""


def gaussian_blur(image: np.ndarray, sigma: float) -> np.ndarray:
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


def checked_flow(displacement: np.ndarray, confidence: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    d, mask = np.asarray(displacement, np.float32), np.asarray(mask, bool)
    require(d.ndim == 3 and d.shape[-1] == 2, f"displacement {d.shape}", "[H,W,2]")
    require(mask.shape == d.shape[:2] == np.shape(confidence), "displacement, confidence and mask of unlike shapes")
    require(bool(mask.any()), "an empty mask", "at least one fluid pixel")
    return d, mask


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
