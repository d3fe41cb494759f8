"""Rigid bodies in the liquid: state, solid on the grid, exchange of momentum."""

from dataclasses import replace

import numpy as np
import pytest
from boxes import walls_of

from fluidlift.errors import InputRejected
from fluidlift.numerics.poisson import PoissonSystem
from fluidlift.numerics.solid_mesh import flipped
from fluidlift.physics import boundaries, free_surface, transfer
from fluidlift.physics.active_region import open_region
from fluidlift.physics.boundaries import cell_capacity, face_fractions
from fluidlift.physics.forces import add_gravity
from fluidlift.physics.pressure import build_system, divergence, project
from fluidlift.physics.rigid import RigidBodies, RigidBody, Trajectory
from fluidlift.physics.rigid_body import slowed
from fluidlift.types import CellType, FaceVelocity, Particles, TriangleMesh, matrix_from_quat

G = 9.81
H = 0.05
DENSITY = 1000.0
TURN = np.array([0.8, 0.3, -0.4, 0.2])


def whole(walls):
    """The region onto the whole box."""
    box = tuple(slice(0, n) for n in walls.grid.shape)
    return open_region(box, walls, cell_capacity(walls.signed_distance, walls.grid))


def rigid(bodies, shape=(20, 20, 20), distance=None, gravity=(0.0, 0.0, -G), open_top=True):
    walls = walls_of(shape, distance, open_top)
    return RigidBodies(bodies, walls, density=DENSITY, gravity=gravity), whole(walls)


def solved(bodies, region, wet, velocity=None, *, dt=0.005, rounds=1, gravity=(0.0, 0.0, -G)):
    """One substep on the grid with liquid in the cells `wet`; with more rounds from the pressure of the last one.

    Returns the velocity, q, and the system.
    """
    grid, rate, start = region.grid, None, bodies.state()
    for _ in range(rounds):
        bodies.restore(start)
        walls = bodies.enter(region).walls
        types = bodies.fill_films(boundaries.liquid_cells(wet, walls))
        system = build_system(types, walls.openings, grid, open_border=True)
        bodies.predict(dt, rate)
        new, q, report = project(
            add_gravity(velocity or FaceVelocity.zeros(grid), gravity, dt), system, tolerance=1e-8,
            solid_velocity=bodies.face_velocity(), low_rank=bodies.coupling(system.unknown),
        )  # fmt: skip
        assert report.converged
        bodies.apply_pressure(q)
        rate = q / dt
    return new, q, system


def pool(shape, level):
    wet = np.zeros(shape, bool)
    wet[:, :, :level] = True
    return wet


# --- state ------------------------------------------------------------------------------------------------------------


def test_mass_and_inertia_are_those_of_the_shape_in_its_pose():
    body = RigidBody.box("b", (0.2, 0.3, 0.4), density=700.0, position=(0.5, 0.5, 0.5), orientation=TURN,
                         angular_velocity=(1.0, 2.0, 3.0))  # fmt: skip
    bodies, _ = rigid([body])
    mass = 700.0 * 0.024
    assert bodies.mass[0] == pytest.approx(mass)
    r = matrix_from_quat(TURN)
    inertia = r @ np.diag([0.3**2 + 0.4**2, 0.2**2 + 0.4**2, 0.2**2 + 0.3**2]) @ r.T * mass / 12
    np.testing.assert_allclose(bodies.angular_momentum[0], inertia @ [1.0, 2.0, 3.0], rtol=1e-9)
    np.testing.assert_allclose(bodies.spin[0], [1.0, 2.0, 3.0], rtol=1e-9)


def test_a_tumbling_body_keeps_its_angular_momentum_and_energy():
    # about the middle axis of inertia, where a rotation is unstable and turns over
    body = RigidBody.box("b", (0.3, 0.2, 0.1), position=(0.5, 0.5, 0.5), angular_velocity=(0.02, 6.0, 0.01))
    bodies, _ = rigid([body], gravity=(0, 0, 0))
    momentum, energy = bodies.angular_momentum.copy(), bodies.energy[0]
    tilted = 1.0
    for _ in range(400):
        bodies.predict(0.01)
        bodies.advance()
        tilted = min(tilted, bodies.rotation[0, 1, 1])
        # fourth order at a twelfth of a rad per step
        assert bodies.energy[0] == pytest.approx(energy, rel=1e-6)
    np.testing.assert_array_equal(bodies.angular_momentum, momentum)
    assert tilted < -0.9  # it has turned over


