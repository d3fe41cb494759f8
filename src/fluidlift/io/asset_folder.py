"""The asset folder: what is written where, and a reader that trusts nothing.

    river.fluid/
      manifest.json   parameters.json   scene.yaml
      rest/           gaussians.ply  terrain.glb  terrain.npz  velocity.vdb  velocity.npz  camera.json
      frames/         splats/####.ply   mesh/####.ply   velocity/####.vdb
      work/           cached stage results

Files for other tools (glb, vdb) lie beside exact arrays (npz), from which the asset is read back. Every file is written
under a temporary name and renamed.
"""

from __future__ import annotations

import importlib.resources
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
from jsonschema.exceptions import best_match

from fluidlift.errors import InputRejected
from fluidlift.io.array_archive import read_arrays, write_packed_arrays
from fluidlift.io.asset_paths import asset_file, require_no_links
from fluidlift.io.atomic import (
    atomic_path,
    atomic_write,
    disk_errors,
    plain,
    require_free_space,
    write_bytes,
    write_json,
)
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.hashes import digests
from fluidlift.io.limits import read_json
from fluidlift.io.ply import read_gaussians, write_gaussians
from fluidlift.io.scene import SCENE_TEMPLATE, read_scene
from fluidlift.io.stage_cache import WORK_MARKER, is_owner, load_stage, mark_owner, mark_work_folder, save_stage
from fluidlift.io.volume_grid import VolumeGrid, velocity_grid, write_vdb
from fluidlift.messages import as_plain
from fluidlift.types import (
    FORMAT_VERSION,
    CellType,
    Estimate,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Grid,
    PinholeCamera,
    Similarity3,
    Terrain,
    TriangleMesh,
    kind_of,
)

__all__ = [
    "FILES", "asset_file", "atomic_path", "atomic_write", "check_output_folder", "disk_errors", "is_owner",
    "load_asset", "load_stage", "mark_owner", "read_manifest", "read_parameters", "read_scene", "require_free_space",
    "save_asset", "save_stage", "update_manifest", "write_parameters",
]  # fmt: skip

FILES = {
    "gaussians": "rest/gaussians.ply",
    "terrain": "rest/terrain.npz",
    "terrain_mesh": "rest/terrain.glb",
    "velocity": "rest/velocity.npz",
    "velocity_volume": "rest/velocity.vdb",
    "camera": "rest/camera.json",
    "film": "rest/film.mp4",
    "force": "rest/force.npz",
    "motion": "rest/motion.npz",
    "parameters": "parameters.json",
    "scene": "scene.yaml",
}
"""where the parts lie, relative to the folder. Not every asset has film, force and motion: smoke of earlier versions
has no film, only streams and falls are calibrated, motion is asked for"""

_HASHED = frozenset(FILES) - {"scene"} | {"usd"}
"""parts whose SHA-256 the manifest keeps: all but what a person edits, and what is large"""

_MAX_JSON = 16 * 2**20


def check_output_folder(path: Path | str) -> Path:
    """The path, if an asset may be written there: it does not exist, is an empty folder, or holds an asset already.

    Raises:
        InputRejected: it is a file, a folder with other things in it or with links, or one that may not be looked into.
    """
    with disk_errors(path):
        return _checked_folder(Path(path))


def _checked_folder(path: Path) -> Path:
    if path.is_symlink() and not path.exists():
        raise InputRejected(f"'{path}' is a broken link", "a new name or an existing asset")
    if not path.exists():
        return path
    if not path.is_dir():
        raise InputRejected(f"'{path}' is a file", "a folder", "choose another name with -o")
    if any(path.iterdir()) and not _is_asset(path):
        raise InputRejected(
            f"the folder '{path}' holds other things",
            "a new name, an empty folder, or one of an earlier run",
            "choose another folder with -o; nothing was changed",
        )
    require_no_links(path)
    return path


