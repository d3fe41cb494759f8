"""The viscous operator: against its plain twin, and what a minimum of energy must do."""

from dataclasses import replace

import numba
import numpy as np
import pytest

from fluidlift.physics import stress_kernels as kernels
from fluidlift.physics.liquid_fractions import octant_shares
from fluidlift.physics.stress_multigrid import SMALL, build_levels, v_cycle
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
    solid = grid.nodes() @ np.array([-0.3, 0.2, 0.93]) - 0.16  # a plane not far from the floor
    cut = {"liquid_distance": distance, "solid_distance": solid}
    return grid, masks, viscosity, cut


class PlainTwin:
    """The same minimum, written down stress by stress on the whole grid, as a dense matrix over all faces."""

    def __init__(self, grid, roles, *, viscosity, number, wall_share):
        self.grid, self.role = grid, {}
        self.solid = None if roles.solid_distance is None else roles.solid_distance / grid.spacing
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
        if roles.liquid_distance is None:
            full = [not closed[c] and not air[c] for c in np.ndindex(grid.shape)]
            self.octants = np.repeat(np.reshape(full, grid.shape)[..., None].astype(float), 8, -1)
        else:
            ring = np.pad(self.excluded, 1, constant_values=True)
            self.octants = octant_shares(np.pad(roles.liquid_distance / grid.spacing, 1, mode="edge"), ring)[
                1:-1, 1:-1, 1:-1
            ]
        self.buried = [f for f in self.index if self.role[f] == 1 and self.clearance(f) <= 0 and wall_share > 0]
        for face in self.buried:
            self.role[face] = 3
        self.assemble(number, wall_share)

    def clearance(self, face):
        """Of the centre of a face from walls, in cells."""
        if self.solid is None:
            return -0.5 if self.role[face] == 3 else 0.5
        a, *at = face
        return self.solid[tuple(slice(n, n + 1 + (b != a)) for b, n in enumerate(at))].mean()

    def gap(self, pair):
        """Cells from a face to the wall in which the other one lies, 1 if there is no wall between them."""
        walls = [f for f in pair if self.role[f] == 3]
        if len(walls) != 1:
            return 1.0
        behind = self.clearance(walls[0])
        (outside,) = (self.clearance(f) for f in pair if f != walls[0])
        return 0.5 if outside <= behind else min(max(outside / (outside - behind), 0.05), 1.0)

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
                self.add_stress(terms, at, (b, c), number, wall_share)
        self.mass = np.zeros(size)
        for (a, *at), n in self.index.items():
            if self.role[(a, *at)] == 1:
                share, _ = self.volume(at, (a,))
                if share > 0 or self.stiffness[n, n] > 0:
                    self.mass[n] = max(share, 0.01)

    def add_stress(self, terms, at, axes, factor, wall_share):
        """Energy factor / 2 V nu (sum of terms)^2, if no term is air and one is sought; at a wall, over its gap."""
        codes = [self.role.get(f, 0) for f in terms]
        if any(c in (0, 4) for c in codes) or 1 not in codes:
            return
        share, viscosity = self.volume(at, axes)
        row = np.zeros(len(self.index))
        for face, sign in terms.items():
            row[self.index[face]] = sign
        if 3 in codes:
            faces = list(terms)
            factor *= wall_share / min(self.gap(faces[n : n + 2]) for n in range(0, len(faces), 2))
        self.stiffness += factor * share * viscosity * np.outer(row, row)

    def times(self, velocity):
        x = np.concatenate([c.ravel() for c in velocity.components]).astype(float)
        return np.where(self.mass > 0, self.mass * x + self.stiffness @ x, 0.0)

    def solution(self, velocity):
        x = np.concatenate([c.ravel() for c in velocity.components]).astype(float)
        x = np.where([self.role[f] in (1, 2, 3) and f not in self.buried for f in self.index], x, 0.0)
        s = self.mass > 0
        rhs = self.mass[s] * x[s] - self.stiffness[np.ix_(s, ~s)] @ x[~s]
        out = x.copy()
        out[s] = np.linalg.solve(np.diag(self.mass[s]) + self.stiffness[np.ix_(s, s)], rhs)
        return out, s


def boxed(system, region, velocity):
    """The components in the box of the system, stacked."""
    out = np.stack([region.crop(c, 0.0, np.float64) for c in velocity.components])
    return np.where(system.roles != kernels.AIR, out, 0.0)


WHAT_CUTS = pytest.mark.parametrize(
    "known", [(), ("liquid_distance",), ("liquid_distance", "solid_distance")],
    ids=["whole cells", "surface through cells", "surface and walls through cells"],
)  # fmt: skip


@WHAT_CUTS
@pytest.mark.parametrize("wall_share", [0.0, 0.4, 1.0])
def test_operator_is_that_of_the_energy(known, wall_share):
    grid, roles, viscosity, cut = random_pool()
    roles = replace(roles, **{k: cut[k] for k in known})
    twin = PlainTwin(grid, roles, viscosity=viscosity, number=30.0, wall_share=wall_share)
    system, region, buried = build_system(
        roles, viscosity=viscosity, dt=30.0 * grid.spacing**2, spacing=grid.spacing, wall_share=wall_share
    )
    assert np.count_nonzero(buried) == len(twin.buried)
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
@WHAT_CUTS
def test_solution_is_that_of_the_dense_matrix(number, known):
    grid, roles, viscosity, cut = random_pool()
    velocity = random_velocity(grid)
    roles = replace(roles, **{k: cut[k] for k in known})
    twin = PlainTwin(grid, roles, viscosity=viscosity, number=number, wall_share=0.7)
    expected, solved = twin.solution(velocity)
    new, (report,) = diffuse(
        velocity, roles, viscosity=viscosity, dt=number * grid.spacing**2, spacing=grid.spacing, wall_share=0.7,
        tolerance=1e-8,
    )  # fmt: skip
    assert report.converged
    found = np.concatenate([c.ravel() for c in new.components])
    # float32 weights and result; the largest velocities are near 3
    np.testing.assert_allclose(found[solved], expected[solved], atol=2e-5)
    before = np.concatenate([c.ravel() for c in velocity.components])
    untouched = ~solved & ~np.array([twin.role[f] == 4 or f in twin.buried for f in twin.index])
    np.testing.assert_array_equal(found[untouched], before[untouched])


