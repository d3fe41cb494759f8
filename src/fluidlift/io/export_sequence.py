"""Numbered files, one per frame: splats/####.ply, mesh/####.ply, velocity/####.vdb, from frame 1001."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from fluidlift.errors import require
from fluidlift.io.frames import FIRST_FRAME, FluidFrame
from fluidlift.io.ply import write_gaussians, write_mesh
from fluidlift.io.volume_grid import VolumeGrid, write_vdb


def frame_name(number: int, suffix: str) -> str:
    """1001 -> '1001.ply'; at least four digits."""
    return f"{number:04d}{suffix}"


def write_splat_sequence(
    folder: Path | str,
    frames: Iterable[FluidFrame | tuple],
    *,
    start_frame: int = FIRST_FRAME,
    axes: str = "z_up",
) -> list[Path]:
    """Write splats with stable ids and velocities (m/s), one PLY per frame; frames are taken one by one.

    Raises:
        InputRejected: the disk is full or may not be written.
        ValueError: no frames, or arrays of wrong lengths.
    """
    written = []
    for number, item in enumerate(frames, start=start_frame):
        frame = FluidFrame.of(item)
        path = Path(folder) / frame_name(number, ".ply")
        comments = [f"frame {number}"]
        write_gaussians(path, frame.gaussians, ids=frame.ids, velocities=frame.velocities, axes=axes, comments=comments)
        written.append(path)
    require(bool(written), "no frames to write")
    return written


def write_mesh_sequence(
    folder: Path | str, frames: Iterable[FluidFrame | tuple], *, start_frame: int = FIRST_FRAME
) -> list[Path]:
    """Write the free surface of the frames that have one, with velocities of the vertices for motion blur."""
    written = []
    for number, item in enumerate(frames, start=start_frame):
        frame = FluidFrame.of(item)
        if frame.surface is not None:
            path = Path(folder) / frame_name(number, ".ply")
            written.append(write_mesh(path, frame.surface, velocities=frame.surface_velocities))
    return written


def write_volume_sequence(
    folder: Path | str, frames: Iterable[list[VolumeGrid]], *, start_frame: int = FIRST_FRAME
) -> list[Path]:
    """Write one OpenVDB file per frame."""
    return [
        write_vdb(Path(folder) / frame_name(number, ".vdb"), grids)
        for number, grids in enumerate(frames, start=start_frame)
    ]
