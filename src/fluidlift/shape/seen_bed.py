"""Whether the bed is seen through the water, where, and what it looks like: the still layer of a moving picture.

In linear light a pixel of clear water shows

    I(x, t) = T B(x + d(x, t)) (1 + c(x, t)) + R(x, t)

B is the bed, which stays; d, by which ripples displace it, and c, the caustics, have no mean over time; R >= 0 is what
the surface mirrors: glints, foam and sky. So a median over time is T B and what of R is smooth.

That a bed is seen at all takes more than something that stays. What the current carries leaves a mean that is blurred
along its way, so the derivative along the flow is what counts, and of its medians over the first and the second half
of the film what both have in common (chance has none). Waves that stand, and a shore that is mirrored, stay as well,
but wander: their mean is smooth. A bed's is as fine as the ground beside the water. And it returns less blue than what
a surface mirrors: where that shows in the mean picture, what stays is redder than the mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.numerics.over_time import median_over_time
from fluidlift.numerics.srgb import linear_from_srgb, srgb_from_linear
from fluidlift.types.fluid_masks import FluidMasks

FINEST, RESOLVED = 0.7, 0.0022
"""px, and part of the picture's longer side: standard deviation of the blur above which the finest band begins, the
larger of both. Lens and coding leave less below (0.7 px of 320)"""
OCTAVES = (1.0, 2.0, 4.0)
"""times that, where bands begin that are an octave wide: fine, middle and broad"""
AROUND = 0.03
"""of the picture's longer side: standard deviation of the weights over which energies are compared"""
ALWAYS = 0.9
"""share of the frames in which a place is fluid, to be asked"""
RIM = 3
"""px inside the outline of the fluid that lens, coding and mask mix with the bank"""
MOST = 48
"""frames that are looked at, evenly spread: more tell the same, and take more memory"""
ROOM = 2.5e8
"""bytes that their pictures may take: at 1280 x 720 px these are 22"""
FEWEST = 8
"""frames: fewer make no two halves with a median each"""
TRAVEL = 4.0
"""px that the current must move within half of the film: else the grain that it carries is still there"""
STAYS = 0.25
"""share of the finest energy along the flow that both halves must have in common. Of made opaque streams it is 0.00, of
real rivers with waves that stand 0.02 to 0.1, of made beds under ripples of slope 0.02 and 0.06 0.85 and 0.4"""
GRAIN = 2.0
"""times the energy along the flow of the broad band that the fine one of the still layer has, at least. What is sharp
(power over wavenumber squared, as in most pictures: Field 1987) has 16; lens and coding leave a bed 2.3 to 10 of that,
waves and mirrored shores have 0.1 to 0.5"""
AS_RED, STEEP, LESS_RED = 0.0, np.cos(np.radians(45.0)), -0.2
"""by which ln(red / blue) of what stays is above that of the mean picture, at least: the mean holds the sky's mirror
image, foam and glints. Above that cosine with the vertical a surface mirrors 3 % at most, and the mean is the bed's,
of which pale stones are less red than dark ones (0.13 on made gravel). Leaves, twigs and their mirror image over a
brook are 0.15 to 0.4 below it"""
LINES = 0.65
"""coherence of what stays, 0 (alike in all directions) to 1 (all along one), from which it is no gravel but crests,
ropes or twigs: made beds have 0.2 to 0.55, a real one 0.1 to 0.5; waves that stand, branches and falls 0.6 to 0.9"""
LEAST = 0.1
"""of the fluid's pixels that a bed is seen through in one piece, or it counts as none: calm arms, stones awash and
ropes across it are less"""
FLATTEST = 0.3
"""cosine below which a surface mirrors more than 0.17 of the sky (Fresnel): as much as wet ground returns"""
DARK = 1e-9
"""of linear light squared: less energy is rounding to 8 bits"""


Around = Callable[[np.ndarray], np.ndarray]
"""means over windows"""


