"""The second half, which `make` and `sim` share: an asset at rest becomes frames, pictures and USD."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluidlift.config import JobConfig
from fluidlift.config.of_asset import SECOND_HALF_SECTIONS, settings_of
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.kept_values import OF_CLIP
from fluidlift.machine import peak_memory_mb
from fluidlift.messages import Notice, as_plain, code_of, from_plain
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.settings import ShowSettings, SimulateSettings, taken
from fluidlift.pipeline.stages.show import SeenLook, show
from fluidlift.pipeline.stages.simulate import frames_still_there, simulate
from fluidlift.present import report
from fluidlift.present.looping import OPEN
from fluidlift.scene.build import Scene, SimulationRequest, scene_of
from fluidlift.scene.filmed_numbers import NAMES
from fluidlift.scene.footage import footage_of
from fluidlift.scene.forecast import ahead
from fluidlift.scene.recall import rest_frame_of
from fluidlift.scene.reshaping import slow_edits
from fluidlift.scene.whitewater_law import LAW
from fluidlift.seams import Progress, Silence
from fluidlift.types import Estimate, FluidAsset
from fluidlift.types.stages import Lift, Shown, Simulation

SECOND_HALF = ("simulate", "show")


FPS_RANGE = (0.1, 10_000.0)
"""frames per second that can be asked for"""

PARTS = {
    "preview": "preview.mp4", "report": "report.html", "usd": "asset.usda", "mask_overlay": "mask_overlay.png",
}  # fmt: skip
"""files that the second half writes, by their name in the manifest"""


@dataclass(frozen=True)
class Made:
    """What a run left."""

    folder: Path
    warnings: tuple[Notice, ...]
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
    from fluidlift.io.asset_folder import load_asset, read_manifest
    from fluidlift.io.asset_lock import writing
    from fluidlift.io.atomic import disk_errors

    request = request or SimulationRequest()
    began = time.perf_counter()
    manifest = read_manifest(folder)
    config = settings_of(manifest, overrides, flat or {}, sections=SECOND_HALF_SECTIONS, work="a simulation")
    _check(request)
    runner = Runner(
        folder, SECOND_HALF, force=frozenset(SECOND_HALF if request.restart else ()), progress=progress or Silence()
    )
    lift = recalled_lift(runner, manifest)
    with disk_errors(folder), writing(folder, "a simulation"):
        frames = play(runner, load_asset(folder), config, request, lift)
        if not overrides and all(value is None for value in (flat or {}).values()):
            note_as_shown(folder, request)
    return Made(folder, tuple(runner.told), time.perf_counter() - began, runner.timings, frames)


def note_as_shown(folder: Path, request: SimulationRequest) -> None:
    """Frames that were just simulated as scene.yaml says are not stale: noted, since finding it out takes seconds.

    Args:
        folder: of the asset.
        request: of the simulation, which went by the settings of the asset; where it asked for something else than
            scene.yaml says, nothing is noted.
    """
    from fluidlift.scene import EditSession

    if (request.duration, request.fps, request.extend_downstream) == (None, None, None):
        with suppress(InputRejected):
            EditSession.open(folder, meshes=request.meshes).note_shown()


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


def play(runner: Runner, asset: FluidAsset, config: JobConfig, request: SimulationRequest, lift: Lift | None) -> int:
    """Simulate and show an asset, and bring its manifest up to date; the number of frames.

    Args:
        runner: of the asset's folder.
        asset: as `load_asset` gives it.
        config: its `simulate` and `show` sections, and the seed.
        request: what this run is asked for.
        lift: what was found in the clip, where that is still at hand.

    Raises:
        InputRejected: a scene that does not fit.
        FluidliftError: the simulation broke down; the frames before it are written.
    """
    from fluidlift.io.asset_folder import read_manifest
    from fluidlift.io.obstacles import color_mark
    from fluidlift.io.scene import read_edits
    from fluidlift.io.scene_domain import require_inside

    folder, manifest, footage = runner.folder, read_manifest(runner.folder), None
    if lift is not None:
        source = lift.read, lift.segmentation, lift.geometry
        footage = runner.follows(footage_of(*source), *source)
    edits = read_edits(folder, meshes=request.meshes)
    start = rest_frame_of(manifest, footage)
    scene = scene_of(asset, folder, request, config, footage=footage, start=start, edits=edits)
    outside = require_inside(edits, scene.terrain.grid, seconds=scene.frames * scene.interval) + slow_edits(scene)
    for text in outside:
        runner.progress.warn(text)

    def tell(splats: int) -> None:
        runner.progress.say(ahead(folder, manifest, scene.simulated, scene.interval, splats))

    done = runner.run(
        "simulate", simulate, scene, taken(SimulateSettings, config.simulate),
        beside={"folder": folder, "request": request, "told": tell}, still_there=frames_still_there(folder),
        owns_files=True,
    )  # fmt: skip
    seen = SeenLook(edits.look, edits.look.mark(folder) | color_mark(edits.obstacles))
    wanted = [folder / "preview.mp4"] * config.show.preview + [folder / "asset.usda"] * config.show.usd
    shown = runner.run(
        "show", show, scene, done, footage, seen, taken(ShowSettings, config.show), beside={"folder": folder},
        still_there=lambda value: all(p.is_file() for p in wanted), owns_files=True,
    )  # fmt: skip
    closed = edits.loop and all(code_of(text) != OPEN for text in done.warnings)
    _finish(runner, scene, manifest, config, lift, Played(done, shown, seen.mark, closed, tuple(outside)))
    if done.failed is not None:
        raise FluidliftError(
            f"{done.failed} The {done.frames} frames before it are kept, with their preview: '{folder}'."
        )
    return done.frames


@dataclass(frozen=True)
class Played:
    """A simulation and its pictures, and what of scene.yaml is noted beside them."""

    simulation: Simulation
    shown: Shown
    look: dict[str, Any]
    loop: bool
    """whether its end runs into its beginning"""
    warnings: tuple[Notice, ...]
    """about scene.yaml"""


def _finish(
    runner: Runner, scene: Scene, manifest: dict[str, Any], config: JobConfig, lift: Lift | None, played: Played
) -> None:
    """Report, and the manifest, which is given as it was before."""
    from fluidlift.io.asset_folder import update_manifest

    folder, done, shown = runner.folder, played.simulation, played.shown
    if done.estimates:
        write_filmed_numbers(folder, done.estimates)
    before = set(from_plain(manifest.get("simulation", {})))
    own = [
        *played.warnings,
        *done.warnings,
        *([] if done.failed is None else [Notice("simulation-broke-down", done.failed)]),
        *shown.warnings,
    ]
    runner.warnings[:] = [w for w in from_plain(manifest) if w not in before] + own
    if lift is not None:
        models = manifest.get("provenance", {}).get("models", ())
        report.write_report(lift, done, shown, folder, config.preset, runner.timings, runner.warnings, models)
    # versions before kept there what `evaluate` takes from the values of the stages, for frames that are gone by now
    asset_file(folder, "work/evaluation.npz").unlink(missing_ok=True)
    update_manifest(
        folder,
        files={name: file for name, file in PARTS.items() if (folder / file).is_file()},
        timings={k: float(t["seconds"]) for k, t in runner.timings.items()},
        metrics={"peak_memory_mb": round(peak_memory_mb(), 1), "stages": runner.timings},
        **as_plain(runner.warnings),
        simulation={
            "frames": done.frames,
            "frame_interval": scene.interval,
            "grid": {"shape": scene.terrain.grid.shape, "spacing": scene.terrain.grid.spacing,
                     "origin": scene.terrain.grid.origin},
            "parameters": scene.parameters.to_dict(),
            "seed": scene.seed,
            "extended_downstream": scene.extended,
            "obstacles": [o.name for o in scene.obstacles],
            "look": played.look,
            "loop": played.loop,
            "parts": scene.parts,
            "usd_frames": config.show.usd * (done.frames if config.show.usd_frames else 1),
            "as_filmed": shown.as_filmed,
        }
        | as_plain(own),
    )  # fmt: skip


def write_filmed_numbers(folder: Path, found: Mapping[str, Estimate]) -> None:
    """Foam and waves beside the other parameters of an asset, in the place of those that were there; the law of white
    water stays as it was where this simulation did not show it (it went on from a checkpoint)."""
    from fluidlift.io.asset_folder import read_parameters, write_parameters

    parameters, before = read_parameters(asset_file(folder, "parameters.json"))
    others = {name: e for name, e in before.items() if name not in NAMES}
    known = {name: e for name, e in before.items() if name in LAW} | dict(found)
    write_parameters(folder, parameters, others | {name: known[name] for name in NAMES if name in known})


def recalled_lift(runner: Runner, manifest: dict[str, Any]) -> Lift | None:
    """What `make` found in the clip; None where any of it is gone, and the runner knows nothing of it then."""
    values = []
    for name, kind in OF_CLIP.items():
        value = runner.recall(manifest, name, kind)
        if value is None:
            runner.forget()
            return None
        values.append(value)
    return Lift(*values)
