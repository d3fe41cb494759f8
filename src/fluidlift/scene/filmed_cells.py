"""Cells in which the clip shows no fluid at any time, and those in which it shows some at all times.

A mask says more than where the fluid is: whatever stands seen above dry ground, or before it, would have been filmed.
Water that gets there in a simulation has left what was filmed (over a bank that is lower than the true one, or past
what stands before it), and is taken out as at an outlet. What is hidden, beside the picture or within a cell of the
filmed fluid is left alone. What comes much nearer to the camera than the fluid at rest is dry wherever it is seen: it
would stand before the whole picture.

Where fluid is seen in nearly every frame, none may go missing: what runs dry there is filled again (`physics.refill`).
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.types import CellType, FluidKind, Grid, PinholeCamera, Terrain
from fluidlift.types.fluid_masks import STAYS, FluidMasks, outline_grows, share_that_stays

MARGIN = 1.0
"""cells from the filmed fluid, as the camera sees them: a simulated rim lies somewhere in a cell"""
NEARER = 0.5
"""of the depth of the nearest fluid at rest: what comes nearer looks twice as large as anything that was filmed"""
STEP = 0.5
"""cells between two looks for ground on the way to the camera"""


def filmed_shares(
    kind: FluidKind, masks: FluidMasks, left: float, *, held: bool
) -> tuple[Float[np.ndarray, "h w"] | None, float]:  # fmt: skip
    """Share of a clip's frames in which each pixel is fluid, and for how long (s) what is dry in all of them stays so.

    The outline of what lies on ground, falls steadily or sways about stays as it was filmed. One that grows, as that
    of a vessel which fills, goes on to do so after its clip, unless it is of a pour in whose scene no vessel was found
    to take it: there it would run over the table. Nothing (None) is said of what collapses: no inlet would make up for
    fluid that was taken out.

    Args:
        kind: of the fluid.
        masks: of the clip.
        left: s of the clip from the body at rest on.
        held: whether there is a vessel that holds it.
    """
    if kind.lies_on_ground:
        return masks.shares(), math.inf
    if kind.starts_at_rest and share_that_stays(masks) <= STAYS:
        return None, math.inf
    goes_on = (held or not kind.fills_vessel) and outline_grows(masks)
    return masks.shares(), left if goes_on else math.inf


def dry_cells(
    terrain: Terrain, camera: PinholeCamera, wet: Bool[np.ndarray, "h w"], cell_types: np.ndarray
) -> Bool[np.ndarray, "nx ny nz"]:
    """Cells that the clip shows dry throughout; those of inlets and of the fluid at rest may be among them, where the
    surface that was laid through the picture goes beyond what is seen in it.

    Args:
        terrain: solid ground.
        camera: of the clip.
        wet: pixels that are fluid in at least one frame.
        cell_types: u8 [nx,ny,nz]; solid cells are not looked at.
    """
    grid = terrain.grid
    require(wet.shape == camera.size[::-1], f"a mask {wet.shape}", f"{camera.size[::-1]}")
    dry = np.zeros(grid.shape, bool)
    if not wet.any():
        return dry
    cells = np.argwhere(cell_types != CellType.SOLID)
    centres = grid.low + (cells + 0.5) * grid.spacing
    uv, depth = camera.project(centres)
    seen = (depth > 0) & ((uv >= 0) & (uv < np.array(camera.size))).all(axis=1)
    fluid = seen & np.isin(cell_types[tuple(cells.T)], (CellType.FLUID, CellType.INFLOW))
    if fluid.any():
        near = seen & (depth < NEARER * np.percentile(depth[fluid], 1.0))
        dry[tuple(cells[near].T)] = True
    if wet.all():
        return dry
    column, row = np.where(seen, uv.T, 0.0).astype(int)
    away = np.asarray(ndimage.distance_transform_edt(~wet))[row, column] * depth / camera.focal[0]
    beside = np.flatnonzero(seen & (away > MARGIN * grid.spacing))
    open_view = ~_hidden(terrain, centres[beside], camera.position)
    dry[tuple(cells[beside[open_view]].T)] = True
    return dry


def wet_cells(
    grid: Grid, camera: PinholeCamera, share: Float[np.ndarray, "h w"], body: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, "nx ny nz"]:
    """Cells of the fluid at rest that the clip shows wet throughout.

    Args:
        grid: of the cells.
        camera: of the clip.
        share: of the clip's frames in which each pixel is fluid.
        body: the particles at rest, m.
    """
    require(share.shape == camera.size[::-1], f"shares {share.shape}", f"{camera.size[::-1]}")
    wet = np.zeros(grid.shape, bool)
    cells = np.unique(np.clip(grid.cell_of(body), 0, np.asarray(grid.shape) - 1), axis=0)
    uv, depth = camera.project(grid.low + (cells + 0.5) * grid.spacing)
    seen = (depth > 0) & ((uv >= 0) & (uv < np.array(camera.size))).all(axis=1)
    column, row = np.where(seen, uv.T, 0.0).astype(int)
    wet[tuple(cells[seen & (share[row, column] >= STAYS)].T)] = True
    return wet


def _hidden(terrain: Terrain, points: np.ndarray, eye: np.ndarray) -> Bool[np.ndarray, " n"]:
    """Whether ground lies between points (m) and the camera; points within the ground are."""
    grid = terrain.grid
    to_eye = eye - points
    reach = np.linalg.norm(to_eye, axis=1, keepdims=True)
    step = STEP * grid.spacing * to_eye / np.maximum(reach, 1e-12)
    hidden, at = np.zeros(len(points), bool), points.copy()
    left = np.flatnonzero(reach[:, 0] > 0)
    while len(left):
        left = left[grid.contains(at[left])]
        ground = sample_nodes(terrain.signed_distance, grid, at[left]) < 0
        hidden[left[ground]] = True
        left = left[~ground]
        at[left] += step[left]
    return hidden
