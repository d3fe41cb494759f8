"""Files of a finished asset for other tools: meshes, splats, volumes, USD, glTF, a page, what the clip showed."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.io.frames import FIRST_FRAME, FluidFrame
from fluidlift.pipeline.export_job import (
    FORMATS,
    OF_CLIP,
    OWN_AXES,
    PICTURES,
    ExportJob,
    ExportRequest,
    Outcome,
    as_simulated,
    checked,
    every,
)
from fluidlift.pipeline.rendering import frame_numbers, frames_told
from fluidlift.pipeline.splat_files import frames_of
from fluidlift.pipeline.surfacing import surface_of
from fluidlift.pipeline.work import Progress, Silence
from fluidlift.pipeline.written import Written, cleared, numbered
from fluidlift.types import FaceVelocity, FluidAsset, Gaussians, Grid, Similarity3, TriangleMesh, kind_of

if TYPE_CHECKING:
    from fluidlift.io.volume_grid import VolumeGrid

__all__ = ["FORMATS", "ExportRequest", "export_asset", "gridded", "level_set"]

MESHED = ("mesh", "obj", "usd", "usd-clips", "gltf")
"""formats with the surface of the fluid; of a liquid's volumes it makes the level set"""
BAND = 3.0
"""half width of the level set, voxels: what OpenVDB's own tools expect"""
FULL = 50.0
"""percentile of the cells' amounts that counts as a full cell"""


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
        from fluidlift.pipeline.export_clip import write_clip_files

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
        outcome = replace(outcome, warnings=(*_missing(job, manifest), *outcome.warnings))
        outcome = replace(outcome, facts={"frames": len(job.picked), "first": FIRST_FRAME + job.picked.start}
                          | (outcome.facts or {}))  # fmt: skip
    seconds = time.perf_counter() - began
    progress.finished("export", seconds, False)
    for text in outcome.warnings:
        progress.warn(text)
    return _told(out, request, outcome, interval, seconds)


def _job(
    folder: Path, out: Path, asset: FluidAsset, request: ExportRequest, manifest: dict[str, Any], progress: Progress
) -> ExportJob:
    """Which frames of the asset are written, how fast they follow each other, and the ground that they flow over."""
    played = manifest.get("simulation", {})
    interval = float(played.get("frame_interval", asset.interval))
    numbers = frame_numbers(folder, int(played.get("frames", 0)), request.frames)
    step = every(request.fps, interval)
    asset = as_simulated(folder, asset, manifest)
    return ExportJob(folder, out, asset, request, numbers[::step], step * interval, progress)


def _missing(job: ExportJob, manifest: dict[str, Any]) -> tuple[str, ...]:
    """A warning where frames of the simulation have gone."""
    simulated = int(manifest.get("simulation", {}).get("frames", 0))
    last = job.picked[-1] + 1
    if job.request.frames is not None or last >= simulated - (job.picked.step - 1):
        return ()
    return (f"frame {FIRST_FRAME + last} is missing: {last} of {simulated} frames are exported; "
            f"fluidlift sim {job.folder} makes the others",)  # fmt: skip


def _told(out: Path, request: ExportRequest, outcome: Outcome, interval: float, seconds: float) -> Written:
    facts = {
        "fps": round(1.0 / interval, 6), "to": request.to, "up_axis": OWN_AXES.get(request.to, request.up_axis),
        "meters_per_unit": request.meters_per_unit,
    } | (outcome.facts or {})  # fmt: skip
    axes = f", {facts['up_axis']} up, {facts['meters_per_unit']:g} m per unit"
    words = (f"{frames_told(facts['frames'])} as {request.to}: {out}", f"{facts['fps']:g} frames per second, from "
             f"{facts['first']}{axes * (request.to not in PICTURES)}", *outcome.words)  # fmt: skip
    return Written(out, seconds, outcome.warnings, {"export": {"seconds": round(seconds, 3)}}, facts, words)


