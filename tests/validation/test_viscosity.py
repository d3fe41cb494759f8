"""Viscous flows with known solutions."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.physics.pressure import build_system as pressure_system
from fluidlift.physics.pressure import project, subtract_gradient
from fluidlift.physics.viscosity import FaceRoles, diffuse
from fluidlift.types import CellType, FaceVelocity, Grid

GRAVITY = 9.81


def everything(grid, value):
    return [np.full(grid.face_shape(a), value) for a in range(3)]


def filled(grid):
    """Roles in a box full of liquid with open sides."""
    return FaceRoles(*(tuple(everything(grid, value)) for value in (True, False, False)))


def channel(grid):
    """Liquid between a floor in the lowest cells and the top of the grid, that can only move along x.

    A channel without end: at open ends, which are free of stress, the liquid would turn instead of being sheared.
    """
    roles = with_floor(filled(grid))
    for a in (1, 2):
        roles.solved[a][...] = False
        roles.fixed[a][...] = True
    return roles


def with_floor(roles, layers=1):
    """The same, but the lowest layers of cells are a wall."""
    for a in range(2):
        roles.solved[a][:, :, :layers] = False
        roles.walls[a][:, :, :layers] = True
    roles.solved[2][:, :, : layers + 1] = False
    roles.fixed[2][:, :, : layers + 1] = True
    return roles


def close_top(roles, kind):
    """The highest faces along x become `kind` ("fixed" or "walls")."""
    roles.solved[0][:, :, -1] = False
    getattr(roles, kind)[0][:, :, -1] = True


def steady(grid, roles, force, viscosity, *, start=None):
    """Velocity along x under a body force (m/s^2): one step, so long that the inertia is gone."""
    height = grid.shape[2] * grid.spacing
    dt = 1e4 * height**2 / np.min(viscosity)
    velocity = FaceVelocity.zeros(grid) if start is None else start
    velocity.u[roles.solved[0]] += np.float32(force * dt)
    new, (report,) = diffuse(
        velocity, roles, viscosity=viscosity, dt=dt, spacing=grid.spacing, wall_share=1.0,
        initial=FaceVelocity.zeros(grid), tolerance=1e-7,
    )  # fmt: skip
    return new, report


def taylor_green(grid, k):
    u, v = grid.faces(0), grid.faces(1)
    return FaceVelocity(
        np.float32(np.sin(k * u[..., 0]) * np.cos(k * u[..., 1])),
        np.float32(-np.cos(k * v[..., 0]) * np.sin(k * v[..., 1])),
        np.zeros(grid.face_shape(2), np.float32),
    )


def closed_box(grid):
    """Frictionless walls across x and y; open along z."""
    fixed = everything(grid, False)
    for a in range(2):
        np.moveaxis(fixed[a], a, 0)[[0, -1]] = True
    return FaceRoles(tuple(~f for f in fixed), tuple(fixed), tuple(everything(grid, False)))


@pytest.mark.parametrize("viscosity", [1e-3, 1e-1], ids=["diagonal preconditioner", "multigrid preconditioner"])
def test_taylor_green_vortices_decay_at_the_viscous_rate(viscosity):
    n = 32
    grid = Grid((n, n, 2), np.pi / n)
    h, k, dt, steps = grid.spacing, 1.0, 0.25, 4
    start = velocity = taylor_green(grid, k)
    for _ in range(steps):
        velocity, reports = diffuse(
            velocity, closed_box(grid), viscosity=viscosity, dt=dt, spacing=h, wall_share=0.0, tolerance=1e-7
        )
        assert all(r.converged for r in reports)
    rate = 2 * (2 - 2 * np.cos(k * h)) / h**2  # eigenvalue of the discrete operator, 2 k^2 up to h^2 / 12
    truth = (1 + dt * viscosity * rate) ** -steps  # backward Euler
    for a in range(2):
        np.testing.assert_allclose(velocity.components[a], truth * start.components[a], atol=3e-6)  # float32
    # and the discrete rate is that of the equation: first order in dt, second in h
    assert truth == pytest.approx(np.exp(-2 * viscosity * dt * steps), rel=dt * viscosity * 2)


def test_decay_of_taylor_green_vortices_is_second_order_in_space():
    errors = []
    for n in (8, 16, 32):
        grid = Grid((n, n, 2), np.pi / n)
        start = taylor_green(grid, 1.0)
        new, _ = diffuse(
            start, closed_box(grid), viscosity=1.0, dt=2.0, spacing=grid.spacing, wall_share=0.0, tolerance=1e-8
        )
        left = (new.u * start.u).sum() / np.square(start.u).sum()
        errors.append(abs((1 / left - 1) / 2.0 - 2.0))  # rate of backward Euler, against 2 k^2
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.05)


def channel_error(n, slope):
    """Largest error over the largest speed in a channel full of liquid, n cells and 1 m deep, tilted by `slope`."""
    grid = Grid((3, 3, n + 2), 1.0 / n)
    roles = channel(grid)
    close_top(roles, "walls")
    viscosity, force = 0.1, GRAVITY * np.sin(slope)
    new, report = steady(grid, roles, force, viscosity)
    assert report.converged
    z = grid.faces(0)[..., 2] - grid.spacing
    truth = force / (2 * viscosity) * z * (1.0 - z)
    return np.abs(new.u - truth)[roles.solved[0]].max() / (force / (8 * viscosity))


def test_flow_down_a_tilted_channel_is_a_parabola_of_second_order():
    errors = [channel_error(n, np.radians(20)) for n in (4, 8, 16)]
    # the wall lies half a cell from the first face: the whole profile is off by h^2 / 8 of its curvature, 1 / n^2
    assert errors[1] == pytest.approx(1 / 8**2, rel=0.05)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.05)


def film_error(n, offset):
    """The same for a film with a free surface `offset` cells above the middle of cell n."""
    grid = Grid((3, 3, n + 4), 1.0 / n)
    depth = (n - 0.5 + offset) * grid.spacing
    roles = channel(grid)
    distance = grid.centers()[..., 2] - (grid.spacing + depth)
    # no velocity where the control volume holds no liquid
    roles.solved[0][grid.faces(0)[..., 2] - 0.5 * grid.spacing >= grid.spacing + depth] = False
    viscosity, force = 0.1, GRAVITY * np.sin(np.radians(20))
    new, report = steady(grid, replace(roles, liquid_distance=distance), force, viscosity)
    assert report.converged
    z = grid.faces(0)[..., 2] - grid.spacing
    truth = force / viscosity * (depth * z - 0.5 * z * z)
    inside = roles.solved[0] & (z < depth)
    return np.abs(new.u - truth)[inside].max() / truth[inside].max()


@pytest.mark.parametrize("offset", [0.0, 0.2, 0.45, 0.7])
def test_a_film_with_a_free_surface_anywhere_in_its_cell_is_of_second_order(offset):
    # Nusselt's film: at the wall, h^2 / 8 of the curvature as in the channel; a quarter of that of the highest speed
    errors = [film_error(n, offset) for n in (4, 8, 16)]
    assert errors[2] == pytest.approx(0.25 / 16**2, rel=0.1)
    for coarse, fine in zip(errors, errors[1:]):
        # 4, and up to 5 since the depth is up to half a cell less than n cells
        assert 3.7 < coarse / fine < 5.0


def test_a_moving_wall_drags_the_liquid_linearly():
    grid = Grid((3, 3, 10), 0.1)
    for kind in ("fixed", "walls"):
        roles = channel(grid)
        close_top(roles, kind)
        start = FaceVelocity.zeros(grid)
        start.u[:, :, -1] = 2.0
        new, report = steady(grid, roles, 0.0, 0.3, start=start)
        assert report.converged
        z = np.arange(10) - 0.5  # of the faces, above the floor
        # a prescribed face holds at its centre, a wall half a cell before it
        truth = 2.0 * z / (z[-1] if kind == "fixed" else z[-1] - 0.5)
        np.testing.assert_allclose(new.u[1, 1, 1:-1], truth[1:-1], atol=1e-5)


def test_stress_is_continuous_between_two_liquids():
    grid = Grid((3, 3, 12), 0.1)
    roles = channel(grid)
    close_top(roles, "fixed")
    start = FaceVelocity.zeros(grid)
    start.u[:, :, -1] = 1.0
    viscosity = np.full(grid.shape, 0.05)
    viscosity[:, :, 6:] = 2.0
    new, report = steady(grid, roles, 0.0, viscosity, start=start)
    assert report.converged
    z = (np.arange(12) + 0.5) * 0.1
    low, high = 0.5 / 0.05, (z[-1] - 0.6) / 2.0  # thickness over viscosity, of what lies below and above the interface
    stress = 1.0 / (low + high)
    truth = np.where(z < 0.6, stress * (z - 0.1) / 0.05, 1.0 - stress * (z[-1] - z) / 2.0)
    # the kinked profile is exact: the interface lies between cells, the stress on it is that of both
    np.testing.assert_allclose(new.u[1, 1, 1:], truth[1:], atol=1e-5)


def wet_roles(grid, wet):
    solved = []
    for a in range(3):
        pad = [(0, 0)] * 3
        pad[a] = (1, 1)
        wide = np.moveaxis(np.pad(wet, pad), a, 0)
        solved.append(np.moveaxis(wide[1:] | wide[:-1], 0, a))
    return FaceRoles(tuple(solved), tuple(everything(grid, False)), tuple(everything(grid, False)))


@pytest.mark.parametrize("number", [1.0, 1e4])
@pytest.mark.parametrize("cut", [True, False], ids=["surface through cells", "whole cells"])
def test_a_free_body_keeps_its_rotation(number, cut):
    grid = Grid((20, 20, 20), 0.05)
    centre = np.array([0.49, 0.51, 0.53])
    distance = np.linalg.norm(grid.centers() - centre, axis=-1) - 0.33
    turning = np.array([0.3, -0.5, 0.8])
    start = FaceVelocity(*(np.float32(np.cross(turning, grid.faces(a) - centre)[..., a]) for a in range(3)))
    rng = np.random.default_rng(0)
    noisy = FaceVelocity(*(c + 0.1 * rng.normal(size=c.shape).astype(np.float32) for c in start.components))
    roles = wet_roles(grid, distance < 0)
    options = {"viscosity": number * grid.spacing**2, "dt": 1.0, "spacing": grid.spacing, "wall_share": 1.0}
    roles = replace(roles, liquid_distance=distance if cut else None)
    new, _ = diffuse(start, roles, **options)
    for a in range(3):
        np.testing.assert_allclose(new.components[a], start.components[a], atol=1e-5)  # no strain: nothing to do
    smooth, (report,) = diffuse(noisy, roles, **options)
    assert report.converged
    if number > 1:
        for a in range(3):
            # the mean of 1300 random numbers of 0.1 is some 0.003, and so is the speed at the rim of the spin they hold
            inside = roles.solved[a]
            np.testing.assert_allclose(smooth.components[a][inside], start.components[a][inside], atol=0.02)


def test_huge_steps_of_a_pool_only_lose_energy():
    grid = Grid((16, 14, 12), 0.01)
    rng = np.random.default_rng(2)
    distance = grid.centers()[..., 2] - 0.06 - 0.01 * np.sin(60 * grid.centers()[..., 0])
    roles = replace(with_floor(wet_roles(grid, distance < 0)), liquid_distance=distance)
    velocity = FaceVelocity(*(rng.normal(size=s.shape).astype(np.float32) * s for s in roles.solved))
    energies = []
    for _ in range(4):
        energies.append(sum(float(np.square(c).sum()) for c in velocity.components))
        velocity, (report,) = diffuse(
            velocity, roles, viscosity=24.0, dt=1 / 24, spacing=grid.spacing, wall_share=1.0
        )  # dt nu / h^2 = 1e4
        assert report.converged and report.iterations < 40
    assert np.isfinite(energies).all()
    assert np.all(np.diff(energies) < 0)
    # what touches the floor comes to rest: the slowest mode decays by 1 + (pi / 2 / 5)^2 1e4 per step
    assert energies[2] < 1e-4 * energies[0]


def half_cell_gaps(grid, wet):
    """For the pressure: the surface lies on the faces between wet and dry cells, half a cell from the centres."""
    gaps = []
    for a in range(3):
        pad = [(0, 0)] * 3
        pad[a] = (1, 1)
        wide = np.moveaxis(np.pad(wet, pad), a, 0)
        gaps.append(np.where(np.moveaxis(wide[1:] ^ wide[:-1], 0, a), np.float32(0.5), np.float32(1.0)))
    return tuple(gaps)


@pytest.mark.parametrize("number", [0.5, 1.5])
def test_a_hanging_column_stretches_by_three_times_its_viscosity(number):
    # Trouton 1906: the sides of a thread under tension move in freely, which triples the viscosity of the stretch
    length = 10
    grid = Grid((8, 8, length + 2), 0.01)
    viscosity, gravity = 0.05, 1.0
    dt = number * grid.spacing**2 / viscosity
    wet = np.zeros(grid.shape, bool)
    wet[2:6, 2:6, 2:] = True
    roles = wet_roles(grid, wet)
    roles.solved[2][:, :, -1] = False
    roles.fixed[2][2:6, 2:6, -1] = True  # glued on top, free to contract there
    system = pressure_system(
        np.where(wet, CellType.FLUID, CellType.EMPTY), None, grid, gaps=half_cell_gaps(grid, wet)
    )  # fmt: skip
    velocity, q = FaceVelocity.zeros(grid), np.zeros(grid.shape, np.float32)
    # 0.15 s: six times (2 L / pi)^2 / (3 nu), the time in which the slowest stretch decays
    for _ in range(round(0.15 / dt)):
        velocity.w[roles.solved[2]] -= np.float32(gravity * dt)
        velocity = subtract_gradient(velocity, system, q)
        velocity, (report,) = diffuse(velocity, roles, viscosity=viscosity, dt=dt, spacing=grid.spacing, wall_share=0.0)
        assert report.converged
        velocity, change, _ = project(velocity, system)
        q = q + change
    w = velocity.w[2:6, 2:6].mean(axis=(0, 1))
    middle = slice(4, length)  # two cells from the ends, where the column is not slender
    stretch = np.diff(w)[middle] / grid.spacing
    weight_below = gravity * grid.spacing * (np.arange(length + 2)[middle] - 1.5)
    # what is left of the start, e^-6, and the change of the tension within the column's width
    assert stretch * viscosity / weight_below == pytest.approx(1 / 3, rel=0.02)


def open_faces(solid, axis):
    """Faces of which any corner lies outside the solid."""
    corners = np.moveaxis(solid, axis, 0)
    n, m = corners.shape[1] - 1, corners.shape[2] - 1
    return (
        np.moveaxis(np.maximum.reduce([corners[:, i : i + n, j : j + m] for i in (0, 1) for j in (0, 1)]), 0, axis)
        > 1e-6
    )


def inclined_film(n, angle, offset):
    """A film n cells thick, its height over the bed, the exact velocity on the faces, and what `diffuse` is told.

    The bed is a plane at `angle` to the grid, `offset` cells above the cells' corners. The ends move as they should.
    """
    h = 1.0 / n
    rise = np.tan(angle)
    grid = Grid((round(2.5 * n), 3, round(2.5 * n * rise) + round(n / np.cos(angle)) + 6), h)
    up, along = np.array([-np.sin(angle), 0.0, np.cos(angle)]), np.array([np.cos(angle), 0.0, np.sin(angle)])
    foot = np.array([0.0, 0.0, (2.0 + offset) * h])
    solid = (grid.nodes() - foot) @ up
    roles = FaceRoles(*(tuple(everything(grid, False)) for _ in range(3)))
    heights, profile = [], []
    for a in range(3):
        height = (grid.faces(a) - foot) @ up
        heights.append(height)
        profile.append(np.float32((0.5 * height**2 - height) * along[a]))  # under a force of -1 along it, viscosity 1
        wet = open_faces(solid, a) & (height < 1.0 + 0.5 * h)
        ends = np.zeros(wet.shape, bool)
        ends[:2] = ends[-2:] = True
        roles.fixed[a][...], roles.solved[a][...] = wet & ends, wet & ~ends
        roles.walls[a][...] = ~open_faces(solid, a)
    start = FaceVelocity(*(np.where(f, p, np.float32(0)) for f, p in zip(roles.fixed, profile)))
    dt = 1e3
    for a in range(3):
        start.components[a][roles.solved[a]] -= np.float32(dt * along[a])
    options = {
        "roles": replace(roles, liquid_distance=(grid.centers() - foot) @ up - 1.0, solid_distance=solid),
        "viscosity": 1.0, "dt": dt, "spacing": h, "wall_share": 1.0, "tolerance": 1e-7,
    }  # fmt: skip
    return grid, heights, profile, start, options


def inclined_film_error(n, angle, offset, *, staircase=False):
    """Largest error in the middle of the film over its surface's speed."""
    grid, heights, profile, start, options = inclined_film(n, angle, offset)
    if staircase:
        options["roles"] = replace(options["roles"], solid_distance=None)
    new, (report,) = diffuse(start, **options)
    assert report.converged
    worst = 0.0
    for a in (0, 2):
        middle = np.abs(grid.faces(a)[..., 0] - 0.5 * grid.high[0]) < 0.2 * grid.high[0]
        inside = options["roles"].solved[a] & middle & (heights[a] > 0) & (heights[a] < 1.0)
        worst = max(worst, 2.0 * np.abs(new.components[a] - profile[a])[inside].max())
    return worst


