"""Files of a finished asset for other tools: surface meshes, splats, USD, in the axes and units that they take."""

from __future__ import annotations

import difflib
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.frames import FIRST_FRAME, FluidFrame
from fluidlift.pipeline.rendering import frame_numbers, frames_told
from fluidlift.pipeline.showing import splat_frames
from fluidlift.pipeline.story import Progress, Silence
from fluidlift.pipeline.written import Written, cleared, numbered
from fluidlift.types import FaceVelocity, FluidAsset, Gaussians, Grid, Similarity3, Terrain, TriangleMesh

if TYPE_CHECKING:
    from fluidlift.io.volume_grid import VolumeGrid

FORMATS = ("mesh", "obj", "splats", "vdb", "usd")
AXES = ("z", "y")
OWN_AXES = ("vdb", "usd")
"""formats whose files are z up and in metres whatever is asked for"""
BAND = 3.0
"""half width of the level set, voxels: what OpenVDB's own tools expect"""
FULL = 50.0
"""percentile of the cells' amounts that counts as a full cell"""
RADIUS = 0.4
"""of a particle in the mesh, cells of the simulation: neighbours lie half a cell apart after reseeding, and a little
more keeps drops whole and flat water flat"""


@dataclass(frozen=True)
class ExportRequest:
    """What is written, and how."""

    to: str
    """mesh: surface as PLY with colours and velocities; obj: the same as OBJ, without velocities; splats: Gaussians as
    splat viewers take them; vdb: OpenVDB with velocity, density and, of liquids, the level set; usd: one OpenUSD file
    with surface, splats, terrain and camera"""
    up_axis: str = "z"
    """z or y; USD states its axis itself and stays z up, and OpenVDB files stay z up, in metres"""
    meters_per_unit: float = 1.0
    """m that one unit of the files is; USD states its unit itself and stays in metres"""
    frames: tuple[int, int] | None = None
    """first and last number, from 1001; None: all"""


def export_asset(folder: Path, out: Path, request: ExportRequest, *, progress: Progress | None = None) -> Written:
    """Write the frames of an asset below `out`, with terrain.glb beside them.

    Args:
        folder: of the asset.
        out: folder for the files; numbered ones of an earlier run are replaced.
        request: what is written.
        progress: where progress is told.

    Raises:
        InputRejected: no asset, no frames, or a request that does not fit it.
        MissingPackage: a mesh without pysplashsurf.
    """
    from fluidlift.io.asset_folder import load_asset, read_manifest
    from fluidlift.io.atomic import disk_errors

    progress, began = progress or Silence(), time.perf_counter()
    _check(request, out)
    manifest, asset = read_manifest(folder), load_asset(folder)
    played = manifest.get("simulation", {})
    numbers = frame_numbers(folder, int(played.get("frames", 0)), request.frames)
    interval = float(played.get("frame_interval", asset.interval))
    progress.stage("export", 1, 1)
    frames = _frames(folder, numbers, asset, request, progress)
    with disk_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        if request.to == "usd":
            _usd(out, frames, asset, interval, numbers)
        elif request.to == "vdb":
            _volumes(out, frames, asset, numbers)
        else:
            _files(out, frames, asset, request, numbers)
    seconds = time.perf_counter() - began
    progress.finished("export", seconds, False)
    own = request.to in OWN_AXES
    facts = {
        "frames": len(numbers), "first": FIRST_FRAME + numbers[0], "fps": round(1.0 / interval, 6), "to": request.to,
        "up_axis": "z" if own else request.up_axis, "meters_per_unit": 1.0 if own else request.meters_per_unit,
    }  # fmt: skip
    words = (f"{frames_told(len(numbers))} as {request.to}: {out}", f"{facts['fps']:g} frames per second, from "
             f"{facts['first']}, {facts['up_axis']} up, {facts['meters_per_unit']:g} m per unit")  # fmt: skip
    return Written(out, seconds, (), {"export": {"seconds": round(seconds, 3)}}, facts, words)


