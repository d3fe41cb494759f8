"""The steady body force that an asset carries: what keeps the filmed flow beside gravity."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.array_archive import read_arrays
from fluidlift.io.asset_folder import FILES
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.atomic import atomic_write
from fluidlift.types import FaceVelocity


def write_force(folder: Path, force: FaceVelocity | None) -> None:
    """Write an acceleration (m/s^2, on the faces of the asset's grid) into an asset; None: take away an older one."""
    path = asset_file(folder, FILES["force"])
    if force is None:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    components: dict[str, Any] = {n: c.astype(np.float32) for n, c in zip("uvw", force.components)}
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **components)


def read_force(folder: Path) -> FaceVelocity | None:
    """The acceleration (m/s^2, on the faces of the asset's grid) of an asset; None: it has none.

    Raises:
        InputRejected: a damaged file.
    """
    path = asset_file(folder, FILES["force"])
    if not path.is_file():
        return None
    found = read_arrays(path, ("u", "v", "w"))
    try:
        return FaceVelocity(*(np.asarray(found[n], np.float32) for n in "uvw"))
    except (IndexError, TypeError, ValueError) as error:
        raise InputRejected(
            f"'{path.name}': {error}", "a force on the faces of a grid", "make the asset again"
        ) from None
