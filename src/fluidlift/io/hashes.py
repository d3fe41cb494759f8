"""SHA-256 of files: whether they are still what was written."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path

from fluidlift.io.asset_paths import asset_file


def digest(path: Path) -> str:
    """SHA-256 of a file's content, 64 hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def file_hash(path: Path) -> str:
    """SHA-256 of a file with its name, or of all files of a folder with theirs."""
    found = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for file in files:
        found.update(file.name.encode())
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                found.update(block)
    return found.hexdigest()


def digests(folder: Path | str, names: Iterable[str]) -> dict[str, str]:
    """SHA-256 of those files of an asset that are there, by their names in it; raises as `asset_file`."""
    paths = {name: asset_file(folder, name) for name in sorted(set(names))}
    return {name: digest(path) for name, path in paths.items() if path.is_file()}


def altered(folder: Path | str, recorded: Mapping[str, str]) -> tuple[list[str], list[str]]:
    """Names of files that are missing, and of those whose content is not what was recorded."""
    found = digests(folder, recorded)
    missing = [name for name in recorded if name not in found]
    return missing, [name for name, value in found.items() if value != recorded[name]]
