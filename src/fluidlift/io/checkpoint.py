"""Checkpoints: the state of a simulation between two frames, from which it goes on bit for bit.

One npz file, written under a temporary name and renamed. The header is JSON; it names the format, the frames that are
done and, part by part, a hash of everything that decides how the simulation goes on. A checkpoint is read like any
file of a stranger: no pickles, no links, and no array is unpacked before its size is known.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected, require
from fluidlift.io.array_archive import DAMAGE, array_in, members_of
from fluidlift.io.atomic import atomic_write
from fluidlift.io.limits import parse_json

CHECKPOINT_VERSION = 1
"""of the file; a reader refuses others"""

_FORMAT = "fluidlift checkpoint"
_MAX_HEADER = 2**20
_MAX_BYTES = 64 * 2**30
_HEADER = "header"


@dataclass(frozen=True)
class Checkpoint:
    """A simulation after some frames."""

    frames: int
    """frames done, the first (at rest) counted"""
    parts: dict[str, str]
    """hash of each part that the simulation depends on: grid, terrain, parameters, ..."""
    state: dict[str, np.ndarray]
    """what `ParticleSimulator.state` gave"""
    history: dict[str, np.ndarray]
    """one entry per frame: figures that the report shows"""


def write_checkpoint(path: Path | str, checkpoint: Checkpoint) -> Path:
    """Write a checkpoint, all of it or nothing.

    Raises:
        InputRejected: the disk is full or may not be written.
        ValueError: arrays that are not of numbers.
    """
    arrays = {f"state.{k}": np.asarray(v) for k, v in checkpoint.state.items()}
    arrays |= {f"history.{k}": np.asarray(v) for k, v in checkpoint.history.items()}
    for name, array in arrays.items():
        require(array.dtype.kind in "fiub", f"array '{name}' of {array.dtype}", "numbers")
    header = {
        "format": _FORMAT,
        "version": CHECKPOINT_VERSION,
        "frames": int(checkpoint.frames),
        "parts": dict(checkpoint.parts),
    }
    held: dict[str, Any] = {_HEADER: np.frombuffer(json.dumps(header).encode(), np.uint8)} | arrays
    with atomic_write(path, lasting=True) as file:
        np.savez(file, **held)
    return Path(path)


def read_checkpoint(path: Path | str, *, max_bytes: int = _MAX_BYTES) -> Checkpoint:
    """The whole checkpoint.

    Args:
        path: of the file.
        max_bytes: most that its arrays may take in memory.

    Raises:
        InputRejected: no such file, a link, another format or version, damage, or more than `max_bytes`.
    """
    path = _plain_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            # written as they are: they are not larger in memory than on disk
            members = members_of(archive, min(max_bytes, path.stat().st_size))
            head = _header(archive, path)
            arrays = {name: array_in(archive, m) for name, m in members.items()}
    except DAMAGE as error:
        raise _damaged(path, error) from None
    state = {k.removeprefix("state."): a for k, a in arrays.items() if k.startswith("state.")}
    history = {k.removeprefix("history."): a for k, a in arrays.items() if k.startswith("history.")}
    wrong = [k for k, a in history.items() if a.ndim == 0 or len(a) != head["frames"]]
    if wrong:
        raise InputRejected(
            f"the checkpoint '{path.name}' has {wrong[0]} of another length", f"{head['frames']} frames"
        )
    return Checkpoint(head["frames"], head["parts"], state, history)


def read_parts(path: Path | str) -> tuple[int, dict[str, str]]:
    """Frames done and the hash of each part, without the arrays. Raises as `read_checkpoint`."""
    path = _plain_file(path)
    try:
        with zipfile.ZipFile(path) as archive:
            head = _header(archive, path)
    except DAMAGE as error:
        raise _damaged(path, error) from None
    return head["frames"], head["parts"]


def differing_parts(found: Mapping[str, str], wanted: Mapping[str, str]) -> list[str]:
    """Names of the parts whose hashes differ or that only one side has, sorted."""
    return sorted(name for name in {*found, *wanted} if found.get(name) != wanted.get(name))


def _damaged(path: Path, error: BaseException) -> InputRejected:
    return InputRejected(
        f"the checkpoint '{path.name}' cannot be read ({error})",
        "an undamaged checkpoint",
        "start again without --resume",
    )


def _plain_file(path: Path | str) -> Path:
    path = Path(path)
    if path.is_symlink():
        raise InputRejected(f"the checkpoint '{path.name}' is a link", "a plain file", "do not trust this asset")
    if not path.is_file():
        raise InputRejected(f"no checkpoint '{path.name}'", "a simulation that was begun", "start without --resume")
    return path


def _header(archive: zipfile.ZipFile, path: Path) -> dict[str, Any]:
    member = archive.getinfo(f"{_HEADER}.npy")
    if member.file_size > _MAX_HEADER:
        raise ValueError(f"a header of {member.file_size} bytes")
    head = parse_json(bytes(array_in(archive, member)))
    if head["format"] != _FORMAT:
        raise ValueError("another format")
    if head["version"] != CHECKPOINT_VERSION:
        raise InputRejected(
            f"the checkpoint '{path.name}' has format version {head['version']!r}", f"version {CHECKPOINT_VERSION}",
            "start again without --resume",
        )  # fmt: skip
    parts = head["parts"]
    plain = isinstance(parts, dict) and all(isinstance(v, str) for v in parts.values())
    if not plain or type(head["frames"]) is not int or head["frames"] < 1:
        raise ValueError("a header without frames and parts")
    return head
