"""Projection onto divergence-free velocities."""

import numpy as np
import pytest

from fluidlift.numerics.poisson import LowRankTerm, PoissonSystem
from fluidlift.physics import pressure
from fluidlift.physics.boundaries import face_fractions
from fluidlift.physics.free_surface import surface_gaps
from fluidlift.physics.pressure import build_system, divergence, project, subtract_gradient
from fluidlift.types import CellType, FaceVelocity, Grid, Terrain, TriangleMesh

GRID = Grid((12, 10, 8), 0.1)


def random_velocity(seed=0, grid=GRID):
    rng = np.random.default_rng(seed)
    return FaceVelocity(*(rng.normal(size=grid.face_shape(a)).astype(np.float32) for a in range(3)))


def sphere_terrain(grid=GRID):
    distance = np.linalg.norm(grid.nodes() - np.array([0.6, 0.5, 0.2]), axis=-1) - 0.23
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    return Terrain(grid, distance.astype(np.float32), np.array([1.0, 0, 0]), mesh)


def layered_types():
    types = np.full(GRID.shape, CellType.EMPTY, np.uint8)
    types[:, :, :5] = CellType.FLUID
    types[0, :, :5] = CellType.INFLOW
    types[-1, :, :5] = CellType.OUTFLOW
    types[:, :, 0] = CellType.SOLID
    return types


@pytest.mark.parametrize("terrain", [None, sphere_terrain()], ids=["by type", "cut cells"])
def test_projection_removes_the_divergence_of_fluid_cells(terrain):
    system = build_system(layered_types(), terrain, GRID)
    velocity = random_velocity()
    new, q, report = project(velocity, system, tolerance=1e-6)
    assert report.converged and q.dtype == np.float32
    before, after = (np.abs(divergence(v, GRID, system)).max() for v in (velocity, new))
    # the tolerance bounds the 2-norm; the maximum stays below the norm of some 480 cells, about 22 times the rms
    assert after < 3e-5 * before


def test_prescribed_inflow_is_kept_and_passes_through():
    types = np.full(GRID.shape, CellType.FLUID, np.uint8)
    types[0], types[-1] = CellType.INFLOW, CellType.OUTFLOW
    velocity = FaceVelocity.zeros(GRID)
    velocity.u[:2] = 0.7
    new, _, report = project(velocity, build_system(types, None, GRID), tolerance=1e-7)
    assert report.converged
    # incompressible plug flow in a pipe; float32 velocities
    np.testing.assert_allclose(new.u[1:-1], 0.7, atol=1e-5)


def test_walls_are_not_crossed():
    types = layered_types()
    new, _, _ = project(random_velocity(), build_system(types, None, GRID))
    assert np.abs(new.w[:, :, 1]).max() == 0.0 and np.abs(new.v[:, 0, 1:5][1:-1]).max() == 0.0


def test_projecting_twice_changes_nothing():
    system = build_system(layered_types(), sphere_terrain(), GRID)
    once, _, _ = project(random_velocity(), system, tolerance=1e-7)
    twice, _, _ = project(once, system, tolerance=1e-3)
    for a, b in zip(once.components, twice.components):
        assert np.abs(a - b).max() < 1e-5  # float32 rounding of unit velocities plus the tolerance


def test_fractions_of_a_tilted_plane_match_the_cut_areas():
    grid = Grid((3, 3, 3), 1.0)
    fractions = face_fractions(grid.nodes()[..., 2] - 1.25)
    # solid below z = 1.25: vertical faces are closed in layer 0, three quarters open in layer 1, open in layer 2
    for axis in (0, 1):
        np.testing.assert_allclose(np.moveaxis(fractions[axis], 2, 0)[0], 0.0)
        np.testing.assert_allclose(
            np.moveaxis(fractions[axis], 2, 0)[1], 0.75, atol=1.1e-3
        )  # the surface is raised by 0.001
        np.testing.assert_allclose(np.moveaxis(fractions[axis], 2, 0)[2], 1.0)


def test_fractions_of_open_and_buried_faces_are_exact():
    ones = np.ones((3, 4, 5))
    assert all((f == 1).all() for f in face_fractions(ones))
    assert all((f == 0).all() for f in face_fractions(-ones))


def test_faces_in_a_flat_surface_are_closed():
    grid = Grid((3, 3, 3), 1.0)
    w = face_fractions(grid.nodes()[..., 2] - 1.0)[2]
    assert (w[:, :, 1] == 0).all() and (w[:, :, 2] == 1).all()


G = 9.81
DT = 0.01


