"""Figures of what does not move: the bed under the fluid, and which way is up."""

from __future__ import annotations

import numpy as np

from fluidlift.evaluate.case import Case
from fluidlift.evaluate.images import resample_nearest
from fluidlift.evaluate.planar import Arrays, picked
from fluidlift.evaluate.report import Metric, figure
from fluidlift.evaluate.space import Alignment
from fluidlift.look.scenery import terrain_depth
from fluidlift.types import FluidAsset


def score_bed(arrays: Arrays, asset: FluidAsset, case: Case, alignment: Alignment) -> list[Metric]:
    """How far the solid that the lines of sight through the fluid meet is from the true one."""
    keys = ("geometry.bed_error", "geometry.bed_error_relative")
    depth, why = picked(arrays, "front_depth", 2)
    if depth is None or not (case.static_depth > 0).any():
        return [figure(k, None, "", why or "the case has no solid") for k in keys]
    size = (depth.shape[1], depth.shape[0])
    truth = resample_nearest(case.static_depth.astype(np.float32), size)
    wet = resample_nearest(case.mask[alignment.frame].astype(np.uint8), size) > 0
    mine = terrain_depth(asset.terrain, asset.camera.resized(size))
    both = wet & np.isfinite(mine) & (truth > 0)
    if not both.any():
        return [figure(k, None, "", "no ray through the fluid meets both solids") for k in keys]
    error = np.abs(alignment.truth_from_asset.scale * mine[both] - truth[both])
    share = both.sum() / max((wet & (truth > 0)).sum(), 1)
    note = f"median over the {100 * share:.0f} % of the fluid's lines of sight that meet a bed"
    return [
        figure(keys[0], float(np.median(error)), "m", note),
        figure(keys[1], float(np.median(error / truth[both])), "", "of the bed's depth"),
    ]


def score_up(case: Case, alignment: Alignment) -> list[Metric]:
    """Angle between the asset's vertical and the case's, both as their cameras see them."""
    up = alignment.truth_from_asset.rotation @ np.array([0.0, 0.0, 1.0])
    gravity = case.scene.get("gravity")
    true = np.array([0.0, 0.0, 1.0])
    if gravity is not None and np.shape(gravity) == (3,) and np.any(gravity):
        true = -np.asarray(gravity, float)
    cosine = float(np.clip(up @ true / np.linalg.norm(true), -1.0, 1.0))
    return [figure("geometry.up_angle", float(np.degrees(np.arccos(cosine))), "degrees", "from the true vertical")]
