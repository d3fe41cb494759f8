"""The pinhole camera: OpenCV axes (x right, y down, z forward), pixel centres at +0.5, no distortion."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from fluidlift.errors import InputRejected, require
from fluidlift.types.transforms import RigidTransform, in_rows, turned


@dataclass(frozen=True)
class PinholeCamera:
    """u = fx x/z + cx, v = fy y/z + cy for a point (x, y, z) in camera axes."""

    focal: tuple[float, float]
    """fx, fy in px"""
    center: tuple[float, float]
    """cx, cy in px, from the upper left corner of the picture"""
    size: tuple[int, int]
    """width, height in px"""
    camera_from_world: RigidTransform = field(default_factory=RigidTransform)

    def __post_init__(self) -> None:
        require(min(self.focal) > 0, f"focal lengths {self.focal}", "positive px")
        require(min(self.size) > 0, f"picture size {self.size}", "positive px")

    @classmethod
    def from_fov(
        cls, fov_degrees: float, size: tuple[int, int], camera_from_world: RigidTransform | None = None
    ) -> PinholeCamera:
        """A camera whose field of view spans the longer side of the picture."""
        require(1.0 < fov_degrees < 170.0, f"field of view {fov_degrees}", "1 to 170 degrees")
        w, h = size
        f = 0.5 * max(w, h) / math.tan(math.radians(fov_degrees) / 2)
        return cls((f, f), (w / 2, h / 2), (w, h), camera_from_world or RigidTransform())

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Camera centre in the world, metres."""
        return self.camera_from_world.inverse().translation

    def pixel_grid(self) -> Float[np.ndarray, "h w 2"]:
        """(u, v) of every pixel centre."""
        w, h = self.size
        u, v = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
        return np.stack([u, v], axis=-1)

    def project(self, points: Float[np.ndarray, "*n 3"]) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n"]]:
        """Pixel positions (u, v) and camera depth z of world points. Points behind the camera keep z <= 0."""
        u, v, z = self._seen(points)
        uv = np.empty((len(z), 2))
        uv[:, 0], uv[:, 1] = u, v
        shape = np.shape(points)[:-1]
        return uv.reshape(*shape, 2), z.reshape(shape)

    def _seen(self, points: Float[np.ndarray, "*n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """u, v and depth z, each [m], of world points."""
        x, y, z = self.camera_from_world.coordinates(points)
        safe = np.where(np.abs(z) < 1e-9, 1e-9, z)
        for axis, (focal, center) in zip((x, y), zip(self.focal, self.center, strict=True), strict=True):
            axis *= focal
            axis /= safe
            axis += center
        return x, y, z

    def nearest_pixels(self, points: Float[np.ndarray, "*n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Row and column of the pixel of the picture nearest to where each world point appears, and its camera depth.

        Points outside the picture get a pixel of its edge; for points behind the camera (depth <= 0) the pixel means
        nothing.
        """
        u, v, z = self._seen(points)
        behind, shape, found = ~(z > 0), np.shape(points)[:-1], []
        for place, size in ((v, self.size[1]), (u, self.size[0])):
            np.fmax(place, 0.0, out=place)  # what is not a number, too
            np.fmin(place, size - 1, out=place)
            place[behind] = 0.0
            found.append(place.astype(int).reshape(shape))
        return *found, z.reshape(shape)

    def rays(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """World directions with unit camera depth: position + z * ray has camera depth z."""
        x = (uv[..., 0] - self.center[0]) / self.focal[0]
        y = (uv[..., 1] - self.center[1]) / self.focal[1]
        ahead = np.stack([x, y, np.ones_like(x)], axis=-1)
        return in_rows(turned(self.camera_from_world.rotation.T, ahead), ahead.shape)

    def unproject(
        self, uv: Float[np.ndarray, "*n 2"], depth: Float[np.ndarray, "*n"] | float
    ) -> Float[np.ndarray, "*n 3"]:
        """World points of pixels (u, v) at camera depth z (not ray length; of each or of all), metres."""
        return self.position + self.rays(uv) * np.asarray(depth)[..., None]

    def resized(self, size: tuple[int, int]) -> PinholeCamera:
        """The same view at another picture size."""
        sx, sy = size[0] / self.size[0], size[1] / self.size[1]
        return replace(
            self,
            focal=(self.focal[0] * sx, self.focal[1] * sy),
            center=(self.center[0] * sx, self.center[1] * sy),
            size=(int(size[0]), int(size[1])),
        )

    @classmethod
    def looking(
        cls,
        eye: Float[np.ndarray, "3"] | tuple[float, float, float],
        target: Float[np.ndarray, "3"] | tuple[float, float, float],
        fov_degrees: float,
        size: tuple[int, int],
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    ) -> PinholeCamera:
        """A camera at `eye` that looks at `target`, with world `up` towards the top of the picture."""
        forward = np.asarray(target, float) - np.asarray(eye, float)
        norm = float(np.linalg.norm(forward))
        require(norm > 0, "eye and target at the same point")
        forward = forward / norm
        right = np.cross(forward, up)
        if np.linalg.norm(right) < 1e-6:
            right = np.cross(forward, (0.0, 1.0, 0.0))
        right = right / np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        return cls.from_fov(fov_degrees, size, RigidTransform(rotation, -rotation @ np.asarray(eye, float)))

    def to_dict(self) -> dict[str, Any]:
        """The camera JSON: width, height, K, R, t with x_cam = R x_world + t."""
        (fx, fy), (cx, cy) = self.focal, self.center
        return {
            "width": self.size[0],
            "height": self.size[1],
            "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
            "R": self.camera_from_world.rotation.tolist(),
            "t": self.camera_from_world.translation.tolist(),
            "convention": "OpenCV axes: x right, y down, z forward; x_cam = R x_world + t; pixel centres at +0.5",
        }

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> PinholeCamera:
        """Read a camera JSON as `to_dict` writes it. `R` and `t` may be absent (identity).

        Raises:
            InputRejected: a key is missing or has the wrong shape or value.
        """
        try:
            k = np.asarray(data["K"], float).reshape(3, 3)
            size = (int(data["width"]), int(data["height"]))
            pose = RigidTransform(
                np.asarray(data.get("R", np.eye(3)), float).reshape(3, 3),
                np.asarray(data.get("t", np.zeros(3)), float).reshape(3),
            )
            return cls((float(k[0, 0]), float(k[1, 1])), (float(k[0, 2]), float(k[1, 2])), size, pose)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise InputRejected(
                f"a camera JSON that cannot be read ({type(error).__name__}: {error})",
                "width, height, K (3x3, px) and, for a known pose, R (3x3) and t (3) with x_cam = R x_world + t",
            ) from None


@dataclass(frozen=True)
class ViewKey:
    """What a camera does at one frame."""

    frame: float
    """counted from 0"""
    eye: tuple[float, float, float]
    """m, world"""
    target: tuple[float, float, float]
    """m, world: what it looks at"""
    fov: float
    """degrees across the longer side"""
