"""Registration and scale, from the canonical frame of a single view to metres: the free scale, heading, origin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fluidlift.errors import InputRejected
from fluidlift.messages import NONE, Notice
from fluidlift.shape.heights import HeightModel
from fluidlift.types import (
    GRAVITY,
    FluidKind,
    MetricScale,
    PinholeCamera,
    RigidTransform,
    Similarity3,
    UpEvidence,
    kind_of,
)
from fluidlift.types.hints import Ruler
from fluidlift.types.kind import POUR

BANDS = 12
"""of height, with equal numbers of points, that a free fall is read from"""
FEWEST_FALLING = 10 * BANDS
"""points of it: fewer are one blur"""
LONGEST_FALL = 100.0
SHORTEST_FALL = 0.02
"""m across the fluid, between which a scale from free fall is believed"""
STEEP = 0.7
"""share of its speed that is downwards, from which something falls"""
LEAST_EXPLAINED = 0.8
"""share of the variance of the squared speed, over heights, that a straight line must explain"""
MEANT = 0.3
"""the same share, from which the bend of the line is looked at"""
UNSURE = 0.3
"""relative standard error of the acceleration from which it is no measurement"""
LEFT_OUT = 0.03
"""relative error of a scale from free fall for what the law leaves out: drag, a jet that widens, pictures in time"""
LEAN = np.radians(POUR.pitch_prior[1])
"""rad, how far camera and jet are off the tilt that they are taken for; seen from above, that changes the drop"""
BENT = 2.0
"""ratio of the accelerations of the lower and the upper half from which the law is not that of free fall"""
DISAGREEING = 1.25
"""ratio of a given size to a surveyed camera's from which one of them is wrong"""


@dataclass(frozen=True)
class FreeFall:
    """What the speeds of a fluid say about its free fall."""

    acceleration: float
    """length/s^2; 0 where nothing could be read"""
    standard_error: float
    """of the acceleration, length/s^2"""
    explained: float
    """share of the variance of the squared speed, over heights"""
    refusal: str = ""
    """why it is no measurement; empty: it is one"""


@dataclass(frozen=True)
class VelocityEvidence:
    """How velocities were seen."""

    trust: Float[np.ndarray, " n"] | None = None
    """0 to 1, of each; None: all alike"""
    interval: float = 0.0
    """s between the two pictures that a velocity comes from. It is the mean over that time, so it belongs to the middle
    of the way."""
    pitch: float = 0.0
    """degrees that the camera looks below the horizon"""


def pose_up(camera: PinholeCamera) -> tuple[UpEvidence, float]:
    """Tilt and heading (degrees, from the world's y axis towards -x) of a camera whose pose is known."""
    right, _, forward = camera.camera_from_world.rotation
    pitch = np.degrees(np.arcsin(np.clip(-forward[2], -1, 1)))
    heading = np.degrees(np.arctan2(-forward[0], forward[1]))
    level = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0.0])
    roll = np.degrees(np.arctan2(-right @ np.cross(forward, level), right @ level))
    return UpEvidence(float(pitch), float(roll), "camera file", 1.0), float(heading)