def test_a_body_whose_frame_lies_off_its_middle_falls_about_its_centre_of_mass():
    mesh = RigidBody.box("b", (0.2, 0.2, 0.2)).mesh
    body = RigidBody("b", TriangleMesh(mesh.vertices + [0.3, 0, 0], mesh.faces), position=(0.2, 0.5, 0.8),
                     angular_velocity=(0, 0, 3.0))  # fmt: skip
    bodies, _ = rigid([body])
    np.testing.assert_allclose(bodies.center[0], [0.5, 0.5, 0.8])
    for _ in range(20):
        bodies.predict(0.005)
        bodies.advance()
    np.testing.assert_allclose(bodies.center[0, :2], [0.5, 0.5], atol=1e-12)
    # semi-implicit steps fall by half a step's way more
    assert 0.8 - bodies.center[0, 2] == pytest.approx(0.5 * G * 0.1 * (0.1 + 0.005))
    np.testing.assert_allclose(
        bodies.position[0], bodies.center[0] + 0.3 * np.array([-np.cos(0.3), -np.sin(0.3), 0]), atol=1e-6
    )


def test_an_animated_body_follows_its_poses_and_knows_its_velocity():
    half = np.sqrt(0.5)
    path = Trajectory(np.array([1.0, 2.0]), np.array([[0.4, 0.5, 0.5], [0.6, 0.5, 0.5]]),
                      np.array([[1.0, 0, 0, 0], [-half, 0, 0, -half]]))  # fmt: skip
    position, orientation = path.pose(1.5)
    np.testing.assert_allclose(position, [0.5, 0.5, 0.5])
    # the shorter arc, although the quaternion is given on the other side
    np.testing.assert_allclose(orientation, [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)], atol=1e-12)
    body = RigidBody.box("b", (0.1, 0.1, 0.1), motion="animated", trajectory=path)
    bodies, _ = rigid([body])
    for start, moves in ((0.5, False), (1.25, True), (2.5, False)):
        bodies.time = start
        bodies.predict(0.01)
        np.testing.assert_allclose(bodies.velocity[0], [0.2 * moves, 0, 0], atol=1e-12)
        np.testing.assert_allclose(bodies.spin[0], [0, 0, 0.5 * np.pi * moves], atol=1e-9)
    bodies.time = 0.95
    assert bodies.max_speed(0.1) == pytest.approx(0.2 + 0.5 * np.pi * 0.05 * np.sqrt(3))
    assert bodies.max_speed(0.01) < 1e-12


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"density": -1.0}, "density"),
        ({"motion": "flying"}, "static or animated or free"),
        ({"motion": "animated"}, "without a trajectory"),
        ({"restitution": 1.5}, "restitution"),
        ({"orientation": (0, 0, 0, 0)}, "length 0"),
        ({"velocity": (np.nan, 0, 0)}, "not finite"),
    ],
)
def test_bodies_with_wrong_numbers_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        RigidBody.box("b", (1, 1, 1), **options)


def test_bodies_that_cannot_be_used_are_refused_by_name():
    with pytest.raises(InputRejected, match=r"body 'duck'.*inside-out"):
        RigidBody("duck", flipped(RigidBody.sphere("s", 0.1).mesh))
    with pytest.raises(InputRejected, match=r"body 'duck' from \(4.9.*outside the simulation's box"):
        rigid([RigidBody.sphere("duck", 0.1, position=(5, 0.5, 0.5))])
    with pytest.raises(InputRejected, match="2 bodies named 'duck'"):
        rigid([RigidBody.sphere("duck", 0.1, position=(x, 0.5, 0.5)) for x in (0.3, 0.7)])


def test_thin_bodies_and_bodies_in_the_terrain_are_reported():
    bodies, _ = rigid(
        [
            RigidBody.box("sheet", (0.3, 0.3, 0.02), position=(0.5, 0.5, 0.8)),
            RigidBody.box("rock", (0.2, 0.2, 0.2), position=(0.5, 0.5, 0.2)),
        ],
        distance=lambda x: x[..., 2] - 0.2,
    )
    sheet, rock = bodies.warnings
    assert "sheet" in sheet and "less than a cell" in sheet and "rock" in rock and "0.1 m inside" in rock


