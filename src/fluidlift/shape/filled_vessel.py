"""The vessel that a pour fills: a solid of revolution about a vertical axis, from the silhouette of what it holds.

Of a circle at height z and distance d from the eye the silhouette shows the half width r / sqrt(1 - (r/d)^2) in the
vertical plane through the axis; its nearest point, at d - r, appears there at z d / (d - r) from the level of the eye.
So floor and level follow from the lowest and highest rows of the silhouette, and the radius from the rows between.
Of a vessel that is looked into its rim tells more (`looked_into`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from fluidlift.shape.ground_mesh import VertexLook
from fluidlift.shape.looked_into import Level, jet_rows, level_below, rim_circle, seen_through
from fluidlift.shape.rectified import BELOW, NARROW, PARTS, Rectified, level_axes
from fluidlift.shape.region import largest_piece
from fluidlift.shape.view.roundness import IN_VESSEL, Ellipse
from fluidlift.types import PinholeCamera, Similarity3, VesselRim, triple

SHALLOW = 0.05
"""radii between level and floor, below which the silhouette is that of the surface alone: no floor is seen"""
DEEP = 1.0
"""radii that such a pool is taken to be deep: as a half sphere is, between a plate and a mug"""
FREEBOARD = 0.1
"""radii that the edge of such a vessel stands above the level at least, which it would run over"""
CUP, BELOW_LEVEL = 1.2, 0.3
"""radii of its rim that a vessel which is looked into is taken to be deep (a choice: bowls have 0.6 to 1, cups 1.2 to
1.6), and that its floor lies below the level at least"""
THICK = 1.15
"""radii of its outside over those of its inside: mugs have walls of a seventh, and cells are coarse"""
FOOT_RADIUS = 0.5
"""of its rim's radius, that of its floor at least"""
SMOOTH = 0.015
"""of the silhouette's height over which its outline is evened out: drops and notches of a mask"""
TURNS, RADII = 17, 96
"""places along a quarter of a circle, and circles, that are tried at each height"""
FINE = 1.0 / 64.0
"""of a wall's thickness between the places of its outline that distances are measured to: a hundredth of it is lost"""
ACROSS = 64
"""places along a ray that are looked at in the pool"""
BELOW_ITS_RIM = 0.8
"""of a rim's disc that a pool fills at most, where the wall shows above it: the outline of what fills more may be the
pool's own"""
FAR_WALL = 0.15
"""of the far half of a rim's disc, from which what a pool leaves free there and not on the near side is wall above it:
outlines of pools err by a few hundredths, on all sides (a choice)"""
ARC = 0.35
"""radii, half of how tall the surface of what a vessel holds looks from 20 degrees above: as far as tilts err"""
FILLED = 0.5
"""of how high a vessel is ever seen filled, to which it is at first at most where only that tells it: what does not
become more is a heap (a choice)"""
FILLS = 0.1
"""of what is seen of a liquid in a vessel on average, by which it is more in the last third of a clip than in the first
where the vessel fills (a choice: outlines err by a few hundredths)"""