@dataclass(frozen=True)
class StillLayer:
    """What stays in the picture of a fluid, and where that is its bed."""

    picture: UInt8[np.ndarray, "h w 3"]
    """sRGB, median over time where the pixel is fluid"""
    seen: Bool[np.ndarray, "h w"]
    """pixels that show the bed"""
    share: float
    """of the fluid's pixels"""
    stays: Float[np.ndarray, "h w"]
    """share of the fine energy along the flow that stays, 0 to 1; 0 where nothing was asked"""


def still_layer(
    frames: UInt8[np.ndarray, "t h w 3"],
    fluid: Bool[np.ndarray, "t h w"] | FluidMasks,
    flow: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
    upright: Float[np.ndarray, "h w"],
) -> StillLayer | None:
    """The bed of a stream as far as it is seen; None where it is not, or nothing can be told.

    Args:
        frames: sRGB, of a picture that stands.
        fluid: in each of them.
        flow: px per frame, mean over time.
        trust: in it, 0 to 1.
        upright: cosine of each line of sight with the vertical.

    Raises:
        ValueError: pictures and masks of different sizes.
    """
    require(frames.shape[:3] == fluid.shape, f"{frames.shape} pictures for masks {fluid.shape}", "one each")
    often = np.sum([fluid[t] for t in range(len(fluid))], axis=0) / len(fluid)
    inner = ndimage.binary_erosion(often >= ALWAYS, iterations=RIM, border_value=1)
    inner &= upright >= FLATTEST
    if len(frames) < FEWEST or not inner.any() or not _moves_on(flow, trust * inner, len(frames)):
        return None
    most = max(min(len(frames), MOST, int(ROOM / (12 * inner.size))), FEWEST)
    pick = np.unique(np.linspace(0, len(frames) - 1, most).round().astype(int))
    light = linear_from_srgb(np.arange(256, dtype=np.float32) / 255.0).astype(np.float32)
    pictures = np.stack([light[frames[t]] for t in pick])
    usual = median_over_time(pictures)
    stays, beds = _compared(pictures, usual, inner, _ways(flow, trust * inner), upright)
    window, whole = 2.0 * np.pi * (AROUND * max(inner.shape)) ** 2, int((often >= ALWAYS).sum())
    seen = _large(beds & inner, max(window, LEAST * whole))
    if not seen.any():
        return None
    seen |= inner & ~_large(~seen, window)  # a hole that is smaller is one draw of chance
    rim = ndimage.binary_dilation(seen, iterations=RIM + 1) & (often >= ALWAYS)  # what was cut off goes with it
    seen |= rim & ~inner
    share = float(seen.sum() / whole)
    picture = np.round(255.0 * srgb_from_linear(np.clip(usual, 0.0, 1.0))).astype(np.uint8)
    return StillLayer(picture, seen, share, stays)


def _moves_on(flow: np.ndarray, trust: np.ndarray, frames: int) -> bool:
    """Whether what the faster quarter of the current carries is elsewhere after half of the film."""
    known = trust > 0.3
    if not known.any():
        return False
    speed = np.percentile(np.linalg.norm(flow[known], axis=-1), 75)
    return bool(0.5 * frames * speed >= TRAVEL)


