"""The surface of a liquid from its particles, and what the pressure solve makes of it."""

import numpy as np
import pytest
from scipy.special import erf

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics import surface_kernels, surface_plain
from fluidlift.physics.boundaries import mean_of_corners, touching_faces
from fluidlift.physics.free_surface import (
    SKIN,
    SMALLEST_GAP,
    continue_velocity,
    liquid_surface,
    pressure_cells,
    solid_shares,
    surface_gaps,
)
from fluidlift.physics.surface_tension import capillary_time_step, surface_tension_jumps
from fluidlift.physics.transfer import sort_by_cell
from fluidlift.types import CellType, FaceVelocity, Grid

N = 18
UNIT = Grid((N, N, N), 1.0)
OPEN = tuple(np.ones(UNIT.face_shape(a), np.float32) for a in range(3))


def far_solid(grid=UNIT):
    return np.full(tuple(n + 1 for n in grid.shape), 100.0, np.float32)


def jittered(inside, *, per_side=2, jitter=0.25, seed=0, grid=UNIT):
    """Points of a jittered lattice where inside(lattice point) holds, and the volume of each."""
    s = grid.spacing / per_side
    axes = [grid.low[a] + (np.arange(grid.shape[a] * per_side) + 0.5) * s for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    points = points[inside(points)]
    points = points + np.random.default_rng(seed).uniform(-jitter, jitter, points.shape) * s
    return points.astype(np.float32), np.full(len(points), s**3, np.float32)


def surface_of(points, volumes, *, grid=UNIT, solid=None, curved=False):
    solids = solid_shares(far_solid(grid) if solid is None else solid, grid)
    return liquid_surface(points, volumes, grid, sort_by_cell(points, grid), solids, curved=curved)


def places(distance, exact):
    """Exact distance (cells) of the points where the line between two cell centres near the surface crosses it."""
    out = []
    for axis in range(3):
        d, e = np.moveaxis(distance, axis, 0), np.moveaxis(exact, axis, 0)
        crossing = ((d[:-1] < 0) != (d[1:] < 0)) & (np.abs(e[1:]) < 2)
        share = d[:-1][crossing] / (d[:-1] - d[1:])[crossing]
        out.append(e[:-1][crossing] * (1 - share) + e[1:][crossing] * share)
    return np.concatenate(out)


def test_the_kernels_agree_with_the_formulas():
    grid = Grid((12, 9, 13), 0.1, (-0.3, 0.2, -0.1))
    x, rng = grid.nodes(), np.random.default_rng(0)
    bed = x[..., 2] - 0.33 - 0.4 * (x[..., 0] - 0.2)
    solid = np.minimum(bed, np.linalg.norm(x - np.array([0.3, 0.7, 0.5]), axis=-1) - 0.17).astype(np.float32)
    solids = solid_shares(solid, grid)
    assert set(np.unique(solids.layer)) == {0, 1, 2, 3, 4}
    volumes = surface_plain.open_volumes_plain(solid, grid)
    # float32 shares
    np.testing.assert_allclose(surface_plain.three_point_plain(volumes, 1 / 12), solids.open_share, atol=1e-6)
    points = rng.uniform(grid.low, grid.high, (4000, 3))
    use = (sample_nodes(solid, grid, points) > 0) & (points[:, 2] < 0.8 + 0.1 * np.sin(9 * points[:, 0]))
    points = points[use].astype(np.float32)
    amounts = rng.uniform(0.5, 1.5, len(points)).astype(np.float32) * grid.cells * 1e-3 / 4000
    fast = surface_of(points, amounts, grid=grid, solid=solid, curved=True)
    plain = surface_plain.liquid_surface_plain(points, amounts, grid, solids, curved=True)
    # single precision, and an error function with seven digits
    np.testing.assert_allclose(fast.distance, plain.distance, atol=1e-4 * grid.spacing)
    np.testing.assert_allclose(fast.curvature, plain.curvature, atol=1e-4 / grid.spacing)


@pytest.mark.parametrize(
    "per_side, spread, bias, noise",
    # measured 0.012, 0.065 and 0.05: the number of particles in the blur (sigma 0.87 cells) decides
    [(2, 0.0, 0.01, 0.02), (1, 0.0, 0.03, 0.08), (2, 0.5, 0.02, 0.07)],
    ids=["eight per cell", "one per cell", "masses between a half and three halves"],
)
@pytest.mark.parametrize("height", [7.0, 7.25, 7.5, 7.75])
def test_a_pool_has_its_surface_where_its_volume_says(per_side, spread, bias, noise, height):
    points, volumes = jittered(lambda p: p[:, 2] < 8.0, per_side=per_side)
    points[:, 2] += np.float32(height - 8.0)  # the lattice is moved, so that its layers lie anywhere in the cells
    keep = points[:, 2] > 0
    volumes *= np.random.default_rng(1).uniform(1 - spread, 1 + spread, len(volumes)).astype(np.float32)
    surface = surface_of(points[keep], volumes[keep])
    error = places(surface.distance, UNIT.centers()[..., 2] - height)
    assert len(error) >= N * N
    assert abs(error.mean()) < bias and error.std() < noise


@pytest.mark.parametrize("radius", [3.0, 4.0, 6.0])
def test_a_drop_has_its_surface_at_its_radius(radius):
    errors = []
    for seed in range(3):
        center = N / 2 + np.random.default_rng(seed).uniform(-0.5, 0.5, 3)
        points, volumes = jittered(lambda p, c=center: np.linalg.norm(p - c, axis=1) < radius, per_side=3, seed=seed)
        exact = np.linalg.norm(UNIT.centers() - center, axis=-1) - (0.75 * volumes.sum() / np.pi) ** (1 / 3)
        errors.append(places(surface_of(points, volumes).distance, exact))
    error = np.concatenate(errors)
    # the blur moves the surface by 3 / (4 radius) = 0.25 cells in the smallest drop, which is taken back
    assert abs(error.mean()) < 0.02 and error.std() < 0.04


@pytest.mark.parametrize("degrees", [20, 45, 70])
def test_a_level_surface_stays_level_up_to_a_sloping_bed(degrees):
    angle = np.radians(degrees)
    x = UNIT.nodes()
    # the bed meets the surface at x = 12
    height = 8.25
    solid = ((x[..., 2] - height) * np.cos(angle) - (x[..., 0] - 12.0) * np.sin(angle)).astype(np.float32)
    points, volumes = jittered(lambda p: p[:, 2] < height, per_side=4)
    points, volumes = (a[sample_nodes(solid, UNIT, points) > 0] for a in (points, volumes))
    error = surface_of(points, volumes, solid=solid).distance - (UNIT.centers()[..., 2] - height)
    bed = mean_of_corners(solid)
    # beyond the shore line there is neither water nor a face that water could pass
    near_surface = (np.abs(UNIT.centers()[..., 2] - height) < 1.0) & (UNIT.centers()[..., 0] < 12.5)
    outside, in_bed = near_surface & (bed > 0), near_surface & (bed < 0) & (bed > -0.6)
    assert outside.any()
    # worst in the last cells of the wedge of water on the flattest bed. Without virtual liquid the surface would be off
    # by half a cell near the bed, and undefined in it
    assert np.abs(error[outside]).max() < 0.3 and np.sqrt(np.square(error[outside]).mean()) < 0.08
    if in_bed.any():  # the steepest bed leaves no such cells
        assert np.abs(error[in_bed]).max() < 0.4


def test_a_thin_layer_has_its_depth():
    solid = (UNIT.nodes()[..., 2] - 4.37).astype(np.float32)
    for depth in (0.5, 1.0, 1.5):
        points, volumes = jittered(lambda p, d=depth: p[:, 2] < d, per_side=4)
        points[:, 2] += np.float32(4.37)
        error = places(surface_of(points, volumes, solid=solid).distance, UNIT.centers()[..., 2] - 4.37 - depth)
        assert abs(error.mean()) < 0.06  # the bed cuts its cells in octants


def test_no_liquid_no_surface():
    empty = surface_of(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), curved=True)
    assert (empty.distance > 0).all() and (empty.curvature == 0).all()