@dataclass(frozen=True)
class FilledVessel:
    """What it holds, z up."""

    axis: tuple[float, float]
    """x, y"""
    heights: Float[np.ndarray, " k"]
    """z from the floor to as high as the radius is known, increasing"""
    radii: Float[np.ndarray, " k"]
    """of the inside at these heights, which goes on above and below"""
    level: float
    """z of the surface at the first instant"""
    inflow: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """unit vector, the way that the jet falls in, as far as it leans to the side"""
    looked_into: bool = False
    """only its surface is seen: its near wall hides the rest of what it holds"""
    edge: float | None = None
    """z of its upper edge where that is seen, by what it hides"""
    mouth: VesselRim | None = None
    """its rim where that is seen: the radii are known up to it"""
    nearly_empty: bool = False
    """what it holds at the first instant is too little to tell it: what it holds later does"""

    @property
    def floor(self) -> float:
        """z of the lowest point inside."""
        return float(self.heights[0])

    @property
    def rim(self) -> float:
        """z of its upper edge; where that is not seen, half as high again as it was filled."""
        if self.edge is not None:
            return self.edge
        return float(self.heights[-1]) + 0.5 * (float(self.heights[-1]) - self.floor)

    @property
    def volume(self) -> float:
        """Of what it holds at the first instant."""
        z = np.linspace(self.floor, self.level, 200)
        return float(np.trapezoid(np.pi * self.radius_at(z) ** 2, z))

    def radius_at(self, z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Radius of the inside."""
        return np.interp(z, self.heights, self.radii)

    def holds(self, points: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        """Whether points are in what it holds at the first instant."""
        z = points[..., 2]
        away = np.hypot(points[..., 0] - self.axis[0], points[..., 1] - self.axis[1])
        return (away < self.radius_at(z)) & (z > self.floor) & (z < self.level)

    def wall(self, points: Float[np.ndarray, "*n 3"], thickness: float) -> Float[np.ndarray, "*n"]:
        """Signed distance to its wall, negative within: from the inside outwards, up to the rim.

        Args:
            points: world.
            thickness: of the wall, as thick where it steps outwards as where it is upright.
        """
        z, r = points[..., 2], np.hypot(points[..., 0] - self.axis[0], points[..., 1] - self.axis[1])
        heights = np.concatenate([[min(self.floor, float(z.min())) - thickness], self.heights, [self.rim + thickness]])
        outline = np.stack([self.radius_at(heights), heights], axis=-1)
        steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
        along = np.arange(0.0, steps[-1], FINE * thickness)
        places = np.stack([np.interp(along, steps, column) for column in outline.T], axis=-1)
        away = cKDTree(places).query(np.stack([r, z], axis=-1))[0]
        away = np.where(r > self.radius_at(z), away, -away)
        return np.maximum(np.abs(away - 0.5 * thickness) - 0.5 * thickness, z - self.rim)

    def transformed(self, t: Similarity3) -> FilledVessel:
        """As a similarity that keeps the vertical moves it."""
        low = t.points(np.array([[*self.axis, 0.0]]))[0]
        mouth = self.mouth
        if mouth is not None:
            mouth = VesselRim(triple(t.points(np.array([mouth.center]))[0]), t.scale * mouth.radius)
        return FilledVessel(
            (float(low[0]), float(low[1])), low[2] + t.scale * self.heights, t.scale * self.radii,
            float(low[2] + t.scale * self.level), triple(t.rotation @ self.inflow), self.looked_into,
            None if self.edge is None else float(low[2] + t.scale * self.edge), mouth, self.nearly_empty,
        )  # fmt: skip


def distance_ahead(camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], middle: Float[np.ndarray, "h w"]) -> float:
    """Median distance along the ground from the camera to a body.

    Args:
        camera: that sees it.
        mask: fluid pixels.
        middle: camera depth of the body's middle.
    """
    rays = camera.rays(camera.pixel_grid()[mask])
    return float(np.median(middle[mask] * (rays[:, :2] @ level_axes(camera)[1])))


def find_vessel(
    camera: PinholeCamera,
    mask: Bool[np.ndarray, "h w"],
    distance: float,
    rims: Sequence[Ellipse] = (),
    mouth: VesselRim | None = None,
) -> FilledVessel | None:
    """The vessel in which the lower part of a silhouette stands, if a much narrower jet falls into it; else None.

    Args:
        camera: its tilt and roll as known.
        mask: fluid pixels.
        distance: from the camera to the axis along the ground, in the unit of the result.
        rims: of vessels that are seen. The one that holds the lower part of the silhouette tells its vessel.
        mouth: that one, where it is known.
    """
    eye, (right, forward) = camera.position, level_axes(camera)
    plane = Rectified.of(camera, mask, distance)
    if plane is None:
        return None
    if mouth is None:
        held = next((rim for rim in rims if in_vessel([rim], mask & ~jet_rows(mask))), None)
        mouth = None if held is None else rim_circle(camera, held, distance)
    level = None if mouth is None else level_below(mouth, camera, mask)
    if mouth is not None and level is not None:
        above = np.flatnonzero(plane.z > (level.z - eye[2]) * distance / (distance + level.radius))
        return _below_rim(mouth, level, plane.lean(int(above[0])) * right if len(above) else 0.0 * right)
    first, last = plane.pool()
    count = len(plane.z)
    if not PARTS[0] * count <= last - first <= PARTS[1] * count or first > BELOW * count:
        return None
    if np.median(plane.width[last:]) > NARROW * plane.widest:
        return None
    smooth = max(SMOOTH * count, 0.5)
    half = 0.5 * plane.width
    begins, ends = half[first], half[last - 1]
    half[first:last] = ndimage.gaussian_filter1d(half[first:last], smooth, mode="nearest")
    z, radius = plane.z[first:last], half[first:last] / np.sqrt(1.0 + np.square(half[first:last] / distance))
    pixel = z[1] - z[0]
    floor = _circle_at(z[0] - 0.5 * pixel, begins, (z, radius), distance, near=z[0] < 0.0)
    level = _circle_at(z[-1] + 0.5 * pixel, ends, (z, radius), distance, near=z[-1] > 0.0)
    middle = float(np.median(plane.middle[first:last]))
    widest, radius = float(radius.max()), _largest_circles(z, plane.z, half, distance)
    looked_into, edge = bool(level - floor < SHALLOW * widest), None
    if looked_into:  # the lowest row shows the nearest point of the edge
        seen = (z[0] - 0.5 * pixel) * (distance - widest) / distance
        edge = float(max(seen, level + FREEBOARD * widest) + eye[2])
        floor, radius = level - DEEP * widest, np.full(len(z), widest)
    heights = np.linspace(floor, level, max(len(z), 2))
    axis = eye[:2] + middle * right + distance * forward
    way = np.array([*(-plane.lean(last) * right), -1.0])
    return FilledVessel(
        (float(axis[0]), float(axis[1])), heights + eye[2], np.interp(heights, z, radius), level + float(eye[2]),
        triple(way / np.linalg.norm(way)), looked_into, edge,
    )  # fmt: skip


def vessel_of(
    camera: PinholeCamera,
    mask: Bool[np.ndarray, "h w"],
    ever: Bool[np.ndarray, "h w"],
    distance: float,
    rims: Sequence[Ellipse] = (),
    mouth: VesselRim | None = None,
) -> FilledVessel | None:
    """The vessel as it is filled in one picture: by what it holds there, or, where that is little yet, by what it holds
    later. None where neither tells one.

    Args:
        ever: pixels that are fluid in at least one frame.
        camera, mask, distance, rims, mouth: as of `find_vessel`.
    """
    found = find_vessel(camera, mask, distance, rims, mouth)
    if found is not None and (found.mouth is not None or not found.looked_into):
        return found  # a little at the bottom of a glass has the silhouette of a surface alone
    later = find_vessel(camera, ever, distance, rims, mouth)
    if later is None or later.looked_into:
        return found
    later = _upright_at_level(later)
    level = level_in(later, camera, mask)
    share = (level - later.floor) / (later.level - later.floor)
    if share > FILLED:
        return found
    heights = np.linspace(later.floor, level, max(int(share * len(later.heights)), 2))
    return replace(later, heights=heights, radii=later.radius_at(heights), level=level, nearly_empty=True)


def _upright_at_level(vessel: FilledVessel) -> FilledVessel:
    """With a wall that does not draw in over the last bit below its level: there the silhouette is the far arc of the
    surface as well, which is taller than it should be where the camera looks down by more than is known."""
    beyond = vessel.heights > vessel.level - ARC * vessel.radii.max()
    if beyond.all():
        return vessel
    least = np.where(beyond, vessel.radii[~beyond][-1], 0.0)
    return replace(vessel, radii=np.maximum(vessel.radii, least))


def level_in(vessel: FilledVessel, camera: PinholeCamera, mask: Bool[np.ndarray, "h w"]) -> float:
    """z of the surface of what a vessel holds in a picture, by the rows over its floor that are as wide as its inside;
    a row's height over its floor where there is none, or the picture shows too little of the fluid to tell.

    Args:
        vessel: in the camera's world, its radii known as high as it is ever filled.
        camera: that sees it.
        mask: fluid pixels.
    """
    eye, distance = camera.position, _ahead(vessel, camera)
    least = vessel.floor + distance / max(camera.focal)
    plane = Rectified.of(camera, mask, distance)
    if plane is None:
        return least
    wide = plane.width > 2.0 * NARROW * vessel.radius_at(plane.z + eye[2])
    first = int(np.argmax(wide))
    top = float(vessel.heights[-1])
    if not wide.any() or plane.z[first] + eye[2] > 0.5 * (vessel.floor + top):  # a puddle in mid-air
        return least
    above = np.flatnonzero(~wide[first:])
    last = first + int(above[0]) if len(above) else len(wide)
    row = float(plane.z[last - 1]) + 0.5 * float(plane.z[1] - plane.z[0])
    profile = vessel.heights - eye[2], vessel.radii
    level = _circle_at(row, 0.5 * float(plane.width[last - 1]), profile, distance, near=row > 0.0)
    return float(np.clip(level + eye[2], least, top))


def _below_rim(mouth: VesselRim, level: Level, lean: np.ndarray) -> FilledVessel:
    """A cone through a rim's inner edge and a level circle; `lean`: way along the ground over height of its jet."""
    x, y, edge = mouth.center
    taper = (level.inner - level.radius) / max(edge - level.z, 1e-9)
    floor = min(edge - CUP * mouth.radius, level.z - BELOW_LEVEL * mouth.radius)
    foot = max(level.radius - taper * (level.z - floor), min(FOOT_RADIUS * mouth.radius, level.radius))
    heights, radii = np.array([floor, level.z, edge]), np.array([foot, level.radius, level.inner])
    way = np.array([*-lean, -1.0])
    kept = np.concatenate([[True], np.diff(heights) > 1e-9])  # a level at the rim itself is one height
    inflow = triple(way / np.linalg.norm(way))
    return FilledVessel((x, y), heights[kept], radii[kept], level.z, inflow, True, edge, mouth)


def behind_its_wall(
    vessel: FilledVessel, camera: PinholeCamera, ever: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels behind which a vessel that is looked into holds fluid though none is seen there: its near wall hides it.

    Args:
        vessel: in the camera's world.
        camera: that sees it.
        ever: pixels that are fluid in at least one frame.
    """
    if not vessel.looked_into:
        return np.zeros(ever.shape, bool)
    if vessel.mouth is None:
        return np.isfinite(pool_depths(camera, np.ones(ever.shape, bool), vessel)[0]) & ~ever
    return _silhouette(vessel, camera) & ~seen_through(_inner_edge(vessel), camera)


def look_of_vertices(
    vessel: FilledVessel, camera: PinholeCamera, vertices: Float[np.ndarray, "v 3"], thickness: float
) -> VertexLook:
    """Where the picture shows the look of a vessel and of the ground that it stands on.

    Its walls are thicker than those that are seen, whose outside lies further in: they are read to half of the rim's
    width, as that is found to a pixel.

    Args:
        vessel: with its rim, in the camera's world.
        camera: that sees it.
        vertices: of ground and walls.
        thickness: of its walls.
    """
    assert vessel.mouth is not None
    axis, z = np.asarray(vessel.axis), vertices[:, 2]
    aside = vertices[:, :2] - axis
    away = np.linalg.norm(aside, axis=1)
    inside = vessel.radius_at(z)
    own = (z > vessel.floor + 0.25 * thickness) & (away < inside + 1.5 * thickness)
    through = np.clip((away - inside) / thickness, 0.0, 1.0) * own
    seen = min(0.5 * (vessel.mouth.radius - _inner_edge(vessel).radius), thickness)
    closer = 1.0 - through * (thickness - seen) / np.maximum(away, 1e-9)
    row, col, _ = camera.nearest_pixels(vertices)
    before = _silhouette(vessel, camera) | seen_through(vessel.mouth, camera)
    return VertexLook(np.column_stack([axis + aside * closer[:, None], z]), before[row, col] & ~own, own)


def _inner_edge(vessel: FilledVessel) -> VesselRim:
    assert vessel.mouth is not None
    return VesselRim(vessel.mouth.center, float(vessel.radius_at(np.array([vessel.rim]))[0]))


def _silhouette(vessel: FilledVessel, camera: PinholeCamera) -> Bool[np.ndarray, "h w"]:
    """Pixels in which a vessel is seen, but for its rim."""
    brimful = replace(vessel, level=vessel.rim, radii=THICK * vessel.radii)
    return np.isfinite(pool_depths(camera, np.ones(camera.size[::-1], bool), brimful)[0])


def seen_higher(vessel: FilledVessel, camera: PinholeCamera, ever: Bool[np.ndarray, "h w"]) -> FilledVessel:
    """The vessel with its radii as high as the clip shows it filled.

    Above the widest row of what it holds at first, that may narrow because the vessel does or because its surface is
    ragged: where it was filled later, the wider of both is the vessel's.

    Args:
        vessel: as it was filled at the first instant.
        camera: in the same world.
        ever: pixels that are fluid in at least one frame.
    """
    if vessel.mouth is not None:  # its radii are known up to its rim
        return vessel
    found = find_vessel(camera, ever, _ahead(vessel, camera))
    if found is None:
        return vessel
    found = _upright_at_level(found)
    above = found.heights > vessel.level
    ragged = (vessel.heights > vessel.heights[np.argmax(vessel.radii)]) & (vessel.heights < found.heights[-1])
    first = np.where(ragged, np.maximum(vessel.radii, found.radius_at(vessel.heights)), vessel.radii)
    heights, radii = (np.append(a, b[above]) for a, b in ((vessel.heights, found.heights), (first, found.radii)))
    return replace(vessel, heights=heights, radii=radii)


def filled_volume(vessel: FilledVessel, camera: PinholeCamera, mask: Bool[np.ndarray, "h w"]) -> float | None:
    """Volume that a vessel holds in a picture, from the level that a silhouette shows; None where it shows none.

    Args:
        vessel: in the world.
        camera: in the world.
        mask: fluid pixels.
    """
    if vessel.mouth is not None:
        found = level_below(vessel.mouth, camera, mask, vessel.radius_at)
        return None if found is None else replace(vessel, level=max(found.z, vessel.floor)).volume
    if vessel.nearly_empty:
        return replace(vessel, level=level_in(vessel, camera, mask)).volume
    found = find_vessel(camera, mask, _ahead(vessel, camera))
    return None if found is None else replace(vessel, level=max(found.level, vessel.floor)).volume


def _ahead(vessel: FilledVessel, camera: PinholeCamera) -> float:
    """Distance to the axis along the ground, as the camera looks."""
    return float((np.asarray(vessel.axis) - camera.position[:2]) @ level_axes(camera)[1])


def pool_depths(
    camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], vessel: FilledVessel
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Camera depth at which the ray of each fluid pixel enters and leaves what a vessel holds; nan where it does not.

    Args:
        camera: that sees it.
        mask: fluid pixels.
        vessel: in the camera's world.
    """
    eye, (_, forward) = camera.position, level_axes(camera)
    rays = camera.rays(camera.pixel_grid()[mask])
    ahead = np.maximum(rays[:, :2] @ forward, 1e-6)
    middle = float((np.asarray(vessel.axis) - eye[:2]) @ forward)
    reach = float(vessel.radii.max())
    step = 2.0 * reach / ACROSS
    front, back = np.full((2, *mask.shape), np.nan)
    entered, left = np.full((2, len(rays)), np.nan)
    for away in middle - reach + step * (np.arange(ACROSS) + 0.5):
        inside = vessel.holds(eye + rays * (away / ahead)[:, None])
        entered = np.where(inside & np.isnan(entered), away - 0.5 * step, entered)
        left = np.where(inside, away + 0.5 * step, left)
    front[mask], back[mask] = entered / ahead, left / ahead
    return front, back


def _largest_circles(z: np.ndarray, rows: np.ndarray, half: np.ndarray, distance: float) -> np.ndarray:
    """Radius of the largest level circle at each height whose lower half nowhere leaves the silhouette: seen from
    above, the front of a shoulder hides the narrower part below it. Their upper halves are asked nothing: near the
    level they lie on the silhouette's upper edge, which waves and the jet fray, and the glass would close above it.

    Args:
        z: heights of the circles, from the eye.
        rows: heights in the plane of the axis, increasing.
        half: half the width of the silhouette there.
        distance: of the axis.
    """
    pixel = rows[1] - rows[0]
    turn = np.linspace(0.0, 0.5 * np.pi, TURNS)
    radii = np.linspace(0.0, 1.05 * float(half.max()), RADII)
    fits = np.zeros((len(z), RADII), bool)
    for side, toward in ((z > 0.0, -1.0), (z <= 0.0, 1.0)):  # above the eye the far half is the lower one
        scale = distance / (distance - toward * radii[:, None] * np.sin(turn))
        aside = radii[:, None] * np.cos(turn) * scale
        for k in np.flatnonzero(side):
            fits[k] = (aside <= np.interp(z[k] * scale, rows, half, 0.0, 0.0) + pixel).all(axis=1)
    return radii[np.maximum(np.argmin(np.column_stack([fits, np.zeros(len(z), bool)]), axis=1) - 1, 0)]


def _circle_at(
    row: float, half: float, profile: tuple[np.ndarray, np.ndarray], distance: float, *, near: bool
) -> float:
    """Height of the circle whose near (or far) arc appears at a height in the plane of the axis, `half` its chord."""
    height = row
    for _ in range(20):
        away = np.sqrt(max(float(np.interp(height, *profile)) ** 2 - half**2, 0.0))
        height = row * (distance - away if near else distance + away) / distance
    return float(height)


def in_vessel(rims: Sequence[Ellipse], pool: Bool[np.ndarray, "h w"]) -> bool:
    """Whether a pool lies within a rim and below it."""
    return any(rim.share_inside(pool) > IN_VESSEL and _shows_wall(rim, pool) for rim in rims)


def _shows_wall(rim: Ellipse, pool: Bool[np.ndarray, "h w"]) -> bool:
    """Whether a pool leaves enough of a rim's disc to the vessel's wall, on the far side: a lower level lies lower."""
    disc = rim.pixels(pool.shape)
    far = disc & (np.arange(len(pool))[:, None] + 0.5 < rim.center[1])
    if (pool & far).sum() > (pool & disc & ~far).sum():
        return False
    above, below = (float((part & ~pool).sum() / max(part.sum(), 1)) for part in (far, disc & ~far))
    return bool((pool & disc).sum() < BELOW_ITS_RIM * disc.sum()) or above > max(FAR_WALL, 2.0 * below)


def fills_a_vessel(rims: Sequence[Ellipse], shown: Bool[np.ndarray, "t h w"]) -> bool:
    """Whether a thin jet falls into a vessel and what is seen of the liquid in that becomes more.

    Args:
        rims: of vessels that are seen.
        shown: fluid pixels of some frames, spread over the clip.
    """
    for rim in rims:
        areas = np.array([rim.share_inside(mask) * mask.sum() for mask in shown])
        third = max(len(areas) // 3, 1)
        if areas[-third:].mean() - areas[:third].mean() < FILLS * max(areas.mean(), 1.0):
            continue
        if np.mean([_jet_into(rim, mask) for mask in shown]) > 0.5:
            return True
    return False


def _jet_into(rim: Ellipse, mask: np.ndarray) -> bool:
    """Whether the silhouette shows a jet, longer than wide, above a pool below a rim, however little there is of
    that yet."""
    piece = largest_piece(mask)
    jet = jet_rows(piece)
    rows = jet.sum(axis=1)[jet.any(axis=1)]
    return bool(len(rows)) and len(rows) > float(np.median(rows)) and in_vessel([rim], piece & ~jet)
