"""Extrapolation of a stream's surface beyond the edges of the picture: the seen one goes on as in a mirror.

What the camera does not see is part of the body all the same, and some of it flows into the picture a moment later. The
colours of the nearest pixels would come in as smears.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.numerics.mirror import MirroredPoints
from fluidlift.physics.inlet import clear_of_shore
from fluidlift.shape.generate import body_cells
from fluidlift.types import Gaussians, PinholeCamera, Setting

HIDDEN = 0.5
"""cells below the surface to which splats of the hull would show through finer ones above them"""


def continued(
    front: Gaussians, hull: Gaussians, setting: Setting, camera: PinholeCamera
) -> tuple[Gaussians, Gaussians]:
    """Copies of the seen splats on the surface that the picture does not show, and the hull without what they cover.

    Args:
        front: splats of the visible surface, world, m.
        hull: of the sides that the camera does not see.
        setting: fluid and ground; bodies in the air (without a height of the surface) stay as they are.
        camera: of the picture, in the world.
    """
    if setting.surface_height is None:
        return Gaussians.empty(), hull
    grid = setting.terrain.grid
    level = _SurfaceHeight(setting)
    pattern = np.flatnonzero(
        in_picture(front.means, camera) & clear_of_shore(front.means, level(front.means[:, :2]), setting.terrain)
    )
    places = _unseen_places(setting, camera)
    if len(pattern) == 0 or len(places) == 0:
        return Gaussians.empty(), hull
    spacing = 0.5 * grid.spacing
    mirrored = MirroredPoints(front.means[pattern], setting.terrain.mainstream, spacing, level)
    found = mirrored.around(places)
    copies = front.select(pattern[found.point])
    copies = Gaussians(
        (places[found.place] + found.offset).astype(np.float32),
        copies.quats,
        copies.scales,
        copies.opacities,
        copies.sh,
    )
    covered = np.zeros((2 * grid.shape[0], 2 * grid.shape[1]), bool)
    covered[_half_cells(places[found.place], setting)] = True
    below = level(hull.means[:, :2]) - hull.means[:, 2]
    return copies, hull.select(~covered[_half_cells(hull.means, setting)] | (below > HIDDEN * grid.spacing))


def in_picture(points: Float[np.ndarray, "n 3"], camera: PinholeCamera) -> Bool[np.ndarray, " n"]:
    """Whether points (world, m) lie in front of the camera and within the edges of its picture."""
    uv, z = camera.project(points)
    return (z > 0) & (uv >= 0).all(axis=1) & (uv < camera.size).all(axis=1)


def _unseen_places(setting: Setting, camera: PinholeCamera) -> Float[np.ndarray, "n 3"]:
    """Middles of half cells in plan, on the surface of the body off the picture, m."""
    grid, level = setting.terrain.grid, _SurfaceHeight(setting)
    wet = body_cells(setting).any(axis=2)
    at = np.argwhere(np.kron(wet, np.ones((2, 2), bool)))
    xy = grid.low[:2] + (at + 0.5) * 0.5 * grid.spacing
    places = np.concatenate([xy, level(xy)[:, None]], axis=1)
    return places[~in_picture(places, camera)]


def _half_cells(points: np.ndarray, setting: Setting) -> tuple[np.ndarray, np.ndarray]:
    grid = setting.terrain.grid
    index = np.floor((points[:, :2] - grid.low[:2]) / (0.5 * grid.spacing)).astype(np.int64)
    return tuple(np.clip(index, 0, 2 * np.asarray(grid.shape[:2]) - 1).T)


class _SurfaceHeight:
    """(x, y [n,2]) -> z [n] of the free surface, m, between the columns of a setting."""

    def __init__(self, setting: Setting) -> None:
        from scipy.ndimage import distance_transform_edt

        grid = setting.terrain.grid
        height = np.asarray(setting.surface_height, np.float64)
        bad = ~np.isfinite(height)
        if bad.any():
            nearest = distance_transform_edt(bad, return_distances=False, return_indices=True)
            height = height[tuple(nearest)]
        self._height, self._low, self._spacing = height, grid.low[:2], grid.spacing

    def __call__(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        from scipy.ndimage import map_coordinates

        at = ((np.asarray(xy, np.float64) - self._low) / self._spacing - 0.5).T
        return map_coordinates(self._height, at, order=1, mode="nearest")
