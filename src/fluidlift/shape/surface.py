"""Where the visible surface of a fluid is: level planes, falling profiles, inflated silhouettes, given depths.

Everything here lives in the canonical frame: origin at the camera, z up, y away from the viewer, lengths in units in
which the fluid is about 1 away. `place` (shape/registration.py) turns that into metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.errors import InputRejected, require
from fluidlift.shape import chute, sections, slope
from fluidlift.shape.energy_line import Channel, energy_profile
from fluidlift.shape.filled_vessel import FilledVessel
from fluidlift.shape.heap import Heap
from fluidlift.shape.heights import (
    FARTHEST,
    FOOT,
    HeightModel,
    PlaneHeight,
    ProfileAlongHeight,
    ProfileHeight,
    SampledHeight,
)
from fluidlift.shape.plume import SIGHT, section_half_thickness
from fluidlift.types import FluidKind, PinholeCamera, SlopeEvidence, kind_of


@dataclass(frozen=True)
class FrontSurface:
    """The visible side of a fluid in one picture, canonical units."""

    depth: Float[np.ndarray, "h w"]
    """camera z at every pixel where the model has one, else 0 (not limited to the mask for height models)"""
    half_thickness: Float[np.ndarray, "h w"]
    """half the extent along the view for bodies in the air; 0 for a fluid that lies on something"""
    height: HeightModel | None
    """for a fluid that lies on something"""
    slope: SlopeEvidence | None = None
    """where its motion was asked how steep it runs"""
    is_gas: bool = False
    """whether it is seen within instead of at its surface"""
    chutes: tuple[Bool[np.ndarray, "h w"], ...] = ()
    """pixels of each chute that comes down onto it"""
    vessel: FilledVessel | None = None
    """that holds its lower part"""
    heap: Heap | None = None
    """that it forms on something"""

    @property
    def sighted(self) -> Float[np.ndarray, "h w"]:
        """Camera z at which the fluid is seen in the mean: of smoke within it, of all else on its near side."""
        return self.depth + (2.0 * SIGHT * self.half_thickness if self.is_gas else 0.0)


def level_surface(camera: PinholeCamera, mask: Bool[np.ndarray, "h w"]) -> FrontSurface:
    """A horizontal plane below the camera, at the height that puts the median fluid pixel at depth 1."""
    down = -camera.rays(camera.pixel_grid())[..., 2]
    below = down[mask]
    require(len(below) > 0, "an empty mask")
    visible = down > max(float(np.percentile(below, 99)) / FARTHEST, 1e-3)
    if not (visible & mask).any():
        raise InputRejected(
            "the camera looks above the horizon at every fluid pixel",
            "a tilt that sees the surface of a stream from above",
            "give --pitch with a larger value, or another --kind",
        )
    drop = float(np.median(down[mask & visible]))
    return _from_height(PlaneHeight((0.0, 0.0), -drop), np.where(visible, drop / np.maximum(down, 1e-6), 0.0))


def stream_surface(
    camera: PinholeCamera,
    mask: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
    interval: float,
    *,
    camera_height: float | None = None,
    tilt_known: bool = True,
    prior: slope.SlopePrior = slope.USUAL_SLOPES,
) -> FrontSurface:
    """The surface of a stream or a film: as steep as its motion shows, and lower where it has become faster.

    The plane comes from `slope.estimate_slope`. Where the camera's height over the water is known, so are metres per
    second, and along a streamline of the surface, at the pressure of the air, v^2 / 2g + z falls by friction alone
    (Bernoulli): the water that speeds up stands lower, and it slopes at least as Manning's formula says. A stream that
    slows down is taken to lose that energy in eddies instead of rising.

    Where a chute comes down onto it (`chute.find_chutes`), it is level: water that loses most of its speed at once is
    slower than its waves from there on, and hardly falls. So it is below a chute as wide as the stream
    (`sections.estimate_sections`).

    Args:
        camera: canonical, z up.
        mask: fluid pixels.
        motion: mean optical flow, px per interval.
        trust: of the flow, 0 to 1.
        interval: s.
        camera_height: m above the water, where surveyed.
        tilt_known: the camera's tilt was given.
        prior: of the slope.

    Raises:
        InputRejected: the camera does not look down at the surface.
    """
    below_chutes = chutes_on_level(camera, mask, motion, trust)
    if below_chutes is not None:
        return below_chutes
    patches = slope.flow_patches(mask, motion, trust)
    broken = _chute_above_pool(camera, mask, sections.estimate_sections(camera, patches))
    if broken is not None:
        return broken
    evidence = slope.estimate_slope(camera, patches, tilt_known=tilt_known, prior=prior)
    front = level_surface(camera, mask) if evidence.slope == 0 else _sloping_plane(camera, mask, evidence)
    front = replace(front, slope=evidence)
    if patches is None or camera_height is None or camera_height <= 0:
        return front
    return _with_energy(camera, mask, front, patches, evidence, camera_height, interval)


def chutes_on_level(
    camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"], ledges: Bool[np.ndarray, "h w"] | None = None,
) -> FrontSurface | None:  # fmt: skip
    """A level surface with the chutes that come down onto it; None where there are none, or they are not seen.

    Args:
        camera: canonical, z up.
        mask: fluid pixels.
        motion: mean optical flow, px per interval.
        trust: of the flow, 0 to 1.
        ledges: pixels of the chutes, as a person marked them; None: they are looked for.
    """
    marked = [] if ledges is None else chute.pieces(ledges)
    parts = marked or chute.chute_pixels(camera, mask, motion, trust)
    lying = mask & ~np.any(parts, axis=0) if parts else mask
    if not parts or not lying.any():
        return None
    level = level_surface(camera, lying)
    assert level.height is not None
    found = chute.find_chutes(camera, mask, motion, trust, level.height, marked)
    if not found:
        return None
    model = chute.ChuteHeight(level.height, tuple(found))
    near = 0.5 * float(level.depth[lying & (level.depth > 0)].min())
    front = _from_height(model, intersect_height(camera, model, near, FARTHEST * 2.0 * near))
    if not (front.depth[mask] > 0).mean() > 0.9:
        return None
    steepest, heading = max(c.slope for c in found), float(np.degrees(found[0].heading))
    source = "a chute that comes down onto level water"
    slopes = SlopeEvidence(0.0, chute.AMISS, heading, 1.0, 0.0, source, steepest)
    return replace(front, slope=slopes, chutes=tuple(c.pixels for c in found))


def _chute_above_pool(camera, mask, found: sections.SectionEvidence) -> FrontSurface | None:
    """A chute as wide as the stream, and the level below it; None where that is not sure."""
    if found.best is None or found.share < sections.SURE:
        return None
    down = -camera.rays(camera.pixel_grid())[..., 2]
    usual = 1.0 / float(np.median(down[mask & (down > 1e-3)]))  # depth of the pool's level, one below the camera
    best = replace(found.best, chute=found.mean)
    along, z = best.height((best.foot - 3.0 * usual, best.foot + 3.0 * usual))
    ahead = (float(np.cos(best.heading)), float(np.sin(best.heading)))
    model = ProfileAlongHeight(ahead, along, z)
    depth = intersect_height(camera, model, 0.1 * usual, FARTHEST * usual)
    if not (depth[mask] > 0).mean() > 0.98:
        return None
    scale = 1.0 / float(np.median(depth[mask & (depth > 0)]))
    points = camera.unproject(camera.pixel_grid()[mask], scale * depth[mask])
    s = np.percentile(points[:, :2] @ ahead, [2.0, 98.0])
    scaled = ProfileAlongHeight(ahead, scale * along, scale * z)
    fall = scaled.height(np.array([s[0] * np.array(ahead), s[1] * np.array(ahead)]))
    mean = float(np.degrees(np.arctan2(fall[0] - fall[1], s[1] - s[0])))
    source = "perspective of the motion: a chute above level water"
    heading = float(np.degrees(best.heading))
    evidence = SlopeEvidence(mean, found.standard_error, heading, 1.0 - found.share, mean, source, found.mean)
    above = np.zeros_like(mask)
    above[mask] = points[:, :2] @ ahead < scale * best.foot
    return replace(_from_height(scaled, scale * depth), slope=evidence, chutes=(above,))


def _sloping_plane(camera: PinholeCamera, mask: np.ndarray, evidence: SlopeEvidence) -> FrontSurface:
    """A plane at depth 1 in the median over the fluid."""
    axes = slope.plane_axes(np.radians(evidence.slope), np.radians(evidence.heading))
    facing = -camera.rays(camera.pixel_grid()) @ axes[2]
    visible = facing > max(float(np.percentile(facing[mask], 99)) / FARTHEST, 1e-3)
    drop = float(np.median(facing[mask & visible]))
    normal = axes[2]
    plane = PlaneHeight((-normal[0] / normal[2], -normal[1] / normal[2]), -drop / normal[2])
    return _from_height(plane, np.where(visible, drop / np.maximum(facing, 1e-6), 0.0))


def _with_energy(camera, mask, front, patches, evidence, camera_height, interval):
    """The same surface, bent along the stream by what its speeds say (m, s), and the evidence completed."""
    angle, heading = np.radians(evidence.slope), np.radians(evidence.heading)
    axes = slope.plane_axes(angle, heading)
    seen = mask & (front.depth > 0)
    points = camera.unproject(camera.pixel_grid()[seen], front.depth[seen].astype(np.float64))
    metres = camera_height / -float(np.median(points[:, 2]))
    drop = -float(np.median(points @ axes[2]))
    along, speed = slope.speed_along(camera, patches, axes, drop)
    across = points @ axes[1]
    width = metres * float(np.ptp(np.percentile(across, [5.0, 95.0])))
    run, fall = energy_profile(
        metres * along, metres * speed / interval, patches.weight, Channel(width, evidence.slope)
    )
    # distances along the slope, seen over the ground
    ground = run / metres * np.cos(angle)
    middle = np.median(points[:, :2] @ axes[0, :2]) / max(np.cos(angle), 1e-9)
    start = float(np.median(points[:, 2]))
    z = start - (fall - np.interp(middle, ground, fall)) / metres
    ahead = (float(np.cos(heading)), float(np.sin(heading)))
    profile = ProfileAlongHeight(ahead, ground, z)
    bent = _from_height(profile, intersect_height(camera, profile, 0.2, FARTHEST))
    if not (bent.depth[seen] > 0).mean() > 0.98:
        return front
    mean = float(np.degrees(np.arctan2(fall[-1] - fall[0], metres * (ground[-1] - ground[0]))))
    source = evidence.source if evidence.slope > 0 else "energy of the motion, and friction"
    return replace(bent, slope=replace(evidence, slope=mean, source=source))


def falling_surface(
    camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"],
) -> FrontSurface:  # fmt: skip
    """A sheet that is steep where the picture shows the fluid falling and flat where it runs.

    The inclination per picture row follows from how much of the motion points down; the profile is then integrated
    along the rays from the row of strongest fall, both ways. Where the motion leans from the projected vertical, the
    sheet is taken to lie on a rock face whose fall line is seen to lean so (`_fall_line`): what is thrown sideways
    through the air would straighten on its way down.
    """
    rows = np.where(mask.any(axis=1))[0]
    require(len(rows) > 1, "a mask of fewer than two rows")
    weight = np.where(mask, confidence, 0.0)
    down = np.where(mask, displacement[..., 1], 0.0)
    speed = np.linalg.norm(displacement, axis=-1)
    total = weight.sum(1)[rows] + 1e-6
    fall = (weight * np.maximum(down, 0.0)).sum(1)[rows] / total
    share = (weight * np.maximum(down, 0.0)).sum(1)[rows] / ((weight * speed).sum(1)[rows] + 1e-6)
    strength = ndimage.gaussian_filter1d(fall / max(np.percentile(fall, 90), 1e-6) * share, max(2.0, len(rows) / 40))
    blend = np.clip((strength - 0.2) / 0.35, 0.0, 1.0)
    blend = blend * blend * (3 - 2 * blend)
    falls = np.zeros(mask.shape[0])
    falls[rows] = blend > 0.5
    aside, steepest = _fall_line(camera, weight * falls[:, None], displacement)
    incline = np.radians(FOOT) + (steepest - np.radians(FOOT)) * blend
    ray = camera.rays(np.stack([_axis(mask, rows, blend > 0.5), rows + 0.5], -1))
    uphill = (-float(np.sin(aside)), float(np.cos(aside)))
    ry, rz = ray[:, 0] * uphill[0] + ray[:, 1] * uphill[1], ray[:, 2]
    depth = np.ones(len(rows))
    start = int(np.argmax(strength))
    # above the strongest fall a flatter surface could hardly be seen from below; nowhere is it seen edge-on
    incline[:start] = np.maximum(incline[:start], min(np.radians(70.0), steepest))
    incline = np.maximum(incline, np.arctan2(rz, ry) + np.radians(10.0))
    for step in (1, -1):
        for i in range(start, len(rows) - 1 if step > 0 else 0, step):
            j = i + step
            # (z_j rz_j - z_i rz_i) = tan(incline) (z_j ry_j - z_i ry_i), solved for the next depth
            t = np.tan(0.5 * (incline[i] + incline[j]))
            below = rz[j] - t * ry[j]
            next_depth = depth[i] * (rz[i] - t * ry[i]) / below if abs(below) > 1e-3 else depth[i]
            depth[j] = np.clip(next_depth, depth[i] * 0.9, depth[i] * 1.1)  # a grazing ray does not run away
    points = ray * depth[:, None]
    up = points[:, 0] * uphill[0] + points[:, 1] * uphill[1]
    order = np.argsort(up)
    away, z = up[order], np.maximum.accumulate(points[order, 2])
    keep = np.concatenate([[True], np.diff(away) > 1e-6])
    profile = ProfileHeight(away[keep], z[keep], uphill)
    return _from_height(profile, intersect_height(camera, profile, 0.2 * depth.min(), 3.0 * depth.max()))


FACE = (78.0, 12.0, 30.0)
"""degrees: how steep falls usually are, by how much they differ, and by how much their faces turn from the viewer (a
choice). A lean of 17 degrees becomes a face 64 degrees steep that falls 40 degrees to the side"""


def _fall_line(camera: PinholeCamera, weight: np.ndarray, displacement: np.ndarray) -> tuple[float, float]:
    """Heading of the fall line, rad to the right of towards the viewer, and the face's greatest steepness, rad.

    Of all faces whose fall line is seen to lean as the motion does, the one that differs least from the usual one.
    """
    moved = (weight * np.linalg.norm(displacement, axis=-1))[..., None] * displacement
    x, y = moved.sum((0, 1))
    right, down = -camera.camera_from_world.rotation[:2, 2]
    lean = float(np.clip(np.arctan2(x, y) - np.arctan2(right, down), -0.8, 0.8)) if y > 0 else 0.0
    if abs(lean) < 1e-3:
        return 0.0, float(np.radians(FACE[0]))
    aside = np.radians(np.arange(0.5, 85.0, 0.5))
    steep = np.minimum(np.arctan2(np.sin(aside), np.tan(abs(lean))), np.radians(FACE[0]))
    leans = np.sin(aside) >= np.tan(abs(lean)) * np.tan(steep) - 1e-6
    odd = ((FACE[0] - np.degrees(steep)) / FACE[1]) ** 2 + (np.degrees(aside) / FACE[2]) ** 2
    best = int(np.argmin(np.where(leans, odd, np.inf)))
    return float(np.copysign(aside[best], lean)), float(steep[best])


def _axis(mask: np.ndarray, rows: np.ndarray, falls: np.ndarray) -> np.ndarray:
    """px, a straight line along the middle of the falling rows, held between its ends beyond them."""
    if falls.sum() < 3:
        return np.full(len(rows), 0.5 * mask.shape[1])
    columns = np.arange(mask.shape[1]) + 0.5
    middle = (mask[rows] * columns).sum(1) / mask[rows].sum(1).clip(1)
    line = np.polyval(np.polyfit(rows[falls], middle[falls], 1), rows)
    return np.clip(line, line[falls].min(), line[falls].max())


def intersect_height(camera: PinholeCamera, model: HeightModel, near: float, far: float) -> Float[np.ndarray, "h w"]:
    """Camera depth where each pixel's ray first goes below a height model (0 where it never does)."""
    rays = camera.rays(camera.pixel_grid())
    eye = camera.position
    depth = np.zeros(rays.shape[:2])
    found = np.zeros(rays.shape[:2], bool)
    steps = np.geomspace(near, far, 96)
    previous = steps[0]
    low, high = np.zeros_like(depth), np.zeros_like(depth)
    for z in steps[1:]:
        p = eye + rays * z
        below = (p[..., 2] < model.height(p[..., :2])) & ~found
        low[below], high[below] = previous, z
        found |= below
        previous = z
    for _ in range(10):
        middle = 0.5 * (low + high)
        p = eye + rays * middle[..., None]
        below = p[..., 2] < model.height(p[..., :2])
        high, low = np.where(below, middle, high), np.where(below, low, middle)
    depth[found] = 0.5 * (low + high)[found]
    return depth


