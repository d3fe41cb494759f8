"""Rigid bodies as they are given: shape, material, motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.numerics.mesh_distance import MeshDistance, mesh_distance
from fluidlift.numerics.solid_mesh import box_mesh, closed_mesh, cylinder_mesh, ellipsoid_mesh
from fluidlift.physics.boundaries import Walls
from fluidlift.physics.rigid_shapes import Shapes
from fluidlift.physics.rotation import product, rotation_by, rotation_vector
from fluidlift.types import TriangleMesh, matrix_from_quat

MOTIONS = ("static", "animated", "free")


def _checked(values: Any, shape: tuple[int | None, ...], what: str) -> np.ndarray:
    array = np.asarray(values, np.float64)
    fits = array.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, array.shape))
    require(fits, f"{what} of shape {array.shape}", str(shape))
    require(bool(np.isfinite(array).all()), f"{what} that is not finite")
    return array


def _unit(quats: np.ndarray, what: str) -> np.ndarray:
    length = np.sqrt(np.square(quats).sum(axis=-1, keepdims=True))
    require(bool((length > 1e-6).all()), f"{what} of length 0", "quaternions w, x, y, z")
    return quats / length


@dataclass(frozen=True)
class Trajectory:
    """Poses over time: straight lines and great arcs between them; the first and last one hold before and after."""

    times: Float[np.ndarray, " k"]
    """s, ascending"""
    positions: Float[np.ndarray, "k 3"]
    """m, of the body frame's origin"""
    orientations: Float[np.ndarray, "k 4"]
    """unit quaternions w, x, y, z, world from body"""

    def __post_init__(self) -> None:
        times = _checked(self.times, (None,), "times")
        require(len(times) > 0 and bool((np.diff(times) > 0).all()), "times of poses", "ascending, at least one")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "positions", _checked(self.positions, (len(times), 3), "positions"))
        turned = _unit(_checked(self.orientations, (len(times), 4), "orientations"), "an orientation")
        # of the two quaternions of an orientation the one on the side of the one before: the shorter arc
        for n in range(1, len(turned)):
            if (turned[n] * turned[n - 1]).sum() < 0:
                turned[n] = -turned[n]
        object.__setattr__(self, "orientations", turned)

    def pose(self, time: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
        """Position (m) and orientation at a time (s)."""
        t = float(np.clip(time, self.times[0], self.times[-1]))
        n = int(np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, max(len(self.times) - 2, 0)))
        if len(self.times) == 1:
            return self.positions[0].copy(), self.orientations[0].copy()
        s = (t - self.times[n]) / (self.times[n + 1] - self.times[n])
        start = self.orientations[n]
        turn = rotation_vector(product(self.orientations[n + 1], start * [1, -1, -1, -1]))
        return (1 - s) * self.positions[n] + s * self.positions[n + 1], product(rotation_by(s * turn), start)

    def velocity(
        self, start: float, dt: float, point: Float[np.ndarray, "3"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Mean velocity (m/s) of a point of the body frame and angular velocity (rad/s) over `dt` s from `start`."""
        (x0, q0), (x1, q1) = self.pose(start), self.pose(start + dt)
        r0, r1 = matrix_from_quat(q0), matrix_from_quat(q1)
        moved = x1 + (r1 * point).sum(axis=1) - x0 - (r0 * point).sum(axis=1)
        return moved / dt, rotation_vector(product(q1, q0 * [1, -1, -1, -1])) / dt

    def max_speed(self, start: float, horizon: float, point: Float[np.ndarray, "3"], radius: float) -> float:
        """m/s that nothing within `radius` (m) of a point of the body frame exceeds within `horizon` s from `start`."""
        at = self.times[(self.times > start) & (self.times < start + horizon)]
        at = np.unique([start, *at, start + horizon])
        motions = [self.velocity(a, b - a, point) for a, b in zip(at[:-1], at[1:])]
        return max(float(np.sqrt(np.square(v).sum()) + radius * np.sqrt(np.square(w).sum())) for v, w in motions)


@dataclass(frozen=True)
class RigidBody:
    """A solid that rests, moves as prescribed, or is free. The mesh is checked and its seams are welded.

    Raises:
        InputRejected: a mesh that does not bound a solid (see `numerics.solid_mesh.closed_mesh`).
        ValueError: numbers out of range.
    """

    name: str
    mesh: TriangleMesh
    """m, in the body's own frame"""
    density: float = 500.0
    """kg/m^3; only that of free bodies counts"""
    motion: str = "free"
    """'static', 'animated' (along `trajectory`) or 'free' (moved by gravity, liquid and contact)"""
    position: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """m, of the body frame's origin at the start; not used by animated bodies"""
    orientation: Float[np.ndarray, "4"] = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    """quaternion w, x, y, z, world from body, at the start"""
    velocity: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """m/s, of the centre of mass at the start; free bodies"""
    angular_velocity: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """rad/s, world axes, at the start; free bodies"""
    trajectory: Trajectory | None = None
    restitution: float = 0.2
    """0 to 1: share of the normal velocity that an impact gives back (of two bodies the larger one counts)"""
    friction: float = 0.5
    """Coulomb's coefficient (of two bodies the geometric mean)"""

    def __post_init__(self) -> None:
        require(bool(self.name), "a body without a name")
        where = f"body '{self.name}'"
        require(self.motion in MOTIONS, f"{where}: motion '{self.motion}'", " or ".join(MOTIONS))
        require(
            (self.trajectory is not None) == (self.motion == "animated"),
            f"{where}: motion '{self.motion}' {'without' if self.trajectory is None else 'with'} a trajectory",
            "a trajectory for animated bodies, none for others",
        )  # fmt: skip
        require(np.isfinite(self.density) and self.density > 0, f"{where}: density {self.density}", "positive kg/m^3")
        require(0 <= self.restitution <= 1, f"{where}: restitution {self.restitution}", "0 to 1")
        require(np.isfinite(self.friction) and self.friction >= 0, f"{where}: friction {self.friction}", "0 or more")
        for name, size in (("position", 3), ("velocity", 3), ("angular_velocity", 3), ("orientation", 4)):
            object.__setattr__(self, name, _checked(getattr(self, name), (size,), f"{where}: {name}"))
        object.__setattr__(self, "orientation", _unit(self.orientation, f"{where}: an orientation"))
        object.__setattr__(self, "mesh", closed_mesh(self.mesh, name=where))

    @classmethod
    def sphere(cls, name: str, radius: float, **options: Any) -> RigidBody:
        """A ball around the body frame's origin; `options` are fields of the class."""
        return cls(name, ellipsoid_mesh(np.full(3, radius)), **options)

    @classmethod
    def ellipsoid(cls, name: str, semi_axes: Float[np.ndarray, "3"] | Sequence[float], **options: Any) -> RigidBody:
        """An ellipsoid around the body frame's origin."""
        return cls(name, ellipsoid_mesh(semi_axes), **options)

    @classmethod
    def box(cls, name: str, size: Float[np.ndarray, "3"] | Sequence[float], **options: Any) -> RigidBody:
        """A box of edge lengths `size` (m) around the body frame's origin."""
        return cls(name, box_mesh(size), **options)

    @classmethod
    def cylinder(cls, name: str, radius: float, height: float, **options: Any) -> RigidBody:
        """A cylinder along the z axis of the body frame, around its origin."""
        return cls(name, cylinder_mesh(radius, height), **options)

    def start(self, time: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
        """Position (m) and orientation at the start."""
        return (self.position, self.orientation) if self.trajectory is None else self.trajectory.pose(time)

    def distance(self, spacing: float) -> MeshDistance:
        """Signed distance in the body frame for a simulation of that spacing (m).

        Its grid is finer than the simulation's, so that edges stay sharp, save around large bodies.
        """
        cells = float(np.ptp(self.mesh.vertices, axis=0).max()) / spacing
        share = 0.25 if cells <= 16 else (0.5 if cells <= 100 else 1.0)
        return mesh_distance(self.mesh, share * spacing, margin=1.5 * spacing)


def within_reach(
    shapes: Shapes, walls: Walls, gravity: Float[np.ndarray, "3"], falls: Bool[np.ndarray, " b"]
) -> Bool[np.ndarray, " b"]:
    """Which bodies touch the walls' box, or, of those that fall, hang where gravity brings them in by an open side."""
    grid, low, high = walls.grid, shapes.box_low, shapes.box_high
    beside = (high > grid.low) & (low < grid.high)
    out = np.all(beside, axis=1)
    for axis, side in np.argwhere(walls.open_sides):
        if gravity[axis] * (-1 if side else 1) > 0:
            above = low[:, axis] >= grid.high[axis] if side else high[:, axis] <= grid.low[axis]
            out |= falls & above & np.delete(beside, axis, axis=1).all(axis=1)
    return out


def material_pairs(bodies: Sequence[RigidBody]) -> tuple[np.ndarray, np.ndarray]:
    """Friction and restitution of body a with body b, [b,b+1]; the last column is with terrain and box."""
    friction, bounce = (np.array([getattr(b, name) for b in bodies]) for name in ("friction", "restitution"))
    return (
        np.column_stack([np.sqrt(np.outer(friction, friction)), friction]),
        np.column_stack([np.maximum.outer(bounce, bounce), bounce]),
    )


def slowed(
    push: Float[np.ndarray, "b 3"], turn: Float[np.ndarray, "b 3"], radius: Float[np.ndarray, " b"], fastest: float
) -> tuple[np.ndarray, np.ndarray]:
    """How bodies leave an overlap (m/s, rad/s), slowed down where a point of one would move faster than `fastest`.

    The way out is a share of the overlap per step, which in short steps is a leap.

    Args:
        push, turn: of `contact.ContactSolver.recovery`.
        radius: m, of each body about its centre of mass.
        fastest: m/s, such as that of a fall through one cell; 0, without gravity: as it is.
    """
    speed = np.sqrt(np.square(push).sum(axis=1)) + radius * np.sqrt(np.square(turn).sum(axis=1))
    share = np.minimum(fastest / np.maximum(speed, 1e-12), 1.0)[:, None] if fastest > 0 else 1.0
    return push * share, turn * share
