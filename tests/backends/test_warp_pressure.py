"""The projection in Warp (here on its CPU device) is that of `physics.pressure`."""

import numpy as np
import pytest

from fluidlift.backends.warp_device import warp_device
from fluidlift.physics import boundaries, free_surface, pressure
from fluidlift.types import CellType, FaceVelocity, Grid, triple

warp = pytest.importorskip("warp")

from fluidlift.backends.warp_pressure import WarpPressure  # noqa: E402

GRID = Grid((11, 8, 13), 0.1)
DEVICE = warp_device("cpu")


def on_device(values, dtype=None):
    return warp.array(np.ascontiguousarray(values), dtype=dtype or warp.float32, device=DEVICE)


def faces(values):
    return triple(on_device(v) for v in values)


def marks(values):
    return triple(on_device(np.asarray(v, np.uint8), warp.uint8) for v in values)


def random_layout(seed):
    """Types of all kinds anyhow, openings of which a third are closed, and distances that change sign with them."""
    rng = np.random.default_rng(seed)
    types = rng.choice(5, size=GRID.shape, p=[0.25, 0.5, 0.1, 0.07, 0.08]).astype(np.uint8)
    openings = [np.maximum(rng.uniform(-0.5, 1, GRID.face_shape(a)), 0).astype(np.float32) for a in range(3)]
    distance = rng.uniform(0, 0.1, GRID.shape).astype(np.float32)
    distance[types == CellType.FLUID] *= -1
    distance[rng.uniform(size=GRID.shape) < 0.1] *= 1e-5  # gaps at their smallest
    return types, openings, distance, rng