def fit_free_fall(
    points: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    *,
    seen: VelocityEvidence | None = None,
) -> FreeFall:
    """Acceleration of what falls, from v^2 = v0^2 + 2 g (z0 - z) (energy; no drag, no friction, steady in time).

    A straight line through v^2 over height, on the stretch where most of it goes down, by iterated least squares with
    Tukey's biweight, started from the medians of bands of height (Theil-Sen). The standard error is that of the bands
    as clusters (sandwich): the flow of neighbouring pixels shares its errors. Where the line explains too little, its
    two halves disagree, or the fluid would have started with a negative energy, the motion is not free fall (drag and a
    flow that saturates bend it down, viscous threads bend it up), and the result says so in `refusal`.

    Args:
        points: positions, any unit of length.
        velocities: in that unit per second, z up.
        seen: how.
    """
    seen = seen or VelocityEvidence()
    weight = np.ones(len(points)) if seen.trust is None else np.asarray(seen.trust, float)
    falls = _free_part(points[:, 2], velocities, weight)
    if falls.sum() < FEWEST_FALLING:
        return FreeFall(0.0, 0.0, 0.0, "too little of it falls")
    z = points[falls, 2] + 0.5 * seen.interval * velocities[falls, 2]
    moving, weight = velocities[falls], weight[falls]
    edges = np.quantile(z, np.linspace(0.0, 1.0, BANDS + 1))
    band = np.clip(np.searchsorted(edges, z, side="right") - 1, 0, BANDS - 1)
    filled = [k for k in range(BANDS) if (band == k).sum() >= 5]
    if len(filled) < BANDS // 2 or edges[-1] <= edges[0]:
        return FreeFall(0.0, 0.0, 0.0, "its fall spans too little height")
    drop = edges[-1] - z
    kept, given = np.ones(len(drop), bool), weight
    for _ in range(3):
        # again without the outliers, which shift medians too
        speed = (moving * _direction(drop, moving, np.where(kept, band, -1), filled)).sum(axis=1)
        line, weight = _robust_line(drop, speed, given, band, filled)
        kept = weight > 0
    # twice: an error of the speed counts twice in its square
    rest = 2.0 * (speed * np.sqrt(_positive(line, drop)) - _positive(line, drop))
    acceleration, error = 0.5 * line[1], 0.5 * _band_error(drop, rest, weight, band)
    centre, level = (np.array([np.average(x[band == k], weights=weight[band == k] + 1e-9) for k in filled])
                     for x in (drop, speed))  # fmt: skip
    level = level**2
    spread = np.square(level - level.mean()).sum()
    explained = 1.0 - float(np.square(level - line[0] - line[1] * centre).sum() / max(spread, 1e-300))
    refusal = _not_free(line, acceleration, error, explained, centre, level)
    return FreeFall(float(acceleration), error, max(explained, 0.0), refusal)


def _free_part(z, velocities, weight) -> np.ndarray:
    """bool [n], points of the longest stretch of height whose motion is mostly down: no pool below, no lip above."""
    known = np.isfinite(velocities).all(axis=1) & (weight > 0)
    if not known.any():
        return known
    steep = known & (-velocities[:, 2] > STEEP * np.linalg.norm(np.nan_to_num(velocities), axis=1))
    low, high = np.percentile(z[known], [0.5, 99.5])
    edges = np.linspace(low, high, 25)
    layer = np.clip(np.searchsorted(edges, z, side="right") - 1, 0, 23)
    count, down = (np.bincount(layer[x], minlength=24) for x in (known, steep))
    falls, best, run = down > 0.5 * np.maximum(count, 1), (0, 0), 0
    for k in range(24):
        run = run + 1 if falls[k] else 0
        if run > best[1] - best[0]:
            best = (k + 1 - run, k + 1)
    low, high = best
    if high - low > 6:  # where it dives in, and where it begins to fall, it is half something else
        low, high = low + (low > 0), high - (high < 24)
    return steep & (layer >= low) & (layer < high)


def _direction(drop, velocities, band, filled) -> np.ndarray:
    """Unit direction of the fall as a cubic of the drop through the medians of the bands. Speeds are measured along it:
    the square of the whole velocity would take the noise across it for energy."""
    bands = [k for k in filled if (band == k).any()]
    centre = np.array([np.median(drop[band == k]) for k in bands])
    medians = np.array([np.median(velocities[band == k], axis=0) for k in bands])
    medians /= np.maximum(np.linalg.norm(medians, axis=1, keepdims=True), 1e-300)
    smooth = np.polynomial.polynomial.polyval(drop, np.polynomial.polynomial.polyfit(centre, medians, 3)).T
    return smooth / np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-300)


def _positive(line, drop) -> np.ndarray:
    """v^2 on the line, kept positive."""
    return np.maximum(line[0] + line[1] * drop, 0.02 * max(np.abs(line[0] + line[1] * drop).max(), 1e-300))


