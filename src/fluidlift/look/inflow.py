"""Appearance of fluid that flows in: the body downstream, mirrored, with all of its splats.

The clip does not show what comes in after it. The body is continued upstream by its own mirror image, which travels in
with the inflow: without a seam at the inlet, and never of one colour for long. A place where a particle is due takes
all splats of the box around its image, so that the fine ones of a surface come in as fine as they are.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from fluidlift.errors import require
from fluidlift.numerics.mirror import MirroredPoints
from fluidlift.physics.stepping import Emitted
from fluidlift.types.gaussians import Gaussians

ENDS = (0.12, 0.9)
"""shares of the body's length between which it is mirrored: its ends are often shaded by what stands there (a gate, a
lip), and that must not be fed in"""

LEVEL = 0.5
"""spacings above the surface from which a place holds no fluid: half the box of a particle"""

SHALLOW = 1.5
"""spacings below the surface to which the visible splats reach; deeper places take the one nearest to their image"""

MOST_COLUMNS = 2.0**52
"""that can be numbered in double precision"""


class InflowLook:
    """Which rest Gaussians lend their look to particles that enter at places and a time.

    Args:
        rest: the body at the first instant, world, m.
        direction: unit vector along the stream.
        speed: of the inflow, m/s.
        spacing: of the places, m.
        usable: which of `rest` may lend their look; None: all.
        run: (time s) -> s at full inflow until then; None: the time itself.
        lying: whether the body lies on a bed: places follow the level of its surface, and those above it stay empty.

    Raises:
        ValueError: no Gaussians, or a spacing that is not positive.
    """

    def __init__(
        self,
        rest: Gaussians,
        direction: Float[np.ndarray, "3"],
        speed: float,
        spacing: float,
        *,
        usable: Bool[np.ndarray, " n"] | None = None,
        run: Callable[[float], float] | None = None,
        lying: bool = False,
    ) -> None:
        require(len(rest) > 0, "a body without Gaussians", "one or more")
        self._index = np.arange(len(rest)) if usable is None or not usable.any() else np.flatnonzero(usable)
        self._speed, self._spacing, self._run = speed, spacing, run or (lambda time: time)
        self._level = surface_level(rest.means, spacing) if lying else None
        self._pattern = MirroredPoints(rest.means[self._index], direction, spacing, self._level, ENDS)

    def __call__(self, places: Float[np.ndarray, "n 3"], time: float) -> Emitted:
        """What enters at places (m) and a time (s)."""
        places, run = np.asarray(places, np.float64), self._speed * self._run(time)
        depth = np.full(len(places), np.inf) if self._level is None else self._level(places[:, :2]) - places[:, 2]
        due = np.flatnonzero(depth >= -LEVEL * self._spacing)
        boxed = due if self._level is None else due[depth[due] < SHALLOW * self._spacing]
        found = self._pattern.around(places[boxed], run)
        several = np.bincount(found.place, minlength=len(boxed))[found.place] > 1
        shared = boxed[found.place[several]]
        alone = np.setdiff1d(due, shared)
        return Emitted(
            np.concatenate([alone, shared]),
            np.concatenate([np.zeros((len(alone), 3)), found.offset[several]]).astype(np.float32),
            self._index[np.concatenate([self._pattern.nearest(places[alone], run), found.point[several]])],
        )


def surface_level(means: Float[np.ndarray, "n 3"], spacing: float) -> Callable[[np.ndarray], np.ndarray]:
    """(x, y [n,2]) -> z [n] of the highest of some points (m) in columns of a width (m); the nearest column's beside
    them."""
    means = np.asarray(means, np.float64)
    cell, of = columns_of(means, spacing)
    top = np.full(len(cell), -np.inf)
    np.maximum.at(top, of, means[:, 2])
    columns = cKDTree((cell + 0.5) * spacing)
    return lambda xy: top[columns.query(xy)[1].reshape(-1)]


def columns_of(
    points: Float[np.ndarray, "n 2+d"], spacing: float
) -> tuple[Float[np.ndarray, "m 2"], Int[np.ndarray, " n"]]:
    """Columns of a width (m) that hold points, in cells, by x and then y; and which of them each point lies in. What
    `np.unique` says of rows, in a sixth of the time: whole numbers are sorted faster than rows."""
    cell = np.floor(np.asarray(points, np.float64)[:, :2] / spacing)
    low, extent = (cell.min(axis=0), np.ptp(cell, axis=0) + 1.0) if len(cell) else (np.zeros(2), np.full(2, np.inf))
    if not (np.isfinite(extent).all() and extent.prod() < MOST_COLUMNS):  # numbers of columns would not be exact
        found, of = np.unique(cell, axis=0, return_inverse=True)
        return found, of.reshape(-1)
    number = ((cell[:, 0] - low[0]) * extent[1] + (cell[:, 1] - low[1])).astype(np.int64)
    there, of = np.unique(number, return_inverse=True)
    return np.stack([there // int(extent[1]), there % int(extent[1])], axis=1) + low, of.reshape(-1)
