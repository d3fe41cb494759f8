"""The steps from two frames to a velocity on the grid, one after the other, against the truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from motion_subjects import Subject, Truth, true_layout

from fluidlift.evaluate.volumes import behind, field_cosine, in_picture, relative_l2
from fluidlift.motion.direction import mainstream_direction
from fluidlift.motion.lift import depth_change, lift_flow
from fluidlift.motion.mainstream import complete_flow
from fluidlift.motion.optical_flow import DenseInverseSearch, Farneback, mean_flow
from fluidlift.motion.screen_divergence import project_screen_divergence
from fluidlift.motion.sequence import MotionScene, motion_sequence
from fluidlift.motion.volume import volume_velocity
from fluidlift.types import CellType, PixelFlow, SurfaceMotion

STEPS = ("Farneback", "DIS", "multiframe", "confidence", "mainstream", "projection", "as made")
HALF_WINDOW = 2
"""frames on either side, as in the pipeline"""
SLOWEST = 0.1
"""px/frame: slower truth has no direction worth scoring"""
FAILED_PX, FAILED_SHARE = 1.0, 0.5
"""raw flow has failed where its error is above both, px and share of the true speed"""
KEPT = 4
"""frames of a clip that are measured"""


@dataclass
class Pixels:
    """What was found at the fluid pixels of the measured frames, one entry per pixel."""

    truth: list[np.ndarray] = field(default_factory=list)
    observed: list[np.ndarray] = field(default_factory=list)
    found: dict[str, list[np.ndarray]] = field(default_factory=lambda: {name: [] for name in STEPS})


def measured_frames(pairs: int) -> list[int]:
    """A few frames spread evenly over the clip, far enough from its ends for a whole window."""
    low, high = HALF_WINDOW, max(pairs - 1 - HALF_WINDOW, HALF_WINDOW)
    return sorted({int(round(x)) for x in np.linspace(low, high, KEPT)})


def planar_steps(subject: Subject, truth: Truth, flow: PixelFlow, t: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Displacement [H,W,2] of frame t after each step, and which pixels count as observed."""
    frames, mask, depth = truth.frames, truth.mask[t], truth.depth[t]
    found = {
        "Farneback": Farneback().displacement(frames[t], frames[t + 1]),
        "DIS": DenseInverseSearch().displacement(frames[t], frames[t + 1]),
    }
    found["multiframe"] = flow.displacement[t]
    part = slice(max(t - HALF_WINDOW, 0), t + HALF_WINDOW + 1)
    mean, trust = mean_flow(PixelFlow(flow.displacement[part], flow.confidence[part]), mask)
    found["confidence"] = mean
    direction = mainstream_direction(mean, trust, mask)
    full, observed = complete_flow(mean, trust, mask, direction, np.where(mask, depth, 1.0))
    found["mainstream"] = full
    rate = depth_change(full, mask, depth, truth.depth[t + 1], mask_t1=truth.mask[t + 1])
    found["projection"], _ = project_screen_divergence(
        full, mask, observed, np.where(mask, depth, 1.0), rate, truth.camera
    )
    scene = MotionScene(
        truth.camera, depth, None, None, subject.kind, truth.case.interval, prior=clip_mean(truth, flow)
    )
    made = next(
        iter(
            motion_sequence(
                lambda a, b: PixelFlow(flow.displacement[a:b], flow.confidence[a:b]),
                lambda k: truth.mask[k], len(flow), scene, frames=[t], volume_frames=[],
            )
        )
    )  # fmt: skip
    found["as made"] = made.displacement
    return found, made.observed


def clip_mean(truth: Truth, flow: PixelFlow) -> tuple[np.ndarray, np.ndarray]:
    """Mean motion of the clip and its confidence, as the pipeline's geometry hands it on to the motion."""
    return mean_flow(flow, truth.mask[: len(flow)])


def add_frame(pixels: Pixels, truth: Truth, t: int, found: dict[str, np.ndarray], observed: np.ndarray) -> None:
    """Keep the pixels of frame t that count."""
    at = truth.mask[t] & truth.rows[:, None]
    pixels.truth.append(truth.flow[t][at])
    pixels.observed.append(observed[at])
    for name, displacement in found.items():
        pixels.found[name].append(np.asarray(displacement, np.float32)[at])


