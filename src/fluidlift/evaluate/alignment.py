"""How well a body fits the truth once it may be moved, turned and scaled as a whole: its shape, whatever the lens and
the tilt of the camera were taken for."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from fluidlift.evaluate.case import Case
from fluidlift.evaluate.report import Metric, figure
from fluidlift.evaluate.space import Alignment
from fluidlift.evaluate.volumes import behind, in_picture, lookup, occupancy_iou
from fluidlift.types import CellType, FluidAsset, Similarity3

STEPS = 300
"""trials of the simplex: seven unknowns settle within some 200"""
MANY = 20_000
"""cells of the truth above which the way is found on every second one along each axis"""
FIRST = (0.08, 0.08, 0.08, 0.05, 0.05, 0.05, 0.05)
"""first moves of the simplex: radians about three axes, logarithm of the scale, and shares of the body's size"""


def score_aligned(asset: FluidAsset, case: Case, alignment: Alignment) -> list[Metric]:
    """Occupancy IoU after the similarity that makes it largest, found from two starts: the eyes on each other, and the
    middles and sizes of both bodies on each other. The same cells count as in `score_volume`."""
    fluid = np.isin(asset.cell_types, (CellType.FLUID, CellType.INFLOW))
    cells = asset.grid.centers()[fluid]
    cells = cells[in_picture(cells, asset.camera)]
    centers, truth, counted = _counted(case, alignment.key)
    if not (truth & counted).any() or len(cells) == 0:
        return [figure("geometry.occupancy_iou_aligned", None, "", "one of the bodies is not in the picture")]
    sink = asset.cell_types == CellType.OUTFLOW

    def overlap(to_truth: Similarity3, some: slice | np.ndarray) -> float:
        at = to_truth.inverse().points(centers[some])
        mine, gone = (lookup(mask, asset.grid, at, outside=False) for mask in (fluid, sink))
        placed = to_truth.points(cells)
        stray = float((in_picture(placed, case.camera) & ~case.grid.contains(placed)).sum())
        stray *= (to_truth.scale * asset.grid.spacing / case.grid.spacing) ** 3 * len(at) / len(centers)
        return occupancy_iou(mine, truth[some], ~counted[some] | gone, stray) or 0.0

    index = np.stack(np.unravel_index(np.arange(len(centers)), case.grid.shape))
    coarse = np.flatnonzero((index % 2 == 0).all(axis=0)) if len(centers) > MANY else slice(None)
    starts = (alignment.truth_from_asset, _laid_on(alignment.truth_from_asset, cells, centers[truth & counted]))
    places = [*starts, *(_climbed(start, cells, lambda t: overlap(t, coarse)) for start in starts)]
    best = max(overlap(place, slice(None)) for place in places)
    return [figure("geometry.occupancy_iou_aligned", best, "", "after the similarity that makes it largest")]


def _counted(case: Case, key: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cell centres of the truth (m), which are fluid, and which count: in the picture and not hidden."""
    centers = case.grid.centers().reshape(-1, 3)
    truth = case.occupied(key).reshape(-1)
    hidden = behind(centers, case.static_depth, case.camera, case.grid.spacing)
    return centers, truth, in_picture(centers, case.camera) & ~(truth & hidden)


def _laid_on(rough: Similarity3, cells: Float[np.ndarray, "n 3"], truth: Float[np.ndarray, "m 3"]) -> Similarity3:
    """The same axes, with the middle and the root mean square size of the truth."""
    placed = rough.points(cells)
    middle, target = placed.mean(axis=0), truth.mean(axis=0)
    factor = float(
        np.sqrt(((truth - target) ** 2).sum() / len(truth) / max(((placed - middle) ** 2).mean() * 3, 1e-24))
    )
    return Similarity3(factor * rough.scale, rough.rotation, target + factor * (rough.translation - middle))


def _climbed(start: Similarity3, cells: np.ndarray, overlap: Callable[[Similarity3], float]) -> Similarity3:
    """Where a simplex around a start finds the largest overlap."""
    placed = start.points(cells)
    middle = placed.mean(axis=0)
    size = float(np.sqrt(((placed - middle) ** 2).sum(axis=1).mean()))

    def moved(x: np.ndarray) -> Similarity3:
        turn, factor = Rotation.from_rotvec(x[:3]).as_matrix(), float(np.exp(x[3]))
        shift = factor * turn @ (start.translation - middle) + middle + size * x[4:]
        return Similarity3(factor * start.scale, turn @ start.rotation, shift)

    simplex = np.vstack([np.zeros(7), np.diag(FIRST)])
    found = minimize(
        lambda x: -overlap(moved(x)), np.zeros(7), method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": STEPS, "xatol": 1e-3, "fatol": 1e-4},
    )  # fmt: skip
    return moved(found.x)