def pool(seed=0):
    """Liquid over a bed, a surface that lies anywhere within its cells, inflow on one side and outflow on the other."""
    rng = np.random.default_rng(seed)
    i, j, k = np.indices(GRID.shape)
    depth = 8.3 + 0.8 * np.sin(0.7 * i) * np.cos(0.5 * j)
    distance = ((k + 0.5 - depth) * GRID.spacing).astype(np.float32)
    types = np.where(distance < 0, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    types[0][types[0] == CellType.FLUID] = CellType.INFLOW
    types[-1][types[-1] == CellType.FLUID] = CellType.OUTFLOW
    nodes = GRID.nodes() - GRID.low
    openings = boundaries.face_fractions(nodes[..., 2] - 0.13 - 0.1 * np.sin(5 * nodes[..., 0]))
    return types, openings, distance, rng


def device_system(types, openings, gaps=None, **options):
    out = WarpPressure(GRID.shape, GRID.spacing, DEVICE)
    given = [None if f is None else faces(f) for f in (openings, gaps)]
    out.build(on_device(types, warp.uint8), *given, **options)
    return out


@pytest.mark.parametrize("open_border", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_the_system_of_a_layout_is_the_same_to_the_last_bit(seed, open_border):
    types, openings, distance, _ = random_layout(seed)
    gaps = free_surface.surface_gaps(distance, types)
    for given, near in ((openings, gaps), (openings, None), (None, None)):
        wanted = pressure.build_system(types, given, GRID, open_border=open_border, gaps=near)
        ours = device_system(types, given, near, open_border=open_border)
        np.testing.assert_array_equal(ours.unknown.numpy().astype(bool), wanted.unknown)
        for a in range(3):
            np.testing.assert_array_equal(ours.openings[a].numpy(), wanted.openings[a])
            np.testing.assert_array_equal(ours.weights[a].numpy(), wanted.weights[a])
    assert wanted.unknown.any() and not wanted.unknown.all()


def test_held_faces_have_no_weight_but_stay_open():
    types, openings, _, rng = pool()
    held = [rng.uniform(size=GRID.face_shape(a)) < 0.2 for a in range(3)]
    free = pressure.build_system(types, openings, GRID)
    ours = device_system(types, openings, held=marks(held))
    np.testing.assert_array_equal(ours.unknown.numpy().astype(bool), free.unknown)
    for a in range(3):
        np.testing.assert_array_equal(ours.weights[a].numpy(), np.where(held[a], 0, free.weights[a]))
        np.testing.assert_array_equal(ours.openings[a].numpy(), free.openings[a])


@pytest.mark.parametrize("with_known", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_right_side_and_gradient_are_those_of_the_cpu(seed, with_known):
    types, openings, distance, rng = random_layout(seed)
    gaps = free_surface.surface_gaps(distance, types)
    wanted = pressure.build_system(types, openings, GRID, gaps=gaps)
    ours = device_system(types, openings, gaps)
    velocity = FaceVelocity(*(rng.normal(size=GRID.face_shape(a)).astype(np.float32) for a in range(3)))
    known = rng.normal(size=GRID.shape).astype(np.float32) if with_known else None
    there = None if known is None else on_device(known)
    ours.right_side(faces(velocity.components), there)
    rhs = -pressure.divergence(velocity, GRID, wanted)
    if known is not None:
        rhs = rhs + wanted.boundary_term(known)
    np.testing.assert_allclose(ours.rhs.numpy(), rhs, rtol=1e-6, atol=1e-6 * np.abs(rhs).max())

    q = rng.normal(size=GRID.shape).astype(np.float32)
    moved = faces(velocity.components)
    ours.subtract_gradient(moved, on_device(q), there)
    for a, new in enumerate(pressure.subtract_gradient(velocity, wanted, q, known).components):
        # a difference of two q over the gap: of both, and of the quotient weight / opening, the last bits may differ
        np.testing.assert_allclose(moved[a].numpy(), new, rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("with_known", [False, True])
def test_the_projection_is_that_of_the_cpu(with_known):
    types, openings, distance, rng = pool()
    gaps = free_surface.surface_gaps(distance, types)
    wanted = pressure.build_system(types, openings, GRID, gaps=gaps)
    ours = device_system(types, openings, gaps)
    velocity = FaceVelocity(*(rng.normal(size=GRID.face_shape(a)).astype(np.float32) for a in range(3)))
    known = np.where(types == CellType.OUTFLOW, rng.uniform(0, 0.1, GRID.shape), 0) if with_known else None
    new, q, report = pressure.project(velocity, wanted, tolerance=1e-7, known=known)
    moved, there = faces(velocity.components), None if known is None else on_device(np.float32(known))
    ours_q, ours_report = ours.solve(moved, tolerance=1e-7, known=there)
    assert report.converged and ours_report.converged
    np.testing.assert_allclose(ours_q.numpy(), q, atol=1e-6 * np.abs(q).max())
    ours.subtract_gradient(moved, ours_q, there)
    for a in range(3):
        np.testing.assert_allclose(moved[a].numpy(), new.components[a], atol=2e-5)  # of speeds up to 4 m/s
    left = pressure.divergence(FaceVelocity(*(m.numpy() for m in moved)), GRID, wanted)
    assert np.abs(left).max() < 1e-4 * np.abs(pressure.divergence(velocity, GRID, wanted)).max()


def test_cells_at_walls_that_suck_become_air():
    types, openings, _, rng = pool()
    ours = device_system(types, openings)
    unknown = ours.unknown.numpy().astype(bool)
    walls, q = rng.uniform(size=GRID.shape) < 0.4, rng.normal(size=GRID.shape).astype(np.float32)
    count = ours.release(on_device(walls.astype(np.uint8), warp.uint8), on_device(q), -0.5)
    sucked = unknown & walls & (q < -0.5)
    assert count == sucked.sum() > 0
    np.testing.assert_array_equal(ours.unknown.numpy().astype(bool), unknown & ~sucked)
    assert ours.release(on_device(walls.astype(np.uint8), warp.uint8), on_device(q), -0.5) == 0


def test_arrays_of_another_grid_are_refused():
    ours = WarpPressure(GRID.shape, GRID.spacing, DEVICE)
    other = warp.zeros((3, 3, 3), dtype=warp.uint8, device=DEVICE)
    with pytest.raises(ValueError, match="cell types"):
        ours.build(other)
    with pytest.raises(ValueError, match="numbers on faces"):
        ours.right_side(faces([np.zeros((2, 2, 2))] * 3))
