"""Obstacles of scene.yaml: what a person puts into the fluid, as read and checked, before physics takes it over."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from fluidlift.errors import InputRejected
from fluidlift.io.entries import Entries
from fluidlift.io.read_mesh import read_any_mesh
from fluidlift.numerics.solid_mesh import box_mesh, closed_mesh, cylinder_mesh, ellipsoid_mesh, flipped
from fluidlift.physics.rigid_body import MOTIONS, RigidBody, Trajectory, product, rotation_by
from fluidlift.types import TriangleMesh

SHAPES = ("sphere", "ellipsoid", "box", "cylinder")

_MOST = 64
_MOST_KEYS = 10_000
FAR = 1e5
"""m, of any place and length"""
_LARGEST_ARC = 2.0
"""rad between two poses of a body that turns steadily"""
_MOST_POSES = 200_000
_COMMON = ("name", "shape", "mesh", "position", "rotation", "scale", "motion", "density", "friction", "restitution",
           "velocity", "angular_velocity", "keyframes", "color")  # fmt: skip
SIZES = {
    "sphere": ("radius",), "ellipsoid": ("size",), "box": ("size",), "cylinder": ("radius", "height"),
    "mesh": ("flip",),
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
    """m, scaled, around the body's own origin; with the colours it is drawn in, where it has any"""
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
        """What it is, as values that can be compared; not its colours, nor where it stands in the file."""
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
            do = "write flip: true, which turns it over" if "inside-out" in error.got else error.do
            raise InputRejected(f"{self.line}: {error.got}", error.needed, do) from None

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
    kind = shape_kind(entry, "an obstacle")
    entry.only((*_COMMON, *SIZES[kind]), size_hints(kind))
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
    position = entry.vector("position", (0.0, 0.0, 0.0), limit=FAR, unit="m")
    return Obstacle(
        name=entry.text("name") if entry.given("name") else f"{kind}{number + 1}",
        mesh=_painted(entry, solid_of(entry, kind, meshes, "obstacle")),
        position=position,
        rotation=rotation_of(entry.vector("rotation", (0.0, 0.0, 0.0), limit=1e6, unit="degrees")),
        motion=motion,
        density=entry.number("density", 500.0, low=1e-3, high=1e6, unit="kg/m^3"),
        friction=entry.number("friction", 0.5, low=0.0, high=10.0, unit=""),
        restitution=entry.number("restitution", 0.2, low=0.0, high=1.0, unit=""),
        velocity=entry.vector("velocity", (0.0, 0.0, 0.0), limit=1e3, unit="m/s"),
        angular_velocity=entry.vector("angular_velocity", (0.0, 0.0, 0.0), limit=1e4, unit="rad/s"),
        keyframes=keyframes,
        line=entry.place,
    )


def _painted(entry: Entries, mesh: TriangleMesh) -> TriangleMesh:
    """In the entry's `color` (sRGB); without one in the colours of its file, if it has any."""
    if not entry.given("color"):
        return mesh
    color = entry.vector("color", None, limit=1.0, low=0.0, unit="", example="[1, 0.8, 0.1]")
    return TriangleMesh(mesh.vertices, mesh.faces, np.tile(np.array(color, np.float32), (len(mesh.vertices), 1)))


def color_mark(obstacles: tuple[Obstacle, ...]) -> dict[str, str]:
    """What pictures depend on beside a look's own mark: a hash of the colours, or nothing where none has any."""
    painted = [(o.name, o.mesh.colors) for o in obstacles if o.mesh.colors is not None]
    if not painted:
        return {}
    digest = hashlib.sha256()
    for name, colors in painted:
        digest.update(name.encode() + b"\0" + np.ascontiguousarray(colors, np.float32).tobytes())
    return {"obstacle_colors_sha256": digest.hexdigest()}


def _keyframes(entry: Entries) -> tuple[Keyframe, ...]:
    keys = []
    for key in entry.parts("keyframes", "a keyframe", most=_MOST_KEYS):
        key.only(("time", "position", "rotation"))
        time = key.number("time", None, low=0.0, high=1e6, unit="s")
        if keys and time <= keys[-1].time:
            raise key.wrong("time", f"time {time:g} s after {keys[-1].time:g} s", "keyframes in order of time")
        position = key.vector("position", None, limit=FAR, unit="m")
        keys.append(
            Keyframe(time, position, rotation_of(key.vector("rotation", (0.0, 0.0, 0.0), limit=1e6, unit="degrees")))
        )
    if len(keys) == 1:
        raise entry.wrong("keyframes", "a single keyframe", "two or more, or none")
    return tuple(keys)