def falling(grid, gravity):
    """Velocity that gravity gives in DT."""
    return FaceVelocity(*(np.full(grid.face_shape(a), DT * gravity[a], np.float32) for a in range(3)))


def liquid_below(distance, grid, gaps=True):
    types = np.where(distance < 0, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    return build_system(types, None, grid, gaps=surface_gaps(distance.astype(np.float32), types) if gaps else None)


def largest_on_open_faces(velocity, system):
    return max(np.abs(c[w > 0]).max() for c, w in zip(velocity.components, system.weights))


@pytest.mark.parametrize("height", [0.41, 0.4601, 0.5])
def test_a_column_of_any_height_rests_under_its_exact_pressure(height):
    distance = GRID.centers()[..., 2] - height
    system = liquid_below(distance, GRID)
    new, q, _ = project(falling(GRID, (0, 0, -G)), system, tolerance=1e-7)
    wet = system.unknown
    # float32 gaps and velocities
    np.testing.assert_allclose(q[wet], -distance[wet] * G * DT, rtol=1e-5, atol=1e-7)
    assert largest_on_open_faces(new, system) < 1e-5 * G * DT
    # with p = 0 at the centres of the first layer of air the pressure is that of a higher column
    _, stairs, _ = project(falling(GRID, (0, 0, -G)), liquid_below(distance, GRID, gaps=False), tolerance=1e-7)
    too_high = (np.count_nonzero(wet[0, 0]) + 0.5) * GRID.spacing - height
    assert too_high > 0.3 * GRID.spacing
    np.testing.assert_allclose(stairs[wet], (too_high - distance[wet]) * G * DT, rtol=1e-5)


@pytest.mark.parametrize("degrees", [3, 10, 30])
def test_a_surface_across_tilted_gravity_feels_no_spurious_forces(degrees):
    grid = Grid((16, 6, 16), 0.1)
    normal = np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])
    distance = (grid.centers() - np.array([0.8, 0.3, 0.77])) @ normal
    speeds = []
    for gaps in (True, False):
        system = liquid_below(distance, grid, gaps)
        new, _, _ = project(falling(grid, -G * normal), system, tolerance=1e-7)
        speeds.append(largest_on_open_faces(new, system))
    # rounding; stairs of cells push with half of g
    assert speeds[0] < 1e-6 * G * DT and speeds[1] > 0.1 * G * DT


def test_pressure_in_a_sphere_is_second_order_only_with_the_surface_in_its_place():
    errors = {}
    for gaps in (True, False):
        errors[gaps] = []
        for n in (8, 16, 32):
            grid = Grid((n, n, n), 1.0 / n)
            away = grid.centers() - np.array([0.503, 0.497, 0.501])
            radius = np.sqrt(np.square(away).sum(axis=-1))
            system = liquid_below(radius - 0.4, grid, gaps)
            # -lap q = 6 with q = 0 on the sphere
            _, q, _ = project(
                FaceVelocity.zeros(grid), system, tolerance=1e-8, source=np.full(grid.shape, 6.0, np.float64)
            )
            errors[gaps].append(np.abs(q - (0.4**2 - radius**2))[system.unknown].max())
    order = {gaps: np.log2(e[0] / e[2]) / 2 for gaps, e in errors.items()}
    # the largest error jumps from grid to grid with the worst cut; two doublings even that out
    assert order[True] > 1.6 and order[False] < 1.3
    assert errors[True][2] < 0.03 * errors[False][2]


def test_a_uniform_jump_raises_the_pressure_of_a_drop_and_moves_nothing():
    distance = np.sqrt(np.square(GRID.centers() - np.array([0.61, 0.48, 0.41])).sum(axis=-1)) - 0.31
    system = liquid_below(distance, GRID)
    jumps = tuple(np.full(GRID.face_shape(a), 0.7, np.float32) for a in range(3))
    new, q, _ = project(FaceVelocity.zeros(GRID), system, tolerance=1e-7, jumps=jumps)
    np.testing.assert_allclose(q[system.unknown], 0.7, rtol=1e-5)
    assert max(np.abs(c).max() for c in new.components) < 1e-3 * 0.7 / GRID.spacing  # of the gradient without balance


def tube(n=8, closed_high=False):
    """A tube along x, one cell wide, full of liquid; its low end is closed, and its high end open or closed."""
    grid = Grid((n, 1, 1), 0.1)
    openings = [np.zeros(grid.face_shape(a), np.float32) for a in range(3)]
    openings[0][1 : -1 if closed_high else None] = 1.0
    return grid, build_system(np.full(grid.shape, CellType.FLUID, np.uint8), tuple(openings), grid, open_border=True)


