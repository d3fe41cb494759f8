"""Where the foam that a clip shows is born: its mean map in the picture, put on the water and followed upstream.

What breaks a stream in its clip (stones under the surface, drops of the bed by a hand's breadth) is not in the lifted
terrain, so the potentials of the simulated flow do not know the place. The film does. In a steady flow v, foam whose
mean number per area is N and whose life is t comes from births

    S = v . grad N + N / t

so that a simulation with these births shows N. Where S is below 0, foam breaks up before its age: there -S / N of it
ends per second. *Assumption:* mean flow and mean map are steady over the clip. *Limit:* columns that the camera does
not see have none; foam that hangs at a bank is taken to be born there.

N follows from the share of a pixel's time that is foam, -ln(1 - share) particles to the area that one hides: in the
picture. A particle is a ball and hides as much from any side, but level water that is looked at along itself is narrow
there: what covers it from above would cover it three times from 20 degrees (`seen_area`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from fluidlift.look.whitewater_splats import FilmedFoam
from fluidlift.types import Grid, PinholeCamera

MOST_COVERED = 0.95
"""share of a column that foam covers at most: to hide all of it would take any number of splats"""
LEAST_SEEN = 0.1
"""of a column's area that is seen at least: at a slant of under 6 degrees waves hide most of it"""
STEADY = 2.0
"""cells over which heights are smoothed before their slope is taken"""
SMOOTH = 1.0
"""cells over which the number is smoothed before its slope is taken: two neighbours differ by chance"""


class FoamInColumns(NamedTuple):
    """What a film's foam is in columns of a grid."""

    balance: Float[np.ndarray, "nx ny"]
    """1/s, by which a steady flow carries as much as the film shows; below 0 more has to go than ends by its age"""
    number: Float[np.ndarray, "nx ny"]
    """of particles that cover as much as the film shows, were none fading"""

    @property
    def births(self) -> Float[np.ndarray, "nx ny"]:
        """1/s, of a flow in which foam ends by its age alone."""
        return np.maximum(self.balance, 0.0)


def births_in_columns(
    foam: FilmedFoam,
    camera: PinholeCamera,
    grid: Grid,
    height: Float[np.ndarray, "nx ny"],
    velocity: Float[np.ndarray, "nx ny 2"],
    lasting: Float[np.ndarray, "nx ny"],
    covers: float,
) -> FoamInColumns:
    """Foam in each column, and the births per second by which a steady flow carries as much as a film shows.

    Args:
        foam: of the film.
        camera: of the film, at any size.
        grid: whose columns are asked for.
        height: m, of the surface in the middle of each column; not a number where there is none.
        velocity: m/s, of the surface.
        lasting: s for which foam born there would cover as much without fading.
        covers: cells^2 that one particle hides.
    """
    share = share_in_columns(foam, camera, grid, height)
    known = np.isfinite(share)
    # a splat is a ball, as large from any side; the column behind it is seen at a slant
    room = seen_area(camera, grid, height)
    number = -np.log1p(-np.clip(np.nan_to_num(share), 0.0, MOST_COVERED)) * room / covers
    # over the columns that are known: beside the picture there is not nothing, but what nobody saw
    number = _smoothed(number, known, SMOOTH)
    slope = np.stack([*np.gradient(number, grid.spacing)], axis=-1) if min(grid.shape[:2]) > 1 else 0.0 * velocity
    made = np.einsum("...i,...i->...", velocity, slope) + number / lasting
    return FoamInColumns(np.where(known, made, 0.0), np.where(known, number, 0.0))


def seen_area(camera: PinholeCamera, grid: Grid, height: Float[np.ndarray, "nx ny"]) -> Float[np.ndarray, "nx ny"]:
    """Area (cells^2) of the surface of each column as the camera sees it.

    Less than 1 where that is level, and seen at a slant; a fall's curtain has more.
    """
    wet = np.isfinite(height)
    # a wave's own slope comes and goes
    even = _smoothed(np.nan_to_num(height), wet, STEADY)
    slope = [np.where(wet, d, 0.0) for d in np.gradient(even, grid.spacing)] if min(even.shape) > 1 else [0.0, 0.0]
    inner = ndimage.binary_erosion(wet, np.ones((3, 3), np.uint8))  # beside it there is no height to slope towards
    normal = np.stack([*(np.where(inner, -d, 0.0) for d in slope), np.ones(height.shape)], axis=-1)
    places = np.moveaxis(np.indices(height.shape), 0, -1) + 0.5
    at = np.concatenate([places * grid.spacing + grid.low[:2], np.nan_to_num(height)[..., None]], axis=-1)
    sight = camera.position - at
    sight /= np.maximum(np.linalg.norm(sight, axis=-1, keepdims=True), 1e-9)
    return np.clip(np.einsum("...i,...i->...", normal, sight), LEAST_SEEN, 1.0 / LEAST_SEEN)


def share_in_columns(
    foam: FilmedFoam, camera: PinholeCamera, grid: Grid, height: Float[np.ndarray, "nx ny"]
) -> Float[np.ndarray, "nx ny"]:
    """Of the time, the share in which a film shows foam at the surface of each column; not a number where it shows no
    fluid, or has the place not in the picture."""
    rows, columns = foam.places.shape
    camera, found = camera.resized((columns, rows)), np.full(height.shape, np.nan)
    wet = np.argwhere(np.isfinite(height))
    if not len(wet):
        return found
    places = np.concatenate([(wet + 0.5) * grid.spacing + grid.low[:2], height[tuple(wet.T)][:, None]], axis=1)
    uv, depth = camera.project(places)
    ahead = depth > 0
    if not ahead.any():
        return found
    width = camera.focal[0] * grid.spacing / float(np.median(depth[ahead]))  # px, of a column
    weight = np.maximum(ndimage.gaussian_filter(foam.seen, 0.5 * width), 1e-9)
    picture = ndimage.gaussian_filter(foam.places * foam.seen, 0.5 * width) / weight
    x, y = np.floor(np.where(ahead, uv.T, -1.0)).astype(np.int64)
    inside = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
    inside[inside] = foam.seen[y[inside], x[inside]] > 0.5
    found[tuple(wet[inside].T)] = picture[y[inside], x[inside]]
    return found


def _smoothed(values: np.ndarray, known: np.ndarray, width: float) -> np.ndarray:
    """A mean around each place over those that are known; 0 where none is near."""
    weight = ndimage.gaussian_filter(known.astype(float), width)
    total = ndimage.gaussian_filter(np.where(known, values, 0.0), width)
    return np.where(weight > 1e-3, total / np.maximum(weight, 1e-3), 0.0)
