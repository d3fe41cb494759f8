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
from fluidlift.pipeline import begin
from fluidlift.pipeline.body import grid_of
from fluidlift.pipeline.frame_files import FrameWriter, MotionFiles
from fluidlift.pipeline.lifting import motion_options, motion_scene, motion_warnings
from fluidlift.pipeline.reading import Inputs, clip_of
from fluidlift.pipeline.seeing import masks_of, pairs_of
from fluidlift.pipeline.story import Progress, Result, Silence, Story, gone_if_refused
from fluidlift.pipeline.written import Written, numbered, require_stages
from fluidlift.types import kind_of

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
    require_stages(force, MOTION_STAGES)
    check_output_folder(folder)
    began = time.perf_counter()
    story = Story(folder, MOTION_STAGES, force=frozenset(force), progress=progress or Silence())
    with gone_if_refused(story, "geometry"):
        hashes = begin.input_hashes(inputs)
        begin.look(story, inputs, config, hashes)
        begin.shape(story, inputs, config, hashes)
        found = story.run(
            "velocities",
            lambda: _velocities(story, folder, config, files, inputs),
            settings=[asdict(motion_options(config)), asdict(files)],
            after=("read", "flow", "segment", "geometry"),
            still_there=lambda result: _all_there(folder, files, result),
            owns_files=True,
        )
        facts = _facts(story, found, begin.provenance_of(inputs, hashes))
        write_json(folder / "motion.json", facts)
    return Written(
        folder, time.perf_counter() - began, tuple(story.warnings), story.timings, facts, _words(folder, facts)
    )


def _velocities(story: Story, folder: Path, config: JobConfig, files: MotionFiles, inputs: Inputs) -> Result:
    """Write the files of every frame; what was written by a run that was stopped is kept."""
    from fluidlift.motion.sequence import motion_sequence

    clip, options = clip_of(story), motion_options(config)
    pairs, g = len(clip) - 1, story["geometry"].meta
    writer = FrameWriter(story, folder, files, inputs, again="velocities" in story.force)
    wanted = [t for t in range(pairs) if t not in writer.rows]
    found = motion_sequence(
        pairs_of(story), masks_of(story).__getitem__, pairs, motion_scene(story), options,
        frames=wanted, volume_frames=() if kind_of(g["kind"]).starts_at_rest else wanted,
    )  # fmt: skip
    following = next(found, None)
    for t in wanted:
        story.step(t, pairs)
        here = following if following is not None and following.frame == t else None
        if here is not None:
            following = next(found, None)
        writer.write(t, here)
    rows = writer.finish(pairs)
    shares = [r["free_fall_share"] for r in rows if r.get("free_fall_share") is not None]
    warnings = motion_warnings(rows, g["kind"], float(max(shares, default=0.0)))
    if kind_of(g["kind"]).starts_at_rest:
        warnings.append(
            f"the shape of a {g['kind']} is known as it stands, not as it collapses: flow is written, and no velocity "
            "in m/s"
        )
    return Result({}, {"warnings": warnings + _unbalanced(rows), "rows": rows})


def _unbalanced(rows: list[dict[str, Any]]) -> list[str]:
    """A warning where what flows in at the inlet and out at the outlet do not agree, or run the wrong way."""
    both = [(r["flux_in"], r["flux_out"]) for r in rows if r.get("flux_in") and r.get("flux_out")]
    if not both:
        return []
    entering, leaving = (float(v) for v in np.median(both, axis=0))
    if entering > 0 > leaving:
        return [
            f"fluid flows in at both ends ({entering:.3g} and {-leaving:.3g} m3/s, medians), and "
            f"{entering - leaving:.3g} m3/s leave through the surface: the outlet is badly seen, look at the mask"
        ]
    if leaving > 0 > entering:
        return [
            f"fluid flows out at both ends ({-entering:.3g} and {leaving:.3g} m3/s, medians), and "
            f"{leaving - entering:.3g} m3/s come through the surface: the inlet is badly seen, look at the mask"
        ]
    if entering < 0 and leaving < 0:
        return [
            f"fluid flows in at the outlet ({-leaving:.3g} m3/s) and out at the inlet ({-entering:.3g} m3/s, medians): "
            "inlet and outlet are taken for each other, look at the overlay"
        ]
    if abs(entering - leaving) <= SPREAD_OF_FLUX * min(entering, leaving):
        return []
    return [
        f"{entering:.3g} m3/s flow in and {leaving:.3g} m3/s flow out (medians): the difference passes through the "
        "surface or changes its level"
    ]


def _all_there(folder: Path, files: MotionFiles, result: Result) -> bool:
    return all(path.is_file() for t in range(len(result.meta["rows"])) for path in files.of_frame(folder, t))


def _facts(story: Story, found: Result, provenance: dict[str, Any]) -> dict[str, Any]:
    clip, g, rows = clip_of(story), story["geometry"].meta, found.meta["rows"]
    wet = [r for r in rows if r["fluid_share"] > 0]
    grid = grid_of(story)
    return {
        "format": "fluidlift motion",
        "format_version": 1,
        "units": {"flow": "px per frame, x right, y down", "velocity": "m/s, z up", "length": "m", "time": "s"},
        "first_number": FIRST_FRAME,
        "frames": len(clip),
        "frame_interval": clip.interval,
        "times": [round(float(t), 6) for t in clip.times],
        "frames_of_clip": [int(k) for k in story["read"].arrays["kept"]],
        "size": list(clip.size),
        "kind": g["kind"],
        "kind_source": g["kind_source"],
        "scale": g["scale"],
        "scale_sentence": g["scale"].get("sentence", ""),
        "grid": {"shape": list(grid.shape), "spacing": grid.spacing, "origin": list(grid.origin)},
        "fluid_share": story["segment"].meta["fluid_share"],
        "flow_trusted_as_given": bool(story["flow"].meta.get("trusted_as_given")),
        "flow_trusted": story["segment"].meta["flow_trusted"],
        "observed_share": _median(wet, "observed_share"),
        "surface_speed": _median(wet, "surface_speed_median"),
        "surface_speed_fast": _median(wet, "surface_speed_p90"),
        "divergence_max": max((r.get("divergence_max", 0.0) for r in wet), default=None),
        "provenance": provenance,
        "warnings": list(story.warnings),
        "per_frame": rows,
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
