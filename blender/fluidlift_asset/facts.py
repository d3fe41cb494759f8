"""What an asset's folder says about itself, in plain values; works without Blender."""

from __future__ import annotations

import json
import math
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

FIRST = 1001
"""number of the first frame"""
EXPORTED = "blender"
"""folder in the asset: what is written for Blender"""
WHITEWATER = "whitewater"
"""folder beside the meshes: points of white water"""


class Facts(NamedTuple):
    """Of the frames on disk."""

    interval: float
    """s between two frames"""
    parameters: dict[str, Any]
    """density kg/m³, kinematic_viscosity m²/s, gravity m/s², inflow_velocity m/s, ..."""
    material: str
    """source: the clip's own colours"""
    tint: tuple[float, ...]
    cell: float
    """m, of the simulation's grid"""
    fitted: dict[str, Any]
    """parameters as they were lifted, without any edit"""
    whitewater: bool = False
    """whether the frames were simulated with white water"""


def require_asset(folder: Path | None) -> Path:
    """The folder, where it is an asset's.

    Raises:
        RuntimeError: it is not.
    """
    if folder is None or not str(folder).strip():
        raise RuntimeError("Choose an asset first: a folder that ends in .fluid.")
    if not folder.is_dir():
        raise RuntimeError(f"There is no folder {folder}. An asset is a folder that ends in .fluid.")
    if not (folder / "manifest.json").is_file():
        raise RuntimeError(f"{folder} is no asset: it has no manifest.json. fluidlift make CLIP writes an asset.")
    return folder


def read_facts(folder: Path) -> Facts:
    """What manifest.json and parameters.json say.

    Raises:
        RuntimeError: a file that is missing, damaged or of another kind.
    """
    manifest, fitted = _json(folder / "manifest.json"), _json(folder / "parameters.json")
    try:
        played = manifest.get("simulation") or {}
        look = played.get("look") or {}
        styled = look.get("style", "splats") != "splats"
        return Facts(
            float(played.get("frame_interval", manifest["frame_interval"])),
            dict(fitted["values"]) | dict(played.get("parameters", {})),
            str(look.get("material", "source")) if styled else "source",
            tuple(float(t) for t in look.get("tint", (1.0, 1.0, 1.0))) if styled else (1.0, 1.0, 1.0),
            float((played.get("grid") or manifest["grid"])["spacing"]),
            dict(fitted["values"]),
            "white water" in dict(played.get("parts") or {}),
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise RuntimeError(f"{folder.name} does not say what an asset says ({error}): is it damaged?") from None


class Body(NamedTuple):
    """An obstacle beside the meshes of the fluid."""

    name: str
    mesh: Path
    first: int
    """number of the frame of the first pose"""
    poses: list[list[float]]
    """place and unit quaternion w x y z, one per frame"""


def read_bodies(folder: Path) -> list[Body]:
    """What bodies.json lists; nothing where there is none.

    Raises:
        RuntimeError: it cannot be read, an entry is not whole, or a mesh is elsewhere than below bodies/.
    """
    file = folder / "bodies.json"
    if not file.is_file():
        return []
    told = _json(file)
    listed = told.get("bodies") if isinstance(told, dict) else None
    if not isinstance(listed, list):
        raise RuntimeError(f"{file} has no list of bodies: export the meshes again.")
    return [_body(entry, k, folder) for k, entry in enumerate(listed, 1)]


def _body(entry: Any, number: int, folder: Path) -> Body:
    try:
        found = Body(str(entry["name"]), _mesh_file(entry["mesh"], folder), int(entry["first"]),
                     [[float(v) for v in pose] for pose in entry["poses"]])  # fmt: skip
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise RuntimeError(f"bodies.json, body {number} is not whole ({error}): export the meshes again.") from None
    if not found.poses or any(len(p) != 7 or not all(map(math.isfinite, p)) for p in found.poses):
        raise RuntimeError(f"bodies.json, body {number} '{found.name}': poses that are not seven finite numbers each.")
    return found


def _mesh_file(told: Any, folder: Path) -> Path:
    """A file in bodies/, also after links are followed: an asset may come from a stranger."""
    path = PurePosixPath(told)
    file = folder / path
    inside = not path.is_absolute() and len(path.parts) == 2 and path.parts[0] == "bodies" and path.suffix == ".ply"
    if not inside or "\\" in told or not file.resolve().is_relative_to(folder.resolve()):
        raise RuntimeError(f"bodies.json names the mesh {told!r}: only files bodies/*.ply beside it are read.")
    return file


def _json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise RuntimeError(f"{file} cannot be read ({error}): is the asset damaged?") from None


def frame_of(folder: Path, number: int, suffix: str = "") -> Path:
    """The file of a frame with that suffix; without one: packed splats or, where there are none, PLY."""
    packed = folder / f"{number}.flsp"
    return packed if not suffix and packed.is_file() else folder / f"{number}{suffix or '.ply'}"


def frames(folder: Path, suffix: str = "") -> range:
    """Numbers of a sequence from 1001 on, as far as its files are there without a gap."""
    last = FIRST
    while frame_of(folder, last, suffix).is_file():
        last += 1
    return range(FIRST, last)


def up_to_date(made: Path, source: Path, suffix: str) -> bool:
    """Whether every frame of `source` has a younger file in `made`, and `made` has no others."""
    numbers = frames(source)
    return len(numbers) > 0 and frames(made, suffix) == numbers and all(
        (made / f"{n}{suffix}").stat().st_mtime >= frame_of(source, n).stat().st_mtime for n in numbers
    )  # fmt: skip
