"""The stage that turns flow into velocities: completed flow, surface and volume velocity of the target frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fluidlift.io.footage_file import MOST_FRAMES
from fluidlift.motion.steady_flow import pairs_of, spans_of
from fluidlift.physics.boundaries import continued
from fluidlift.pipeline.settings import MotionSettings
from fluidlift.pipeline.volume_motion import (
    motion_options,
    motion_scene,
    motion_warnings,
    plain_report,
    seen_beside,
    seen_cells,
)
from fluidlift.pipeline.work import Work
from fluidlift.scene.build import first_of_film
from fluidlift.types import FaceVelocity, FilmedMotion, kind_of
from fluidlift.types.fluid_masks import FluidMasks
from fluidlift.types.stages import Flow, Geometry, Motion, Read, Segmentation, TargetVelocity

if TYPE_CHECKING:
    from fluidlift.motion.sequence import FrameMotion, MotionOptions, MotionScene


def motion(
    read: Read, flow: Flow, segmentation: Segmentation, geometry: Geometry, config: MotionSettings, *, work: Work
) -> Motion:
    """Completed flow of many frames, volume velocity of the target frames."""
    from fluidlift.motion.sequence import motion_sequence

    clip, (width, height) = read.clip, read.clip.size
    pairs, grid, masks = len(clip) - 1, geometry.grid, FluidMasks(segmentation.labels.labels, geometry.hidden)
    start = min(geometry.rest_frame, pairs - 1)
    stands = kind_of(geometry.kind).starts_at_rest  # its body is known as it stands, not as it collapses
    targets = range(start, start if stands else min(start + config.targets, pairs))
    film = _frames_of_film(geometry, pairs) if config.every_frame else range(0)
    wanted = sorted({start, *targets, *film} | set(range(0, pairs, config.complete_every)))
    spans = spans_of(clip)
    completed = work.scratch.array("completed", (pairs, height, width, 2), np.float16)
    observed = work.scratch.array("observed", (pairs, height, -(-width // 8)), np.uint8)
    for t in range(pairs):
        completed[t] = np.nan
    found: list[TargetVelocity] = []
    seen: list[FrameMotion] = []
    filmed: dict[int, FaceVelocity] = {}
    scene, options = motion_scene(clip, geometry), motion_options(config)
    seen_flow = seen_beside(pairs_of(clip, flow.flow), geometry)
    for frame in motion_sequence(
        seen_flow, masks.__getitem__, pairs, scene, options, frames=wanted, volume_frames={*targets, *film}
    ):
        work.step(wanted.index(frame.frame), len(wanted))
        completed[frame.frame] = spans[frame.frame] * frame.displacement
        observed[frame.frame] = np.packbits(frame.observed, axis=-1)
        if frame.velocity is None or frame.surface is None:
            continue
        velocity = FaceVelocity(*(component.astype(np.float32) for component in frame.velocity.components))
        if frame.frame in film:
            filmed[frame.frame] = continued(velocity, geometry.setting.cell_types)
        if frame.frame not in targets:
            continue
        wet = masks[frame.frame]
        share = float(frame.observed[wet].mean()) if wet.any() else None
        cells = seen_cells(frame.surface, grid)
        found.append(TargetVelocity(frame.frame, velocity, cells, share, plain_report(frame)))
        seen.append(frame)
    if stands:
        still = FaceVelocity(*(c.astype(np.float32) for c in FaceVelocity.zeros(grid).components))
        found.append(TargetVelocity(start, still, np.zeros(grid.shape, bool)))
    shares = [s.free_fall_share for s in seen if s.free_fall_share is not None]
    factors = [s.front_factor for s in seen if s.front_factor is not None]
    fast = float(max(shares, default=0.0))
    return Motion(
        targets=tuple(found),
        completed=completed,
        observed_bits=observed,
        front_factor=float(np.median(factors)) if factors else 1.0,
        free_fall_share=fast,
        filmed=_film_of(filmed, film, start, clip.interval),
        mean=_mean_velocity(masks[start], geometry, scene, options) if config.of_whole else None,
        warnings=tuple(motion_warnings([t.plain() for t in found], geometry.kind, fast)),
    )


def _mean_velocity(
    mask: np.ndarray, geometry: Geometry, scene: MotionScene, options: MotionOptions
) -> FaceVelocity | None:
    """Of what the fluid does all the time, m/s; None of a kind whose motion does not last."""
    from fluidlift.motion.sequence import mean_velocity

    kind = kind_of(geometry.kind)
    if not (kind.is_channel_flow and kind.has_mean_motion):
        return None
    found = mean_velocity(mask, scene, options)
    return None if found is None else FaceVelocity(*(c.astype(np.float32) for c in found.components))


def _frames_of_film(geometry: Geometry, pairs: int) -> range:
    """Those whose motion can guide a simulation: of what runs in a channel, where its surface's film is."""
    if not kind_of(geometry.kind).is_channel_flow:
        return range(0)
    first = first_of_film(geometry.rest_frame, pairs + 1)
    return range(min(first, pairs - 1), min(first + MOST_FRAMES, pairs))


def _film_of(velocities: dict[int, FaceVelocity], film: range, start: int, interval: float) -> FilmedMotion | None:
    """The velocities (m/s) of these frames; one without fluid moves as the known one before it, or the first."""
    if not velocities:
        return None
    known = sorted(velocities)
    each = [velocities[max((k for k in known if k <= t), default=known[0])].components for t in film]
    u, v, w = (np.stack(c).astype(np.float16) for c in zip(*each))
    return FilmedMotion(u, v, w, interval, start - film.start)
