"""The bed of a stream that is seen through its water: its picture for the ground's texture, and the water's colour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage

from fluidlift.look import clear_water
from fluidlift.look.environment import Environment
from fluidlift.look.materials import WATER
from fluidlift.pipeline.sight import Sight
from fluidlift.shape import seen_bed
from fluidlift.types import BedEvidence, Estimate, PinholeCamera, Setting, VideoClip
from fluidlift.types.fluid_masks import FluidMasks

BESIDE = (3.0, 0.1)
"""px, and part of the picture's longer side: from there on to there lies the ground beside the fluid"""
BRIGHTEST = 95.0
"""percentile of it that no bed is brighter than: mostly ground, some of it sky and glare"""
SHARE = "bed_seen_share"
"""name of the share of the fluid's pixels among the estimates"""


@dataclass(frozen=True)
class BedPicture:
    """What is seen of a bed, as if it were dry and nothing stood on it."""

    picture: np.ndarray
    """u8 [h,w,3], sRGB"""
    known: np.ndarray
    """bool [h,w]"""
    evidence: BedEvidence


def bed_of(
    clip: VideoClip, fluid: FluidMasks, seen: Sight, setting: Setting, camera: PinholeCamera, depth: np.ndarray
) -> BedPicture | None:
    """None where no bed is seen: not of a stream, or its water shows none.

    Args:
        clip: with a camera that stands.
        fluid: its masks.
        seen: kind and motion.
        setting: bed and water level.
        camera: in the world.
        depth: camera z of the surface, m; 0 where there is none.
    """
    kind = seen.kind
    if not kind.is_channel_flow or kind.enters_over_rim or setting.surface_height is None:
        return None
    rays = camera.rays(camera.pixel_grid())
    upright = np.abs(rays[..., 2]) / np.linalg.norm(rays, axis=-1)
    found = seen_bed.still_layer(clip.frames, fluid, seen.motion, seen.trust, upright)
    if found is None:
        return None
    grid = setting.terrain.grid

    def column(values: np.ndarray, points: np.ndarray) -> np.ndarray:
        at = (points - grid.low[:2]) / grid.spacing - 0.5
        return ndimage.map_coordinates(np.asarray(values, float), at.T, order=1, mode="nearest")

    way = clear_water.bed_rays(
        camera, depth, lambda p: column(setting.bed_height, p),
        lambda p: column(cast(np.ndarray, setting.surface_height), p),
    )  # fmt: skip
    light, sky = clear_water.linear_picture(found.picture), Environment.sky()
    away = ndimage.distance_transform_edt(~fluid.any_frame())
    dry = light[(away > BESIDE[0]) & (away < BESIDE[1] * max(away.shape))]
    usual, brightest = (np.median(dry, axis=0), np.percentile(dry, BRIGHTEST, axis=0)) if len(dry) else (None, 1.0)
    estimates = clear_water.absorption_of(light, found.seen, way, sky, dry=usual)
    absorption = clear_water.absorption_in(estimates) or WATER.absorption
    below = clear_water.without_mirror(light, found.seen, way, sky)
    albedo = clear_water.dry_ground(below, way, absorption, brightest=brightest)
    if not np.isfinite(albedo).all(axis=-1).any():
        return None
    picture, known = clear_water.straight_picture(albedo, way, camera)
    n = len(clip)
    share = Estimate(
        found.share, float("inf"), False, found.share, "", None, f"what stays in the picture of {n} frames"
    )
    return BedPicture(picture, known, BedEvidence(found.seen, found.share, {SHARE: share} | estimates))
