"""Plumes: smoke that is round in level sections and rises from below."""

from __future__ import annotations

import numpy as np

from fluidlift.shape import depth_surface, surface
from fluidlift.types.kind import PLUME

FOOT = 3
"""cells that the inlet is tall: what is thinner falls through between two of the places that particles come from"""


class _Plume:
    side, above = 0.2, 0.2

    def front_surface(self, seen):
        return surface.inflated_surface(seen.camera, seen.mask, PLUME, seen.roll)

    def depth_surface(self, scene, seen, slopes, usual):
        return depth_surface.airborne_surface(scene, seen.camera, seen.mask, PLUME), None

    def mainstream(self, bulk):
        bulk = bulk / max(np.linalg.norm(bulk), 1e-12)
        return np.array([bulk[0], bulk[1], max(bulk[2], 1.0)])

    def inlet(self, fluid, z, spacing):
        """The foot of the stem, as wide as the stem above it: the silhouette is round where the picture or the vessel
        cuts it off, and there the smoke is not. It stands on the ground: through a slit below it, all that flows in
        would be drawn from the sides."""
        lowest = z[fluid].min() - 0.5 * spacing
        foot = z < lowest + FOOT * spacing
        stem = np.any(fluid & (z < lowest + (FOOT + 1) * spacing), axis=2)
        return foot & stem[..., None]

    def outlet(self, shape):
        """All faces but the floor."""
        faces = np.ones(shape, bool)
        faces[2:-2, 2:-2, :-2] = False
        return faces


BUILDER = _Plume()
