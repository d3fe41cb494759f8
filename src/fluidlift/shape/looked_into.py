"""What a rim says of a vessel that is looked into: where it stands, how wide it is, and how high the liquid in it is.

A rim that lies level is a circle about the vessel's axis. Its ellipse in the picture, carried onto level planes below a
level camera, is one in each of them: how far away it is decides its height and its radius. What is seen of a liquid in
it is the part of a lower level circle that the near part of the rim does not hide: of a silhouette, the lower edge is
the rim's and the upper one the far arc of that circle, which tells both its height and its radius.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.shape.view.roundness import Ellipse, conic_below
from fluidlift.types import PinholeCamera, VesselRim, triple

DEEPEST, STEP = 1.6, 0.02
"""radii of the rim that a level lies below it at most (mugs are that deep), and between two that are tried"""
NARROWEST = 0.4
"""of the rim's radius, that of a level circle at least"""
INNER = (1.0, 0.95, 0.9, 0.85)
"""of the rim's radius, that of its inner edge: an ellipse may be of its outer one, and mugs are a seventh thick"""
LIKENESS = 0.6
"""IoU of what is seen within a rim with the level circle that fits it best, from which that is believed: waves and
splashes are the rest (a choice)"""
BESIDE, OVER_RIM = 0.02, 1.1
"""of the pixels of standing water, those that may lie farther from the axis than so many radii of its rim (a choice:
outlines err by a pixel or two of 50)"""
JET = 0.55
"""of the widest row, at most: rows above it that show the jet, which hides the wall and the level alike"""


@dataclass(frozen=True)
class Level:
    """The level circle of a liquid in a vessel."""

    z: float
    radius: float
    inner: float
    """radius of the rim's inner edge, which hides what is nearer"""


def rim_circle(camera: PinholeCamera, rim: Ellipse, distance: float) -> VesselRim | None:
    """The level circle that an ellipse shows; None where it reaches up to the horizon.

    Args:
        camera: its tilt and roll as known.
        rim: in the picture, px.
        distance: from the camera to the circle's center along the ground.
    """
    flat = _below_eye(camera, rim)
    away = 0.0 if flat is None else float(np.hypot(*flat[:2]))
    if flat is None or away < 1e-6:  # straight below, no way along the ground tells how far
        return None
    return _scaled(flat, distance / away, camera)


def _below_eye(camera: PinholeCamera, rim: Ellipse) -> tuple[float, float, float] | None:
    """x, y from the eye and radius of the circle that an ellipse shows on the level plane one below it; None where it
    reaches up to the horizon."""
    conic = conic_below(camera, rim)
    if conic is None:
        return None
    shape, linear = conic[:2, :2], conic[:2, 2]
    x, y = -np.linalg.solve(shape, linear)
    square = -(linear @ (x, y) + conic[2, 2]) / np.sqrt(np.linalg.det(shape))
    return float(x), float(y), float(np.sqrt(square))  # of what is a little out of round, the circle of its area


def _scaled(flat: tuple[float, float, float], scale: float, camera: PinholeCamera) -> VesselRim:
    center = camera.position + scale * np.array([flat[0], flat[1], -1.0])
    return VesselRim(triple(center.tolist()), scale * flat[2])


