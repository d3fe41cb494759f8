"""The viscous operator: against its plain twin, and what a minimum of energy must do."""

import numpy as np
import pytest

from fluidlift.physics import stress_kernels as kernels
from fluidlift.physics.liquid_fractions import cut_share, octant_shares
from fluidlift.physics.viscosity import FaceRoles, build_system, diffuse
from fluidlift.types import FaceVelocity, Grid


def wet_faces(wet):
    out = []
    for axis in range(3):
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        wide = np.moveaxis(np.pad(wet, pad), axis, 0)
        out.append(np.moveaxis(wide[1:] | wide[:-1], 0, axis))
    return tuple(out)


def nothing(grid):
    return tuple(np.zeros(grid.face_shape(a), bool) for a in range(3))


def random_velocity(grid, seed=0):
    rng = np.random.default_rng(seed)
    return FaceVelocity(*(rng.normal(size=grid.face_shape(a)).astype(np.float32) for a in range(3)))


def random_pool():
    """A lump of liquid on a floor with a step, beside an inflow and a frictional side wall; two liquids."""
    grid = Grid((7, 6, 8), 0.1)
    c = grid.centers()
    distance = np.sqrt(((c - (0.33, 0.31, 0.3)) ** 2).sum(-1)) - 0.27
    roles = [np.zeros(grid.face_shape(a), np.int8) for a in range(3)]
    for a, wet in enumerate(wet_faces(distance < 0)):
        roles[a][wet] = kernels.SOLVED
    floor = np.zeros(grid.shape, bool)
    floor[:, :, :2] = True
    floor[5:, :, :4] = True
    for a in range(3):
        pad = [(0, 0)] * 3
        pad[a] = (1, 1)
        wide = np.moveaxis(np.pad(floor, pad, mode="edge"), a, 0)
        both, either = (np.moveaxis(m, 0, a) for m in (wide[1:] & wide[:-1], wide[1:] | wide[:-1]))
        roles[a][both] = kernels.WALL
        roles[a][either & ~both] = kernels.FIXED
    roles[0][:2, 2:4, 2:5] = kernels.FIXED
    roles[1][0] = roles[1][-1] = roles[2][0] = kernels.WALL
    masks = FaceRoles(
        *(tuple(r == code for r in roles) for code in (kernels.SOLVED, kernels.FIXED, kernels.WALL))
    )  # fmt: skip
    viscosity = np.where(c[..., 1] < 0.3, 0.02, 0.7).astype(np.float32)
    return grid, distance, masks, viscosity


