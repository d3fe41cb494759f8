"""A jet in space: a round column that stands vertically on the surface of the fluid below it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.shape.jets import JetOutline
from fluidlift.shape.surface import FrontSurface
from fluidlift.types import PinholeCamera, Similarity3


@dataclass(frozen=True)
class Jet:
    """A round column that stands vertically on a surface."""

    axis: tuple[float, float]
    """x, y"""
    z: Float[np.ndarray, " k"]
    """increasing, from below the foot to the top"""
    radius: Float[np.ndarray, " k"]
    """at these heights"""
    nozzle: tuple[float, float] | None = None
    """x, y of where it rises out of the surface; None: it falls onto that"""

    def __post_init__(self) -> None:
        require(len(self.z) == len(self.radius) >= 2, f"{len(self.z)} heights, {len(self.radius)} radii", "two or more")
        require(bool((np.diff(self.z) > 0).all()), "heights that do not increase")
        require(bool((self.radius > 0).all()), "a radius that is not positive")

    @property
    def top(self) -> float:
        """z of its upper end."""
        return float(self.z[-1])

    def contains(self, points: Float[np.ndarray, "*n 3"], *, least: float = 0.0) -> Bool[np.ndarray, "*n"]:
        """Which points are inside it, with a radius of at least `least`."""
        away = np.hypot(points[..., 0] - self.axis[0], points[..., 1] - self.axis[1])
        z = points[..., 2]
        inside = away <= np.maximum(np.interp(z, self.z, self.radius), least)
        return inside & (z >= self.z[0]) & (z <= self.top)

    def transformed(self, target_from_source: Similarity3) -> Jet:
        """In another frame whose z axis is up as well."""
        t = target_from_source
        x, y, _ = t.points(np.array([[self.axis[0], self.axis[1], 0.0]]))[0]
        nozzle = None
        if self.nozzle is not None:
            out = t.points(np.array([[*self.nozzle, 0.0]]))[0]
            nozzle = float(out[0]), float(out[1])
        return Jet((float(x), float(y)), t.scale * self.z + t.translation[2], t.scale * self.radius, nozzle)

    def seen(self, camera: PinholeCamera) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
        """Camera depth of its near side and half its extent along the ray, camera depth too; 0 where no ray meets it.

        Seen from above, its flat top closes it.
        """
        rays, eye = camera.rays(camera.pixel_grid()), camera.position
        flat = np.maximum((rays[..., :2] ** 2).sum(-1), 1e-12)
        offset = np.asarray(self.axis) - eye[:2]
        middle = (rays[..., :2] @ offset) / flat
        miss = np.linalg.norm(middle[..., None] * rays[..., :2] - offset, axis=-1)
        near = middle
        for _ in range(4):  # the radius changes slowly with height
            radius = np.interp(eye[2] + near * rays[..., 2], self.z, self.radius)
            half = np.sqrt(np.maximum(radius**2 - miss**2, 0.0) / flat)
            near = middle - half
        z = eye[2] + near * rays[..., 2]
        through_top = (z > self.top) & (rays[..., 2] < 0)
        lid = (self.top - eye[2]) / np.minimum(rays[..., 2], -1e-12)
        lid_hit = through_top & (lid <= middle + half)
        hit = (miss < radius) & (middle > 0) & (((z <= self.top) & (z >= self.z[0])) | lid_hit)
        near = np.where(lid_hit, lid, near)
        return np.where(hit, near, 0.0), np.where(hit, np.maximum(0.5 * (middle + half - near), 0.0), 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        out = {"axis": list(self.axis), "z": self.z.tolist(), "radius": self.radius.tolist()}
        return out if self.nozzle is None else out | {"nozzle": list(self.nozzle)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Jet:
        """Of `to_dict`."""
        (x, y), nozzle = data["axis"], data.get("nozzle")
        nozzle = None if nozzle is None else (float(nozzle[0]), float(nozzle[1]))
        return cls((float(x), float(y)), np.asarray(data["z"], float), np.asarray(data["radius"], float), nozzle)


def stand(outline: JetOutline, camera: PinholeCamera, front: FrontSurface) -> Jet | None:
    """The jet on the surface of the lying part; None where its foot is not on it.

    The lowest point of the silhouette is the near side of its foot, a radius before the axis.

    Args:
        outline: in the picture of `camera`.
        camera: canonical (z up).
        front: of the lying part.
    """
    (u, v), focal = outline.centers[-1], float(np.mean(camera.focal))
    row = int(np.clip(np.floor(v), 0, camera.size[1] - 1))
    col = int(np.clip(np.floor(u), 0, camera.size[0] - 1))
    depth = float(front.depth[row, col])
    if depth <= 0:
        return None
    foot = camera.unproject(np.array([[u, v]]), np.array([depth]))[0]
    away = foot[:2] - camera.position[:2]
    away = away / max(float(np.linalg.norm(away)), 1e-12)
    axis = foot[:2] + away * float(outline.half_widths[-1]) * depth / focal
    rays, eye = camera.rays(outline.centers), camera.position
    # the vertical plane through the axis that faces the viewer
    middle = ((axis - eye[:2]) @ away) / np.maximum(rays[:, :2] @ away, 1e-9)
    if not outline.cut:
        # the upper edge is the far rim of the top. Where a nozzle hides that, the jet ends lower than it does, by its
        # foreshortened width, instead of standing out before the nozzle
        middle[0] += float(outline.half_widths[0]) * middle[0] / focal / max(float(rays[0, :2] @ away), 1e-9)
    z = eye[2] + middle * rays[:, 2]
    z[1:] = np.minimum(z[1:], z[0])
    radius = outline.half_widths * middle / focal
    ground = float(foot[2]) if front.height is None else float(front.height.height(axis[None])[0])
    keep = z > ground
    if not keep.any() or z[keep].max() <= ground:
        return None
    order = np.argsort(z[keep])
    z, radius = z[keep][order], np.maximum(radius[keep][order], 1e-9)
    fresh = np.concatenate([[True], np.diff(z) > 1e-9])
    z, radius = z[fresh], radius[fresh]
    # it goes on down to a radius below the surface, which may slope
    below = min(ground, float(foot[2])) - float(radius[0])
    nozzle = None
    if outline.nozzle is not None:  # in the vertical plane through the axis that faces the viewer
        aside = (outline.nozzle[0] - float(u)) * float(middle[-1]) / focal
        nozzle = float(axis[0] + aside * away[1]), float(axis[1] - aside * away[0])
    return Jet(
        (float(axis[0]), float(axis[1])), np.concatenate([[below], z]), np.concatenate([[radius[0]], radius]), nozzle
    )  # fmt: skip


def with_columns(
    front: FrontSurface, outlines: list[JetOutline], camera: PinholeCamera, mask: Bool[np.ndarray, "h w"]
) -> tuple[FrontSurface, list[Jet], Bool[np.ndarray, "h w"]]:
    """The visible side of the lying part and the jets above it, whichever is nearer; the jets; and where they are seen.

    Args:
        front: of the lying part.
        outlines: of the jets in the picture.
        camera: canonical (z up).
        mask: all fluid pixels.
    """
    depth, half = front.depth.astype(np.float64), front.half_thickness.astype(np.float64)
    found, airborne = [], np.zeros(mask.shape, bool)
    for outline in outlines:
        jet = stand(outline, camera, front)
        if jet is None:
            continue
        found.append(jet)
        near, thick = jet.seen(camera)
        plane = _facing_plane(jet, camera)
        # a ragged silhouette is a little wider than the column
        beside = outline.pixels & (near == 0) & (plane > 0) & ((depth == 0) | (plane < depth))
        near, thick = np.where(beside, plane, near), np.where(beside, 0.0, thick)
        over = mask & (near > 0) & ((depth == 0) | (near < depth))
        depth, half = np.where(over, near, depth), np.where(over, thick, half)
        airborne |= over
    if not found:
        return front, [], airborne
    return replace(front, depth=depth.astype(np.float32), half_thickness=half.astype(np.float32)), found, airborne


def _facing_plane(jet: Jet, camera: PinholeCamera) -> Float[np.ndarray, "h w"]:
    """Camera depth of the vertical plane through the axis that faces the viewer, above the foot; else 0."""
    rays, eye = camera.rays(camera.pixel_grid()), camera.position
    offset = np.asarray(jet.axis) - eye[:2]
    toward = rays[..., :2] @ offset
    depth = (offset @ offset) / np.maximum(toward, 1e-9)
    return np.where((toward > 0) & (eye[2] + depth * rays[..., 2] > jet.z[0]), depth, 0.0)
