"""From a clip to an asset folder."""

from __future__ import annotations

import platform
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from fluidlift import __version__
from fluidlift.config import JobConfig
from fluidlift.pipeline import begin, body, calibrating, generating, lifting, moving, refining, simulating
from fluidlift.pipeline.begin import input_hashes, provenance_of
from fluidlift.pipeline.fit_request import request_of
from fluidlift.pipeline.reading import Inputs, clip_of
from fluidlift.pipeline.resimulate import Made, play
from fluidlift.pipeline.scene import SimulationRequest, first_of_film, scene_of
from fluidlift.pipeline.seeing import masks_of
from fluidlift.pipeline.story import Progress, Result, Silence, Story, gone_if_refused
from fluidlift.pipeline.written import require_stages
from fluidlift.types import FluidAsset, kind_of

STAGES = ("read", "flow", "segment", "geometry", "refine", "motion", "fit", "calibrate", "simulate", "show")


def make(
    inputs: Inputs,
    folder: Path,
    config: JobConfig,
    *,
    force: Iterable[str] = (),
    progress: Progress | None = None,
) -> Made:
    """Run every stage that is not already done and write the asset folder.

    Args:
        inputs: the clip and what the user adds to it.
        folder: of the asset; an existing asset is continued or rewritten.
        config: of the job.
        force: stages to run again, with all that come after.
        progress: where progress is told.

    Raises:
        InputRejected: an input that cannot be used, or a folder that is not an asset. Nothing is left behind then
            where nothing was before.
        FluidliftError: a stage failed; what was done before it is kept and the next run goes on from there. Where the
            simulation broke down, the frames before it are written as an asset of fewer frames.
    """
    from fluidlift.io.asset_folder import check_output_folder
    from fluidlift.io.asset_lock import writing

    stages = generating.stages_of(STAGES, config)
    require_stages(force, stages)
    check_output_folder(folder)
    simulating.particle_work(config.simulate.device)  # a device that is not there is said now, not after the fit
    request_of(config.fit)  # so is a parameter that is not known
    warnings = generating.require_usable(inputs, config, folder)
    began = time.perf_counter()
    story = Story(folder, stages, force=frozenset(force), progress=progress or Silence())
    for text in warnings:
        story.warn(text)
    with gone_if_refused(story, "motion"), writing(folder, "fluidlift make"):
        provenance = _run(story, inputs, config)
        frames = config.simulate.frames or len(clip_of(story)) - story["geometry"].meta["rest_frame"]
        simulating.require_room(folder, frames, len(body.rest_of(story)))
        _write_asset(story, folder, config, provenance)
        frames = play(story, folder, config, SimulationRequest(restart="simulate" in story.force))
    return Made(folder, tuple(story.warnings), time.perf_counter() - began, story.timings, frames)


def _run(story: Story, inputs: Inputs, config: JobConfig) -> dict[str, Any]:
    hashes = input_hashes(inputs)
    seed, run, shape = config.seed, story.run, config.section("shape")
    begin.look(story, inputs, config, hashes)
    given, known = generating.run(story, inputs, config, hashes)
    begin.shape(story, given, config, known)
    run("refine", lambda: refining.refine(story, given, config), settings=[shape, seed], after=("geometry",))
    run("motion", lambda: lifting.motion(story, config), settings=config.section("motion"), after=("geometry",))
    run("fit", lambda: moving.fit(story, config), settings=config.section("fit"), after=("motion",))
    return provenance_of(inputs, hashes)


def _write_asset(story: Story, folder: Path, config: JobConfig, provenance: dict[str, Any]) -> None:
    """The body at rest and what moves it; simulation and pictures come after."""
    from fluidlift.io.asset_folder import save_asset
    from fluidlift.io.force_file import write_force

    clip, g = clip_of(story), story["geometry"]
    setting = body.setting_of(story)
    _write_film(story, folder)
    origin = {"config": config.to_dict(), "versions": versions(), "seed": config.seed, "stages": dict(story.keys)}
    asset = FluidAsset(
        kind=g.meta["kind"],
        rest=body.rest_of(story),
        terrain=setting.terrain,
        grid=setting.terrain.grid,
        cell_types=setting.cell_types,
        velocity=lifting.targets_of(story)[0],
        parameters=moving.parameters_of(story),
        estimates=moving.estimates_of(story),
        camera=body.camera_of(story),
        world_from_canonical=body.placement_of(story),
        interval=clip.interval,
        frame_count=len(clip),
        provenance=provenance | origin,
    )
    write_force(folder, calibrating.force_of(_calibrated(story, asset, config)))
    save_asset(
        folder,
        asset,
        timings={k: float(t["seconds"]) for k, t in story.timings.items()},
        metrics=_metrics(story),
        warnings=story.warnings,
    )


def _calibrated(story: Story, asset: FluidAsset, config: JobConfig) -> Result:
    """The force that keeps the filmed flow, from a run without what scene.yaml changes."""
    with tempfile.TemporaryDirectory(prefix="fluidlift-calibrate-") as name:
        start = story["geometry"].meta["rest_frame"]
        scene = scene_of(asset, Path(name), SimulationRequest(), config, footage=None, start=start)
    target = calibrating.mean_target(asset, lifting.targets_of(story))
    return story.run(
        "calibrate",
        lambda: (
            calibrating.calibrate(scene, target, device=config.simulate.device, step=story.step)
            if config.simulate.follow > 0
            else Result()
        ),
        settings=[config.simulate.follow > 0, scene.frames, config.seed],
        after=("geometry", "refine", "motion", "fit"),
    )


def _write_film(story: Story, folder: Path) -> None:
    """The film that the fluid's surface plays; smoke has none."""
    from fluidlift.io.asset_folder import FILES
    from fluidlift.io.footage_file import MOST_FRAMES, write_footage

    film, start = folder / FILES["film"], story["geometry"].meta["rest_frame"]
    if kind_of(story["geometry"].meta["kind"]).is_gas:
        film.unlink(missing_ok=True)  # of an earlier run, as something else
        return
    clip = clip_of(story)
    first = first_of_film(start, len(clip))
    part = slice(first, first + MOST_FRAMES)
    write_footage(film, clip.frames[part], masks_of(story)[part], clip.interval)


def _metrics(story: Story) -> dict[str, Any]:
    g, refined, reports = story["geometry"].meta, story["refine"].meta, story["motion"].meta["reports"]
    return {
        "kind_scores": g["kind_evidence"]["scores"],
        "up": g["up"],
        "scale": g["scale"],
        "rest_frame": g["rest_frame"],
        "gaussians": refined["total"],
        "refine_psnr_after": refined.get("psnr_after"),
        "divergence_max": max((r.get("divergence_max", 0.0) for r in reports), default=None),
        "fit_converged": story["fit"].meta["converged"],
        "fit_rollouts": story["fit"].meta["rollouts"],
        "fit_extra": story["fit"].meta["extra"],
        "fit": fit_figures(story),
        "calibration": {k: story["calibrate"].meta.get(k) for k in ("acceleration", "speed", "left", "frames")},
    }


def fit_figures(story: Story) -> dict[str, Any]:
    """How the fit ended, and its table, for the manifest."""
    meta = story["fit"].meta
    return {k: meta[k] for k in ("status", "reason", "warnings", "notes", "table")}


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
