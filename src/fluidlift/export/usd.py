"""A finished asset as OpenUSD: what the file holds besides the frames, and the volumes beside it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fluidlift.export.bodies import bodies_of
from fluidlift.export.job import ExportJob, ExportOutcome
from fluidlift.io.frames import FIRST_FRAME, FluidFrame
from fluidlift.messages import Notice
from fluidlift.types import FluidAsset, kind_of

if TYPE_CHECKING:
    from fluidlift.io.export_usd import PreviewMaterial, UsdSettings

VOLUMES = "volumes"
"""folder of the OpenVDB files, beside the USD file"""
DEPTH = 0.5
"""of the body: as deep as half its height, a preview material shows the liquid"""


def write_usd_asset(job: ExportJob, frames: Iterable[FluidFrame], settings: UsdSettings) -> tuple[Notice, ...]:
    """fluid.usda with all that belongs to it; warnings.

    Args:
        job: asset, folder for the files, frames that are picked.
        frames: of the fluid; smoke gets its volumes written here.
        settings: axes, units, layout, first number. Without a material it is that of scene.yaml.
    """
    from dataclasses import replace

    from fluidlift.io.export_usd import write_usd

    asset = job.asset
    settings = replace(settings, material=settings.material or preview_of(job.folder, asset))
    bodies, warnings = bodies_of(job.folder, job.picked)
    if kind_of(asset.kind).is_gas:
        frames = _with_volumes(frames, job.out, asset, settings.start_frame)
    write_usd(
        job.out / "fluid.usda", frames=frames, interval=job.interval, terrain=asset.terrain.mesh, camera=asset.camera,
        bodies=bodies, attributes=asset.parameters.to_dict() | {"kind": asset.kind}, settings=settings,
    )  # fmt: skip
    return warnings


def preview_of(folder: Path, asset: FluidAsset) -> PreviewMaterial | None:
    """The material that scene.yaml names, as a preview can show it; None: the clip's own colours."""
    from fluidlift.io.export_usd import PreviewMaterial
    from fluidlift.io.scene import read_edits
    from fluidlift.look.materials import material_named

    look = read_edits(folder).look
    if look.material == "source":
        return None
    m = material_named(look.material).tinted(look.tint)
    height = float(np.ptp(asset.rest.means[:, 2])) if len(asset.rest) else 0.0
    depth = max(DEPTH * height, asset.grid.spacing)
    return PreviewMaterial.of_depth(
        m.name, depth, absorption=m.absorption, scattering=m.scattering, albedo=m.albedo, emission=m.emission,
        refractive_index=m.refractive_index, roughness=m.roughness,
    )  # fmt: skip


def _with_volumes(
    frames: Iterable[FluidFrame], out: Path, asset: FluidAsset, start_frame: int = FIRST_FRAME
) -> Iterator[FluidFrame]:
    """The frames of smoke, each with the name of its OpenVDB file."""
    from fluidlift.export.volumes import gridded
    from fluidlift.io.output_files import cleared
    from fluidlift.io.volume_grid import VolumeGrid, velocity_grid, write_vdb

    cleared(out / VOLUMES, [".vdb"])
    for k, frame in enumerate(frames):
        velocity, density, grid = gridded(frame, asset.grid, smoke=True)
        filled = density > 0
        path = out / VOLUMES / f"{start_frame + k:04d}.vdb"
        density_grid = VolumeGrid("density", density, asset.grid.spacing, grid.origin, filled)
        write_vdb(path, [velocity_grid(velocity, grid, active=filled), density_grid])
        yield frame._replace(volume=path.relative_to(out).as_posix())


def write_usd_files(job: ExportJob, frames: Iterator[FluidFrame]) -> ExportOutcome:
    """One file with all of it, or one with a clip per frame."""
    from fluidlift.io.export_usd import UsdSettings

    layout = "clips" if job.request.to == "usd-clips" else "file"
    axes, unit = job.request.up_axis, job.request.meters_per_unit
    settings = UsdSettings(FIRST_FRAME + job.numbers.start, axes, unit, layout)
    return ExportOutcome(warnings=write_usd_asset(job, frames, settings))
