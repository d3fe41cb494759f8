"""A fluid's visible surface from a depth picture: what the picture can say is taken from it, the rest from physics.

Learned depth has slow errors of some per cent, which turn level water into a hill, and its noise is larger than waves.
A stream, however, is level across: what its depth shows to be uneven across is error, and measures the error of its
slope. So a stream's surface is a smooth function of the way along it, and its slope is weighed against what streams
have. Everything lives in the canonical frame of `shape.surface`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage
from scipy.linalg import solve

from fluidlift.errors import InputRejected
from fluidlift.shape.given_depth import SceneDepth, robust_plane, without_rim
from fluidlift.shape.heights import HeightModel, ProfileHeight
from fluidlift.shape.plume import SIGHT
from fluidlift.shape.surface import FrontSurface, inflated_surface, intersect_height
from fluidlift.shape.view import ViewContext, habit_prior
from fluidlift.shape.view.habit import ROLL
from fluidlift.types import FluidKind, Grid, Label, PinholeCamera, SlopeEvidence, UpEvidence, kind_of
from fluidlift.types.kind import STEEPEST_STREAM, STREAM

SLOPES: tuple[tuple[float, float, float], ...] = ((0.7, 0.5, 2.0), (0.3, 0.0, 20.0))
"""share, mean and standard deviation (degrees, down is positive) of how streams slope: most are nearly level, films and
chutes are not (a choice; it matters where the depth is uncertain by more than 2 degrees)"""
RELIEF = 0.01
"""height of what a stream's surface deviates from an even slope, over its length (a choice: standing waves, drops)"""
CROWN = 0.03
"""height of what a stream's surface deviates from being level across, over its width (a choice: films have a crown of a
tenth, rivers waves of some hundredths)"""
COARSE = 0.01
"""relative error of slow changes from which the depth is a learned one, whose bends are not believed"""
MODEL_TILT = 4.5
"""degrees, standard deviation of the tilt by the plane of a learned depth: true depth of two streams, spoilt as models
spoil it, put up 4.3 and 4.6 degrees off (docs/depth.md)"""
LEAN = 0.05
"""way back per height of a fall that stands upright: a height model knows one height over each point of the ground"""
FEWEST_NORMALS = 64
"""px of fluid, in all frames together, whose normals tell a plane"""
ALIGNED = 0.7
"""length of the mean of unit normals below which they are of no plane: half of all directions, at random, have 0.5,
waves as steep as 20 degrees 0.94"""
KNOTS = 12
"""of a profile along the stream: its pieces are about as long as a stream is wide"""


@dataclass(frozen=True)
class DepthSlope:
    """How a stream slopes, by its depth."""

    degrees: float
    """taken: downstream is positive"""
    measured: float
    """by the depth alone, degrees"""
    standard_error: float
    """of the measured one, degrees"""
    source: str = "depth"


