"""Obstacles of scene.yaml: what a person puts into the fluid, as read and checked, before physics takes it over."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fluidlift.errors import InputRejected
from fluidlift.io.entries import Entries
from fluidlift.io.read_mesh import read_any_mesh
from fluidlift.numerics.solid_mesh import box_mesh, cylinder_mesh, ellipsoid_mesh
from fluidlift.types import TriangleMesh

MOTIONS = ("static", "animated", "free")
SHAPES = ("sphere", "ellipsoid", "box", "cylinder")

_MOST = 64
_MOST_KEYS = 10_000
_FAR = 1e5
_COMMON = ("name", "shape", "mesh", "position", "rotation", "scale", "motion", "density", "friction", "restitution",
           "velocity", "angular_velocity", "keyframes")  # fmt: skip
_SIZES = {
    "sphere": ("radius",), "ellipsoid": ("size",), "box": ("size",), "cylinder": ("radius", "height"), "mesh": (),
}  # fmt: skip


@dataclass(frozen=True)
class Keyframe:
    """Where an animated obstacle is at one time."""

    time: float
    """s"""
    position: tuple[float, float, float]
    """m"""
    rotation: Float[np.ndarray, "3 3"]
    """world_from_body"""


@dataclass(frozen=True)
class Obstacle:
    """One solid in the fluid."""

    name: str
    mesh: TriangleMesh
    """m, scaled, around the body's own origin"""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m, of the body's origin in the world"""
    rotation: Float[np.ndarray, "3 3"] = field(default_factory=lambda: np.eye(3))
    """world_from_body"""
    motion: str = "static"
    """static; animated: moves as told; free: moves as fluid and gravity push it"""
    density: float = 500.0
    """kg/m^3, of a free one"""
    friction: float = 0.5
    """Coulomb's coefficient against terrain and other bodies"""
    restitution: float = 0.0
    """0 to 1"""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m/s, at the first instant"""
    angular_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """rad/s, at the first instant"""
    keyframes: tuple[Keyframe, ...] = ()
    """of an animated one, in order of time"""
    line: str = ""
    """where it stands in the file, for later complaints"""


def rotation_of(degrees: tuple[float, float, float]) -> Float[np.ndarray, "3 3"]:
    """Turned about the world's x, then y, then z axis."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def read_obstacles(scene: Entries, meshes: Path) -> tuple[Obstacle, ...]:
    """The list `obstacles` of a scene.

    Args:
        scene: all of scene.yaml.
        meshes: folder that mesh files are looked up in, and must lie in.

    Raises:
        InputRejected: an entry that is unknown, missing or out of range (the message names its line), or a mesh file
            that cannot be read or lies elsewhere.
    """
    found = [_read(entry, i, meshes) for i, entry in enumerate(scene.parts("obstacles", "an obstacle", most=_MOST))]
    names = [o.name for o in found]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InputRejected(f"{found[i].line}: a second obstacle '{name}'", "different names")
    return tuple(found)


def _read(entry: Entries, number: int, meshes: Path) -> Obstacle:
    if "center" in entry.data:  # the name in the examples of earlier versions
        if "position" in entry.data:
            raise entry.wrong("center", "both center and position", "position")
        entry.data = {("position" if k == "center" else k): v for k, v in entry.data.items()}
    if entry.given("mesh") == entry.given("shape"):
        raise entry.wrong(
            None, "an obstacle with " + ("both shape and mesh" if entry.given("mesh") else "neither shape nor mesh"),
            "one of them: shape: " + "/".join(SHAPES) + ", or mesh: name of an .obj, .ply or .glb file",
        )  # fmt: skip
    kind = "mesh" if entry.given("mesh") else entry.word("shape", None, SHAPES)
    entry.only((*_COMMON, *_SIZES[kind]))
    motion = entry.word("motion", "static", MOTIONS)
    keyframes = _keyframes(entry)
    if keyframes and motion != "animated":
        raise entry.wrong("keyframes", f"keyframes of a {motion} obstacle", "motion: animated")
    moves = entry.given("velocity") or entry.given("angular_velocity")
    if moves and motion == "static":
        raise entry.wrong("velocity", "the velocity of a static obstacle", "motion: animated or free")
    if motion == "animated" and not keyframes and not moves:
        raise entry.wrong(
            "motion", "an animated obstacle that nothing moves", "keyframes, velocity or angular_velocity"
        )
    position = entry.vector("position", (0.0, 0.0, 0.0), limit=_FAR, unit="m")
    return Obstacle(
        name=entry.text("name") if entry.given("name") else f"{kind}{number + 1}",
        mesh=_mesh(entry, kind, meshes),
        position=position,
        rotation=rotation_of(entry.vector("rotation", (0.0, 0.0, 0.0), limit=1e6, unit="degrees")),
        motion=motion,
        density=entry.number("density", 500.0, low=1e-3, high=1e6, unit="kg/m^3"),
        friction=entry.number("friction", 0.5, low=0.0, high=10.0, unit=""),
        restitution=entry.number("restitution", 0.0, low=0.0, high=1.0, unit=""),
        velocity=entry.vector("velocity", (0.0, 0.0, 0.0), limit=1e3, unit="m/s"),
        angular_velocity=entry.vector("angular_velocity", (0.0, 0.0, 0.0), limit=1e4, unit="rad/s"),
        keyframes=keyframes,
        line=_line(entry),
    )


