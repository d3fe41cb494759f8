"""From a clip to an asset folder."""

from __future__ import annotations

import importlib
import platform
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift import __version__
from fluidlift.config import JobConfig
from fluidlift.io.hints_file import hints_data
from fluidlift.look.smoke_film import smoke_layers
from fluidlift.pipeline import begin
from fluidlift.pipeline.fit_request import request_of
from fluidlift.pipeline.inputs import GivenFile, GivenFiles, Inputs
from fluidlift.pipeline.models import UsedModel, allowed_models, provenance_of
from fluidlift.pipeline.other_times import moved_elsewhere
from fluidlift.pipeline.resimulate import Made, note_as_shown, play
from fluidlift.pipeline.runner import Runner, gone_if_refused
from fluidlift.pipeline.settings import GenerateSettings, GivenView, MotionSettings, RefineSettings, taken
from fluidlift.pipeline.stages import generate
from fluidlift.pipeline.stages.calibrate import calibrate, mean_target
from fluidlift.pipeline.stages.fit import fit
from fluidlift.pipeline.stages.motion import motion
from fluidlift.pipeline.stages.refine import refine
from fluidlift.present.as_filmed import certainty
from fluidlift.scene.build import SceneSettings, SimulationRequest, edited_scene, first_of_film
from fluidlift.scene.filmed_cells import filmed_shares
from fluidlift.scene.filmed_inlet import inlet_offsets
from fluidlift.scene.simulator import particle_work
from fluidlift.scene.splat_files import require_room
from fluidlift.seams import Progress, Silence
from fluidlift.shape.occluders import HiddenFluid
from fluidlift.types import Filmed, FluidAsset, kind_of
from fluidlift.types.fluid_masks import FluidMasks
from fluidlift.types.hints import NOTHING_SAID, ClipHints
from fluidlift.types.stages import Bodies, Calibration, Fit, Lift, Read, Segmentation

STAGES = ("read", "flow", "segment", "geometry", "refine", "motion", "fit", "calibrate", "simulate", "show")


def make(
    inputs: Inputs,
    folder: Path,
    config: JobConfig,
    *,
    hints: ClipHints = NOTHING_SAID,
    force: Iterable[str] = (),
    progress: Progress | None = None,
    value_told: Callable[[str, Any], None] = lambda name, value: None,
) -> Made:
    """Run every stage that is not already done and write the asset folder.

    Args:
        inputs: the clip and what the user adds to it.
        folder: of the asset; an existing asset is continued or rewritten.
        config: of the job.
        hints: what a person drew on the clip; those that are settings (`ClipHints.settings`) stand in `config`.
        force: stages to run again, with all that come after.
        progress: where progress is told.
        value_told: gets the name and the value of each stage as it ends.

    Raises:
        InputRejected: an input that cannot be used, or a folder that is not an asset. Nothing is left behind then
            where nothing was before.
        FluidliftError: a stage failed; what was done before it is kept and the next run goes on from there. Where the
            simulation broke down, the frames before it are written as an asset of fewer frames.
    """
    from fluidlift.io.asset_folder import check_output_folder
    from fluidlift.io.asset_lock import writing

    began, generates = time.perf_counter(), config.generate.name is not None
    stages = begin.stages_of(generate.stages_of(STAGES) if generates else STAGES, hints)
    runner = Runner(folder, stages, force=frozenset(force), progress=progress or Silence(), value_told=value_told)
    check_output_folder(folder)
    particle_work(config.simulate.device)  # a device that is not there is said now, not after the fit
    request_of(config.fit)  # so is a parameter that is not known
    warnings = generate.require_usable(inputs, config, folder) if generates else []
    models, terms = allowed_models(config, inputs)
    for text in warnings + terms:
        runner.warn(text)
    with gone_if_refused(runner, "motion"), writing(folder, "fluidlift make"):
        given = GivenFiles.of(inputs)
        if hints != NOTHING_SAID or given != GivenFiles(given.clip):
            config = begin.uncropped(config)
        config, others = begin.windows(runner, given.clip, config)
        lift = _lifted(runner, given, config, hints, others)
        frames = config.simulate.frames or len(lift.clip) - lift.geometry.rest_frame
        require_room(folder, frames, len(lift.refined.body))
        origin = given.provenance() | _provenance(hints, models)
        asset = _write_asset(runner, lift, config, origin)
        request = SimulationRequest(restart="simulate" in runner.force)
        frames = play(runner, asset, config, request, lift)
        note_as_shown(folder, request)
    return Made(folder, tuple(runner.warnings), time.perf_counter() - began, runner.timings, frames)