def test_a_free_liquid_keeps_momentum_and_angular_momentum():
    grid = Grid((12, 11, 13), 0.1)
    distance = np.linalg.norm(grid.centers() - (0.6, 0.56, 0.63), axis=-1) - 0.38
    solved = wet_faces(distance < 0)
    roles = FaceRoles(solved, nothing(grid), nothing(grid), distance)
    velocity = random_velocity(grid)
    new, (report,) = diffuse(
        velocity, roles, viscosity=50.0, dt=0.04, spacing=grid.spacing, wall_share=1.0,
        tolerance=1e-7,
    )  # fmt: skip
    assert report.converged
    masses = face_masses(grid, roles)
    for quantity in (momentum, angular_momentum):
        before, after = quantity(grid, masses, velocity), quantity(grid, masses, new)
        # the tolerance of the solve, over the root of the number of faces
        np.testing.assert_allclose(after, before, atol=1e-5 * np.abs(before).max())


def face_masses(grid, roles):
    system, region, _ = build_system(
        roles, viscosity=1.0, dt=1.0, spacing=grid.spacing, wall_share=1.0
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
    roles = FaceRoles(wet_faces(distance < 0), nothing(grid), nothing(grid), distance)
    velocity = random_velocity(grid)
    new, (report,) = diffuse(
        velocity, roles, viscosity=1e5, dt=0.1, spacing=grid.spacing, wall_share=1.0,
        tolerance=1e-7,
    )  # fmt: skip
    assert report.converged
    masses = face_masses(grid, roles)
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


def test_the_cycle_is_symmetric_and_positive():
    _, roles, viscosity, cut = random_pool()
    system, _, _ = build_system(replace(roles, **cut), viscosity=viscosity, dt=3.0, spacing=0.1, wall_share=0.7)
    levels = build_levels(system)
    assert len(levels) > 1
    rng = np.random.default_rng(5)
    a, b = (rng.normal(size=system.mass.shape) * (system.mass > 0) for _ in range(2))

    def cycled(r):
        levels[0].rhs[...] = r
        levels[0].x[...] = 0.0
        v_cycle(levels)
        return levels[0].x.astype(float)

    once = cycled(a)
    # single precision, in numbers of order one
    assert (b * once).sum() == pytest.approx((a * cycled(b)).sum(), rel=1e-4)
    assert (a * once).sum() > 0
    assert not once[system.mass == 0].any()


def test_iterations_hardly_grow_with_the_resolution():
    counts = []
    for n in (12, 24):
        grid = Grid((n, n, n), 1.0 / n)
        distance = np.linalg.norm(grid.centers() - (0.5, 0.48, 0.52), axis=-1) - 0.4
        roles = FaceRoles(wet_faces(distance < 0), nothing(grid), nothing(grid), distance)
        _, (report,) = diffuse(
            random_velocity(grid), roles, viscosity=1.0, dt=1.0, spacing=grid.spacing, wall_share=1.0,
        )  # fmt: skip
        assert report.converged
        counts.append(report.iterations)
    # with the diagonal alone they would double
    assert counts[1] < 1.5 * counts[0] and counts[1] < 20


def test_the_number_of_threads_changes_nothing():
    n = 32
    grid = Grid((n, n, n), 1.0 / n)
    distance = np.linalg.norm(grid.centers() - (0.5, 0.48, 0.52), axis=-1) - 0.45
    roles = FaceRoles(wet_faces(distance < 0), nothing(grid), nothing(grid), distance)
    assert grid.cells > SMALL  # smaller ones are left to one thread anyway
    results = []
    before = numba.get_num_threads()
    try:
        for threads in {1, before}:
            numba.set_num_threads(threads)
            new, _ = diffuse(
                random_velocity(grid), roles, viscosity=0.02, dt=1.0, spacing=grid.spacing, wall_share=1.0,
            )  # fmt: skip
            results.append(new)
    finally:
        numba.set_num_threads(before)
    for a in range(3):
        np.testing.assert_array_equal(results[0].components[a], results[-1].components[a])


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
     {"liquid_distance": np.zeros((5, 4, 4))}, {"solid_distance": np.zeros((4, 4, 4))},
     {"solved": nothing(Grid((4, 4, 5), 0.1))}],
)  # fmt: skip
def test_wrong_arguments_are_refused(wrong):
    grid = Grid((4, 4, 4), 0.1)
    roles = FaceRoles(tuple(~m for m in nothing(grid)), nothing(grid), nothing(grid))
    arguments = {"viscosity": 1.0, "wall_share": 1.0, "dt": 0.1, "spacing": 0.1}
    with pytest.raises(ValueError):
        wrong_roles = {k: v for k, v in wrong.items() if k not in arguments}
        arguments |= {k: v for k, v in wrong.items() if k in arguments}
        diffuse(random_velocity(grid), replace(roles, **wrong_roles), **arguments)
