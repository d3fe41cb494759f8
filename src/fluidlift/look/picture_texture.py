"""What a fluid that falls or stands looks like in its film, by place in the picture."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.look.footage import FluidFootage
from fluidlift.look.surface_axes import PictureAxes
from fluidlift.look.surface_map import SurfaceMap, sampled


class PictureTexture:
    """As `look.seen_texture.SeenTexture` for a map over the picture, where each place is seen in itself.

    Args:
        axes: of the map.
        surface: of the body at rest.
        footage: of the fluid.
    """

    def __init__(self, axes: PictureAxes, surface: SurfaceMap, footage: FluidFootage) -> None:
        self.surface, self._axes = surface, axes
        index = self.index_of(surface.middles().reshape(-1, 2))
        inside = ((index >= 0) & (index <= np.array(footage.outside.shape) - 1)).all(axis=1)
        seen = (inside & (sampled(footage.outside, index) <= 0)).reshape(surface.wet.shape)
        self._trust = ndimage.gaussian_filter(seen.astype(np.float64), 1.0)

    @property
    def usable(self) -> bool:
        """Whether any place can lend its look."""
        return bool(self._trust.max(initial=0.0) > 0.5)

    def trust(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Share of the surroundings of places (X, Y in m) that may lend its look, 0 to 1."""
        return self.surface.at(self._trust, places)

    def trust_within(self, radius: float) -> Float[np.ndarray, "nx ny"]:
        """As `SeenTexture.trust_within`."""
        width = 2 * int(np.ceil(radius / self.surface.pitch)) + 1
        return ndimage.uniform_filter(self._trust, width, mode="constant") * self._trust

    def seen_at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Row and column of the picture in which points of the map are seen."""
        return self.index_of(points[:, :2])

    def index_of(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Row and column in which places (X, Y in m) are seen."""
        return self._axes.pixels(places)[:, ::-1] - 0.5
