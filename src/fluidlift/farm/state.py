"""What became of each shot: one small file beside its asset, and one lock while somebody makes it.

A shot is finished when the file says so, its fingerprint is that of the shot that is asked for, and the asset's
manifest is the one that was written then. Several batches, machines and schedulers may share one folder: who holds a
shot's lock makes it.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from fluidlift.farm.shots import is_name
from fluidlift.io.asset_lock import held, held_file
from fluidlift.io.atomic import atomic_write
from fluidlift.io.hashes import digest
from fluidlift.io.limits import parse_json

STATE, LOCK, LOG = ".state.json", ".lock", ".log"
"""suffixes of a shot's files, beside NAME.fluid"""
LISTED = "shots.json"
"""names of all shots of a folder, in the order in which batches named them"""
WELL = ("done", "done, warnings")
LARGEST = 1 << 20
"""bytes of a state file that are read: warnings are some hundred characters each"""

LARGEST_LIST = 16 * LARGEST
"""bytes of a list of names that are read: a hundred thousand shots"""


@dataclass(frozen=True)
class ShotOutcome:
    """How the make of one shot ended."""

    name: str
    outcome: str
    """done, "done, warnings", rejected or failed"""
    seconds: float
    asset: str
    log: str
    warnings: list[str] = field(default_factory=list)
    reason: str = ""
    """what a make that failed said last"""
    failure: str = ""
    """class of failure: input (`make` refuses it), memory or time (which ran out), crash, stopped (it was told to end);
    or empty"""
    verdict: str = ""
    """of the asset, as filmed: good, usable, does not hold; empty: not measured"""
    peak_memory_mb: float = 0.0
    host: str = ""
    version: str = ""
    """of fluidlift"""
    ended: str = ""
    """UTC, for people: clocks of machines differ"""
    fingerprint: str = ""
    manifest: str = ""
    """SHA-256 of the asset's manifest.json"""
    clip: str = ""
    """its path"""
    licence: str = ""
    """of the clip, as the list gives it"""
    source: str = ""
    """of the clip, as the list gives it"""

    @property
    def well(self) -> bool:
        """It became an asset."""
        return self.outcome in WELL

    def line(self) -> str:
        """For people."""
        warned = f" ({len(self.warnings)} warnings)" if self.warnings else ""
        return f"{self.name}: {self.outcome.partition(',')[0]} in {self.seconds:.0f} s{warned}" + (
            f": {self.reason}" if self.reason else ""
        )


def read_outcome(folder: Path, name: str) -> ShotOutcome | None:
    """What became of a shot; None where nothing has, or what is there is damaged."""
    try:
        with os.fdopen(os.open(folder / f"{name}{STATE}", os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0)), "rb") as file:
            return parsed_outcome(file.read(LARGEST), name)
    except OSError:
        return None


def parsed_outcome(data: bytes, name: str) -> ShotOutcome | None:
    """What a state file says of a shot; None of one that is damaged, or of another shot."""
    with suppress(ValueError, TypeError, KeyError):
        found = parse_json(data)
        outcome = ShotOutcome(**{f.name: found[f.name] for f in fields(ShotOutcome) if f.name in found})
        if outcome.name == name and _is_typed(outcome):
            return outcome
    return None


def _is_typed(outcome: ShotOutcome) -> bool:
    """Whether every field holds what it should: a state may come from a store that others write to."""
    for f in fields(outcome):
        value = getattr(outcome, f.name)
        if f.name == "warnings":
            good = isinstance(value, list) and all(isinstance(w, str) for w in value)
        elif f.name in ("seconds", "peak_memory_mb"):
            good = isinstance(value, int | float) and math.isfinite(value)
        else:
            good = isinstance(value, str)
        if not good:
            return False
    return True


def write_outcome(folder: Path, outcome: ShotOutcome) -> None:
    """Beside the asset, whole or not at all."""
    with atomic_write(folder / f"{outcome.name}{STATE}") as file:
        file.write((json.dumps(asdict(outcome), indent=1) + "\n").encode())


def is_finished(folder: Path, found: ShotOutcome | None, fingerprint: str) -> bool:
    """Whether nothing is left to do for a shot of this fingerprint."""
    if found is None or not found.well or found.fingerprint != fingerprint:
        return False
    return manifest_digest(folder, found.name) == found.manifest != ""


def manifest_digest(folder: Path, name: str) -> str:
    """SHA-256 of the manifest of a shot's asset; empty where there is none."""
    path = folder / f"{name}.fluid" / "manifest.json"
    return digest(path) if path.is_file() and not path.is_symlink() and not path.parent.is_symlink() else ""


@contextmanager
def claimed(folder: Path, name: str, *, wait: float = 0.0) -> Iterator[int | None]:
    """The right to make a shot, which one process has while the block runs; None where another one does.

    What is given is the lock's file descriptor. A process that is handed it holds the lock as well, until it ends.

    Args:
        folder: of the batch.
        name: of the shot.
        wait: s to wait for it.
    """
    with held_file(folder / f"{name}{LOCK}", f"making {name}", wait=wait) as file:
        yield file


def is_running(folder: Path, name: str) -> bool:
    """Whether somebody on this machine, or on a file system whose locks reach further, makes a shot."""
    if not (folder / f"{name}{LOCK}").is_file():
        return False
    with held(folder / f"{name}{LOCK}", "") as ours:
        return not ours


def names_of(folder: Path) -> list[str]:
    """Shots of a folder: those that batches put on its list, then others that something is known of."""
    listed: Any = []
    with suppress(OSError, ValueError), (folder / LISTED).open("rb") as file:
        listed = parse_json(file.read(LARGEST_LIST))
    names = [n for n in listed if isinstance(n, str) and is_name(n)] if isinstance(listed, list) else []
    others = sorted(p.name.removesuffix(STATE) for p in folder.glob(f"*{STATE}"))
    return list(dict.fromkeys([*names, *others]))


def list_names(folder: Path, names: list[str]) -> None:
    """Put shots on the folder's list, after those that other batches put there."""
    with held(folder / ".shots.lock", "a list of shots", wait=10.0):
        text = json.dumps(list(dict.fromkeys([*names_of(folder), *names])), indent=1)
        with atomic_write(folder / LISTED) as file:
            file.write((text + "\n").encode())
