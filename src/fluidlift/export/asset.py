"""Files of a finished asset for other tools: meshes, splats, volumes, USD, glTF, a page, what the clip showed."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from fluidlift.export.gltf import write_hero
from fluidlift.export.job import (
    OF_CLIP,
    OWN_AXES,
    PICTURES,
    ExportJob,
    ExportOutcome,
    ExportRequest,
    as_simulated,
    checked,
    every,
)
from fluidlift.export.mesh import write_meshes
from fluidlift.export.splats import write_splats, write_spz_frames
from fluidlift.export.usd import write_usd_files
from fluidlift.export.volumes import write_volumes
from fluidlift.export.whitewater import has_whitewater, with_kinds
from fluidlift.io.frames import FIRST_FRAME, FluidFrame
from fluidlift.io.output_files import Written
from fluidlift.messages import Notice
from fluidlift.numerics.mesh_normals import vertex_normals
from fluidlift.present.surface_waves import SurfaceWaves, waves_of
from fluidlift.present.surfacing import surface_of
from fluidlift.scene.recall import simulated_scene
from fluidlift.scene.splat_files import frame_numbers, frames_of, frames_told
from fluidlift.seams import Progress, Silence
from fluidlift.types import FluidAsset, kind_of

MESHED = ("mesh", "obj", "usd", "usd-clips", "gltf")
"""formats with the surface of the fluid; of a liquid's volumes it makes the level set"""


def export_asset(folder: Path, out: Path, request: ExportRequest, *, progress: Progress | None = None) -> Written:
    """Write the frames of an asset below `out`, with terrain.glb beside meshes and splats.

    Args:
        folder: of the asset.
        out: folder for the files; numbered ones of an earlier run are replaced. For a page, a name that ends in .html
            will do.
        request: what is written.
        progress: where progress is told.

    Raises:
        InputRejected: no asset, no frames, a request that does not fit it, or a disk that does not take it.
        MissingPackage: a mesh without pysplashsurf.
    """
    from fluidlift.io.asset_folder import load_asset, read_manifest
    from fluidlift.io.atomic import disk_errors, require_writable

    progress, began = progress or Silence(), time.perf_counter()
    checked(request, out)
    manifest, asset = read_manifest(folder), load_asset(folder)
    page = out.suffix.lower() == ".html" and request.to == "html"
    progress.stage("export", 1, 1)
    if request.to in OF_CLIP:
        from fluidlift.export.clip import write_clip_files

        interval = asset.interval
        require_writable(out)
        with disk_errors(out):
            outcome = write_clip_files(folder, out, asset, request, manifest, progress)
    else:
        job = _job(folder, out, asset, request, manifest, progress)
        interval = job.interval
        require_writable(out.parent if page else out)
        with disk_errors(out):
            outcome = _written(job)
        none = (job.waves,) if isinstance(job.waves, Notice) else ()
        if isinstance(job.waves, SurfaceWaves):
            told = (outcome.facts or {}) | {"waves": job.waves.facts}
            outcome = replace(outcome, words=(*outcome.words, job.waves.told), facts=told)
        outcome = replace(outcome, warnings=(*_missing(job, manifest), *none, *outcome.warnings))
        outcome = replace(outcome, facts={"frames": len(job.picked), "first": FIRST_FRAME + job.picked.start}
                          | (outcome.facts or {}))  # fmt: skip
    seconds = time.perf_counter() - began
    progress.finished("export", seconds, False)
    for text in outcome.warnings:
        progress.warn(text)
    return _summary(out, request, outcome, interval, seconds)


def _job(
    folder: Path, out: Path, asset: FluidAsset, request: ExportRequest, manifest: dict[str, Any], progress: Progress
) -> ExportJob:
    """Which frames of the asset are written, how fast they follow each other, and the ground that they flow over."""
    played = manifest.get("simulation", {})
    interval = float(played.get("frame_interval", asset.interval))
    numbers = frame_numbers(folder, int(played.get("frames", 0)), request.frames)
    step = every(request.fps, interval)
    shown = as_simulated(folder, asset, manifest)
    job = ExportJob(folder, out, shown, request, numbers[::step], step * interval, progress, has_whitewater(manifest))
    return replace(job, waves=_waves(job, asset, manifest))


