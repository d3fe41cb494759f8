"""Files that are either whole or absent, and disk errors that say what to do."""

from __future__ import annotations

import errno
import glob
import itertools
import json
import math
import os
import re
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
def disk_errors(path: Path | str, elsewhere: str = "choose another folder with -o") -> Iterator[None]:
    """Translate what the operating system says about a full or forbidden disk.

    Args:
        path: that is written.
        elsewhere: how a user names another place.

    Raises:
        InputRejected: no space, too large a file, no permission, or a read-only file system. Other errors pass
            unchanged.
    """
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise InputRejected(
                f"disk full while writing '{path}'", "free space", f"free some space or {elsewhere}"
            ) from error
        if error.errno == errno.EFBIG:
            raise InputRejected(
                f"a file larger than it may be while writing '{path}'", "a limit (ulimit -f) or a disk for larger ones",
                f"raise the limit, or {elsewhere}",
            ) from error  # fmt: skip
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            raise InputRejected(
                f"'{path}' cannot be written ({error.strerror})", "permission to write there", elsewhere
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
def atomic_path(path: Path | str, *, lasting: bool = False) -> Iterator[Path]:
    """An empty temporary file in the same folder, with the same suffix; renamed to `path` when the block ends well.

    For libraries that want a name. The temporary file is removed when the block fails, and those that a killed run left
    behind for `path` before it begins.

    Args:
        path: of the file.
        lasting: wait until the content is on the disk before it is renamed: for what cannot be made again.
    """
    path = Path(path)
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        for old in path.parent.glob(f".{glob.escape(path.stem)}.*.part{glob.escape(path.suffix)}"):
            if _is_leftover(old):
                old.unlink(missing_ok=True)
        temporary = new_temporary(path.parent, path.stem, path.suffix)
        try:
            yield temporary
            if lasting:
                _onto_disk(temporary)
            os.replace(temporary, path)
            if lasting:
                _onto_disk(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


_COUNT = itertools.count(1)
_BEGAN = time.time()
_TEMPORARY = re.compile(r"\..*\.([0-9]+)\.[0-9]+\.part(\.\w+)?")


def new_temporary(folder: Path, stem: str, suffix: str) -> Path:
    """An empty file that was not there before, nor a link of its name, and says which process it belongs to."""
    path = folder / f".{stem}.{os.getpid()}.{next(_COUNT)}.part{suffix}"
    path.unlink(missing_ok=True)  # of a killed run whose process had the same number: a link itself, not its target
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_NOFOLLOW", 0), 0o666))
    return path


def remove_leftovers(folder: Path | str) -> None:
    """Remove the temporary files of killed runs anywhere below a folder, without following links."""
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place) / name
            if _is_leftover(path):
                with suppress(OSError):
                    path.unlink()


def _is_leftover(path: Path) -> bool:
    """Whether a file is one of `new_temporary` whose process has ended."""
    found = _TEMPORARY.fullmatch(path.name)
    if found is None:
        return False
    pid = int(found[1])
    try:
        if pid == os.getpid():  # in a container every run has the same number
            return path.lstat().st_mtime < _BEGAN
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:  # someone else's, or gone in the meantime
        return False
    return False


def _onto_disk(path: Path) -> None:
    """Wait until what was written to a file or a folder is on the disk; a file system that cannot wait does not."""
    file = os.open(path, os.O_RDONLY)
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP, errno.EBADF):
            raise
    finally:
        os.close(file)


@contextmanager
def atomic_write(path: Path | str, *, lasting: bool = False) -> Iterator[IO[bytes]]:
    """A binary file object whose content appears under `path` all at once when the block ends well."""
    with atomic_path(path, lasting=lasting) as temporary, temporary.open("r+b") as file:
        yield file


def write_bytes(path: Path | str, data: bytes, *, lasting: bool = False) -> Path:
    """Write all of a small file at once."""
    with atomic_write(path, lasting=lasting) as file:
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


def write_json(path: Path | str, data: Any, *, lasting: bool = False) -> Path:
    """Write `data` as readable JSON."""
    text = json.dumps(plain(data), indent=2, allow_nan=False) + "\n"
    return write_bytes(path, text.encode(), lasting=lasting)