def test_spray_stays_liquid():
    points = np.array([[5.3, 6.2, 7.6]], np.float32)
    surface = surface_of(points, np.full(1, 0.125, np.float32))
    types = np.zeros(UNIT.shape, np.uint8)
    types[5, 6, 7] = CellType.FLUID
    new, distance = pressure_cells(types, surface.distance, OPEN, 1.0)
    assert (new == types).all() and distance[5, 6, 7] < 0 and (distance[types == 0] > 0).all()


def test_the_skin_of_a_pool_is_air_and_gaps_between_particles_are_liquid():
    height = np.broadcast_to(UNIT.centers()[..., 2] - 7.3, UNIT.shape)
    types = np.where(UNIT.centers()[..., 2] < 8, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    types[3, 3, 6] = CellType.EMPTY  # no particle there by chance
    new, distance = pressure_cells(types, height.astype(np.float32), OPEN, 1.0)
    assert (new[:, :, 7] == CellType.EMPTY).all() and (new[:, :, :7] == CellType.FLUID).all()
    np.testing.assert_array_equal(distance, height.astype(np.float32))
    closed = tuple(np.zeros_like(o) for o in OPEN)
    same, _ = pressure_cells(types, height.astype(np.float32), closed, 1.0)
    assert (same == types).all()  # liquid behind a wall does not count
    high = (UNIT.centers()[..., 2] - 7.5 + SKIN + 0.01).astype(np.float32)
    assert (pressure_cells(types, high, OPEN, 1.0)[0][:, :, 7] == CellType.FLUID).all()  # spray above the pool


def test_gaps_are_the_way_to_a_flat_surface():
    normal = np.array([0.3, -0.2, 0.9327])
    distance = ((UNIT.centers() - 9.1) @ normal).astype(np.float32)
    types = np.where(distance < 0, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    gaps = surface_gaps(distance, types)
    for axis in range(3):
        inner = np.moveaxis(gaps[axis], axis, 0)[1:-1]
        d, wet = np.moveaxis(distance, axis, 0), np.moveaxis(types, axis, 0) == CellType.FLUID
        surface = wet[:-1] != wet[1:]
        assert surface.any() and (inner[~surface] == 1).all()
        inside = np.where(wet[:-1], d[:-1], d[1:])[surface]
        # the distance falls by |normal| per cell
        exact = np.clip(-inside / abs(normal[axis]), SMALLEST_GAP, 1.0)
        np.testing.assert_allclose(inner[surface], exact, atol=1e-4)


def test_a_sphere_has_the_curvature_two_over_its_radius_and_a_plane_none():
    for radius in (4.0, 6.0):
        center = np.array([9.1, 8.8, 9.3])
        points, volumes = jittered(lambda p, r=radius, c=center: np.linalg.norm(p - c, axis=1) < r, per_side=3)
        surface = surface_of(points, volumes, curved=True)
        near = np.abs(surface.distance) < 0.5
        assert surface.curvature[near].mean() == pytest.approx(2 / radius, rel=0.04)
        # a force proportional to the curvature then varies by as little
        assert surface.curvature[near].std() < 0.2 * 2 / radius
    points, volumes = jittered(lambda p: p[:, 2] < 7.25)
    flat = surface_of(points, volumes, curved=True)
    near = np.abs(flat.distance) < 0.5
    # one over the radius of a drop of 30 cells; the noise of eight particles per cell
    assert np.abs(flat.curvature[near]).max() < 0.1 and abs(flat.curvature[near].mean()) < 0.01


def test_surface_tension_raises_the_pressure_of_a_drop_and_not_of_spray():
    center = np.array([9.1, 8.8, 9.3])
    points, volumes = jittered(lambda p: np.linalg.norm(p - center, axis=1) < 5.0, per_side=3)
    points = np.concatenate([points, np.array([[1.5, 1.5, 1.5]], np.float32)])
    surface = surface_of(points, np.append(volumes, np.float32(0.04)), curved=True)
    types = np.where(surface.distance < 0, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    types[1, 1, 1] = CellType.FLUID
    jumps = surface_tension_jumps(surface, types, 3.0)
    for axis, jump in enumerate(jumps):
        wet = np.moveaxis(types == CellType.FLUID, axis, 0)
        between = np.moveaxis(jump, axis, 0)[1:-1]
        assert (between[wet[1:] == wet[:-1]] == 0).all()
        assert (np.moveaxis(jump, axis, 0)[:4] == 0).all()  # the spray
        assert between[between != 0].mean() == pytest.approx(3.0 * 2 / 5.0, rel=0.04)


def test_the_capillary_time_step_resolves_the_shortest_wave():
    step = capillary_time_step(1000.0, 0.072, 1e-3)
    assert step == pytest.approx(np.sqrt(1000 * 1e-9 / (4 * np.pi * 0.072)))
    assert capillary_time_step(1000.0, 0.072, 4e-3) == pytest.approx(8 * step)
    assert capillary_time_step(1000.0, 0.0, 1e-3) == np.inf
    with pytest.raises(ValueError, match="surface tension"):
        capillary_time_step(1000.0, -0.1, 1e-3)


def random_faces(seed, dtype=np.float32):
    rng = np.random.default_rng(seed)
    return tuple(rng.normal(size=UNIT.face_shape(a)).astype(dtype) for a in range(3))


def test_the_continued_velocity_agrees_with_the_formula():
    rng = np.random.default_rng(5)
    velocity, carried = FaceVelocity(*random_faces(1)), FaceVelocity(*random_faces(2))
    masses = tuple(np.maximum(m, 0) for m in random_faces(3))
    openings = tuple(np.clip(o + 0.7, 0, 1).astype(np.float32) for o in random_faces(4))
    fluid = rng.random(UNIT.shape) < 0.2
    skin = (rng.random(UNIT.shape) < 0.2) & ~fluid
    wet = tuple(t & (o > 0) for t, o in zip(touching_faces(fluid), openings))
    fast = continue_velocity(velocity, carried, masses, wet, skin, openings)
    plain = surface_plain.continue_velocity_plain(velocity, carried, masses, wet, skin, openings)
    for a, b in zip(fast.components, plain.components):
        np.testing.assert_allclose(a, b, atol=1e-5)  # float32


def test_the_skin_of_a_pool_at_rest_does_not_fall():
    wet = touching_faces(UNIT.centers()[..., 2] < 7)
    skin = np.zeros(UNIT.shape, bool)
    skin[:, :, 7] = True
    carried = FaceVelocity.zeros(UNIT)
    fallen = FaceVelocity(carried.u, carried.v, np.where(wet[2], 0.0, -0.1).astype(np.float32))  # pressure holds wet
    masses = tuple(np.ones_like(c) for c in carried.components)
    new = continue_velocity(fallen, carried, masses, wet, skin, OPEN)
    assert all((c == 0).all() for c in new.components)


def test_wrong_arrays_are_refused():
    points = np.ones((3, 3), np.float32)
    solids = solid_shares(far_solid(), UNIT)
    with pytest.raises(ValueError, match="volumes"):
        liquid_surface(points, np.ones(2, np.float32), UNIT, sort_by_cell(points, UNIT), solids)
    with pytest.raises(ValueError, match="distance"):
        solid_shares(np.zeros((3, 3, 3)), UNIT)


def test_the_inverse_error_function_inverts():
    for value in (-2.0, -0.5, 0.0, 1e-3, 1.0, 2.3):
        assert surface_kernels.inverse_error_function(erf(value)) == pytest.approx(value, rel=1e-5, abs=1e-6)