def _line(entry: Entries) -> str:
    line = entry.lines.get(entry.path)
    return entry.file if line is None else f"{entry.file}, line {line}"


def _keyframes(entry: Entries) -> tuple[Keyframe, ...]:
    keys = []
    for key in entry.parts("keyframes", "a keyframe", most=_MOST_KEYS):
        key.only(("time", "position", "rotation"))
        time = key.number("time", None, low=0.0, high=1e6, unit="s")
        if keys and time <= keys[-1].time:
            raise key.wrong("time", f"time {time:g} s after {keys[-1].time:g} s", "keyframes in order of time")
        position = key.vector("position", None, limit=_FAR, unit="m")
        keys.append(
            Keyframe(time, position, rotation_of(key.vector("rotation", (0.0, 0.0, 0.0), limit=1e6, unit="degrees")))
        )
    if len(keys) == 1:
        raise entry.wrong("keyframes", "a single keyframe", "two or more, or none")
    return tuple(keys)


def _mesh(entry: Entries, kind: str, meshes: Path) -> TriangleMesh:
    scale = _scale(entry)
    if kind == "mesh":
        mesh = _mesh_file(entry, meshes)
    elif kind in ("box", "ellipsoid"):
        size = entry.vector("size", None, limit=_FAR, unit="m")
        if min(size) <= 0:
            raise entry.wrong("size", f"size of {entry.what} is {list(size)}", "three positive lengths, m")
        mesh = box_mesh(np.array(size)) if kind == "box" else ellipsoid_mesh(0.5 * np.array(size))
    else:
        radius = entry.number("radius", None, low=1e-6, high=_FAR, unit="m")
        if kind == "sphere":
            mesh = ellipsoid_mesh(np.full(3, radius))
        else:
            mesh = cylinder_mesh(radius, entry.number("height", None, low=1e-6, high=_FAR, unit="m"))
    return TriangleMesh(np.asarray(mesh.vertices, np.float64) * scale, mesh.faces)


def _scale(entry: Entries) -> np.ndarray:
    value: Any = entry.data.get("scale")
    if isinstance(value, list):
        scale = entry.vector("scale", None, limit=1e6, unit="")
    else:
        scale = (entry.number("scale", 1.0, low=1e-6, high=1e6, unit=""),) * 3
    if min(scale) <= 0 or not math.isfinite(sum(scale)):
        raise entry.wrong("scale", f"scale {list(scale)}", "positive factors (a mirror would turn it inside out)")
    return np.array(scale)


def _mesh_file(entry: Entries, meshes: Path) -> TriangleMesh:
    """A mesh whose file lies in the folder `meshes`, by a relative name without `..` and links."""
    from fluidlift.io.asset_folder import asset_file

    name = entry.text("mesh")
    try:
        return read_any_mesh(asset_file(meshes, name))
    except InputRejected as error:
        outside = "names inside its own folder" in error.needed
        do = "copy it into the asset, or give its folder with --meshes" if outside else error.do
        raise entry.wrong("mesh", error.got, error.needed, do) from None
