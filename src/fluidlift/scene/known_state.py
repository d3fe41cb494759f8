"""Which frames are stale, remembered: to find it out the scene is built, which takes seconds and half a dozen packages.

An answer holds for a text of scene.yaml and the files that it depends on, told by their sizes and times. Only answers
without a warning are kept, so that nothing that is printed comes from this file: a false one says at most that
something has to be simulated again, or has not.
"""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import yaml

import fluidlift
from fluidlift.errors import FluidliftError
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.atomic import write_json
from fluidlift.io.limits import read_json
from fluidlift.io.yaml_reader import parse_yaml
from fluidlift.scene.splat_files import checkpoint_file

KNOWN = "work/stale.json"
PARTS = frozenset({"simulate", "look"})
_MOST = 100
"""answers"""
_MAX_BYTES = 64 * 2**10
_NAMED = ("mesh", "environment")
"""entries of a scene that name files"""


def recalled(folder: Path, text: str, *, meshes: Path | None = None) -> set[str] | None:
    """What of a scene the frames on disk do not show, if that was found before; None where it is not known.

    Args:
        folder: of the asset.
        text: its scene.yaml.
        meshes: folder of its mesh files; None: the asset.
    """
    key = _key(folder, text, meshes)
    answer = _read(folder).get(key) if key else None
    return set(answer) if isinstance(answer, list) and PARTS.issuperset(map(str, answer)) else None


def remember(folder: Path, text: str, stale: set[str], *, meshes: Path | None = None) -> None:
    """Keep an answer for `recalled`, where the asset has a folder work/ that can be written."""
    with suppress(OSError, FluidliftError):
        if not asset_file(folder, KNOWN).parent.is_dir():
            return
        key = _key(folder, text, meshes)
        if not key:
            return
        kept = _read(folder)
        kept.pop(key, None)  # it becomes the newest
        kept[key] = sorted(stale)
        write_json(asset_file(folder, KNOWN), dict(list(kept.items())[-_MOST:]))


def _read(folder: Path) -> dict[str, Any]:
    with suppress(OSError, FluidliftError):
        path = asset_file(folder, KNOWN)
        found = read_json(path, "file of answers", _MAX_BYTES) if path.is_file() else {}
        return found if isinstance(found, dict) else {}
    return {}


def _key(folder: Path, text: str, meshes: Path | None) -> str:
    """A hash of all that an answer depends on."""
    with suppress(yaml.YAMLError, FluidliftError, OSError):
        home = folder if meshes is None else meshes
        rest = sorted(p.name for p in asset_file(folder, "rest").glob("*"))
        names = ["manifest.json", "parameters.json", "work/simulate/owner", *(f"rest/{name}" for name in rest)]
        files = [asset_file(folder, name) for name in names]
        files += [checkpoint_file(folder), *(home / name for name in _files_of(parse_yaml(text)))]
        facts = [_source(), text, None if meshes is None else str(meshes), names, [_facts(p) for p in files]]
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()
    return ""


@cache
def _source() -> list[tuple[str, int, int]]:
    """Every module of fluidlift with its size and time: another simulator may simulate the same scene otherwise."""
    place = Path(fluidlift.__file__).parent
    return sorted((p.name, (s := p.stat()).st_size, s.st_mtime_ns) for p in place.rglob("*.py"))


def _facts(path: Path) -> tuple[int, int] | None:
    """Size and time of the last change, ns; None where there is no such file."""
    with suppress(OSError, ValueError):
        found = path.stat()
        return found.st_size, found.st_mtime_ns
    return None


def _files_of(scene: Any) -> list[str]:
    """Names of files in a scene, wherever they stand."""
    found, waiting = [], [scene]
    while waiting:
        part = waiting.pop()
        if isinstance(part, dict):
            found += [str(part[name]) for name in _NAMED if isinstance(part.get(name), str)]
            waiting += part.values()
        elif isinstance(part, list):
            waiting += part
    return sorted(found)
