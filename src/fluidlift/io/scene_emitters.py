"""The sections `emitters` and `inflow` of scene.yaml: where fluid comes from, and how much over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.entries import Entries
from fluidlift.io.obstacles import FAR, SIZES, rotation_of, shape_kind, size_hints, solid_of
from fluidlift.numerics.solid_mesh import welded
from fluidlift.physics.emitter import Emitter
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.types import TriangleMesh, matrix_from_quat

MOST_EMITTERS = 64
_MOST_KEYS = 10_000
_LATEST = 1e6
_COMMON = ("name", "shape", "mesh", "position", "rotation", "scale", "velocity", "start", "end", "color")


def read_emitters(scene: Entries, meshes: Path) -> tuple[Emitter, ...]:
    """The list `emitters` of a scene.

    Args:
        scene: all of scene.yaml.
        meshes: folder that mesh files are looked up in, and must lie in.

    Raises:
        InputRejected: an entry that is unknown, missing or out of range, or a mesh that bounds no solid; the message
            names the line.
    """
    entries = scene.parts("emitters", "an emitter", most=MOST_EMITTERS)
    found = [_read(entry, i, meshes) for i, entry in enumerate(entries)]
    names = [e.name for e in found]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InputRejected(f"{found[i].line}: a second emitter '{name}'", "different names")
    return tuple(found)


def _read(entry: Entries, number: int, meshes: Path) -> Emitter:
    kind = shape_kind(entry, "an emitter")
    entry.only((*_COMMON, *SIZES[kind]), size_hints(kind))
    start = entry.number("start", 0.0, low=0.0, high=_LATEST, unit="s")
    end = entry.number("end", None, low=0.0, high=_LATEST, unit="s") if entry.given("end") else None
    if end is not None and end <= start:
        raise entry.wrong("end", f"end {end:g} s of an emitter that starts at {start:g} s", "a later end, or none")
    color = None
    if entry.given("color"):
        color = entry.vector("color", None, limit=1.0, unit="(sRGB)", low=0.0, example="[0.2, 0.4, 0.9]")
    return Emitter(
        name=entry.text("name") if entry.given("name") else f"{kind}{number + 1}",
        mesh=_placed(entry, kind, meshes),
        velocity=entry.vector("velocity", (0.0, 0.0, 0.0), limit=1e3, unit="m/s"),
        start=start,
        end=end,
        color=color,
        line=entry.place,
    )


def _placed(entry: Entries, kind: str, meshes: Path) -> TriangleMesh:
    """The closed mesh of a shape in the world, m."""
    mesh = solid_of(entry, kind, meshes, "emitter")
    if kind == "mesh":
        mesh = welded(mesh)
    turn = matrix_from_quat(rotation_of(entry.vector("rotation", (0.0, 0.0, 0.0), limit=1e6, unit="degrees")))
    at = np.array(entry.vector("position", (0.0, 0.0, 0.0), limit=FAR, unit="m"))
    return TriangleMesh(np.asarray(mesh.vertices, np.float64) @ turn.T + at, mesh.faces)


def read_inflow(scene: Entries) -> InflowSchedule:
    """The section `inflow` of a scene; `factor` multiplies all keyframes.

    Raises:
        InputRejected: an entry that is unknown or out of range, or keyframes that are not in order of time.
    """
    inflow, plain = scene.part("inflow", "inflow"), InflowSchedule()
    inflow.only(("factor", "keyframes", "fluctuation", "period"))
    factor = inflow.number("factor", 1.0, low=0.0, high=100.0, unit="times the inflow's velocity")
    keys: list[tuple[float, float]] = []
    for key in inflow.parts("keyframes", "a keyframe", most=_MOST_KEYS):
        key.only(("time", "factor"))
        time = key.number("time", None, low=0.0, high=_LATEST, unit="s")
        if keys and time <= keys[-1][0]:
            raise key.wrong("time", f"time {time:g} s after {keys[-1][0]:g} s", "keyframes in order of time")
        keys.append((time, factor * key.number("factor", None, low=0.0, high=100.0, unit="times")))
    return InflowSchedule(
        tuple(keys) or ((0.0, factor),),
        inflow.number("fluctuation", plain.fluctuation, low=0.0, high=10.0, unit="of the inflow's velocity"),
        inflow.number("period", plain.period, low=1e-3, high=_LATEST, unit="s"),
    )
