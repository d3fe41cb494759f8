"""Figures of space: depth, occupancy, volume velocity, divergence, parameters. From an asset and the truth of a case.

All are measured after one alignment: camera axes on camera axes, then one scale factor about the eye (`align_cameras`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fluidlift.evaluate.case import Case
from fluidlift.evaluate.images import depth_error, depth_scale, resample_nearest
from fluidlift.evaluate.planar import Arrays, number, picked, truth_mask
from fluidlift.evaluate.report import Metric, figure
from fluidlift.evaluate.volumes import (
    align_cameras,
    behind,
    cell_surface_points,
    field_cosine,
    in_picture,
    level_set_points,
    lookup,
    mean_nearest,
    occupancy_iou,
    relative_divergence,
    relative_l2,
    sample_cells,
    within,
)
from fluidlift.motion.lift import lift_flow
from fluidlift.physics.pressure import build_system, divergence
from fluidlift.types import CellType, Estimate, FluidAsset, Similarity3, kind_of

FEWEST_CELLS = 8
"""inlet cells that must meet the truth's fluid before its inflow is called known"""


@dataclass(frozen=True)
class Alignment:
    """How the asset was laid over the truth."""

    truth_from_asset: Similarity3
    frame: int
    """of the clip, at which the asset is at rest"""
    key: int
    """index of the key frame of the truth nearest to it"""


def score_depth(arrays: Arrays, case: Case) -> tuple[list[Metric], float | None, int]:
    """Depth error after one scale factor; returns the figures, that factor and the rest frame."""
    frame = int(np.clip(number(arrays, "rest_frame", number(arrays, "first_frame", 0)), 0, len(case) - 1))
    depth, why = picked(arrays, "front_depth", 2)
    scale = error = None
    if depth is not None:
        size = (depth.shape[1], depth.shape[0])
        truth = resample_nearest(case.depth[frame].astype(np.float32), size)
        mask = truth_mask(case, slice(frame, frame + 1), size)[0]
        scale = depth_scale(depth, truth, mask)
        error = None if scale is None else depth_error(depth, truth, mask, scale)
        why = "" if scale is not None else "depth and truth share no pixel"
    return (
        [
            figure("geometry.scale", scale, "", why or "truth metres per asset metre, from the median depths"),
            figure("geometry.depth_error", error and error[0], "m", why or f"mean over the fluid of frame {frame}"),
            figure("geometry.depth_error_over_relief", error and error[1], "", why or "1 = no better than one depth"),
            figure("geometry.depth_error_relative", error and error[2], "", why or "median, of the true depth"),
        ],
        scale,
        frame,
    )


def align(asset: FluidAsset, case: Case, scale: float, frame: int) -> Alignment:
    """Lay the asset, at rest at `frame`, over the truth with `scale` truth metres per asset metre."""
    key = int(np.argmin(np.abs(case.key_frames - frame)))
    return Alignment(align_cameras(case.camera, asset.camera, scale), frame, key)


def score_surface_velocity(arrays: Arrays, asset: FluidAsset, case: Case, alignment: Alignment) -> list[Metric]:
    """Velocity of the visible surface at the rest frame in m/s, lifted with the run's own depth and camera.

    Scored at the pixels where run and truth both see fluid, in the truth's world; `share_found` is the factor of the
    truth nearest to the run's velocity, 1 where speeds are neither low nor high in the mean.
    """
    keys = tuple(f"surface.velocity.{k}" for k in ("error", "relative_error", "share_found"))
    depth, why = picked(arrays, "front_depth", 2)
    flow, why_flow = picked(arrays, "flow_completed", 4, 2)
    t = alignment.frame
    if depth is None or flow is None or flow.shape[1:3] != depth.shape:
        return [figure(k, None, "", why or why_flow or "depth and flow of unlike size") for k in keys]
    t = min(t, len(flow) - 1)
    size = (depth.shape[1], depth.shape[0])
    mask = (depth > 0) & np.isfinite(flow[t]).all(axis=-1)
    both = mask & truth_mask(case, slice(t, t + 1), size)[0]
    if not both.any():
        return [figure(k, None, "", f"run and truth share no moving pixel of frame {t}") for k in keys]
    moved = np.where(mask[..., None], flow[t], 0.0)
    lifted = lift_flow(moved, mask, mask, depth, depth, asset.camera.resized(size), case.interval)
    mine = alignment.truth_from_asset.vectors(lifted.velocities[both[mask]].astype(np.float64))
    true = resample_nearest(true_surface_velocity(case, t), size, axes=(0, 1))[both]
    error, speed = np.linalg.norm(mine - true, axis=-1).mean(), np.linalg.norm(true, axis=-1).mean()
    found = float((mine * true).sum() / max(float((true**2).sum()), 1e-12))
    return [
        figure(keys[0], error, "m/s", f"mean over the fluid of frame {t}; the truth moves {speed:.3g} m/s"),
        figure(keys[1], error / max(speed, 1e-12), "", "of the mean true speed"),
        figure(keys[2], found, "", "1 = speeds neither low nor high"),
    ]