def _provenance(hints: ClipHints, models: tuple[UsedModel, ...]) -> dict[str, Any]:
    """What a person said, and which learned models looked, for a manifest."""
    said = {} if hints == NOTHING_SAID else {"hints": hints_data(hints)}
    return said | provenance_of(models)


def _lifted(
    runner: Runner, given: GivenFiles, config: JobConfig, hints: ClipHints, others: tuple[JobConfig, ...]
) -> Lift:
    """From the clip to the parameters; `others` are stretches of a long clip whose motion counts as well."""
    files = given
    read, flow, segmentation = seen = begin.look(runner, given, config, said=hints)
    if not runner.timings["segment"]["cached"]:  # loaded beside the shape, and needed after it: one to two seconds
        threading.Thread(target=importlib.import_module, args=("torch",), name="loads torch").start()
    given = _with_bodies(runner, read, segmentation, given, config)
    geometry = begin.shape(runner, seen, given, config, hints)
    settings = taken(RefineSettings, config.shape, seed=config.seed)
    refined = runner.run("refine", refine, *seen, geometry, given.geometry, settings)
    moving = runner.run("motion", motion, *seen, geometry, MotionSettings.of(config, simulated=True))
    more = moved_elsewhere(runner, files, others, (read, segmentation, geometry, moving))
    also = () if more is None else (more,)
    fitted = runner.run("fit", fit, read, segmentation, geometry, moving, config.fit, *also)
    return Lift(read, flow, segmentation, geometry, refined, moving, fitted, more)


def _with_bodies(
    runner: Runner, read: Read, segmentation: Segmentation, given: GivenFiles, config: JobConfig
) -> GivenFiles:
    """Ask the generator where the job has one: its bodies count as given."""
    if config.generate.name is None:
        return given
    view, name = GivenView(given.clip, given.camera), generate.STAGE

    def there(made: Bodies) -> bool:
        return generate.bodies_there(generate.bodies_folder(runner.folder, runner.keys[name]), made)

    runner.run(
        name, generate.generate, read, segmentation, view, GenerateSettings.of(config),
        beside={"folder": runner.folder}, still_there=there,
    )  # fmt: skip
    key = runner.keys[name]
    return replace(given, geometry=GivenFile(generate.bodies_folder(runner.folder, key), key))


def _write_asset(runner: Runner, lift: Lift, config: JobConfig, provenance: dict[str, Any]) -> FluidAsset:
    """The body at rest and what moves it; simulation and pictures come after."""
    from fluidlift.io.asset_folder import load_asset, save_asset
    from fluidlift.io.force_file import write_filmed

    clip, g, folder = lift.clip, lift.geometry, runner.folder
    _write_film(lift, folder)
    origin = {"config": config.to_dict(), "versions": versions(), "seed": config.seed, "stages": dict(runner.keys)}
    asset = FluidAsset(
        kind=g.kind,
        rest=lift.refined.body,
        terrain=g.setting.terrain,
        grid=g.grid,
        cell_types=g.setting.cell_types,
        velocity=lift.motion.velocities[0],
        parameters=lift.fit.parameters,
        estimates=lift.fit.estimates | ({} if g.bed is None else g.bed.estimates),
        camera=g.camera,
        world_from_canonical=g.world_from_canonical,
        interval=clip.interval,
        frame_count=len(clip),
        provenance=provenance | origin,
    )
    calibration = _calibrated(runner, lift, asset, config)
    known = calibration.force, calibration.dry, calibration.dry_for, calibration.wet
    write_filmed(folder, Filmed(*known, lift.motion.filmed, _inlet_in_film(lift)))
    save_asset(
        folder,
        asset,
        timings={k: float(t["seconds"]) for k, t in runner.timings.items()},
        metrics=_metrics(lift, calibration),
        warnings=runner.warnings,
    )
    return load_asset(folder)  # as everybody else finds it: files hold less digits