def _robust_line(drop, speed, weight, band, filled) -> tuple[np.ndarray, np.ndarray]:
    """(v0^2, 2 g) of the line through (drop, v^2), and the weights that the points end with.

    The observed v^2 is speed times the root of the line, not the square of the speed, whose mean noise would raise.
    """
    centre = np.array([np.median(drop[band == k]) for k in filled])
    level = np.array([np.median(speed[band == k]) ** 2 for k in filled])
    i, j = np.triu_indices(len(filled), 1)
    apart = np.abs(centre[j] - centre[i]) > 1e-12
    slope = np.median((level[j] - level[i])[apart] / (centre[j] - centre[i])[apart])
    line = np.array([np.median(level - slope * centre), slope])
    columns, robust = np.stack([np.ones_like(drop), drop], axis=1), weight
    for _ in range(50):
        size = _positive(line, drop)
        energy = speed * np.sqrt(size)
        # v scatters in proportion to itself
        rest = energy / size - 1.0
        u = np.clip(rest / (4.685 * max(1.4826 * np.median(np.abs(rest)), 1e-6)), -1.0, 1.0)
        robust = weight * np.square(1.0 - u * u) / size**2
        normal = (columns * robust[:, None]).T @ columns
        if np.linalg.cond(normal) > 1e14:
            break
        new = np.linalg.solve(normal, (columns * robust[:, None]).T @ energy)
        done = np.abs(new - line).max() < 1e-7 * np.abs(new).max()
        line = new
        if done:
            break
    return line, robust


def _band_error(drop, rest, weight, band) -> float:
    """Standard error of the slope of a weighted line whose errors are shared inside a band (cluster sandwich)."""
    columns = np.stack([np.ones_like(drop), drop], axis=1)
    bread = np.linalg.pinv((columns * weight[:, None]).T @ columns)
    scores = np.stack([(columns * (weight * rest)[:, None])[band == k].sum(axis=0) for k in np.unique(band)])
    count = len(scores)
    # two numbers were fitted to the bands
    meat = scores.T @ scores * count / max(count - 2, 1)
    return float(np.sqrt(max((bread @ meat @ bread)[1, 1], 0.0)))


def _not_free(line, acceleration: float, error: float, explained: float, centre, level) -> str:
    """Why this is no free fall; empty where it may be one."""
    if acceleration <= 0:
        return "it does not get faster as it falls"
    half = len(centre) // 2
    order = np.argsort(centre)
    upper, lower = (np.polyfit(centre[order][part], level[order][part], 1)[0]
                    for part in (slice(None, half + 1), slice(half, None)))  # fmt: skip
    if explained > MEANT:
        if lower * BENT < upper:
            return "it stops getting faster on the way down, as under drag, or where optical flow cannot follow"
        if upper * BENT < lower:
            return "it hardly gets faster at first, as a viscous thread, or where it is still held"
    if error > UNSURE * acceleration:
        return f"its speed scatters too much (acceleration known to ± {100 * 1.96 * error / acceleration:.0f} %)"
    if explained < LEAST_EXPLAINED:
        return f"its speed does not follow the height (only {100 * explained:.0f} % of it does)"
    if line[0] < -0.1 * line[1] * centre.max():
        return "its speed would vanish below its top: the fluid is held back there"
    return ""


