"""Chutes: where water runs down steeply onto the level or gently sloping fluid below.

In the picture a chute is a piece of the fluid that moves down, much faster than what lies around it, and whose motion
ends where it meets that. A jet in the air does the same, but along the vertical (`shape.jets`); a chute leans, because
it also moves on over the ground. It is taken to run the way the water below its foot goes on, so that the angle between
the two motions in the picture shows how steep it is.

What spreads on the level from the foot of a jet, or from a source, looks the same but for one thing: it loses its speed
on the way, while water that runs down gains speed, or keeps it where friction takes all that gravity gives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.shape import jets, slope, spreading
from fluidlift.shape.heights import FARTHEST, HeightModel
from fluidlift.types import PinholeCamera

DOWN = np.cos(np.radians(75.0))
"""share of its motion that goes down the picture, at least"""
SLOWER = 0.5
"""speed of the fluid around the foot over that on the chute, at most: a current in a pool keeps its own for widths"""
LEAST_SHARE, MOST_SHARE = 0.01, 0.4
"""of the fluid's pixels: less is a splash, more is a stream of its own"""
LEAST_SLOPE, MOST_SLOPE = 12.0, 75.0
"""degrees"""
USUAL = (35.0, 15.0)
"""degrees, mean and standard deviation of chutes (a choice: steeper ones are falls, flatter ones streams). It counts
where a chute comes straight towards the viewer, or away: its motion then points down the picture at any slope"""
UNSURE = 6.0
"""degrees, standard error of the angle between the motion on a chute and that below it"""
AMISS = 12.0
"""degrees between the motion seen and that on the chute that explains it best, at most"""
FEWEST = 60
"""pixels"""
LEAST_EXCESS = 0.1
"""px per frame: twice the error of optical flow at its best (`slope.LEAST_NOISE`); this is its mean over a clip. At 60
and more frames per second, or slowed down, water that falls over a weir moves by 0.3 to 0.5"""
SHEET = 0.1
"""greatest thickness of a chute over its width: that of a fall (`types.kind.FALL.depth_ratio`)"""
SCALED = 0.5
"""relative standard error of a size from a chute's speed: friction on the way, and what optical flow misses, enter its
square. On a weir filmed at a quarter of its speed the size came out 16 to 17 times the true one, as it should"""
LOSES = 0.5
"""share of its kinetic energy that the water of a chute may seem to lose from its upper to its lower end. Down a slope
it loses none (v^2 = v0^2 + 2 g dz, less friction, which grows with v^2 and stops at what gravity gives) unless it
enters faster than the slope can keep; errors of flow and of the slope take some. Water that spreads as 1/r loses three
quarters by twice the radius. Of real footage weirs and cascades kept 0.9 to 3 times theirs, honey less than 0.4"""
FLANK = 0.25
"""of its half width, over which a chute's surface comes down to the fluid beside it"""


@dataclass(frozen=True)
class Chute:
    """A plane that comes down onto the surface below, canonical units."""

    foot: tuple[float, float, float]
    """middle of its lower end, on that surface"""
    heading: float
    """rad from the canonical x axis towards y, where it runs to"""
    slope: float
    """degrees"""
    half_width: float
    length: float
    """over the ground"""
    pixels: Bool[np.ndarray, "h w"]

    def rise(self, xy: Float[np.ndarray, "*n 2"]) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
        """z of its plane above the ground positions, straight on beyond its top, and how far (0 to 1) it holds there:
        1 on it, 0 beside it and below its foot."""
        ahead = np.array([np.cos(self.heading), np.sin(self.heading)])
        away = np.asarray(xy) - np.asarray(self.foot[:2])
        s, c = away @ ahead, away[..., 1] * ahead[0] - away[..., 0] * ahead[1]
        z = self.foot[2] - np.tan(np.radians(self.slope)) * np.maximum(s, -1.2 * self.length)
        beside = np.clip((np.abs(c) / self.half_width - 1.0) / FLANK, 0.0, 1.0)
        return z, np.where(s < 0, 1.0 - beside, 0.0)


