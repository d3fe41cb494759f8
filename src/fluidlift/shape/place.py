"""From the canonical frame of a single view to metres: the one free scale, the heading, the origin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.shape.kind import Kind, UpEvidence
from fluidlift.types import PinholeCamera, RigidTransform, Similarity3

STANDARD_GRAVITY = 9.81


@dataclass(frozen=True)
class MetricScale:
    """Metres per canonical unit and where that came from."""

    value: float
    source: str
    """size, camera, free fall, or assumed"""
    warning: str = ""


def pose_up(camera: PinholeCamera) -> tuple[UpEvidence, float]:
    """Tilt and heading (degrees, from the world's y axis towards -x) of a camera whose pose is known."""
    right, _, forward = camera.camera_from_world.rotation
    pitch = np.degrees(np.arcsin(np.clip(-forward[2], -1, 1)))
    heading = np.degrees(np.arctan2(-forward[0], forward[1]))
    level = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0.0])
    roll = np.degrees(np.arctan2(-right @ np.cross(forward, level), right @ level))
    return UpEvidence(float(pitch), float(roll), "camera file", 1.0), float(heading)


def free_fall_acceleration(
    points: Float[np.ndarray, "n 3"], velocities: Float[np.ndarray, "n 3"], *, bins: int = 12
) -> tuple[float, float]:
    """Acceleration (length/s^2) of what falls, from v^2 = v0^2 + 2 g (z0 - z), and the share of variance explained.

    Args:
        points: positions, any unit of length.
        velocities: in that unit per second.
        bins: heights at which the median is taken, against outliers.
    """
    speed2 = np.where(velocities[:, 2] < 0, (velocities**2).sum(1), np.nan)
    ok = np.isfinite(speed2)
    if ok.sum() < 10 * bins:
        return 0.0, 0.0
    z, s = points[ok, 2], speed2[ok]
    edges = np.quantile(z, np.linspace(0.05, 0.95, bins + 1))
    centre, median = [], []
    for low, high in zip(edges[:-1], edges[1:]):
        inside = (z >= low) & (z <= high)
        if inside.sum() >= 5:
            centre.append(z[inside].mean())
            median.append(np.median(s[inside]))
    if len(centre) < 4 or np.ptp(centre) <= 0:
        return 0.0, 0.0
    slope, _ = np.polyfit(centre, median, 1)
    r = np.corrcoef(centre, median)[0, 1]
    return float(-slope / 2.0), float(r * r) if np.isfinite(r) else 0.0


def metric_scale(
    kind: Kind,
    points: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    *,
    size: float | None = None,
    camera_height: float | None = None,
    known_scale: float | None = None,
) -> MetricScale:
    """Metres per canonical unit (design: a single view has no scale of its own).

    Args:
        kind: of the fluid.
        points: canonical positions on the fluid.
        velocities: canonical units per second at those points.
        size: metres across the fluid (the longest side of its bounding box), from the user.
        camera_height: metres of a surveyed camera above the level of a stream.
        known_scale: metres per canonical unit, where the depth came in metres.
    """
    extent = float(np.ptp(np.percentile(points, [0.5, 99.5], axis=0), axis=0).max())
    if size is not None:
        return MetricScale(size / extent, "size")
    if known_scale is not None:
        return MetricScale(known_scale, "depth")
    if camera_height is not None and camera_height > 0:
        drop = float(-np.median(points[:, 2]))
        if drop > 0:
            return MetricScale(camera_height / drop, "camera")
    if kind in ("fall", "pour"):
        acceleration, explained = free_fall_acceleration(points, velocities)
        if acceleration > 0 and explained > 0.5:
            scale = STANDARD_GRAVITY / acceleration
            if 0.02 < scale * extent < 100.0:
                return MetricScale(scale, "free fall")
    return MetricScale(
        1.0 / extent,
        "assumed",
        "the size of the fluid is unknown: 1 m across is assumed, and speeds and gravity follow from it; "
        "give --size METRES (or a camera file with a pose) for true units",
    )


def place(
    camera: PinholeCamera,
    points: Float[np.ndarray, "n 3"],
    scale: float,
    *,
    heading: float | None,
    eye: Float[np.ndarray, "3"] | None,
    mainstream: Float[np.ndarray, "3"],
) -> tuple[Similarity3, PinholeCamera]:
    """world_from_canonical and the camera in the world.

    A surveyed camera keeps its world. Otherwise the world's origin is below the middle of the fluid, and x runs along
    the mainstream where that has a horizontal part, so that a river runs along an axis of its grid.
    """
    if heading is not None and eye is not None:
        turn = np.radians(heading)
    else:
        along = mainstream[:2]
        turn = -np.arctan2(along[1], along[0]) if np.linalg.norm(along) > 0.5 else 0.0
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = scale * (points @ rotation.T)
    low, high = np.percentile(moved, 0.5, axis=0), np.percentile(moved, 99.5, axis=0)
    shift = eye if eye is not None else -np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]])
    world_from_canonical = Similarity3(scale, rotation, shift)
    turned = camera.camera_from_world.rotation @ rotation.T
    pose = RigidTransform(turned, -turned @ np.asarray(shift))
    return world_from_canonical, PinholeCamera(camera.focal, camera.center, camera.size, pose)


@dataclass(frozen=True)
class PlacedHeight:
    """A canonical height model seen in the world."""

    model: object
    world_from_canonical: Similarity3

    def height(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """World z above world ground positions, m. The placement only turns about z, so heights stay heights."""
        t = self.world_from_canonical
        local = (np.asarray(xy) - t.translation[:2]) @ t.rotation[:2, :2] / t.scale
        return t.scale * self.model.height(local) + t.translation[2]  # type: ignore[attr-defined]
