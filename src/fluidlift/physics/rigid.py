"""Rigid bodies in the liquid: their state, and what a substep of the simulator asks of them.

A substep calls, in this order (see `RigidBodies`): `enter`, `predict`, `dragged` and `apply_viscosity` around the
viscous solve, `face_velocity` and `coupling` before the pressure solve, `apply_pressure` and `slide` after it,
`advance`, and `push_out` for the particles that have moved.
`state` and `restore` undo a substep that fails.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import InputRejected, required
from fluidlift.messages import Notice
from fluidlift.numerics.mesh_distance import thin_warning
from fluidlift.numerics.poisson import LowRankTerm
from fluidlift.numerics.solid_mesh import hull_points, moments, surface_points
from fluidlift.physics import rigid_coupling
from fluidlift.physics.active_region import ActiveRegion
from fluidlift.physics.boundaries import Walls, slide_along_walls
from fluidlift.physics.contact import BodyMotion, ContactSolver
from fluidlift.physics.contact_search import Contacts, find_contacts, spread_points
from fluidlift.physics.rigid_body import RigidBody, Trajectory, material_pairs, slowed, within_reach
from fluidlift.physics.rigid_coupling import BodyRows, SolidVelocity
from fluidlift.physics.rigid_push import push_out
from fluidlift.physics.rigid_shapes import distances, pack, posed
from fluidlift.physics.rigid_walls import UnionWalls
from fluidlift.physics.rotation import product, rotation_by, turned
from fluidlift.physics.viscous_bodies import DraggedBody
from fluidlift.types import FaceVelocity, matrix_from_quat

__all__ = ["RigidBodies", "RigidBody", "Trajectory"]

SAFE_REACH = 0.2
"""cells: more than the gap at rest, and room for what the pressure adds to the speed in a step"""


class RigidBodies:
    """The bodies of a simulation. Positions are those of the centres of mass; all state is in double precision.

    Args:
        bodies: with different names.
        walls: terrain and box, without bodies.
        density: of the liquid, kg/m^3.
        gravity: m/s^2.

    Raises:
        InputRejected: a body outside the box that does not fall into it, or two of one name.
    """

    def __init__(
        self,
        bodies: Sequence[RigidBody],
        walls: Walls,
        *,
        density: float,
        gravity: Float[np.ndarray, "3"] | Sequence[float],
    ) -> None:
        self.bodies, self._static = tuple(bodies), walls
        self._density, self._gravity = float(density), np.asarray(gravity, np.float64)
        self.time, self.removed = 0.0, 0
        """s, and particles that found no place beside the bodies"""
        h, n = walls.grid.spacing, len(self.bodies)
        self._cell_mass = self._density * h**3  # of liquid, kg
        self.free = np.array([b.motion == "free" for b in self.bodies], bool)
        integrals = [moments(b.mesh) for b in self.bodies]
        self._offset = np.array([m.center for m in integrals]).reshape(n, 3)
        """centres of mass in the body frames, m"""
        self._volume = np.array([m.volume for m in integrals])
        self.mass = self._volume * [b.density for b in self.bodies]
        """kg"""
        inertia = np.array([m.inertia * b.density for m, b in zip(integrals, self.bodies)]).reshape(n, 3, 3)
        self._inertia = inertia
        self._inverse_inertia = np.linalg.inv(inertia) if n else inertia
        self._corners = [hull_points(b.mesh) for b in self.bodies]
        self._radius = np.array([np.sqrt(np.square(c - o).sum(1).max()) for c, o in zip(self._corners, self._offset)])
        self.distances = tuple(b.distance(h) for b in self.bodies)
        self._pairs = material_pairs(self.bodies)
        self._set_start()
        self._shapes = pack(self.distances)
        apart = np.array([min(h, float(np.ptp(c, axis=0).max()) / 6.0) for c in self._corners])
        points = [surface_points(b.mesh, s) for b, s in zip(self.bodies, apart)]
        self._surface = spread_points(self._shapes, points, apart)
        self._union: UnionWalls | None = None
        self._pose()
        self.warnings = self._check()
        """what a user should know: bodies thinner than a cell, or starting inside the terrain"""

    def __len__(self) -> int:
        return len(self.bodies)

    def _set_start(self) -> None:
        n = len(self.bodies)
        starts = [b.start(self.time) for b in self.bodies]
        self.orientation = np.array([q for _, q in starts]).reshape(n, 4)
        rotation = matrix_from_quat(self.orientation)
        self.center = np.array([x for x, _ in starts]).reshape(n, 3) + np.einsum("nij,nj->ni", rotation, self._offset)
        self.velocity = np.array([b.velocity * (b.motion == "free") for b in self.bodies]).reshape(n, 3)
        spin = np.array([b.angular_velocity * (b.motion == "free") for b in self.bodies]).reshape(n, 3)
        self.angular_momentum = np.einsum("nij,njk,nlk,nl->ni", rotation, self._inertia, rotation, spin)
        """kg m^2/s about the centres of mass, world axes"""
        self._prescribed_spin = np.zeros((n, 3))
        self.active = np.ones(n, bool)
        """False once a free body has left the box for good"""
        self._known_keys, self._known_impulses, self._known_step = np.zeros(0, np.int64), np.zeros((0, 3)), 1.0
        self._solver: ContactSolver | None = None
        self._rows: tuple[BodyRows, ...] = ()
        self._step = 0.0

    def _check(self) -> tuple[Notice, ...]:
        grid, out = self._static.grid, []
        names = [b.name for b in self.bodies]
        for name in names:
            if names.count(name) > 1:
                raise InputRejected(f"{names.count(name)} bodies named '{name}'", "different names")
        near = within_reach(self._shapes, self._static, self._gravity, self.free)
        for n, body in enumerate(self.bodies):
            low, high = self._shapes.box_low[n], self._shapes.box_high[n]
            if body.motion != "animated" and not near[n]:
                raise InputRejected(
                    f"body '{body.name}' from {_place(low)} to {_place(high)} m, outside the simulation's box",
                    f"a place within {_place(grid.low)} to {_place(grid.high)} m", "move the body or enlarge the box",
                )  # fmt: skip
            out.append(thin_warning(f"body '{body.name}'", self.distances[n], grid.spacing))
        contacts = find_contacts(self._shapes, self._surface, self.free, self._static, np.zeros(len(names)))
        for n, body in enumerate(self.bodies):
            mine = (contacts.first == n) & (contacts.gaps < -grid.spacing)
            if mine.any():
                out.append(
                    Notice(
                        "body-starts-inside",
                        f"body '{body.name}' starts {-contacts.gaps[mine].min():.3g} m inside the terrain, the "
                        f"box's side "
                        "or another body: it first creeps out the nearest way, and lies where that ends. Put it "
                        "on open "
                        "fluid instead: fluidlift edit names such a place",
                    )
                )
        return tuple(w for w in out if w)

    # --- present pose -----------------------------------------------------------------------------------------------

    @property
    def rotation(self) -> Float[np.ndarray, "b 3 3"]:
        """World from body."""
        return matrix_from_quat(self.orientation)

    @property
    def position(self) -> Float[np.ndarray, "b 3"]:
        """m, of the body frames' origins."""
        return self.center - np.einsum("nij,nj->ni", self.rotation, self._offset)

    @property
    def spin(self) -> Float[np.ndarray, "b 3"]:
        """Angular velocity, rad/s, world axes."""
        free = np.einsum("nij,nj->ni", self._inverse_world_inertia(), self.angular_momentum)
        return np.where(self.free[:, None], free, self._prescribed_spin)

    @property
    def energy(self) -> Float[np.ndarray, " b"]:
        """J, of motion; free bodies."""
        turning = 0.5 * (self.spin * self.angular_momentum).sum(axis=1)
        return np.where(self.free, 0.5 * self.mass * np.square(self.velocity).sum(axis=1) + turning, 0.0)

    def _inverse_world_inertia(self) -> np.ndarray:
        r = self.rotation
        return np.einsum("nij,njk,nlk->nil", r, self._inverse_inertia, r)

    def _pose(self) -> None:
        self._shapes = posed(self._shapes, self.rotation, self.position, self._corners)

    def max_speed(self, horizon: float) -> float:
        """m/s that no point of a body exceeds now (free ones: without what forces add) and within `horizon` s."""
        spin = np.sqrt(np.square(self.spin).sum(axis=1))
        speed = np.sqrt(np.square(self.velocity).sum(axis=1)) + spin * self._radius
        speed = np.where(self.free & self.active, speed, 0.0)
        for n, body in enumerate(self.bodies):
            if body.trajectory is not None:
                speed[n] = body.trajectory.max_speed(self.time, horizon, self._offset[n], self._radius[n])
        return float(speed.max(initial=0.0))

    # --- a substep, in the order of the calls -----------------------------------------------------------------------

    @property
    def _entered(self) -> UnionWalls:
        return required(self._union, "a step of bodies without enter")

    def enter(self, region: ActiveRegion) -> ActiveRegion:
        """The region onto terrain and bodies in their present poses, from one without bodies.

        The arrays change at the next call. All fields on cells or faces in the calls that follow are of this region.
        """
        if self._union is None or self._union.static is not region:
            self._union = UnionWalls(region)
            self._solid = SolidVelocity(self._union)
        self._union.update(self._shapes, self._volume, self.center)
        return self._union.region

    def predict(self, dt: float, pressure_rate: Float[np.ndarray, "nx ny nz"] | None = None) -> None:
        """Velocities that the bodies would have after `dt` s without the liquid's new pressure.

        Free ones: gravity, the contact impulses of the step before where the contacts still hold, and what `coupling`
        leaves out of the pressure (see `rigid_coupling.surface_force`). Animated ones: their mean over the step.

        Args:
            dt: s.
            pressure_rate: q / dt (m^2/s^2) of the step before, 0 in cells without liquid.
        """
        self._step, moving = dt, self.free & self.active
        self.velocity = np.where(moving[:, None], self.velocity + dt * self._gravity, 0.0)
        for n, body in enumerate(self.bodies):
            if body.trajectory is not None:
                self.velocity[n], self._prescribed_spin[n] = body.trajectory.velocity(self.time, dt, self._offset[n])
        if pressure_rate is not None and self._union is not None:
            for cover in self._union.covers:
                if moving[cover.body]:
                    n = cover.body
                    force = rigid_coupling.surface_force(cover, pressure_rate, self._union.walls, self.center[n])
                    self.velocity[n] += dt * self._density / self.mass[n] * force[:3]
                    self.angular_momentum[n] += dt * self._density * force[3:]
        self._meet(dt, moving)

    def _meet(self, dt: float, moving: np.ndarray) -> None:
        """Contacts of this step, and the impulses that the step before lets expect."""
        spin, h = self.spin, self._static.grid.spacing
        speed = np.sqrt(np.square(self.velocity).sum(1)) + self._radius * np.sqrt(np.square(spin).sum(1))
        reach = np.where(self.active, SAFE_REACH * h + dt * speed, -np.inf)
        contacts = find_contacts(self._shapes, self._surface, moving, self._static, reach)
        motion = BodyMotion(
            self.center, self.velocity.copy(), spin, np.where(moving, 1.0 / self.mass, 0.0),
            np.where(moving[:, None, None], self._inverse_world_inertia(), 0.0),
        )  # fmt: skip
        self._solver = ContactSolver(contacts, motion)
        if len(self._known_keys) and len(contacts):
            self._solver.expect(self._known_keys, self._known_impulses * (dt / self._known_step))
            self._adopt(contacts, motion)

    def _adopt(self, contacts: Contacts, motion: BodyMotion) -> None:
        """Take over the velocities of bodies in contact."""
        before = self.spin
        touched = np.zeros(len(self.bodies), bool)
        touched[contacts.first] = True
        touched[contacts.second[contacts.second >= 0]] = True
        touched &= self.free & self.active
        r = self.rotation
        gained = np.einsum("nij,njk,nlk,nl->ni", r, self._inertia, r, motion.spin - before)
        # bodies without contact keep theirs to the last digit
        self.velocity = np.where(touched[:, None], motion.velocity, self.velocity)
        self.angular_momentum = np.where(touched[:, None], self.angular_momentum + gained, self.angular_momentum)

    def face_velocity(self) -> FaceVelocity:
        """Velocity of the solid on all faces, m/s: mean over the closed share. The arrays change at the next call."""
        return self._solid.update(self.center, self.velocity, self.spin)

    def dragged(self) -> tuple[DraggedBody, ...]:
        """The free bodies for `viscosity.diffuse_with_bodies`; on their faces it wants `face_velocity`."""
        out = []
        inertia, spin = np.einsum("nij,njk,nlk->nil", self.rotation, self._inertia, self.rotation), self.spin
        union = self._entered
        for c in union.covers:
            if self.free[c.body] and self.active[c.body]:
                mass = rigid_coupling.mass_matrix(self.mass[c.body], inertia[c.body]) / self._cell_mass
                rows = rigid_coupling.moving_faces(c, union.walls, self.center[c.body], spin[c.body])
                out.append(DraggedBody(c.body, mass, *rows))
        return tuple(out)

    def apply_viscosity(self, dragged: Sequence[DraggedBody], change: Float[np.ndarray, "d 6"]) -> None:
        """Take over how viscosity changed the velocities and angular velocities of the `dragged` bodies."""
        for body, six in zip(dragged, change):
            self.velocity[body.body] += six[:3]
            self.angular_momentum[body.body] += self._cell_mass * (body.mass[3:, 3:] * six[3:]).sum(axis=1)

    def coupling(self, unknown: Bool[np.ndarray, "nx ny nz"]) -> tuple[LowRankTerm, ...]:
        """How the pressure of the unknown cells moves the free bodies, for `pressure.project`.

        Divergence (1/s) of the liquid = values . (velocity, angular velocity) of the body; the body gains
        inverse_mass . values^T q. Units: inverse_mass = density h^3 times the inverse of mass and inertia.
        """
        union = self._entered
        self._rows = tuple(rigid_coupling.body_rows(c, unknown, union.walls, self.center[c.body]) for c in union.covers)
        inertia, terms = self._inverse_world_inertia(), []
        for rows in self._rows:
            if self.free[rows.body] and self.active[rows.body] and len(rows.cells):
                inverse = rigid_coupling.mass_matrix(1.0 / self.mass[rows.body], inertia[rows.body])
                terms.append(LowRankTerm(rows.cells, rows.values, self._cell_mass * inverse))
        return tuple(terms)

    def pressure_forces(self, q: Float[np.ndarray, "nx ny nz"]) -> Float[np.ndarray, "b 6"]:
        """Force (N) and torque (N m) of the liquid on every body, from the q (m^2/s) of a solve with `coupling`."""
        out = np.zeros((len(self.bodies), 6))
        union, volume = self._entered, self._static.grid.spacing**3
        for cover, rows in zip(union.covers, self._rows):
            pressed = (rows.values * q[tuple(rows.cells.T)].astype(np.float64)[:, None]).sum(axis=0) * volume
            rest = rigid_coupling.surface_force(cover, q, union.walls, self.center[rows.body])
            out[rows.body] = self._density / self._step * (pressed + rest)
        return out

    def apply_pressure(self, q: Float[np.ndarray, "nx ny nz"]) -> None:
        """Free bodies after the solve for q (m^2/s), whose `low_rank` was the last `coupling`."""
        for rows in self._rows:
            n = rows.body
            if self.free[n] and self.active[n]:
                pressed = (rows.values * q[tuple(rows.cells.T)].astype(np.float64)[:, None]).sum(axis=0)
                impulse = self._cell_mass * pressed
                self.velocity[n] += impulse[:3] / self.mass[n]
                self.angular_momentum[n] += impulse[3:]

    def fill_films(self, types: np.ndarray) -> np.ndarray:
        """See `rigid_coupling.fill_films`."""
        return rigid_coupling.fill_films(types, self._entered, self._gravity)

    def slide(self, velocity: FaceVelocity) -> FaceVelocity:
        """Velocity on closed faces without its part into the solid: terrain at rest, bodies in their motion."""
        slid = slide_along_walls(velocity, self._entered.walls)
        speeds = (self.velocity, self.spin)
        return rigid_coupling.slide_along_bodies(velocity, slid, self._entered, self.center, speeds)

    def advance(self) -> None:
        """Contacts, then the poses at the end of the step that `predict` began."""
        solver = required(self._solver, "advance without predict")
        dt, h = self._step, self._static.grid.spacing
        contacts, motion = solver.contacts, solver.motion
        push, turn = np.zeros_like(self.velocity), np.zeros_like(self.velocity)
        if len(contacts):
            motion.velocity[:], motion.spin[:] = self.velocity, self.spin
            friction, restitution = (p[contacts.first, contacts.second] for p in self._pairs)
            gain = dt * float(np.sqrt(np.square(self._gravity).sum()))
            impact = solver.solve(friction, restitution, dt=dt, spacing=h, gain=gain)
            self._adopt(contacts, motion)
            push, turn = slowed(*solver.recovery(dt=dt, spacing=h), self._radius, np.sqrt(2.0 * gain / dt * h))
            resting = ~impact & (solver.impulses[:, 0] > 0)
            self._known_keys, self._known_impulses = contacts.keys[resting], solver.world_impulses()[resting]
        else:
            self._known_keys, self._known_impulses = np.zeros(0, np.int64), np.zeros((0, 3))
        self._known_step, self._solver = dt, None
        self._move(dt, push, turn)

    def _move(self, dt: float, push: np.ndarray, turn: np.ndarray) -> None:
        self.time += dt
        for n, body in enumerate(self.bodies):
            if body.trajectory is not None:
                x, self.orientation[n] = body.trajectory.pose(self.time)
                self.center[n] = x + (matrix_from_quat(self.orientation[n]) * self._offset[n]).sum(axis=1)
            elif self.free[n] and self.active[n]:
                self.center[n] += dt * (self.velocity[n] + push[n])
                quat = turned(self.orientation[n], self.angular_momentum[n], self._inverse_inertia[n], dt)
                quat = product(rotation_by(dt * turn[n]), quat) if turn[n].any() else quat
                self.orientation[n] = quat / np.sqrt(np.square(quat).sum())
        self._pose()
        self.active &= ~self.free | within_reach(self._shapes, self._static, self._gravity, self.free)

    # --- particles --------------------------------------------------------------------------------------------------

    def inside(self, positions: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Which points lie in a body."""
        return distances(self._shapes, positions, self._static.grid.spacing)[0] <= 0.0

    def push_out(
        self, positions: Float[np.ndarray, "n 3"], velocities: Float[np.ndarray, "n 3"], *, tangential_share: float = 1
    ) -> Bool[np.ndarray, " n"]:
        """Move particles out of the bodies' present poses, in place; True: no place was found (see `rigid_push`)."""
        motion = (self.center, self.velocity, self.spin)
        lost = push_out(positions, velocities, self._shapes, motion, self._static, tangential_share=tangential_share)
        self.removed += int(lost.sum())
        return lost

    # --- checkpoints ------------------------------------------------------------------------------------------------

    def state(self) -> dict[str, np.ndarray]:
        """All that changes, between two substeps; `restore` continues from it bit for bit."""
        return {
            "time": np.array(self.time), "center": self.center.copy(), "orientation": self.orientation.copy(),
            "velocity": self.velocity.copy(), "angular_momentum": self.angular_momentum.copy(),
            "prescribed_spin": self._prescribed_spin.copy(), "active": self.active.copy(),
            "contact_keys": self._known_keys.copy(), "contact_impulses": self._known_impulses.copy(),
            "contact_step": np.array(self._known_step), "removed": np.array(self.removed),
        }  # fmt: skip

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go back to a `state` of the same bodies.

        Raises:
            InputRejected: a state of other bodies, or one that is not finite.
        """
        n = len(self.bodies)
        shapes = {
            "center": (n, 3), "orientation": (n, 4), "velocity": (n, 3), "angular_momentum": (n, 3),
            "prescribed_spin": (n, 3), "active": (n,), "time": (), "contact_step": (), "removed": (),
        }  # fmt: skip
        keys = np.asarray(state.get("contact_keys", 0))
        shapes |= {"contact_keys": (keys.size,), "contact_impulses": (keys.size, 3)}
        for name, shape in shapes.items():
            if name not in state or np.shape(state[name]) != shape or not np.isfinite(state[name]).all():
                raise InputRejected(f"the state of rigid bodies: '{name}' is missing or does not fit", f"{n} bodies")
        self.time, self.removed = float(state["time"]), int(state["removed"])
        for name in ("center", "orientation", "velocity", "angular_momentum"):
            setattr(self, name, np.array(state[name], np.float64))
        self._prescribed_spin = np.array(state["prescribed_spin"], np.float64)
        self.active = np.array(state["active"], bool)
        self._known_keys, self._known_impulses = keys.astype(np.int64), np.array(state["contact_impulses"], np.float64)
        self._known_step = float(state["contact_step"])
        self._solver, self._rows = None, ()
        self._pose()


def _place(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.3g}" for x in point) + ")"
