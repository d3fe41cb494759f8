"""Mesh files that a person hands over in the page: kept in the asset, and put where they can be seen."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.atomic import write_bytes
from fluidlift.io.read_mesh import SUFFIXES, read_any_mesh
from fluidlift.pipeline.edit_outlook import placed

FOLDER = "meshes"
"""of the asset, where uploaded files are kept"""
MOST_BYTES = 64 * 2**20
"""of an uploaded file; larger ones are copied into the asset by hand"""
MOST_SAME = 1000
"""different files of one name"""
UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254}
"""m: lengths of a file are in"""


def kept_mesh(folder: Path, name: str, content: bytes) -> tuple[str, Callable[[], None]]:
    """Keep an uploaded mesh in an asset.

    Args:
        folder: of the asset.
        name: of the file, as the browser tells it.
        content: of the file.

    Returns:
        Its name inside the asset, such as `meshes/duck.obj` (another number where another file has that name), and what
        takes it away again: nothing where it was there before.

    Raises:
        InputRejected: too large, empty, of another format, or a disk that is full.
    """
    plain = PurePosixPath(name.replace("\\", "/")).name
    stem, suffix = PurePosixPath(plain).stem, PurePosixPath(plain).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputRejected(f"'{plain[:60]}' as a mesh", "a file that ends in " + ", ".join(SUFFIXES), "convert it")
    if not content:
        raise InputRejected(f"'{plain[:60]}' is empty", "a mesh")
    if len(content) > MOST_BYTES:
        raise InputRejected(
            f"'{plain[:60]}' has {len(content) / 2**20:.0f} MB", f"at most {MOST_BYTES // 2**20} MB",
            "simplify it, or copy it into the asset's folder and name it below",
        )  # fmt: skip
    stem = re.sub(r"[^A-Za-z0-9_-]+", "_", stem).strip("_")[:60] or "mesh"
    for k in range(1, MOST_SAME):
        inside = f"{FOLDER}/{stem if k == 1 else f'{stem}_{k}'}{suffix}"
        path = asset_file(folder, inside)
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            write_bytes(path, content)
            return inside, partial(_taken_away, path)
        if path.is_file() and path.stat().st_size == len(content) and path.read_bytes() == content:
            return inside, lambda: None
    raise InputRejected(f"{MOST_SAME} files named {stem}{suffix}", "another name")


def _taken_away(path: Path) -> None:
    path.unlink(missing_ok=True)
    if path.parent.name == FOLDER and not any(path.parent.iterdir()):
        path.parent.rmdir()


def mesh_entry(
    folder: Path, inside: str, unit: float, *, turned_over: bool, over: Callable[[float], np.ndarray]
) -> dict[str, Any]:
    """The entry of scene.yaml that puts a mesh file of the asset with the middle of its lower side at a place.

    Args:
        folder: of the asset.
        inside: name of the file inside it.
        unit: m, of the file's lengths.
        turned_over: its faces look inwards.
        over: gives the place, [3] m, of a mesh so wide in plan, m.

    Raises:
        InputRejected: no such file, or one that cannot be read.
    """
    points = unit * np.asarray(read_any_mesh(asset_file(folder, inside)).vertices, float)
    low, high = points.min(axis=0), points.max(axis=0)
    foot = np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]])
    place = over(float((high - low)[:2].max()))
    fine = 1e-3 * max(float((high - low).max()), 1e-9)  # of its longest side
    entry: dict[str, Any] = {"mesh": inside, "position": placed(place - foot, fine)}
    return entry | ({} if unit == 1.0 else {"scale": unit}) | ({"flip": True} if turned_over else {})
