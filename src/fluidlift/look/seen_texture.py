"""What the surface of a body at rest looks like to the camera that saw it, by place in plan."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import cKDTree

from fluidlift.errors import require
from fluidlift.look.appearance import SteadyShading
from fluidlift.look.rasterize import render
from fluidlift.look.surface_map import SurfaceMap, sampled
from fluidlift.types import Gaussians, PinholeCamera

OPAQUE = 0.8
"""coverage of a pixel that shows the body alone"""

INSET = 2.0
"""px at the picture's edge that are left out: splats end there"""

BEHIND = 4.0
"""columns of the map by which a place may be behind what its pixel shows"""


class TrustedMap:
    """A map of a surface whose places may lend their look, more or less.

    Args:
        surface: the map.
        seen: which of its columns were seen as what they are.
    """

    shift: Float[np.ndarray, "h w 2"] | None = None
    """px by which the splats that wear this look appear from their centres (`apparent_shift`); None: not at all"""

    def __init__(self, surface: SurfaceMap, seen: Bool[np.ndarray, "nx ny"]) -> None:
        self.surface, self._trust = surface, ndimage.gaussian_filter(seen.astype(np.float64), 1.0)

    @property
    def usable(self) -> bool:
        """Whether any place can lend its look."""
        return bool(self._trust.max(initial=0.0) > 0.5)

    def appearing(self, index: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Row and column where splats appear that have their centres at others."""
        return index if self.shift is None else index + sampled(self.shift, index)

    def trust(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Share of the surroundings of places (x, y in m) that was seen and may lend its look, 0 to 1."""
        return self.surface.at(self._trust, places)

    def trust_within(self, radius: float) -> Float[np.ndarray, "nx ny"]:
        """Share of a square of twice a radius (m) around each column, and of the column itself, that may lend it."""
        width = 2 * int(np.ceil(radius / self.surface.pitch)) + 1
        return ndimage.uniform_filter(self._trust, width, mode="constant") * self._trust


class SeenTexture(TrustedMap):
    """The picture of the body, looked up through the camera.

    The picture is drawn from the splats, at the clip's size: what is not at hand with an asset is not needed.

    Args:
        body: splats at rest, world, m.
        camera: that saw them.
        surface: of the body at rest.
        shading: what of the look stays in place; None: nothing.
        usable: which of the splats may lend their look.
        plane: pixels that show the fluid, where its surface is a plane, which hides no part of itself: from flat above,
            splats on it seem to, by metres. All that is seen there may lend its look, whatever else is said.

    Raises:
        ValueError: no splats.
    """

    def __init__(
        self,
        body: Gaussians,
        camera: PinholeCamera,
        surface: SurfaceMap,
        *,
        shading: SteadyShading | None = None,
        usable: Bool[np.ndarray, " n"] | None = None,
        plane: Bool[np.ndarray, "h w"] | None = None,
    ) -> None:
        require(len(body) > 0, "a body without Gaussians", "one or more")
        self._camera, self._shading = camera, shading
        drawn = render(body, camera, background=np.zeros((camera.size[1], camera.size[0], 3), np.float32))
        have = drawn.alpha > OPAQUE
        straight = np.clip(drawn.image / np.maximum(drawn.alpha, 1e-3)[..., None], 0.0, 1.0)
        if have.any():
            nearest = ndimage.distance_transform_edt(~have, return_distances=False, return_indices=True)
            straight = straight[tuple(nearest)]
        self._picture = straight.astype(np.float32)
        places = surface.middles()
        points = np.concatenate([places, surface.height[..., None]], axis=-1).reshape(-1, 3)
        uv, depth = camera.project(points)
        width, height = camera.size
        row, col, _ = camera.nearest_pixels(points)
        inside = (depth > 0) & (uv > INSET).all(axis=1) & (uv < np.array([width, height]) - INSET).all(axis=1)
        seen = inside & have[row, col] & (depth - drawn.depth[row, col] < BEHIND * surface.pitch)
        if shading is not None and shading.fixed is not None:
            seen &= ~shading.fixed[row, col]
        if usable is not None:
            seen &= usable[cKDTree(body.means[:, :2]).query(places.reshape(-1, 2))[1]]
        if plane is not None:
            seen = inside & plane[row, col]
        super().__init__(surface, ndimage.binary_closing(seen.reshape(surface.wet.shape)) & surface.wet)

    def seen_at(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
        """Row and column of the picture in which splats at points (m) are seen, whatever is before them."""
        return self.appearing(self._camera.project(points)[0][:, ::-1] - 0.5)

    def index_of(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Row and column in which places (x, y in m) of the surface at rest were seen."""
        return self.seen_at(np.concatenate([places, self.surface.at(self.surface.height, places)[:, None]], axis=1))

    def colors(self, places: Float[np.ndarray, "n 2"]) -> tuple[np.ndarray, np.ndarray]:
        """sRGB [n,3] seen at places (x, y in m), and the steady shade [n,3] there; ones where there is none."""
        index = self.index_of(places)
        color = sampled(self._picture, index)
        return color, np.ones_like(color) if self._shading is None else sampled(self._shading.image, index)

    def shade(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The steady shade where points (m) are seen now; ones where there is none."""
        return np.ones((len(points), 3), np.float32) if self._shading is None else self._shading.at(points)