def _written(job: ExportJob) -> Outcome:
    """Hand the frames to the writer of the format."""
    to, asset = job.request.to, job.asset
    if to == "html":
        from fluidlift.pipeline.export_page import write_page_of

        return write_page_of(job)
    if to == "spz":
        from fluidlift.pipeline.export_web import write_spz_frames

        return write_spz_frames(job)
    if to == "gltf":
        from fluidlift.pipeline.export_web import write_hero

        return write_hero(job, lambda picked: next(_frames(replace(job, picked=picked))))
    frames = _frames(job)
    if to in ("usd", "usd-clips"):
        return _usd(job, frames)
    if to == "vdb":
        _volumes(job.out, frames, asset, job.numbers)
    else:
        _files(job.out, frames, asset, job.request, job.numbers)
        if to == "mesh":
            return Outcome(warnings=_bodies(job))
    return Outcome()


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
        if mesher is None:
            yield FluidFrame(gaussians, ids, velocities)
            continue
        mesh, moving = surface_of(gaussians, velocities, asset.terrain, mesher)
        yield FluidFrame(gaussians, ids, velocities, mesh, moving)


def _files(out: Path, frames: Iterator[FluidFrame], asset: FluidAsset, request: ExportRequest, numbers: range) -> None:
    """Numbered files and the terrain, in the axes and the units that were asked for."""
    from fluidlift.io.export_mesh import write_glb, write_mesh, write_obj
    from fluidlift.io.ply import AXES as ROTATIONS
    from fluidlift.io.ply import write_gaussians

    axes, unit = f"{request.up_axis}_up", f"{request.up_axis} up, one unit is {request.meters_per_unit:g} m"
    place = Similarity3(1.0 / request.meters_per_unit, ROTATIONS[axes], np.zeros(3))
    suffix = ".obj" if request.to == "obj" else ".ply"
    cleared(out, [suffix])
    for k, frame in zip(numbers, frames, strict=True):
        path = numbered(out, k, suffix)
        if request.to == "splats":
            scaled: Gaussians = frame.gaussians.transformed(Similarity3(place.scale))
            velocities = frame.velocities * np.float32(place.scale)
            write_gaussians(path, scaled, ids=frame.ids, velocities=velocities, axes=axes, comments=[unit])
            continue
        assert frame.surface is not None and frame.surface_velocities is not None  # `_frames` makes both
        mesh = TriangleMesh(place.points(frame.surface.vertices), frame.surface.faces, frame.surface.colors)
        if request.to == "obj":
            write_obj(path, mesh, comment=unit)
        else:
            write_mesh(path, mesh, velocities=place.vectors(frame.surface_velocities), comment=unit)
    if len(asset.terrain.mesh.faces):
        write_glb(out / "terrain.glb", asset.terrain.mesh)


def _bodies(job: ExportJob) -> tuple[str, ...]:
    """Obstacles beside the meshes of the fluid, in the same axes and units; warnings.

    bodies/NUMBER_NAME.ply has one around its own origin, bodies.json where it is in every frame: "poses" [frames][7],
    place of the origin and unit quaternion w x y z, from the frame "first" on.
    """
    from fluidlift.io.atomic import atomic_write
    from fluidlift.io.export_mesh import write_mesh
    from fluidlift.io.ply import AXES as ROTATIONS
    from fluidlift.pipeline.usd_exporting import bodies_of

    request, listed = job.request, job.out / "bodies.json"
    listed.unlink(missing_ok=True)
    if (job.out / "bodies").is_dir():
        cleared(job.out / "bodies", [".ply"])
    bodies, warnings = bodies_of(job.folder, job.picked)
    place = Similarity3(1.0 / request.meters_per_unit, ROTATIONS[f"{request.up_axis}_up"], np.zeros(3))
    entries: list[dict[str, Any]] = []
    for k, body in enumerate(bodies, 1):
        stem = "".join(c if (c.isascii() and c.isalnum()) or c in "-_" else "_" for c in body.name)
        path = f"bodies/{k:02d}_{stem[:60]}.ply"
        (job.out / "bodies").mkdir(exist_ok=True)
        write_mesh(job.out / path, TriangleMesh(place.points(body.mesh.vertices), body.mesh.faces, body.mesh.colors))
        # turned on both sides, R q R^-1 keeps the angle and turns the axis
        turned = np.concatenate([body.orientations[:, :1], body.orientations[:, 1:] @ place.rotation.T], axis=1)
        poses = np.concatenate([place.points(body.positions), turned], axis=1).astype(float)
        first = FIRST_FRAME + job.numbers.start
        entries.append({"name": body.name, "mesh": path, "first": first, "poses": poses.tolist()})
    if entries:
        facts = {"up_axis": request.up_axis, "meters_per_unit": request.meters_per_unit, "bodies": entries}
        with atomic_write(listed) as file:
            file.write(json.dumps(facts).encode())
    return warnings