def _is_asset(path: Path) -> bool:
    """Whether the folder was begun by fluidlift: our marker under work/, or a manifest of ours."""
    if asset_file(path, f"work/{WORK_MARKER}").is_file():
        return True
    file = asset_file(path, "manifest.json")
    try:
        manifest = read_json(file, "manifest", _MAX_JSON)
    except InputRejected:
        return False
    return isinstance(manifest, dict) and manifest.get("format") == "fluidlift asset"


def save_asset(
    folder: Path | str,
    asset: FluidAsset,
    *,
    timings: Mapping[str, Any] | None = None,
    metrics: Mapping[str, Any] | None = None,
    warnings: Sequence[str] = (),
    files: Mapping[str, str] | None = None,
    start_frame: int = FIRST_FRAME,
) -> Path:
    """Write or rewrite an asset. `scene.yaml` is written only if there is none: it belongs to the person who edits it.

    Args:
        folder: as `check_output_folder` accepts it.
        timings: seconds per stage, or dictionaries with seconds and more.
        metrics: figures for the report.
        warnings: what the user should know.
        files: further files of the folder by name, relative (preview, report, asset_usd, mask, ...).
        start_frame: number of the first frame of exported sequences.

    Returns:
        The folder.

    Raises:
        InputRejected: the folder holds other things, or the disk is full or may not be written.
    """
    folder = check_output_folder(folder)
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        mark_work_folder(folder)
        write_gaussians(asset_file(folder, FILES["gaussians"]), asset.rest, comments=["rest shape"])
        _write_terrain(folder, asset)
        _write_velocity(folder, asset)
        write_json(asset_file(folder, FILES["camera"]), asset.camera.to_dict())
        write_parameters(folder, asset.parameters, asset.estimates)
        if not (scene := asset_file(folder, FILES["scene"])).exists():
            write_bytes(scene, SCENE_TEMPLATE.encode())
        present = {name: file for name, file in FILES.items() if (folder / file).is_file()}
        manifest = (
            _manifest(asset, start_frame)
            | {
                "files": present | dict(files or {}),
                "hashes": _hashes(folder, present | dict(files or {})),
                "timings": dict(timings or {}),
                "metrics": dict(metrics or {}),
            }
            | as_plain(warnings)
        )
        _write_manifest(folder, manifest)  # last: an asset without a manifest is not finished
    return folder


def _manifest(asset: FluidAsset, start_frame: int) -> dict[str, Any]:
    canonical = asset.world_from_canonical
    return {
        "format": "fluidlift asset",
        "format_version": FORMAT_VERSION,
        "kind": kind_of(asset.kind).name,
        "units": {"length": "m", "time": "s", "mass": "kg", "up": "z"},
        "frame_interval": asset.interval,
        "frame_count": asset.frame_count,
        "start_frame": start_frame,
        "grid": _grid_dict(asset.grid),
        "world_from_canonical": {
            "scale": canonical.scale,
            "rotation": canonical.rotation,
            "translation": canonical.translation,
        },
        "provenance": asset.provenance,
    }


def _write_manifest(folder: Path, manifest: Mapping[str, Any]) -> None:
    data = plain(manifest)
    _validate(data, "manifest", ValueError)
    for name in data["files"].values():
        asset_file(folder, name)
    write_json(asset_file(folder, "manifest.json"), data, lasting=True)


def update_manifest(folder: Path | str, **changes: Any) -> dict[str, Any]:
    """Change top-level entries of a manifest; dictionaries are merged, anything else is replaced. The new manifest."""
    manifest = read_manifest(folder)
    for key, value in changes.items():
        merge = isinstance(value, Mapping) and isinstance(manifest.get(key), dict)
        manifest[key] = {**manifest[key], **value} if merge else value
    manifest["hashes"] = manifest.get("hashes", {}) | _hashes(Path(folder), changes.get("files", {}))
    _write_manifest(Path(folder), manifest)
    return plain(manifest)


def _hashes(folder: Path, files: Mapping[str, str]) -> dict[str, str]:
    return digests(folder, (file for name, file in files.items() if name in _HASHED))


