"""The surface of the fluid as numbered files, with the bodies in it beside them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from fluidlift.export.bodies import write_bodies
from fluidlift.export.job import (
    ExportJob,
    ExportOutcome,
    write_terrain,
)
from fluidlift.export.whitewater import WhitewaterFiles
from fluidlift.io.frames import FluidFrame
from fluidlift.io.output_files import cleared, numbered
from fluidlift.types import TriangleMesh

if TYPE_CHECKING:
    pass


def write_meshes(job: ExportJob, frames: Iterator[FluidFrame]) -> ExportOutcome:
    """Numbered files of the surface, of white water and the terrain, in the axes and units that are asked for; with PLY
    the bodies."""
    from fluidlift.io.export_mesh import write_mesh, write_obj

    to, place = job.request.to, job.place
    cleared(job.out, [suffix := ".obj" if to == "obj" else ".ply"])
    white = WhitewaterFiles(job.out, place, job.unit)
    for k, frame in zip(job.numbers, frames, strict=True):
        path = numbered(job.out, k, suffix)
        assert frame.surface is not None and frame.surface_velocities is not None  # frames of meshed formats have both
        mesh = TriangleMesh(place.points(frame.surface.vertices), frame.surface.faces, frame.surface.colors)
        if to == "obj":
            write_obj(path, mesh, comment=job.unit)
        else:
            write_mesh(path, mesh, velocities=place.vectors(frame.surface_velocities), comment=job.unit)
        white.write(k, frame)
    write_terrain(job)
    return ExportOutcome(warnings=write_bodies(job) if to == "mesh" else ())
