"""Implicit viscosity in Warp (here on its CPU device) is that of `physics.viscosity`."""

import numpy as np
import pytest

from fluidlift.backends.warp_device import warp_device
from fluidlift.physics import viscosity
from fluidlift.physics.viscosity import FaceRoles, diffuse
from fluidlift.types import FaceVelocity, Grid, triple

warp = pytest.importorskip("warp")

from fluidlift.backends.warp_viscosity import WarpViscosity  # noqa: E402

GRID = Grid((9, 7, 10), 0.1)
DEVICE = warp_device("cpu")


def touching(cells):
    """Faces of the cells, per component."""
    out = []
    for axis in range(3):
        wide = np.moveaxis(np.pad(cells, [(1, 1) if a == axis else (0, 0) for a in range(3)]), axis, 0)
        out.append(np.moveaxis(wide[1:] | wide[:-1], 0, axis))
    return out


def scene(seed=0, *, fills_the_box=False):
    """A wavy lump of liquid on a sloping bed, or a layer that reaches the open sides; an inflow; closed faces.

    Faces with liquid are solved where the bed leaves them open, even if their centre lies in it; closed faces are
    walls, or fixed where they stop the flow head-on.
    """
    rng = np.random.default_rng(seed)
    c, nodes = GRID.centers() - GRID.low, GRID.nodes() - GRID.low
    solid = nodes @ np.array([-0.2, 0.1, 0.97]) - 0.17 + 0.02 * np.sin(9 * nodes[..., 0])
    if fills_the_box:
        liquid = c[..., 2] - 0.62 - 0.07 * np.sin(7 * c[..., 0] + 5 * c[..., 1])
    else:
        liquid = np.sqrt(((c - (0.42, 0.36, 0.4)) ** 2).sum(-1)) - 0.3 + 0.03 * np.sin(20 * c[..., 1])
    wet = touching(liquid < 0.01)
    solved, fixed, walls = [], [], []
    for a in range(3):
        corner = solid
        for other in range(3):
            if other != a:
                corner = np.maximum(*(np.take(corner, range(s, corner.shape[other] - 1 + s), other) for s in (0, 1)))
        closed = corner <= 0.0
        head_on = closed & (a == 2)
        if a == 0:
            head_on[1:3, 2:5, 4:6] = True  # an inflow
        fixed.append(head_on)
        walls.append(closed & ~head_on)
        solved.append(wet[a] & ~closed & ~head_on)
    roles = FaceRoles(triple(solved), triple(fixed), triple(walls), np.float32(liquid), np.float32(solid))
    velocity = [rng.normal(size=GRID.face_shape(a)).astype(np.float32) for a in range(3)]
    for v, w in zip(velocity, walls):
        v[w] = 0.0
    return roles, FaceVelocity(*velocity)


def upload(values, dtype=None):
    return warp.array(np.ascontiguousarray(values), dtype=dtype or warp.float32, device=DEVICE)


def on_device(roles, velocity, solver=None, **options):
    solver = solver or WarpViscosity(GRID.shape, GRID.spacing, DEVICE)
    moved = triple(upload(v) for v in velocity.components)
    masks = [triple(upload(m.astype(np.uint8), warp.uint8) for m in part) for part in roles_of(roles)]
    distances = upload(roles.liquid_distance), upload(roles.solid_distance)
    report = solver.diffuse(moved, triple(masks), *distances, **options)
    return FaceVelocity(*(m.numpy() for m in moved)), report


def roles_of(roles):
    return roles.solved, roles.fixed, roles.walls


