"""The plane of the water before a moving camera: where what does not stand meets what does.

The shore is level, and what stands stands above it: of all planes through points near what flows, the one counts that
has most of them on it and the fewest points of the scene below it (RANSAC, Fischler and Bolles 1981, one-sided).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.motion.plane_sweep import Swept
from fluidlift.types import CameraPath

TRIALS = 2000
FLOWS = 1.6
"""times what a still thing shows, above which a place flows. Of made scenes, 0.95 of what stands lies below"""
STANDS, SURE = 1.2, 0.3
"""below this, and at other depths by so much more, the depth of a place is known"""
SHORE = (1, 7)
"""px of working size that the shore lies from what flows: nearer, the window sees both"""
SPECK = 0.004
"""part of the picture; what flows and is smaller is a leaf or what was hidden"""
LEVEL = 0.05
"""part of the camera's height over the water that a point of the shore may be off its level"""
STEEPEST, MOST_ROLL = 75.0, 15.0
"""degrees that a camera over water looks down, and is held off the level, at most"""
LEAST_PITCH = -15.0
"""degrees; a camera that looks up higher does not see the water's plane"""
BELOW = 3.0
"""how many points on the level one that lies below the water counts against: mirrored trees do, rocks do not"""
READ = 0.5
"""px of working size to which a shift is read"""
LEAST_SHORE = 40
"""px of shore of known depth"""
LEAST_SUPPORT = 0.4
"""share of the shore of some water that must lie on the level. Of branches before the sky 0.05 to 0.1 does by chance"""


@dataclass(frozen=True)
class WaterPlane:
    """n . x = d for a point x in the axes of the reference camera."""

    normal: Float[np.ndarray, "3"]
    """unit, up, in camera axes (x right, y down, z forward)"""
    height: float
    """of the camera over it, in units of the path: d = -height"""
    support: float
    """share of the shore that lies on it, 0 to 1"""
    water: Bool[np.ndarray, "h w"]
    """what flows and has that shore, at working size"""

    def inverse_depth(self, rays: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
        """1 over the depth at which rays of unit depth meet the plane; negative above its horizon."""
        return -(rays @ self.normal) / self.height

    @property
    def pitch(self) -> float:
        """Degrees that the camera looks below the water's horizon."""
        return float(np.degrees(np.arcsin(np.clip(-self.normal[2], -1.0, 1.0))))

    @property
    def roll(self) -> float:
        """Degrees that the picture is turned clockwise."""
        return float(np.degrees(np.arctan2(self.normal[0], -self.normal[1])))


def flowing(swept: Swept) -> Bool[np.ndarray, "h w"]:
    """What does not stand, without specks."""
    wet = cv2.medianBlur((swept.unlike > FLOWS).astype(np.uint8), 5)
    count, parts, stats, _ = cv2.connectedComponentsWithStats(wet, connectivity=4)
    large = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] > SPECK * wet.size)
    return (wet > 0) & np.isin(parts, large[large > 0]) if count > 1 else np.zeros(wet.shape, bool)