def test_a_moving_wall_pushes_the_liquid_ahead_of_it():
    grid, system = tube()
    solid = FaceVelocity.zeros(grid)
    solid.u[0] = 0.3
    new, _, _ = project(FaceVelocity.zeros(grid), system, tolerance=1e-7, solid_velocity=solid)
    np.testing.assert_allclose(new.u, 0.3, rtol=1e-5)  # the wall itself included
    assert np.abs(divergence(new, grid, system, solid_velocity=solid)).max() < 1e-4
    at_rest, _, _ = project(new, system, tolerance=1e-7)
    np.testing.assert_allclose(at_rest.u, 0.0, atol=1e-6)


def test_a_half_open_face_lets_the_solid_through_with_its_half():
    grid, system = tube()
    half = [o.copy() for o in system.openings]
    half[0][4] = 0.5
    system = build_system(np.full(grid.shape, CellType.FLUID, np.uint8), tuple(half), grid, open_border=True)
    solid = FaceVelocity.zeros(grid)
    solid.u[0], solid.u[4] = 0.3, 0.1
    new, _, _ = project(FaceVelocity.zeros(grid), system, tolerance=1e-7, solid_velocity=solid)
    # flux 0.3 = half a face of liquid at 0.5 and half a face of solid at 0.1
    np.testing.assert_allclose(new.u[4], 0.5, rtol=1e-5)
    np.testing.assert_allclose(np.delete(new.u, 4, axis=0), 0.3, rtol=1e-5)


def test_a_plain_system_knows_no_moving_solids():
    grid, system = tube()
    plain = PoissonSystem(system.unknown, *system.weights, system.spacing)
    with pytest.raises(ValueError, match="moving solids"):
        project(FaceVelocity.zeros(grid), plain, solid_velocity=FaceVelocity.zeros(grid))


def test_a_piston_and_the_water_that_it_strikes_share_their_momentum():
    grid, system = tube()
    h, density, mass, speed = grid.spacing, 1000.0, 2.0, 1.0
    solid = FaceVelocity.zeros(grid)
    solid.u[0] = speed
    # J: divergence of the first cell per velocity of the piston. q is pressure dt / density: impulse = density h^3 J q
    rows = np.array([[-1.0 / h, 0, 0, 0, 0, 0]])
    inverse = np.zeros((6, 6))
    inverse[0, 0] = density * h**3 / mass
    term = LowRankTerm(np.array([[0, 0, 0]]), rows, inverse)
    new, q, report = project(
        FaceVelocity.zeros(grid), system, tolerance=1e-9, solid_velocity=solid, low_rank=(term,), max_iterations=500
    )
    assert report.converged
    after = speed + inverse[0, 0] * rows[0, 0] * float(q[0, 0, 0])
    # from the centre of the first cell, whose pressure the piston feels, to p = 0 half a cell beyond the open end
    water = density * h**3 * grid.shape[0]
    assert after == pytest.approx(speed * mass / (mass + water), rel=1e-5)
    np.testing.assert_allclose(new.u[1:], after, rtol=1e-4)


def test_gaps_that_are_not_positive_are_refused():
    types = np.full(GRID.shape, CellType.FLUID, np.uint8)
    gaps = tuple(np.zeros(GRID.face_shape(a), np.float32) for a in range(3))
    with pytest.raises(ValueError, match="positive"):
        build_system(types, None, GRID, gaps=gaps)


@pytest.mark.parametrize("near", [False, True], ids=["centres of air", "surface between"])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_compiled_loops_over_faces_give_the_bits_of_array_operations(near, kind, monkeypatch):
    rng = np.random.default_rng(2)
    gaps = tuple(rng.uniform(0.05, 1.0, GRID.face_shape(a)).astype(np.float32) for a in range(3)) if near else None
    system = build_system(layered_types(), sphere_terrain(), GRID, open_border=near, gaps=gaps)
    velocity, q = random_velocity(), rng.normal(size=GRID.shape).astype(kind)
    fast = divergence(velocity, GRID, system), *subtract_gradient(velocity, system, q).components
    monkeypatch.setattr(pressure, "_plain_numbers", lambda velocity, system: False)
    plain = divergence(velocity, GRID, system), *subtract_gradient(velocity, system, q).components
    for one, other in zip(fast, plain, strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    assert np.ptp(plain[1]) > 0 and not np.array_equal(plain[1], velocity.u)
