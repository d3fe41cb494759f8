"""Results of stages under work/<stage>/<key>.npz and .json, so that a killed or repeated run resumes.

The JSON file is written last and names the arrays: without it, or when anything does not match, there is no cache.
Arrays are packed where a glance says that it pays, and as fast as it goes: writing must cost little beside the stage.

Arrays that grow with the clip (frames, flow) lie in files of their own, <key>.<name>.npy. A stage writes them
part by part through `Scratch`, and they are mapped, not read, when they come back: memory does not grow with the clip.
Their size and header are checked, their content is not (that would mean to read them).
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected, require
from fluidlift.io.array_archive import (
    DAMAGE,
    mapped_array,
    packs_to,
    read_packed_arrays,
    write_packed_arrays,
)
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.atomic import (
    atomic_write,
    disk_errors,
    new_temporary,
    plain,
    remove_leftovers,
    require_free_space,
    write_bytes,
    write_json,
)
from fluidlift.io.limits import read_json
from fluidlift.types.fluid_masks import parts_of

WORK_MARKER = ".fluidlift"
"""file in work/ that says whose folder this is"""

_KINDS = "fiubcU"
"""of arrays, as NumPy's `dtype.kind`"""
_MOST_PACKED = 128 * 2**20
"""bytes of an array that is packed though it has a file of its own"""
_KEPT = 2
"""results kept per stage: going back to the settings before is free"""


def mark_work_folder(folder: Path | str) -> Path:
    """Make work/ and put our marker there; the folder work/."""
    work = asset_file(folder, "work")
    marker = work / WORK_MARKER
    if not marker.exists():
        write_bytes(marker, b"cached stage results of fluidlift; may be deleted\n")
    return work


class GrowingArray:
    """An array on disk whose length is known only at its end: items are appended, then it is closed.

    Args:
        path: of the .npy file, which is there and empty.
        shape: of one item.
        dtype: of the numbers.
    """

    def __init__(self, path: Path, shape: tuple[int, ...], dtype: Any) -> None:
        self.path, self.shape, self.dtype, self.count = path, tuple(shape), np.dtype(dtype), 0
        self._file = path.open("r+b")
        self._head()

    def __len__(self) -> int:
        return self.count

    def append(self, item: np.ndarray) -> None:
        """One more item."""
        require(np.shape(item) == self.shape, f"an item {np.shape(item)}", str(self.shape))
        self._file.write(np.ascontiguousarray(item, self.dtype).tobytes())
        self.count += 1

    def close(self) -> np.ndarray:
        """The whole array, mapped."""
        self._file.seek(0)
        self._head()
        self._file.close()
        return np.load(self.path, mmap_mode="r+", allow_pickle=False)

    def _head(self) -> None:
        """NumPy pads its header so that the first axis can grow without moving what follows."""
        facts = {"descr": self.dtype.str, "fortran_order": False, "shape": (self.count, *self.shape)}
        np.lib.format.write_array_header_1_0(self._file, facts)