def test_a_state_continues_bit_for_bit():
    bodies, region = rigid(
        [
            RigidBody.box(
                "crate", (0.2, 0.2, 0.2), density=2500.0, position=(0.5, 0.5, 0.104), orientation=(1, 0.02, 0, 0)
            ),
            RigidBody.sphere("ball", 0.1, density=2500.0, position=(0.45, 0.5, 0.34), velocity=(0.1, 0, -1.0)),
        ]
    )

    def step():
        solved(bodies, region, pool((20, 20, 20), 8))
        bodies.advance()
        return bodies.state()

    for _ in range(12):
        step()
    kept = bodies.state()
    assert len(kept["contact_keys"])
    first = [step() for _ in range(4)]
    bodies.restore(kept)
    again = [step() for _ in range(4)]
    for one, two in zip(first, again):
        for name, value in one.items():
            np.testing.assert_array_equal(value, two[name])
    fresh, region = rigid(bodies.bodies)
    fresh.restore(kept)
    solved(fresh, region, pool((20, 20, 20), 8))
    fresh.advance()
    np.testing.assert_array_equal(fresh.center, first[0]["center"])
    with pytest.raises(InputRejected, match="'center'"):
        fresh.restore({**kept, "center": np.zeros((1, 3))})


# --- the solid on the grid --------------------------------------------------------------------------------------------


def bed(x):
    return x[..., 2] - 0.13 - 0.1 * x[..., 0]


def test_the_open_shares_beside_a_body_are_those_of_its_distance():
    body = RigidBody.sphere("s", 0.32, position=(0.52, 0.49, 0.62))
    bodies, region = rigid([body], distance=bed)
    walls = bodies.enter(region).walls
    plain = face_fractions(walls.signed_distance)
    for axis in range(3):
        inner = [slice(None)] * 3
        inner[axis] = slice(1, -1)  # the sides of the box are closed beside
        found, wanted = walls.openings[axis][tuple(inner)], plain[axis][tuple(inner)]
        # the plain ones know the distance at the corners of the face only. A plane that touches a sphere of 6.4 H cuts
        # discs out of it whose edge is missed where it bulges between corners: a tenth of a face at some places
        assert np.abs(found - wanted).max() < 0.15
        assert np.abs(found - wanted).mean() < 1e-3
        closed = (found == 0) & (wanted == 0)
        np.testing.assert_array_equal(walls.normals[axis][tuple(inner)][~closed & (found > 0)], 0.0)
        length = np.sqrt((walls.normals[axis][tuple(inner)][closed] ** 2).sum(-1))
        np.testing.assert_allclose(length, 1.0, atol=1e-5)


def test_what_the_simulator_knows_of_cells_follows_the_union():
    body = RigidBody.box("b", (0.4, 0.3, 0.3), position=(0.52, 0.49, 0.6), orientation=TURN)
    bodies, region = rigid([body], distance=bed)
    union = bodies.enter(region)
    walls = union.walls
    np.testing.assert_array_equal(union.wall_cells, boundaries.beside_closed_faces(walls))
    mean = boundaries.mean_of_corners(walls.signed_distance.astype(np.float64))
    near = np.abs(mean) < 2.0 * H  # elsewhere `cell_capacity` says 1, in the solid too
    np.testing.assert_allclose(union.capacity[near], cell_capacity(walls.signed_distance, walls.grid)[near], atol=1e-6)
    assert (union.capacity[mean > 2.0 * H] == 1).all()
    clear = np.abs(mean - 0.25 * H) > 1e-6  # but for rounding
    np.testing.assert_array_equal(walls.buried[clear], (~walls.solid & (mean < 0.25 * H))[clear])
    assert walls.solid[10, 10, 12] and (walls.regions[walls.solid] == CellType.SOLID).all()
    inside = bodies.inside(walls.grid.centers().reshape(-1, 3)).reshape(walls.grid.shape)
    assert inside[10, 10, 12] and inside.sum() * H**3 == pytest.approx(0.036, rel=0.1)