@dataclass(frozen=True)
class Bowl:
    """A vessel in which a liquid stands: a cone from its level circle up to the inner edge of its rim."""

    rim: VesselRim
    """its radius is that of the inner edge"""
    level: Level

    def pool(self, camera: PinholeCamera) -> Bool[np.ndarray, "h w"]:
        """Pixels of all of its level, with what its near wall hides."""
        return _away(self.rim, camera, self.level.z) < self.level.radius

    def away(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
        """Distance from the axis."""
        return np.linalg.norm(xy - np.asarray(self.rim.center[:2]), axis=-1)

    def height(self, away: Float[np.ndarray, "*n"], lip: float, side: float, table: float) -> Float[np.ndarray, "*n"]:
        """z of wall and rim, which is `lip` wide, beside the level; it falls to a table around it over `side`."""
        inner = max(self.rim.radius, 1.001 * self.level.radius)  # upright at most
        edge = self.rim.center[2]
        places = [self.level.radius, inner, inner + lip, inner + lip + side]
        return np.interp(away, places, [self.level.z, edge, edge, table])


def bowl_of(camera: PinholeCamera, rim: Ellipse, mask: Bool[np.ndarray, "h w"], z: float) -> Bowl | None:
    """The vessel in which standing water lies at a height z; None where no rim above it leaves to be seen what is.

    Args:
        camera: in the world.
        rim: px.
        mask: pixels of the water.
        z: of its level.
    """
    flat, best, found = _below_eye(camera, rim), LIKENESS, None
    if flat is None:
        return None
    within = rim.pixels(mask.shape)
    ways, wet = _ways_down(camera)[within], mask[within]
    deep = float(camera.position[2]) - z
    heights = np.arange(STEP, DEEPEST, STEP) * flat[2] * deep
    for above in heights[heights < deep]:
        edge = _scaled(flat, deep - float(above), camera)
        likeness, level = _Opening.of(edge, camera, ways, wet).fit(z)
        if level is not None and likeness > best:
            best, found = likeness, Bowl(VesselRim(edge.center, level.inner), level)
    if found is None:
        return None
    farthest = float(np.quantile(_away(found.rim, camera, z)[mask], 1.0 - BESIDE))
    return found if farthest < OVER_RIM * found.rim.radius else None  # what lies beside it has another bank


def _ways_down(camera: PinholeCamera) -> Float[np.ndarray, "h w 2"]:
    """Way along the ground per height of the ray of each pixel; inf where it looks up."""
    rays = camera.rays(camera.pixel_grid())
    down = rays[..., 2] < -1e-6
    return np.where(down[..., None], rays[..., :2] / np.where(down, -rays[..., 2], 1.0)[..., None], np.inf)


def seen_through(rim: VesselRim, camera: PinholeCamera) -> Bool[np.ndarray, "h w"]:
    """Pixels that look through a rim."""
    return _away(rim, camera, rim.center[2]) < rim.radius


def _away(rim: VesselRim, camera: PinholeCamera, z: float) -> Float[np.ndarray, "h w"]:
    """Distance from a rim's axis at which the ray of each pixel meets a level plane; inf where it does not."""
    met = camera.position[:2] + (camera.position[2] - z) * _ways_down(camera)
    return np.hypot(*np.moveaxis(met - rim.center[:2], -1, 0))


def level_below(
    rim: VesselRim,
    camera: PinholeCamera,
    mask: Bool[np.ndarray, "h w"],
    radius_at: Callable[[Float[np.ndarray, " k"]], Float[np.ndarray, " k"]] | None = None,
) -> Level | None:
    """The level circle whose part within the rim's inner edge a silhouette shows; None where none fits it.

    Args:
        rim: in the camera's world.
        camera: that sees it.
        mask: fluid pixels, with the jet that falls in.
        radius_at: of the inside at heights z; None: it is read from the silhouette as well.
    """
    judged = seen_through(rim, camera) & ~jet_rows(mask)
    opening, best, found = _Opening.of(rim, camera, _ways_down(camera)[judged], mask[judged]), LIKENESS, None
    for below in np.arange(0.0, DEEPEST, STEP):
        z = float(rim.center[2] - below * rim.radius)
        likeness, level = opening.fit(z, None if radius_at is None else float(radius_at(np.array([z]))[0]))
        if likeness > best:
            best, found = likeness, level
    return found


@dataclass(frozen=True)
class _Opening:
    """What is seen through a rim; n pixels."""

    rim: VesselRim
    eye: np.ndarray
    at_rim: Float[np.ndarray, " n"]
    """distance from the axis at the rim's height, in its radii"""
    flat: Float[np.ndarray, "n 2"]
    """way along the ground per height of each ray"""
    wet: Bool[np.ndarray, " n"]

    @classmethod
    def of(cls, rim: VesselRim, camera: PinholeCamera, flat: np.ndarray, wet: np.ndarray) -> _Opening:
        """Of pixels within the rim, with their ways down."""
        center, eye = np.asarray(rim.center), camera.position
        away = np.hypot(*(eye[:2] + (eye[2] - center[2]) * flat - center[:2]).T) / rim.radius
        return cls(rim, eye, away, flat, wet)

    def fit(self, z: float, radius: float | None = None) -> tuple[float, Level | None]:
        """IoU of what is wet with the level circle at a height that fits it best, of a radius where that is given."""
        if not self.wet.any():
            return 0.0, None
        away = np.hypot(*(self.eye[:2] + (self.eye[2] - z) * self.flat - self.rim.center[:2]).T)
        best, found = 0.0, None
        for inner in INNER:
            seen, most = self.at_rim < inner, inner * self.rim.radius
            likeness, fits = _best_circle(away[seen], self.wet[seen], int(self.wet.sum()), self.rim.radius, radius)
            if likeness > best:
                best, found = likeness, Level(z, min(fits, most), most)
        return best, found


def jet_rows(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels of a silhouette's narrow rows above its widest one."""
    width = mask.sum(axis=1)
    narrow = width < JET * float(np.percentile(width[width > 0], 95)) if width.any() else width < 0
    narrow[int(np.argmax(width)) :] = False
    return mask & narrow[:, None]


def _best_circle(
    away: np.ndarray, wet: np.ndarray, count: int, largest: float, radius: float | None
) -> tuple[float, float]:
    """IoU of `count` wet pixels with those less `away` from an axis than a radius, the best one where None is given."""
    if not len(away):
        return 0.0, 0.0
    order = np.argsort(away)
    both, away = np.cumsum(wet[order]), away[order]
    likeness = both / (count + np.arange(1, len(away) + 1) - both)
    tried = (away > NARROWEST * largest) & (away < largest) if radius is None else away < radius
    if not tried.any():
        return 0.0, 0.0
    at = int(np.argmax(np.where(tried, likeness, 0.0))) if radius is None else int(np.flatnonzero(tried)[-1])
    return float(likeness[at]), float(away[at])