def true_surface_velocity(case: Case, t: int) -> np.ndarray:
    """float64 [H,W,3], m/s in the truth's world, of the surface seen at each pixel of frame t; 0 outside the mask."""
    mask, uv = case.mask[t], case.camera.pixel_grid()
    z = np.where(mask, case.depth[t], 1.0).astype(np.float64)
    first = case.camera.unproject(uv, z)
    second = case.camera.unproject(uv + case.flow[t], z + case.depth_change[t])
    return np.where(mask[..., None], (second - first) / case.interval, 0.0)


def score_volume(asset: FluidAsset, case: Case, alignment: Alignment) -> list[Metric]:
    """Occupancy IoU, Chamfer distance and volume velocity against the truth's grid at the nearest key frame.

    Only cells whose centres are in the picture count, and truth that a solid hides from the camera
    or that lies in the asset's outlet cells, where its simulation ends, is left out.
    """
    to_truth, key = alignment.truth_from_asset, alignment.key
    to_asset = to_truth.inverse()
    fluid = np.isin(asset.cell_types, (CellType.FLUID, CellType.INFLOW))
    centers = case.grid.centers().reshape(-1, 3)
    seen = in_picture(centers, case.camera)
    truth = case.occupied(key).reshape(-1)
    hidden = behind(centers, case.static_depth, case.camera, case.grid.spacing)
    at_asset = to_asset.points(centers)
    occupied = lookup(fluid, asset.grid, at_asset, outside=False)
    sink = lookup(asset.cell_types == CellType.OUTFLOW, asset.grid, at_asset, outside=False)
    ignored = ~seen | (truth & hidden) | sink

    asset_cells = to_truth.points(asset.grid.centers()[fluid])
    stray = in_picture(asset_cells, case.camera) & ~case.grid.contains(asset_cells)
    stray_cells = stray.sum() * (to_truth.scale * asset.grid.spacing / case.grid.spacing) ** 3
    note = f"cells in the picture, key frame {case.key_frames[key]} for rest frame {alignment.frame}"
    out = [figure("geometry.occupancy_iou", occupancy_iou(occupied, truth, ignored, float(stray_cells)), "", note)]
    out += _score_surface(asset, fluid, case, alignment)

    both = occupied & truth & ~ignored
    share = both.sum() / max((truth & ~ignored).sum(), 1)
    out.append(figure("volume.overlap", share, "", "of the truth's fluid cells in the picture that the asset fills"))
    if not both.any():
        why = "asset and truth share no fluid cell"
        return [*out, figure("volume.relative_l2", None, "", why), figure("volume.cosine", None, "", why)]
    mine = to_truth.vectors(sample_cells(asset.velocity, fluid, asset.grid, at_asset[both]))
    true = case.velocity[key].reshape(-1, 3)[both].astype(np.float64)
    speeds = f"mean speed {np.linalg.norm(mine, axis=-1).mean():.3g}, truth {np.linalg.norm(true, axis=-1).mean():.3g}"
    out.append(figure("volume.relative_l2", relative_l2(mine, true), "", speeds + " m/s"))
    out.append(figure("volume.cosine", field_cosine(mine, true)))
    return out


def _score_surface(asset: FluidAsset, fluid: np.ndarray, case: Case, alignment: Alignment) -> list[Metric]:
    """Chamfer distance between the surfaces of both bodies of fluid."""
    names = ("geometry.chamfer", "geometry.chamfer_cells")
    if case.level_set is None:
        return [figure(n, None, "", "a gas has no surface") for n in names]
    mine = alignment.truth_from_asset.points(cell_surface_points(fluid, asset.grid))
    true = level_set_points(case.level_set[alignment.key], case.grid)
    mine, true = mine[in_picture(mine, case.camera)], true[in_picture(true, case.camera)]
    seen = true[~behind(true, case.static_depth, case.camera, 2 * case.grid.spacing)]
    there, back = mean_nearest(mine, true), mean_nearest(seen, mine)
    if there is None or back is None:
        return [figure(n, None, "", "one of the bodies is not in the picture") for n in names]
    chamfer = 0.5 * (there + back)
    note = f"mean nearest distance, asset to truth {there:.3g} m and back {back:.3g} m"
    return [figure(names[0], chamfer, "m", note), figure(names[1], chamfer / case.grid.spacing, "truth cells")]


