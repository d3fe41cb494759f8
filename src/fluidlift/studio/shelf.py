"""The assets of a folder: looked at, duplicated, exported, put into the trash and taken out again."""

from __future__ import annotations

import os
import re
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import FluidliftError, InputRejected

SUFFIX = ".fluid"
TRASH = "trash"
THUMB = 240
"""px, width of a thumbnail"""


@dataclass(frozen=True)
class Entry:
    """One asset, as the shelf shows it."""

    name: str
    bytes: int
    verdict: str
    card: list[list[str]]
    changed: float

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return dict(vars(self))


class Shelf:
    """The finished assets below a folder.

    Args:
        folder: that they lie in.
        room: folder for the trash.
    """

    def __init__(self, folder: Path, room: Path) -> None:
        self.folder, self.trash = folder, room / TRASH
        self._known: dict[str, tuple[float, Entry]] = {}

    def entries(self) -> list[dict[str, Any]]:
        """All of them, by name. What did not change since is not measured again."""
        found = []
        for path in sorted(self.folder.glob(f"*{SUFFIX}")):
            manifest = path / "manifest.json"
            if path.is_symlink() or not manifest.is_file():
                continue
            changed = manifest.stat().st_mtime
            known = self._known.get(path.name)
            if known is None or known[0] != changed:
                known = self._known[path.name] = (changed, _entry(path, changed))
            found.append(known[1].to_dict())
        return found

    def path(self, name: str) -> Path:
        """The folder of an asset on the shelf.

        Raises:
            InputRejected: there is none of that name.
        """
        path = self.folder / name
        good = Path(name).name == name and name.endswith(SUFFIX) and path.is_dir() and not path.is_symlink()
        if not good:
            raise InputRejected(f"no asset '{name}' on the shelf", "one of those that are shown", "load the page again")
        return path

    def duplicate(self, name: str) -> str:
        """Copy an asset; the name of the copy."""
        source = self.path(name)
        target = _free(self.folder, source.stem + "-copy", SUFFIX)
        shutil.copytree(source, target, symlinks=True)
        return target.name

    def discard(self, name: str) -> str:
        """Into the trash; its name there."""
        source = self.path(name)
        self.trash.mkdir(parents=True, exist_ok=True)
        target = _free(self.trash, f"{source.stem}.{time.strftime('%Y%m%d-%H%M%S')}", SUFFIX)
        source.rename(target)
        return target.name

    def trashed(self) -> list[str]:
        """Names in the trash, the last first."""
        found = sorted(self.trash.glob(f"*{SUFFIX}"), key=lambda p: p.stat().st_mtime, reverse=True)
        return [p.name for p in found if not p.is_symlink()]

    def restore(self, name: str) -> str:
        """Out of the trash; its name on the shelf."""
        if name not in self.trashed():
            raise InputRejected(f"no asset '{name}' in the trash", "one that lies there", "load the page again")
        stem = re.sub(r"\.\d{8}-\d{6}(-\d+)?$", "", name.removesuffix(SUFFIX))
        target = _free(self.folder, stem, SUFFIX)
        (self.trash / name).rename(target)
        return target.name

    def picture(self, name: str) -> bytes:
        """JPEG of the re-simulation, in the middle of the preview film.

        Raises:
            InputRejected: the asset has no preview.
        """
        import cv2

        from fluidlift.io.video import probe, read_clip

        film = self.path(name) / "preview.mp4"
        if not film.is_file() or film.is_symlink():
            raise InputRejected(f"'{name}' has no preview", "an asset whose frames were drawn")
        middle = 0.5 * probe(film).duration
        frames = read_clip(film, start=middle, duration=0.5, max_size=3 * THUMB).frames
        picture = np.ascontiguousarray(frames[0][:, frames.shape[2] // 3 : 2 * frames.shape[2] // 3, ::-1])
        return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


def _entry(path: Path, changed: float) -> Entry:
    from fluidlift.io.asset_folder import read_manifest
    from fluidlift.pipeline import card_of

    card_rows: list[list[str]] = []
    try:
        card = card_of(read_manifest(path))
        verdict = f"not measured: {card}" if isinstance(card, str) else card.sentence()
        if not isinstance(card, str):
            card_rows = [list(row) for row in card.rows()]
    except FluidliftError as error:
        verdict = str(error)
    return Entry(path.name, _size(path), verdict, card_rows, changed)


def _size(path: Path) -> int:
    total = 0
    for root, _, files in os.walk(path):
        total += sum(os.lstat(os.path.join(root, f)).st_size for f in files)
    return total


def _free(folder: Path, stem: str, suffix: str) -> Path:
    """A name that nothing has yet."""
    number, path = 1, folder / f"{stem}{suffix}"
    while path.exists():
        number += 1
        path = folder / f"{stem}-{number}{suffix}"
    return path
