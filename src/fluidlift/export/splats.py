"""Splats as files of their own: PLY as splat viewers take them, or SPZ, which is small."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.export.job import ExportJob, ExportOutcome, write_terrain
from fluidlift.io.output_files import cleared, numbered
from fluidlift.scene.splat_files import frames_of
from fluidlift.types import Similarity3

if TYPE_CHECKING:
    from fluidlift.io.frames import FluidFrame


def write_spz_frames(job: ExportJob) -> ExportOutcome:
    """Numbered .spz files: y up, metres."""
    from fluidlift.io.spz import write_spz

    cleared(job.out, [".spz"])
    size = 0
    for done, (k, (gaussians, _, _)) in enumerate(zip(job.numbers, frames_of(job.folder, job.picked), strict=True)):
        job.progress.update(done, len(job.picked))
        size += write_spz(numbered(job.out, k, ".spz"), gaussians).stat().st_size
    each = size / max(len(job.picked), 1) / 1e6
    return ExportOutcome(
        (f"{each:.2f} MB per frame; the format has no place for ids and velocities",), (), {"bytes": size}
    )


def kind_column(frame: FluidFrame) -> dict[str, np.ndarray]:
    """The property `kind` of a fluid with white water, in every frame: 0 spray, 1 foam, 2 bubbles, -1 all else."""
    return {} if frame.kinds is None else {"kind": np.asarray(frame.kinds, np.int32)}


def write_splats(job: ExportJob, frames: Iterator[FluidFrame]) -> ExportOutcome:
    """Numbered .ply files and the terrain, in the axes and units that are asked for."""
    from fluidlift.io.ply import write_gaussians

    cleared(job.out, [".ply"])
    scale, axes = Similarity3(job.place.scale), f"{job.request.up_axis}_up"
    for k, frame in zip(job.numbers, frames, strict=True):
        velocities = frame.velocities * np.float32(scale.scale)
        write_gaussians(
            numbered(job.out, k, ".ply"), frame.gaussians.transformed(scale), ids=frame.ids, velocities=velocities,
            axes=axes, comments=[job.unit], extras=kind_column(frame),
        )  # fmt: skip
    write_terrain(job)
    return ExportOutcome()