def test_where_a_body_has_left_the_terrain_is_as_before():
    bodies, region = rigid([RigidBody.sphere("s", 0.2, position=(0.5, 0.5, 0.4))], distance=bed)
    before = replace(region.walls, signed_distance=region.walls.signed_distance.copy())
    bodies.enter(region)
    assert (bodies.enter(region).walls.signed_distance != before.signed_distance).any()
    bodies.center[:] = (0.5, 0.5, 5.0)
    bodies.predict(1e-9)
    bodies.advance()
    union = bodies.enter(region)
    for name in ("signed_distance", "solid", "buried", "regions"):
        np.testing.assert_array_equal(getattr(union.walls, name), getattr(before, name))
    for axis in range(3):
        np.testing.assert_array_equal(union.walls.openings[axis], before.openings[axis])
        np.testing.assert_array_equal(union.walls.normals[axis], before.normals[axis])
        assert (bodies.face_velocity().components[axis] == 0).all()
    np.testing.assert_array_equal(union.capacity, region.capacity)
    np.testing.assert_array_equal(union.wall_cells, region.wall_cells)


def test_a_gap_of_a_twentieth_of_a_cell_stays_open_and_holds_liquid():
    # terrain up to 0.3 of cell layer 2, and a flat bottom 0.05 cells above it
    body = RigidBody.box("b", (0.4, 0.4, 0.2), position=(0.5, 0.5, 0.115 + 0.05 * H + 0.1))
    bodies, region = rigid([body], distance=lambda x: x[..., 2] - 0.115)
    walls = bodies.enter(region).walls
    assert walls.openings[0][10, 10, 2] == pytest.approx(0.05, abs=0.003)
    types = boundaries.liquid_cells(pool((20, 20, 20), 4) & ~bodies.inside(
        region.grid.centers().reshape(-1, 3)).reshape(20, 20, 20), walls)  # fmt: skip
    types[7:13, 7:13, 2] = CellType.EMPTY
    filled = bodies.fill_films(types)
    assert (filled[7:13, 7:13, 2] == CellType.FLUID).all()
    assert (filled[:, :, 4:] != CellType.FLUID).all()  # not upwards


# --- velocity of the solid --------------------------------------------------------------------------------------------


def test_a_spinning_ball_and_a_moving_box_drive_no_flux_through_their_inside():
    bodies, region = rigid(
        [
            RigidBody.sphere("ball", 0.2, position=(0.31, 0.52, 0.5), angular_velocity=(3.0, 4.0, 5.0)),
            RigidBody.box("box", (0.25, 0.2, 0.2), position=(0.73, 0.52, 0.5), orientation=TURN, velocity=(1, 2, 3)),
        ],
        gravity=(0, 0, 0),
    )
    walls = bodies.enter(region).walls
    solid = bodies.face_velocity()
    flux = FaceVelocity(*((1 - w) * s for w, s in zip(walls.openings, solid.components)))
    spread = divergence(flux, region.grid) * H
    inside = boundaries.mean_of_corners(walls.signed_distance) < -H
    assert inside[:10].any() and inside[10:].any()
    # cells deep inside: a rigid motion has no divergence
    assert np.abs(spread[inside]).max() < 1e-5
    ball = np.zeros(inside.shape, bool)
    ball[:10] = True
    # the ball's surface moves along itself; what is left of 1.4 m/s comes from the surface's kinks between cells
    assert np.abs(spread[ball]).max() < 0.03
    # the box takes as much volume in front as it leaves behind
    assert np.abs(spread[10:]).max() > 0.5 and abs(spread[10:].sum()) < 1e-4 * np.abs(spread[10:]).sum()


def test_rows_times_velocity_are_the_divergence_of_the_solid():
    motion = {"velocity": (1.0, 2.0, 3.0), "angular_velocity": (5.0, 4.0, -3.0)}
    body = RigidBody.box("b", (0.4, 0.3, 0.3), position=(0.52, 0.49, 0.22), orientation=TURN, **motion)
    bodies, region = rigid([body], gravity=(0, 0, 0), distance=bed)
    walls = bodies.enter(region).walls
    unknown = ~walls.solid
    unknown[:, :, 12:] = False
    (term,) = bodies.coupling(unknown)
    solid = bodies.face_velocity()
    flux = FaceVelocity(*((1 - w.astype(float)) * s for w, s in zip(walls.openings, solid.components)))
    wanted = np.where(unknown, divergence(flux, region.grid), 0.0)
    found = np.zeros(unknown.shape)
    found[tuple(term.cells.T)] = term.values @ np.concatenate([bodies.velocity[0], bodies.spin[0]])
    # single precision of the face velocity
    np.testing.assert_allclose(found, wanted, atol=1e-5 * np.abs(wanted).max())