@pytest.mark.parametrize("offset", [0.1, 0.3, 0.6, 0.9])
def test_a_bed_anywhere_in_its_cell_is_of_second_order(offset):
    errors = [inclined_film_error(n, 0.0, offset) for n in (4, 8, 16)]
    # as in the channel: a quarter of the curvature times the square of the gap between bed and first face, 1 cell
    assert errors[2] < 0.3 / 16**2
    for coarse, fine in zip(errors, errors[1:]):
        assert 3.0 < coarse / fine < 5.0


@pytest.mark.parametrize("angle", [20, 40])
def test_an_inclined_bed_is_not_a_staircase(angle):
    # the bed's place is known within cells, what is strained there to first order: 4 % at 8 cells in the worst face
    cut = inclined_film_error(8, np.radians(angle), 0.3)
    assert cut < 0.05
    staircase = inclined_film_error(8, np.radians(angle), 0.3, staircase=True)
    assert cut < 0.6 * staircase


def test_velocity_continues_linearly_into_the_bed():
    # faces that are partly open but have their centre in the bed take part as walls, and are filled afterwards
    _, heights, profile, start, options = inclined_film(8, 0.0, 0.95)
    new, _ = diffuse(start, **options)
    filled = options["roles"].solved[0] & (heights[0] < 0)
    assert np.count_nonzero(filled) > 10
    assert profile[0][filled].min() > 0.05
    # linear, not the parabola of curvature 1: half the product of both distances, 0.056 and 0.125, is 0.0035
    np.testing.assert_allclose(new.u[filled], profile[0][filled], atol=0.005)


def test_a_moving_bed_carries_the_film_along():
    # the bed lies above some faces' centres, which move with it although they are partly open
    _, heights, _, _, options = inclined_film(8, 0.0, 0.95)
    roles = options["roles"]
    ones = FaceVelocity(*(np.full(h.shape, np.float32(a == 0)) for a, h in enumerate(heights)))
    start = FaceVelocity(*(np.where(s, np.float32(0), c) for s, c in zip(roles.solved, ones.components)))
    new, (report,) = diffuse(start, **(options | {"roles": replace(roles, solid_velocity=ones)}))
    assert report.converged
    # the time step is 1000 times the viscous time of the film
    np.testing.assert_allclose(new.u[roles.solved[0]], 1.0, atol=2e-3)
