"""One instant of an animated fluid, as the exporters take it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fluidlift.errors import require
from fluidlift.types import Gaussians, TriangleMesh

FIRST_FRAME = 1001
"""number of the first frame of every exported sequence, as visual-effects departments count"""


class MovingMesh(NamedTuple):
    """A solid that an exporter shows in its poses."""

    name: str
    mesh: TriangleMesh
    """m, in the body's own frame"""
    positions: np.ndarray
    """[k,3] m, of the body frame's origin at each frame"""
    orientations: np.ndarray
    """[k,4] unit quaternions w, x, y, z, world from body"""


class FluidFrame(NamedTuple):
    """What an exporter shows at one frame."""

    gaussians: Gaussians
    """world, m"""
    ids: np.ndarray
    """int [n], stable over time"""
    velocities: np.ndarray
    """[n,3], m/s"""
    surface: TriangleMesh | None = None
    """the free surface, where it was made"""
    surface_velocities: np.ndarray | None = None
    """[v,3], m/s, of the vertices of `surface`"""
    volume: str | None = None
    """name of this frame's OpenVDB file, relative to the USD file"""
    kinds: np.ndarray | None = None
    """int [n], of white water: 0 spray, 1 foam, 2 bubbles; -1 all else. None: the fluid has none in any frame"""

    def part(self, keep: np.ndarray) -> FluidFrame:
        """The Gaussians of a mask or of indices, with their ids, velocities and kinds; all else is left out."""
        kinds = None if self.kinds is None else np.asarray(self.kinds)[keep]
        gaussians = self.gaussians.select(keep)
        return FluidFrame(gaussians, np.asarray(self.ids)[keep], np.asarray(self.velocities)[keep], kinds=kinds)

    @staticmethod
    def of(given: FluidFrame | tuple) -> FluidFrame:
        """A frame, or one from the values of its fields in their order; after a check of the array lengths."""
        return (given if isinstance(given, FluidFrame) else FluidFrame(*given)).checked()

    def checked(self) -> FluidFrame:
        """Itself, after a check of the array lengths."""
        n = len(self.gaussians)
        require(
            np.shape(self.ids) == (n,) and np.shape(self.velocities) == (n, 3),
            f"ids {np.shape(self.ids)} and velocities {np.shape(self.velocities)} for {n} Gaussians",
            "[n] and [n,3]",
        )
        if self.surface is not None and self.surface_velocities is not None:
            v = len(self.surface.vertices)
            require(np.shape(self.surface_velocities) == (v, 3), "surface velocities of the wrong shape", f"({v}, 3)")
        if self.kinds is not None:
            require(np.shape(self.kinds) == (n,), f"kinds {np.shape(self.kinds)} for {n} Gaussians", "[n]")
        return self