class PlainTwin:
    """The same minimum, written down stress by stress on the whole grid, as a dense matrix over all faces."""

    def __init__(self, grid, roles, *, viscosity, number, wall_share, distance=None):
        self.grid, self.role = grid, {}
        self.index = {}
        for a in range(3):
            for at in np.ndindex(grid.face_shape(a)):
                self.index[(a, *at)] = len(self.index)
                code = 1 if roles.solved[a][at] else 2 if roles.fixed[a][at] else 3 if roles.walls[a][at] else 0
                if code == 1 and at[a] in (0, grid.shape[a]):
                    code = 4  # on an open side of the grid
                self.role[(a, *at)] = code
        self.viscosity = np.broadcast_to(viscosity, grid.shape)
        closed = {c: all(self.role[f] in (2, 3) for f in self.faces_of(c)) for c in np.ndindex(grid.shape)}
        air = {c: any(self.role[f] == 0 for f in self.faces_of(c)) for c in np.ndindex(grid.shape)}
        self.excluded = np.array([closed[c] for c in np.ndindex(grid.shape)]).reshape(grid.shape)
        if distance is None:
            full = [not closed[c] and not air[c] for c in np.ndindex(grid.shape)]
            self.octants = np.repeat(np.reshape(full, grid.shape)[..., None].astype(float), 8, -1)
        else:
            ring = np.pad(self.excluded, 1, constant_values=True)
            self.octants = octant_shares(np.pad(distance, 1, mode="edge"), ring)[1:-1, 1:-1, 1:-1]
        self.assemble(number, wall_share)

    def faces_of(self, cell):
        for a in range(3):
            for s in range(2):
                yield (a, *(cell[b] + (s if b == a else 0) for b in range(3)))

    def volume(self, at, axes):
        """Liquid share and harmonic viscosity of the volume of cell `at`, moved down by half a cell along `axes`."""
        shares, resistances = [], []
        for o in np.ndindex(2, 2, 2):
            cell = tuple(at[b] - (1 - o[b] if b in axes else 0) for b in range(3))
            if not all(0 <= cell[b] < self.grid.shape[b] for b in range(3)) or self.excluded[cell]:
                continue
            half = [1 - o[b] if b in axes else o[b] for b in range(3)]
            shares.append(self.octants[cell][4 * half[0] + 2 * half[1] + half[2]])
            resistances.append(shares[-1] / self.viscosity[cell])
        total = sum(shares)
        return (total / len(shares), total / sum(resistances)) if total > 0 else (0.0, 0.0)

    def assemble(self, number, wall_share):
        size = len(self.index)
        self.stiffness = np.zeros((size, size))
        nodes = tuple(n + 1 for n in self.grid.shape)
        for at in np.ndindex(nodes):
            for a in range(3):
                up = tuple(n + (b == a) for b, n in enumerate(at))
                self.add_stress({(a, *up): 1.0, (a, *at): -1.0}, at, (), 2.0 * number, wall_share)
                b, c = (x for x in range(3) if x != a)
                terms = {(b, *at): 1.0, (b, *(n - (x == c) for x, n in enumerate(at))): -1.0}
                terms |= {(c, *at): 1.0, (c, *(n - (x == b) for x, n in enumerate(at))): -1.0}
                self.add_stress(terms, at, (b, c), number, 2.0 * wall_share)
        self.mass = np.zeros(size)
        for (a, *at), n in self.index.items():
            if self.role[(a, *at)] == 1:
                share, _ = self.volume(at, (a,))
                if share > 0 or self.stiffness[n, n] > 0:
                    self.mass[n] = max(share, 0.01)

    def add_stress(self, terms, at, axes, factor, at_wall):
        """Energy factor / 2 V nu (sum of terms)^2, if no term is air and one is sought."""
        codes = [self.role.get(f, 0) for f in terms]
        if any(c in (0, 4) for c in codes) or 1 not in codes:
            return
        share, viscosity = self.volume(at, axes)
        row = np.zeros(len(self.index))
        for face, sign in terms.items():
            row[self.index[face]] = sign
        self.stiffness += factor * (at_wall if 3 in codes else 1.0) * share * viscosity * np.outer(row, row)

    def times(self, velocity):
        x = np.concatenate([c.ravel() for c in velocity.components]).astype(float)
        return np.where(self.mass > 0, self.mass * x + self.stiffness @ x, 0.0)

    def solution(self, velocity):
        x = np.concatenate([c.ravel() for c in velocity.components]).astype(float)
        x = np.where([self.role[f] in (1, 2, 3) for f in self.index], x, 0.0)
        s = self.mass > 0
        rhs = self.mass[s] * x[s] - self.stiffness[np.ix_(s, ~s)] @ x[~s]
        out = x.copy()
        out[s] = np.linalg.solve(np.diag(self.mass[s]) + self.stiffness[np.ix_(s, s)], rhs)
        return out, s


def boxed(system, region, velocity):
    """The components in the box of the system, stacked."""
    out = np.stack([region.crop(c, 0.0, np.float64) for c in velocity.components])
    return np.where(system.roles != kernels.AIR, out, 0.0)


@pytest.mark.parametrize("cut", [True, False], ids=["surface through cells", "whole cells"])
@pytest.mark.parametrize("wall_share", [0.0, 0.4, 1.0])
def test_operator_is_that_of_the_energy(cut, wall_share):
    grid, distance, roles, viscosity = random_pool()
    twin = PlainTwin(
        grid, roles, viscosity=viscosity, number=30.0, wall_share=wall_share, distance=distance * 10 if cut else None
    )
    system, region = build_system(
        roles, viscosity=viscosity, number=30.0, wall_share=wall_share, liquid_distance=distance * 10 if cut else None
    )
    velocity = random_velocity(grid)
    x = boxed(system, region, velocity)
    out = np.zeros_like(x)
    kernels.apply(x, out, *system.operator)
    expected = twin.times(velocity)
    largest = np.abs(expected).max()
    assert np.count_nonzero(system.mass) == np.count_nonzero(twin.mass) > 100
    for (a, *at), n in twin.index.items():
        local = tuple(m - low for m, low in zip(at, region.low))
        inside = all(0 <= m < size for m, size in zip(local, system.shape))
        # the weights are float32
        assert abs((out[(a, *local)] if inside else 0.0) - expected[n]) < 1e-6 * largest