def _ways(flow: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """Unit direction of the flow in every pixel, float32 [h,w,2], evened out over where it was not measured."""
    weighted = np.asarray(flow, np.float32) * np.asarray(trust, np.float32)[..., None]
    smooth = cv2.GaussianBlur(weighted, (0, 0), 2.0 * AROUND * max(trust.shape))
    mean = weighted.mean(axis=(0, 1))
    mean = mean / max(float(np.linalg.norm(mean)), 1e-9)
    size = np.linalg.norm(smooth, axis=-1, keepdims=True)
    return np.where(size > 1e-3 * size.max(), smooth / np.maximum(size, 1e-9), mean).astype(np.float32)


def _along(picture: np.ndarray, ways: np.ndarray, band: tuple[float, float]) -> np.ndarray:
    """Derivative along the ways of one band of a picture, 1/px, [h,w,3]."""
    fine = cv2.GaussianBlur(picture, (0, 0), band[0]) - cv2.GaussianBlur(picture, (0, 0), band[1])
    down, right = np.gradient(fine, axis=(0, 1))
    return right * ways[..., :1] + down * ways[..., 1:]


def _halves(pictures: np.ndarray, ways: np.ndarray, band: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, Any]:
    """Medians of the derivative over both halves of the film, [h,w,3] each, and its mean energy in one picture."""
    along = np.stack([_along(p, ways, band) for p in pictures])
    half = len(along) // 2
    energy = (along.sum(axis=-1) ** 2).mean(axis=0)
    return median_over_time(along[:half]), median_over_time(along[-half:]), energy


def _compared(
    pictures: np.ndarray, usual: np.ndarray, inner: np.ndarray, ways: np.ndarray, upright: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """How much of the finest energy along the flow stays, float32 [h,w], and where what stays looks like a bed.

    Args:
        pictures: [t,h,w,3], linear.
        usual: [h,w,3], their median.
        inner: bool [h,w], where the fluid is asked.
        ways: [h,w,2], of the flow.
        upright: [h,w], cosine of the lines of sight.
    """
    weight, sigma = inner.astype(np.float32), AROUND * max(inner.shape)

    def around(values: np.ndarray, wide: float = 1.0) -> np.ndarray:
        norm = np.maximum(cv2.GaussianBlur(weight, (0, 0), wide * sigma), 1e-3)
        return cv2.GaussianBlur((values * weight).astype(np.float32), (0, 0), wide * sigma) / norm

    still, red, blue = [], np.zeros(inner.shape), np.zeros(inner.shape)
    stays = np.zeros(inner.shape)
    finest = max(FINEST, RESOLVED * max(inner.shape))
    for k, times in enumerate(OCTAVES):
        band = (times * finest, 2.0 * times * finest)
        first, second, energy = _halves(pictures, ways, band)
        light = first.sum(axis=-1), second.sum(axis=-1)
        still.append(around(light[0] * light[1]))
        if k == 0:
            stays = still[0] / np.maximum(around(energy), DARK)
        if k < 2:  # what red and blue do when all light changes
            red += around(0.5 * (first[..., 0] * light[1] + second[..., 0] * light[0]), 2.0)
            blue += around(0.5 * (first[..., 2] * light[1] + second[..., 2] * light[0]), 2.0)
    mean = [np.log(np.maximum(around(usual[..., k], 2.0), DARK)) for k in (0, 2)]
    redder = np.log(np.maximum(red, DARK)) - np.log(np.maximum(blue, DARK)) - (mean[0] - mean[1])
    enough = np.where(upright > STEEP, LESS_RED, AS_RED)
    fine = still[0] > GRAIN * np.maximum(still[2], 0.0)
    isotropic = _coherence(pictures, finest, upright, around) < LINES
    found = (stays > STAYS) & fine & isotropic & (np.minimum(red, blue) > DARK) & (redder > enough)
    return np.clip(stays * weight, 0.0, 1.0).astype(np.float32), found


def _coherence(pictures: np.ndarray, finest: float, upright: np.ndarray, around: Around) -> np.ndarray:
    """How much what stays lies along one direction, [h,w], of its structure tensor (Bigun and Granlund 1987).

    Ground is foreshortened along the picture's columns by the cosine with the vertical, which is taken out.
    """
    half, slopes = len(pictures) // 2, []
    for part in (pictures[:half], pictures[-half:]):
        still = median_over_time(part).sum(axis=-1)
        down, right = np.gradient(cv2.GaussianBlur(still, (0, 0), finest) - cv2.GaussianBlur(still, (0, 0), 4 * finest))
        slopes.append((right, down * upright))
    (right, down), (other_right, other_down) = slopes
    across, along = around(right * other_right), around(down * other_down)
    mixed = around(0.5 * (right * other_down + down * other_right))
    return np.hypot(across - along, 2.0 * mixed) / np.maximum(across + along, DARK)


def _large(found: np.ndarray, least: float) -> np.ndarray:
    """The connected parts of at least so many pixels."""
    parts, count = ndimage.label(found)
    if count == 0:
        return found
    sizes = ndimage.sum_labels(found, parts, np.arange(count + 1))
    return found & (sizes >= least)[parts]