@dataclass(frozen=True)
class ChuteHeight(HeightModel):
    """A surface with chutes that come down onto it."""

    below: HeightModel
    chutes: tuple[Chute, ...]

    @property
    def steps(self) -> bool:
        """True: each chute has an upper end."""
        return True

    def height(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """z above the ground positions."""
        z = self.below.height(xy)
        for chute in self.chutes:
            plane, share = chute.rise(xy)
            z = z + share * np.maximum(plane - z, 0.0)
        return z

    def sheet(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Greatest thickness of the fluid above the ground positions: a chute is a sheet as a fall is (`SHEET` of its
        own width), for it is as fast; infinite elsewhere."""
        thick = np.full(np.shape(xy)[:-1], np.inf)
        z = self.below.height(xy)
        for chute in self.chutes:
            plane, share = chute.rise(xy)
            thick = np.where((share > 0) & (plane > z), np.minimum(thick, SHEET * 2.0 * chute.half_width), thick)
        return thick


def chute_pixels(
    camera: PinholeCamera,
    mask: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
) -> list[Bool[np.ndarray, "h w"]]:
    """Pieces of the fluid that move down the picture and much faster than what lies around them, largest first.

    Args:
        camera: its tilt gives the projected vertical.
        mask: fluid pixels.
        motion: mean over the clip, px per frame.
        trust: of the motion, 0 to 1.
    """
    if mask.sum() < 10 * FEWEST:
        return []
    down = jets.projected_vertical(camera)
    speed = np.linalg.norm(motion, axis=-1)
    usual, spread = jets.lying_motion(mask, motion, trust, (motion * down).sum(-1) > DOWN * speed)
    excess = np.linalg.norm(motion - usual, axis=-1)
    goes_down = ((motion - usual) * down).sum(-1) > DOWN * excess
    clear = (excess > max(jets.CONTRAST * spread, LEAST_EXCESS)) & (excess > jets.FASTER * speed)
    fast = speed > np.linalg.norm(usual, axis=-1) / (1.0 - jets.FASTER)
    candidate = mask & (trust > jets.TRUSTED) & ((motion * down).sum(-1) > DOWN * speed) & goes_down & clear & fast
    label, count = cast(tuple[np.ndarray, int], ndimage.label(ndimage.binary_opening(candidate, iterations=2)))
    parts = [label == k for k in range(1, count + 1)]
    parts = [p for p in parts if max(FEWEST, LEAST_SHARE * mask.sum()) <= p.sum() <= MOST_SHARE * mask.sum()]
    parts = [p for p in parts if _ends(p, mask, motion, trust)]
    return sorted((_whole(p, mask) for p in parts), key=lambda p: -int(p.sum()))


def pieces(marked: Bool[np.ndarray, "h w"]) -> list[Bool[np.ndarray, "h w"]]:
    """Connected pieces of what a person marked, largest first, without those too small to stand."""
    label, count = cast(tuple[np.ndarray, int], ndimage.label(marked))
    found = [label == k for k in range(1, count + 1)]
    return sorted((p for p in found if p.sum() >= FEWEST), key=lambda p: -int(p.sum()))


def _whole(part: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """With the rim that opening and the blur of flow took from it."""
    return cast(np.ndarray, ndimage.binary_closing(part, iterations=2)) & mask | part


def _ends(part: np.ndarray, mask: np.ndarray, motion: np.ndarray, trust: np.ndarray) -> bool:
    """Whether its motion ends on fluid: ahead of its foot, within its own width, most is fluid and much slower."""
    ahead = foot_pixels(part, mask, motion)
    if ahead.sum() < 0.25 * FEWEST:
        return False
    known = ahead & (trust > jets.TRUSTED)
    own = float(np.median(np.linalg.norm(motion[part], axis=1)))
    # what has no motion that can be trusted hardly moves, or is foam
    return not known.any() or float(np.median(np.linalg.norm(motion[known], axis=1))) < SLOWER * own


def foot_pixels(part: np.ndarray, mask: np.ndarray, motion: np.ndarray) -> Bool[np.ndarray, "h w"]:
    """Fluid beyond the lower end of a piece, as seen along its motion, out to its own width."""
    direction = np.median(motion[part], axis=0)
    direction = direction / max(float(np.linalg.norm(direction)), 1e-12)
    rows, cols = np.nonzero(part)
    s, c = cols * direction[0] + rows * direction[1], rows * direction[0] - cols * direction[1]
    low, high = np.percentile(c, [5, 95])
    v, u = np.mgrid[: mask.shape[0], : mask.shape[1]]
    along, across = u * direction[0] + v * direction[1], v * direction[0] - u * direction[1]
    end = float(np.percentile(s, 98))
    ahead = (along > end + jets.BLUR) & (along < end + jets.BLUR + (high - low)) & (across > low) & (across < high)
    return ahead & mask & ~part


def stand(
    camera: PinholeCamera, part: Bool[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"], trust: Float[np.ndarray, "h w"], level: float, *, sure: bool = False,
) -> Chute | None:  # fmt: skip
    """The chute that a piece of the picture shows, on a level surface; None where none explains its motion.

    Args:
        camera: canonical, z up.
        part: its pixels.
        mask: the fluid.
        motion: px per frame.
        trust: of it.
        level: z of the surface at its foot.
        sure: it is one, whatever its motion: it is as steep as that says, or as chutes usually are.
    """
    heading = _heading_below(camera, part, mask, motion, trust)
    if heading is None:
        if not sure:
            return None
        heading = -0.5 * np.pi  # towards the viewer
    seen = np.median(motion[part], axis=0)
    unseen = float(np.linalg.norm(seen)) < LEAST_EXCESS
    if unseen:
        seen = jets.projected_vertical(camera)[part].mean(axis=0)
    rows, cols = np.nonzero(part)
    at = np.array([[float(np.median(cols)) + 0.5, float(np.median(rows)) + 0.5]])
    degrees = np.arange(0.0, MOST_SLOPE + 1.0, 1.0)
    off = []
    for angle in np.radians(degrees):
        axes = slope.plane_axes(angle, heading)
        _, _, along, _ = slope.basis(camera, at, axes)
        cosine = float(along[0] @ seen) / max(float(np.linalg.norm(along[0]) * np.linalg.norm(seen)), 1e-12)
        off.append(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    habit = np.exp(-0.5 * ((degrees - USUAL[0]) / USUAL[1]) ** 2)
    belief = np.exp(-0.5 * (np.array(off) / UNSURE) ** 2) * habit
    if unseen or min(off) > AMISS:
        if not sure:
            return None
        belief = habit
    found = float((degrees * belief).sum() / belief.sum())
    if found < LEAST_SLOPE and not sure:
        return None
    return _placed(camera, part, seen, (max(found, LEAST_SLOPE), heading), level)


def _heading_below(camera, part, mask, motion, trust) -> float | None:
    """Where the water goes on: on the level, the motion of the fluid around the foot that is not part of it."""
    reach = 2.0 * float(np.sqrt(part.sum() / np.pi))
    rows, cols = np.nonzero(part)
    foot = rows >= np.percentile(rows, 80)
    grid = np.stack([*np.mgrid[: mask.shape[0], : mask.shape[1]]], axis=-1)
    middle = np.array([rows[foot].mean(), cols[foot].mean()])
    around = np.linalg.norm(grid - middle, axis=-1) < reach
    lying = mask & ~ndimage.binary_dilation(part, iterations=int(jets.BLUR)) & (trust > jets.TRUSTED)
    use = around & lying if (around & lying).sum() >= FEWEST else lying
    if not use.any():
        return None
    weight = trust[use] * np.linalg.norm(motion[use], axis=1)
    if weight.sum() <= 0:
        return None
    mean = np.average(motion[use], axis=0, weights=weight)
    at = np.average(camera.pixel_grid()[use], axis=0, weights=weight)
    ends = camera.rays(np.stack([at, at + mean]))
    if (ends[:, 2] > -1e-3).any():
        return None
    ground = ends[:, :2] / -ends[:, 2:]
    step = ground[1] - ground[0]
    return float(np.arctan2(step[1], step[0]))


def _placed(camera, part, seen: np.ndarray, angles: tuple[float, float], level: float) -> Chute | None:
    """Its foot on the level, its width and its length from where the rays of its pixels meet its plane."""
    degrees, heading = angles
    direction = seen / max(float(np.linalg.norm(seen)), 1e-12)
    uv = camera.pixel_grid()[part]
    s = uv @ direction
    last = s > np.percentile(s, 90)
    ray = camera.rays(uv[last].mean(axis=0)[None])[0]
    if ray[2] > -1e-3:
        return None
    foot = ray * (level / ray[2])
    axes = slope.plane_axes(np.radians(degrees), heading)
    rays = camera.rays(uv)
    facing = -(rays @ axes[2])
    drop = -float(foot @ axes[2])
    if drop <= 0 or facing.min() <= facing.max() / FARTHEST:
        return None
    points = rays * (drop / facing)[:, None]
    ahead = np.array([np.cos(heading), np.sin(heading)])
    away = points[:, :2] - foot[:2]
    run, across = away @ ahead, away[:, 1] * ahead[0] - away[:, 0] * ahead[1]
    low, high = np.percentile(across, [5, 95])
    end = float(np.percentile(run, 98))
    # the foot in the middle of its width, at its lower end
    foot = foot + np.array([*(ahead * end), 0.0]) + 0.5 * (low + high) * np.array([-ahead[1], ahead[0], 0.0])
    length = end - float(np.percentile(run, 2))
    if length <= 0 or high <= low:
        return None
    return Chute(
        (float(foot[0]), float(foot[1]), float(foot[2])),
        heading,
        degrees,
        float(0.5 * (high - low) / 0.9),
        length,
        part,
    )


def find_chutes(
    camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"], height: HeightModel,
    marked: list[Bool[np.ndarray, "h w"]] | None = None,
) -> list[Chute]:  # fmt: skip
    """Chutes that come down onto a surface.

    Args:
        camera: canonical, z up.
        mask: fluid pixels that lie or run.
        motion: mean over the clip, px per frame.
        trust: of it.
        height: model of that surface, as it is without them.
        marked: their pixels, as a person says; none: they are looked for, and what slows down on its way is none.
    """
    found = []
    for part in marked or chute_pixels(camera, mask, motion, trust):
        rows, cols = np.nonzero(part)
        low = rows >= np.percentile(rows, 90)
        ray = camera.rays(np.array([[cols[low].mean() + 0.5, rows[low].mean() + 0.5]]))[0]
        if ray[2] > -1e-3:
            continue
        level = -1.0
        for _ in range(8):  # where its foot's ray meets the surface
            level = float(height.height((ray[:2] * level / ray[2])[None])[0])
        chute = stand(camera, part, mask, motion, trust, level, sure=bool(marked)) if level < 0 else None
        if chute is not None and (marked or energy_kept(camera, chute, motion, trust) >= 1.0 - LOSES):
            found.append(chute)
    return found


def energy_kept(
    camera: PinholeCamera, chute: Chute, motion: Float[np.ndarray, "h w 2"], trust: Float[np.ndarray, "h w"]
) -> float:
    """Kinetic energy of the water at the lower end of a chute over that at its upper end, on its plane; 1 where too
    little of the motion is known.

    What really spreads on the level may keep it on the plane that it is mistaken for: a plane that rises towards the
    viewer makes its upper end seem near and slow. So a low value speaks against a chute, a high one for nothing. Of 77
    made outflows that lean as a chute does, 66 lose more than `LOSES`; the others come nearly straight at the viewer.

    Args:
        camera: canonical, z up.
        chute: on whose plane its pixels lie.
        motion: px per frame.
        trust: of it, 0 to 1.
    """
    known = chute.pixels & (trust > jets.TRUSTED)
    if known.sum() < FEWEST:
        return 1.0
    axes, uv = slope.plane_axes(np.radians(chute.slope), chute.heading), camera.pixel_grid()[known]
    rays, foot = camera.rays(uv), np.asarray(chute.foot)
    depth = (foot @ axes[2]) / (rays @ axes[2])
    _, _, along, across = slope.basis(camera, uv, axes)
    velocity = np.linalg.solve(np.stack([along, across], axis=-1), motion[known][..., None])[..., 0] * depth[:, None]
    way = (rays * depth[:, None] - foot) @ axes[0]
    return spreading.energy_kept(way, np.square(velocity).sum(axis=1), trust[known])


def head_acceleration(
    points: Float[np.ndarray, "n 3"], velocities: Float[np.ndarray, "n 3"], trust: Float[np.ndarray, " n"]
) -> float | None:
    """Gravity as a chute shows it, length/s^2, from v^2 = v0^2 + 2 g (z0 - z) without friction; None where it shows
    none. Medians of its uppermost tenth and of its lower half: a chute has too little height for `fit_free_fall`.

    Args:
        points: of its surface, z up, any unit of length.
        velocities: in that unit per second.
        trust: of them, 0 to 1.
    """
    known = trust > jets.TRUSTED
    if known.sum() < FEWEST:
        return None
    z, energy = points[known, 2], 0.5 * np.square(velocities[known]).sum(axis=1)
    top, low = z >= np.percentile(z, 90), z <= np.percentile(z, 50)
    drop = float(np.median(z[top]) - np.median(z[low]))
    gained = float(np.median(energy[low]) - np.median(energy[top]))
    return gained / drop if drop > 0 and gained > 0 else None