@pytest.mark.parametrize("number", [0.5, 300.0], ids=["diagonal preconditioner", "multigrid preconditioner"])
@pytest.mark.parametrize("cut", [True, False], ids=["surface through cells", "whole cells"])
def test_solution_is_that_of_the_dense_matrix(number, cut):
    grid, distance, roles, viscosity = random_pool()
    velocity = random_velocity(grid)
    twin = PlainTwin(
        grid, roles, viscosity=viscosity, number=number, wall_share=0.7, distance=distance * 10 if cut else None
    )
    expected, solved = twin.solution(velocity)
    new, (report,) = diffuse(
        velocity, roles, viscosity=viscosity, dt=number * grid.spacing**2, spacing=grid.spacing, wall_share=0.7,
        liquid_distance=distance if cut else None, tolerance=1e-8,
    )  # fmt: skip
    assert report.converged
    found = np.concatenate([c.ravel() for c in new.components])
    # float32 weights and result; the largest velocities are near 3
    np.testing.assert_allclose(found[solved], expected[solved], atol=2e-5)
    before = np.concatenate([c.ravel() for c in velocity.components])
    untouched = ~solved & ~np.array([twin.role[f] == 4 for f in twin.index])
    np.testing.assert_array_equal(found[untouched], before[untouched])


def test_share_of_a_cube_cut_by_a_plane_is_that_of_many_points():
    rng = np.random.default_rng(3)
    axis = (np.arange(48) + 0.5) / 48 - 0.5
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    slopes = [rng.normal(size=3) for _ in range(20)] + [
        np.array(g, float) for g in ((1, 0, 0), (0, -1, 1e-5), (0, 0, 0))
    ]
    for g in slopes:
        for value in np.append(rng.uniform(-0.9, 0.9, 4), 0.0) * max(np.abs(g).sum() / 2, 1.0):
            counted = np.mean(value + points @ g < 0)
            # a plane along an axis lies between two layers of points at best
            assert abs(cut_share(value, *g) - counted) < 0.5 / 48 + 1e-3 or not np.any(g)


def test_control_volumes_hold_the_volume_of_a_ball():
    grid = Grid((20, 20, 20), 1.0)
    radius = 6.3
    distance = np.linalg.norm(grid.centers() - (10.1, 9.7, 10.3), axis=-1) - radius
    octants = octant_shares(distance, np.zeros(grid.shape, bool))
    # linear between samples a quarter of a cell off, a curved distance is too large by 3/32 of its Laplacian, 2 / R
    seen = radius - 3 / 32 * 2 / radius
    assert octants.sum() / 8 == pytest.approx(4 / 3 * np.pi * seen**3, rel=2e-3)


def test_a_sheet_thinner_than_a_cell_keeps_its_thickness():
    z = np.arange(9) - 4.0
    distance = np.broadcast_to(np.abs(z) - 0.4, (5, 5, 9)).copy()
    octants = octant_shares(distance, np.zeros(distance.shape, bool))
    # piecewise linear between the samples, as the distance itself: exact
    np.testing.assert_allclose(octants[2, 2].sum() / 8, 0.8, atol=1e-3)


def test_a_free_liquid_keeps_momentum_and_angular_momentum():
    grid = Grid((12, 11, 13), 0.1)
    distance = np.linalg.norm(grid.centers() - (0.6, 0.56, 0.63), axis=-1) - 0.38
    solved = wet_faces(distance < 0)
    roles = FaceRoles(solved, nothing(grid), nothing(grid))
    velocity = random_velocity(grid)
    new, (report,) = diffuse(
        velocity, roles, viscosity=50.0, dt=0.04, spacing=grid.spacing, wall_share=1.0, liquid_distance=distance,
        tolerance=1e-7,
    )  # fmt: skip
    assert report.converged
    masses = face_masses(grid, roles, distance)
    for quantity in (momentum, angular_momentum):
        before, after = quantity(grid, masses, velocity), quantity(grid, masses, new)
        # the tolerance of the solve, over the root of the number of faces
        np.testing.assert_allclose(after, before, atol=1e-5 * np.abs(before).max())


def face_masses(grid, roles, distance):
    system, region = build_system(
        roles, viscosity=1.0, number=1.0, wall_share=1.0, liquid_distance=distance / grid.spacing
    )  # fmt: skip
    out = []
    for a in range(3):
        full = np.zeros(grid.face_shape(a))
        for at in np.argwhere(system.mass[a] > 0):
            full[tuple(at + region.low)] = system.mass[(a, *at)]
        out.append(full)
    return out


def momentum(grid, masses, velocity):
    return np.array([(m * c).sum() for m, c in zip(masses, velocity.components)])


def angular_momentum(grid, masses, velocity):
    total = np.zeros(3)
    for a, (m, c) in enumerate(zip(masses, velocity.components)):
        total += np.cross(grid.faces(a), np.eye(3)[a] * (m * c)[..., None]).sum((0, 1, 2))
    return total


