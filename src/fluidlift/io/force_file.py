"""What an asset carries of the filmed flow: the steady body force that keeps it, the cells where it never is and where
it always is, and its motion frame by frame, where that was asked for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected, require
from fluidlift.io.array_archive import read_arrays
from fluidlift.io.asset_folder import FILES
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.atomic import atomic_write
from fluidlift.io.footage_file import MOST_FRAMES
from fluidlift.types import FaceVelocity, Filmed, FilmedMotion


def write_filmed(folder: Path, filmed: Filmed) -> None:
    """Write it into an asset; what it lacks is taken away where an older run left it."""
    arrays: dict[str, Any] = {}
    if filmed.force is not None:
        arrays = {n: c.astype(np.float32) for n, c in zip("uvw", filmed.force.components)}
        known = {"dry": filmed.dry, "wet": filmed.wet}
        arrays |= {name: np.packbits(cells) for name, cells in known.items() if cells is not None}
        if np.isfinite(filmed.dry_for):
            arrays["dry_for"] = np.float64(filmed.dry_for)
        if filmed.inlet is not None:
            arrays["inlet"] = filmed.inlet.astype(np.float32)
    _write(asset_file(folder, FILES["force"]), arrays)
    motion: dict[str, Any] = {}
    if filmed.motion is not None:
        motion = dict(zip("uvw", filmed.motion.components))
        motion |= {"interval": np.float64(filmed.motion.interval), "start": np.int64(filmed.motion.start)}
    _write(asset_file(folder, FILES["motion"]), motion)


def _write(path: Path, arrays: dict[str, Any]) -> None:
    if not arrays:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as stream:
        np.savez_compressed(stream, **arrays)


def read_filmed(folder: Path, *, motion: bool = False) -> Filmed:
    """That of an asset; nothing where it has none, no dry or wet cells where an older version made it.

    Args:
        folder: of the asset.
        motion: that of each frame, too: some megabytes.

    Raises:
        InputRejected: a damaged file.
    """
    path, moving, kept = asset_file(folder, FILES["force"]), asset_file(folder, FILES["motion"]), Filmed()
    if path.is_file():
        found = read_arrays(path, ("u", "v", "w"))
        with _named(path, "a force on the faces of a grid"):
            force = FaceVelocity(*(np.asarray(found[n], np.float32) for n in "uvw"))
            dry, wet = (_unpacked(found[n], n, force.shape) if n in found else None for n in ("dry", "wet"))
            inlet = _offsets(found["inlet"]) if "inlet" in found else None
            kept = Filmed(force, dry, float(found.get("dry_for", np.inf)), wet, inlet=inlet)
    if not motion or not moving.is_file():
        return kept
    found = read_arrays(moving, ("u", "v", "w", "interval", "start"))
    with _named(moving, "velocities of frames on the faces of a grid"):
        u, v, w = (np.asarray(found[n], np.float16) for n in "uvw")
        return replace(kept, motion=FilmedMotion(u, v, w, float(found["interval"]), int(found["start"])))


@contextmanager
def _named(path: Path, wanted: str) -> Iterator[None]:
    """What is wrong with arrays, as a word about their file."""
    try:
        yield
    except (IndexError, TypeError, ValueError) as error:
        raise InputRejected(f"'{path.name}': {error}", wanted, "make the asset again") from None


def _offsets(inlet: np.ndarray) -> np.ndarray:
    """float64 [T,3], m, of an inlet in each frame of a film."""
    right = inlet.dtype == np.float32 and inlet.ndim == 2 and inlet.shape[1] == 3 and 0 < len(inlet) <= MOST_FRAMES
    require(right and bool(np.isfinite(inlet).all()), f"an inlet {inlet.dtype} {inlet.shape}", "metres, three a frame")
    return inlet.astype(np.float64)


def _unpacked(bits: np.ndarray, name: str, shape: tuple[int, int, int]) -> np.ndarray:
    """bool [nx,ny,nz] from a bit per cell."""
    count = int(np.prod(shape))
    right = bits.dtype == np.uint8 and bits.shape == ((count + 7) // 8,)
    require(right, f"{name} {bits.dtype} {bits.shape}", "a bit per cell")
    return np.unpackbits(bits, count=count).astype(bool).reshape(shape)
