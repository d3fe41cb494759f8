"""Where an asset keeps the frames of its simulation, and what goes on from them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.types import Gaussians

BYTES_PER_SPLAT = 80
"""of disk, in a frame's file"""


def frame_file(folder: Path, number: int) -> Path:
    """Splats of one frame; numbers start at 1001."""
    return folder / "frames" / "splats" / f"{number:04d}.ply"


def require_room(folder: Path, frames: int, splats: int) -> None:
    """Raise `InputRejected` where the disk cannot hold so many frames of so many splats."""
    from fluidlift.io.atomic import require_free_space

    require_free_space(folder, frames * splats * BYTES_PER_SPLAT)


def checkpoint_file(folder: Path) -> Path:
    """Where the state of the simulation is kept whose frames are in the folder."""
    return folder / "work" / "checkpoint" / "simulation.npz"


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
