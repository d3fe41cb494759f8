"""Plumes: smoke that is round in level sections and rises from below."""

from __future__ import annotations

import numpy as np

from fluidlift.shape import depth_surface, surface
from fluidlift.types.kind import PLUME


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
        return fluid & (z < z[fluid].min() + 3.0 * spacing)

    def outlet(self, shape):
        """All faces but the floor."""
        faces = np.ones(shape, bool)
        faces[2:-2, 2:-2, :-2] = False
        return faces


BUILDER = _Plume()
