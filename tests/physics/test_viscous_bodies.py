"""Viscous liquid drags rigid bodies along: momentum, energy, and against a plain twin."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.physics import boundaries
from fluidlift.physics import stress_kernels as kernels
from fluidlift.physics.active_region import open_region
from fluidlift.physics.boundaries import cell_capacity
from fluidlift.physics.face_clearance import face_clearance
from fluidlift.physics.rigid import RigidBodies, RigidBody
from fluidlift.physics.viscosity import FaceRoles, build_system, diffuse, diffuse_with_bodies
from fluidlift.physics.viscous_bodies import DraggedBody
from fluidlift.types import FaceVelocity, Grid, Terrain, TriangleMesh

H, FLUID = 0.05, 1400.0
ARGUMENTS = {"dt": 0.01, "spacing": H, "wall_share": 1.0, "tolerance": 1e-9}


class Scene:
    """Rigid bodies in a ball of liquid of radius `drop` in the air, or filling the box."""

    def __init__(self, *bodies, drop=np.inf, shape=(16, 16, 16), cut=True):
        grid = Grid(shape, H)
        far = np.full(tuple(n + 1 for n in shape), 100.0, np.float32)
        terrain = Terrain(grid, far, np.eye(3)[0], TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
        walls = boundaries.build_walls(terrain, np.zeros(shape, np.uint8), np.zeros((3, 2), bool))
        box = tuple(slice(0, n) for n in shape)
        region = open_region(box, walls, cell_capacity(walls.signed_distance, grid))
        self.grid, self.bodies = grid, RigidBodies(bodies, walls, density=FLUID, gravity=(0.0, 0.0, 0.0))
        self.walls = self.bodies.enter(region).walls
        self.bodies.predict(0.01)
        middle = np.array(shape) * 0.5 * H
        self.distance = np.sqrt(np.square(grid.centers() - middle).sum(-1)).astype(np.float32) - drop
        self.distance = np.maximum(self.distance, np.float32(-100.0))
        self.cut = cut
        self.start = self.closed_in(FaceVelocity.zeros(grid))

    def closed_in(self, velocity):
        """With the solid's velocity on closed faces."""
        solid = self.bodies.face_velocity()
        both = zip(velocity.components, solid.components, self.walls.openings)
        return FaceVelocity(*(np.where(o == 0, s, c).astype(np.float32) for c, s, o in both))

    @property
    def roles(self):
        wet = boundaries.touching_faces((self.distance < 0) & ~self.walls.solid)
        closed = [o == 0 for o in self.walls.openings]
        across = [c & (np.abs(n[..., a]) > 0.7) for a, (c, n) in enumerate(zip(closed, self.walls.normals))]
        return FaceRoles(
            tuple(w & ~c for w, c in zip(wet, closed)), tuple(across), tuple(c & ~a for c, a in zip(closed, across)),
            self.distance, self.walls.signed_distance if self.cut else None, self.bodies.face_velocity(),
            self.bodies.dragged(),
        )  # fmt: skip

    def diffused(self, number, velocity=None, **changed):
        """After a step with nu dt / h^2 = `number`: velocity, changes of the bodies, report."""
        arguments = ARGUMENTS | {"viscosity": number * H**2 / ARGUMENTS["dt"]} | changed
        new, change, (report,) = diffuse_with_bodies(velocity or self.start, self.roles, **arguments)
        assert report.converged
        return new, change, report

    def diffused_beside(self, dragged, change, number):
        """Velocity after a step in which the only body is made to change its motion."""
        solid = [c.astype(np.float64) for c in self.bodies.face_velocity().components]
        for (a, i, j, k), row, shift in zip(dragged.faces, dragged.values, dragged.shift):
            solid[a][i, j, k] += row @ change + shift
        solid = [c.astype(np.float32) for c in solid]
        start = zip(self.walls.openings, solid, self.start.components)
        roles = replace(self.roles, bodies=(), solid_velocity=FaceVelocity(*solid))
        velocity = FaceVelocity(*(np.where(o == 0, c, s) for o, c, s in start))
        return diffuse(velocity, roles, viscosity=number * H**2 / ARGUMENTS["dt"], **ARGUMENTS)[0]

    def mass(self):
        """Liquid shares of the solved faces, on the whole grid."""
        system, region, _ = build_system(self.roles, viscosity=1.0, dt=0.01, spacing=H, wall_share=1.0)
        out = []
        for a in range(3):
            full = np.zeros(self.grid.face_shape(a))
            grid, box = region.overlap(full.shape)
            full[grid] = system.mass[a][box]
            out.append(full)
        return out

    def momentum(self, change):
        """Of liquid per axis over density h^3."""
        return np.array([(m * c).sum() for m, c in zip(self.mass(), change.components)])


def ball(density=2800.0, radius=0.16, position=(0.41, 0.385, 0.4), **given):
    return RigidBody.sphere("ball", radius, density=density, position=position, **given)


