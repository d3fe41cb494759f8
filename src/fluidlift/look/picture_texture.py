"""What a fluid that falls or stands looks like in its film, by place in the picture."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.look.footage import FluidFootage
from fluidlift.look.seen_texture import TrustedMap
from fluidlift.look.surface_axes import PictureAxes
from fluidlift.look.surface_map import SurfaceMap, sampled


class PictureTexture(TrustedMap):
    """As `SeenTexture` for a map over the picture, where each place is seen in itself.

    Args:
        axes: of the map.
        surface: of the body at rest.
        footage: of the fluid.
    """

    def __init__(self, axes: PictureAxes, surface: SurfaceMap, footage: FluidFootage) -> None:
        self._axes = axes
        index = self.index_of(surface.middles().reshape(-1, 2))
        inside = ((index >= 0) & (index <= np.array(footage.outside.shape) - 1)).all(axis=1)
        super().__init__(surface, (inside & (sampled(footage.outside, index) <= 0)).reshape(surface.wet.shape))

    def seen_at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Row and column of the picture in which points of the map are seen."""
        return self.index_of(points[:, :2])

    def index_of(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Row and column in which places (X, Y in m) are seen."""
        return self.appearing(self._axes.pixels(places)[:, ::-1] - 0.5)
