"""How the motion in the volume is asked for, and what is told of it: what `make` and `fluidlift motion` share."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.messages import Notice
from fluidlift.pipeline.settings import MotionSettings
from fluidlift.shape.airborne import MOUTH, nozzle_radius
from fluidlift.shape.jet_column import Jet
from fluidlift.shape.occluders import near_occluders
from fluidlift.types import Grid, PixelFlow, SurfaceMotion, VideoClip, kind_of
from fluidlift.types.stages import Geometry

if TYPE_CHECKING:
    from fluidlift.motion.sequence import FlowReader, FrameMotion, MotionOptions, MotionScene
    from fluidlift.motion.thrown_up import Flight

MEAN_RISE = 0.93
"""height of the mean drop of a fountain over that of its outline, which the highest ones make: where speeds differ by
`stages.fit.SCATTER` heights do by twice that, and the highest of some hundred drops is 2 deviations above the mean (0.7
to 0.8 in four made ones, whose drops differ more)"""
FAST_FALL = 0.3
"""share of the steep part whose speed is that of free fall, from which the user is told"""
LITTLE_SEEN = 0.25
"""share of the fluid below which the result is more the completion's than the clip's, and the user is told"""
WAVES = 0.5
"""share of the seen speed that circulates, below which the user is told that the rest counts as waves"""
DISAGREEMENT = 0.5
"""share by which the projection changes what was seen on the surface, from which the user is told"""


def motion_scene(clip: VideoClip, geometry: Geometry) -> MotionScene:
    """Where the fluid is."""
    from fluidlift.motion.sequence import MotionScene

    g, setting = geometry, geometry.setting
    trust = g.mean_confidence
    if g.hidden is not None:
        trust = np.where(near_occluders(g.hidden), np.float32(0), trust)
    return MotionScene(
        g.camera, g.sighted_depth, setting.terrain, setting.cell_types, g.kind, clip.interval, setting.surface_height,
        setting.held_below, flights=flights_of(geometry), prior=(g.mean_flow, trust),
        slope_error=0.0 if g.slope is None else float(np.tan(np.radians(min(g.slope.error, 45.0)))),
    )  # fmt: skip


def flights_of(geometry: Geometry) -> tuple[Flight, ...]:
    """How the columns of a fountain fly, m."""
    from fluidlift.motion.thrown_up import Flight

    setting, found = geometry.setting, []
    if setting.surface_height is None:
        return ()
    grid = setting.terrain.grid
    for jet in (Jet.from_dict(plain) for plain in geometry.jets):
        if jet.nozzle is None:
            continue
        column = np.clip(grid.cell_of(np.array([[*jet.axis, grid.low[2]]]))[0, :2], 0, np.array(grid.shape[:2]) - 1)
        level = float(np.asarray(setting.surface_height)[tuple(column)])
        narrow, wide = nozzle_radius(jet, grid.spacing), float(jet.radius.max())
        mouth = level + MOUTH * grid.spacing
        height = max(MEAN_RISE * (jet.top - mouth), grid.spacing)
        found.append(Flight(jet.nozzle, jet.axis, mouth, height, narrow, max(wide, narrow)))
    return tuple(found)


def seen_beside(flow: FlowReader, geometry: Geometry) -> FlowReader:
    """The flow as a person says that it runs, and without confidence where something before the fluid moves, or stands,
    in its place."""
    said, hidden = geometry.said_flow, geometry.hidden
    if hidden is None and said is None:
        return flow
    near = None if hidden is None else near_occluders(hidden)

    def read(first: int, last: int) -> PixelFlow:
        found = flow(first, last)
        found = found if said is None else said.turned(found)
        if near is None:
            return found
        return PixelFlow(found.displacement, np.where(near, np.float32(0), found.confidence))

    return read


def motion_options(config: MotionSettings) -> MotionOptions:
    """How the motion is estimated, from the settings."""
    from fluidlift.motion.sequence import MotionOptions

    return MotionOptions(
        half_window=config.half_window, reach=max(config.reach, config.half_window), along_paths=config.along_paths,
        filling=config.filling, divergence=config.divergence, constraint=config.constraint, wall=config.wall,
    )  # fmt: skip


def motion_warnings(reports: list[dict[str, Any]], kind: str, free_fall_share: float) -> list[Notice]:
    """What the user should know of the velocities."""
    warnings = []
    stuck = [r["frame"] for r in reports if not r.get("solve", {}).get("converged", True)]
    if stuck:
        warnings.append(
            Notice(
                "solve-not-converged",
                "the divergence-free solve of the target velocity did not converge on every frame: "
                f"{len(stuck)} of {len(reports)}, the first is {stuck[0]}",
            )
        )
    shares = [r["observed_share"] for r in reports if r.get("observed_share") is not None]
    if shares and np.median(shares) < LITTLE_SEEN:
        warnings.append(
            Notice(
                "little-motion-seen",
                f"the motion was measured on {100 * np.median(shares):.0f} % of the fluid only; the rest is filled in: "
                "speeds there are a guess; look at observed/ of fluidlift motion, and at a larger --max-size, "
                "more texture "
                "or a higher frame rate",
            )
        )
    changes = [r["change_observed"] for r in reports if "change_observed" in r]
    if changes and np.median(changes) > DISAGREEMENT:
        warnings.append(
            Notice(
                "discharge-disagrees",
                "the shape and the measured motion do not agree on one discharge: velocities of the seen surface were "
                "changed by more than half",
            )
        )
    circulating = [r["circulating"] for r in reports if r.get("circulating") is not None]
    if circulating and np.median(circulating) < WAVES:
        # of a fountain it is its pool that is seen from above; what is in the air is thrown, and simulated
        pool = kind_of(kind).rises_from_pool
        where, calm = (f"pool of the {kind}", "that and what falls into it") if pool else (kind, "that")
        warnings.append(
            Notice(
                "waves-not-simulated",
                f"what is seen to move over the {where} is taken for waves: only "
                f"{100 * np.median(circulating):.0f} % of its speed can be water that circulates within its outline; "
                f"it is simulated calm but for {calm}, and the film on its surface shows the waves",
            )
        )
    if free_fall_share > FAST_FALL:
        warnings.append(
            Notice(
                "speed-from-free-fall",
                f"the {kind} moves faster than optical flow can follow: on {100 * free_fall_share:.0f} % of its "
                f"steep part "
                "the speed comes from free fall at the given size",
            )
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
