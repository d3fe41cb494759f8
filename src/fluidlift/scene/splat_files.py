"""Where an asset keeps the frames of its simulation, and what goes on from them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.asset_paths import asset_file, asset_files
from fluidlift.io.frames import FIRST_FRAME, FluidFrame
from fluidlift.io.packed_splats import SUFFIX, packable, read_packed, write_packed
from fluidlift.types import Gaussians

FOLDER = "frames/splats"
"""of an asset, where the frames are"""
PACKED, PLAIN = SUFFIX, ".ply"
"""suffixes of frames: as they are written, and as versions before wrote them"""
BYTES_PER_SPLAT = 18
"""of disk, in a packed frame: 16 in the demo's last frames, and more where fewer neighbours are alike"""


def frame_file(folder: Path, number: int) -> Path:
    """Splats of one frame, from 1001 on: packed or, where only that is there, PLY. Raises as `asset_file`."""
    packed = asset_file(folder, f"{FOLDER}/{number:04d}{PACKED}")
    plain = asset_file(folder, f"{FOLDER}/{number:04d}{PLAIN}")
    return plain if plain.is_file() and not packed.is_file() else packed


def frame_files(folder: Path) -> list[Path]:
    """The files of all frames that are there, in order. Raises as `asset_files`."""
    return asset_files(folder, FOLDER, (PACKED, PLAIN))


def write_frame(folder: Path, number: int, gaussians: Gaussians, *, ids: np.ndarray, velocities: np.ndarray) -> Path:
    """Write one frame (world, m; m/s), in place of what was there: packed, or as PLY where it cannot be packed.

    Raises:
        InputRejected: as `asset_file`, or the disk does not take it.
    """
    from fluidlift.io.ply import write_gaussians

    packed, plain = (asset_file(folder, f"{FOLDER}/{number:04d}{suffix}") for suffix in (PACKED, PLAIN))
    if packable(gaussians, velocities):
        written, other = write_packed(packed, gaussians, ids=ids, velocities=velocities), plain
    else:
        written, other = write_gaussians(plain, gaussians, ids=ids, velocities=velocities), packed
    other.unlink(missing_ok=True)
    return written


def read_frame(path: Path) -> FluidFrame:
    """A frame, packed or PLY.

    Raises:
        InputRejected: it is missing or damaged, or a PLY without ids or velocities.
    """
    if path.suffix == PACKED:
        return read_packed(path)
    from fluidlift.io.ply import read_splats

    splats = read_splats(path)
    missing = {"id", "vx", "vy", "vz"} - splats.extras.keys()
    if missing:
        raise InputRejected(
            f"'{path.name}' has no {', '.join(sorted(missing))}", "frames as the simulation writes them",
            "fluidlift sim with --restart",
        )  # fmt: skip
    velocities = np.stack([splats.extras[v] for v in ("vx", "vy", "vz")], axis=-1)
    return FluidFrame(splats.gaussians, splats.extras["id"], velocities)


def require_room(folder: Path, frames: int, splats: int) -> None:
    """Raise `InputRejected` where the disk cannot hold so many frames of so many splats."""
    from fluidlift.io.atomic import require_free_space

    require_free_space(folder, frames * splats * BYTES_PER_SPLAT)


def checkpoint_file(folder: Path) -> Path:
    """Where the state of the simulation is kept whose frames are in the folder. Raises as `asset_file`."""
    return asset_file(folder, "work/checkpoint/simulation.npz")


def frames_of(folder: Path, picked: range) -> Iterator[tuple[Gaussians, np.ndarray, np.ndarray]]:
    """(gaussians, ids, velocities m/s) of some simulated frames, read one by one.

    Raises:
        InputRejected: a frame is missing or damaged.
    """
    for k in picked:
        frame = read_frame(frame_file(folder, FIRST_FRAME + k))
        yield frame.gaussians, frame.ids, frame.velocities


def splat_frames(folder: Path, count: int) -> Iterator[tuple[Gaussians, np.ndarray, np.ndarray]]:
    """(gaussians, ids, velocities) of each simulated frame."""
    return frames_of(folder, range(count))


def frames_told(count: int) -> str:
    """A number of frames in words."""
    return f"{count} frame" + ("s" if count != 1 else "")


def frame_numbers(folder: Path, count: int, wanted: tuple[int, int] | None) -> range:
    """Frames of an asset, from 0: of the `count` that were simulated those whose files are there, or those wanted
    (first and last number, from 1001).

    Raises:
        InputRejected: none are there, or not those.
    """
    gaps = [k for k in range(count) if not frame_file(folder, FIRST_FRAME + k).is_file()]
    if len(gaps) == count:
        raise InputRejected(f"'{folder.name}' has no simulated frames", f"{FOLDER}/1001{PACKED} and so on",
                            f"fluidlift sim {folder}")  # fmt: skip
    if wanted is None and gaps[:1] != [0]:
        return range(gaps[0] if gaps else count)
    first, last = wanted or (FIRST_FRAME, FIRST_FRAME + count - 1)
    if not FIRST_FRAME <= first <= last < FIRST_FRAME + count:
        raise InputRejected(f"frames {first} to {last}", f"numbers from {FIRST_FRAME} to {FIRST_FRAME + count - 1}",
                            "the first frame of an asset is 1001" if first < FIRST_FRAME else "")  # fmt: skip
    numbers = range(first - FIRST_FRAME, last - FIRST_FRAME + 1)
    gone = next((FIRST_FRAME + k for k in gaps if k in numbers), None)
    if gone is not None:
        raise InputRejected(f"frame {gone} is missing: {FOLDER}/{gone}{PACKED}", "every frame of the range",
                            f"fluidlift sim {folder} --restart, or --frames with a range without it")  # fmt: skip
    return numbers
