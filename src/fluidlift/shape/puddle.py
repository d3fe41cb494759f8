"""Puddles that jets fall into, seen from above: told from a vessel seen from the side, and what they say of the tilt.

Where a jet ends in a still pool the silhouette alone does not tell a puddle that lies from a body that hangs: the jet
is seen by its motion (shape/jets.py), and a pool that is round lies where its outline is an ellipse wider than tall.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.shape.jets import Outline, airborne_pixels, find_jets, lying_pixels
from fluidlift.shape.kind import level_camera
from fluidlift.shape.region import largest_piece
from fluidlift.types import PinholeCamera, UpEvidence
from fluidlift.types.kind import STREAM

ROUND = 0.85
"""IoU of a pool's outline with the ellipse of its moments, at least: a rectangle has 0.83, a glass from the side less.
What waves and a jet in front take away from a true ellipse is under a tenth"""
LEAST_SHARE = 0.4
"""share of the fluid that is in the pool, at least"""
OUT_OF_ROUND = 0.25
"""standard deviation of the logarithm of a pool's length over its width (a choice: bowls have 0, puddles up to 2)"""
UPRIGHT = 1.5
"""how many times taller than the tilt would show it a round pool may be, where the tilt is known: a taller one is no
level surface (`OUT_OF_ROUND` at 95 %)"""


@dataclass(frozen=True)
class Ellipse:
    """The ellipse with the moments of a region."""

    center: tuple[float, float]
    """(u, v), px"""
    covariance: Float[np.ndarray, "2 2"]
    """px^2"""
    likeness: float
    """IoU with the region"""

    @property
    def flatness(self) -> float:
        """Its height over its width, along the picture's axes."""
        return float(np.sqrt(self.covariance[1, 1] / self.covariance[0, 0]))


def fit_ellipse(region: Bool[np.ndarray, "h w"]) -> Ellipse | None:
    """The ellipse whose area and axes fit a region; None for less than 40 pixels."""
    rows, cols = np.nonzero(region)
    if len(rows) < 40:
        return None
    points = np.stack([cols + 0.5, rows + 0.5], -1)
    center, covariance = points.mean(0), np.cov(points.T)
    offset = np.stack(np.meshgrid(np.arange(region.shape[1]), np.arange(region.shape[0])), -1) + 0.5 - center
    inside = np.einsum("...i,ij,...j->...", offset, np.linalg.inv(covariance), offset) <= 4.0
    likeness = float((inside & region).sum() / (inside | region).sum())
    return Ellipse((float(center[0]), float(center[1])), covariance, likeness)


@dataclass(frozen=True)
class Poured:
    """What is poured, and the pool it ends in."""

    jets: tuple[Outline, ...]
    lying: Bool[np.ndarray, "h w"]
    """pixels of the pool, with what the jets hide of it"""


def jets_into_puddle(
    camera: PinholeCamera,
    up: UpEvidence | None,
    mask: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
) -> Poured | None:
    """Jets that end in a round pool; None where no pool is seen from above.

    Args:
        camera: of the picture.
        up: its tilt, where that is known.
        mask: fluid pixels.
        motion: mean over the clip, px per frame.
        trust: of it.
    """
    tilt = up or UpEvidence(STREAM.pitch_prior[0], 0.0, "", 0.0)
    found = find_jets(level_camera(camera, tilt), mask, motion, trust)
    found = [down_to_landing(outline, mask, motion, trust) for outline in found]
    airborne = airborne_pixels(found, mask.shape)
    # wet traces on a bowl's rim, and what is left of a jet at the picture's edge, have no part in the outline
    lying = lying_pixels(airborne | largest_piece(mask & ~airborne), airborne)
    pool = fit_ellipse(lying)
    if not found or pool is None or pool.likeness < ROUND or lying.sum() < LEAST_SHARE * mask.sum():
        return None
    tallest = 1.0 if up is None else min(UPRIGHT * np.sin(np.radians(max(up.pitch, 0.0))), 1.0)
    return Poured(tuple(found), lying) if pool.flatness <= tallest else None


def down_to_landing(
    outline: Outline,
    mask: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
) -> Outline:
    """An outline that ends where its motion is lost, drawn on to where it lands.

    What lands within a frame is not seen again: optical flow ends a frame's way above the pool. How much of that way
    the jet is drawn on is how much of the trust is lost there.
    """
    step = outline.centers[-1] - outline.centers[-2]
    step = step / max(float(np.linalg.norm(step)), 1e-9)
    grid = np.stack(np.meshgrid(np.arange(mask.shape[1]), np.arange(mask.shape[0])), -1) + 0.5
    along = (grid - outline.centers[-1]) @ step
    aside = np.abs((grid - outline.centers[-1]) @ np.array([-step[1], step[0]]))
    half = float(outline.half_widths[-1])
    core = mask & (aside < 0.5 * half)
    end = core & outline.pixels & (along > -4.0 * half)
    if not end.any():
        return outline
    way = float(np.percentile((motion @ step)[end], 90))
    below = core & ~outline.pixels & (along > -half) & (along < way)
    if way <= 0 or not below.any():
        return outline
    kept = float(np.mean(trust[below])) / max(float(np.median(trust[outline.pixels])), 1e-6)
    reach = way * max(1.0 - kept, 0.0)
    drawn = outline.pixels | (mask & (aside < half) & (along > -half) & (along < reach))
    centers = np.concatenate([outline.centers, [outline.centers[-1] + reach * step]])
    return replace(outline, pixels=drawn, centers=centers, half_widths=np.append(outline.half_widths, half))


def puddle_tilt(lying: Bool[np.ndarray, "h w"], habit: UpEvidence) -> UpEvidence:
    """The camera's tilt from how flat a round pool looks: its height over its width is the sine of the pitch.

    Weighed against the usual view, as a pool may be out of round.

    Args:
        lying: pixels of the pool.
        habit: the tilt without this: its roll is kept, and all of it where the outline is no ellipse.
    """
    pool = fit_ellipse(lying)
    if pool is None or pool.likeness < ROUND or pool.flatness >= 1.0:
        return habit
    mean, sigma = STREAM.pitch_prior
    seen = np.arcsin(pool.flatness)
    error = np.degrees(OUT_OF_ROUND * np.tan(seen))  # d pitch = tan(pitch) d log(sin(pitch))
    weight = sigma**2 / (sigma**2 + error**2)
    pitch = mean + weight * (np.degrees(seen) - mean)
    return UpEvidence(float(pitch), habit.roll, "roundness of the puddle", float(0.5 * weight))
