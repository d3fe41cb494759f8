"""The stage that turns flow into velocities: completed flow, surface and volume velocity of the target frames."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.pipeline.body import camera_of, setting_of
from fluidlift.pipeline.reading import clip_of, spans_of
from fluidlift.pipeline.seeing import masks_of, pairs_of
from fluidlift.pipeline.story import Result, Story
from fluidlift.types import FaceVelocity, Grid, SurfaceMotion, kind_of

if TYPE_CHECKING:
    from fluidlift.motion.sequence import FrameMotion, MotionOptions, MotionScene

FAST_FALL = 0.3
"""share of the steep part whose speed is that of free fall, from which the user is told"""
LITTLE_SEEN = 0.25
"""share of the fluid below which the result is more the completion's than the clip's, and the user is told"""
DISAGREEMENT = 0.5
"""share by which the projection changes what was seen on the surface, from which the user is told"""


def motion(story: Story, config: JobConfig) -> Result:
    """Completed flow of many frames, volume velocity of the target frames."""
    from fluidlift.motion.sequence import motion_sequence

    g, (width, height) = story["geometry"], clip_of(story).size
    pairs, grid = len(clip_of(story)) - 1, setting_of(story).terrain.grid
    start = min(g.meta["rest_frame"], pairs - 1)
    stands = kind_of(g.meta["kind"]).starts_at_rest  # its body is known as it stands, not as it collapses
    targets = range(start, start if stands else min(start + config.motion.targets, pairs))
    wanted = sorted({start, *targets} | set(range(0, pairs, config.motion.complete_every)))
    spans = spans_of(clip_of(story))
    completed = story.scratch.array("completed", (pairs, height, width, 2), np.float16)
    observed = story.scratch.array("observed", (pairs, height, -(-width // 8)), np.uint8)
    for t in range(pairs):
        completed[t] = np.nan
    arrays: dict[str, np.ndarray] = {"completed": completed, "observed": observed}
    reports: list[dict[str, Any]] = []
    seen: list[FrameMotion] = []
    for found in motion_sequence(
        pairs_of(story), masks_of(story).__getitem__, pairs, motion_scene(story), motion_options(config),
        frames=wanted, volume_frames=targets,
    ):  # fmt: skip
        story.step(wanted.index(found.frame), len(wanted))
        completed[found.frame] = spans[found.frame] * found.displacement
        observed[found.frame] = np.packbits(found.observed, axis=-1)
        if found.velocity is None or found.surface is None:
            continue
        for name, component in zip("uvw", found.velocity.components):
            arrays[f"target_{len(reports):03d}_{name}"] = component.astype(np.float32)
        arrays[f"target_{len(reports):03d}_seen"] = np.packbits(seen_cells(found.surface, grid), axis=-1)
        wet = masks_of(story)[found.frame]
        share = float(found.observed[wet].mean()) if wet.any() else None
        reports.append({"frame": found.frame, "observed_share": share, **plain_report(found)})
        seen.append(found)
    if stands:
        _add_rest(arrays, grid)
        reports.append({"frame": start})
    shares = [s.free_fall_share for s in seen if s.free_fall_share is not None]
    factors = [s.front_factor for s in seen if s.front_factor is not None]
    return Result(
        arrays,
        {
            "warnings": motion_warnings(reports, g.meta["kind"], max(shares, default=0.0)),
            "targets": [r["frame"] for r in reports],
            "reports": reports,
            "front_factor": float(np.median(factors)) if factors else 1.0,
            "free_fall_share": float(max(shares, default=0.0)),
        },
    )


def _add_rest(arrays: dict[str, np.ndarray], grid: Grid) -> None:
    """The target velocity of a fluid at rest."""
    for name, component in zip("uvw", FaceVelocity.zeros(grid).components):
        arrays[f"target_000_{name}"] = component.astype(np.float32)
    arrays["target_000_seen"] = np.packbits(np.zeros(grid.shape, bool), axis=-1)


def motion_scene(story: Story) -> MotionScene:
    """Where the fluid is, from the geometry."""
    from fluidlift.motion.sequence import MotionScene

    setting, g = setting_of(story), story["geometry"]
    return MotionScene(
        camera_of(story), g.arrays["sighted_depth"], setting.terrain, setting.cell_types, g.meta["kind"],
        clip_of(story).interval, setting.surface_height, setting.pool_level,
        prior=(g.arrays["mean_flow"], g.arrays["mean_confidence"]),
    )  # fmt: skip


def motion_options(config: JobConfig) -> MotionOptions:
    """How the motion is estimated, from the settings."""
    from fluidlift.motion.sequence import MotionOptions

    m = config.motion
    return MotionOptions(
        half_window=m.half_window, reach=max(m.reach, m.half_window), along_paths=m.along_paths,
        divergence=m.divergence, wall=m.wall,
    )  # fmt: skip


def motion_warnings(reports: list[dict[str, Any]], kind: str, free_fall_share: float) -> list[str]:
    """What the user should know of the velocities."""
    warnings = []
    stuck = [r["frame"] for r in reports if not r.get("solve", {}).get("converged", True)]
    if stuck:
        warnings.append(
            "the divergence-free solve of the target velocity did not converge on every frame: "
            f"{len(stuck)} of {len(reports)}, the first is {stuck[0]}"
        )
    shares = [r["observed_share"] for r in reports if r.get("observed_share") is not None]
    if shares and np.median(shares) < LITTLE_SEEN:
        warnings.append(
            f"the motion was measured on {100 * np.median(shares):.0f} % of the fluid only; the rest is filled in: "
            "speeds there are a guess; look at observed/ of fluidlift motion, and at a larger --max-size, more texture "
            "or a higher frame rate"
        )
    changes = [r["change_observed"] for r in reports if "change_observed" in r]
    if changes and np.median(changes) > DISAGREEMENT:
        warnings.append(
            "the shape and the measured motion do not agree on one discharge: velocities of the seen surface were "
            "changed by more than half"
        )
    if free_fall_share > FAST_FALL:
        warnings.append(
            f"the {kind} moves faster than optical flow can follow: on {100 * free_fall_share:.0f} % of its steep part "
            "the speed comes from free fall at the given size"
        )
    return warnings


def plain_report(found: FrameMotion) -> dict[str, Any]:
    """The report of a frame's volume as plain values for JSON."""
    if found.report is None:
        return {}
    return {k: v for k, v in asdict(found.report).items() if isinstance(v, int | float | str | bool | dict)}


def seen_cells(surface: SurfaceMotion, grid: Grid) -> np.ndarray:
    """bool [nx,ny,nz]: cells in which a point of the surface was observed."""
    cells = np.zeros(grid.shape, bool)
    points = surface.points[surface.observed]
    points = points[grid.contains(points)]
    cells[tuple(grid.cell_of(points).T)] = True
    return cells


def targets_of(story: Story) -> list[FaceVelocity]:
    """Target velocities of consecutive frames."""
    a = story["motion"].arrays
    count = len(story["motion"].meta["targets"])
    return [FaceVelocity(*(a[f"target_{k:03d}_{name}"] for name in "uvw")) for k in range(count)]


def seen_of(story: Story) -> list[np.ndarray]:
    """bool [nx,ny,nz] of each target: cells in which the surface was observed."""
    a, nz = story["motion"].arrays, setting_of(story).terrain.grid.shape[2]
    count = len(story["motion"].meta["targets"])
    return [np.unpackbits(a[f"target_{k:03d}_seen"], axis=-1, count=nz).astype(bool) for k in range(count)]