def score_divergence(asset: FluidAsset) -> list[Metric]:
    """|div v| dx / mean speed of the asset's first velocity, with the open fractions that its solver uses."""
    system = build_system(asset.cell_types, asset.terrain, asset.grid)
    fluid = np.asarray(asset.cell_types) == CellType.FLUID
    if asset.velocity.shape != asset.grid.shape:
        scaled = None
    else:
        value = divergence(asset.velocity, asset.grid, system)
        scaled = relative_divergence(value, asset.velocity, fluid, asset.grid.spacing)
    why = "" if scaled else "no moving fluid cell"
    return [
        figure("divergence.max", scaled and scaled[0], "", why or "|div v| dx / mean speed"),
        figure("divergence.mean", scaled and scaled[1], "", why),
    ]


def _sigma(estimate: Estimate | None) -> float | None:
    if estimate is None or not estimate.fitted:
        return None
    return float(estimate.sigma)


def _recovery(
    name: str, value: np.ndarray, truth: np.ndarray | None, sigmas: list[float | None], unit: str, why: str = ""
) -> list[Metric]:
    """Relative error of a scalar or vector (length-1 or length-3 arrays), and whether the truth lies in 2 sigma."""
    key = f"parameters.{name}"
    keys = (f"{key}.relative_error", f"{key}.within_2_sigma")
    shown = ", ".join(f"{x:.3g}" for x in value)
    if truth is None:
        return [figure(keys[0], None, "", f"got {shown} {unit}; {why}"), figure(keys[1], None, "", why)]
    note = f"got {shown}, truth {', '.join(f'{x:.3g}' for x in truth)} {unit}"
    known = [i for i, s in enumerate(sigmas) if s is not None]
    size = float(np.linalg.norm(truth))
    error = float(np.linalg.norm(value - truth)) / size if size > 0 else None
    if error is None:
        note += "; the truth is 0"
    if not known:
        note += "; not determined"
        return [figure(keys[0], error, "", note), figure(keys[1], None, "", "not determined")]
    inside = all(within(value[i], truth[i], sigmas[i] or 0.0) for i in known)
    spread = ", ".join("-" if s is None else f"{s:.2g}" for s in sigmas)
    return [figure(keys[0], error, "", note), figure(keys[1], float(inside), "", f"1 = yes; sigma {spread} {unit}")]


def _true_inflow(asset: FluidAsset, case: Case, alignment: Alignment) -> tuple[np.ndarray | None, str]:
    """Mean velocity of the truth in the asset's inlet cells, m/s in asset axes at truth scale."""
    cells = asset.grid.centers()[np.asarray(asset.cell_types) == CellType.INFLOW]
    at = alignment.truth_from_asset.points(cells)
    wet = lookup(case.occupied(alignment.key), case.grid, at, outside=False) if len(at) else np.zeros(0, bool)
    if wet.sum() < FEWEST_CELLS:
        return None, f"{wet.sum()} of {len(at)} inlet cells lie in the truth's fluid"
    index = case.grid.cell_of(at[wet])
    velocity = case.velocity[alignment.key].astype(np.float64)[index[:, 0], index[:, 1], index[:, 2]].mean(axis=0)
    return velocity @ alignment.truth_from_asset.rotation, ""


def score_parameters(asset: FluidAsset, case: Case, alignment: Alignment) -> list[Metric]:
    """Recovery of gravity, viscosity and inflow velocity, in the axes of the asset and the lengths of the truth."""
    s, rotation = alignment.truth_from_asset.scale, alignment.truth_from_asset.rotation
    p, e = asset.parameters, asset.estimates

    def vector(name: str) -> list[float | None]:
        sigmas = [_sigma(e.get(f"{name}_{axis}")) for axis in "xyz"]
        return [None if x is None else x * s for x in sigmas]

    out = []
    gravity = case.scene.get("gravity")
    true = np.asarray(gravity, float) @ rotation if gravity is not None and np.shape(gravity) == (3,) else None
    mine, why = s * np.asarray(p.gravity), "the case does not say"
    if kind_of(asset.kind).is_gas:
        true, why = None, "the gravity of a plume is its buoyancy, which the case does not say in m/s2"
    out += _recovery("gravity", mine, true, vector("gravity"), "m/s2", why)
    if true is not None:
        cosine = field_cosine(mine, true)
        angle = None if cosine is None else float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        out.append(figure("parameters.gravity.angle", angle, "degrees", "between fitted and true gravity"))
    viscosity = case.scene.get("viscosity_m2_s")
    true = np.array([float(viscosity)]) if isinstance(viscosity, int | float) else None
    sigma = _sigma(e.get("kinematic_viscosity"))
    out += _recovery(
        "viscosity", np.array([s * s * p.kinematic_viscosity]), true, [None if sigma is None else s * s * sigma],
        "m2/s", "the case does not say",
    )  # fmt: skip
    true, why = _true_inflow(asset, case, alignment)
    out += _recovery("inflow", s * np.asarray(p.inflow_velocity), true, vector("inflow_velocity"), "m/s", why)
    return out
