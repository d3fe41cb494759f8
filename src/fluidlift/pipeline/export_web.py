"""Single frames for viewers on the web: splats as SPZ, and one frame with its ground and camera as glTF."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fluidlift.io.frames import FIRST_FRAME
from fluidlift.pipeline.export_job import ExportJob, Outcome
from fluidlift.pipeline.splat_files import frames_of
from fluidlift.pipeline.written import cleared, numbered

if TYPE_CHECKING:
    from collections.abc import Callable

    from fluidlift.io.frames import FluidFrame

HERO, SURFACE = "hero.glb", "surface.glb"


def write_spz_frames(job: ExportJob) -> Outcome:
    """Numbered .spz files: y up, metres."""
    from fluidlift.io.spz import write_spz

    cleared(job.out, [".spz"])
    size = 0
    for done, (k, (gaussians, _, _)) in enumerate(zip(job.numbers, frames_of(job.folder, job.picked), strict=True)):
        job.progress.update(done, len(job.picked))
        size += write_spz(numbered(job.out, k, ".spz"), gaussians).stat().st_size
    each = size / max(len(job.picked), 1) / 1e6
    return Outcome((f"{each:.2f} MB per frame; the format has no place for ids and velocities",), (), {"bytes": size})


def hero_of(picked: range) -> int:
    """The frame of a range that stands for all: the middle one."""
    return picked[len(picked) // 2]


def write_hero(job: ExportJob, surfaced: Callable[[range], FluidFrame]) -> Outcome:
    """One frame as hero.glb (splats, terrain, camera) and surface.glb (the surface as a mesh instead of the splats).

    Args:
        job: whose middle frame is taken.
        surfaced: gives a frame with its surface.
    """
    from fluidlift.io.export_gltf import write_gltf

    k = hero_of(job.picked)
    frame = surfaced(range(k, k + 1))
    ground = {"terrain": job.asset.terrain.mesh}
    write_gltf(job.out / HERO, gaussians=frame.gaussians, meshes=ground, camera=job.asset.camera)
    written = HERO
    if frame.surface is not None and len(frame.surface.faces):
        write_gltf(job.out / SURFACE, meshes=ground | {"surface": frame.surface}, camera=job.asset.camera)
        written += f" (splats) and {SURFACE} (mesh)"
    told = f"glTF holds one instant: frame {FIRST_FRAME + k} as {written}; another with --frames"
    return Outcome((told,), (), {"frames": 1, "first": FIRST_FRAME + k})