def inflated_surface(
    camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], kind: str | FluidKind, roll: float = 0.0
) -> FrontSurface:
    """A rounded body in the air: its middle in a vertical plane facing the viewer, its thickness from the silhouette.

    Where the silhouette is 2R wide the body is taken to be a circle across: about its middle line, or of a gas in level
    sections.

    Args:
        camera: level, its tilt as known.
        mask: fluid pixels.
        kind: of the body.
        roll: degrees that the picture is turned clockwise.
    """
    require(bool(mask.any()), "an empty mask")
    gas, ray = kind_of(kind).is_gas, camera.rays(camera.pixel_grid())
    middle = 1.0 / np.maximum(ray[..., 1], 0.2)  # plane y = 1: depth z with z * ray_y = 1
    middle /= np.median(middle[mask])
    thickness = section_half_thickness(mask, roll) if gas else _half_thickness(mask)
    half = thickness * middle / camera.focal[0]
    front = np.where(mask, middle - half, 0.0)
    return FrontSurface(front.astype(np.float32), half.astype(np.float32), None, is_gas=gas)


def _half_thickness(mask: np.ndarray) -> np.ndarray:
    """Half the extent along the view, px, of a body that is round about its middle line."""
    padded = np.pad(mask, 2, mode="edge")  # a body cut by the picture's edge goes on beyond it
    distance = ndimage.distance_transform_edt(padded)[2:-2, 2:-2]
    ridge = (distance == ndimage.maximum_filter(distance, size=5)) & mask
    index = ndimage.distance_transform_edt(~ridge, return_distances=False, return_indices=True)
    radius = np.maximum(ndimage.gaussian_filter(distance[tuple(index)], 3.0), distance)
    thickness = np.sqrt(np.maximum(2 * radius * distance - distance**2, 0.0))
    return ndimage.gaussian_filter(thickness, 1.5) * mask