def read_manifest(folder: Path | str) -> dict[str, Any]:
    """The manifest of an asset, checked.

    Raises:
        InputRejected: no asset, a newer format, a broken manifest, or a link or a file entry that leads out of the
            folder.
    """
    folder = Path(folder)
    if not (folder / "manifest.json").is_file():
        why = "it has no manifest.json" if folder.exists() else "there is nothing of that name"
        do = "check the name, or run 'fluidlift make' to its end"
        raise InputRejected(f"'{folder}' is not a fluidlift asset ({why})", "a folder made with 'fluidlift make'", do)
    require_no_links(folder)
    manifest = read_json(folder / "manifest.json", "manifest", _MAX_JSON)
    version = manifest.get("format_version") if isinstance(manifest, dict) else None
    if isinstance(version, int) and version > FORMAT_VERSION:
        raise InputRejected(
            f"'{folder.name}' has format version {version}",
            f"version {FORMAT_VERSION} or older",
            "update fluidlift: pip install -U fluidlift",
        )
    _validate(manifest, "manifest", InputRejected)
    kind_of(manifest["kind"])
    for name in manifest["files"].values():
        asset_file(folder, name)
    return manifest


def load_asset(folder: Path | str) -> FluidAsset:
    """Read an asset back. `scene.yaml` is not applied here; `read_scene` gives its content.

    Raises:
        InputRejected: as `read_manifest`, or a missing, damaged or contradictory part.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    part = {name: asset_file(folder, file) for name, file in manifest["files"].items()}
    parameters, estimates = read_parameters(part["parameters"])
    camera = read_json(part["camera"], "camera JSON", _MAX_JSON)
    canonical = manifest["world_from_canonical"]
    moving = read_arrays(part["velocity"], ("u", "v", "w", "cell_types"))
    try:
        grid = _grid(manifest["grid"])
        velocity = FaceVelocity(moving["u"], moving["v"], moving["w"])
        if velocity.shape != grid.shape or moving["cell_types"].shape != grid.shape:
            raise ValueError(f"velocity {velocity.shape} for a grid {grid.shape}")
        if moving["cell_types"].dtype != np.uint8 or moving["cell_types"].max() > max(CellType):
            raise ValueError("cell types that do not exist")
        return FluidAsset(
            kind=manifest["kind"],
            rest=read_gaussians(part["gaussians"]),
            terrain=_read_terrain(part["terrain"]),
            grid=grid,
            cell_types=moving["cell_types"],
            velocity=velocity,
            parameters=parameters,
            estimates=estimates,
            camera=PinholeCamera.from_dict(camera),
            world_from_canonical=Similarity3(
                canonical["scale"], np.array(canonical["rotation"]), np.array(canonical["translation"])
            ),
            interval=manifest["frame_interval"],
            frame_count=manifest["frame_count"],
            provenance=manifest.get("provenance", {}),
        )
    except (ValueError, TypeError, IndexError, OverflowError) as error:
        raise InputRejected(f"the parts of '{folder.name}' contradict each other: {error}", "a whole asset") from None


def write_parameters(folder: Path | str, parameters: FluidParameters, estimates: Mapping[str, Estimate]) -> Path:
    """Write parameters.json, and its hash in the manifest if there is one. A sigma of infinity becomes null."""
    data = plain({"values": parameters.to_dict(), "estimates": {k: vars(e) for k, e in estimates.items()}})
    _validate(data, "parameters", ValueError)
    path = write_json(asset_file(folder, FILES["parameters"]), data, lasting=True)
    with suppress(InputRejected):  # no manifest yet, or one that is about to be replaced
        update_manifest(folder, hashes=digests(folder, [FILES["parameters"]]))
    return path


def read_parameters(path: Path | str) -> tuple[FluidParameters, dict[str, Estimate]]:
    """Parameters and their estimates.

    Args:
        path: of parameters.json.

    Raises:
        InputRejected: a broken file or a value out of its range.
    """
    data = read_json(path, "parameters.json", _MAX_JSON)
    _validate(data, "parameters", InputRejected)
    estimates = {}
    for name, e in data["estimates"].items():
        sigma = np.inf if e["sigma"] is None else float(e["sigma"])
        prior = np.nan if e["prior"] is None else float(e["prior"])
        interval = (float(e["interval"][0]), float(e["interval"][1])) if e.get("interval") else None
        estimates[name] = Estimate(
            float(e["value"]), sigma, e["identifiable"], prior, e.get("unit", ""), interval, e.get("source", "")
        )
    return FluidParameters().updated(data["values"]), estimates


@cache
def _validator(name: str) -> jsonschema.Draft202012Validator:
    text = importlib.resources.files("fluidlift.io").joinpath(f"{name}.schema.json").read_text(encoding="utf-8")
    return jsonschema.Draft202012Validator(json.loads(text))


def _validate(data: Any, name: str, error: type[Exception]) -> None:
    """Raise the first and deepest complaint of the schema, or one about a number that is not finite."""
    waiting = [data]
    while waiting:
        part = waiting.pop()
        if isinstance(part, dict | list):
            waiting += part.values() if isinstance(part, dict) else part
        elif isinstance(part, float) and not math.isfinite(part):
            raise error(f"{name}.json: the number {part}, which is not finite")
    complaint = best_match(_validator(name).iter_errors(data))
    if complaint is not None:
        raise error(f"{name}.json: {complaint.json_path}: {complaint.message[:300]}")


def _grid_dict(grid: Grid) -> dict[str, Any]:
    return {"shape": list(grid.shape), "spacing": grid.spacing, "origin": list(grid.origin)}


def _grid(data: Mapping[str, Any]) -> Grid:
    return Grid(tuple(data["shape"]), data["spacing"], tuple(data["origin"]))


def _write_terrain(folder: Path, asset: FluidAsset) -> None:
    terrain = asset.terrain
    arrays: dict[str, Any] = {
        "shape": np.array(terrain.grid.shape),
        "spacing": np.array(terrain.grid.spacing),
        "origin": np.array(terrain.grid.origin),
        "signed_distance": terrain.signed_distance,
        "mainstream": terrain.mainstream,
        "vertices": terrain.mesh.vertices,
        "faces": terrain.mesh.faces,
    }
    arrays |= {k: v for k in ("colors", "uv", "texture") if (v := getattr(terrain.mesh, k)) is not None}
    arrays |= {"opaque": np.array(True)} if terrain.opaque else {}
    with atomic_write(asset_file(folder, FILES["terrain"])) as file:
        write_packed_arrays(file, arrays)
    glb = asset_file(folder, FILES["terrain_mesh"])
    if len(terrain.mesh.faces):
        from fluidlift.io.export_mesh import write_glb  # trimesh is slow to import

        write_glb(glb, terrain.mesh)
    else:
        glb.unlink(missing_ok=True)


def _read_terrain(path: Path) -> Terrain:
    a = read_arrays(path, ("shape", "spacing", "origin", "signed_distance", "mainstream", "vertices", "faces"))
    grid = Grid(tuple(a["shape"].tolist()), float(a["spacing"]), tuple(a["origin"].tolist()))
    faces = a["faces"]
    if len(faces) and (faces.min() < 0 or faces.max() >= len(a["vertices"])):
        raise ValueError("terrain faces that name missing vertices")
    mesh = TriangleMesh(a["vertices"], faces, a.get("colors"), a.get("uv"), a.get("texture"))
    return Terrain(grid, a["signed_distance"], a["mainstream"], mesh, bool(a.get("opaque", False)))


def _write_velocity(folder: Path, asset: FluidAsset) -> None:
    v = asset.velocity
    with atomic_write(asset_file(folder, FILES["velocity"])) as file:
        write_packed_arrays(file, {"u": v.u, "v": v.v, "w": v.w, "cell_types": asset.cell_types})
    fluid = np.isin(asset.cell_types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW))
    density = VolumeGrid("density", fluid.astype(np.float32), asset.grid.spacing, asset.grid.origin)
    write_vdb(asset_file(folder, FILES["velocity_volume"]), [density, velocity_grid(v, asset.grid, active=fluid)])