def test_a_liquid_as_stiff_as_glass_moves_as_a_rigid_body():
    grid = Grid((12, 11, 13), 0.1)
    distance = np.linalg.norm((grid.centers() - (0.6, 0.56, 0.63)) / (1, 1, 1.3), axis=-1) - 0.36
    roles = FaceRoles(wet_faces(distance < 0), nothing(grid), nothing(grid))
    velocity = random_velocity(grid)
    new, (report,) = diffuse(
        velocity, roles, viscosity=1e5, dt=0.1, spacing=grid.spacing, wall_share=1.0, liquid_distance=distance,
        tolerance=1e-7,
    )  # fmt: skip
    assert report.converged
    masses = face_masses(grid, roles, distance)
    # the rigid motion that is nearest in kinetic energy
    rows, values, weights = [], [], []
    for a in range(3):
        x = grid.faces(a)[masses[a] > 0]
        turning = np.stack([np.cross(np.eye(3)[b], x)[:, a] for b in range(3)], -1)
        rows.append(np.hstack([np.tile(np.eye(3)[a], (len(x), 1)), turning]))
        values.append(velocity.components[a][masses[a] > 0])
        weights.append(masses[a][masses[a] > 0])
    rows, values, root = np.vstack(rows), np.concatenate(values), np.sqrt(np.concatenate(weights))
    motion = np.linalg.lstsq(rows * root[:, None], values * root, rcond=None)[0]
    found = np.concatenate([c[m > 0] for c, m in zip(new.components, masses)])
    # the remaining strain is of the order 1 / number = 1e-6
    np.testing.assert_allclose(found, rows @ motion, atol=1e-4)
    assert np.abs(rows @ motion).max() > 0.05


def test_walls_without_friction_let_the_flow_slip():
    grid = Grid((4, 4, 10), 0.1)
    walls, solved, fixed = nothing(grid), nothing(grid), nothing(grid)
    for a in range(3):
        solved[a][...] = True
    for a in range(2):
        walls[a][:, :, 0] = True
    fixed[2][:, :, :2] = True
    roles = FaceRoles(tuple(s & ~w & ~f for s, w, f in zip(solved, walls, fixed)), fixed, walls)
    velocity = FaceVelocity.zeros(grid)
    velocity.u[...] = np.where(walls[0], 0, 1)
    for share, kept in ((0.0, 1.0), (1.0, 0.5)):
        new, _ = diffuse(velocity, roles, viscosity=5.0, dt=0.01, spacing=0.1, wall_share=share)
        if share == 0.0:
            np.testing.assert_allclose(new.u, velocity.u, atol=1e-5)  # float32
        else:
            # by far the largest part of the boundary layer, sqrt(nu dt) = 2.2 cells, lies in the lower half
            assert new.u[2, 2, 1] < kept and new.u[2, 2, -1] > 0.9


def test_negligible_viscosity_changes_nothing():
    grid = Grid((4, 4, 4), 0.1)
    velocity = random_velocity(grid)
    roles = FaceRoles(tuple(~m for m in nothing(grid)), nothing(grid), nothing(grid))
    new, reports = diffuse(velocity, roles, viscosity=1e-6, dt=0.01, spacing=0.1, wall_share=1.0)
    assert new is velocity and reports == ()


def test_liquid_that_is_nowhere_is_no_fault():
    grid = Grid((4, 4, 4), 0.1)
    velocity = random_velocity(grid)
    new, reports = diffuse(
        velocity, FaceRoles(nothing(grid), nothing(grid), nothing(grid)), viscosity=1.0, dt=0.01, spacing=0.1,
        wall_share=1.0,
    )  # fmt: skip
    assert new is velocity and reports == ()


@pytest.mark.parametrize(
    "wrong",
    [{"viscosity": -1.0}, {"viscosity": np.ones((3, 3, 3))}, {"viscosity": np.nan}, {"wall_share": 1.5},
     {"liquid_distance": np.zeros((5, 4, 4))}],
)  # fmt: skip
def test_wrong_arguments_are_refused(wrong):
    grid = Grid((4, 4, 4), 0.1)
    roles = FaceRoles(tuple(~m for m in nothing(grid)), nothing(grid), nothing(grid))
    arguments = {"viscosity": 1.0, "wall_share": 1.0, "dt": 0.1, "spacing": 0.1} | wrong
    with pytest.raises(ValueError):
        diffuse(random_velocity(grid), roles, **arguments)
