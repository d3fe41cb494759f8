"""Where the files of an asset may lie: inside its own folder."""

from __future__ import annotations

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
    if foreign or ".." in parts or not parts or "\0" in name or endless:
        raise InputRejected(
            f"the asset names the file '{name[:100]}'", "names inside its own folder", "do not trust this asset"
        )
    path = folder
    for part in parts:
        path = path / part
        if path.is_symlink():
            raise InputRejected(f"'{name}' in '{folder.name}' is a link", "plain files", "do not trust this asset")
    return path
