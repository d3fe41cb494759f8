"""Where an asset keeps the frames of its simulation, and what goes on from them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.asset_paths import asset_file
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.types import Gaussians

BYTES_PER_SPLAT = 84
"""of disk, in a frame's file: 17 numbers of a splat, its id and its velocity, of 4 bytes each"""


def frame_file(folder: Path, number: int) -> Path:
    """Splats of one frame; numbers start at 1001. Raises as `asset_file`."""
    return asset_file(folder, f"frames/splats/{number:04d}.ply")


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
    from fluidlift.io.frames import FIRST_FRAME
    from fluidlift.io.ply import read_splats

    for k in picked:
        splats = read_splats(frame_file(folder, FIRST_FRAME + k))
        missing = {"id", "vx", "vy", "vz"} - splats.extras.keys()
        if missing:
            raise InputRejected(
                f"frame {FIRST_FRAME + k} of '{folder.name}' has no {', '.join(sorted(missing))}",
                "frames as the simulation writes them", f"fluidlift sim {folder} --restart",
            )  # fmt: skip
        yield splats.gaussians, splats.extras["id"], np.stack([splats.extras[v] for v in ("vx", "vy", "vz")], axis=-1)


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
        raise InputRejected(f"'{folder.name}' has no simulated frames", "frames/splats/1001.ply and so on",
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
        raise InputRejected(f"frame {gone} is missing: frames/splats/{gone}.ply", "every frame of the range",
                            f"fluidlift sim {folder} --restart, or --frames with a range without it")  # fmt: skip
    return numbers