def _check(request: ExportRequest, out: Path) -> None:
    if request.to not in FORMATS:
        near = difflib.get_close_matches(request.to, FORMATS, 1)
        raise InputRejected(f"no format '{request.to}'", ", ".join(FORMATS), f"did you mean {near[0]}?" if near else "")
    if request.up_axis not in AXES:
        raise InputRejected(f"an up axis '{request.up_axis}'", " or ".join(AXES))
    if request.to in OWN_AXES and (request.up_axis != "z" or request.meters_per_unit != 1.0):
        raise InputRejected(
            f"{request.to} with other axes or units", "z up and metres", "leave out --up-axis and --meters-per-unit"
        )
    if not (np.isfinite(request.meters_per_unit) and 1e-6 <= request.meters_per_unit <= 1e6):
        raise InputRejected(f"{request.meters_per_unit:g} m per unit", "1e-6 to 1e6, such as 0.01 for centimetres")
    if out.exists() and not out.is_dir():
        raise InputRejected(f"'{out.name}', which is a file", "a folder")


def _frames(
    folder: Path, numbers: range, asset: FluidAsset, request: ExportRequest, progress: Progress
) -> Iterator[FluidFrame]:
    """Frame by frame, with the surface where the format has one."""
    mesher = None
    if request.to in ("mesh", "obj", "usd") or (request.to == "vdb" and asset.kind != "plume"):
        from fluidlift.backends.splashsurf import SplashsurfMesher

        mesher = SplashsurfMesher()
    for k, (gaussians, ids, velocities) in enumerate(splat_frames(folder, numbers.stop)):
        if k < numbers.start:
            continue
        progress.update(k - numbers.start, len(numbers))
        if mesher is None:
            yield FluidFrame(gaussians, ids, velocities)
            continue
        carried = {"velocity": velocities, "rgb": gaussians.rgb}
        mesh, found = mesher.surface(gaussians.means, RADIUS * asset.grid.spacing, carried)
        mesh = TriangleMesh(outside_solid(mesh.vertices, asset.terrain), mesh.faces, np.clip(found["rgb"], 0.0, 1.0))
        yield FluidFrame(gaussians, ids, velocities, mesh, found["velocity"])


def outside_solid(points: np.ndarray, terrain: Terrain) -> np.ndarray:
    """Points [n,3] (m) inside the terrain moved to its surface along the gradient of the distance; the others stay.

    A surface of particles stands a radius outside them and would dip into the bed.
    """
    from fluidlift.numerics.sampling import gradient_nodes, sample_nodes

    moved = np.array(points, np.float32)
    for _ in range(2):  # the distance is not exact beside edges: once more brings most of the rest out
        distance = sample_nodes(terrain.signed_distance, terrain.grid, moved)
        inside = (distance < 0) & terrain.grid.contains(moved)
        if not inside.any():
            break
        normal = gradient_nodes(terrain.signed_distance, terrain.grid, moved[inside])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)
        moved[inside] -= distance[inside, None] * normal
    return moved


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


def _usd(out: Path, frames: Iterator[FluidFrame], asset: FluidAsset, interval: float, numbers: range) -> None:
    """One file with all of it."""
    from fluidlift.io.export_usd import write_usd

    write_usd(
        out / "fluid.usda", frames=frames, interval=interval, start_frame=FIRST_FRAME + numbers[0],
        terrain=asset.terrain.mesh, camera=asset.camera, attributes=asset.parameters.to_dict() | {"kind": asset.kind},
    )  # fmt: skip


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
    liquid fills, and how thick smoke is.
    """
    from fluidlift.physics.transfer import particles_to_grid
    from fluidlift.types import Particles

    points, h = frame.gaussians.means.astype(np.float64), cells.spacing
    first = np.floor((points.min(axis=0) - cells.low) / h).astype(int) - 1
    last = np.floor((points.max(axis=0) - cells.low) / h).astype(int) + 2
    (nx, ny, nz), (x, y, z) = (last - first).tolist(), (cells.low + first * h).tolist()
    grid = Grid((nx, ny, nz), h, (x, y, z))
    velocity, _ = particles_to_grid(Particles.at_rest(points, 1.0, velocities=frame.velocities), grid)
    flat = np.ravel_multi_index(tuple(grid.cell_of(points).T), grid.shape)
    amount = np.bincount(flat, weights=frame.gaussians.opacities, minlength=grid.cells).reshape(grid.shape)
    full = np.percentile(amount[amount > 0], FULL)
    return velocity, np.clip(amount / max(float(full), 1e-12), 0.0, 1.0).astype(np.float32), grid
