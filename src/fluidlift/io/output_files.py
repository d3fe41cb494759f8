"""What a command that writes files for other tools tells at its end."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fluidlift.io.frames import FIRST_FRAME
from fluidlift.messages import Notice, as_plain


@dataclass(frozen=True)
class Written:
    """A folder of files, and what is known of them."""

    folder: Path
    seconds: float
    warnings: tuple[Notice, ...]
    stages: dict[str, Any]
    """seconds and peak memory of each stage"""
    facts: dict[str, Any]
    """plain values, for --json"""
    summary: tuple[str, ...]
    """in words"""

    def to_dict(self) -> dict[str, Any]:
        """Plain data for --json."""
        return (
            self.facts
            | {
                "folder": str(self.folder),
                "seconds": round(self.seconds, 3),
                "stages": self.stages,
            }
            | as_plain(self.warnings)
        )

    def lines(self) -> list[str]:
        """For people."""
        return [*self.summary, f"done in {self.seconds:.0f} s"]


def numbered(folder: Path, frame: int, suffix: str) -> Path:
    """The file of a frame: frame 0 has the number 1001."""
    return folder / f"{FIRST_FRAME + frame:04d}{suffix}"


def cleared(folder: Path, suffixes: Iterable[str]) -> Path:
    """The folder, without numbered files of an earlier run."""
    if folder.is_dir():
        for file in folder.iterdir():
            if file.suffix in suffixes and not file.is_symlink():
                file.unlink()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def digest_of(files: Iterable[Path]) -> str:
    """SHA-256 of files in order, to see whether a person has changed them."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.read_bytes() if file.is_file() else b"")
        digest.update(b"\0")
    return digest.hexdigest()