class Scratch:
    """Arrays on disk of a stage that is at work, under temporary names; `save_stage` keeps those in its result.

    Args:
        folder: of the asset.
        stage: letters, digits, `-` and `_`.
    """

    def __init__(self, folder: Path | str, stage: str) -> None:
        self.folder, self.place = Path(folder), _names(folder, stage, "none")[0].parent
        self._made: dict[str, Path] = {}
        remove_leftovers(self.place)

    def array(self, name: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """A new array of zeros.

        Raises:
            InputRejected: the disk has no room for it.
        """
        path, size = self._path(name), int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        require_free_space(path, size)
        with disk_errors(self.folder):
            array = np.lib.format.open_memmap(path, "w+", np.dtype(dtype), tuple(shape))
            # all of it now: a disk that fills later would end the process, not raise
            if hasattr(os, "posix_fallocate"):
                with path.open("r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
        self._register(name, path)
        return array

    def growing(self, name: str, shape: tuple[int, ...], dtype: Any) -> GrowingArray:
        """A new array of items of `shape`, without any yet. Once closed, give it back through `keep`."""
        with disk_errors(self.folder):
            growing = GrowingArray(self._path(name), shape, dtype)
        self._register(name, growing.path)
        return growing

    def keep(self, name: str, array: np.ndarray) -> np.ndarray:
        """The array where it lies here already, else a copy that does, under `name`."""
        if self.file_of(array) is not None:
            return array
        out = self.array(name, array.shape, array.dtype)
        for part in parts_of(array):
            out[part] = array[part]
        return out

    def file_of(self, array: np.ndarray) -> Path | None:
        """The file here that an array is all of; None for one that lies elsewhere."""
        mapped = _whole_file(array)
        if mapped is None or not mapped.exists():  # one of an earlier stage has its last name now
            return None
        return next((path for path in self._made.values() if mapped.samefile(path)), None)

    def discard(self) -> None:
        """Remove what was not kept."""
        for path in self._made.values():
            with suppress(OSError):
                path.unlink(missing_ok=True)
        self._made = {}

    def _register(self, name: str, path: Path) -> None:
        """Remember where an array lies; one that had the name before is gone (who maps it still has it)."""
        before = self._made.get(name)
        if before is not None:
            with suppress(OSError):
                before.unlink(missing_ok=True)
        self._made[name] = path

    def _path(self, name: str) -> Path:
        require(re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name) is not None, f"array '{name}'", "letters and digits")
        with disk_errors(self.folder):
            mark_work_folder(self.folder)
            self.place.mkdir(parents=True, exist_ok=True)
            return new_temporary(self.place, name, ".npy")


def _whole_file(array: np.ndarray) -> Path | None:
    """The file that a mapped array is all of; None for one in memory and for a slice."""
    if not isinstance(array, np.memmap) or isinstance(array.base, np.ndarray) or array.filename is None:
        return None
    return Path(array.filename)


def _names(folder: Path | str, stage: str, key: str) -> tuple[Path, Path]:
    for name in (stage, key):
        require(re.fullmatch(r"[A-Za-z0-9_-]{1,128}", name) is not None, f"stage or key '{name}'", "letters and digits")
    place = asset_file(folder, f"work/{stage}")
    return place / f"{key}.npz", place / f"{key}.json"


def save_stage(
    folder: Path | str,
    stage: str,
    key: str,
    arrays: Mapping[str, np.ndarray],
    meta: Mapping[str, Any],
    *,
    scratch: Scratch | None = None,
) -> None:
    """Keep the result of a stage; older results beyond the last two are removed.

    Args:
        folder: of the asset.
        stage, key: letters, digits, `-` and `_`.
        arrays: any number of arrays of numbers.
        meta: plain data (what JSON can hold; arrays become lists, inf and nan null).
        scratch: where some of the arrays lie already; the rest of it is removed.

    Raises:
        InputRejected: the disk is full or may not be written.
    """
    data, facts = _names(folder, stage, key)
    for name, array in arrays.items():
        require(np.asarray(array).dtype.kind in _KINDS, f"array '{name}' of {np.asarray(array).dtype}", "numbers")
    mark_work_folder(folder)
    facts.unlink(missing_ok=True)
    mapped = {} if scratch is None else {n: p for n, a in arrays.items() if (p := scratch.file_of(a)) is not None}
    mapped = {n: path for n, path in mapped.items() if not _better_packed(arrays[n])}
    require(len(set(mapped.values())) == len(mapped), "one array under two names", "a copy")
    held: dict[str, Any] = {f"{name}.": array for name, array in arrays.items() if name not in mapped}
    with atomic_write(data) as file:
        write_packed_arrays(file, held)
    with disk_errors(folder):
        for name, path in mapped.items():
            made = arrays[name]
            if isinstance(made, np.memmap):
                made.flush()
            os.replace(path, _mapped(data, name))
    for old in data.parent.glob(f"{key}.*.npy"):  # of a result of the same name that was forced away
        if old not in {_mapped(data, name) for name in mapped}:
            old.unlink(missing_ok=True)
    if scratch is not None:
        scratch.discard()
    shapes = {name: [list(np.shape(a)), np.asarray(a).dtype.str] for name, a in arrays.items()}
    known = {"stage": stage, "key": key, "arrays": shapes, "mapped": sorted(mapped), "meta": plain(meta)}
    write_json(facts, known | {"sum": _sum(known)})
    _forget_old(data.parent, key)


def _better_packed(array: np.ndarray) -> bool:
    """Whether an array with a file of its own is packed with the others: what is mostly one number (labels, flow that
    was filled in), and unpacked within a second. Who has it mapped keeps it: a file lives as long as its last map."""
    return array.nbytes <= _MOST_PACKED and packs_to(array, 0.4)


def _mapped(data: Path, name: str) -> Path:
    """The file of an array that is mapped."""
    return data.with_name(f"{data.stem}.{name}.npy")


def load_stage(folder: Path | str, stage: str, key: str) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
    """Arrays and meta of a stage, or None where there are none or they are damaged.

    Arrays in files of their own come mapped, copied where they are written to.
    """
    data, facts = _names(folder, stage, key)
    if not (data.is_file() and facts.is_file()) or data.is_symlink() or facts.is_symlink():
        return None
    try:
        known = read_json(facts, "cache")
        if known.pop("sum") != _sum(known):
            return None
        arrays = {name.removesuffix("."): a for name, a in read_packed_arrays(data, _KINDS).items()}
        for name in known["mapped"]:
            path = _mapped(data, name)
            if path.is_symlink() or not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name):
                return None
            arrays[name] = mapped_array(path, "c", _KINDS)
        shapes = {name: [list(a.shape), a.dtype.str] for name, a in arrays.items()}
        if known["key"] != key or known["stage"] != stage or known["arrays"] != shapes:
            return None
        return arrays, dict(known["meta"])
    except (*DAMAGE, AttributeError, InputRejected):
        return None


