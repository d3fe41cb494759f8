"""The section `terrain` of scene.yaml: edits of the ground, one after the other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.entries import TERRAIN_EDITS, Entries, nearest
from fluidlift.io.obstacles import FAR, mesh_file, rotation_of, scale_of
from fluidlift.physics.terrain_edit import Move, Replace, Rotate, Scale, TerrainEdit, Twist, solid_ground
from fluidlift.types import TriangleMesh, matrix_from_quat, triple

_OF_A_MESH = ("mesh", "position", "rotation", "scale", "flip")
_MOST = 64


def read_terrain(scene: Entries, meshes: Path) -> tuple[TerrainEdit, ...]:
    """The list `terrain` of a scene, in its order.

    Args:
        scene: all of scene.yaml.
        meshes: folder that mesh files are looked up in, and must lie in.

    Raises:
        InputRejected: an edit that is unknown or out of range, two in one entry, or a mesh that bounds no solid.
    """
    return tuple(_read(entry, meshes) for entry in scene.parts("terrain", "an edit of the terrain", most=_MOST))


def _read(entry: Entries, meshes: Path) -> TerrainEdit:
    if entry.given("mesh"):
        entry.only(_OF_A_MESH)
        mesh, note = _bed(entry, meshes)
        return Replace(mesh, entry.place, note and f"{entry.place}: {note}")
    for name in entry.data:
        if name not in TERRAIN_EDITS:
            raise entry.wrong(
                name, f"unknown entry '{name}' of {entry.what}", "one of " + ", ".join(TERRAIN_EDITS),
                nearest(name, TERRAIN_EDITS),
            )  # fmt: skip
    if len(entry.data) != 1:
        found = " and ".join(entry.data) or "nothing"
        raise entry.wrong(
            None, f"{found} in one edit of the terrain", "one of " + ", ".join(TERRAIN_EDITS),
            "write each on a '- ' line of its own: they are done in that order",
        )  # fmt: skip
    (name,) = entry.data
    if name == "move":
        return Move(entry.vector("move", None, limit=FAR, unit="m"), entry.place)
    if name == "rotate":
        return Rotate(entry.number("rotate", None, low=-360.0, high=360.0, unit="degrees about z"), entry.place)
    if name == "twist":
        return Twist(entry.number("twist", None, low=-3600.0, high=3600.0, unit="degrees per metre"), entry.place)
    return Scale(triple(float(f) for f in scale_of(entry, low=0.01, high=100.0)), entry.place)


def _bed(entry: Entries, meshes: Path) -> tuple[TriangleMesh, str]:
    """The closed mesh that replaces the terrain, in the world, m, and what was done to close it."""
    mesh = mesh_file(entry, meshes)
    turn = matrix_from_quat(rotation_of(entry.vector("rotation", (0.0, 0.0, 0.0), limit=1e6, unit="degrees")))
    at = np.array(entry.vector("position", (0.0, 0.0, 0.0), limit=FAR, unit="m"))
    placed = (np.asarray(mesh.vertices, np.float64) * scale_of(entry)) @ turn.T + at
    try:
        return solid_ground(replace(mesh, vertices=placed))
    except InputRejected as error:
        do = "write flip: true" if "inside-out" in error.got else error.do
        raise entry.wrong("mesh", error.got, error.needed, do) from None