def shape_kind(entry: Entries, what: str) -> str:
    """Which of `SHAPES` an entry describes, or "mesh"."""
    if entry.given("mesh") == entry.given("shape"):
        raise entry.wrong(
            None, f"{what} with " + ("both shape and mesh" if entry.given("mesh") else "neither shape nor mesh"),
            "one of them: shape: " + "/".join(SHAPES) + ", or mesh: name of an .obj, .ply or .glb file",
        )  # fmt: skip
    return "mesh" if entry.given("mesh") else entry.word("shape", None, SHAPES)


def size_hints(kind: str) -> dict[str, str]:
    """What to do about the sizes of another shape."""
    own = " and ".join(SIZES[kind]) if kind != "mesh" else "scale, its size is that of the file"
    do = f"{'an' if kind[0] in 'aeiou' else 'a'} {kind} has {own}"
    return {name: do for names in SIZES.values() for name in names if name not in SIZES[kind]}


def solid_of(entry: Entries, kind: str, meshes: Path, what: str) -> TriangleMesh:
    """The mesh of a shape; one from a file must bound a solid, as the simulation wants it."""
    mesh = shape_mesh(entry, kind, meshes)
    if kind == "mesh":
        faults = _faults(_Solid(mesh))
        if faults is not None:
            got, needed, do = faults
            do = "write flip: true, which turns it over" if "inside-out" in got else do
            raise entry.wrong("mesh", f"the {what}'s {got}", needed, do)
    return mesh


class _Solid:
    """A mesh that is known by its vertices and faces."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self.mesh = mesh
        parts = (np.ascontiguousarray(x).tobytes() for x in (mesh.vertices, mesh.faces))
        self.key = hashlib.sha256(b"".join(parts)).digest()

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Solid) and self.key == other.key


@lru_cache(maxsize=64)
def _faults(solid: _Solid) -> tuple[str, str, str] | None:
    """Got, needed and do of a mesh that bounds no solid; judged once while its file stays as it is."""
    try:
        closed_mesh(solid.mesh)
    except InputRejected as error:
        return error.got, error.needed, error.do
    return None


def shape_mesh(entry: Entries, kind: str, meshes: Path) -> TriangleMesh:
    """The mesh of a shape around its own origin, m, scaled."""
    scale = scale_of(entry)
    if kind == "mesh":
        mesh = mesh_file(entry, meshes)
    elif kind in ("box", "ellipsoid"):
        size = entry.vector("size", None, limit=FAR, unit="m", low=0.0, example="[0.2, 0.2, 0.1]")
        if min(size) <= 0:
            raise entry.wrong("size", f"size of {entry.what} is {list(size)}", "three positive lengths, m")
        mesh = box_mesh(np.array(size)) if kind == "box" else ellipsoid_mesh(0.5 * np.array(size))
    else:
        radius = entry.number("radius", None, low=1e-6, high=FAR, unit="m")
        if kind == "sphere":
            mesh = ellipsoid_mesh(np.full(3, radius))
        else:
            mesh = cylinder_mesh(radius, entry.number("height", None, low=1e-6, high=FAR, unit="m"))
    return TriangleMesh(np.asarray(mesh.vertices, np.float64) * scale, mesh.faces, mesh.colors)


def scale_of(entry: Entries, *, low: float = 1e-6, high: float = 1e6) -> np.ndarray:
    """The entry `scale`: one positive factor or three, each within low..high."""
    value: Any = entry.data.get("scale")
    if not isinstance(value, list):
        return np.full(3, entry.number("scale", 1.0, low=low, high=high, unit=""))
    scale = entry.vector("scale", None, limit=high, unit="", example="[1, 1, 1.5]")
    if min(scale) < low:
        needed = f"factors from {low:g} to {high:g} (a mirror would turn it inside out)"
        raise entry.wrong("scale", f"scale {list(scale)}", needed)
    return np.array(scale)


@lru_cache(maxsize=8)
def _read_once(path: Path, changed: int, size: int) -> TriangleMesh:
    """A mesh file while it stays as it is: a scene is read again after every edit, its meshes need not be."""
    return read_any_mesh(path)


def mesh_file(entry: Entries, meshes: Path) -> TriangleMesh:
    """The mesh of the entry `mesh`, whose file lies in the folder `meshes`, by a relative name without `..` and links.

    It is turned inside out where the entry says `flip: true`.
    """
    from fluidlift.io.asset_paths import asset_file

    name = entry.text("mesh")
    try:
        path = asset_file(meshes, name)
        facts = path.stat() if path.is_file() else None
        mesh = read_any_mesh(path) if facts is None else _read_once(path, facts.st_mtime_ns, facts.st_size)
    except InputRejected as error:
        outside = "names inside its own folder" in error.needed
        do = "copy it into the asset, or give its folder with --meshes" if outside else error.do
        raise entry.wrong("mesh", error.got, error.needed, do) from None
    return flipped(mesh) if entry.flag("flip", False) else mesh
