"""The kernels at walls and beyond the liquid compute what their plain twins say, on the CPU and in Warp."""

import numpy as np
import pytest

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics import boundaries
from fluidlift.physics.boundaries_plain import collide_plain, extrapolate_plain, slide_along_walls_plain
from fluidlift.seams import MoveRules
from fluidlift.types import CellType, FaceVelocity, Grid, Particles, Terrain, TriangleMesh

GRIDS = [Grid((9, 7, 8), 0.1, (0.3, -2.0, 0.0)), Grid((4, 15, 6), 1.3)]
DT = 0.02


def walls_of(grid, shape, seed):
    """A bed that is flat, tilted, rough or a ball, an inlet and an outlet, and an open top."""
    rng = np.random.default_rng(seed)
    x = (grid.nodes() - grid.low) / (grid.high - grid.low)
    distance = {
        "flat": x[..., 2] - 0.3,
        "tilted": 0.6 * x[..., 2] - 0.4 * x[..., 0] + 0.3 * x[..., 1] - 0.1,
        "rough": x[..., 2] - 0.3 + rng.uniform(-0.1, 0.1, x.shape[:3]),
        "ball": np.linalg.norm(x - 0.5, axis=-1) - 0.3,
    }[shape] * (grid.high - grid.low).min()
    regions = np.zeros(grid.shape, np.uint8)
    regions[0], regions[-1] = CellType.INFLOW, CellType.OUTFLOW
    open_sides = np.zeros((3, 2), bool)
    open_sides[2, 1] = True
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    terrain = Terrain(grid, np.float32(distance), np.array([1.0, 0, 0]), mesh)
    return boundaries.build_walls(terrain, regions, open_sides)


def random_velocity(grid, seed):
    rng = np.random.default_rng(seed)
    return FaceVelocity(*(rng.normal(size=grid.face_shape(a)).astype(np.float32) for a in range(3)))


def flying(walls, seed, n=3000):
    """Particles outside the solid whose steps end anywhere, and their velocities before and after."""
    grid, rng = walls.grid, np.random.default_rng(seed)
    old = rng.uniform(grid.low, grid.high, (n, 3)).astype(np.float32)
    old = old[sample_nodes(walls.signed_distance, grid, old) > 1e-3 * grid.spacing]
    incoming = (grid.spacing / DT * rng.normal(size=old.shape)).astype(np.float32)
    velocities = (incoming + 0.3 * grid.spacing / DT * rng.normal(size=old.shape)).astype(np.float32)
    return old, incoming, velocities


def numba_collide(new, old, velocities, incoming, walls, *, dt, restitution, tangential_share):
    new, velocities = new.copy(), velocities.copy()
    boundaries.collide(
        new, old, velocities, incoming, walls, dt=dt, restitution=restitution, tangential_share=tangential_share
    )
    return new, velocities


def warp_collide(new, old, velocities, incoming, walls, *, dt, restitution, tangential_share):
    pytest.importorskip("warp")
    from fluidlift.backends.warp_particles import WarpMover

    n = len(old)
    unit = np.broadcast_to(np.eye(3, dtype=np.float32), (n, 3, 3)).copy()
    labels = np.zeros(n, np.int64)
    particles = Particles(old, incoming, np.zeros_like(unit), unit, np.ones(n, np.float32), labels, labels)
    rules = MoveRules(dt, restitution, tangential_share, max_stretch=4.0)
    moved = WarpMover("cpu").moved(particles, new - old, velocities, particles.affine, walls, rules)
    return moved.positions, moved.velocities


