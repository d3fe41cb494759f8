"""What an asset's folder says about itself, in plain values; works without Blender."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

FIRST = 1001
"""number of the first frame"""
EXPORTED = "blender"
"""folder in the asset: what is written for Blender"""


class Facts(NamedTuple):
    """Of the frames on disk."""

    interval: float
    """s between two frames"""
    parameters: dict[str, Any]
    """density kg/m³, kinematic_viscosity m²/s, gravity m/s², inflow_velocity m/s, ..."""
    material: str
    """source: the clip's own colours"""
    tint: tuple[float, ...]


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
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise RuntimeError(f"{folder.name} does not say what an asset says ({error}): is it damaged?") from None


def _json(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RuntimeError(f"{file} cannot be read ({error}): is the asset damaged?") from None


def frames(folder: Path, suffix: str = ".ply") -> range:
    """Numbers of a sequence from 1001 on, as far as its files are there without a gap."""
    last = FIRST
    while (folder / f"{last}{suffix}").is_file():
        last += 1
    return range(FIRST, last)


def up_to_date(made: Path, source: Path, suffix: str) -> bool:
    """Whether every frame of `source` has a younger file in `made`, and `made` has no others."""
    numbers = frames(source)
    return len(numbers) > 0 and frames(made, suffix) == numbers and all(
        (made / f"{n}{suffix}").stat().st_mtime >= (source / f"{n}.ply").stat().st_mtime for n in numbers
    )  # fmt: skip
