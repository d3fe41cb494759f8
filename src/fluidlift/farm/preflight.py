"""What is wrong with the machines of a batch, seen before hours of work: said once, and not by every shot."""

from __future__ import annotations

import hashlib
import shutil
import time
import uuid
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from platform import node, python_version
from typing import Any

from fluidlift import __version__
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.farm.making import ROOM
from fluidlift.farm.store import Store
from fluidlift.io.asset_lock import held
from fluidlift.source import ROOT

NOTE = ".looking.lock"
"""file of the folder that a batch holds while it looks at machines; what it says is known to this batch alone"""
CLOCKS = 300.0
"""s that two clocks may differ: as Kerberos demands. Machines that ask a time server agree to a fraction of a second"""


@dataclass(frozen=True)
class Machine:
    """What a machine that is to make shots is like."""

    host: str
    version: str = ""
    """of fluidlift"""
    source: str = ""
    """SHA-256 of its text: versions in development have the same number"""
    python: str = ""
    clock: float = 0.0
    """s, its time when it looked"""
    file_clock: float = 0.0
    """s by which a file that it wrote is newer than that"""
    free: int = ROOM
    """bytes, on the disk of the folder"""
    sees: bool = True
    """the folder is that of the batch"""
    locks: bool = True
    """what the batch locks is locked there"""
    missing: str = ""
    """a clip that the batch sees and it does not"""
    error: str = ""
    """why it cannot be used at all"""


def looked_at(folder: Path, note: str = "", clips: Sequence[Path] = ()) -> Machine:
    """This machine.

    Args:
        folder: of the assets.
        note: what the batch wrote into the file `NOTE` of the folder, which it holds; empty: this is its machine.
        clips: that must be there.
    """
    mine = _mine()
    began = mine.clock
    trial = folder / f".looking.{uuid.uuid4().hex}"
    try:
        sees = not note or note in _note(folder)
        locks = not note or not sees or not _is_free(folder)
        trial.write_bytes(b"x" * 4096)
        late = trial.stat().st_mtime - began
        space = shutil.disk_usage(folder).free
    except (OSError, InputRejected) as error:
        return replace(mine, error=f"cannot write to '{folder}' ({error})")
    finally:
        with suppress(OSError):
            trial.unlink(missing_ok=True)
    missing = next((str(clip) for clip in clips if not clip.exists()), "")
    return replace(mine, file_clock=late, free=space, sees=sees, locks=locks, missing=missing)


def looked_at_store(told: dict[str, Any], clips: Sequence[Path] = ()) -> Machine:
    """This machine, of a batch whose assets belong on a store: its own folder, and whether it reaches the store.

    Args:
        told: fields of the `Store`.
        clips: that must be there.
    """
    try:
        store = Store(**told)
        store.require()
        return looked_at(store.folder, "", clips)
    except (FluidliftError, OSError) as error:
        return replace(_mine(), error=" ".join(str(error).split()))


def _mine() -> Machine:
    """This machine, and nothing of a folder."""
    return Machine(node(), __version__, source_digest(), python_version(), time.time())


def _note(folder: Path) -> str:
    path = folder / NOTE
    return path.read_text("utf-8") if path.is_file() else ""


def _is_free(folder: Path) -> bool:
    with held(folder / NOTE, "") as free:
        return free


def source_digest() -> str:
    """SHA-256 of the text of all modules of this package."""
    found = hashlib.sha256()
    for file in sorted(ROOT.rglob("*.py")):
        found.update(str(file.relative_to(ROOT)).encode() + b"\0" + file.read_bytes() + b"\0")
    return found.hexdigest()


def require_fit(machines: Sequence[Machine], folder: Path, *, ours: Machine | None = None) -> list[str]:
    """What people should know of machines that can be used.

    Args:
        machines: all.
        folder: of the assets.
        ours: that of the batch, with the time when the others answered; None: it is the only one.

    Raises:
        InputRejected: one of them cannot be used, with the remedy.
    """
    for one in machines:
        _require_fit(one, folder, ours)
    apart = sorted({one.host for one in machines if not one.locks})
    if not apart:
        return []
    return [f"locks of '{folder}' do not reach {_few(apart)}: start no second batch on it while this one runs"]


def _require_fit(one: Machine, folder: Path, ours: Machine | None) -> None:
    where = f" on {one.host}"
    if one.error:
        raise InputRejected(f"{one.error}{where}", "a machine that can make shots", "mend it, or take it out")
    if ours is not None and (one.version, one.source) != (ours.version, ours.source):
        same = "of another source" if one.version == ours.version else f"{one.version}, here {ours.version}"
        raise InputRejected(
            f"fluidlift{where} is {same}", "the same version on all machines",
            f"install fluidlift {ours.version} there: assets of one batch would not be alike",
        )  # fmt: skip
    if not one.sees:
        raise InputRejected(
            f"'{folder}'{where} is not the folder that is seen here", "one folder for all machines",
            "mount the shared folder under the same path everywhere",
        )  # fmt: skip
    if one.missing:
        raise InputRejected(
            f"'{one.missing}' is not there{where}", "clips under the same paths on all machines", "mount their folder"
        )
    if one.free < ROOM:
        raise InputRejected(
            f"{one.free / 1e6:.0f} MB free in '{folder}'{where}", f"{ROOM / 1e6:.0f} MB for each shot at a time",
            "free some space, or choose another folder with -o",
        )  # fmt: skip
    offset = one.clock - ours.clock if ours is not None else 0.0
    for late, clock in ((offset, f"the clock{where}"), (one.file_clock, f"the clock of '{folder}' as seen{where}")):
        if abs(late) > CLOCKS:
            raise InputRejected(
                f"{clock} is {abs(late) / 60:.0f} min {'fast' if late > 0 else 'slow'}",
                "clocks that agree: which file is newer is told by them",
                "set the clock, by a time server (chronyc, timedatectl set-ntp true)",
            )  # fmt: skip


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