@dataclass(frozen=True)
class AlongHeight(HeightModel):
    """A stream: level across, z a function of the way along it; beyond its ends it goes on at its mean slope."""

    direction: tuple[float, float]
    """unit vector on the ground, downstream"""
    along: Float[np.ndarray, " k"]
    """increasing"""
    z: Float[np.ndarray, " k"]
    relief: Relief | None = None
    """what stands out of that"""

    def height(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """z above the ground positions."""
        s = xy[..., 0] * self.direction[0] + xy[..., 1] * self.direction[1]
        mean = (self.z[-1] - self.z[0]) / max(self.along[-1] - self.along[0], 1e-12)
        beyond = np.minimum(s - self.along[0], 0.0) + np.maximum(s - self.along[-1], 0.0)
        z = np.interp(s, self.along, self.z) + mean * beyond
        return z if self.relief is None else z + self.relief.height(s, self._across(xy))

    def _across(self, xy: np.ndarray) -> np.ndarray:
        return xy[..., 1] * self.direction[0] - xy[..., 0] * self.direction[1]


@dataclass(frozen=True)
class Relief:
    """Crowns, humps and hollows of a stream, on a map of the ways along and across; it ends as its edge is."""

    low: tuple[float, float]
    """along and across, of the first node"""
    step: tuple[float, float]
    """between nodes"""
    z: Float[np.ndarray, "m n"]

    def height(self, along: Float[np.ndarray, "*n"], across: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """z above the profile."""
        at = np.stack([(along - self.low[0]) / self.step[0], (across - self.low[1]) / self.step[1]])
        return ndimage.map_coordinates(self.z, at, order=1, mode="nearest")


def plane_normal(camera: PinholeCamera, depth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"]) -> np.ndarray:
    """Unit normal, in the camera's own axes, towards the camera, of the plane that most of the masked depth lies in.

    For a plane, inverse depth is linear in the pixel's position: 1/z = n . r / h with r = (x, y, 1).
    """
    known = without_rim(mask & np.isfinite(depth) & (depth > 0))
    grid = camera.pixel_grid()[known]
    x = (grid[:, 0] - camera.center[0]) / camera.focal[0]
    y = (grid[:, 1] - camera.center[1]) / camera.focal[1]
    a, b, c = robust_plane(x, y, 1.0 / depth[known].astype(np.float64))
    normal = -np.array([b, c, a])
    return normal / np.linalg.norm(normal)


def facing(
    normals: Float[np.ndarray, "n h w 3"], fluid: Bool[np.ndarray, "n h w"], area: Bool[np.ndarray, "h w"],
    camera: PinholeCamera,
) -> Float[np.ndarray, "3"] | None:  # fmt: skip
    """Unit normal, in the camera's own axes, of the plane that most of the fluid's surface lies in, by its normals.

    Waves tilt them to all sides, which a median evens out. What is seen faces the camera, whichever sign they have.

    Args:
        normals: of some frames, camera axes; nan: not known.
        fluid: mask of each of them.
        area: the fluid that it is wanted of.
        camera: its pose is not used.

    Returns:
        None where too little of the fluid has normals.
    """
    use = fluid & area & np.isfinite(normals).all(axis=-1)
    if use.sum() < FEWEST_NORMALS:
        return None
    grid = camera.pixel_grid()
    ray = np.concatenate([(grid - camera.center) / camera.focal, np.ones((*grid.shape[:2], 1))], axis=-1)
    found = normals[use].astype(np.float64)
    away = (found * np.broadcast_to(ray, normals.shape)[use]).sum(axis=-1) > 0
    found[away] *= -1.0
    if np.linalg.norm(found.mean(axis=0)) < ALIGNED:
        return None
    middle = np.median(found, axis=0)
    return middle / np.linalg.norm(middle)


def up_from_depth(
    scene: SceneDepth, camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"], *, normal: Float[np.ndarray, "3"] | None = None,
) -> tuple[UpEvidence, float]:  # fmt: skip
    """Up and slope (degrees) of a stream whose camera's tilt nobody knows, from the plane that its depth lies in.

    The plane is level across the stream. How far it falls along it cannot be seen: each slope asks for another tilt of
    the camera, and the likeliest pair is taken (mean over what is possible). `normal` of that plane: see `facing`; by
    default that of the depth.
    """
    normal = plane_normal(camera, scene.depth, mask) if normal is None else normal
    flow = _flow_on_plane(camera, normal, mask, displacement, confidence)
    angles = np.arange(0.0, 45.5, 0.5)
    share = _share_of(angles, SLOPES)
    pitches, rolls, belief = [], [], []
    for angle in np.radians(angles):
        # gravity turned so that the plane falls along the flow by this angle
        up = normal if flow is None else np.cos(angle) * normal - np.sin(angle) * flow
        pitch, roll = float(np.degrees(-np.arcsin(np.clip(up[2], -1, 1)))), float(np.degrees(np.arctan2(up[0], -up[1])))
        pitches.append(pitch)
        rolls.append(roll)
        belief.append(np.exp(habit_prior(STREAM, np.array([pitch]), ViewContext())[0] - 0.5 * (roll / ROLL) ** 2))
    weight = share * np.asarray(belief) + 1e-30
    best = float((angles * weight).sum() / weight.sum()) if flow is not None else 0.0
    k = int(np.argmin(np.abs(angles - best)))
    return UpEvidence(pitches[k], rolls[k], f"plane of the {scene.source}", 0.8), float(angles[k])


def model_normal(
    camera: PinholeCamera, depth: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], faces: np.ndarray | None
) -> tuple[np.ndarray, float]:
    """Unit normal of a stream by a learned model, and its standard deviation in degrees.

    Depth and normals are two answers of one network about the same plane: their mean is taken, and by how much they
    differ tells, too, how far it can be off.
    """
    plane = plane_normal(camera, depth, mask)
    if faces is None:
        return plane, MODEL_TILT
    apart = float(np.degrees(np.arccos(np.clip(plane @ faces, -1.0, 1.0))))
    both = plane + faces
    return both / max(float(np.linalg.norm(both)), 1e-9), max(MODEL_TILT, 0.5 * apart)


def weighed_up(seen: UpEvidence, by_model: UpEvidence, error: float) -> UpEvidence:
    """Up by what the clip shows and by a learned model: each counts by how sure it is.

    Where both are far apart, one of them is wrong, and the spread says so.

    Args:
        seen: by motion, sky, plumb lines and more; its error is the spread of what the pitch may be.
        by_model: by a learned depth.
        error: of that, degrees.
    """
    if seen.error <= 0.0:  # nothing is known of how sure it is
        return replace(by_model, error=error)
    weights = np.array([seen.error, error]) ** -2.0
    share = weights / weights.sum()
    pitch, roll = (float(share @ [getattr(seen, n), getattr(by_model, n)]) for n in ("pitch", "roll"))
    spread = max(float(weights.sum() ** -0.5), 0.5 * abs(seen.pitch - by_model.pitch))
    roll = seen.roll if seen.source.startswith("user") else roll
    source = f"{by_model.source} ({100 * share[1]:.0f} %), {seen.source}"
    return UpEvidence(pitch, roll, source, max(seen.confidence, by_model.confidence), spread)


def _share_of(degrees: np.ndarray, slopes: tuple[tuple[float, float, float], ...]) -> np.ndarray:
    return np.sum([w / s * np.exp(-0.5 * np.square((degrees - m) / s)) for w, m, s in slopes], axis=0)


def slopes_by_motion(found: SlopeEvidence | None) -> tuple[tuple[float, float, float], ...]:
    """What the motion of a stream lets expect of its slope, as a mixture like `SLOPES`."""
    if found is None:
        return SLOPES
    if found.source.startswith("energy"):  # its perspective has been found level, and its speeds say how level
        return (0.95, found.slope, 1.0), (0.05, 0.0, SLOPES[1][2])
    level = SLOPES[0][1]
    error = max(found.standard_error, 1.0)
    return (
        (0.95 * found.level_share, level, 1.0), (0.95 * (1.0 - found.level_share), found.likeliest, error),
        (0.05, 0.0, SLOPES[1][2]),
    )  # fmt: skip


def _flow_on_plane(camera, normal, mask, displacement, confidence) -> np.ndarray | None:
    """Unit vector in camera axes, in the plane, along the mean motion; None where there is none."""
    weight = np.where(mask, confidence, 0.0) * np.linalg.norm(displacement, axis=-1)
    use = weight > 0.1 * weight.max(initial=0.0)
    if not use.any() or weight.max() <= 0:
        return None
    start = camera.pixel_grid()[use]
    ends = []
    for uv in (start, start + displacement[use]):
        ray = np.stack([(uv[:, 0] - camera.center[0]) / camera.focal[0],
                        (uv[:, 1] - camera.center[1]) / camera.focal[1], np.ones(len(uv))], axis=1)  # fmt: skip
        ends.append(ray / np.maximum(-(ray @ normal), 1e-3)[:, None])
    mean = np.average(ends[1] - ends[0], axis=0, weights=confidence[use])
    size = np.linalg.norm(mean)
    return mean / size if size > 1e-9 else None


def stream_surface(
    scene: SceneDepth, camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"], *, slopes: tuple[tuple[float, float, float], ...] = SLOPES,
    usual: HeightModel | None = None,
) -> tuple[FrontSurface, DepthSlope]:  # fmt: skip
    """A stream: level across, its profile along the flow from the depth as far as that is sure.

    Args:
        scene: depth of the whole picture.
        camera: canonical (`kind.level_camera`): its tilt is known.
        mask: the fluid.
        displacement: mean optical flow, px per frame.
        confidence: of the flow.
        slopes: share, mean and standard deviation (degrees) of the slopes that are expected.
        usual: the surface as it is taken to be without the depth, in the same units: it bends as that does where the
            depth is not sure; None: it is even there.

    Raises:
        InputRejected: the surface stands on edge: the depth is not of this view.
    """
    use = without_rim(mask & np.isfinite(scene.depth))
    points = camera.unproject(camera.pixel_grid()[use], scene.depth[use].astype(np.float64))
    rotation = camera.camera_from_world.rotation
    normal = plane_normal(camera, scene.depth, mask) @ rotation
    tilt = float(np.degrees(np.arccos(np.clip(normal[2], -1.0, 1.0))))
    if tilt > STEEPEST_STREAM:
        raise InputRejected(
            f"a {scene.source} in which the stream stands {tilt:.0f} degrees steep",
            "depth of this view, and the camera's tilt that belongs to it",
            "check camera and --pitch, that the depth is camera z, and --kind",
        )  # fmt: skip
    gradient = -normal[:2] / normal[2]
    flow = _flow_on_plane(camera, rotation @ normal, mask, displacement, confidence)
    ground = -gradient if flow is None else (rotation.T @ flow)[:2]
    direction = ground / max(np.linalg.norm(ground), 1e-12) if np.linalg.norm(ground) > 1e-9 else np.array([0.0, -1.0])
    s = points[:, :2] @ direction
    # relative error of depth moves a point along its ray: this much of it is height
    lift = np.abs(points @ normal) / normal[2]
    across = points[:, 1] * direction[0] - points[:, 0] * direction[1]
    before = np.zeros(len(s)) if usual is None else usual.height(points[:, :2])
    uneven = _unevenness(s, across, points[:, 2], lift, scene.floor)
    if scene.floor >= COARSE:
        uneven = max(uneven, _bumpiness(s, across, (points[:, 2] - before), lift))
    height, evidence = _profile(s, points[:, 2], before, lift * uneven, slopes)
    model = AlongHeight((float(direction[0]), float(direction[1])), *height)
    model = replace(model, relief=_relief(s, across, points[:, 2] - model.height(points[:, :2]), lift * uneven))
    near, far = 0.3 * float(np.nanmin(scene.depth[use])), 4.0 * float(np.nanmax(scene.depth[use]))
    depth = intersect_height(camera, model, near, far)
    middle = float(np.median(depth[mask & (depth > 0)])) if (mask & (depth > 0)).any() else 0.0
    if middle <= 0:
        raise InputRejected(f"a {scene.source} whose surface the camera does not see", "depth of this view")
    known = np.where(depth > 0, depth, 0.0)
    return FrontSurface(known.astype(np.float32), np.zeros(mask.shape, np.float32), model), evidence


def _unevenness(s: np.ndarray, across: np.ndarray, z: np.ndarray, lift: np.ndarray, floor: float) -> float:
    """Relative error of depth that changes slowly: by how much the two sides of the stream differ in height.

    In pieces along the stream; a crown, which viscous films have, is alike on both sides and no error.
    """
    piece = np.clip(((s - s.min()) / max(np.ptp(s), 1e-12) * 6).astype(int), 0, 5)
    error = []
    for k in range(6):
        here = piece == k
        if here.sum() < 60:
            continue
        _, b, _ = robust_plane(across[here], s[here], z[here])
        error.append(b * np.ptp(np.percentile(across[here], [2, 98])) / np.sqrt(12.0) / np.median(lift[here]))
    return max(floor, float(np.sqrt(np.mean(np.square(error))))) if error else max(floor, 0.01)


def _bumpiness(s: np.ndarray, across: np.ndarray, rest: np.ndarray, lift: np.ndarray) -> float:
    """Relative error of depth, if all that bends against the usual surface is error: a learned depth's bends are."""
    columns = np.stack([np.ones_like(s), s], axis=1)
    rest = rest - columns @ np.linalg.lstsq(columns, rest, rcond=None)[0]
    cells = [np.clip(((v - v.min()) / max(np.ptp(v), 1e-12) * 6).astype(int), 0, 5) for v in (s, across)]
    index = cells[0] * 6 + cells[1]
    count = np.bincount(index, minlength=36)
    mean = (np.bincount(index, rest / np.maximum(lift, 1e-9), minlength=36) / np.maximum(count, 1))[count > 20]
    return float(np.sqrt(np.mean(mean**2))) if len(mean) else 0.0


def _relief(s: np.ndarray, across: np.ndarray, rest: np.ndarray, error: np.ndarray) -> Relief | None:
    """What is left of the height, smoothed, even across, and as far as it stands out from the error."""
    low = np.array([np.percentile(v, 1.0) for v in (s, across)])
    high = np.array([np.percentile(v, 99.0) for v in (s, across)])
    width = float(high[1] - low[1])
    nodes = np.array([2 * KNOTS, KNOTS])
    step = np.maximum((high - low) / (nodes - 1), 1e-9)
    index = [np.clip(np.round((v - lo) / st).astype(int), 0, n - 1)
             for v, lo, st, n in zip((s, across), low, step, nodes)]  # fmt: skip
    cell = index[0] * nodes[1] + index[1]
    order = np.lexsort((rest, cell))
    count = np.bincount(cell, minlength=int(nodes.prod()))
    ends = np.cumsum(count)
    filled = count > 0
    value = np.zeros(len(count))
    value[filled] = rest[order][(ends - count // 2 - 1)[filled]]
    weight = np.minimum(count / max(float(np.median(count[filled])), 1.0), 1.0).reshape(nodes)
    value = ndimage.gaussian_filter(value.reshape(nodes) * weight, 1.0) / (ndimage.gaussian_filter(weight, 1.0) + 0.05)
    usual = (CROWN * width) ** 2
    keep = usual / (usual + np.square(float(np.median(error))))
    return Relief((float(low[0]), float(low[1])), (float(step[0]), float(step[1])), keep * value)


def _profile(s, z, before, error, slopes) -> tuple[tuple[np.ndarray, np.ndarray], DepthSlope]:
    """z over the way along the stream: slope and bends, each as far as it stands out from the error.

    `error` (per point, m) belongs to slow changes: it does not shrink with the number of points. An error that is
    linear over the length L with this size at its ends makes a slope of error / (L / sqrt 12).
    """
    low, high = np.percentile(s, [1.0, 99.0])
    length = max(float(high - low), 1e-9)
    middle = 0.5 * (low + high)
    shift, slope = robust_plane(s - middle, None, z)
    typical = float(np.median(error))
    se = np.degrees(np.arctan(typical * np.sqrt(12.0) / length))
    measured = -float(np.degrees(np.arctan(slope)))
    taken = _weighed(measured, se, slopes)
    line = -np.tan(np.radians(taken))
    knots = np.linspace(low, high, KNOTS)
    keep = (RELIEF * length) ** 2 / ((RELIEF * length) ** 2 + typical**2)
    even = robust_plane(s - middle, None, before)
    bends = [_smooth_bins(s, v - (a + b * (s - middle)), knots) for v, a, b in ((z, shift, slope), (before, *even))]
    heights = shift + line * (knots - middle) + keep * bends[0] + (1.0 - keep) * bends[1]
    if taken > 0:  # water does not run uphill over a length that matters
        heights = 0.5 * (np.minimum.accumulate(heights) + np.maximum.accumulate(heights[::-1])[::-1])
    return (knots, heights), DepthSlope(taken, measured, float(se))


def _weighed(measured: float, error: float, slopes: tuple[tuple[float, float, float], ...]) -> float:
    """Mean of the slope (degrees) after the measurement. Water runs downhill."""
    angles = np.arange(0.0, STEEPEST_STREAM, 0.25)
    belief = _share_of(angles, slopes) * np.exp(-0.5 * np.square((angles - measured) / max(error, 0.1)))
    total = float(belief.sum())
    return float((angles * belief).sum() / total) if total > 1e-300 else max(measured, 0.0)


def _smooth_bins(s: np.ndarray, rest: np.ndarray, knots: np.ndarray) -> np.ndarray:
    """Medians at the knots, smoothed by their second difference; a knot without points takes its neighbours' line."""
    step = knots[1] - knots[0]
    index = np.round((s - knots[0]) / step).astype(int)
    count = np.array([(index == k).sum() for k in range(len(knots))], float)
    level = np.array([np.median(rest[index == k]) if count[k] else 0.0 for k in range(len(knots))])
    weight = np.minimum(count / max(np.median(count), 1.0), 1.0)
    bend = np.diff(np.eye(len(knots)), 2, axis=0)
    return solve(np.diag(weight) + 1.0 * bend.T @ bend + 1e-6 * np.eye(len(knots)), weight * level, assume_a="pos")


def fall_surface(scene: SceneDepth, camera: PinholeCamera, mask: Bool[np.ndarray, "h w"]) -> FrontSurface:
    """A sheet that falls: the same across, from the medians of the picture's rows.

    Raises:
        InputRejected: depth in fewer than four rows of the fluid.
    """
    use = without_rim(mask & np.isfinite(scene.depth))
    rows = np.where(use.sum(axis=1) >= 3)[0]
    if len(rows) < 4:
        raise InputRejected(f"a {scene.source} with {len(rows)} rows on the fluid", "at least 4")
    points = camera.unproject(camera.pixel_grid(), np.where(use, scene.depth, np.nan).astype(np.float64))
    away = np.array([np.nanmedian(points[r, :, 1]) for r in rows])
    z = np.array([np.nanmedian(points[r, :, 2]) for r in rows])
    sigma = max(1.5, len(rows) / 40)
    away, z = (ndimage.gaussian_filter1d(v, sigma, mode="nearest")[::-1] for v in (away, z))  # from the foot up
    # higher is never nearer: what hangs over is not seen from the front
    away = 0.5 * (np.maximum.accumulate(away) + np.minimum.accumulate(away[::-1])[::-1])
    z = np.maximum.accumulate(z)
    away = away + np.maximum.accumulate(np.concatenate([[0.0], np.cumsum(LEAN * np.diff(z) - np.diff(away))]))
    keep = np.concatenate([[True], np.diff(away) > 1e-6])
    profile = ProfileHeight(away[keep], z[keep])
    low, high = np.nanmin(scene.depth[use]), np.nanmax(scene.depth[use])
    depth = intersect_height(camera, profile, 0.5 * float(low), 2.0 * float(high))
    return FrontSurface(depth.astype(np.float32), np.zeros(mask.shape, np.float32), profile)


def airborne_surface(
    scene: SceneDepth, camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], kind: str | FluidKind
) -> FrontSurface:
    """A body in the air: thickness from its silhouette, its middle in the plane of its depth.

    Depth of smoke and of thin jets is a mixture of what is before and behind; its plane is what can be believed.
    """
    use = without_rim(mask & np.isfinite(scene.depth))
    grid = camera.pixel_grid()
    x = (grid[..., 0] - camera.center[0]) / camera.focal[0]
    y = (grid[..., 1] - camera.center[1]) / camera.focal[1]
    a, b, c = robust_plane(x[use], y[use], 1.0 / scene.depth[use].astype(np.float64))
    inverse = a + b * x + c * y
    near, far = np.nanpercentile(1.0 / scene.depth[use], [99, 1])
    plane = 1.0 / np.clip(inverse, far, near)
    gas, round_body = kind_of(kind).is_gas, inflated_surface(camera, mask, kind)
    # smoke is seen where enough of it lies in front; of a jet the front is seen
    share = 2.0 * SIGHT if gas else np.pi / 4
    half = round_body.half_thickness * plane
    front = np.where(mask, plane - share * half, 0.0)
    return FrontSurface(front.astype(np.float32), half.astype(np.float32), None, is_gas=gas)


def solid_heights(
    depth: Float[np.ndarray, "h w"], labels: UInt8[np.ndarray, "h w"], camera: PinholeCamera, grid: Grid
) -> Float[np.ndarray, "nx ny"]:
    """Height (m, world) of the solids that the picture shows above each column of a grid; nan where none is seen.

    Args:
        depth: camera depth of the whole picture, m; nan or 0: unknown.
        labels: `Label` of each pixel: those of the fluid say nothing about the ground.
        camera: in the world.
        grid: of the scene.
    """
    solid = (labels != Label.FLUID) & np.isfinite(depth) & (depth > 0)
    heights = np.full(grid.shape[:2], np.nan)
    points = camera.unproject(camera.pixel_grid()[solid], depth[solid].astype(np.float64))
    cell = np.floor((points[:, :2] - np.asarray(grid.origin)[:2]) / grid.spacing).astype(int)
    ok = ((cell >= 0) & (cell < grid.shape[:2])).all(axis=1)
    index = cell[ok, 0] * grid.shape[1] + cell[ok, 1]
    order = np.lexsort((points[ok, 2], index))
    index, z = index[order], points[ok, 2][order]
    first = np.flatnonzero(np.concatenate([[True], np.diff(index) > 0])) if len(index) else np.zeros(0, int)
    count = np.diff(np.append(first, len(index)))
    heights.reshape(-1)[index[first]] = z[first + count // 2]
    return heights
