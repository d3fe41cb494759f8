"""The surface of a frame's fluid as a mesh that does not dip into the terrain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fluidlift.look.outlet_section import OpenEnd
from fluidlift.look.surface_skin import of_skin, painted_liquid
from fluidlift.seams import Mesher
from fluidlift.types import Gaussians, Terrain, TriangleMesh

RADIUS = 0.4
"""of a particle in the mesh, cells of the simulation: neighbours lie half a cell apart after reseeding, and a little
more keeps drops whole and flat water flat"""


def surface_of(
    fluid: Gaussians,
    velocities: np.ndarray,
    terrain: Terrain,
    mesher: Mesher,
    *,
    clamped: bool = True,
    ends: Sequence[OpenEnd] = (),
) -> tuple[TriangleMesh, np.ndarray]:
    """The surface with the splats' colours (sRGB) at its vertices, and its velocity [v,3] there, m/s.

    Args:
        fluid: n splats, m; those of a skin only give their colours.
        velocities: [n,3], m/s.
        terrain: that the surface stays out of.
        mesher: of particles.
        clamped: whether it does; the surface of particles itself stands a little outside them, and dips into the bed.
        ends: of a stream, where the surface ends in flat sections; at others it goes as far as the particles.
    """
    for end in ends:
        kept, places = end.carried_on(fluid.means)
        fluid, velocities = replace(fluid.select(kept), means=places), velocities[kept]
    velocities = velocities[~of_skin(fluid, terrain.grid.spacing)]
    fluid = painted_liquid(fluid, terrain.grid.spacing)
    carried = {"velocity": velocities, "rgb": fluid.rgb}
    mesh, found = mesher.surface(fluid.means, RADIUS * terrain.grid.spacing, carried)
    vertices = outside_solid(mesh.vertices, terrain) if clamped else np.asarray(mesh.vertices)
    surface = TriangleMesh(vertices, mesh.faces, np.clip(found["rgb"], 0.0, 1.0))
    for end in ends:
        surface = end.section(surface)
    return surface, found["velocity"]


def outside_solid(points: np.ndarray, terrain: Terrain) -> np.ndarray:
    """Points [n,3] (m) inside the terrain moved to its surface along the gradient of the distance; the others stay.

    A surface of particles stands a radius outside them and would dip into the bed.
    """
    from fluidlift.numerics.sampling import gradient_nodes, sample_nodes

    moved = np.array(points, np.float32)
    for _ in range(2):  # the distance is not exact beside edges: once more brings most of the rest out
        distance = sample_nodes(terrain.signed_distance, terrain.grid, moved)
        inside = (distance < 0) & terrain.grid.contains(moved)
        if not inside.any():
            break
        normal = gradient_nodes(terrain.signed_distance, terrain.grid, moved[inside])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        moved[inside] -= distance[inside, None] * normal
    return moved
