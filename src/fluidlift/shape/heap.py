"""What is poured over something that stands: a film on a solid of revolution about a vertical axis.

A liquid that is wide in the air, below a jet and above what runs down from it, would fall if nothing held it. What
holds it is not seen, as the liquid covers it: it is taken to be round, as wide at each height as the silhouette is
there or anywhere above, and to stand on the ground; what runs down runs down its near side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

from fluidlift.shape.rectified import BELOW, NARROW, PARTS, Rectified, level_axes
from fluidlift.types import PinholeCamera, Similarity3, triple

THICKEST = 0.5
"""of the radius at a height that is liquid at most"""
TURNS = 4
"""steps in which a ray's hit on the outline is found: its radius changes slowly with height"""


@dataclass(frozen=True)
class Heap:
    """A liquid that covers something, z up."""

    axis: tuple[float, float]
    """x, y"""
    heights: Float[np.ndarray, " k"]
    """z from the lower end of what is wide to its top, increasing"""
    radii: Float[np.ndarray, " k"]
    """of the liquid's outside at these heights, not increasing; below it goes on"""
    inflow: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """unit vector, the way that the jet falls onto it, as far as it leans to the side"""

    def radius_at(self, z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Radius of the outside; 0 above its top."""
        return np.interp(z, self.heights, self.radii, right=0.0)

    def core(self, points: Float[np.ndarray, "*n 3"], film: float) -> Float[np.ndarray, "*n"]:
        """Signed distance to what it covers, negative within, down to any depth.

        Args:
            points: world.
            film: thickness of the liquid on it, no more than `THICKEST` of its radius.
        """
        z, r = points[..., 2], np.hypot(points[..., 0] - self.axis[0], points[..., 1] - self.axis[1])
        inner = np.maximum(self.radii - film, (1.0 - THICKEST) * self.radii)
        top = self.heights - film
        heights = np.concatenate([[min(float(z.min()), float(top[0])) - film], top])
        outline = np.stack([np.append(np.concatenate([inner[:1], inner]), 0.0), np.append(heights, top[-1])], axis=-1)
        steps = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(outline, axis=0), axis=1))])
        along = np.arange(0.0, steps[-1], film / 16.0)
        places = np.stack([np.interp(along, steps, column) for column in outline.T], axis=-1)
        away = cKDTree(places).query(np.stack([r, z], axis=-1))[0]
        inside = (r < np.interp(z, heights, outline[:-1, 0])) & (z < top[-1])
        return np.where(inside, -away, away)

    def seen(self, camera: PinholeCamera) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
        """Camera depth at which each ray enters and leaves it; nan where it does not."""
        rays, eye = camera.rays(camera.pixel_grid()), camera.position
        flat = np.maximum((rays[..., :2] ** 2).sum(-1), 1e-12)
        offset = np.asarray(self.axis) - eye[:2]
        middle = (rays[..., :2] @ offset) / flat
        miss = np.linalg.norm(middle[..., None] * rays[..., :2] - offset, axis=-1)
        near = far = middle
        for _ in range(TURNS):
            ends = []
            for depth, side in ((near, -1.0), (far, 1.0)):
                radius = self.radius_at(eye[2] + depth * rays[..., 2])
                ends.append(middle + side * np.sqrt(np.maximum(radius**2 - miss**2, 0.0) / flat))
            near, far = ends
        hit = (far > near) & (near > 0)
        return np.where(hit, near, np.nan), np.where(hit, far, np.nan)

    def transformed(self, t: Similarity3) -> Heap:
        """As a similarity that keeps the vertical moves it."""
        low = t.points(np.array([[*self.axis, 0.0]]))[0]
        return Heap(
            (float(low[0]), float(low[1])), low[2] + t.scale * self.heights, t.scale * self.radii,
            triple(t.rotation @ self.inflow),
        )  # fmt: skip


def find_heap(camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], distance: float) -> Heap | None:
    """The heap in a silhouette: wide below a jet, and above what runs down from it; else None.

    Args:
        camera: its tilt and roll as known.
        mask: fluid pixels.
        distance: from the camera to the axis along the ground, in the unit of the result.
    """
    eye, (right, forward) = camera.position, level_axes(camera)
    plane = Rectified.of(camera, mask, distance)
    if plane is None:
        return None
    first, last = plane.pool()
    count = len(plane.z)
    if not PARTS[0] * count <= last - first <= PARTS[1] * count or first <= BELOW * count:
        return None
    jet = plane.width[last:]
    if len(jet) < PARTS[0] * count or np.median(jet) > NARROW * plane.widest:
        return None
    half = np.maximum.accumulate(0.5 * plane.width[first:last][::-1])[::-1]
    axis = eye[:2] + float(np.median(plane.middle[first:last])) * right + distance * forward
    way = np.array([*(-plane.lean(last) * right), -1.0])
    return Heap((float(axis[0]), float(axis[1])), eye[2] + plane.z[first:last], half, triple(way / np.linalg.norm(way)))
