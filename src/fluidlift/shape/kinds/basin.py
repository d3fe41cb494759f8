"""Basins: water that stays, whose surface is a level plane whatever travels over it."""

from __future__ import annotations

import numpy as np

from fluidlift.shape import depth_surface, surface

LEVEL = ((1.0, 0.0, 0.5),)
"""share, mean and standard deviation (degrees) of the slopes that it may have: none, but for errors of the depth"""


class Basin:
    """Construction of a level body."""

    def front_surface(self, seen):
        """A level plane."""
        return surface.level_surface(seen.camera, seen.mask)

    def depth_surface(self, scene, seen, slopes, usual):
        """A level plane, as far off as the depth says."""
        return depth_surface.stream_surface(
            scene, seen.camera, seen.mask, seen.motion, seen.trust, slopes=LEVEL, usual=usual
        )

    def mainstream(self, bulk):
        """None: across the view, along the waves of a sea and its horizon. Its box ends there, and beside the picture
        it goes on so."""
        return np.array([1.0, 0.0, 0.0])


BUILDER = Basin()