def _waves(job: ExportJob, asset: FluidAsset, manifest: dict[str, Any]) -> SurfaceWaves | Notice | None:
    """On the surface of the frames, where the format has one; None where none are asked for.

    Args:
        job: of the asset on the ground that its frames flow over.
        asset: as it was lifted.
        manifest: of it.
    """
    from fluidlift.io.scene import read_edits

    amount = read_edits(job.folder).waves
    if amount == 0 or kind_of(asset.kind).is_gas or job.request.to not in (*MESHED, "vdb"):
        return None
    numbers = frame_numbers(job.folder, int(manifest.get("simulation", {}).get("frames", 0)), None)
    return waves_of(simulated_scene(job.folder, asset, manifest), asset, job.folder, numbers, amount)


def _missing(job: ExportJob, manifest: dict[str, Any]) -> tuple[Notice, ...]:
    """A warning where frames of the simulation have gone."""
    simulated = int(manifest.get("simulation", {}).get("frames", 0))
    last = job.picked[-1] + 1
    if job.request.frames is not None or last >= simulated - (job.picked.step - 1):
        return ()
    return (Notice("frames-missing", f"frame {FIRST_FRAME + last} is missing: {last} of {simulated} frames are "
                                     f"exported; "
            f"fluidlift sim {job.folder} makes the others"),)  # fmt: skip


def _summary(out: Path, request: ExportRequest, outcome: ExportOutcome, interval: float, seconds: float) -> Written:
    facts = {
        "fps": round(1.0 / interval, 6), "to": request.to, "up_axis": OWN_AXES.get(request.to, request.up_axis),
        "meters_per_unit": request.meters_per_unit,
    } | (outcome.facts or {})  # fmt: skip
    axes = f", {facts['up_axis']} up, {facts['meters_per_unit']:g} m per unit"
    words = (f"{frames_told(facts['frames'])} as {request.to}: {out}", f"{facts['fps']:g} frames per second, from "
             f"{facts['first']}{axes * (request.to not in PICTURES)}", *outcome.words)  # fmt: skip
    return Written(out, seconds, outcome.warnings, {"export": {"seconds": round(seconds, 3)}}, facts, words)


def _written(job: ExportJob) -> ExportOutcome:
    """Hand the frames to the writer of the format."""
    to = job.request.to
    if to == "html":
        from fluidlift.export.page import write_page_of

        return write_page_of(job)
    if to == "spz":
        return write_spz_frames(job)
    if to == "gltf":
        return write_hero(job, lambda picked: next(_frames(replace(job, picked=picked))))
    writers = {"vdb": write_volumes, "splats": write_splats, "usd": write_usd_files, "usd-clips": write_usd_files}
    return writers.get(to, write_meshes)(job, _frames(job))


def _frames(job: ExportJob) -> Iterator[FluidFrame]:
    """Frame by frame, with the surface where the format has one."""
    mesher, asset = None, job.asset
    smoke = kind_of(asset.kind).is_gas  # its volumes say it all; as a surface it would be a lump
    if (job.request.to in MESHED and not (smoke and job.request.to in ("usd", "usd-clips"))) or (
        job.request.to == "vdb" and not smoke
    ):
        from fluidlift.backends.splashsurf import SplashsurfMesher

        mesher = SplashsurfMesher()
    for done, (gaussians, ids, velocities) in enumerate(frames_of(job.folder, job.picked)):
        job.progress.update(done, len(job.picked))
        frame = FluidFrame(gaussians, ids, velocities)
        if job.whitewater:
            frame = with_kinds(frame, asset.grid.spacing)
        if mesher is not None:
            mesh, moving = surface_of(gaussians, velocities, asset.terrain, mesher)
            if isinstance(job.waves, SurfaceWaves):
                now = job.picked[done] * job.waves.interval
                mesh, moving = job.waves.raised(mesh, vertex_normals(mesh), moving, now)
            frame = frame._replace(surface=mesh, surface_velocities=moving)
        yield frame
