"""Rows of a silhouette in the vertical plane through a body: its jet, and what that falls into or onto."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.types import PinholeCamera

NARROW = 0.55
"""of the widest row, at most: the jet that falls in. A jet that fills half of its glass is rare, and a body that is as
wide above as below is none that stands in a vessel"""
STEEPEST = np.tan(np.radians(15.0))
"""way to the side over height of a jet that leans, at most (`jets.ALONG`): what leans more is no jet alone"""
STEEPEST_VIEW = np.sin(np.radians(70.0))
"""sine of the tilt from which no silhouette from the side is seen: walls are a third as high as they are"""
WIDER = 1.5
"""of the jet's median width, from which a row shows more than the jet"""
FOOT = 0.2
"""of the widest row, at least: the vessel. A narrower part below is a stem or a reflection on the table"""
PARTS = (1.0 / 6.0, 5.0 / 6.0)
"""of the silhouette's height that the pool takes, at least and at most: less is a rim of drops, more leaves no jet"""
BELOW = 0.1
"""of the silhouette's height that may lie below the pool"""


def level_axes(camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors x, y to the camera's right and ahead of it, along the ground; of a look straight down, up the
    picture."""
    rotation = camera.camera_from_world.rotation
    ahead = rotation[2, :2] if np.linalg.norm(rotation[2, :2]) > 1e-6 else -rotation[1, :2]
    forward = ahead / np.linalg.norm(ahead)
    return np.array([forward[1], -forward[0]]), forward


@dataclass(frozen=True)
class Rectified:
    """Rows of a silhouette in the vertical plane through the axis, from below."""

    z: Float[np.ndarray, " k"]
    """above the eye"""
    width: Float[np.ndarray, " k"]
    """of the widest run; 0 where there is none"""
    middle: Float[np.ndarray, " k"]
    """of it, to the right of the eye"""

    @property
    def widest(self) -> float:
        return float(np.percentile(self.width, 90))

    @classmethod
    def of(cls, camera: PinholeCamera, mask: Bool[np.ndarray, "h w"], distance: float) -> Rectified | None:
        """The rows of a mask at a distance along the ground; None where the camera looks down too steeply, or they are
        too few."""
        if abs(camera.camera_from_world.rotation[2, 2]) > STEEPEST_VIEW:
            return None
        eye, (right, forward) = camera.position, level_axes(camera)
        rays = camera.rays(camera.pixel_grid()[mask])
        ahead = rays[:, :2] @ forward
        rays, ahead = rays[ahead > 1e-3], ahead[ahead > 1e-3]
        if not len(rays):
            return None
        x, z = distance * (rays[:, :2] @ right) / ahead, distance * rays[:, 2] / ahead
        pitch = distance / max(camera.focal)
        columns, rows = (np.arange(v.min(), v.max() + 2.0 * pitch, pitch) for v in (x, z))
        if min(len(columns), len(rows)) < 12 or max(len(columns), len(rows)) > 4 * max(mask.shape):
            return None
        place = (eye[:2] + distance * forward + columns[:, None] * right)[None]
        points = np.concatenate(
            [np.broadcast_to(place, (len(rows), len(columns), 2)),
             np.broadcast_to((eye[2] + rows)[:, None, None], (len(rows), len(columns), 1))], axis=-1,
        )  # fmt: skip
        row, column, depth = camera.nearest_pixels(points.reshape(-1, 3))
        uv, _ = camera.project(points.reshape(-1, 3))
        inside = (depth > 0) & ((uv >= 0) & (uv < np.array(camera.size))).all(axis=1)
        shown = (mask[row, column] & inside).reshape(len(rows), len(columns))
        runs = [_longest_run(line) for line in shown]
        first, last = np.array([r[0] for r in runs]), np.array([r[1] for r in runs])
        return cls(rows, (last - first) * pitch, columns[0] + 0.5 * (first + last - 1) * pitch)

    def lean(self, last: int) -> float:
        """Way to the right over height, of the jet above a row, but for rows that show what it falls into as well."""
        width = self.width[last:]
        rows = last + np.flatnonzero((width > 0) & (width < WIDER * np.median(width)))
        lean = float(np.polyfit(self.z[rows], self.middle[rows], 1)[0]) if len(rows) > 2 else 0.0
        return lean if abs(lean) < STEEPEST else 0.0

    def pool(self) -> tuple[int, int]:
        """First row of the pool and the one after its last."""
        widest = self.widest
        wide = self.width > NARROW * widest
        middle = int(np.argmax(np.where(self.width >= widest, 1, 0)))
        above, below = np.flatnonzero(~wide[middle:]), np.flatnonzero(self.width[:middle] < FOOT * widest)
        return int(below[-1]) + 1 if len(below) else 0, middle + int(above[0]) if len(above) else len(wide)


def _longest_run(line: np.ndarray) -> tuple[int, int]:
    """Begin and end of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(np.int8)))
    if not len(edges):
        return 0, 0
    begins, ends = edges[::2], edges[1::2]
    k = int(np.argmax(ends - begins))
    return int(begins[k]), int(ends[k])
