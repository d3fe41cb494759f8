"""The obstacles of an asset as other tools get them: a mesh each, and where it is in every frame."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fluidlift.export.job import (
    ExportJob,
)
from fluidlift.io.frames import FIRST_FRAME, MovingMesh
from fluidlift.io.output_files import cleared
from fluidlift.messages import Notice
from fluidlift.types import TriangleMesh

if TYPE_CHECKING:
    pass


def write_bodies(job: ExportJob) -> tuple[Notice, ...]:
    """Obstacles beside the meshes of the fluid, in the same axes and units; warnings.

    bodies/NUMBER_NAME.ply has one around its own origin, bodies.json where it is in every frame: "poses" [frames][7],
    place of the origin and unit quaternion w x y z, from the frame "first" on.
    """
    from fluidlift.io.atomic import atomic_write
    from fluidlift.io.export_mesh import write_mesh

    request, listed = job.request, job.out / "bodies.json"
    listed.unlink(missing_ok=True)
    if (job.out / "bodies").is_dir():
        cleared(job.out / "bodies", [".ply"])
    bodies, warnings = bodies_of(job.folder, job.picked)
    place = job.place
    entries: list[dict[str, Any]] = []
    for k, body in enumerate(bodies, 1):
        stem = "".join(c if (c.isascii() and c.isalnum()) or c in "-_" else "_" for c in body.name)
        path = f"bodies/{k:02d}_{stem[:60]}.ply"
        (job.out / "bodies").mkdir(exist_ok=True)
        write_mesh(job.out / path, TriangleMesh(place.points(body.mesh.vertices), body.mesh.faces, body.mesh.colors))
        # turned on both sides, R q R^-1 keeps the angle and turns the axis
        turned = np.concatenate([body.orientations[:, :1], body.orientations[:, 1:] @ place.rotation.T], axis=1)
        poses = np.concatenate([place.points(body.positions), turned], axis=1).astype(float)
        first = FIRST_FRAME + job.numbers.start
        entries.append({"name": body.name, "mesh": path, "first": first, "poses": poses.tolist()})
    if entries:
        facts = {"up_axis": request.up_axis, "meters_per_unit": request.meters_per_unit, "bodies": entries}
        with atomic_write(listed) as file:
            file.write(json.dumps(facts).encode())
    return warnings


def bodies_of(folder: Path, picked: range) -> tuple[list[MovingMesh], tuple[Notice, ...]]:
    """The obstacles in the poses that the simulation gave them in the frames that are picked, and warnings."""
    from fluidlift.io.scene import read_edits
    from fluidlift.scene.recall import simulated_poses

    obstacles = read_edits(folder).obstacles
    if not obstacles:
        return [], ()
    poses = simulated_poses(folder, len(obstacles), picked[-1] + 1)
    if poses is None:
        return [], (
            Notice(
                "obstacles-left-out",
                "the obstacles' motion is not at hand and they are left out: run fluidlift sim again",
            ),
        )
    shown = np.asarray(poses)[list(picked)]
    return [MovingMesh(o.name, o.mesh, shown[:, k, :3], shown[:, k, 3:]) for k, o in enumerate(obstacles)], ()