def _sum(facts: Mapping[str, Any]) -> str:
    """Checksum of the facts: what was changed in them is no cache any more."""
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def mark_owner(folder: Path | str, stage: str, key: str | None) -> None:
    """Note which result the files beside the cache (frames, pictures) belong to; None: to none, they are being made."""
    data, _ = _names(folder, stage, key or "none")
    owner = data.with_name("owner")
    if key is None:
        owner.unlink(missing_ok=True)
    else:
        write_bytes(owner, key.encode())


def owner_of(folder: Path | str, stage: str) -> str | None:
    """Key of the result that the files beside the cache belong to; None where that is not known."""
    owner = _names(folder, stage, "none")[0].with_name("owner")
    try:
        key = "" if owner.is_symlink() else owner.read_bytes()[:128].decode("ascii")
    except (OSError, UnicodeDecodeError):
        return None
    return key if re.fullmatch(r"[A-Za-z0-9_-]{1,128}", key) else None


def is_owner(folder: Path | str, stage: str, key: str) -> bool:
    """Whether the files beside the cache belong to this result."""
    return owner_of(folder, stage) == key


def _forget_old(place: Path, key: str) -> None:
    """Remove all but the newest results; the one just written stays in any case."""
    others = [p for p in place.glob("*.json") if p.stem != key]
    others.sort(key=lambda p: p.stat().st_mtime, reverse=True)
    for facts in others[_KEPT - 1 :]:
        facts.unlink(missing_ok=True)
        facts.with_suffix(".npz").unlink(missing_ok=True)
        for mapped in place.glob(f"{facts.stem}.*.npy"):
            mapped.unlink(missing_ok=True)
