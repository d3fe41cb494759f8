"""The look of fluid that was drawn out further than its splats can show.

A splat that is sheared becomes a needle, and starts again round (`physics.deform`). What it stood for is a filament by
then, folded between those of other colours, finer than the splats. Round splats that keep their colours show that as
grain and as dotted lines. Their mean is what such a mixture looks like.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.numerics.nearest import nearest_of_crowd
from fluidlift.numerics.sharing import shared
from fluidlift.numerics.short_axis import every, most
from fluidlift.types.gaussians import Gaussians
from fluidlift.types.rows import rows

RESOLVED = (2.0, 3.0)
"""a splat stretched by the first keeps its colour; by the second, where it is made round, it shows the mean"""

NEIGHBOURS = 12
"""splats that share a colour: those of two shells of a lattice"""

SIXTH = 7
"""place in the list of the nearest of the neighbour that says whether a splat stands alone; the first is itself"""

CROWD = 2.4
"""widths of a splat of the inside within which it has `NEIGHBOURS` neighbours, as a rule: of the particles of a stream,
eight to a cell and 0.42 cells wide, 99.5 in 100 do, and the search is fastest"""

APART = (3.0, 4.0)
"""distance to the sixth neighbour, in largest standard deviations, from which a splat is taken to stand alone: a sheet
of splats at its pixels has 2.6"""


def mixed_share(deformation: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, " n"]:
    """How far the colour of a particle is that of its surroundings, 0 to 1, from its deformation F (no unit).

    The measure is the root mean square stretch |F| / sqrt(3): 1 at rest, and what a pure shear with the limits of
    `RESOLVED` as its longest axis gives (s, 1, 1/s).
    """
    rms = np.sqrt((np.asarray(deformation, np.float64) ** 2).sum(axis=(1, 2)) / 3)
    low, high = (np.sqrt((s * s + 1 + 1 / (s * s)) / 3) for s in RESOLVED)
    return np.clip((np.nan_to_num(rms, nan=low) - low) / (high - low), 0.0, 1.0)


def mixed(
    shown: Gaussians,
    deformation: Float[np.ndarray, "n 3 3"],
    *,
    widest: float,
    seen: Bool[np.ndarray, " n"] | None = None,
) -> Gaussians:
    """Splats that were drawn out show the mean of the colours around them, and close up with their neighbours.

    Weights fall to zero at the last of the neighbours, so that colours change smoothly while neighbours come and go.
    A splat that does not reach its neighbours (drawn out, or small and set into the coarse rows of an inlet) grows to
    half the distance to the sixth of them, at which round splats in a regular lattice leave no gaps.

    Args:
        shown: the splats now, m.
        deformation: F of each of them.
        widest: standard deviation to which they may grow, m: that of a splat of the inside.
        seen: those that anybody sees: the others stay as they are. None: all.

    Raises:
        ValueError: another number of deformations than of splats, or `widest` not positive.
    """
    require(len(shown) == len(deformation), f"{len(deformation)} deformations", f"{len(shown)}, one per splat")
    require(widest > 0, f"widest {widest}", "positive metres")
    sound = every(np.isfinite(shown.means))
    share, size = mixed_share(deformation), most(shown.scales)
    at = sound & ((share > 0) | (size < 0.5 * widest))
    at = np.flatnonzero(at if seen is None else at & seen)
    if len(at) == 0 or sound.sum() <= NEIGHBOURS:
        return shown
    around = np.flatnonzero(sound)
    points, share, sh, grown = rows(shown.means, around), share[at], shown.sh.copy(), shown.scales.copy()
    reach = CROWD * widest
    blended, sixth = np.flatnonzero(share > 0), np.empty(len(at))
    if len(blended):
        distance, near = nearest_of_crowd(points, rows(shown.means, at[blended]), NEIGHBOURS + 1, reach)
        one, mean = at[blended], np.empty((len(blended), 3), np.float64)
        _mean_around(distance, around[near], shown.sh[:, 0], mean)
        sh[one, 0] += share[blended, None] * (mean - shown.sh[one, 0])
        sixth[blended] = distance[:, SIXTH - 1]
    kept = np.flatnonzero(share <= 0)
    if len(kept):  # they may grow and keep their colour: one distance is enough
        sixth[kept] = nearest_of_crowd(points, rows(shown.means, at[kept]), SIXTH, reach)[0][:, -1]
    gap = sixth / np.maximum(size[at], 1e-12)
    alone = np.clip((gap - APART[0]) / (APART[1] - APART[0]), 0.0, 1.0)
    least = np.maximum(share, alone) * np.minimum(0.5 * sixth, widest)
    grown[at] = np.maximum(rows(shown.scales, at), least[:, None])
    return Gaussians(shown.means, shown.quats, grown, shown.opacities, sh)


@shared(lambda distance, *_: (0, len(distance)))
def _mean_around(begin, end, distance, near, colors, mean):
    """Means of the colours of neighbours, the nearest first, with weights that are zero at the last."""
    for p in range(begin, end):
        last = max(distance[p, -1], 1e-12)
        total = red = green = blue = 0.0
        for k in range(distance.shape[1]):
            away = distance[p, k] / last
            weight = (1.0 - away * away) ** 2 + 1e-9
            c = near[p, k]
            total += weight
            red += weight * colors[c, 0]
            green += weight * colors[c, 1]
            blue += weight * colors[c, 2]
        mean[p, 0], mean[p, 1], mean[p, 2] = red / total, green / total, blue / total
