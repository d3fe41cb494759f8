"""The user's cache of learned models: where they lie, which are there, and whether they are still what was fetched."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluidlift.backends.model_card import ModelCard
from fluidlift.errors import InputRejected

VARIABLE = "FLUIDLIFT_MODELS"
"""environment variable with another folder, such as one on a larger disk or one that a farm shares"""
ELSEWHERE = f"name another folder with {VARIABLE}"
"""what to do where models cannot be kept"""
RECORD = "model.json"
_RECORD_BYTES = 64 * 2**10


@dataclass(frozen=True)
class KeptModel:
    """A model in the cache."""

    name: str
    folder: Path
    hashes: dict[str, str]
    """SHA-256 of each file, as it was when it came"""
    checked: str
    """against what: card (the hash that is known here), trusted (one that the user gave), unverified (none)"""
    bytes: int

    @property
    def path(self) -> Path:
        """What a back end is given: the only file, else the folder."""
        return self.folder / next(iter(self.hashes)) if len(self.hashes) == 1 else self.folder

    def require_whole(self) -> None:
        """See that every file is what came, by its hash: a third of a second for 150 MB.

        Raises:
            InputRejected: a file that is missing, changed, or a link.
        """
        for name, sha256 in self.hashes.items():
            path = self.folder / name
            if path.is_symlink() or not path.is_file() or _digest(path) != sha256:
                raise InputRejected(
                    f"'{name}' of the model {self.name} is not what was fetched", f"a file with SHA-256 {sha256}",
                    f"fluidlift models remove {self.name}, then fluidlift models get {self.name}",
                )  # fmt: skip


def models_folder() -> Path:
    """$FLUIDLIFT_MODELS, else fluidlift/models below the user's cache folder ($XDG_CACHE_HOME or ~/.cache)."""
    named = os.environ.get(VARIABLE)
    if named:
        return Path(os.path.expanduser(named))
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "fluidlift" / "models"


def kept(name: str) -> KeptModel | None:
    """The model of that name, where it is in the cache. Its files are not read: see `KeptModel.require_whole`."""
    folder = models_folder() / name
    if "/" in name or name in ("", ".", "..") or folder.is_symlink():
        return None
    facts = _record(folder)
    hashes = facts.get("files")
    if facts.get("name") != name or not isinstance(hashes, dict) or not hashes or not all(map(_plain, hashes)):
        return None
    if not all((folder / f).is_file() for f in hashes):
        return None
    size = sum((folder / f).stat().st_size for f in hashes)
    return KeptModel(name, folder, {k: str(v) for k, v in hashes.items()}, str(facts.get("checked", "")), size)


def all_kept(cards: tuple[ModelCard, ...]) -> tuple[KeptModel, ...]:
    """Those of some cards that are in the cache, in their order."""
    found = (kept(card.name) for card in cards)
    return tuple(model for model in found if model is not None)


def remove(name: str) -> int:
    """Delete a model, and what an interrupted download of it left; the bytes that became free.

    Raises:
        InputRejected: there is nothing of it, another process is fetching it, or it cannot be deleted.
    """
    folders = [folder for folder in (models_folder() / name, begun_folder(name)) if os.path.lexists(folder)]
    if not folders:
        raise InputRejected(f"the model {name} is not in the cache", "one that is", "fluidlift models")
    with alone(name):
        freed = 0
        for folder in folders:
            try:
                if folder.is_symlink():  # never what it leads to
                    folder.unlink()
                    continue
                freed += sum(p.lstat().st_size for p in folder.iterdir() if not p.is_symlink())
                shutil.rmtree(folder)
            except OSError as error:
                raise InputRejected(
                    f"'{folder}' cannot be deleted ({error.strerror})", "permission", "delete it by hand"
                ) from None
    with suppress(OSError):
        _lock_file(name).unlink()
    return freed


def begun_folder(name: str) -> Path:
    """Where the files of a model lie until all are there and right."""
    return models_folder() / f"{name}.begun"


@contextmanager
def alone(name: str) -> Iterator[None]:
    """While the block runs no other process fetches or removes this model.

    Raises:
        InputRejected: another one does, or the folder cannot be written.
    """
    path = _lock_file(name)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(path, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise InputRejected(
            f"'{path.parent}' cannot be written ({error.strerror})", "a folder that can be written", ELSEWHERE
        ) from None
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputRejected(
                f"another process is fetching or removing {name}", "one at a time", "wait until it is done"
            ) from None
        yield
    finally:
        os.close(file)


def _lock_file(name: str) -> Path:
    return models_folder() / f".{name}.lock"


def _record(folder: Path) -> dict[str, Any]:
    try:
        path = folder / RECORD
        if path.is_symlink() or path.stat().st_size > _RECORD_BYTES:
            return {}
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def _plain(name: str) -> bool:
    return "/" not in name and name not in ("", ".", "..", RECORD)


def _digest(path: Path) -> str:
    from fluidlift.io.hashes import digest

    return digest(path)
