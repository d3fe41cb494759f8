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
from fluidlift.physics.rigid_body import MOTIONS, RigidBody, Trajectory, product, rotation_by
from fluidlift.types import TriangleMesh

SHAPES = ("sphere", "ellipsoid", "box", "cylinder")

_MOST = 64
_MOST_KEYS = 10_000
_FAR = 1e5
_LARGEST_ARC = 2.0
"""rad between two poses of a body that turns steadily"""
_MOST_POSES = 200_000
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
    rotation: Float[np.ndarray, "4"]
    """quaternion w, x, y, z, world from body"""


@dataclass(frozen=True)
class Obstacle:
    """One solid in the fluid."""

    name: str
    mesh: TriangleMesh
    """m, scaled, around the body's own origin"""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m, of the body's origin in the world"""
    rotation: Float[np.ndarray, "4"] = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    """quaternion w, x, y, z, world from body"""
    motion: str = "static"
    """static; animated: moves as told; free: moves as fluid and gravity push it"""
    density: float = 500.0
    """kg/m^3, of a free one"""
    friction: float = 0.5
    """Coulomb's coefficient against terrain and other bodies"""
    restitution: float = 0.2
    """0 to 1"""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m/s, at the first instant"""
    angular_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """rad/s, at the first instant"""
    keyframes: tuple[Keyframe, ...] = ()
    """of an animated one, in order of time"""
    line: str = ""
    """where it stands in the file, for later complaints"""

    def plain(self) -> list[Any]:
        """What it is, as values that can be compared; not where it stands in the file."""
        keys = [x for k in self.keyframes for x in (k.time, k.position, k.rotation)]
        numbers = [self.density, self.friction, self.restitution, self.velocity, self.angular_velocity]
        shape = [np.asarray(self.mesh.vertices), np.asarray(self.mesh.faces)]
        return [self.name, self.motion, self.position, self.rotation, *numbers, *shape, *keys]

    def body(self, duration: float) -> RigidBody:
        """The body as physics takes it.

        Args:
            duration: s, for which a motion of constant velocity is written out.

        Raises:
            InputRejected: a mesh that does not bound a solid.
        """
        free = self.motion == "free"
        try:
            return RigidBody(
                self.name, self.mesh, density=self.density, motion=self.motion, position=np.array(self.position),
                orientation=self.rotation, velocity=np.array(self.velocity if free else (0.0, 0.0, 0.0)),
                angular_velocity=np.array(self.angular_velocity if free else (0.0, 0.0, 0.0)),
                trajectory=self._trajectory(duration) if self.motion == "animated" else None,
                restitution=self.restitution, friction=self.friction,
            )  # fmt: skip
        except InputRejected as error:
            raise InputRejected(f"{self.line}: {error.got}", error.needed, error.do) from None

    def _trajectory(self, duration: float) -> Trajectory:
        if self.keyframes:
            times, positions, rotations = zip(*((k.time, k.position, k.rotation) for k in self.keyframes))
            return Trajectory(np.array(times), np.array(positions), np.array(rotations))
        # poses less than half a turn apart, so that the arc between two is the shorter one; their times do not depend
        # on the duration, so that a longer simulation goes on as the shorter one did
        spin = np.array(self.angular_velocity)
        apart = _LARGEST_ARC / max(float(np.sqrt(np.square(spin).sum())), _LARGEST_ARC)
        count = math.ceil(duration / apart) + 2
        if count > _MOST_POSES:
            raise InputRejected(
                f"{self.line}: a body that turns by {duration / apart * _LARGEST_ARC:.3g} rad", "less, or keyframes"
            )
        times = apart * np.arange(count)
        positions = np.array(self.position) + times[:, None] * np.array(self.velocity)
        return Trajectory(times, positions, np.array([product(rotation_by(t * spin), self.rotation) for t in times]))


def rotation_of(degrees: tuple[float, float, float]) -> Float[np.ndarray, "4"]:
    """Quaternion w, x, y, z of turns about the world's x, then y, then z axis."""
    about_x, about_y, about_z = (rotation_by(np.radians(d) * np.eye(3)[axis]) for axis, d in enumerate(degrees))
    return product(about_z, product(about_y, about_x))


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
        restitution=entry.number("restitution", 0.2, low=0.0, high=1.0, unit=""),
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
