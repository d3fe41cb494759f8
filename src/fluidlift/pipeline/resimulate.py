"""The second half of the story, which `make` and `sim` share: an asset at rest becomes frames, pictures and USD."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.config import PRESETS, JobConfig, build_config
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.pipeline import reporting, showing, simulating
from fluidlift.pipeline.reshaping import slow_edits
from fluidlift.pipeline.scene import Footage, Scene, SimulationRequest, footage_of, scene_of
from fluidlift.pipeline.story import Progress, Silence, Story, peak_memory_mb

FIRST_HALF = ("read", "flow", "segment", "geometry", "refine", "motion", "fit")
"""stages that need the clip; `sim` takes their results from where `make` left them"""

SECOND_HALF = ("simulate", "show")

SECOND_HALF_SECTIONS = ("simulate", "show")
"""settings that the second half depends on"""

FPS_RANGE = (0.1, 10_000.0)
"""frames per second that can be asked for"""

AS_FILMED = 1
"""raised where figures of the card change, so that frames that are there are measured again"""

PARTS = {
    "preview": "preview.mp4", "report": "report.html", "usd": "asset.usda", "mask_overlay": "mask_overlay.png",
}  # fmt: skip
"""files that the second half writes, by their name in the manifest"""


@dataclass(frozen=True)
class Made:
    """What a run left."""

    folder: Path
    warnings: tuple[str, ...]
    seconds: float
    timings: dict[str, dict[str, Any]]
    frames: int
    """simulated, the first (at rest) counted"""


def resimulate(
    folder: Path,
    *,
    request: SimulationRequest | None = None,
    overrides: Sequence[str] = (),
    flat: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> Made:
    """Simulate a finished asset again, with its scene.yaml, its fitted parameters and its body at rest.

    The clip is not needed. Where the cached stages of `make` are still in work/, preview and report show it again.

    Args:
        folder: of the asset.
        request: what this run is asked for.
        overrides: `simulate.name=value` and `show.name=value`.
        flat: settings by dotted name; None values are left out.
        progress: where progress is told.

    Raises:
        InputRejected: no asset, or a request, a scene.yaml or settings that do not fit; nothing was changed.
        FluidliftError: the simulation broke down; the frames before are kept and shown.
    """
    from fluidlift.io.asset_folder import read_manifest
    from fluidlift.io.asset_lock import writing
    from fluidlift.io.atomic import disk_errors

    request = request or SimulationRequest()
    began = time.perf_counter()
    manifest = read_manifest(folder)
    config = settings_of(manifest, overrides, flat or {}, sections=SECOND_HALF_SECTIONS, work="a simulation")
    _check(request)
    story = Story(
        folder, SECOND_HALF, force=frozenset(SECOND_HALF if request.restart else ()), progress=progress or Silence()
    )
    recall_first_half(story, manifest)
    with disk_errors(folder), writing(folder, "a simulation"):
        frames = play(story, folder, config, request)
    own = tuple(text for name in SECOND_HALF for text in story[name].meta.get("warnings", ()))
    return Made(folder, own, time.perf_counter() - began, story.timings, frames)


def _check(request: SimulationRequest) -> None:
    low, high = FPS_RANGE
    if request.fps is not None and not low <= request.fps <= high:
        raise InputRejected(f"--fps {request.fps:g}", f"{low:g} to {high:g} frames per second")
    if request.duration is not None and not 0 < request.duration < 1e9:
        raise InputRejected(f"--duration {request.duration:g}", "seconds, more than 0")
    if request.extend_downstream is not None and not 0 <= request.extend_downstream < 1e6:
        raise InputRejected(f"--extend-downstream {request.extend_downstream:g}", "metres, 0 or more")
    if request.meshes is not None and not request.meshes.is_dir():
        raise InputRejected(f"--meshes '{request.meshes}'", "an existing folder")
    if request.resume and request.restart:
        raise InputRejected("both --resume and --restart", "one of them")


def settings_of(
    manifest: dict[str, Any], overrides: Sequence[str], flat: dict[str, Any], *, sections: Sequence[str], work: str
) -> JobConfig:
    """The settings that the asset was made with, and what is changed now.

    Of an asset made by another version, settings that this one does not know are left out.

    Args:
        manifest: of the asset.
        overrides: `section.name=value`.
        flat: settings by dotted name; None values are left out.
        sections: that matter for the work.
        work: a word for it.

    Raises:
        InputRejected: a setting of another section, an unknown one, or a wrong value.
    """
    for text in overrides:
        if text.partition("=")[0].strip().partition(".")[0] not in sections:
            raise InputRejected(
                f"--set {text}, which has no effect on {work}", " or ".join(f"{s}.name=value" for s in sections),
                "change it with fluidlift make",
            )  # fmt: skip
    provenance = manifest.get("provenance", {})
    stored = provenance.get("config", {})
    values: dict[str, Any] = {"seed": provenance.get("seed")}
    for section in sections:
        part = stored.get(section, {}) if isinstance(stored, dict) else {}
        known = JobConfig().section(section)
        values |= {f"{section}.{k}": v for k, v in part.items() if k in known} if isinstance(part, dict) else {}
    preset = stored.get("preset") if isinstance(stored, dict) else None
    preset = preset if isinstance(preset, str) and preset in PRESETS else None
    return build_config(preset, None, overrides, values | {k: v for k, v in flat.items() if v is not None})


def recall_first_half(story: Story, manifest: dict[str, Any]) -> None:
    """Results of the first half, as far as they are still cached; all of them or none."""
    keys = stage_keys(manifest)
    if not all(name in keys and story.recall(name, keys[name]) for name in FIRST_HALF):
        for part in (story.results, story.keys, story.timings):
            part.clear()


def stage_keys(manifest: dict[str, Any]) -> dict[str, str]:
    """Keys of the cached results that an asset was made from; those that are none are left out."""
    keys = manifest.get("provenance", {}).get("stages", {})
    return {n: k for n, k in keys.items() if is_key(k)} if isinstance(keys, dict) else {}


def is_key(text: Any) -> bool:
    """Whether this can be the key of a result."""
    return isinstance(text, str) and len(text) == 64 and text.isalnum() and text.isascii()


def play(story: Story, folder: Path, config: JobConfig, request: SimulationRequest) -> int:
    """Simulate and show the asset in a folder, and bring its manifest up to date; the number of frames.

    Args:
        story: with the results of the first half, or without any of them.
        folder: of the asset.
        config: its `simulate` and `show` sections, and the seed.
        request: what this run is asked for.

    Raises:
        InputRejected: a scene that does not fit.
        FluidliftError: the simulation broke down; the frames before it are written.
    """
    from fluidlift.io.asset_folder import load_asset, read_manifest
    from fluidlift.io.obstacles import color_mark
    from fluidlift.io.scene import read_edits
    from fluidlift.io.scene_domain import require_inside

    manifest, asset = read_manifest(folder), load_asset(folder)
    footage, edits = footage_of(story), read_edits(folder, meshes=request.meshes)
    scene = scene_of(asset, folder, request, config, footage=footage, start=rest_frame_of(manifest, footage))
    outside = require_inside(edits, scene.terrain.grid, seconds=scene.frames * scene.interval) + slow_edits(scene)
    look = edits.look.mark(folder) | color_mark(edits.obstacles)
    for text in outside:
        story.progress.warn(text)
    story.run(
        "simulate",
        lambda: simulating.simulate(scene, folder, config, request=request, step=story.step),
        settings=[scene.parts, scene.frames, config.simulate.max_particles],
        after=(),
        still_there=simulating.frames_still_there(folder),
        owns_files=True,
    )
    done = story["simulate"].meta
    first_half = [story.keys[s] for s in FIRST_HALF if s in story.keys]
    wanted = [folder / "preview.mp4"] * config.show.preview + [folder / "asset.usda"] * config.show.usd
    story.run(
        "show",
        lambda: showing.show(
            scene, footage, folder, config, story["simulate"].arrays["poses"], look=edits.look, step=story.step
        ),
        settings=[config.section("show"), done["frames"], look, AS_FILMED, first_half],
        after=("simulate",),
        still_there=lambda result: all(p.is_file() for p in wanted),
        owns_files=True,
    )
    closed = edits.loop and not any("loop is not closed" in text for text in done.get("warnings", ()))
    _finish(story, scene, config, manifest, {"look": look, "loop": closed, "warnings": outside})
    if "failed" in done:
        raise FluidliftError(
            f"{done['failed']} The {done['frames']} frames before it are kept, with their preview: '{folder}'."
        )
    return int(done["frames"])


def rest_frame_of(manifest: dict[str, Any], footage: Footage | None) -> int:
    """Frame of the clip that the body at rest shows."""
    start = manifest.get("metrics", {}).get("rest_frame", 0) if footage is None else footage.start
    return start if type(start) is int and 0 <= start < manifest["frame_count"] else 0


def _finish(story: Story, scene: Scene, config: JobConfig, manifest: dict[str, Any], edited: dict[str, Any]) -> None:
    """Report, figures for `evaluate`, manifest.

    Args:
        story: of the run.
        scene: that was simulated.
        config: its `simulate` and `show` sections.
        manifest: as it was before.
        edited: what of scene.yaml is noted beside the scene, and warnings about it.
    """
    from fluidlift.io.asset_folder import update_manifest
    from fluidlift.io.atomic import atomic_write

    folder = story.folder
    result = story["simulate"].meta
    before = set(manifest.get("simulation", {}).get("warnings", ()))
    shown = story["show"].meta
    own = [*edited["warnings"], *result.get("warnings", ()), *([result["failed"]] if "failed" in result else [])]
    own += shown.get("warnings", ())
    story.warnings[:] = [w for w in manifest.get("warnings", ()) if w not in before] + own
    if story.results.keys() >= set(FIRST_HALF):
        reporting.write_report(story, folder, config, story.timings)
        figures = folder / "work" / "evaluation.npz"
        if "resim_frames" in story["show"].arrays:
            with atomic_write(figures) as stream:
                np.savez_compressed(stream, **evaluation_arrays(story))
        else:
            figures.unlink(missing_ok=True)  # of frames that are no longer there
    update_manifest(
        folder,
        files={name: file for name, file in PARTS.items() if (folder / file).is_file()},
        timings={k: float(t["seconds"]) for k, t in story.timings.items()},
        metrics={"peak_memory_mb": round(peak_memory_mb(), 1), "stages": story.timings},
        warnings=story.warnings,
        simulation={
            "frames": result["frames"],
            "frame_interval": scene.interval,
            "grid": {"shape": scene.terrain.grid.shape, "spacing": scene.terrain.grid.spacing,
                     "origin": scene.terrain.grid.origin},
            "parameters": scene.parameters.to_dict(),
            "seed": scene.seed,
            "extended_downstream": scene.extended,
            "obstacles": [o.name for o in scene.obstacles],
            "look": edited["look"],
            "loop": edited["loop"],
            "parts": scene.parts,
            "as_filmed": shown["as_filmed"],
            "warnings": own,
        },
    )  # fmt: skip


def evaluation_arrays(story: Story) -> dict[str, np.ndarray]:
    """What `fluidlift evaluate` compares with a truth."""
    g, m, s, shown = story["geometry"], story["motion"], story["simulate"], story["show"].arrays
    targets = m.meta["targets"]
    start = g.meta["rest_frame"]
    return {
        "labels": story["segment"].arrays["labels"],
        "front_depth": g.arrays["sighted_depth"] * g.arrays["mask"],
        "flow_raw": story["flow"].arrays["displacement"],
        "flow_completed": m.arrays["completed"],
        "flow_observed": np.unpackbits(m.arrays["observed"], axis=-1)[..., : m.arrays["completed"].shape[2]],
        "resim_flow": shown["resim_flow"][:-1],
        "resim_mask": shown["resim_mask"],
        "resim_frames": shown["resim_frames"],
        "first_frame": np.int64(start),
        "fit_frames": np.array([targets[0], targets[-1] + 1] if targets else [0, 0]),
        "particle_volume": s.arrays["volume"],
        "leak_share": s.arrays["leak"],
    }
