"""The axes over which the surface of a liquid is a map: the plan for what lies, the picture for what falls or stands.

A curtain, a jet or a column has no one height at each place of the plan. Seen from the clip's camera it has one depth
at each place of the picture, so a map over the picture takes in its whole seen side, and all that floats on a surface
(`look.surface_skin`, `look.texture_patches`) floats there as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.numerics.short_axis import every
from fluidlift.types import Gaussians, PinholeCamera, RigidTransform, Similarity3

BESIDE = 0.1
"""of the picture's width and height: how far beside it a map over it goes on"""


class PlanAxes:
    """The world's own: x, y and height."""

    def points(self, world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """World points on the map's axes, m."""
        return world

    def shown(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points of the map's axes belong on the map."""
        return np.ones(len(points), bool)

    def velocities(self, world: Float[np.ndarray, "n 3"], moving: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Velocities (m/s) of world points on the map's axes."""
        return moving

    def world_points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Back to the world."""
        return points

    def world_velocities(
        self, points: Float[np.ndarray, "n 3"], moving: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Back to the world, of points on the map's axes."""
        return moving

    def world_splats(self, splats: Gaussians) -> Gaussians:
        """Back to the world."""
        return splats


@dataclass(frozen=True)
class PictureAxes:
    """X to the right, Y up, Z towards the camera; X and Y are those of the picture, in metres at one distance.

    X = D x / z, Y = -D y / z, Z = -z for a point (x, y, z) on the camera's axes (x right, y down, z forward).
    """

    camera: PinholeCamera
    distance: float
    """D, m: of the fluid, so that lengths on the map are about those in the world"""

    def points(self, world: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """World points on the map's axes, m. What is not before the camera goes to the rim of the map."""
        x, y, z = self.camera.camera_from_world.coordinates(world)
        near = np.maximum(z, self._nearest)
        return np.stack([self.distance * x / near, -self.distance * y / near, -z], axis=-1)

    def shown(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points of the map's axes are in the picture, or near it."""
        size = np.array(self.camera.size)
        uv = self.pixels(points)
        inside = every((uv > -BESIDE * size) & (uv < (1 + BESIDE) * size))
        return inside & (points[:, 2] < -self._nearest)

    def velocities(self, world: Float[np.ndarray, "n 3"], moving: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Velocities (m/s) of world points on the map's axes."""
        x, y, z = self.camera.camera_from_world.coordinates(world)
        u, v, w = self.camera.camera_from_world.vectors(moving).T
        near = np.maximum(z, self._nearest)
        return np.stack(
            [self.distance * (u - x / near * w) / near, -self.distance * (v - y / near * w) / near, -w], axis=-1
        )

    def world_points(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Back to the world."""
        return self.camera.unproject(self.pixels(points), -points[:, 2])

    def world_velocities(
        self, points: Float[np.ndarray, "n 3"], moving: Float[np.ndarray, "n 3"]
    ) -> Float[np.ndarray, "n 3"]:
        """Back to the world, of points on the map's axes."""
        z, w = -points[:, 2], -moving[:, 2]
        u = (moving[:, 0] * z + points[:, 0] * w) / self.distance
        v = -(moving[:, 1] * z + points[:, 1] * w) / self.distance
        return RigidTransform(self.camera.camera_from_world.rotation.T).vectors(np.stack([u, v, w], axis=-1))

    def world_splats(self, splats: Gaussians) -> Gaussians:
        """Back to the world; their sizes stay those at the distance D."""
        turn = Similarity3(1.0, self.camera.camera_from_world.rotation.T @ np.diag([1.0, -1.0, -1.0]), np.zeros(3))
        return replace(
            splats,
            means=self.world_points(splats.means).astype(np.float32),
            quats=turn.quats(splats.quats).astype(np.float32),
        )

    def pixels(self, points: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n 2"]:
        """u, v of the picture at X, Y of the map, px."""
        scale = np.array([self.camera.focal[0], -self.camera.focal[1]]) / self.distance
        return points[:, :2] * scale + np.array(self.camera.center)

    @property
    def _nearest(self) -> float:
        """m before the camera: what is nearer is not in the picture"""
        return 0.01 * self.distance


SurfaceAxes = PlanAxes | PictureAxes