def planar_figures(pixels: Pixels) -> dict[str, Any]:
    """Errors of every step over all pixels, where flow was called failed, and where it truly failed."""
    true, observed = np.concatenate(pixels.truth).astype(np.float64), np.concatenate(pixels.observed)
    speed = np.linalg.norm(true, axis=-1)
    found = {name: np.concatenate(parts).astype(np.float64) for name, parts in pixels.found.items() if parts}
    error = {name: np.linalg.norm(d - true, axis=-1) for name, d in found.items()}
    failed = error["DIS"] > np.maximum(FAILED_PX, FAILED_SHARE * speed)
    moving = speed > SLOWEST
    out: dict[str, Any] = {
        "pixels": len(true), "speed_px": float(speed.mean()),
        "shares": {
            "filled": float((~observed).mean()), "failed": float(failed.mean()),
            "failed_and_filled": _share(failed & ~observed, failed),
        },
        "steps": {},
    }  # fmt: skip
    for name, e in error.items():
        length = np.maximum(np.linalg.norm(found[name], axis=-1) * speed, 1e-12)
        cosine = (found[name] * true).sum(axis=-1) / length
        out["steps"][name] = {
            "epe": float(e.mean()), "p90": float(np.percentile(e, 90)), "cosine": float(cosine[moving].mean()),
            "gain": gain(found[name], true), "of_farneback": float(e.mean() / max(error["Farneback"].mean(), 1e-9)),
            "observed": _mean(e, observed), "filled": _mean(e, ~observed), "good": _mean(e, ~failed),
            "failed": _mean(e, failed),
        }  # fmt: skip
    return out


def gain(found: np.ndarray, true: np.ndarray) -> float:
    """Share of the true motion that was found: the factor of the truth nearest to what was found."""
    return float((found * true).sum() / max(float((true * true).sum()), 1e-12))


def surface_figures(truth: Truth, t: int, displacement: np.ndarray, observed: np.ndarray) -> dict[str, np.ndarray]:
    """Found and true velocity (m/s) of the surface of frame t with true depth and camera, on the rows that count."""
    m = truth.mask[t]
    lifted = lifted_surface(truth, t, displacement, observed)
    _, true = truth.velocity(t)
    counted = np.broadcast_to(truth.rows[:, None], m.shape)[m]
    return {"found": lifted.velocities[counted], "true": true[counted]}


def lifted_surface(truth: Truth, t: int, displacement: np.ndarray, observed: np.ndarray) -> SurfaceMotion:
    """The public lift with true masks, depths and camera."""
    m, n = truth.mask[t], truth.mask[t + 1]
    before, after = np.where(m, truth.depth[t], 0.0), np.where(n, truth.depth[t + 1], 0.0)
    return lift_flow(displacement, observed, m, before, after, truth.camera, truth.case.interval, mask_t1=n)


def surface_summary(parts: list[dict[str, np.ndarray]]) -> dict[str, float]:
    """Mean error in m/s and relative to the mean true speed, and the share of the true motion found."""
    found, true = (np.concatenate([p[k] for p in parts]).astype(np.float64) for k in ("found", "true"))
    error, speed = np.linalg.norm(found - true, axis=-1).mean(), np.linalg.norm(true, axis=-1).mean()
    return {
        "error_m_s": float(error), "speed_m_s": float(speed), "relative": float(error / speed),
        "gain": gain(found, true),
    }  # fmt: skip


def volume_figures(subject: Subject, truth: Truth, key: int, surfaces: dict[str, SurfaceMotion]) -> dict[str, Any]:
    """Volume velocity on the case's own grid and cells from each of the surface motions."""
    case = truth.case
    terrain, types = true_layout(subject, case, key)
    centers = case.grid.centers().reshape(-1, 3)
    hidden = behind(centers, case.static_depth, case.camera, case.grid.spacing)
    counted = (in_picture(centers, case.camera) & ~hidden).reshape(case.grid.shape)
    counted &= case.occupied(key) & np.isin(types, (CellType.FLUID, CellType.INFLOW))
    true = case.velocity[key][counted].astype(np.float64)
    out = {}
    for name, surface in surfaces.items():
        velocity, report = volume_velocity(
            surface, terrain, types, case.grid, kind=subject.kind, mainstream=terrain.mainstream
        )
        found = velocity.at_centers()[counted].astype(np.float64)
        out[name] = {
            "relative_l2": relative_l2(found, true), "cosine": field_cosine(found, true), "gain": gain(found, true),
            "divergence_max": report.divergence_max, "divergence_mean": report.divergence_mean,
            "flux_in": report.flux_in, "flux_out": report.flux_out, "flux_surface": report.flux_surface,
        }  # fmt: skip
    return out


def _mean(values: np.ndarray, where: np.ndarray) -> float | None:
    return float(values[where].mean()) if where.any() else None


def _share(part: np.ndarray, whole: np.ndarray) -> float | None:
    return float(part.sum() / whole.sum()) if whole.any() else None
