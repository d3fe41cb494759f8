"""The door: an asset folder against a case with a known truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import FluidliftError
from fluidlift.evaluate.alignment import score_aligned
from fluidlift.evaluate.case import Case, read_case, read_json
from fluidlift.evaluate.of_run import arrays_of_run
from fluidlift.evaluate.planar import (
    Arrays,
    picked,
    score_conservation,
    score_flow,
    score_resimulation,
    score_segmentation,
)
from fluidlift.evaluate.report import Evaluation, Metric, figure
from fluidlift.evaluate.solid import score_bed, score_up
from fluidlift.evaluate.space import (
    align,
    score_depth,
    score_divergence,
    score_parameters,
    score_surface_velocity,
    score_volume,
)
from fluidlift.types import FluidAsset


def _seconds(entry: Any) -> float | None:
    """Of one stage: a number, or an object with `seconds`."""
    value = entry.get("seconds") if isinstance(entry, Mapping) else entry
    return float(value) if isinstance(value, int | float) else None


def score_cost(manifest: Mapping[str, Any]) -> list[Metric]:
    """Seconds per stage (`timings`) and peak memory (`peak_memory_mb`, of its `metrics`)."""
    timings = manifest.get("timings")
    stages = {str(k): _seconds(v) for k, v in timings.items()} if isinstance(timings, Mapping) else {}
    known = {k: v for k, v in stages.items() if v is not None}
    out = [figure(f"cost.seconds.{k}", v, "s") for k, v in known.items() if k != "total"]
    total = known.get("total", sum(known.values())) if known else None
    out.append(figure("cost.seconds", total, "s", "all stages" if known else "the manifest has no timings"))
    metrics = manifest.get("metrics")
    peak = metrics.get("peak_memory_mb") if isinstance(metrics, Mapping) else None
    if isinstance(peak, int | float):
        return [*out, figure("cost.peak_memory", peak, "MB")]
    return [*out, figure("cost.peak_memory", None, "MB", "not in the manifest")]


def evaluate_arrays(
    asset: FluidAsset,
    arrays: Arrays,
    manifest: Mapping[str, Any],
    case: Case,
    *,
    video: np.ndarray | None = None,
) -> Evaluation:
    """All figures of an asset and the arrays of its run. A figure that cannot be measured is None and says why.

    Args:
        asset: the product.
        arrays: of the run: labels u8 [T,H,W], front_depth f [H,W] (m), flow_raw and flow_completed f [T-1,H,W,2]
            (px/frame), flow_observed [T-1,H,W] (0 where filled in), first_frame, fit_frames [first, last), and of the
            re-simulation, whose index k shows frame first_frame + k: resim_flow f [K-1,H,W,2], resim_mask [K,H,W],
            resim_frames u8 [K,H,W,3], particle_volume [K] (m^3), leak_share [K]. The raster may differ from the
            truth's. Each may be missing.
        manifest: timings and peak memory.
        case: the truth.
        video: u8 [T,H,W,3], the clip that the asset was made of on the raster of resim_frames.
    """
    segmentation, series = score_segmentation(arrays, case)
    flow = score_flow(arrays, case)
    depth, scale, frame = score_depth(arrays, case)
    if scale is None:
        why = "no scale: " + depth[0].note
        names = ("geometry.occupancy_iou", "geometry.chamfer", "volume.overlap", "volume.relative_l2", "volume.cosine")
        space = [figure(n, None, "", why) for n in ("surface.velocity.error", *names, "parameters")]
    else:
        alignment = align(asset, case, scale, frame)
        space = score_surface_velocity(arrays, asset, case, alignment)
        space += score_bed(arrays, asset, case, alignment) + score_up(case, alignment)
        space += score_aligned(asset, case, alignment)
        space += score_volume(asset, case, alignment) + score_parameters(asset, case, alignment)
    pictures, more = score_resimulation(arrays, case, video)
    figures = [*segmentation, *flow, *depth, *space, *score_divergence(asset), *pictures]
    figures += [*score_conservation(arrays, case), *score_cost(manifest)]
    return Evaluation(case.name, tuple(figures), {**series, **more})


def read_video(path: Path, size: tuple[int, int]) -> np.ndarray:
    """u8 [T,h,w,3]: all frames of a clip, shrunk or enlarged to `size` (width, height)."""
    import cv2

    from fluidlift.io.video import read_clip

    frames = read_clip(path, max_size=1 << 14).frames
    if (frames.shape[2], frames.shape[1]) == size:
        return frames
    way = cv2.INTER_AREA if size[0] < frames.shape[2] else cv2.INTER_LINEAR
    return np.stack([cv2.resize(f, size, interpolation=way) for f in frames])


def evaluate_asset(folder: Path, truth: Path) -> Evaluation:
    """Score an asset folder against a case folder.

    Args:
        folder: the asset; its folder `work` holds the arrays of the run (`arrays_of_run`).
        truth: the case; see `read_case`.

    Raises:
        InputRejected: the asset or the case cannot be read. A missing folder `work` only leaves figures out.
    """
    from fluidlift.io.asset_folder import load_asset

    folder = Path(folder)
    case = read_case(Path(truth))
    asset = load_asset(folder)
    manifest = read_json(folder / "manifest.json")
    arrays = arrays_of_run(folder, manifest)
    frames, _ = picked(arrays, "resim_frames", 4, 3)
    # the asset may be of another clip of the same motion than that of the case
    video, _ = picked(arrays, "clip_frames", 4, 3)
    if frames is not None and video is None:
        try:
            video = read_video(case.video, (frames.shape[2], frames.shape[1]))
        except FluidliftError:
            video = None  # the pictures are then not scored, and the figure says so
    return evaluate_arrays(asset, arrays, manifest, case, video=video)
