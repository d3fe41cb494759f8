"""`fluidlift motion`: how the fluid moves in every frame, as files that other tools read."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.output_files import Written, numbered
from fluidlift.messages import Notice, as_plain
from fluidlift.motion.steady_flow import pairs_of
from fluidlift.pipeline import begin
from fluidlift.pipeline.frame_files import FrameWriter, MotionFiles, WritingPlace
from fluidlift.pipeline.inputs import GivenFiles, Inputs
from fluidlift.pipeline.models import allowed_models, provenance_of
from fluidlift.pipeline.runner import Runner, gone_if_refused
from fluidlift.pipeline.settings import MotionSettings
from fluidlift.pipeline.volume_motion import motion_options, motion_scene, motion_warnings
from fluidlift.pipeline.work import Work
from fluidlift.seams import Progress, Silence
from fluidlift.types import kind_of
from fluidlift.types.fluid_masks import FluidMasks
from fluidlift.types.stages import Flow, Geometry, Read, Segmentation, VelocityFiles

MOTION_STAGES = ("read", "flow", "segment", "geometry", "velocities")

SPREAD_OF_FLUX = 0.5
"""difference of what flows in and out, relative to the smaller one, from which the user is told"""


def measure_motion(
    inputs: Inputs,
    folder: Path,
    config: JobConfig,
    *,
    files: MotionFiles | None = None,
    force: Iterable[str] = (),
    progress: Progress | None = None,
) -> Written:
    """Flow, surface velocity and volume velocity of every frame, without Gaussians, fit or simulation.

    Args:
        inputs: the clip and what the user adds to it.
        folder: to write; an earlier one is continued, frame by frame.
        config: of the job; read, segment, shape and motion count.
        files: which are written, and how.
        force: stages to run again, with all that come after.
        progress: where progress is told.

    Raises:
        InputRejected: an input that cannot be used, or a folder with other things in it.
    """
    from fluidlift.io.asset_folder import check_output_folder
    from fluidlift.io.atomic import write_json

    files = files or MotionFiles()
    began = time.perf_counter()
    runner = Runner(folder, MOTION_STAGES, force=frozenset(force), progress=progress or Silence())
    check_output_folder(folder)
    models, warnings = allowed_models(config, inputs)
    for text in warnings:
        runner.warn(text)
    with gone_if_refused(runner, "geometry"):
        given, config = GivenFiles.of(inputs), begin.uncropped(config)
        seen = begin.look(runner, given, config)
        geometry = begin.shape(runner, seen, given, config)
        found = runner.run(
            "velocities", write_velocities, *seen, geometry, files, MotionSettings.of(config),
            beside={"place": WritingPlace(folder, inputs, "velocities" in runner.force)},
            still_there=lambda made: _all_there(folder, files, made), owns_files=True,
        )  # fmt: skip
        facts = _facts(seen, geometry, found) | {"provenance": given.provenance() | provenance_of(models)}
        facts |= as_plain(runner.warnings)
        facts |= {"per_frame": list(found.rows)}
        write_json(folder / "motion.json", facts)
    return Written(
        folder, time.perf_counter() - began, tuple(runner.warnings), runner.timings, facts, _words(folder, facts)
    )


def write_velocities(
    read: Read, flow: Flow, segmentation: Segmentation, geometry: Geometry, files: MotionFiles,
    config: MotionSettings, *, place: WritingPlace, work: Work,
) -> VelocityFiles:  # fmt: skip
    """Write the files of every frame; what was written by a run that was stopped is kept."""
    from fluidlift.motion.sequence import motion_sequence

    clip, options, masks = read.clip, motion_options(config), FluidMasks(segmentation.labels.labels)
    pairs, kind = len(clip) - 1, geometry.kind
    writer = FrameWriter(clip, masks, flow.flow, geometry, files, place, work.key)
    wanted = [t for t in range(pairs) if t not in writer.rows]
    found = motion_sequence(
        pairs_of(clip, flow.flow), masks.__getitem__, pairs, motion_scene(clip, geometry), options,
        frames=wanted, volume_frames=() if kind_of(kind).starts_at_rest else wanted,
    )  # fmt: skip
    following = next(found, None)
    for t in wanted:
        work.step(t, pairs)
        here = following if following is not None and following.frame == t else None
        if here is not None:
            following = next(found, None)
        writer.write(t, here)
    rows = writer.finish(pairs)
    shares = [r["free_fall_share"] for r in rows if r.get("free_fall_share") is not None]
    warnings = motion_warnings(rows, kind, float(max(shares, default=0.0)))
    if kind_of(kind).starts_at_rest:
        warnings.append(
            Notice(
                "no-velocity-in-metres",
                f"the shape of a {kind} is known as it stands, not as it collapses: flow is written, and no "
                f"velocity in m/s",
            )
        )
    return VelocityFiles(tuple(rows), tuple(warnings + _unbalanced(rows)))


def _unbalanced(rows: list[dict[str, Any]]) -> list[Notice]:
    """A warning where what flows in at the inlet and out at the outlet do not agree, or run the wrong way."""
    both = [(r["flux_in"], r["flux_out"]) for r in rows if r.get("flux_in") and r.get("flux_out")]
    if not both:
        return []
    entering, leaving = (float(v) for v in np.median(both, axis=0))
    if entering > 0 > leaving:
        return [
            Notice(
                "inflow-at-both-ends",
                f"fluid flows in at both ends ({entering:.3g} and {-leaving:.3g} m3/s, medians), and "
                f"{entering - leaving:.3g} m3/s leave through the surface: the outlet is badly seen, look at the mask",
            )
        ]
    if leaving > 0 > entering:
        return [
            Notice(
                "outflow-at-both-ends",
                f"fluid flows out at both ends ({-entering:.3g} and {leaving:.3g} m3/s, medians), and "
                f"{leaving - entering:.3g} m3/s come through the surface: the inlet is badly seen, look at the mask",
            )
        ]
    if entering < 0 and leaving < 0:
        return [
            Notice(
                "ends-exchanged",
                f"fluid flows in at the outlet ({-leaving:.3g} m3/s) and out at the inlet ({-entering:.3g} m3/s, "
                f"medians): "
                "inlet and outlet are taken for each other, look at the overlay",
            )
        ]
    if abs(entering - leaving) <= SPREAD_OF_FLUX * min(entering, leaving):
        return []
    return [
        Notice(
            "fluxes-differ",
            f"{entering:.3g} m3/s flow in and {leaving:.3g} m3/s flow out (medians): the difference passes through the "
            "surface or changes its level",
        )
    ]


def _all_there(folder: Path, files: MotionFiles, made: VelocityFiles) -> bool:
    return all(path.is_file() for t in range(len(made.rows)) for path in files.of_frame(folder, t))


def _facts(seen: tuple[Read, Flow, Segmentation], geometry: Geometry, found: VelocityFiles) -> dict[str, Any]:
    (read, flow, segmentation), g, clip, grid = seen, geometry, seen[0].clip, geometry.grid
    wet = [r for r in found.rows if r["fluid_share"] > 0]
    return {
        "format": "fluidlift motion",
        "format_version": 1,
        "units": {"flow": "px per frame, x right, y down", "velocity": "m/s, z up", "length": "m", "time": "s"},
        "first_number": FIRST_FRAME,
        "frames": len(clip),
        "frame_interval": clip.interval,
        "times": [round(float(t), 6) for t in clip.times],
        "frames_of_clip": [int(k) for k in read.kept],
        "size": list(clip.size),
        "kind": g.kind,
        "kind_source": g.kind_source,
        "scale": asdict(g.scale) | {"sentence": g.scale_sentence},
        "scale_sentence": g.scale_sentence,
        "grid": {"shape": list(grid.shape), "spacing": grid.spacing, "origin": list(grid.origin)},
        "fluid_share": segmentation.fluid_share,
        "flow_trusted_as_given": flow.trusted_as_given,
        "flow_trusted": segmentation.flow_trusted,
        "observed_share": _median(wet, "observed_share"),
        "surface_speed": _median(wet, "surface_speed_median"),
        "surface_speed_fast": _median(wet, "surface_speed_p90"),
        "divergence_max": max((r.get("divergence_max", 0.0) for r in wet), default=None),
    }


def _median(rows: list[dict[str, Any]], name: str) -> float | None:
    values = [r[name] for r in rows if r.get(name) is not None]
    return float(np.median(values)) if values else None


def _words(folder: Path, facts: dict[str, Any]) -> tuple[str, ...]:
    def number(name: str, digits: int = 3) -> str:
        return "unknown" if facts[name] is None else f"{facts[name]:.{digits}g}"

    last = numbered(folder, facts["frames"] - 2, "").name
    lines = [
        f"a {facts['kind']}, {facts['frames']} frames at {1 / facts['frame_interval']:.4g} per second; files "
        f"{FIRST_FRAME} to {last} in {folder}",
        f"surface speed {number('surface_speed')} m/s (median), {number('surface_speed_fast')} m/s (fastest tenth)",
    ]
    if facts["scale_sentence"]:
        lines.append(facts["scale_sentence"])
    if facts["observed_share"] is not None:
        seen = "trusted as given (without confidence)" if facts["flow_trusted_as_given"] else "measured"
        lines.append(
            f"{seen} on {100 * facts['observed_share']:.0f} % of the fluid; the other "
            f"{100 - round(100 * facts['observed_share'])} % are filled in along the mainstream"
        )
    if facts["divergence_max"] is not None:
        lines.append(f"largest |div v| dx / mean speed {facts['divergence_max']:.2g}")
    return tuple(lines)
