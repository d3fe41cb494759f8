"""Edits of the terrain before a simulation: moved, turned, scaled, twisted or replaced."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from fluidlift.errors import InputRejected, require
from fluidlift.numerics.solid_mesh import closed_mesh, welded
from fluidlift.types import CellType, Terrain, TriangleMesh

FLOOR = 0.1
"""of the longer side: how far a height field's floor lies below its lowest point"""
ASKED = 300
"""triangles that are asked whether another one lies above or below them"""


def _three(values: tuple[float, ...], what: str) -> tuple[float, float, float]:
    found = tuple(float(v) for v in values)
    require(len(found) == 3 and all(map(math.isfinite, found)), f"{what} {found}", "three finite numbers")
    return found  # type: ignore[return-value]


@dataclass(frozen=True)
class Move:
    """The terrain shifted as a whole."""

    offset: tuple[float, float, float]
    """m"""
    line: str = ""
    """where it stands in the file, for later complaints"""

    def __post_init__(self) -> None:
        object.__setattr__(self, "offset", _three(self.offset, "offset"))


@dataclass(frozen=True)
class Rotate:
    """The terrain turned about the vertical through its centre, counter-clockwise seen from above."""

    degrees: float
    line: str = ""

    def __post_init__(self) -> None:
        require(math.isfinite(self.degrees), f"{self.degrees} degrees", "a finite number")


@dataclass(frozen=True)
class Scale:
    """The terrain stretched about its centre (its lowest height for z: the ground stays where it is)."""

    factors: tuple[float, float, float]
    line: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "factors", _three(self.factors, "factors"))
        require(min(self.factors) > 0, f"factors {self.factors}", "positive (a mirror would turn it inside out)")


@dataclass(frozen=True)
class Twist:
    """The terrain turned about the mainstream through its centre, the more the farther downstream."""

    degrees_per_metre: float
    line: str = ""

    def __post_init__(self) -> None:
        require(math.isfinite(self.degrees_per_metre), f"{self.degrees_per_metre} degrees per metre", "a finite number")


@dataclass(frozen=True)
class Replace:
    """Another solid instead of the terrain."""

    mesh: TriangleMesh
    """closed, m, in the world"""
    line: str = ""
    note: str = ""
    """what was done to the mesh to close it; empty: nothing"""


def solid_ground(mesh: TriangleMesh) -> tuple[TriangleMesh, str]:
    """A mesh (m, z up) as a solid, with its colours and texture, and what was done to close it, in words.

    A height field (open, without an overhang) gets a skirt along its rims down to a floor: an artist's bed is often no
    more than what is seen of it.

    Raises:
        InputRejected: a mesh that neither bounds a solid nor is a height field.
    """
    name = "the terrain's mesh"
    try:
        return _with_looks(closed_mesh(mesh, name=name), mesh), ""
    except InputRejected as error:
        sheet = "open" in error.got or 0 < len(mesh.faces) < 4
        field = _height_field(_with_looks(welded(mesh), mesh)) if sheet else None
        if field is None:
            do = error.do
            if "open" in error.got:
                do += "; a height field is closed by itself, but this mesh has overhangs or is folded"
            raise InputRejected(error.got, error.needed, do) from None
    solid = _with_looks(closed_mesh(closed_below(field), name=name), closed_below(field))
    return solid, "the terrain's mesh is open: closed at its rims by a skirt and a floor below it"


def _with_looks(solid: TriangleMesh, mesh: TriangleMesh) -> TriangleMesh:
    """A welded mesh with the texture of the one it was made from, where no triangle has collapsed."""
    if mesh.texture is None or len(solid.faces) != len(mesh.faces):
        return solid
    return TriangleMesh(solid.vertices, solid.faces, solid.colors, mesh.uv, mesh.texture)


