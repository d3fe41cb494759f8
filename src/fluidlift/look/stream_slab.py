"""A piece of a stream as a slab that one can pick up, and how it goes on beyond its ends.

What is simulated is a box. Before the terrain, ground and liquid end together in clean sections. Before a clip's plate,
which shows the whole world, both go on beyond the box as their own mirror images, as the plate does beyond its rim: an
end in the middle of a picture is a pane of glass that nobody filmed. Downhill stays downhill there: what stands higher
than the liquid at the end lies as much lower in the image. As it is, the mirror image of a fall would stand before it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from fluidlift.look.inflow import columns_of, surface_level
from fluidlift.look.outlet_section import OpenEnd
from fluidlift.numerics.ground_block import PARTS
from fluidlift.types import (
    Gaussians,
    Grid,
    PinholeCamera,
    TriangleMesh,
    concatenate,
    matrix_from_quat,
    quat_from_matrix,
)

MARGIN = 0.05
"""of a picture's size: so far beyond its rim the liquid goes on, since light that is bent comes from there"""
LEVELS = 8
"""columns of the liquid at rest whose mean is its level: of one, the image would go down in steps"""


@dataclass(frozen=True)
class Slab:
    """The piece of a stream, or of whatever lies, that is simulated."""

    ends: tuple[OpenEnd, ...] = ()
    """where it is cut; none: its liquid ends by itself"""
    still: Float[np.ndarray, "n 3"] | None = None
    """points of the liquid at rest, m: how high it stands; None: not known"""

    def before(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether points lie between the ends."""
        inside = np.ones(len(points), bool)
        for end in self.ends:
            inside &= end.before(points)
        return inside

    def beyond(
        self, fluid: Gaussians, velocities: Float[np.ndarray, "n 3"], camera: PinholeCamera
    ) -> tuple[Gaussians, Float[np.ndarray, "m 3"]]:
        """The fluid between the ends, and beyond them its mirror image as far as a camera sees it."""
        kept = self.before(fluid.means)
        fluid, velocities = fluid.select(kept), velocities[kept]
        parts, speeds = [fluid], [velocities]
        for end in self.ends:
            way = np.eye(3) - 2.0 * np.outer(end.along, end.along)
            may = np.flatnonzero(self._may_be_seen(fluid.means, end, camera))
            means = self._image(fluid.means[may], end)
            near = _near_picture(means, camera)
            means, seen = means[near], may[near]
            # the mirror image of an ellipsoid is one that was turned: its axes have no sign
            turned = quat_from_matrix(-way @ matrix_from_quat(fluid.quats[seen]))
            image = replace(fluid.select(seen), means=means.astype(fluid.means.dtype), quats=turned)
            parts.append(replace(image, quats=image.quats.astype(fluid.quats.dtype)))
            speeds.append((velocities[seen] @ way).astype(velocities.dtype))
        return concatenate(parts), np.concatenate(speeds)

    def cut(self, ground: TriangleMesh, grid: Grid) -> TriangleMesh:
        """The block of ground (`ground_block.ground_mesh`) cut off where the liquid is; other meshes stay."""
        heights = _heights(ground, grid)
        if heights is None or not self.ends:
            return ground
        points = np.asarray(ground.vertices, np.float64).copy()
        for end in self.ends:
            points -= np.maximum(points @ end.along - end.at, 0.0)[:, None] * end.along
        count, h = heights.size, grid.spacing / PARTS
        place = (points[:count, :2] - grid.low[:2]) / h
        points[:count, 2] = ndimage.map_coordinates(heights, place.T, order=1, mode="nearest")
        # the sides hang from the rim of the top, all around alike
        number = np.arange(count).reshape(heights.shape)
        rim = np.concatenate([number[:-1, 0], number[-1, :-1], number[:0:-1, -1], number[0, :0:-1]])
        sides = points[count:-1].reshape(-1, len(rim), 3)
        old, new = np.asarray(ground.vertices, np.float64)[rim, 2], points[rim, 2]
        floor = points[-1, 2]
        share = (old - sides[..., 2]) / np.maximum(old - floor, 1e-12)
        sides[..., 2] = new + share * (floor - new)
        return replace(ground, vertices=points.astype(ground.vertices.dtype))

    def carried_on(self, mesh: TriangleMesh) -> TriangleMesh:
        """A mesh that is cut at the ends, with what a mirror in each of them shows of it."""
        points, count = np.asarray(mesh.vertices, np.float64), len(mesh.vertices)
        images = [self._image(points, end) for end in self.ends]
        if not images:
            return mesh
        faces = [mesh.faces, *(mesh.faces[:, ::-1] + (k + 1) * count for k in range(len(images)))]
        return replace(
            mesh,
            vertices=np.concatenate([points, *images]).astype(mesh.vertices.dtype),
            faces=np.concatenate(faces),
            colors=None if mesh.colors is None else np.concatenate([mesh.colors] * len(faces)),
            uv=None if mesh.uv is None else np.concatenate([mesh.uv, *[mesh.uv[:, ::-1]] * len(images)]),
        )

    def _image(self, points: np.ndarray, end: OpenEnd) -> np.ndarray:
        """Points behind an end, m, of points before it."""
        foot = points - (points @ end.along - end.at)[:, None] * end.along
        image = 2.0 * foot - points
        if self._columns is not None:
            image[:, 2] -= 2.0 * (self._level(points) - self._level(foot))
        return image

    def _may_be_seen(self, points: np.ndarray, end: OpenEnd, camera: PinholeCamera) -> np.ndarray:
        """bool [n]: the image of a point behind an end may lie near the picture. Which of them do says `_near_picture`;
        of most it can be told without the levels, by the most that these move an image up or down."""
        image = points - 2.0 * (points @ end.along - end.at)[:, None] * end.along
        moved = 0.0 if self._columns is None else 2.0 * float(np.ptp(self._columns[1]))
        return _near_picture(image, camera, upward=moved)

    @cached_property
    def _columns(self) -> tuple[cKDTree, np.ndarray] | None:
        """Columns of the liquid at rest, and the height (m) of each."""
        if self.still is None or not len(self.still) or not self.ends:
            return None
        spacing, still = self.ends[0].spacing, np.asarray(self.still, np.float64)
        places = (columns_of(still, spacing)[0] + 0.5) * spacing
        return cKDTree(places), surface_level(still, spacing)(places)

    def _level(self, points: np.ndarray) -> np.ndarray:
        """z (m) of the liquid at rest at places."""
        assert self._columns is not None
        columns, heights = self._columns
        count = min(LEVELS, len(heights))
        nearest = columns.query(points[:, :2], k=count, workers=-1)[1]
        return heights[nearest.reshape(len(points), count)].mean(axis=1)

    def islands(self, ground: TriangleMesh, grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Heights (m) of a block of ground over its nodes, the level of the liquid there, and bool: what stands out of
        it and is no bank. None where nothing does, or that is not known."""
        heights = _heights(ground, grid)
        if heights is None or self.still is None or len(self.still) == 0:
            return None
        places = np.asarray(ground.vertices)[: heights.size, :2]
        level = surface_level(self.still, grid.spacing)(places).reshape(heights.shape)
        part, _ = ndimage.label(heights > level, structure=np.ones((3, 3)))
        rim = np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]])
        island = (part > 0) & ~np.isin(part, rim)
        return (heights, level, island) if island.any() else None


