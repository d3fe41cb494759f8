"""The block of ground under a fluid (`numerics.ground_block`), and its colours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import cKDTree

from fluidlift.numerics.ground_block import PARTS, ground_mesh
from fluidlift.numerics.srgb import linear_from_srgb, srgb_from_linear
from fluidlift.types import PinholeCamera, TriangleMesh

__all__ = ["PARTS", "VertexLook", "cut_colour", "ground_colours", "ground_mesh"]

LOAM = np.array([0.28, 0.24, 0.20])
"""linear reflectance of dry loam, about a quarter"""
OWN = 0.5
"""share of the ground's own colour in a cut through it: below turf or snow there is earth"""

GRAZING = (0.1, 0.3)
"""sine of the angle at which ground is seen, below which the picture says nothing of it and above which it is believed
(6 and 17 degrees: a pixel is drawn out to ten and to three times its width). What is seen so flatly is mostly what
stands behind it or before it, drawn into streaks"""


def cut_colour(ground: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """sRGB in [0, 1] of a cut through ground whose top has these colours (sRGB): half their median, half dry loam, in
    linear light. The shade of a side comes from the light on it: a colour darkened beforehand is shaded twice.
    """
    return srgb_from_linear(OWN * linear_from_srgb(np.median(ground, axis=0)) + (1.0 - OWN) * LOAM)


@dataclass(frozen=True)
class VertexLook:
    """Where a picture shows the look of a ground's vertices."""

    places: Float[np.ndarray, "v 3"]
    """at which it is read, m"""
    covered: Bool[np.ndarray, " v"]
    """what stands before them is seen in their place"""
    stands: Bool[np.ndarray, " v"]
    """they are of what stands on the ground, which lends it no look"""


def ground_colours(
    mesh: TriangleMesh,
    plate: UInt8[np.ndarray, "h w 3"],
    camera: PinholeCamera,
    read: VertexLook | None = None,
) -> Float[np.ndarray, "v 3"]:
    """sRGB in [0, 1] of each vertex of a terrain.

    What the picture shows gets its colour from there, less the more flatly it is seen (`GRAZING`): then it has the
    mean of what is shown in its place. Ground beyond the picture goes on as the seen ground beside it, evened out: the
    last pixel would be drawn into long streaks. The cut sides and the floor show plain earth.

    Args:
        mesh: of the terrain, world.
        plate: the scene without its fluid.
        camera: in the world.
        read: where the picture shows the look of each vertex; None: it shows each in its place.
    """
    vertices = mesh.vertices.astype(np.float64)
    nothing = np.zeros(len(vertices), bool)
    read = VertexLook(vertices, nothing, nothing) if read is None else read
    uv, depth = camera.project(read.places)
    row, col, _ = camera.nearest_pixels(read.places)
    colours = plate[row, col].astype(np.float32) / 255.0
    seen = (depth > 0) & (uv >= 0).all(axis=-1) & (uv < np.array(camera.size)).all(axis=-1) & ~read.covered
    top = _looks_up(mesh)
    cut = _on_box(mesh) & ~top
    known = seen & ~cut
    if not known.any():
        return colours
    colours[cut] = cut_colour(colours[known])
    plain = known & ~read.stands & top
    way = camera.position - vertices[plain]
    steep = np.abs(way[:, 2]) / np.maximum(np.linalg.norm(way, axis=1), 1e-12)
    believed = np.clip((steep - GRAZING[0]) / (GRAZING[1] - GRAZING[0]), 0.0, 1.0)[:, None]
    if plain.any():
        mean = srgb_from_linear(linear_from_srgb(colours[plain]).mean(axis=0))
        colours[plain] = believed * colours[plain] + (1.0 - believed) * mean
    hidden = ~seen & ~cut
    lies = known & ~read.stands if (known & ~read.stands).any() else known
    if hidden.any():
        nearest = cKDTree(vertices[lies, :2]).query(vertices[hidden, :2], k=min(32, int(lies.sum())))[1]
        colours[hidden] = colours[lies][nearest.reshape(int(hidden.sum()), -1)].mean(axis=1)
    return colours


def _looks_up(mesh: TriangleMesh) -> np.ndarray:
    """bool [v]: on a face that looks up."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    up = normal[:, 2] > 0.2 * np.linalg.norm(normal, axis=1)
    top = np.zeros(len(mesh.vertices), bool)
    top[mesh.faces[up].ravel()] = True
    return top


def _on_box(mesh: TriangleMesh) -> np.ndarray:
    """bool [v]: on the sides of the mesh's box or its floor."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    near = 1e-3 * float((high - low).max())
    side = (np.abs(mesh.vertices - low) < near).any(axis=1) | (np.abs(mesh.vertices - high) < near)[:, :2].any(axis=1)
    return side