def _height_field(mesh: TriangleMesh) -> TriangleMesh | None:
    """The mesh with all triangles facing up; None where it hangs over, is folded, or neighbours disagree."""
    faces = np.asarray(mesh.faces)
    flat = np.asarray(mesh.vertices, np.float64)[:, :2]
    a, b, c = (flat[faces[:, i]] for i in range(3))
    twice = _cross(b - a, c - a)
    least = 1e-9 * float(np.abs(twice).max(initial=0.0))
    if (twice < -least).any() and (twice > least).any():
        return None
    ask = np.linspace(0, len(faces) - 1, min(ASKED, len(faces))).astype(int)
    for number in ask[np.abs(twice[ask]) > least]:
        p = (a[number] + b[number] + c[number]) / 3
        inside = [_cross(v - u, p - u) * np.sign(twice) > 0 for u, v in ((a, b), (b, c), (c, a))]
        if np.count_nonzero(inside[0] & inside[1] & inside[2]) > 1:
            return None
    directed = _directed(faces)
    if len(np.unique(directed, axis=0)) < len(directed):
        return None
    if not (twice < -least).any():
        return mesh
    uv = None if mesh.uv is None else np.ascontiguousarray(mesh.uv[:, ::-1])
    return TriangleMesh(mesh.vertices, np.ascontiguousarray(faces[:, ::-1]), mesh.colors, uv, mesh.texture)