def metric_scale(
    kind: str | FluidKind,
    points: Float[np.ndarray, "n 3"],
    velocities: Float[np.ndarray, "n 3"],
    *,
    size: float | None = None,
    camera_height: float | None = None,
    known_scale: float | None = None,
    seen: VelocityEvidence | None = None,
    usual: float = 1.0,
) -> MetricScale:
    """Metres per canonical unit (design: a single view has no scale of its own).

    In this order: a given size (what a person asks for wins; where a camera says clearly otherwise, there is a
    warning), metric depth, a surveyed camera, free fall at 9.81 m/s^2 for what falls freely, the usual size.

    Args:
        kind: of the fluid.
        points: canonical positions on the fluid.
        velocities: canonical units per second at those points.
        size: metres across the fluid (the longest side of its bounding box), from the user.
        camera_height: metres of a surveyed camera above the level of a stream.
        known_scale: metres per canonical unit, where the depth came in metres.
        seen: how the velocities were seen.
        usual: m across such a fluid (`FluidKind.usual_size`).
    """
    extent = extent_of(points)
    drop = float(-np.median(points[:, 2])) if camera_height is not None else 0.0
    surveyed = camera_height / drop if camera_height is not None and camera_height > 0 and drop > 0 else None
    if size is not None:
        scale, warning = size / extent, NONE
        if surveyed is not None and not 1 / DISAGREEING < surveyed / scale < DISAGREEING:
            warning = Notice(
                "size-disagrees",
                f"the given size, {size:.3g} m across the fluid, is taken, but the camera file makes it "
                f"{surveyed * extent:.3g} m; leave out --size to use the camera's",
            )
        return MetricScale(scale, "size", warning, across=size)
    if known_scale is not None:
        return MetricScale(known_scale, "depth", across=known_scale * extent)
    if surveyed is not None:
        return MetricScale(surveyed, "camera", across=surveyed * extent)
    refusal = ""
    if kind_of(kind).falls_freely:
        fall = fit_free_fall(points, velocities, seen=seen)
        refusal = fall.refusal
        if not refusal:
            across = GRAVITY / fall.acceleration * extent
            if SHORTEST_FALL < across < LONGEST_FALL:
                # the scale goes with the inverse of the acceleration: the relative errors are the same
                lean = LEAN * np.tan(np.radians(abs(seen.pitch if seen else 0.0)))
                relative = float(np.linalg.norm([fall.standard_error / fall.acceleration, LEFT_OUT, lean]))
                return MetricScale(across / extent, "free fall", relative_error=relative, across=across)
            refusal = f"it would be {across:.3g} m across"
    because = f" (free fall does not tell: {refusal})" if refusal else ""
    return MetricScale(
        usual / extent,
        "assumed",
        Notice(
            "size-unknown",
            f"the size of the fluid is unknown{because}: {usual:.2g} m across is assumed, and speeds and gravity "
            "follow from it; give --size METRES (or a camera file with a pose) for true units",
        ),
        across=usual,
        refusal=refusal,
    )


def ruler_scale(camera: PinholeCamera, points: Float[np.ndarray, "n 3"], ruler: Ruler) -> MetricScale:
    """Metres per canonical unit by something of known length that lies on the fluid's surface.

    The surface is taken for the plane that fits its points best; the ends of the ruler may lie beside the fluid.

    Args:
        camera: at the origin of the canonical frame.
        points: canonical, on the fluid.
        ruler: px of the camera's picture.

    Raises:
        InputRejected: an end at which the plane is not seen, such as one above the horizon.
    """
    middle = np.median(points, axis=0)
    normal = np.linalg.svd(points - middle, full_matrices=False)[2][2]
    rays = camera.rays(np.array([ruler.begin, ruler.end], float))
    toward = rays @ normal
    away = (middle - camera.position) @ normal
    along = away / np.where(np.abs(toward) < 1e-9, 1e-9, toward)
    farthest = 20.0 * float(np.linalg.norm(points - camera.position, axis=1).max())
    if (along <= 0).any() or (along * np.linalg.norm(rays, axis=1) > farthest).any():
        raise InputRejected(
            "an end of the ruler lies where the fluid's surface is not seen (at its horizon, or above)",
            "two points on the fluid's surface, or beside it", "move the ruler, or correct the horizon",
        )  # fmt: skip
    ends = camera.position + rays * along[:, None]
    value = ruler.metres / float(np.linalg.norm(ends[1] - ends[0]))
    return MetricScale(value, "ruler", across=value * extent_of(points))


def extent_of(points: Float[np.ndarray, "n 3"]) -> float:
    """The longest side of the box around points, without outliers."""
    return float(np.ptp(np.percentile(points, [0.5, 99.5], axis=0), axis=0).max())


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
class PlacedHeight(HeightModel):
    """A canonical height model seen in the world."""

    model: HeightModel
    world_from_canonical: Similarity3

    @property
    def steps(self) -> bool:
        """As the model has it."""
        return self.model.steps

    def height(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """World z above world ground positions, m. The placement only turns about z, so heights stay heights."""
        t = self.world_from_canonical
        return t.scale * self.model.height(self._local(xy)) + t.translation[2]

    def sheet(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Greatest thickness of the fluid there, m; infinite where the surface does not say."""
        return self.world_from_canonical.scale * self.model.sheet(self._local(xy))

    def _local(self, xy: np.ndarray) -> np.ndarray:
        t = self.world_from_canonical
        return (np.asarray(xy) - t.translation[:2]) @ t.rotation[:2, :2] / t.scale
