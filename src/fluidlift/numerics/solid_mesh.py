"""Closed triangle meshes as solids: checks, exact integrals, simple shapes, points on the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree, QhullError

from fluidlift.errors import InputRejected, require
from fluidlift.types import TriangleMesh

LARGEST = 200_000
"""faces of a mesh that is accepted"""
SEAM = 1e-6
"""of the mesh's extent: vertices closer than this are one (meshes from files are often cut at texture seams)"""
FLATTEST = 1e-6
"""volume over extent^3 below which a mesh encloses nothing"""


@dataclass(frozen=True)
class Moments:
    """Volume integrals of a solid of density 1."""

    volume: float
    """m^3"""
    center: Float[np.ndarray, "3"]
    """m, centre of mass"""
    second: Float[np.ndarray, "3 3"]
    """m^5, integral of r r^T about the centre of mass"""

    @property
    def inertia(self) -> Float[np.ndarray, "3 3"]:
        """m^5 about the centre of mass; times the density: kg m^2."""
        return np.trace(self.second) * np.eye(3) - self.second


def moments(mesh: TriangleMesh) -> Moments:
    """Exact for the polyhedron, by the divergence theorem.

    Each face and the origin span a tetrahedron of signed volume; polynomials up to degree two are integrated over it
    in closed form (Mirtich 1996; here in the matrix form of Blow and Binstock 2004). The origin is put into the middle
    of the vertices first, against cancellation.
    """
    vertices = np.asarray(mesh.vertices, np.float64)
    middle = vertices.mean(axis=0)
    corners = (vertices - middle)[np.asarray(mesh.faces)]
    sixfold = np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    volume = float(sixfold.sum() / 6.0)
    require(volume != 0.0, "a mesh of no volume", "a closed surface around a solid")
    total = corners.sum(axis=1)
    center = (sixfold[:, None] * total).sum(axis=0) / (24.0 * volume)
    # integral of x x^T over a tetrahedron at the origin: det / 120 (sum of corner x corner^T + total x total^T)
    about_middle = np.einsum("n,nci,ncj->ij", sixfold, corners, corners)
    about_middle = (about_middle + np.einsum("n,ni,nj->ij", sixfold, total, total)) / 120.0
    return Moments(volume, center + middle, about_middle - volume * np.outer(center, center))


def flipped(mesh: TriangleMesh) -> TriangleMesh:
    """The same surface with inside and outside exchanged."""
    uv = None if mesh.uv is None else np.ascontiguousarray(np.asarray(mesh.uv)[:, ::-1])
    faces = np.ascontiguousarray(np.asarray(mesh.faces)[:, ::-1])
    return TriangleMesh(mesh.vertices, faces, mesh.colors, uv, mesh.texture)


def welded(mesh: TriangleMesh) -> TriangleMesh:
    """Vertices at the same place become one; triangles that collapse are dropped."""
    vertices = np.asarray(mesh.vertices, np.float64)
    n = len(vertices)
    if n == 0:
        return mesh
    pairs = KDTree(vertices).query_pairs(SEAM * float(np.ptp(vertices, axis=0).max()), output_type="ndarray")
    joined = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    _, group = connected_components(joined, directed=False)
    first = np.unique(group, return_index=True)[1]
    faces = group[np.asarray(mesh.faces)]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    colors = None if mesh.colors is None else mesh.colors[first]
    return TriangleMesh(vertices[first], faces[whole].astype(np.int64), colors)