def test_velocity_slides_along_a_moving_wall():
    normal = matrix_from_quat(TURN)[:, 2]
    motion = {"velocity": (1.0, -2.0, 0.5), "angular_velocity": (0.0, 0.0, 0.0)}
    body = RigidBody.box("b", (2, 2, 0.3), position=(0.5, 0.5, 0.5), orientation=TURN, **motion)
    bodies, region = rigid([body], gravity=(0, 0, 0))
    walls = bodies.enter(region).walls
    bodies.face_velocity()
    wind = np.array([0.3, 0.7, -1.1])
    velocity = FaceVelocity(*(np.full(region.grid.face_shape(a), wind[a], np.float32) for a in range(3)))
    new = bodies.slide(velocity)
    wanted = wind - (wind - np.array([1.0, -2.0, 0.5])) @ normal * normal
    for axis in range(3):
        above = (region.grid.faces(axis) - 0.5) @ normal
        closed = (
            (walls.openings[axis] == 0) & (np.abs(above) > 0.02) & (np.abs(region.grid.faces(axis) - 0.5).max(-1) < 0.4)
        )
        assert closed.any()
        np.testing.assert_allclose(new.components[axis][closed], wanted[axis], atol=1e-3)


# --- exchange with the liquid -----------------------------------------------------------------------------------------


def dense(system: PoissonSystem, terms):
    """The operator as a matrix, column by column, and the cells of its rows."""
    cells = np.argwhere(system.unknown)
    columns = []
    for cell in cells:
        unit = np.zeros(system.unknown.shape)
        unit[tuple(cell)] = 1.0
        out = system.apply(unit)
        for t in terms:
            at = tuple(t.cells.T)
            out[at] += t.values @ (t.inverse_mass @ (t.values.T @ unit[at]))
        columns.append(out[tuple(cells.T)])
    return np.array(columns).T, cells


def test_the_coupled_solve_agrees_with_the_dense_one():
    body = RigidBody.box("b", (0.2, 0.15, 0.15), density=300.0, position=(0.21, 0.2, 0.16), orientation=TURN)
    bodies, region = rigid([body], (8, 8, 8))
    velocity = add_gravity(FaceVelocity.zeros(region.grid), (0, 0, -G), 0.005)
    _, q, system = solved(bodies, region, pool((8, 8, 8), 6))
    fresh, region = rigid([body], (8, 8, 8))
    fresh.enter(region)
    fresh.predict(0.005)
    matrix, cells = dense(system, fresh.coupling(system.unknown))
    rhs = -divergence(velocity, region.grid, system, solid_velocity=fresh.face_velocity())
    wanted = np.linalg.solve(matrix, rhs[tuple(cells.T)])
    # q is kept in single precision
    np.testing.assert_allclose(q[tuple(cells.T)], wanted, atol=1e-6 * np.abs(wanted).max())
    fresh.apply_pressure(q)
    np.testing.assert_array_equal(fresh.velocity, bodies.velocity)


@pytest.mark.parametrize("density", [200.0, 3000.0])
def test_liquid_and_body_keep_their_momentum_together(density):
    # a body inside a free blob of liquid, in air on all sides, no gravity, and liquid that streams at it
    shape = (20, 20, 20)
    body = RigidBody.ellipsoid("b", (0.2, 0.12, 0.12), density=density, position=(0.52, 0.49, 0.5), orientation=TURN,
                               velocity=(0.5, 0.2, -0.3), angular_velocity=(1, 2, 3))  # fmt: skip
    bodies, region = rigid([body], shape, gravity=(0, 0, 0))
    wet = np.zeros(shape, bool)
    wet[3:17, 3:17, 3:17] = True
    rng = np.random.default_rng(0)
    start = FaceVelocity(*(rng.normal(size=region.grid.face_shape(a)).astype(np.float32) for a in range(3)))
    before = bodies.mass[0] * bodies.velocity[0]
    new, _, _ = solved(bodies, region, wet, start, gravity=(0, 0, 0))
    openings = bodies.enter(region).walls.openings
    gained = np.array(
        [
            DENSITY * H**3 * (w.astype(float) * (n.astype(float) - s)).sum()
            for w, n, s in zip(openings, np.array([np.where(w > 0, n, s) for w, n, s in zip(
                openings, new.components, start.components)], dtype=object), start.components)
        ]
    )  # fmt: skip
    lost = before - bodies.mass[0] * bodies.velocity[0]
    # exact but for single precision; the exchange itself is a thousandth of a N s or more
    assert np.abs(lost).max() > 1e-2
    np.testing.assert_allclose(gained, lost, atol=2e-4 * np.abs(lost).max())