def difference(a, b):
    return FaceVelocity(*(x.astype(np.float64) - y for x, y in zip(a.components, b.components)))


@pytest.mark.parametrize("cut", [False, True], ids=["walls half way", "walls where they are"])
@pytest.mark.parametrize("density", [140.0, 2800.0])
def test_liquid_and_body_exchange_momentum_without_loss(density, cut):
    scene = Scene(ball(density, velocity=(0.3, -0.2, 1.0), angular_velocity=(2.0, 1.0, -1.0)), drop=0.33, cut=cut)
    new, change, _ = scene.diffused(5.0)
    gained = scene.momentum(difference(new, scene.start))
    lost = -scene.bodies.dragged()[0].mass[:3, :3] @ change[0, :3]
    # the drop hangs free in the air: nothing else takes momentum. 1e-6: the velocities returned are float32
    assert np.abs(lost).min() > 0.05 * np.abs(lost).max()
    np.testing.assert_allclose(gained, lost, atol=2e-6 * np.abs(lost).max())


def test_liquid_and_body_exchange_angular_momentum_without_loss():
    body = RigidBody.box("box", (6.3 * H, 4.2 * H, 4 * H), density=500.0, position=(8.1 * H, 8 * H, 8 * H),
                         velocity=(0.0, 0.5, 0.0), angular_velocity=(3.0, -1.0, 2.0))  # fmt: skip
    scene = Scene(body, drop=0.33)
    new, change, _ = scene.diffused(5.0)
    gained, arms, mass = np.zeros(3), scene.bodies.center[0], scene.mass()
    for a, component in enumerate(difference(new, scene.start).components):
        moved = np.zeros((*component.shape, 3))
        moved[..., a] = mass[a] * component
        gained += np.cross(scene.grid.faces(a).reshape(-1, 3) - arms, moved.reshape(-1, 3)).sum(axis=0)
    lost = -scene.bodies.dragged()[0].mass[3:, 3:] @ change[0, 3:]
    assert np.abs(lost).max() > 1e-3
    np.testing.assert_allclose(gained, lost, atol=2e-5 * np.abs(lost).max())


def test_a_drop_with_its_body_turns_on_rigidly():
    scene = Scene(ball(500.0, velocity=(0.0, 0.0, 0.0), angular_velocity=(0.0, 0.0, 2.0), position=(0.4, 0.4, 0.4)),
                  drop=0.33)  # fmt: skip
    spun = [np.cross((0.0, 0.0, 2.0), scene.grid.faces(a) - 0.4)[..., a].astype(np.float32) for a in range(3)]
    start = scene.closed_in(FaceVelocity(*spun))
    _, change, _ = scene.diffused(20.0, start)
    # no strain, no stress; 1e-5: velocities of single precision, times nu dt / h^2
    assert np.abs(change[0, :3]).max() < 1e-5 * 2.0 * 0.16
    assert np.abs(change[0, 3:]).max() < 1e-5 * 2.0


@pytest.mark.parametrize("density", [1.4, 140.0, 14000.0])
def test_a_body_ten_and_more_times_lighter_than_honey_is_only_slowed_down_however_large_the_step(density):
    scene = Scene(ball(density, velocity=(0.0, 0.0, 1.0)), drop=0.33)
    mass = scene.bodies.dragged()[0].mass
    new, change, report = scene.diffused(100.0, tolerance=1e-6)
    speed = 1.0 + change[0, 2]
    total = mass[2, 2] + sum(m.sum() for m in scene.mass()[2:])
    # liquid and body end nearly as one lump, without overshoot: what differs within a drop of 6.6 cells is left over
    # by 1 / (1 + 100 (2 / 6.6)^2), a tenth
    assert speed == pytest.approx(mass[2, 2] / total, rel=0.12)
    energy = sum((m * np.square(c.astype(np.float64))).sum() for m, c in zip(scene.mass(), new.components))
    after = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) + change[0]
    assert energy + after @ mass @ after < mass[2, 2]
    # one solve, not one per body and direction
    assert report.iterations < 100


def test_bodies_of_very_different_mass_and_touching_boxes_keep_the_momentum():
    scene = Scene(
        RigidBody.box("a", (0.2, 0.2, 0.2), density=50.0, position=(0.3, 0.4, 0.4), velocity=(1.0, 0.0, 0.0)),
        RigidBody.box("b", (0.2, 0.17, 0.2), density=5000.0, position=(0.502, 0.41, 0.4), velocity=(0.0, 0.0, -1.0)),
        drop=0.33,
    )
    new, change, _ = scene.diffused(3.0)
    gained = scene.momentum(difference(new, scene.start))
    lost = -sum(b.mass[:3, :3] @ c[:3] for b, c in zip(scene.bodies.dragged(), change))
    np.testing.assert_allclose(gained, lost, atol=3e-6 * np.abs(lost).max())


