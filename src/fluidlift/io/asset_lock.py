"""Who is at work on an asset: one process at a time writes its frames, one edit at a time changes its scene.yaml.

A lock is the operating system's own (flock) on a small file that also names its holder. It ends with the process,
however that ends: a lock cannot be left behind, and no process has to guess whether another one is still alive.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from fluidlift.errors import InputRejected
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.atomic import disk_errors, remove_leftovers
from fluidlift.io.limits import parse_json

WRITING, EDITING = "work/.writing", "edits/.editing"
"""lock files, inside the asset"""

_POLL = 0.02
_MAX_NOTE = 4096


@dataclass(frozen=True)
class Holder:
    """Who holds a lock."""

    pid: int
    """0: not known"""
    work: str
    """in words: "a simulation" """

    def __str__(self) -> str:
        return f"{self.work} (process {self.pid})" if self.pid else self.work


@contextmanager
def writing(folder: Path | str, work: str) -> Iterator[None]:
    """Hold the right to write an asset's frames while the block runs; what a killed run left half written is removed.

    Args:
        folder: of the asset.
        work: what is done, in words, for others to read: "a simulation".

    Raises:
        InputRejected: another run holds it, in this process or another one.
    """
    with _locked(Path(folder), WRITING, work, wait=0.0, do="wait until it is done, or stop it"):
        remove_leftovers(folder)
        yield


@contextmanager
def editing(folder: Path | str, *, wait: float = 2.0) -> Iterator[None]:
    """Hold the right to change an asset's scene.yaml and its history while the block runs.

    Args:
        folder: of the asset.
        wait: s to wait for another edit to end; one takes milliseconds.

    Raises:
        InputRejected: another edit is not done by then, or another process writes the asset.
    """
    folder = Path(folder)
    require_not_written(folder)
    with _locked(folder, EDITING, "an edit", wait=wait, do="try again; nothing was changed"):
        yield


def writer_of(folder: Path | str) -> Holder | None:
    """Who writes the asset's frames at the moment; None: nobody."""
    path = Path(folder) / WRITING
    if path.is_symlink() or not path.is_file():
        return None
    try:
        file = os.open(path, os.O_RDONLY)
    except OSError:
        return None
    try:
        if _taken(file, fcntl.LOCK_SH):
            return None
        return _holder(file)
    finally:
        os.close(file)


def require_not_written(folder: Path | str) -> None:
    """Raise `InputRejected` where another process writes the asset; what this one does is its own business."""
    holder = writer_of(folder)
    if holder is not None and holder.pid != os.getpid():
        raise InputRejected(
            f"'{Path(folder).name}' is being written by {holder}", "an asset that nobody else writes",
            "wait until that is done, or stop it; nothing was changed",
        )  # fmt: skip


@contextmanager
def held(path: Path, work: str, *, wait: float = 0.0) -> Iterator[bool]:
    """Try to hold a lock while the block runs; whether it is ours.

    Args:
        path: of the lock file, which is made; no link is followed.
        work: what is done, in words, for others to read; empty: only to see whether it is free.
        wait: s to wait for it.
    """
    with held_file(path, work, wait=wait) as file:
        yield file is not None


@contextmanager
def held_file(path: Path, work: str, *, wait: float = 0.0) -> Iterator[int | None]:
    """As `held`: the file descriptor by which the lock is held, or None. Who inherits it holds the lock as well."""
    with disk_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
    try:
        until = time.monotonic() + wait
        while not (ours := _taken(file, fcntl.LOCK_EX)) and time.monotonic() < until:
            time.sleep(_POLL)
        if ours and work:
            note = json.dumps({"pid": os.getpid(), "work": work}).encode()
            with suppress(OSError):  # a full disk: the lock holds all the same
                os.ftruncate(file, 0)
                os.pwrite(file, note, 0)
        yield file if ours else None
    finally:
        os.close(file)


@contextmanager
def _locked(folder: Path, name: str, work: str, *, wait: float, do: str) -> Iterator[None]:
    path = asset_file(folder, name)
    with held(path, work, wait=wait) as ours:
        if not ours:
            raise InputRejected(f"'{folder.name}' is being changed by {_holder_of(path)}", "one at a time", do)
        yield


def _holder_of(path: Path) -> Holder:
    file = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    try:
        return _holder(file)
    finally:
        os.close(file)


def _taken(file: int, kind: int) -> bool:
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
            return False
        if error.errno in (errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL):
            return True  # a file system without locks: one works there as before there were any
        raise
    return True


def _holder(file: int) -> Holder:
    try:
        note = parse_json(os.pread(file, _MAX_NOTE, 0))
        return Holder(int(note["pid"]), str(note["work"])[:100])
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return Holder(0, "another run")