@pytest.mark.parametrize("height", [0.5, 0.51, 0.53, 0.549])
@pytest.mark.parametrize("turned", [False, True])
def test_a_pool_at_rest_lifts_with_the_weight_of_the_displaced_liquid(height, turned):
    shape = (22, 20, 22)
    body = RigidBody.box("b", (0.4, 0.3, 0.3), motion="static", position=(0.53, 0.49, height),
                         orientation=TURN if turned else (1, 0, 0, 0))  # fmt: skip
    bodies, region = rigid([body], shape)
    _, q, _ = solved(bodies, region, pool(shape, 20))
    force = bodies.pressure_forces(q)[0]
    weight = DENSITY * G * 0.036
    # wherever the flat bottom lies in its cells: the rest is single precision
    assert force[2] == pytest.approx(weight, rel=1e-3)
    assert np.abs(force[:2]).max() < 1e-5 * weight
    # no torque about the middle: an arm of a thousandth of its size
    assert np.abs(force[3:]).max() < 1e-3 * weight * 0.3


def test_a_neutral_body_stays_where_it_is():
    shape = (20, 20, 22)
    bodies, region = rigid([RigidBody.sphere("b", 0.2, density=DENSITY, position=(0.51, 0.52, 0.5))], shape)
    solved(bodies, region, pool(shape, 20), rounds=3)
    # of free fall
    assert np.abs(bodies.velocity[0]).max() < 1e-4 * G * 0.005


@pytest.mark.parametrize("density", [100.0, 2000.0, 8000.0])
def test_a_ball_in_liquid_accelerates_with_its_added_mass(density):
    # (m + m' / 2) a = (m' - m) g with the mass m' of the displaced liquid
    shape = (32, 32, 34)
    bodies, region = rigid([RigidBody.sphere("b", 0.2, density=density, position=(0.81, 0.82, 0.8))], shape)
    solved(bodies, region, pool(shape, 32), rounds=3)
    wanted = (DENSITY - density) / (density + 0.5 * DENSITY) * G
    # sides at four radii raise the added mass by some percent, the open surface lowers it
    assert bodies.velocity[0, 2] / 0.005 == pytest.approx(wanted, rel=0.03)
    assert np.abs(bodies.velocity[0, :2]).max() < 1e-3 * abs(wanted) * 0.005


def test_a_light_body_on_the_floor_of_a_pool_is_lifted():
    shape = (16, 16, 16)
    bodies, region = rigid([RigidBody.box("b", (0.3, 0.3, 0.2), density=500.0, position=(0.4, 0.4, 0.1025))], shape)
    solved(bodies, region, pool(shape, 14), rounds=3)
    assert bodies.velocity[0, 2] > 0.0
    bodies, region = rigid([RigidBody.box("b", (0.3, 0.3, 0.2), motion="static", position=(0.4, 0.4, 0.1025))], shape)
    _, q, _ = solved(bodies, region, pool(shape, 14))
    # the film below carries the pressure of the depth
    assert bodies.pressure_forces(q)[0, 2] == pytest.approx(DENSITY * G * 0.018, rel=0.01)


@pytest.mark.parametrize("floor", [0.5, 0.52])
def test_what_of_a_body_lies_in_the_ground_displaces_no_liquid_and_is_not_lifted(floor):
    # water on top of it and none below: it is pressed down by the column above, whatever of it is in the ground
    shape = (20, 20, 22)
    body = RigidBody.box("b", (0.4, 0.3, 0.3), motion="static", position=(0.5, 0.5, 0.5))
    bodies, region = rigid([body], shape, distance=lambda x: x[..., 2] - floor)
    wet = pool(shape, 20)
    wet[:, :, : int(floor / H)] = False
    _, q, _ = solved(bodies, region, wet)
    force = bodies.pressure_forces(q)[0]
    # the pressure is known at cells' centres: within that of half a cell
    assert force[2] == pytest.approx(-DENSITY * G * 0.12 * 0.35, abs=DENSITY * G * 0.12 * 0.5 * H)