def test_a_very_heavy_body_is_like_one_with_a_given_motion():
    scene = Scene(ball(1e9, velocity=(0.5, 0.0, 1.0), angular_velocity=(0.0, 2.0, 0.0)))
    new, change, _ = scene.diffused(2.0)
    given = scene.diffused_beside(scene.bodies.dragged()[0], np.zeros(6), 2.0)
    assert np.abs(change).max() < 1e-4
    for a, b in zip(new.components, given.components):
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_the_motion_is_the_minimum_of_the_energy():
    scene = Scene(ball(300.0, velocity=(0.3, 0.0, 1.0), angular_velocity=(0.0, 3.0, 0.0)), drop=0.33)
    (dragged,) = scene.bodies.dragged()
    found = scene.diffused(3.0)[1][0]

    def reaction(change):
        """What the liquid gains from a body that is made to change its motion thus."""
        new = scene.diffused_beside(dragged, change, 3.0)
        return scene.momentum(difference(new, scene.start))

    # with the motion found, prescribed, the liquid gains what the body loses (exact to float32) and with any other not
    balance = reaction(found) + dragged.mass[:3, :3] @ found[:3]
    assert np.abs(balance).max() < 1e-5 * np.abs(dragged.mass[2, 2] * found[2])
    other = 0.9 * found
    assert np.abs(reaction(other) + dragged.mass[:3, :3] @ other[:3]).max() > 1e-2 * np.abs(found[2])


def test_the_faces_of_a_body_move_as_its_solid_velocity_says():
    scene = Scene(ball(velocity=(0.3, -0.2, 1.0), angular_velocity=(2.0, 1.0, -1.0)))
    bodies, solid = scene.bodies, scene.bodies.face_velocity()
    (dragged,) = bodies.dragged()
    motion = np.concatenate([bodies.velocity[0], bodies.spin[0]])
    given = np.array([solid.components[a][i, j, k] for a, i, j, k in dragged.faces])
    np.testing.assert_allclose(dragged.values @ motion - dragged.shift, given, atol=1e-6)
    clearance, seen = (
        face_clearance(scene.walls.signed_distance),
        [np.zeros(o.shape, bool) for o in scene.walls.openings],
    )
    for a, i, j, k in dragged.faces:
        seen[a][i, j, k] = True
    inside = tuple(slice(2, -2) for _ in range(3))
    for a in range(3):
        closed = (scene.walls.openings[a] == 0) | (clearance[a] <= 0)
        np.testing.assert_array_equal(seen[a][inside], closed[inside])


def test_a_body_takes_over_its_changes_and_others_are_not_asked():
    still = RigidBody.box("still", (0.1, 0.1, 0.1), position=(0.6, 0.6, 0.6), motion="static")
    free = RigidBody.box("free", (0.2, 0.1, 0.1), density=700.0, position=(0.3, 0.3, 0.3))
    scene = Scene(still, free)
    bodies = scene.bodies
    dragged = bodies.dragged()
    assert [d.body for d in dragged] == [1]
    bodies.apply_viscosity(dragged, np.array([[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]))
    np.testing.assert_allclose(bodies.velocity[1], (1, 2, 3))
    np.testing.assert_allclose(bodies.spin[1], (4, 5, 6))
    assert not bodies.velocity[0].any() and not bodies.spin[0].any()


def test_what_stresses_take_from_single_faces_is_what_the_operator_takes():
    scene = Scene(ball(), drop=0.33)
    system, _, _ = build_system(scene.roles, viscosity=0.3, dt=0.01, spacing=H, wall_share=1.0)
    x, out = np.random.default_rng(0).normal(size=system.mass.shape), np.zeros(system.mass.shape)
    kernels.apply(x, out, *system.operator)
    at = tuple(np.ascontiguousarray(a) for a in np.nonzero(system.mass > 0))
    pulls = np.zeros(len(at[0]))
    kernels.pull_faces(x, system.normal, system.shear, *at, pulls)
    # sums in another order; weights are of order one
    np.testing.assert_allclose(system.mass[at] * x[at] + pulls, out[at], atol=1e-12)


def test_diffuse_refuses_bodies_whose_motion_would_be_lost():
    scene = Scene(ball())
    with pytest.raises(ValueError, match="diffuse_with_bodies"):
        diffuse(scene.start, scene.roles, viscosity=1.0, **ARGUMENTS)


def test_nearly_no_viscosity_leaves_bodies_alone():
    scene = Scene(ball())
    new, change, reports = diffuse_with_bodies(scene.start, scene.roles, viscosity=1e-9, **ARGUMENTS)
    assert new is scene.start and change.shape == (1, 6) and not change.any() and reports == ()


def test_a_dragged_body_needs_rows_that_fit():
    with pytest.raises(ValueError, match="values"):
        DraggedBody(0, np.eye(6), np.zeros((3, 4), np.int64), np.zeros((2, 6)), np.zeros(3))