def _edges(faces: Int[np.ndarray, "f 3"], count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Undirected edges [e,2], the number of triangles at each, and the number of those that run from low to high."""
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    low, high = directed.min(axis=1), directed.max(axis=1)
    keys, index = np.unique(low.astype(np.int64) * count + high, return_inverse=True)
    triangles = np.bincount(index, minlength=len(keys))
    forward = np.bincount(index, weights=directed[:, 0] == low, minlength=len(keys)).astype(np.int64)
    return np.stack([keys // count, keys % count], axis=1), triangles, forward


def _place(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in point) + ")"


def closed_mesh(mesh: TriangleMesh, *, name: str = "mesh", max_faces: int = LARGEST) -> TriangleMesh:
    """The mesh with its seams welded, once it is known to bound a solid.

    Raises:
        InputRejected: not finite, wrong indices, too many faces, open, facing both ways, flat or inside-out.
    """
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if len(faces) > max_faces:
        raise InputRejected(f"{name}: {len(faces)} triangles", f"at most {max_faces}", "simplify (decimate) the mesh")
    if len(faces) < 4 or len(vertices) < 4:
        raise InputRejected(
            f"{name}: {len(vertices)} vertices and {len(faces)} triangles", "a closed surface: at least four of each",
            "check that the file holds a triangle mesh",
        )  # fmt: skip
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise InputRejected(
            f"{name}: {int(bad.sum())} vertices that are not finite, the first has number {int(bad.argmax())}",
            "finite coordinates in metres", "export the mesh again",
        )  # fmt: skip
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputRejected(
            f"{name}: vertex numbers from {int(faces.min())} to {int(faces.max())}", f"0 to {len(vertices) - 1}",
            "export the mesh again",
        )  # fmt: skip
    solid = welded(mesh)
    _require_closed(solid, name)
    extent = float(np.ptp(solid.vertices, axis=0).max())
    corners = solid.vertices[solid.faces] - solid.vertices.mean(axis=0)
    volume = float(np.einsum("ni,ni->n", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6.0)
    if abs(volume) < FLATTEST * extent**3:
        raise InputRejected(
            f"{name}: volume {volume:.3g} m^3 at an extent of {extent:.3g} m (a flat or degenerate mesh)",
            "a solid with a thickness", "give the surface a thickness (solidify)",
        )  # fmt: skip
    if volume < 0:
        raise InputRejected(
            f"{name}: volume {volume:.3g} m^3, the surface is inside-out", "triangles counter-clockwise from outside",
            "flip the faces (fluidlift.numerics.solid_mesh.flipped)",
        )  # fmt: skip
    return solid


def _require_closed(solid: TriangleMesh, name: str) -> None:
    """InputRejected where edges have one triangle, or neighbours face opposite ways."""
    edges, triangles, forward = _edges(solid.faces, len(solid.vertices))
    middle = solid.vertices[edges].mean(axis=1)
    odd = triangles % 2 == 1
    if odd.any():
        places = ", ".join(_place(p) for p in middle[odd][:3])
        raise InputRejected(
            f"{name}: the surface is open: {int(odd.sum())} edges without a second triangle, such as those near "
            f"{places} m", "a closed (watertight) surface", "fill the holes, or give a sheet a thickness (solidify)",
        )  # fmt: skip
    twisted = 2 * forward != triangles
    if twisted.any():
        raise InputRejected(
            f"{name}: neighbouring triangles face opposite ways at {int(twisted.sum())} edges, such as that near "
            f"{_place(middle[twisted][0])} m", "all triangles counter-clockwise from outside",
            "recalculate the normals (outside) in the program the mesh comes from",
        )  # fmt: skip


def box_mesh(size: Float[np.ndarray, "3"] | Sequence[float] | float) -> TriangleMesh:
    """A box of edge lengths `size` (m; one for a cube) around the origin."""
    half = 0.5 * np.broadcast_to(np.asarray(size, np.float64), (3,))
    require(bool((half > 0).all()), f"box size {tuple(2 * half)}", "positive metres")
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return TriangleMesh(corners, np.array(faces))


def ellipsoid_mesh(semi_axes: Float[np.ndarray, "3"] | Sequence[float] | float, subdivisions: int = 4) -> TriangleMesh:
    """An ellipsoid around the origin: an icosahedron subdivided (20 * 4^n faces), with the volume of the ellipsoid."""
    axes = np.broadcast_to(np.asarray(semi_axes, np.float64), (3,))
    require(bool((axes > 0).all()), f"semi-axes {tuple(axes)}", "positive metres")
    require(0 <= subdivisions <= 6, f"{subdivisions} subdivisions", "0 to 6")
    g = (1 + np.sqrt(5)) / 2
    vertices = np.array(
        [[-1, g, 0], [1, g, 0], [-1, -g, 0], [1, -g, 0], [0, -1, g], [0, 1, g], [0, -1, -g], [0, 1, -g],
         [g, 0, -1], [g, 0, 1], [-g, 0, -1], [-g, 0, 1]]
    ) / np.sqrt(1 + g * g)  # fmt: skip
    faces = np.array(
        [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2], [10, 7, 6],
         [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5], [2, 4, 11], [6, 2, 10],
         [8, 6, 7], [9, 8, 1]]
    )  # fmt: skip
    for _ in range(subdivisions):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        middle = vertices[unique].mean(axis=1)
        ab, bc, ca = (index.reshape(3, -1) + len(vertices)).astype(np.int64)
        vertices = np.concatenate([vertices, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        a, b, c = faces.T
        faces = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    ball = TriangleMesh(vertices, faces)
    return TriangleMesh(vertices * axes * np.cbrt(4.0 / 3.0 * np.pi / moments(ball).volume), faces)


def cylinder_mesh(radius: float, height: float) -> TriangleMesh:
    """A cylinder along z around the origin; its base is a regular polygon with the area of the circle."""
    require(radius > 0 and height > 0, f"radius {radius}, height {height}", "positive metres")
    n = 64
    i = np.arange(n)
    j = (i + 1) % n
    angle = 2 * np.pi * i / n
    polygon = radius * np.sqrt(np.pi / (n * np.sin(np.pi / n) * np.cos(np.pi / n)))
    ring = polygon * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    low, high = (np.column_stack([ring, np.full(n, z)]) for z in (-0.5 * height, 0.5 * height))
    vertices = np.concatenate([low, high, [[0, 0, -0.5 * height], [0, 0, 0.5 * height]]])
    faces = [
        (i, j, n + j), (i, n + j, n + i), (j, i, np.full(n, 2 * n)), (n + i, n + j, np.full(n, 2 * n + 1)),
    ]  # fmt: skip
    return TriangleMesh(vertices, np.concatenate([np.stack(f, axis=1) for f in faces]))


def hull_points(mesh: TriangleMesh) -> Float[np.ndarray, "n 3"]:
    """Corners of the convex hull, m."""
    vertices = np.asarray(mesh.vertices, np.float64)
    try:
        return vertices[np.sort(ConvexHull(vertices).vertices)]
    except QhullError:
        return vertices


def surface_points(mesh: TriangleMesh, spacing: float) -> Float[np.ndarray, "n 3"]:
    """Points on the surface, none farther than about `spacing` (m) from its neighbours.

    The corners of the convex hull come first and are all kept unless they lie closer than half the spacing to each
    other; then other vertices, then a lattice on every triangle, each where no point is near yet.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    longest = np.sqrt(np.max([np.square(b - a).sum(1), np.square(c - b).sum(1), np.square(a - c).sum(1)], axis=0))
    counts = np.ceil(longest / spacing).astype(np.int64)
    lattice = []
    for n in np.unique(counts[counts > 1]):
        i, j = (g.ravel() for g in np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij"))
        i, j = i[i + j <= n] / n, j[i + j <= n] / n
        at = counts == n
        points = a[at][:, None] * (1 - i - j)[:, None] + b[at][:, None] * i[:, None] + c[at][:, None] * j[:, None]
        lattice.append(points.reshape(-1, 3))
    points = np.concatenate([hull_points(mesh), vertices, *lattice])
    return _thinned(points, 0.5 * spacing)


def _thinned(points: np.ndarray, distance: float) -> np.ndarray:
    """Points in their order, without those within `distance` (m) of an earlier one that stays."""
    # one per small cube first: the pairs of a mesh much finer than the distance would be too many
    cubes = np.floor(points / (0.5 * distance)).astype(np.int64)
    points = points[np.sort(np.unique(cubes, axis=0, return_index=True)[1])]
    kept = np.ones(len(points), bool)
    near = KDTree(points).query_pairs(distance * (1 - 1e-9), output_type="ndarray")
    near = np.sort(near, axis=1)
    near = near[np.lexsort((near[:, 1], near[:, 0]))]
    for first, second in near:
        if kept[first]:
            kept[second] = False
    return points[kept]
