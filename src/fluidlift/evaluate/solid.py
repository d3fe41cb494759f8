"""Figures of what does not move: the bed under the fluid, and which way is up."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from fluidlift.evaluate.case import Case
from fluidlift.evaluate.images import resample_nearest
from fluidlift.evaluate.planar import Arrays, picked
from fluidlift.evaluate.report import Figure, figure
from fluidlift.evaluate.space import Alignment
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.types import FluidAsset, PinholeCamera, Terrain


def solid_depth(terrain: Terrain, camera: PinholeCamera, start: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Camera z (m) at which each pixel's ray first enters the solid beyond `start` (camera z, m); 0 where it never
    does.

    Half a cell at a time, then the crossing of the signed distance between the last two places. Rays whose start is
    not positive are not followed.
    """
    out = np.zeros(start.shape)
    followed = start > 0
    if not followed.any():
        return out
    grid, eye = terrain.grid, camera.position
    rays, z = camera.rays(camera.pixel_grid())[followed], start[followed].astype(np.float64)
    step = 0.5 * grid.spacing / np.linalg.norm(rays, axis=-1)
    longest = np.linalg.norm(np.asarray(grid.shape)) * grid.spacing
    found = np.zeros(len(z))
    open_, before = np.ones(len(z), bool), np.zeros(len(z))
    for _ in range(int(2 * longest / grid.spacing) + 1):
        at = np.flatnonzero(open_)
        if len(at) == 0:
            break
        points = eye + rays[at] * z[at, None]
        inside = grid.contains(points)
        distance = sample_nodes(terrain.signed_distance, grid, points).astype(np.float64)
        hit = inside & (distance <= 0)
        # 0 before the first place inside: a ray that enters the box in the solid meets it right there
        share = np.where(before[at] > 0, distance / np.minimum(distance - before[at], -1e-12), 0.0)
        found[at[hit]] = (z[at] - share * step[at])[hit]
        open_[at[hit]] = False
        left = (points < grid.low) & (rays[at] <= 0) | (points > grid.high) & (rays[at] >= 0)
        open_[at[left.any(axis=-1)]] = False
        before[at], z[at] = np.where(inside, distance, 0.0), z[at] + step[at]
    out[followed] = found
    return out


def score_bed(arrays: Arrays, asset: FluidAsset, case: Case, alignment: Alignment) -> list[Figure]:
    """How far the solid behind the visible fluid is from the true one along the lines of sight."""
    keys = ("geometry.bed_error", "geometry.bed_error_relative")
    depth, why = picked(arrays, "front_depth", 2)
    if depth is None or not (case.static_depth > 0).any():
        return [figure(k, None, "", why or "the case has no solid") for k in keys]
    size = (depth.shape[1], depth.shape[0])
    truth = resample_nearest(case.static_depth.astype(np.float32), size)
    wet = resample_nearest(case.mask[alignment.frame].astype(np.uint8), size) > 0
    mine = solid_depth(asset.terrain, asset.camera.resized(size), np.where(wet, depth, 0.0))
    both = (mine > 0) & (truth > 0)
    if not both.any():
        return [figure(k, None, "", "no ray through the fluid meets both solids") for k in keys]
    error = np.abs(alignment.truth_from_asset.scale * mine - truth)[both]
    share = both.sum() / max((wet & (truth > 0)).sum(), 1)
    note = f"median over the {100 * share:.0f} % of the fluid's lines of sight that meet a bed"
    return [
        figure(keys[0], float(np.median(error)), "m", note),
        figure(keys[1], float(np.median(error / truth[both])), "", "of the bed's depth"),
    ]


def score_up(case: Case, alignment: Alignment) -> list[Figure]:
    """Angle between the asset's vertical and the case's, both as their cameras see them."""
    up = alignment.truth_from_asset.rotation @ np.array([0.0, 0.0, 1.0])
    gravity = case.scene.get("gravity")
    true = -np.asarray(gravity, float) if np.shape(gravity) == (3,) and np.any(gravity) else np.array([0.0, 0.0, 1.0])
    cosine = float(np.clip(up @ true / np.linalg.norm(true), -1.0, 1.0))
    return [figure("geometry.up_angle", float(np.degrees(np.arccos(cosine))), "degrees", "from the true vertical")]
