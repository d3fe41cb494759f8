"""Paths below an asset, none of which leads out of it: asset folders come from strangers, and they hold no links.

Everything that reads, writes or deletes a file of an asset has its path from here. A command that begins with an asset
looks through all of it once (`require_no_links`), so that nothing is half done when a link is met.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path, PurePosixPath, PureWindowsPath

from fluidlift.errors import InputRejected


def asset_file(folder: Path | str, name: str) -> Path:
    """The file `name` of an asset.

    Raises:
        InputRejected: an absolute name, a drive, `..`, or a link on the way: the file could be anywhere.
    """
    folder = Path(folder)
    foreign = PurePosixPath(name).is_absolute() or PureWindowsPath(name).drive or PureWindowsPath(name).root
    parts = PurePosixPath(name.replace("\\", "/")).parts
    endless = any(len(part.encode("utf-8", "replace")) > 255 for part in parts) or len(name) > 1000
    unwritable = "\0" in name or any(0xD800 <= ord(letter) < 0xE000 for letter in name)
    if foreign or ".." in parts or not parts or unwritable or endless:
        raise InputRejected(
            f"the asset names the file '{name[:100].encode('utf-8', 'backslashreplace').decode()}'",
            "names inside its own folder",
            "do not trust this asset",
        )
    path = folder
    for part in parts:
        path = path / part
        if path.is_symlink():
            raise _is_link(folder, path.relative_to(folder).as_posix())
    return path


def asset_files(folder: Path | str, name: str, suffixes: Iterable[str]) -> list[Path]:
    """Files of an asset's folder `name` that end in one of the suffixes, sorted; none where there is no such folder.

    Raises:
        InputRejected: as `asset_file`, or one of the files is a link.
    """
    place = asset_file(folder, name)
    if not place.is_dir():
        return []
    found = sorted(path for path in place.iterdir() if path.suffix in set(suffixes))
    for path in found:
        if path.is_symlink():
            raise _is_link(Path(folder), path.relative_to(folder).as_posix())
    return found


def require_no_links(folder: Path | str) -> None:
    """Look through an asset before anything is done with it; the folder itself may be a link.

    Raises:
        InputRejected: a link anywhere below it, to a file or a folder; a pipe or a device; or a folder that may not be
            looked into.
    """
    folder = Path(folder)
    waiting = [folder]
    while waiting:
        place = waiting.pop()
        try:
            with os.scandir(place) as entries:
                for entry in entries:
                    if entry.is_symlink():
                        raise _is_link(folder, Path(entry.path).relative_to(folder).as_posix())
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(Path(entry.path))
                    elif not entry.is_file(follow_symlinks=False):  # a pipe would hold up who reads it for ever
                        raise InputRejected(
                            f"'{Path(entry.path).relative_to(folder)}' in '{folder.name}' is a pipe or a device",
                            "plain files and folders inside an asset", "do not trust this asset",
                        )  # fmt: skip
        except FileNotFoundError:  # another run is at work, and this was a temporary folder of it
            continue
        except OSError as error:
            raise InputRejected(
                f"'{place}' cannot be looked into ({error.strerror})", "permission to read it", "change its rights"
            ) from None


def _is_link(folder: Path, name: str) -> InputRejected:
    try:
        leads = f" to '{os.readlink(folder / name)[:200]}'"
    except OSError:
        leads = ""
    return InputRejected(
        f"'{name}' in '{folder.name}' is a link{leads}", "plain files and folders inside an asset",
        "do not trust this asset if the link is not your own; else put what it leads to in its place",
    )  # fmt: skip
