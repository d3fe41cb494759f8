"""Denoises a body: takes out faint, stretched, huge, lonely and broken Gaussians (paper: before the filling)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.numerics.nearest import nearest
from fluidlift.types.gaussians import Gaussians

LARGEST = 0.25
"""standard deviation over the body's size (`body_size`): more than any piece of a body can be"""


@dataclass(frozen=True)
class PruneReport:
    """How many Gaussians went, by the first reason that applied."""

    broken: int
    """non-finite numbers, scales that are not positive, no orientation"""
    faint: int
    stretched: int
    huge: int
    isolated: int
    left: int


def prune(
    gaussians: Gaussians,
    *,
    min_opacity: float = 0.05,
    max_stretch: float = 10.0,
) -> tuple[Gaussians, PruneReport]:
    """Drop what is not a piece of the fluid: also what is larger than `LARGEST` of the body, and what is `lonely`.

    Args:
        gaussians: any Gaussians, m.
        min_opacity: fainter ones go.
        max_stretch: largest ratio of the two largest scales. Needles go, flat discs stay: surfaces are made of them.

    Returns:
        Those left, in order, and the counts.
    """
    require(max_stretch >= 1, f"max_stretch {max_stretch}", "at least 1")
    g = gaussians
    with np.errstate(all="ignore"):
        ordered = np.sort(g.scales, axis=1)
        stretch = ordered[:, 2] / ordered[:, 1]
    broken = ~_sound(g)
    faint = ~broken & ~(g.opacities >= min_opacity)
    stretched = ~broken & ~faint & ~(stretch <= max_stretch)
    rest = ~(broken | faint | stretched)
    size = body_size(g.means[rest])
    huge = rest & (ordered[:, 2] > LARGEST * size) & (size > 0)
    rest &= ~huge
    isolated = np.zeros(len(g), bool)
    isolated[rest] = lonely(g.means[rest])
    left = rest & ~isolated
    counts = (int(m.sum()) for m in (broken, faint, stretched, huge, isolated, left))
    return g.select(left), PruneReport(*counts)


def _sound(g: Gaussians) -> Bool[np.ndarray, " n"]:
    ok = np.isfinite(g.means).all(1) & np.isfinite(g.scales).all(1) & (g.scales > 0).all(1)
    ok &= np.isfinite(g.quats).all(1) & (np.abs(g.quats).max(1, initial=0.0) > 1e-12)
    return ok & np.isfinite(g.opacities) & np.isfinite(g.sh).all((1, 2))


def body_size(points: Float[np.ndarray, "n 3"]) -> float:
    """Diagonal of the box between the 2 % and 98 % quantiles, m; 0 for fewer than two points."""
    if len(points) < 2:
        return 0.0
    return float(np.linalg.norm(np.ptp(np.quantile(points, [0.02, 0.98], axis=0), axis=0)))


def lonely(points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Points with fewer than four others within three times the distance at which the points nearby hold eight.

    Some seventy should be found there. The comparison is with the nearest eight points, so that a body may thin out
    with its distance from the camera.
    """
    if len(points) < 10:
        return np.zeros(len(points), bool)
    distances, others = nearest(points, points, 9)
    usual = np.median(distances[others[:, 1:9], 8], axis=1)
    return distances[:, 4] > 3 * usual
