"""Results of stages under work/<stage>/<key>.npz and .json, so that a killed or repeated run resumes.

The JSON file is written last and names the arrays: without it, or when anything does not match, there is no cache.
Arrays are not compressed, because writing must cost little beside the stage itself.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import require
from fluidlift.io.atomic import atomic_write, plain, write_bytes, write_json

WORK_MARKER = ".fluidlift"
"""file in work/ that says whose folder this is"""

_KEPT = 2
"""results kept per stage: going back to the settings before is free"""


def mark_work_folder(folder: Path | str) -> Path:
    """Make work/ and put our marker there; the folder work/."""
    work = Path(folder) / "work"
    marker = work / WORK_MARKER
    if not marker.exists():
        write_bytes(marker, b"cached stage results of fluidlift; may be deleted\n")
    return work


def _names(folder: Path | str, stage: str, key: str) -> tuple[Path, Path]:
    for name in (stage, key):
        require(re.fullmatch(r"[A-Za-z0-9_-]{1,128}", name) is not None, f"stage or key '{name}'", "letters and digits")
    place = Path(folder) / "work" / stage
    return place / f"{key}.npz", place / f"{key}.json"


def save_stage(
    folder: Path | str, stage: str, key: str, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]
) -> None:
    """Keep the result of a stage; older results beyond the last two are removed.

    Args:
        folder: of the asset.
        stage, key: letters, digits, `-` and `_`.
        arrays: any number of arrays of numbers.
        meta: plain data (what JSON can hold; arrays become lists, inf and nan null).

    Raises:
        InputRejected: the disk is full or may not be written.
    """
    data, facts = _names(folder, stage, key)
    for name, array in arrays.items():
        require(np.asarray(array).dtype.kind in "fiubcU", f"array '{name}' of {np.asarray(array).dtype}", "numbers")
    mark_work_folder(folder)
    facts.unlink(missing_ok=True)
    with atomic_write(data) as file:
        np.savez(file, **{f"{name}.": array for name, array in arrays.items()})
    shapes = {name: [list(np.shape(a)), np.asarray(a).dtype.str] for name, a in arrays.items()}
    write_json(facts, {"stage": stage, "key": key, "arrays": shapes, "meta": plain(meta)})
    _forget_old(data.parent, key)


def load_stage(folder: Path | str, stage: str, key: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
    """Arrays and meta of a stage, or None where there are none or they are damaged."""
    data, facts = _names(folder, stage, key)
    if not (data.is_file() and facts.is_file()) or data.is_symlink() or facts.is_symlink():
        return None
    try:
        known = json.loads(facts.read_text(encoding="utf-8"))
        with np.load(data, allow_pickle=False) as archive:
            arrays = {name.removesuffix("."): archive[name] for name in archive.files}
        shapes = {name: [list(a.shape), a.dtype.str] for name, a in arrays.items()}
        if known["key"] != key or known["stage"] != stage or known["arrays"] != shapes:
            return None
        return arrays, dict(known["meta"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile, MemoryError, RecursionError):
        return None


def mark_owner(folder: Path | str, stage: str, key: str | None) -> None:
    """Note which result the files beside the cache (frames, pictures) belong to; None: to none, they are being made."""
    data, _ = _names(folder, stage, key or "none")
    owner = data.with_name("owner")
    if key is None:
        owner.unlink(missing_ok=True)
    else:
        write_bytes(owner, key.encode())


def is_owner(folder: Path | str, stage: str, key: str) -> bool:
    """Whether the files beside the cache belong to this result."""
    data, _ = _names(folder, stage, key)
    owner = data.with_name("owner")
    try:
        return not owner.is_symlink() and owner.read_bytes()[:128] == key.encode()
    except OSError:
        return False


def _forget_old(place: Path, key: str) -> None:
    """Remove all but the newest results; the one just written stays in any case."""
    others = [p for p in place.glob("*.json") if p.stem != key]
    others.sort(key=lambda p: p.stat().st_mtime, reverse=True)
    for facts in others[_KEPT - 1 :]:
        facts.unlink(missing_ok=True)
        facts.with_suffix(".npz").unlink(missing_ok=True)