def test_a_light_body_that_begins_deep_in_rock_creeps_out_of_it_and_is_not_thrown():
    body = RigidBody.sphere("ball", 0.12, density=100.0, position=(0.31, 0.3, 0.15))
    tank = Tank([body], (12, 12, 18), 0.3, distance=lambda x: x[..., 2] - 0.35)
    assert "creeps out" in tank.bodies.warnings[0]
    heights = [0.15]
    for _ in range(80):
        tank.step(0.005)
        heights.append(tank.bodies.center[0, 2])
    # as fast as a fall through one cell at most, though a share of the overlap per step would be twice that
    assert np.diff(heights).max() / 0.005 <= 1.001 * np.sqrt(2 * G * H)
    assert heights[-1] == pytest.approx(0.35 + 0.12, abs=0.1 * H)  # and there it lies, on the rock
    assert np.abs(np.diff(heights[-5:])).max() < 0.01 * H


def test_the_water_beside_a_bank_does_not_throw_a_light_body_out_of_it():
    def bank(x):
        return np.maximum(0.35 - x[..., 0], x[..., 2] - 0.4)

    body = RigidBody.sphere("ball", 0.12, density=100.0, position=(0.45, 0.3, 0.15))
    tank = Tank([body], (14, 12, 18), 0.38, distance=bank)
    heights = [0.15]
    for _ in range(60):
        tank.step(0.005)
        heights.append(tank.bodies.center[0, 2])
    # it comes up through the water as a light ball does; lifted by rock that it is taken to displace, with 3 m/s
    assert np.diff(heights).max() / 0.005 < 2.0


def test_ways_out_of_an_overlap_are_slowed_down_as_a_whole():
    push, turn = np.array([[0.0, 0.0, 3.0], [0.1, 0.0, 0.0]]), np.array([[0.0, 10.0, 0.0], [0.0, 0.0, 0.0]])
    slow, slower = slowed(push, turn, np.array([0.1, 1.0]), 1.0)
    np.testing.assert_allclose(slow, [[0, 0, 0.75], [0.1, 0, 0]])
    np.testing.assert_allclose(slower, [[0, 2.5, 0], [0, 0, 0]])
    np.testing.assert_array_equal(slowed(push, turn, np.ones(2), 0.0)[0], push)  # no gravity, no measure


def test_a_piston_drives_the_liquid_with_its_own_velocity():
    # a plate across a channel, with a free surface in front
    shape = (24, 8, 12)
    path = Trajectory(
        np.array([0.0, 1.0]), np.array([[0.2, 0.2, 0.3], [0.7, 0.2, 0.3]]), np.tile([1.0, 0, 0, 0], (2, 1))
    )
    plate = RigidBody.box("plate", (0.2, 0.6, 0.8), motion="animated", trajectory=path)
    bodies, region = rigid([plate], shape, gravity=(0, 0, 0), open_top=False)
    wet = np.zeros(shape, bool)
    wet[6:18] = True
    new, _, _ = solved(bodies, region, wet, gravity=(0, 0, 0))
    np.testing.assert_allclose(new.u[7:18], 0.5, atol=1e-4)
    assert np.abs(new.v[7:18]).max() < 1e-4


# --- with particles ---------------------------------------------------------------------------------------------------


