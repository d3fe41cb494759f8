"""What an asset carries of the filmed flow: the steady body force that keeps it, and the cells where it never is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected, require
from fluidlift.io.array_archive import read_arrays
from fluidlift.io.asset_folder import FILES
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.atomic import atomic_write
from fluidlift.types import FaceVelocity, Filmed


def write_filmed(folder: Path, filmed: Filmed) -> None:
    """Write it into an asset; one without a force takes away an older one."""
    path = asset_file(folder, FILES["force"])
    if filmed.force is None:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {n: c.astype(np.float32) for n, c in zip("uvw", filmed.force.components)}
    if filmed.dry is not None:
        arrays["dry"] = np.packbits(filmed.dry)
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **arrays)


def read_filmed(folder: Path) -> Filmed:
    """That of an asset; nothing where it has none, no dry cells where an older version made it.

    Raises:
        InputRejected: a damaged file.
    """
    path = asset_file(folder, FILES["force"])
    if not path.is_file():
        return Filmed()
    found = read_arrays(path, ("u", "v", "w"))
    try:
        force = FaceVelocity(*(np.asarray(found[n], np.float32) for n in "uvw"))
        return Filmed(force, _unpacked(found["dry"], force.shape) if "dry" in found else None)
    except (IndexError, TypeError, ValueError) as error:
        raise InputRejected(
            f"'{path.name}': {error}", "a force on the faces of a grid", "make the asset again"
        ) from None


def _unpacked(bits: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """bool [nx,ny,nz] from a bit per cell."""
    count = int(np.prod(shape))
    require(
        bits.dtype == np.uint8 and bits.shape == ((count + 7) // 8,), f"dry {bits.dtype} {bits.shape}", "a bit per cell"
    )
    return np.unpackbits(bits, count=count).astype(bool).reshape(shape)
