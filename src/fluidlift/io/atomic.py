"""Files that are either whole or absent, and disk errors that say what to do."""

from __future__ import annotations

import errno
import glob
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from fluidlift.errors import InputRejected


@contextmanager
def disk_errors(path: Path | str) -> Iterator[None]:
    """Translate what the operating system says about a full or forbidden disk.

    Raises:
        InputRejected: no space, no permission, or a read-only file system. Other errors pass unchanged.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise InputRejected(
                f"disk full while writing '{path}'", "free space", "free some space or choose another folder with -o"
            ) from error
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise InputRejected(
                f"'{path}' cannot be written ({error.strerror})", "permission to write there", "choose another folder"
            ) from error
        raise


def require_writable(folder: Path | str) -> None:
    """See that files can be written in a folder, which need not exist yet, before hours of work are done for it.

    Raises:
        InputRejected: whatever the operating system has against it.
    """
    folder = Path(folder)
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        for path in new:  # nothing is left behind where the work is refused later
            with suppress(OSError):
                path.rmdir()
    except OSError as error:
        raise InputRejected(
            f"'{folder}' cannot be written ({error.strerror or error})", "a folder that can be written",
            "choose another one with -o",
        ) from error  # fmt: skip


def require_free_space(path: Path | str, needed: int) -> None:
    """Check that the disk of `path` (which need not exist yet) has `needed` bytes left.

    Raises:
        InputRejected: less is free.
    """
    place = Path(path).absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if free < needed:
        raise InputRejected(
            f"{free / 1e6:.0f} MB free on the disk of '{path}'",
            f"about {needed / 1e6:.0f} MB",
            "free some space, choose another folder with -o, or lower the quality",
        )


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """A temporary name in the same folder, with the same suffix; renamed to `path` when the block ends well.

    For libraries that want a name. The temporary file is removed when the block fails.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(path)
        try:
            yield temporary
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def _remove_leftovers(path: Path) -> None:
    """Temporary files of this name that a killed run left behind: those untouched for a day."""
    for old in path.parent.glob(f".{glob.escape(path.stem)}.*.part{glob.escape(path.suffix)}"):
        with suppress(OSError):
            if time.time() - old.stat().st_mtime > 86400:
                old.unlink()


@contextmanager
def atomic_write(path: Path | str) -> Iterator[IO[bytes]]:
    """A binary file object whose content appears under `path` all at once when the block ends well."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        yield file


def write_bytes(path: Path | str, data: bytes) -> Path:
    """Write all of a small file at once."""
    with atomic_write(path) as file:
        file.write(data)
    return Path(path)


def plain(value: Any) -> Any:
    """The same data in JSON's own kinds: arrays become lists, NumPy scalars numbers, inf and nan null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value.as_posix() if isinstance(value, Path) else value


def write_json(path: Path | str, data: Any) -> Path:
    """Write `data` as readable JSON."""
    return write_bytes(path, (json.dumps(plain(data), indent=2, allow_nan=False) + "\n").encode())