class Tank:
    """Liquid and bodies, one substep as the simulator does it."""

    def __init__(self, bodies, shape, level, distance=None):
        self.bodies, self.region = rigid(bodies, shape, distance)
        grid = self.region.grid
        axes = [grid.low[a] + (np.arange(2 * grid.shape[a]) + 0.5) * 0.5 * H for a in range(3)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        points = points[points[:, 2] < level]
        points += np.random.default_rng(0).uniform(-0.1, 0.1, points.shape) * H
        points = points[~self.bodies.inside(points)]
        points = points if distance is None else points[distance(points) > 0.0]
        self.particles = Particles.at_rest(points, DENSITY * (0.5 * H) ** 3)
        self.rate = None

    def step(self, dt):
        bodies, p, grid = self.bodies, self.particles, self.region.grid
        region = bodies.enter(self.region)
        walls = region.walls
        order = transfer.sort_by_cell(p.positions, grid)
        carried, masses = transfer.particles_to_grid(p, grid, order)
        full = boundaries.liquid_cells((np.diff(order.start) > 0).reshape(grid.shape), walls)
        shares = free_surface.solid_shares(walls.signed_distance, grid)
        surface = free_surface.liquid_surface(p.positions, p.masses / DENSITY, grid, order, shares)
        types, depth = free_surface.pressure_cells(full, surface.distance, walls.openings, H)
        skin = (full == CellType.FLUID) & (types == CellType.EMPTY)
        types = bodies.fill_films(types)
        depth = np.where(types == CellType.FLUID, np.minimum(depth, -0.1 * H), depth)
        gaps = free_surface.surface_gaps(depth, types)
        wet = types == CellType.FLUID
        wet_faces = tuple(t & (o > 0) for t, o in zip(boundaries.touching_faces(wet), walls.openings))
        bodies.predict(dt, self.rate)
        system = build_system(types, walls.openings, grid, open_border=True, gaps=gaps)
        new, q, report = project(
            add_gravity(carried, (0, 0, -G), dt), system, initial=None if self.rate is None else self.rate * dt,
            solid_velocity=bodies.face_velocity(), low_rank=bodies.coupling(system.unknown),
        )  # fmt: skip
        assert report.converged
        bodies.apply_pressure(q)
        new = free_surface.continue_velocity(new, carried, masses, wet_faces, skin & ~wet, walls.openings)
        velocities, affine = transfer.grid_to_particles(bodies.slide(new), grid, p.positions, order)
        positions = (p.positions + dt * velocities).astype(np.float32)
        boundaries.collide(
            positions, p.positions, velocities, p.velocities, self.region.walls, dt=dt, restitution=0.0,
            tangential_share=1.0,
        )  # fmt: skip
        bodies.advance()
        lost = bodies.push_out(positions, velocities)
        moved = replace(p, positions=positions, velocities=velocities, affine=affine)
        self.particles, self.rate = moved.select(~lost & grid.contains(positions)), q / dt


def test_a_raft_floats_as_deep_as_archimedes_says():
    # let go 0.4 cells too high, it bobs about its draught
    density, size, shape, level = 400.0, np.array([0.3, 0.3, 0.2]), (12, 12, 14), 0.4
    draught = density / DENSITY * size[2]
    raft = RigidBody.box("raft", size, density=density, position=(0.31, 0.3, level - draught + 0.1 + 0.4 * H))
    tank = Tank([raft], shape, level)
    count = len(tank.particles)
    heights = []
    for _ in range(200):
        tank.step(0.005)
        heights.append(tank.bodies.center[0, 2])
        assert not tank.bodies.inside(tank.particles.positions).any()
    assert len(tank.particles) == count  # nothing lost
    bottom = np.mean(heights[-110:]) - 0.1  # more than one period of heaving
    # the volume of the liquid and the submerged part fill the tank up to the level
    volume = count * (0.5 * H) ** 3
    area, floor = 0.6 * 0.6, size[0] * size[1]
    found = (volume - floor * bottom) / (area - floor) - bottom
    assert found == pytest.approx(draught, rel=0.05)
    assert tank.bodies.rotation[0, 2, 2] > 0.995


def test_a_stone_sinks_to_the_floor_and_rests_there_with_its_weight_in_water():
    stone = RigidBody.box("stone", (0.2, 0.2, 0.15), density=2500.0, position=(0.31, 0.3, 0.2), restitution=0.0)
    tank = Tank([stone], (12, 12, 12), 0.45)
    count = len(tank.particles)
    for _ in range(110):
        tank.step(0.005)
    bodies = tank.bodies
    assert (bodies.center[0, 2] - 0.075) / H == pytest.approx(0.05, abs=0.015)
    assert np.abs(bodies.velocity).max() < 1e-4
    kept = bodies.state()
    on_floor = kept["contact_impulses"][:, 2].sum() / 0.005
    # the last splashes still move the water
    assert on_floor == pytest.approx(1500.0 * 0.006 * G, rel=0.05)
    assert len(tank.particles) == count and not bodies.inside(tank.particles.positions).any()