def _usd(job: ExportJob, frames: Iterator[FluidFrame]) -> Outcome:
    """One file with all of it, or one with a clip per frame."""
    from fluidlift.io.export_usd import UsdSettings
    from fluidlift.pipeline.usd_exporting import write_usd_asset

    layout = "clips" if job.request.to == "usd-clips" else "file"
    axes, unit = job.request.up_axis, job.request.meters_per_unit
    settings = UsdSettings(FIRST_FRAME + job.numbers.start, axes, unit, layout)
    return Outcome(warnings=write_usd_asset(job, frames, settings))


def _volumes(out: Path, frames: Iterator[FluidFrame], asset: FluidAsset, numbers: range) -> None:
    """Numbered OpenVDB files: `vel` (m/s) and `density` on cells of the simulation, `surface` (m) on half of them."""
    from fluidlift.io.volume_grid import VolumeGrid, velocity_grid, write_vdb

    cleared(out, [".vdb"])
    h = asset.grid.spacing
    for k, frame in zip(numbers, frames, strict=True):
        velocity, density, grid = gridded(frame, asset.grid)
        filled = density > 0
        grids = [velocity_grid(velocity, grid, active=filled), VolumeGrid("density", density, h, grid.origin, filled)]
        if frame.surface is not None and len(frame.surface.faces):
            grids.append(level_set(frame.surface, 0.5 * h))
        write_vdb(numbered(out, k, ".vdb"), grids)


def level_set(mesh: TriangleMesh, spacing: float) -> VolumeGrid:
    """Signed distance (m) of a closed mesh as OpenVDB's tools take it: cut at three voxels, the inside stored as well,
    because the writer knows no tiles and what is not stored counts as outside."""
    from fluidlift.io.volume_grid import VolumeGrid
    from fluidlift.numerics.mesh_distance import mesh_distance

    found, band = mesh_distance(mesh, spacing), BAND * spacing
    x, y, z = (float(v) - 0.5 * spacing for v in found.grid.origin)  # the voxels' middles lie on the nodes
    values, stored = np.clip(found.distance, -band, band), found.distance < band
    return VolumeGrid("surface", values, spacing, (x, y, z), stored, grid_class="level set", background=band)


def gridded(frame: FluidFrame, cells: Grid) -> tuple[FaceVelocity, np.ndarray, Grid]:
    """Velocity and density of a frame on cells that lie on those of the simulation, as far as its particles reach.

    Density is the opacity of the splats in a cell next to that of a full one, at most 1: the share of a cell that a
    liquid fills, and how thick smoke is. A skin is no liquid.
    """
    from fluidlift.look.surface_skin import of_skin
    from fluidlift.physics.transfer import particles_to_grid
    from fluidlift.types import Particles

    h, liquid = cells.spacing, ~of_skin(frame.gaussians, cells.spacing)
    points = frame.gaussians.means[liquid].astype(np.float64)
    first = np.floor((points.min(axis=0) - cells.low) / h).astype(int) - 1
    last = np.floor((points.max(axis=0) - cells.low) / h).astype(int) + 2
    (nx, ny, nz), (x, y, z) = (last - first).tolist(), (cells.low + first * h).tolist()
    grid = Grid((nx, ny, nz), h, (x, y, z))
    velocity, _ = particles_to_grid(Particles.at_rest(points, 1.0, velocities=frame.velocities[liquid]), grid)
    flat = np.ravel_multi_index(tuple(grid.cell_of(points).T), grid.shape)
    amount = np.bincount(flat, weights=frame.gaussians.opacities[liquid], minlength=grid.cells).reshape(grid.shape)
    full = np.percentile(amount[amount > 0], FULL)
    return velocity, np.clip(amount / max(float(full), 1e-12), 0.0, 1.0).astype(np.float32), grid
