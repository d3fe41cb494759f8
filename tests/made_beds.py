"""A made clear stream, its opaque twin, and the ground under them, which tests of seen beds share."""

from __future__ import annotations

from functools import cache

import numpy as np

from fluidlift.shape.ground_mesh import ground_mesh
from fluidlift.shape.seen_bed import StillLayer, still_layer
from fluidlift.synthetic.clear_stream import CAMERAS, ClearStream, FilmedBed, film_of_bed
from fluidlift.types import Grid, PinholeCamera, TriangleMesh

GRID = Grid((40, 44, 16), 0.1, (-2.0, -2.2, -1.0))


@cache
def filmed(view: str, seed: int = 1, frames: int = 24, **scene) -> tuple[ClearStream, FilmedBed]:
    """A scene and its film."""
    made = ClearStream.make(seed, **scene)
    return made, film_of_bed(made, CAMERAS[view], frames, seed=seed)


def seen_in(film: FilmedBed, camera: PinholeCamera) -> StillLayer | None:
    """With the true flow, as if all of it were trusted."""
    rays = camera.rays(camera.pixel_grid())
    upright = np.abs(rays[..., 2]) / np.linalg.norm(rays, axis=-1)
    masks = np.repeat(film.water[None], len(film.frames), axis=0)
    return still_layer(film.frames, masks, film.flow, film.water.astype(float), upright)


def ground_of(scene: ClearStream) -> TriangleMesh:
    """Its block."""
    x, y = (GRID.low[a] + GRID.spacing * np.arange(GRID.shape[a] + 1) for a in (0, 1))
    return ground_mesh(GRID, scene.height(np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)))
