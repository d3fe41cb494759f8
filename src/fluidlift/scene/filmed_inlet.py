"""Where an inlet stood in each frame of a clip: what pours out of a jug comes from where a hand holds that.

The upper end of a jet is looked for in the masks of all frames, as it looks in that of the body at rest. Where it goes
is a shift in the picture, and at the depth of the inlet a way in the world: nearer or farther it does not show. The
simulation moves its inlet along that as the film plays, cell by cell; what has left it falls on from where it left.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from fluidlift.physics.inflow_schedule import InletPath
from fluidlift.scene.surface_film import LATER, first_end
from fluidlift.types import CellType, Grid, PinholeCamera, kind_of

if TYPE_CHECKING:
    from fluidlift.scene.build import Scene

FARTHEST = 0.15
"""of the picture's longer side that an inlet is looked for from where it was at rest (a choice)"""
FASTEST = 0.02
"""of that side that it goes in a frame at most: at 25 frames a second, half of it in a second (a choice)"""
ALIKE = 0.3
"""intersection over union of a jet's end with that at rest, below which it is not known where it stands: of a jet of
coffee that was followed by eye it is 0.33 to 0.76 within a second"""
AS_GOOD = 0.02
"""of overlap, within which two shifts are as good: along a jet it looks the same, and the smaller counts (a choice)"""
SHAKES = 5
"""frames over which its place is the median: outlines come and go by a pixel or two"""
STICKS = 0.75
"""cells from where it stands that it goes before it moves: at half a cell it would go to and fro with every pixel"""


def inlet_offsets(
    cell_types: np.ndarray, grid: Grid, camera: PinholeCamera, masks: Bool[np.ndarray, "t h w"], rest: int
) -> Float[np.ndarray, "t 3"] | None:
    """m that the inlet stands beside its place at rest, in every frame; None where it stays within a cell, there are
    several, or the picture does not show it.

    Args:
        cell_types: u8 [nx,ny,nz].
        grid: of them.
        camera: of the clip.
        masks: where fluid was filmed.
        rest: frame that the cells show.
    """
    inlet = cell_types == CellType.INFLOW
    beside = np.ones((3, 3, 3), bool)
    if ndimage.label(ndimage.binary_dilation(inlet, beside), beside)[1] != 1:
        return None
    uv, depth = camera.project(grid.low + (np.argwhere(inlet) + 0.5) * grid.spacing)
    away = float(np.median(depth))
    if away <= 0:
        return None
    across = grid.spacing * camera.focal[0] / away
    low, high = uv.min(axis=0) - 0.5 * across, uv.max(axis=0) + 0.5 * across
    shifts = _shifts(masks, rest, low, high)
    if shifts is None:
        return None
    middle = 0.5 * (low + high)
    offsets = camera.unproject(middle + shifts, np.full(len(shifts), away)) - camera.unproject(middle[None], away)
    return offsets if np.linalg.norm(offsets, axis=1).max() > grid.spacing else None


def _shifts(
    masks: Bool[np.ndarray, "t h w"], rest: int, low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "t 2"] | None:
    """Px that what is seen in a box of the picture (u, v) has gone from where it is in frame `rest`; None where that
    shows nothing, or too little of it is found again."""
    h, w = masks.shape[1:]
    beside = 0.5 * float(max(high - low))
    first = np.clip(np.floor(low - beside), 0, (w, h)).astype(int)
    last = np.clip(np.ceil(high + beside), 0, (w, h)).astype(int)
    shown = np.asarray(masks[rest][first[1] : last[1], first[0] : last[0]], np.float32)
    if not shown.size or not 0.0 < shown.mean() < 1.0:
        return None
    longest = max(h, w)
    reach, pace = max(int(FARTHEST * longest), 1), max(FASTEST * longest, 2.0)
    ones, places = np.ones_like(shown), np.arange(-reach, reach + 1)
    far = np.hypot(places[:, None], places[None, :])
    found = np.full((len(masks), 2), np.nan)
    for way in (range(rest, len(masks)), range(rest, -1, -1)):
        last_seen = np.zeros(2)
        for t in way:
            # what hangs from the picture's edge goes on beyond it
            wide = np.pad(masks[t].astype(np.float32), reach, mode="edge")
            part = wide[first[1] : last[1] + 2 * reach, first[0] : last[0] + 2 * reach]
            both, there = (cv2.matchTemplate(part, image, cv2.TM_CCORR) for image in (shown, ones))
            gone = np.hypot(places[:, None] - last_seen[1], places[None, :] - last_seen[0])
            overlap = np.where(gone <= pace, both / np.maximum(there + shown.sum() - both, 1.0), 0.0)
            best = float(overlap.max())
            if best >= ALIKE:
                row, column = np.unravel_index(
                    int(np.where(overlap >= best - AS_GOOD, far, np.inf).argmin()), far.shape
                )
                found[t] = last_seen = np.array([places[column], places[row]], float)
    known = np.flatnonzero(np.isfinite(found[:, 0]))
    if len(known) < 0.5 * len(found):
        return None
    every = np.arange(len(found))
    filled = np.stack([np.interp(every, known, found[known, k]) for k in range(2)], axis=-1)
    steady = ndimage.median_filter(filled, (SHAKES, 1), mode="nearest")
    return steady - steady[rest]


def inlet_path(scene: Scene) -> InletPath | None:
    """The way of the inlet through a simulation, with the film that its fluid plays; None where it stays."""
    from fluidlift.look.texture_patches import instants_together

    if scene.inlet is None or scene.edited or not kind_of(scene.kind).fills_vessel:
        return None
    frames, again = len(scene.inlet), 0.0
    if scene.dry is not None and math.isfinite(scene.dry_for):  # as `SurfaceAppearance` has it
        again = LATER * frames
    pace = scene.interval / scene.clip_interval
    instants = instants_together(
        frames, start=scene.film_start, again=again, pace=pace, count=scene.simulated, first_end=first_end(scene)
    )
    cells = _stepped(scene.inlet[np.rint(instants).astype(int)] / scene.terrain.grid.spacing)
    moved = np.flatnonzero(np.r_[True, (np.diff(cells, axis=0) != 0).any(axis=1)])
    return InletPath(scene.interval * moved, cells[moved])


def _stepped(way: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "n 3"]:
    """Whole cells for a way in cells, each kept until the way is `STICKS` from it."""
    cells, at = np.zeros(way.shape, np.int64), np.zeros(3, np.int64)
    for k, place in enumerate(way):
        at = np.where(np.abs(place - at) > STICKS, np.rint(place).astype(np.int64), at)
        cells[k] = at
    return cells
