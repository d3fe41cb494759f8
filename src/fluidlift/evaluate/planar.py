"""Figures of pictures: segmentation, planar velocity, re-simulation. From arrays of a run and the truth of a case."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fluidlift.evaluate.case import Case
from fluidlift.evaluate.images import (
    end_point_error,
    end_point_percentile,
    mask_iou,
    mean_cosine,
    psnr,
    resample_nearest,
    ssim,
)
from fluidlift.evaluate.report import Metric, figure
from fluidlift.types import Label

EQUAL_DB = 99.0
"""PSNR of equal pictures, so that means stay finite"""

Arrays = Mapping[str, np.ndarray]
Series = dict[str, tuple[float, ...]]


def picked(arrays: Arrays, name: str, dimensions: int, last: int | None = None) -> tuple[np.ndarray | None, str]:
    """The array if it is there and has the right shape, and otherwise None and the reason."""
    array = arrays.get(name)
    if array is None:
        return None, f"the run has no '{name}'"
    if array.ndim != dimensions or (last is not None and array.shape[-1] != last) or array.size == 0:
        return None, f"'{name}' has shape {array.shape}"
    return array, ""


def number(arrays: Arrays, name: str, default: int) -> int:
    """One whole number of the run."""
    array = arrays.get(name)
    return default if array is None or np.size(array) != 1 else int(np.asarray(array).reshape(()))


def truth_mask(case: Case, frames: slice, size: tuple[int, int]) -> np.ndarray:
    """bool [n,h,w] on the raster of the run."""
    return resample_nearest(case.mask[frames], size)


def truth_flow(case: Case, frames: slice, size: tuple[int, int]) -> np.ndarray:
    """float32 [n,h,w,2] in px/frame of the raster of the run."""
    flow = resample_nearest(case.flow[frames], size, axes=(-3, -2)).astype(np.float32)
    return flow * np.array([size[0] / case.size[0], size[1] / case.size[1]], np.float32)


def score_segmentation(arrays: Arrays, case: Case) -> tuple[list[Metric], Series]:
    """Mask IoU of the labels of the clip."""
    labels, why = picked(arrays, "labels", 3)
    if labels is None:
        return [figure("segmentation.iou", None, "", why)], {}
    n = min(len(labels), len(case))
    size = (labels.shape[2], labels.shape[1])
    iou = mask_iou(labels[:n] == Label.FLUID, truth_mask(case, slice(0, n), size))
    return [
        figure("segmentation.iou", iou.mean(), "", f"mean of {n} frames"),
        figure("segmentation.iou_worst", iou.min(), "", "worst frame"),
    ], {"segmentation.iou": tuple(iou.tolist())}


def _scored_pixels(arrays: Arrays, case: Case, start: int, n: int, size: tuple[int, int]) -> np.ndarray:
    """bool [n,h,w]: fluid in the truth and, where the run says so, in the run."""
    mask = truth_mask(case, slice(start, start + n), size)
    labels, _ = picked(arrays, "labels", 3)
    if labels is not None and len(labels) >= start + n:
        mask = mask & resample_nearest(labels[start : start + n] == Label.FLUID, size)
    return mask


def score_flow(arrays: Arrays, case: Case) -> list[Metric]:
    """End-point error (mean, 90th percentile) and cosine of the raw, the completed and the re-simulated velocity.

    Raw and completed flow are scored where truth and run both say fluid (segmentation is scored by itself),
    the re-simulation where truth and re-simulation are both fluid; `share` says how much of the truth that is.
    The completed flow is also scored apart where it was observed and where it was filled in.

    Args:
        arrays: of the run.
        case: the truth.
    """
    out = []
    first = number(arrays, "first_frame", 0)
    for name, start, group in (
        ("flow_raw", 0, "flow.raw"),
        ("flow_completed", 0, "flow.completed"),
        ("resim_flow", first, "flow.resimulated"),
    ):
        flow, why = picked(arrays, name, 4, 2)
        n = 0 if flow is None else min(len(flow), len(case) - start)
        if flow is None or n <= 0:
            keys = ("epe", "epe_p90", "cosine", "share")
            out += [figure(f"{group}.{k}", None, "", why or "no common frames") for k in keys]
            continue
        size = (flow.shape[2], flow.shape[1])
        fluid = truth_mask(case, slice(start, start + n), size)
        mask = _scored_pixels(arrays, case, start, n, size)
        shown, _ = picked(arrays, "resim_mask", 3)
        if name == "resim_flow":
            mask = fluid if shown is None or len(shown) < n else fluid & resample_nearest(shown[:n].astype(bool), size)
        finite = np.isfinite(flow[:n]).all(-1)
        mask = mask & finite
        truth = truth_flow(case, slice(start, start + n), size)
        mean = float(np.linalg.norm(truth[mask], axis=-1).mean()) if mask.any() else 0.0
        note = f"{n} frames; the truth moves {mean:.2f} px/frame"
        out.append(figure(f"{group}.epe", end_point_error(flow[:n], truth, mask), "px/frame", note))
        out.append(
            figure(f"{group}.epe_p90", end_point_percentile(flow[:n], truth, mask), "px/frame", "90 % lie below")
        )
        out.append(figure(f"{group}.cosine", mean_cosine(flow[:n], truth, mask)))
        out.append(figure(f"{group}.share", mask.sum() / max(fluid.sum(), 1), "", "of the truth's fluid pixels scored"))
        if name == "flow_completed":
            out += _observed_and_filled(arrays, flow[:n], truth, mask)
    return out


def _observed_and_filled(arrays: Arrays, flow: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> list[Metric]:
    """Error of the completed flow apart where it was observed and where it was filled in."""
    names = tuple(f"flow.completed.{k}" for k in ("epe_observed", "epe_filled", "filled_share"))
    observed, why = picked(arrays, "flow_observed", 3)
    if observed is not None and (len(observed) < len(flow) or observed.shape[1:] != flow.shape[1:3]):
        observed, why = None, f"'flow_observed' has shape {observed.shape}"
    if observed is None:
        return [figure(k, None, "", why) for k in names]
    seen = mask & observed[: len(flow)].astype(bool)
    filled = mask & ~seen
    none = "no such pixel"
    return [
        figure(names[0], end_point_error(flow, truth, seen), "px/frame", "" if seen.any() else none),
        figure(names[1], end_point_error(flow, truth, filled), "px/frame", "" if filled.any() else none),
        figure(names[2], filled.sum() / max(mask.sum(), 1), "", "of the scored pixels took their neighbours' motion"),
    ]


def _windows(arrays: Arrays, first: int, n: int) -> dict[str, np.ndarray]:
    """bool [n] of the re-simulated frames inside the fitted window and beyond it."""
    window = arrays.get("fit_frames")
    if window is None or np.size(window) != 2:
        return {"all": np.ones(n, bool)}
    frame = first + np.arange(n)
    low, high = (int(x) for x in np.ravel(window))
    return {"fitted": (frame >= low) & (frame < high), "predicted": frame >= high}


def score_resimulation(arrays: Arrays, case: Case, video: np.ndarray | None) -> tuple[list[Metric], Series]:
    """Mask IoU, PSNR and SSIM per frame of the re-simulation, inside the fitted window and beyond it.

    Args:
        arrays: of the run. `resim_*[k]` shows frame `first_frame` + k; `fit_frames` is [first, last).
        case: the truth.
        video: u8 [T,h,w,3] of the clip on the raster of the re-simulation; None where it cannot be read.
    """
    out: list[Metric] = []
    series: Series = {}
    first = number(arrays, "first_frame", 0)
    measured: dict[str, tuple[np.ndarray, str]] = {}
    mask, why_mask = picked(arrays, "resim_mask", 3)
    if mask is not None and (n := min(len(mask), len(case) - first)) > 0:
        size = (mask.shape[2], mask.shape[1])
        measured["mask_iou"] = (mask_iou(mask[:n].astype(bool), truth_mask(case, slice(first, first + n), size)), "")
    frames, why = picked(arrays, "resim_frames", 4, 3)
    if frames is not None and video is not None and frames.shape[1:] == video.shape[1:]:
        n = max(min(len(frames), len(video) - first, len(case) - first), 0)
        fluid = truth_mask(case, slice(first, first + n), (frames.shape[2], frames.shape[1]))
        pairs = [(frames[k], video[first + k]) for k in range(n)]
        measured["psnr"] = (np.array([min(psnr(a, b), EQUAL_DB) for a, b in pairs]), "dB")
        measured["psnr_fluid"] = (np.array([min(psnr(a, b, m), EQUAL_DB) for (a, b), m in zip(pairs, fluid)]), "dB")
        measured["ssim"] = (np.array([ssim(a, b) for a, b in pairs]), "")
    elif frames is not None:
        why = "the clip of the case cannot be compared" if video is None else f"pictures {frames.shape[1:3]} of the run"
    for name in ("mask_iou", "psnr", "psnr_fluid", "ssim"):
        values, unit = measured.get(name, (np.zeros(0), ""))
        if len(values) == 0:
            reason = (why_mask if name == "mask_iou" else why) or "no common frames"
            out.append(figure(f"resimulation.{name}", None, "", reason))
            continue
        series[f"resimulation.{name}"] = tuple(values.tolist())
        for window, inside in _windows(arrays, first, len(values)).items():
            chosen = values[inside & np.isfinite(values)]
            note = f"mean of {len(chosen)} frames" if len(chosen) else f"no {window} frames"
            out.append(figure(f"resimulation.{name}.{window}", chosen.mean() if len(chosen) else None, unit, note))
    return out, series


def score_conservation(arrays: Arrays, case: Case) -> list[Metric]:
    """Volume drift and leakage of the re-simulation's particles."""
    out = []
    volume, why = picked(arrays, "particle_volume", 1)
    if volume is None or volume[0] <= 0:
        out.append(figure("resimulation.volume_drift", None, "", why or "no particles at the start"))
    else:
        drift = volume.astype(np.float64) / float(volume[0]) - 1
        counts = np.array([case.occupied(k).sum() for k in range(len(case.key_frames))], float)
        change = f"; the truth's own is {counts[-1] / counts[0] - 1:+.3f}" if counts[0] > 0 and len(counts) > 1 else ""
        out.append(figure("resimulation.volume_drift", drift[-1], "", f"last frame over first, minus 1{change}"))
        out.append(figure("resimulation.volume_drift_worst", np.abs(drift).max(), "", "largest magnitude"))
    leak, why = picked(arrays, "leak_share", 1)
    out.append(
        figure("resimulation.leak_share", None if leak is None else leak.max(), "", why or "largest share of particles")
    )
    return out