def _cross(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """z of the cross product of plane vectors."""
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _directed(faces: np.ndarray) -> np.ndarray:
    """[3 f, 2]: edges of triangles, each in its triangle's sense; of face k at k, f + k and 2 f + k."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def closed_below(field: TriangleMesh) -> TriangleMesh:
    """The solid between a height field (triangles facing up) and a floor below it; rims and holes get a skirt.

    Colours and texture of the rim go on down the skirt.
    """
    vertices, faces = np.asarray(field.vertices, np.float64), np.asarray(field.faces, np.int64)
    count, n = len(vertices), len(faces)
    extent = np.ptp(vertices, axis=0)
    low = vertices.copy()
    low[:, 2] = vertices[:, 2].min() - FLOOR * max(extent[0], extent[1])
    edges = _directed(faces)
    keys, backwards = edges @ [count, 1], edges @ [1, count]
    rim = np.flatnonzero(~np.isin(keys, backwards))
    a, b = edges[rim].T
    skirt = np.concatenate([np.stack([b, a, a + count], -1), np.stack([b, a + count, b + count], -1)])
    colors = None if field.colors is None else np.concatenate([field.colors, field.colors])
    uv = None
    if field.uv is not None:
        face, corner = rim % n, rim // n
        ua, ub = field.uv[face, corner], field.uv[face, (corner + 1) % 3]
        sides = np.concatenate([np.stack([ub, ua, ua], axis=1), np.stack([ub, ua, ub], axis=1)])
        uv = np.concatenate([field.uv, sides, field.uv[:, ::-1]])
    whole = np.concatenate([faces, skirt, faces[:, ::-1] + count])
    return TriangleMesh(np.concatenate([vertices, low]), whole, colors, uv, field.texture)


TerrainEdit: TypeAlias = Move | Rotate | Scale | Twist | Replace


@dataclass(frozen=True)
class Place:
    """Where the edits put what was at a point: one map of space, made of one per edit.

    Water, inlet and outlet follow the terrain as if they were painted on it. An artist who turns a river bed means the
    river; moved against obstacles, emitters and the camera, which stay in the world. Only `Replace` leaves the water
    where it is.
    """

    forth: tuple[Callable[[np.ndarray], np.ndarray], ...] = ()
    back: tuple[Callable[[np.ndarray], np.ndarray], ...] = ()
    """their inverses, in the same order"""
    mainstream: Float[np.ndarray, "3"] = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    """unit direction of the bulk flow after them, in the middle of the water"""

    def points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Where they are after the edits, m."""
        out = np.asarray(points, np.float64)
        for step in self.forth:
            out = step(out)
        return out

    def origin(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Where they were before, m."""
        out = np.asarray(points, np.float64)
        for step in reversed(self.back):
            out = step(out)
        return out

    def gradient(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
        """d after / d before at points before the edits."""
        return gradient_of(self.points, points)

    def directions(self, points: Float[np.ndarray, "n 3"], vectors: Float[np.ndarray, "n 3"]) -> np.ndarray:
        """Vectors at points before the edits, turned with the terrain; their lengths stay (a river that is made wider
        flows no faster)."""
        turned = np.einsum("nij,nj->ni", self.gradient(points), np.asarray(vectors, np.float64))
        length, was = (np.linalg.norm(v, axis=-1, keepdims=True) for v in (turned, vectors))
        return turned * (was / np.maximum(length, 1e-12))


def gradient_of(function: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> np.ndarray:
    """Central differences of a map of space, [n,3,3]."""
    p = np.asarray(points, np.float64)
    step = 1e-4 * max(float(np.abs(p).max(initial=0.0)), 1.0)
    columns = [(function(p + step * e) - function(p - step * e)) / (2 * step) for e in np.eye(3)]
    return np.stack(columns, axis=-1)


def _rotation(axis: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Rotation matrices [...,3,3] about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = np.asarray(angle, np.float64)[..., None, None]
    return np.eye(3) + np.sin(a) * cross + (1 - np.cos(a)) * (cross @ cross)


def _about(center: np.ndarray, matrix: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda p: center + (p - center) @ matrix.T


def place_of(terrain: Terrain, cell_types: np.ndarray, edits: Sequence[TerrainEdit]) -> Place:
    """The map of space of the edits; `Replace` leaves space as it is.

    Turning and scaling are about the middle of the box (its bottom for heights); the axis of a twist runs along the
    mainstream through the middle of the water, and the twist begins where the water does: the inlet stays upright.
    """
    grid = terrain.grid
    wet = np.argwhere(np.isin(cell_types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW)))
    water = grid.low + (wet + 0.5) * grid.spacing if len(wet) else 0.5 * (grid.low + grid.high)[None]
    center = np.array([*0.5 * (grid.low + grid.high)[:2], grid.low[2]])
    axis, middle = np.asarray(terrain.mainstream, np.float64), water.mean(axis=0)
    forth, back = [], []
    for edit in edits:
        if isinstance(edit, Move):
            shift = np.array(edit.offset)
            forth.append(lambda p, s=shift: p + s)
            back.append(lambda p, s=shift: p - s)
        elif isinstance(edit, Rotate):
            turn = _rotation(np.array([0.0, 0.0, 1.0]), math.radians(edit.degrees))
            forth.append(_about(center, turn))
            back.append(_about(center, turn.T))
        elif isinstance(edit, Scale):
            factors = np.array(edit.factors)
            forth.append(_about(center, np.diag(factors)))
            back.append(_about(center, np.diag(1 / factors)))
        elif isinstance(edit, Twist):
            rate, start = math.radians(edit.degrees_per_metre), float(((water - middle) @ axis).min())
            forth.append(_twist(middle, axis, start, rate))
            back.append(_twist(middle, axis, start, -rate))
        else:
            continue
        step = forth[-1]
        axis = step(middle[None] + 1e-3 * axis)[0] - step(middle[None])[0]
        axis, center, middle, water = (
            axis / np.linalg.norm(axis),
            step(center[None])[0],
            step(middle[None])[0],
            step(water),
        )
    return Place(tuple(forth), tuple(back), axis)


def _twist(middle: np.ndarray, axis: np.ndarray, start: float, rate: float) -> Callable[[np.ndarray], np.ndarray]:
    """A turn about an axis by `rate` (rad/m) times the way past `start` (m along it, from the middle)."""

    def twisted(points: np.ndarray) -> np.ndarray:
        away = points - middle
        angle = rate * np.maximum(away @ axis - start, 0.0)
        return middle + np.einsum("nij,nj->ni", _rotation(axis, angle), away)

    return twisted