@pytest.mark.parametrize("collide", [numba_collide, warp_collide], ids=["numba", "warp"])
@pytest.mark.parametrize("grid", GRIDS, ids=lambda g: str(g.shape))
@pytest.mark.parametrize(("shape", "seed"), [("flat", 0), ("tilted", 1), ("rough", 2), ("ball", 3)])
def test_particles_collide_like_the_plain_model(collide, grid, shape, seed):
    walls = walls_of(grid, shape, seed)
    old, incoming, velocities = flying(walls, seed)
    new = (old + DT * velocities).astype(np.float32)
    # both add the step to the old place; so that both mean the same place, the step is the rounded one
    rules = {"dt": DT, "restitution": 0.4, "tangential_share": 0.7}
    got_x, got_v = collide(new, old, velocities, incoming, walls, **rules)
    x, v = collide_plain(new, old, velocities, incoming, walls, **rules)
    # A place is stored in single precision: 2^-24 of the coordinate. Up to six pushes follow gradients that differ by
    # as much per cell, up to 16 times the slope 1 between neighbours of a rough bed.
    rounding = 100 * 2.0**-24 * np.abs([grid.low, grid.high]).max()
    speed = grid.spacing / DT
    same_x = (np.abs(got_x - x) < rounding).all(axis=1)
    same_v = (np.abs(got_v - v) < 4 * rounding / grid.spacing * speed).all(axis=1)
    # A particle within rounding of a threshold may take either branch: the band is 1e-6 of a cell wide, the particles
    # are 3000. Both results are right for it.
    assert (~same_x).sum() <= 1 and (~same_v).sum() <= 1
    # the states have touched every branch
    changed = (x != new).any(axis=1)
    assert 0.02 < changed.mean() < 0.9 and (v != velocities).any(axis=1).mean() > 0.05
    # those that left the box are on their way to be removed; no terrain is known there
    inside = grid.contains(got_x)
    assert sample_nodes(walls.signed_distance, grid, got_x[inside]).min() >= 0 and inside.mean() > 0.5


@pytest.mark.parametrize("grid", [*GRIDS, Grid((1, 2, 1), 0.1)], ids=lambda g: str(g.shape))
@pytest.mark.parametrize("layers", [1, 3, 5])
def test_velocity_is_continued_like_the_plain_model(grid, layers):
    velocity, rng = random_velocity(grid, 5), np.random.default_rng(layers)
    valid = tuple(rng.uniform(size=grid.face_shape(a)) < 0.05 for a in range(3))
    got, plain = boundaries.extrapolate(velocity, valid, layers), extrapolate_plain(velocity, valid, layers)
    for a, b, known, original in zip(got.components, plain.components, valid, velocity.components):
        # one rounding of numbers up to 4 per layer
        np.testing.assert_allclose(a, b, atol=layers * 4 * 2.0**-23)
        np.testing.assert_array_equal(a[known], original[known])


@pytest.mark.parametrize("grid", GRIDS, ids=lambda g: str(g.shape))
@pytest.mark.parametrize(("shape", "seed"), [("flat", 0), ("tilted", 1), ("rough", 2), ("ball", 3)])
def test_velocity_slides_like_the_plain_model(grid, shape, seed):
    walls, velocity = walls_of(grid, shape, seed), random_velocity(grid, seed)
    got, plain = boundaries.slide_along_walls(velocity, walls), slide_along_walls_plain(velocity, walls)
    changed = 0
    for a, b, c in zip(got.components, plain.components, velocity.components):
        np.testing.assert_allclose(a, b, atol=3e-6)  # float32 sums of a dozen numbers up to 4
        changed += int((a != c).sum())
    assert changed > 20


def test_particles_go_the_same_way_whether_or_not_they_are_drawn_out():
    from fluidlift.physics.numba_particles import NumbaMover

    walls = walls_of(GRIDS[0], "rough", 2)
    old, incoming, velocities = flying(walls, 2)
    n, labels = len(old), np.zeros(len(old), np.int64)
    unit = np.broadcast_to(np.eye(3, dtype=np.float32), (n, 3, 3)).copy()
    shear = np.zeros_like(unit)
    shear[:, 0, 1] = 5.0
    particles = Particles(old, incoming, shear, unit, np.ones(n, np.float32), labels, labels)
    moves = (DT * velocities).astype(np.float32)
    drawn, left = (
        NumbaMover().moved(particles, moves, velocities, shear, walls, MoveRules(DT, 0.3, 0.9, 4.0, deform))
        for deform in (True, False)
    )
    np.testing.assert_array_equal(drawn.positions, left.positions)
    np.testing.assert_array_equal(drawn.velocities, left.velocities)
    np.testing.assert_array_equal(left.deformation, unit)
    assert np.abs(drawn.deformation - unit).max() > 0.01
