"""Falls: a curtain along its bed, whose profile follows the line of steepest descent."""

from __future__ import annotations

from fluidlift.shape import depth_surface, surface


class _Fall:
    def front_surface(self, seen):
        return surface.falling_surface(seen.camera, seen.mask, seen.motion, seen.trust)

    def depth_surface(self, scene, seen, slopes, usual):
        return depth_surface.fall_surface(scene, seen.camera, seen.mask), None

    def mainstream(self, bulk):
        return bulk


BUILDER = _Fall()
