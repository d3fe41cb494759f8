"""Pours: a jet that is round about its middle line, and the vessel that it may fill."""

from __future__ import annotations

import numpy as np

from fluidlift.shape import depth_surface, surface
from fluidlift.types.kind import POUR


class _Pour:
    side, above = 0.35, 0.1

    def front_surface(self, seen):
        return surface.inflated_surface(seen.camera, seen.mask, POUR, seen.roll)

    def depth_surface(self, scene, seen, slopes, usual):
        return depth_surface.airborne_surface(scene, seen.camera, seen.mask, POUR), None

    def mainstream(self, bulk):
        bulk = bulk / max(np.linalg.norm(bulk), 1e-12)
        return np.array([bulk[0], bulk[1], -max(-bulk[2], 1.0)])

    def vessel(self, body):
        """A container around the lower part of a body, if that is much wider than the upper part and holds its width (a
        pool that a jet falls into)."""
        z = body[:, 2]
        edges = np.linspace(z.min(), z.max(), 13)
        widths = np.zeros(12)
        for i in range(12):
            layer = (z >= edges[i]) & (z <= edges[i + 1])
            if layer.sum() > 5:
                widths[i] = np.ptp(np.percentile(body[layer, 0], [2, 98]))
        widest = np.percentile(widths, 90)
        wide = widths > 0.6 * widest
        first_narrow = int(np.argmin(wide)) if not wide.all() else 12
        if first_narrow < 2 or first_narrow > 10 or np.median(widths[first_narrow:]) > 0.55 * widest:
            return None
        pool = body[z <= edges[first_narrow]]
        centre = 0.5 * (np.percentile(pool[:, :2], 2, axis=0) + np.percentile(pool[:, :2], 98, axis=0))
        return (float(centre[0]), float(centre[1])), 0.5 * float(widest), float(edges[first_narrow])

    def inlet(self, fluid, z, spacing):
        return fluid & (z > z[fluid].max() - 2.0 * spacing)

    def outlet(self, shape):
        """What pours leaves sideways over the floor."""
        sides = np.ones(shape, bool)
        sides[2:-2, 2:-2] = False
        sides[:, :, -2:] = False
        return sides


BUILDER = _Pour()