def _inlet_in_film(lift: Lift) -> np.ndarray | None:
    """float64 [T,3], m that the inlet of a pour stands beside its place at rest in each frame of the film."""
    g = lift.geometry
    if not kind_of(g.kind).fills_vessel:
        return None
    part = _film_part(lift)
    fluid = FluidMasks(lift.labels.labels)[part]
    return inlet_offsets(g.setting.cell_types, g.grid, g.camera, fluid, g.rest_frame - part.start)


def _film_part(lift: Lift) -> slice:
    """Frames of the clip that the film holds."""
    from fluidlift.io.footage_file import MOST_FRAMES

    first = first_of_film(lift.geometry.rest_frame, len(lift.clip))
    return slice(first, first + MOST_FRAMES)


def _calibrated(runner: Runner, lift: Lift, asset: FluidAsset, config: JobConfig) -> Calibration:
    """The force that keeps the filmed flow, from a run without what scene.yaml changes."""
    from fluidlift.io.scene import SceneEdits

    scene = edited_scene(asset, SceneEdits(), None, SceneSettings.of(config), start=lift.geometry.rest_frame)
    target = mean_target(asset, lift.motion, lift.elsewhere)
    masks, s = FluidMasks(lift.labels.labels, lift.geometry.hidden), config.simulate
    left = (len(masks) - lift.geometry.rest_frame) * asset.interval
    shares, dry_for = filmed_shares(kind_of(asset.kind), masks, left, held=lift.geometry.setting.pool_level is not None)
    return runner.run(
        "calibrate", calibrate, scene, target, shares, dry_for, wanted=s.follow > 0, beside={"device": s.device}
    )


def _write_film(lift: Lift, folder: Path) -> None:
    """The film that the fluid's surface plays; of smoke, its color and opacity."""
    from fluidlift.io.asset_folder import FILES
    from fluidlift.io.footage_file import write_footage, write_smoke

    film, clip, part = folder / FILES["film"], lift.clip, _film_part(lift)
    whole = lift.segmentation.whole
    frames, fluid = (clip.frames if whole is None else whole)[part], FluidMasks(lift.labels.labels)[part]
    hidden = lift.geometry.hidden
    if hidden is not None:
        behind = HiddenFluid.of(hidden, lift.geometry.mask)
        frames, fluid = behind.pictures(frames), behind.pictures(fluid)
    if kind_of(lift.geometry.kind).is_gas:
        write_smoke(film, smoke_layers(frames, fluid, lift.geometry.plate), clip.interval)
        return
    write_footage(film, frames, fluid, clip.interval)


def _metrics(lift: Lift, calibration: Calibration) -> dict[str, Any]:
    g, reports = lift.geometry, lift.motion.reports
    return {
        "kind_scores": g.kind_evidence.scores,
        "up": asdict(g.up),
        "certainty": certainty(lift),
        "scale": asdict(g.scale) | {"sentence": g.scale_sentence},
        "rest_frame": g.rest_frame,
        **_times(lift),
        "gaussians": len(lift.refined.body),
        "refine_psnr_after": lift.refined.psnr_after,
        "divergence_max": max((r.get("divergence_max", 0.0) for r in reports), default=None),
        "fit_converged": lift.fit.converged,
        "fit_rollouts": lift.fit.rollouts,
        "fit_extra": lift.fit.extra,
        "fit": fit_figures(lift.fit),
        "calibration": {k: getattr(calibration, k) for k in ("acceleration", "speed", "left", "frames")},
    }


def _times(lift: Lift) -> dict[str, Any]:
    """At which other times of a long clip its motion was taken, and how far that is from the motion that is made."""
    if lift.elsewhere is None:
        return {}
    return {"elsewhere": [{"start": s.start, "targets": len(s.targets), "apart": round(s.apart, 4)}
                          for s in lift.elsewhere.stretches]}  # fmt: skip


def fit_figures(fit: Fit) -> dict[str, Any]:
    """How the fit ended, and its table, for the manifest."""
    return {k: getattr(fit, k) for k in ("status", "reason", "warnings", "notes", "table")}


def versions() -> dict[str, str]:
    """Of what computed this asset."""
    from importlib import metadata

    found = {"fluidlift": __version__, "python": platform.python_version(), "system": platform.system()}
    for name in ("numpy", "scipy", "numba", "torch", "av", "opencv-python-headless", "usd-core"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