@pytest.mark.parametrize("wall_share", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("nu", [0.01, 0.7, 12.0])
@pytest.mark.parametrize("fills_the_box", [False, True])
def test_a_viscous_step_is_that_of_the_cpu(fills_the_box, nu, wall_share):
    roles, velocity = scene(fills_the_box=fills_the_box)
    options = {"viscosity": nu, "dt": 0.01, "wall_share": wall_share, "tolerance": 1e-7}
    wanted, (theirs,) = diffuse(velocity, roles, spacing=GRID.spacing, **options)
    found, ours = on_device(roles, velocity, **options)
    assert theirs.converged and ours.converged and 0 < ours.residual <= 1e-7
    for one, other, before in zip(found.components, wanted.components, velocity.components):
        # the tolerance relative to the momentum; slow modes (rigid motion) hide some in the residual
        np.testing.assert_allclose(one, other, atol=1e-5)
        assert np.abs(other - before).max() > 0.1  # of speeds about 1 m/s


def test_the_operator_is_that_of_the_cpu():
    roles, velocity = scene()
    solver = WarpViscosity(GRID.shape, GRID.spacing, DEVICE)
    options = {"viscosity": 0.3, "dt": 0.01, "wall_share": 0.8}
    on_device(roles, velocity, solver, **options)
    system, region, buried = viscosity.build_system(roles, spacing=GRID.spacing, **options)
    assert buried.any() and ((system.mass > 0) & (system.mass < 1)).any()
    size = (3, *(n + 5 for n in GRID.shape))
    crop = tuple(slice(2 + a, 2 + a + n) for a, n in zip(region.low, region.shape))
    pairs = {"mass": system.mass, "normal": system.normal, "shear": system.shear, "inverse": system.inverse}
    for name, wanted in pairs.items():
        found = getattr(solver._stress, name).numpy().reshape(size)
        np.testing.assert_allclose(found[(slice(None), *crop)], wanted, rtol=2e-5, atol=1e-6)
        assert np.count_nonzero(found) == np.count_nonzero(wanted)  # nothing outside the box
    np.testing.assert_array_equal(solver._parts.buried.numpy().reshape(size)[(slice(None), *crop)] > 0, buried)


def test_without_walls_momentum_is_kept():
    roles, velocity = scene()
    free = tuple(np.zeros_like(m) for m in roles.solved)
    roles = FaceRoles(
        triple(touching(roles.liquid_distance < 0)), free, free, roles.liquid_distance,
        np.ones_like(roles.solid_distance),
    )  # fmt: skip
    solver = WarpViscosity(GRID.shape, GRID.spacing, DEVICE)
    found, report = on_device(roles, velocity, solver, viscosity=5.0, dt=0.01, wall_share=1.0, tolerance=1e-8)
    assert report.converged
    mass = solver._stress.mass.numpy().reshape((3, *(n + 5 for n in GRID.shape)))
    for a in range(3):
        m = mass[a][tuple(slice(2, 2 + n) for n in GRID.face_shape(a))]
        assert abs((m * (found.components[a] - velocity.components[a])).sum()) < 1e-5 * m.sum()


def test_a_negligible_viscosity_changes_nothing():
    roles, velocity = scene()
    found, report = on_device(roles, velocity, viscosity=1e-6, dt=0.01, wall_share=1.0)
    assert report is None
    for one, other in zip(found.components, velocity.components):
        np.testing.assert_array_equal(one, other)


def test_without_liquid_nothing_moves():
    roles, velocity = scene()
    dry = tuple(np.zeros_like(m) for m in roles.solved)
    roles = FaceRoles(dry, roles.fixed, roles.walls, roles.liquid_distance, roles.solid_distance)
    found, report = on_device(roles, velocity, viscosity=1.0, dt=0.01, wall_share=1.0)
    assert report.converged and report.iterations == 0 and report.residual == 0.0
    for one, other in zip(found.components, velocity.components):
        np.testing.assert_array_equal(one, other)


def test_velocities_that_are_not_finite_are_reported():
    roles, velocity = scene()
    velocity.w[4, 3, 4] = np.nan
    _, report = on_device(roles, velocity, viscosity=1.0, dt=0.01, wall_share=1.0)
    assert not report.converged and np.isnan(report.residual)


@pytest.mark.parametrize("loops", [False, True])
def test_graphs_give_the_same_bits_and_a_solver_forgets_the_step_before(loops):
    options = {"viscosity": 3.0, "dt": 0.01, "wall_share": 1.0}
    solver = WarpViscosity(GRID.shape, GRID.spacing, DEVICE, graphs=True, loops=loops)
    for seed, fills in ((0, False), (1, True), (2, False)):
        roles, velocity = scene(seed, fills_the_box=fills)
        wanted, one = on_device(roles, velocity, **options)
        found, two = on_device(roles, velocity, solver, **options)
        assert one == two and one.iterations > 4
        for a, b in zip(found.components, wanted.components):
            np.testing.assert_array_equal(a, b)


def test_arguments_of_wrong_shape_or_range_are_refused():
    roles, velocity = scene()
    solver = WarpViscosity((9, 7, 11), GRID.spacing, DEVICE)
    with pytest.raises(ValueError, match="liquid distance"):
        on_device(roles, velocity, solver, viscosity=1.0, dt=0.01, wall_share=1.0)
    for wrong, match in (({"viscosity": -1.0}, "negative"), ({"wall_share": 1.5}, "wall share")):
        with pytest.raises(ValueError, match=match):
            on_device(roles, velocity, **({"viscosity": 1.0, "dt": 0.01, "wall_share": 1.0} | wrong))
