"""Surfaces of particles by splashsurf: marching cubes on the SPH density, weighted Laplacian smoothing (Loeschner,
Boettcher, Jeske and Bender 2023)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, final

import numpy as np

from fluidlift.errors import MissingPackage, require
from fluidlift.numerics.particle_mean import kernel_mean
from fluidlift.seams import Mesher
from fluidlift.types import TriangleMesh

KERNEL = 2.0
"""smoothing length, radii: the support then spans four neighbours"""
CUBE = 0.8
"""cell of the marching cubes, radii"""
INSIDE = 0.6
"""share of the density of the full fluid at which the surface lies"""
CARRIED = 1.5 * KERNEL
"""reach of the means of what particles carry, radii: they are as wide as the kernel of the density"""
SMOOTHING = 15
"""passes over the mesh; the weights keep flat parts from shrinking and take the lattice out of sprays"""
DRAFT_CUBE, DRAFT_SMOOTHING = 1.2, 7
"""of drafts, in half of the time: passes reach as far as the others, over larger triangles"""
BLOCK = 32
"""cells along a side of the blocks worked on at a time: with the 64 of the package small bodies leave cores idle"""
FEWEST = 4
"""particles with neighbours: fewer bound nothing"""


@final
class SplashsurfMesher(Mesher):
    """Through the package `pysplashsurf`.

    Args:
        draft: coarser, in half of the time.

    Raises:
        MissingPackage: it is not installed.
    """

    def __init__(self, *, draft: bool = False) -> None:
        try:
            import pysplashsurf
        except ImportError:
            raise MissingPackage("Surface meshes need pysplashsurf: pip install pysplashsurf") from None
        self._package: Any = pysplashsurf
        self._cube, self._smoothing = (DRAFT_CUBE, DRAFT_SMOOTHING) if draft else (CUBE, SMOOTHING)

    def surface(
        self, positions: np.ndarray, radius: float, attributes: Mapping[str, np.ndarray]
    ) -> tuple[TriangleMesh, dict[str, np.ndarray]]:
        """See `Mesher.surface`. Particles with a number that is not finite are left out; no particles, no triangles."""
        require(np.isfinite(radius) and radius > 0, f"a radius of {radius}", "positive metres")
        points = np.ascontiguousarray(positions, np.float64)
        sound = np.isfinite(points).all(axis=1)
        values = {k: np.ascontiguousarray(np.asarray(v, np.float32)[sound]) for k, v in attributes.items()}
        if sound.sum() < FEWEST:
            return _nothing(values)
        # single precision takes two thirds of the time; about its middle a body loses nothing by it
        middle = points[sound].mean(axis=0)
        particles = (points[sound] - middle).astype(np.float32)
        found, _ = self._package.reconstruction_pipeline(
            particles, particle_radius=radius, smoothing_length=KERNEL, cube_size=self._cube,
            iso_surface_threshold=INSIDE, mesh_cleanup=True, decimate_barnacles=True,
            mesh_smoothing_iters=self._smoothing, mesh_smoothing_weights=True, subdomain_num_cubes_per_dim=BLOCK,
        )  # fmt: skip
        vertices, faces = np.asarray(found.mesh.vertices), np.asarray(found.mesh.triangles, np.int64)
        if len(faces) == 0:
            return _nothing(values)
        mesh = TriangleMesh((vertices.astype(np.float64) + middle).astype(np.float32), faces)
        return mesh, _carried(np.ascontiguousarray(vertices, np.float32), particles, values, CARRIED * radius)


def _carried(
    vertices: np.ndarray, particles: np.ndarray, values: Mapping[str, np.ndarray], reach: float
) -> dict[str, np.ndarray]:
    """Values at the vertices, all in one pass: for 100 000 particles the package takes a third of a second of processor
    time for each of them, next to 1.1 for the surface."""
    if not values:
        return {}
    every = [v.reshape(len(v), -1) for v in values.values()]
    found = kernel_mean(vertices, particles, np.concatenate(every, axis=1), reach)
    ends = np.cumsum([v.shape[1] for v in every])[:-1]
    parts = zip(values.items(), np.split(found, ends, axis=1), strict=True)
    return {name: part.reshape(len(part), *value.shape[1:]) for (name, value), part in parts}


def _nothing(values: Mapping[str, np.ndarray]) -> tuple[TriangleMesh, dict[str, np.ndarray]]:
    mesh = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64))
    return mesh, {k: np.zeros((0, v.shape[1]), np.float32) for k, v in values.items()}