def water_plane(swept: Swept, path: CameraPath) -> WaterPlane | None:
    """The plane of the water, or None where too little of its shore is seen to lie on one.

    The inverse depth of a plane is linear in the picture: 1/z = -n . r / h for rays r of unit depth.

    Args:
        swept: the reference frame.
        path: in the axes of that frame.
    """
    wet = flowing(swept)
    if not wet.any():
        return None
    away = cv2.distanceTransform((~wet).astype(np.uint8), cv2.DIST_L2, 3)
    known = (swept.unlike < STANDS) & (swept.sure > SURE) & (swept.inverse_depth > 0)
    beside = known & (away > SHORE[0]) & (away <= SHORE[1])
    rest = np.flatnonzero((known & ~beside).ravel())
    rest = rest[:: max(1, len(rest) // 2000)]
    shore = np.flatnonzero(beside.ravel())
    if len(shore) < LEAST_SHORE:
        return None
    rays = swept.rays(path.focal).reshape(-1, 3)
    told = _read(swept, path).ravel()
    banks = _Banks(rays[shore], swept.inverse_depth.ravel()[shore], told[shore])
    others = _Banks(rays[rest], swept.inverse_depth.ravel()[rest], told[rest])
    rng = np.random.default_rng(0)
    best, most = None, -np.inf
    for _ in range(TRIALS):
        found = banks.through(rng.choice(len(shore), 3, replace=False))
        if found is not None and (score := _score(found, banks, others)) > most:
            best, most = found, score
    if best is None:
        return None
    for _ in range(5):  # least squares over what lies on it
        refined = banks.through(np.flatnonzero(np.abs(banks.above(best)) < 1.0))
        if refined is None or (score := _score(refined, banks, others)) < most:
            break
        best, most = refined, score
    water, support = _water_of(wet, beside, np.abs(banks.above(best)) < 1.0)
    size = float(np.linalg.norm(best))
    return WaterPlane(-best / size, 1.0 / size, support, water) if support >= LEAST_SUPPORT else None


def _water_of(wet: np.ndarray, beside: np.ndarray, on: np.ndarray) -> tuple[np.ndarray, float]:
    """The parts of what flows whose shore lies on the level, bool [h,w], and which share of theirs does."""
    parts = cv2.distanceTransformWithLabels((~wet).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_CCOMP)[1]
    part = parts[beside]
    found = [k for k in np.unique(part) if (part == k).sum() >= LEAST_SHORE and on[part == k].mean() >= LEAST_SUPPORT]
    return wet & np.isin(parts, found), float(on[np.isin(part, found)].mean()) if found else 0.0


def _read(swept: Swept, path: CameraPath) -> Float[np.ndarray, "h w"]:
    """How well inverse depth is read at each pixel: `READ` px of the largest shift over all frames."""
    rays, centers = swept.rays(path.focal), path.centers
    shift = np.zeros(rays.shape[:2])
    for center in centers[:: max(1, len(centers) // 16)]:
        shift = np.maximum(shift, np.linalg.norm(center[:2] - rays[..., :2] * center[2], axis=-1))
    return READ / np.maximum(path.focal * swept.scale * shift, 1e-9)


@dataclass(frozen=True)
class _Banks:
    """Points of what stands."""

    rays: np.ndarray
    """[n,3], unit depth"""
    inverse: np.ndarray
    """[n], 1 over depth"""
    read: np.ndarray
    """[n], how well that is known"""

    def above(self, plane: np.ndarray) -> np.ndarray:
        """[n]: height over a plane (1/z = plane . ray), in units of what a point may be off."""
        level = self.rays @ plane
        return (self.inverse - level) / (self.read + LEVEL * np.maximum(level, 0.0))

    def through(self, chosen: np.ndarray) -> np.ndarray | None:
        """The plane through these points, where a camera may stand so over it."""
        if len(chosen) < 3:
            return None
        weight = 1.0 / (self.read[chosen] + LEVEL * self.inverse[chosen])
        plane = np.linalg.lstsq(self.rays[chosen] * weight[:, None], self.inverse[chosen] * weight, rcond=None)[0]
        size = float(np.linalg.norm(plane))
        if size < 1e-12:
            return None
        found = WaterPlane(-plane / size, 1.0 / size, 0.0, np.zeros((0, 0), bool))
        usual = found.normal[1] < 0 and abs(found.roll) < MOST_ROLL and LEAST_PITCH < found.pitch < STEEPEST
        return plane if usual else None


def _score(plane: np.ndarray, banks: _Banks, others: _Banks) -> float:
    """Part of the shore on the level, less what lies below it elsewhere (at the shore it may be water)."""
    on = np.clip(1.0 - banks.above(plane) ** 2, 0.0, None).mean()
    return float(on - BELOW * (others.above(plane) < -2.0).mean())