def given_surface(
    camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], depth: Float[np.ndarray, "h w"], kind: str | FluidKind
) -> FrontSurface:
    """The user's depth, scaled to a median of 1 on the fluid.

    Raises:
        InputRejected: the depth says nothing on most of the fluid.
    """
    valid = mask & np.isfinite(depth) & (depth > 0)
    if valid.sum() < 0.5 * mask.sum():
        raise InputRejected(
            f"a depth map that is empty on {100 * (1 - valid.sum() / max(mask.sum(), 1)):.0f} % of the fluid",
            "positive camera depths on the fluid pixels",
        )
    index = ndimage.distance_transform_edt(~valid, return_distances=False, return_indices=True)
    filled = depth[tuple(index)] / np.median(depth[valid])
    kind = kind_of(kind)
    if kind.airborne:
        half = inflated_surface(camera, mask, kind).half_thickness
        front = filled - (2.0 * SIGHT * half if kind.is_gas else 0.0)
        return FrontSurface(np.where(mask, front, 0.0).astype(np.float32), half, None, is_gas=kind.is_gas)
    rows, cols = np.where(valid)
    pick = np.linspace(0, len(rows) - 1, min(len(rows), 20000)).astype(int)
    points = camera.unproject(np.stack([cols[pick] + 0.5, rows[pick] + 0.5], -1), filled[rows[pick], cols[pick]])
    return _from_height(SampledHeight(points), filled)


def _from_height(model: HeightModel, depth: np.ndarray) -> FrontSurface:
    return FrontSurface(depth.astype(np.float32), np.zeros_like(depth, dtype=np.float32), model)
