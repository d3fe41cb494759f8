"""What of a fluid's look stays in place and what moves with it.

Foam, bubbles and dirt are carried along; shade, depth, the white of a fall and the dark of its pool stay where they
are although the water runs through. Carried colours alone smear the second kind downstream.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.numerics.over_time import sorted_over_time
from fluidlift.numerics.short_axis import mean_of
from fluidlift.types import SH_C0, Gaussians, PinholeCamera, sh_from_rgb
from fluidlift.types.rows import rows

LARGEST_RATIO = 2.0
"""a colour is brightened or darkened by no more than this when it moves to another place"""

LARGEST_TINT = 1.25
"""and no channel against the others by more than this: a bank beside the mask must not colour the water"""

BASE = 0.25
"""share of the time that a place is darker than its shade. In the mean, a lane where much foam passes would count as
bright water, and what is carried out of it would turn dark"""

FIXED = 0.35
"""natural logarithm by which the brightness of a place may differ, all the time, from that of its surroundings: a
shadow, a stone or a mirror image stands there, and is no pattern that flows"""


@dataclass(frozen=True)
class SteadyShading:
    """The slowly varying part of what the fluid looks like in each place while no foam passes."""

    image: Float[np.ndarray, "h w 3"]
    """sRGB in (0, 1]; outside the fluid, that of the nearest fluid"""
    camera: PinholeCamera
    fixed: Bool[np.ndarray, "h w"] | None = None
    """pixels of things that stand still in the picture and are smaller than the shading's blur; None: not known"""

    @classmethod
    def of(
        cls,
        frames: UInt8[np.ndarray, "t h w 3"],
        fluid: Bool[np.ndarray, "t h w"],
        camera: PinholeCamera,
        *,
        width: float = 0.03,
    ) -> SteadyShading | None:
        """The lower quartile over the frames in which a pixel is fluid, blurred inside it; None without fluid.

        Args:
            frames: sRGB.
            fluid: in each of them.
            camera: in the world.
            width: standard deviation of the blur over the picture's longer side.
        """
        mask = fluid.mean(axis=0) > 0.5
        if not mask.any():
            return None
        base = _base(frames, fluid, mask)
        sigma = width * max(mask.shape)
        weight = ndimage.gaussian_filter(mask.astype(np.float32), sigma)
        blurred = np.stack([ndimage.gaussian_filter(base[..., c] * mask, sigma) for c in range(3)], axis=-1)
        smooth = blurred / np.maximum(weight, 1e-6)[..., None]
        index = ndimage.distance_transform_edt(~mask, return_distances=False, return_indices=True)
        smooth = smooth[tuple(index)]
        return cls(np.clip(smooth, 0.02, 1.0).astype(np.float32), camera, _fixed(base, smooth, mask, sigma))

    def at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The shading where each point is seen; that of the nearest pixel outside the picture."""
        row, col, _ = self.camera.nearest_pixels(points)
        return rows(self.image.reshape(-1, 3), row * self.image.shape[1] + col)

    def moved(self, shown: Gaussians, origin: Float[np.ndarray, "n 3"]) -> Gaussians:
        """Gaussians whose colours were taken at `origin`, shaded for where they are now.

        What is as colourful as the fluid was there takes the hue of the fluid here; foam is white everywhere.
        """
        here, there = self.at(shown.means), self.at(origin)
        bright = (mean_of(here) / mean_of(there))[:, None]
        tint = np.clip(here / there / bright, 1.0 / LARGEST_TINT, LARGEST_TINT)
        sh = shown.sh.copy()
        color = np.clip(0.5 + SH_C0 * sh[:, 0], 0.0, 1.0)
        tint **= np.clip(_saturation(color) / np.maximum(_saturation(there), 1e-3), 0.0, 1.0)[:, None]
        ratio = np.clip(bright, 1.0 / LARGEST_RATIO, LARGEST_RATIO) * tint
        sh[:, :1] = sh_from_rgb(np.clip(color * ratio, 0.0, 1.0))
        return Gaussians(shown.means, shown.quats, shown.scales, shown.opacities, sh)


def _saturation(color: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """0 for grey, 1 for pure colours."""
    r, g, b = color.T
    return 1.0 - np.minimum(np.minimum(r, g), b) / np.maximum(np.maximum(np.maximum(r, g), b), 1e-6)


def _base(frames: np.ndarray, fluid: np.ndarray, mask: np.ndarray) -> Float[np.ndarray, "h w 3"]:
    """Lower quartile over time of what is fluid in at most 24 frames; 0 outside of the mask."""
    pick = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), 24)).astype(int))
    wet = fluid[pick][:, mask]
    # what is no fluid goes to the end of the order
    order = sorted_over_time(np.where(wet[..., None], frames[pick][:, mask].astype(np.float32), np.float32(np.inf)))
    at = np.round(BASE * (np.maximum(wet.sum(axis=0), 1) - 1)).astype(int)
    found = np.take_along_axis(order, at[None, :, None], axis=0)[0]
    out = np.zeros((*mask.shape, 3), np.float32)
    out[mask] = np.where(np.isfinite(found), found, frames[pick][:, mask].mean(axis=0)) / 255.0
    return out


def _fixed(base: np.ndarray, smooth: np.ndarray, mask: np.ndarray, sigma: float) -> np.ndarray:
    """Pixels that are much brighter or darker than their surroundings while no foam passes."""
    fine = np.maximum(ndimage.gaussian_filter(base.mean(axis=-1), 0.1 * sigma), 0.02)
    odd = np.abs(np.log(fine / np.maximum(smooth.mean(axis=-1), 0.02))) > FIXED
    return ndimage.binary_dilation(odd & mask, iterations=max(round(0.1 * sigma), 1))
