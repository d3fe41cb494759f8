"""What a pour falls into, as thin glass: which faces of the ground are the vessel, and what its walls do to a picture.

The walls of the ground are some cells thick, as the simulation needs them, those of a glass thin. So light goes
straight through, is mirrored as at a pane (both of its surfaces, Fresnel) and tinted by the wall thicknesses on its
way: at the outline, where it runs along in the wall, they are many. That is the edge by which one sees a glass.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from fluidlift.look.liquid import Behind
from fluidlift.look.optics import fresnel
from fluidlift.numerics.mesh_normals import vertex_normals
from fluidlift.numerics.triangles import interpolated, rasterize_closed, rasterize_triangles
from fluidlift.types.camera import PinholeCamera
from fluidlift.types.kind import FluidKind, kind_of
from fluidlift.types.terrain import Terrain, TriangleMesh

if TYPE_CHECKING:
    from fluidlift.look.environment import Environment

LEVEL = 0.9
"""cosine to the vertical from which a face of the ground is level: the table is the height of most of what is"""
ABOVE = 0.5
"""cells above the table from which on ground is a vessel"""
INDEX = 1.52
"""refractive index of common glass"""
TINT = (0.93, 0.97, 0.955)
"""linear, share of light left by one thickness of wall: the green of common glass in its edge"""
GLASS = 0.25
"""opacity of the walls where they are drawn as surfels, without light that is mirrored or bent"""
MOST = 12.0
"""wall thicknesses on a ray, at most: light does not run round the whole of a wall"""


def has_glass(kind: str | FluidKind, terrain: Terrain) -> bool:
    """Whether what a fluid of a kind stands in lets light through."""
    return kind_of(kind).fills_vessel and not terrain.opaque


def glass_of(kind: str | FluidKind, terrain: Terrain) -> float | None:
    """Opacity, as surfels, of the walls of what a fluid of a kind stands in; None: they are ground as the rest."""
    return GLASS if has_glass(kind, terrain) else None


@dataclass(frozen=True)
class Vessel:
    """The walls of a vessel that stands on a table."""

    walls: TriangleMesh
    """closed: with an underside on the table"""
    inner: np.ndarray
    """bool [f]: faces of the walls that look at what they hold"""
    sheet: TriangleMesh
    """the walls as one sheet, without thickness: their outside and their rim"""

    @property
    def thickness(self) -> float:
        """m, of the walls: volume over half of the surface."""
        a, b, c = (np.asarray(self.walls.vertices, np.float64)[self.walls.faces[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        middle = a.mean(axis=0)
        volume = abs(((a - middle) * np.cross(b - middle, c - middle)).sum()) / 6.0
        return float(max(2.0 * volume / max(area, 1e-30), 1e-9))


def vessel_apart(ground: TriangleMesh, cell: float) -> tuple[TriangleMesh, Vessel | None]:
    """The ground of a pour without what stands on it, and that, its vessel; None where nothing stands there.

    The table goes on below the walls, in the colours around them.

    Args:
        ground: of the pour: a level table, and what stands on it.
        cell: m, of the simulation.
    """
    points, faces = np.asarray(ground.vertices, np.float64), np.asarray(ground.faces)
    if not len(faces):
        return ground, None
    cross = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    area = np.linalg.norm(cross, axis=1)
    level = _level(points[faces][..., 2].mean(axis=1), np.where(cross[:, 2] > LEVEL * area, area, 0.0))
    if level is None:
        return ground, None
    high = points[:, 2] > level + ABOVE * cell
    stands = np.any(high[faces], axis=1)
    if not stands.any():
        return ground, None
    foot = np.zeros(len(points), bool)
    foot[faces[stands]] = True
    down, top = points.copy(), points.copy()
    down[foot, 2] = level
    top[foot & ~high, 2] = level
    return _table(ground, down, stands, foot), _vessel(ground, top, down, stands)


def _level(heights: np.ndarray, weights: np.ndarray) -> float | None:
    """The weighted median; None of no weight."""
    order = np.argsort(heights)
    total = np.cumsum(weights[order])
    return None if total[-1] <= 0 else float(heights[order][np.searchsorted(total, 0.5 * total[-1])])


def _table(ground: TriangleMesh, down: np.ndarray, stands: np.ndarray, foot: np.ndarray) -> TriangleMesh:
    faces = np.asarray(ground.faces)
    across = np.cross(down[faces[:, 1]] - down[faces[:, 0]], down[faces[:, 2]] - down[faces[:, 0]])[:, 2]
    # walls have fallen to lines; what looked down, below an edge that stands out, lies under what looks up
    kept = ~stands | (across > 1e-9 * np.abs(across).max())
    colors = ground.colors
    bare = np.setdiff1d(np.unique(faces[~stands]), np.flatnonzero(foot))
    if colors is not None and len(bare):
        colors = np.array(colors)
        colors[foot] = colors[bare][cKDTree(down[bare]).query(down[foot])[1]]
    uv = None if ground.uv is None else ground.uv[kept]
    return TriangleMesh(down.astype(ground.vertices.dtype), faces[kept], colors, uv, ground.texture)


def _vessel(ground: TriangleMesh, top: np.ndarray, down: np.ndarray, stands: np.ndarray) -> Vessel:
    faces, n = np.asarray(ground.faces)[stands], len(top)
    a, b, c = (top[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    middle = (a + b + c) / 3.0
    axis = (middle[:, :2] * area[:, None]).sum(axis=0) / max(area.sum(), 1e-30)
    inner = (cross[:, :2] * (axis - middle[:, :2])).sum(axis=1) > 0.0
    inner &= np.linalg.norm(cross[:, :2], axis=1) > 0.5 * area  # the rim looks up
    below = np.arange(n) + n * (top != down).any(axis=1)  # where it stands on the table both are one
    walls = TriangleMesh(np.concatenate([top, down]), np.concatenate([faces, below[faces[:, ::-1]]]))
    used, index = np.unique(faces[~inner], return_inverse=True)
    colors = None if ground.colors is None else np.asarray(ground.colors)[used]
    sheet = TriangleMesh(top[used].astype(np.float32), index.reshape(-1, 3), colors)
    return Vessel(walls, np.concatenate([inner, np.zeros(len(faces), bool)]), sheet)


@dataclass(frozen=True)
class Pane:
    """Glass in a picture."""

    depth: np.ndarray
    """[h,w] camera z, m; 0 where there is none"""
    passes: np.ndarray
    """[h,w,3] share of light that comes through; 1 where there is none"""
    mirrored: np.ndarray
    """[h,w,3] linear light that it adds"""

    def over(self, image: np.ndarray, depth: np.ndarray | None = None) -> np.ndarray:
        """The picture seen through it; of what is nearer to the camera than it (depth: camera z, m, 0: nothing) the
        picture itself."""
        seen = image * self.passes + self.mirrored
        if depth is None:
            return seen
        return np.where(((depth > 0) & (depth < self.depth))[..., None], image, seen)


def panes(vessel: Vessel, camera: PinholeCamera, environment: Environment) -> tuple[Pane, Pane]:
    """The walls before and behind what the vessel holds.

    Only the nearest wall is before it, and only where its outside is seen.
    """
    walls = vessel.walls
    rays = camera.rays(camera.pixel_grid())
    away = np.linalg.norm(rays, axis=-1)
    rays = rays / away[..., None]
    closed = rasterize_closed(walls.vertices, walls.faces, camera)
    smooth = vertex_normals(walls)
    thickness = vessel.thickness
    whole = np.clip(closed.inside, 0.0, None) * away
    both = closed.front.hit & closed.back.hit
    first = np.where(both, np.clip(closed.back.depth - closed.front.depth, 0.0, None), 0.0) * away
    before = closed.front.hit & ~vessel.inner[np.maximum(closed.front.face, 0)]
    normal = interpolated(closed.front, smooth, walls.faces)
    near = _pane(before, closed.front.depth, normal, np.where(before, first, 0.0) / thickness, rays, environment)
    # of the others the nearest that is seen from inside
    held = walls.faces[vessel.inner]
    behind = rasterize_triangles(walls.vertices, held, camera, facing="front")
    normal = interpolated(behind, smooth, held)
    rest = np.where(before, whole - first, whole) / thickness
    return near, _pane(behind.hit, behind.depth, normal, rest, rays, environment)


def _pane(there, depth, normal, thicknesses, rays, environment: Environment) -> Pane:
    """A pane where `there`, with what its walls take from light."""
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), -rays)
    cos = np.clip(-(normal * rays).sum(axis=-1), 0.0, 1.0)
    share = pane_share(cos) * there
    mirror = rays + 2.0 * cos[..., None] * normal
    passes = np.asarray(TINT) ** np.clip(thicknesses, 0.0, MOST)[..., None] * (1.0 - share[..., None])
    light = share[..., None] * environment.toward(mirror)
    return Pane(np.where(there, depth, 0.0), passes.astype(np.float32), light.astype(np.float32))


def pane_share(cos: np.ndarray) -> np.ndarray:
    """Share of light that a pane mirrors: Fresnel's r at its first surface, and what goes to and fro between both, so
    2 r / (1 + r) in all (Born and Wolf 1999)."""
    r = fresnel(np.asarray(cos, np.float64), INDEX)
    return 2.0 * r / (1.0 + r)


def before_glass(behind: Behind, pane: Pane) -> Behind:
    """What lies behind what the vessel holds, through its far wall, which hides nothing."""
    return Behind(pane.over(behind.image, behind.depth), behind.depth, behind.goes_on)