def _heights(ground: TriangleMesh, grid: Grid) -> np.ndarray | None:
    """z of the top of a block of ground over its nodes, m; None of another mesh."""
    nodes = (grid.shape[0] * PARTS + 1, grid.shape[1] * PARTS + 1)
    count = nodes[0] * nodes[1]
    around = 2 * (nodes[0] + nodes[1]) - 4
    if len(ground.vertices) <= count or (len(ground.vertices) - 1 - count) % around:
        return None
    top = np.asarray(ground.vertices[:count], np.float64).reshape(*nodes, 3)
    return top[..., 2] if np.allclose(top[0, 0, :2], grid.low[:2], atol=1e-3 * grid.spacing) else None


def _near_picture(points: np.ndarray, camera: PinholeCamera, upward: float = 0.0) -> np.ndarray:
    """bool [n]: in the picture or close to its rim. upward: m by which points may be moved up or down, to where it is
    asked whether any place on the way is."""
    pose, (width, height), room = camera.camera_from_world, camera.size, MARGIN * max(camera.size)
    seen, (fx, fy), (cx, cy) = pose.points(points), camera.focal, camera.center
    # each side of the picture is a plane through the eye, on whose inner side these are positive
    sides = np.array([
        [0.0, 0.0, 1.0], [fx, 0.0, cx + room], [-fx, 0.0, width + room - cx], [0.0, fy, cy + room],
        [0.0, -fy, height + room - cy],
    ])  # fmt: skip
    reach = upward * np.abs(sides @ np.asarray(pose.rotation, np.float64)[:, 2])
    return np.asarray((seen @ sides.T + reach > 0.0).all(axis=-1))
