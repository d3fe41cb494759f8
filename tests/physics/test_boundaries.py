"""Walls, free surfaces, inlet and outlet of the particle simulators."""

import numpy as np
import pytest

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics import boundaries
from fluidlift.physics.boundaries import cell_capacity
from fluidlift.physics.emitter import PHASES
from fluidlift.physics.forces import add_buoyancy, add_gravity
from fluidlift.physics.inlet import Inlet, random_fluctuation
from fluidlift.physics.outlet import hold_columns, outlet_heads, surface_heights, water_levels
from fluidlift.physics.position_correction import (
    fill_ratio,
    limited_moves,
    limited_moves_plain,
    spreading,
)
from fluidlift.physics.pressure import build_system
from fluidlift.physics.transfer import sort_by_cell
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Terrain, TriangleMesh

GRID = Grid((8, 6, 7), 0.1)
CLOSED = np.zeros((3, 2), bool)


def terrain_of(distance):
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    return Terrain(GRID, np.float32(distance), np.array([1.0, 0, 0]), mesh)


def walls_of(distance=None, regions=None):
    distance = GRID.nodes()[..., 2] - 0.2 if distance is None else distance
    regions = np.zeros(GRID.shape, np.uint8) if regions is None else regions
    return boundaries.build_walls(terrain_of(distance), regions, CLOSED)


def test_a_flat_bed_closes_the_cells_below_it():
    walls = walls_of()
    assert walls.solid[:, :, :2].all() and not walls.solid[:, :, 2:].any()
    np.testing.assert_allclose(walls.normals[2][:, :, 2], np.broadcast_to([0, 0, 1], (8, 6, 3)), atol=1e-6)


def test_closed_sides_stay_open_where_fluid_passes():
    regions = np.zeros(GRID.shape, np.uint8)
    regions[-1, :, 2:5] = CellType.OUTFLOW
    opening = walls_of(regions=regions).openings[0]
    assert (opening[-1, :, 2:5] > 0.99).all() and (opening[-1, :, 5:] == 0).all() and (opening[0] == 0).all()


def test_gaps_between_particles_are_liquid_and_bubbles_are_not():
    occupied = np.zeros(GRID.shape, bool)
    occupied[1:7, :, 2:6] = True
    occupied[3, 3, 3] = False  # one missing cell
    occupied[5, 2:4, 3:5] = False  # a bubble of four
    types = boundaries.liquid_cells(occupied, walls_of())
    assert types[3, 3, 3] == CellType.FLUID and (types[5, 2:4, 3:5] == CellType.EMPTY).all()
    assert (types[:, :, :2] == CellType.SOLID).all() and types[0, 0, 3] == CellType.EMPTY


def test_slivers_above_a_cut_bed_are_liquid_where_liquid_lies_on_them():
    walls = walls_of(GRID.nodes()[..., 2] - 0.19)  # a tenth of cell layer 1 is open
    occupied = np.zeros(GRID.shape, bool)
    occupied[:4, :, 2] = True
    types = boundaries.liquid_cells(occupied, walls)
    assert (types[:4, :, 1] == CellType.FLUID).all() and (types[5:, :, 1] == CellType.EMPTY).all()


def test_extrapolation_continues_a_constant_and_leaves_known_values():
    rng = np.random.default_rng(0)
    velocity = FaceVelocity(*(np.full(GRID.face_shape(a), 2.5, np.float32) for a in range(3)))
    valid = tuple(rng.uniform(size=GRID.face_shape(a)) < 0.3 for a in range(3))
    new = boundaries.extrapolate(velocity, valid, layers=8)
    for c in new.components:
        np.testing.assert_allclose(c, 2.5, rtol=1e-6)
    near = boundaries.extrapolate(velocity, tuple(np.zeros_like(v) for v in valid))
    assert all((c == 0).all() for c in near.components)


def test_velocity_slides_along_a_tilted_wall():
    normal = np.array([-0.6, 0.0, 0.8])
    distance = (GRID.nodes() - np.array([0.4, 0.3, 0.35])) @ normal
    walls = walls_of(distance)
    velocity = FaceVelocity(*(np.full(GRID.face_shape(a), s, np.float32) for a, s in enumerate((1.0, 0.3, -0.7))))
    new = boundaries.slide_along_walls(velocity, walls)
    tangent = np.array([1.0, 0.3, -0.7]) - np.dot([1.0, 0.3, -0.7], normal) * normal
    for axis in range(3):
        inside = (walls.openings[axis] == 0) & (np.abs(walls.normals[axis] @ normal - 1) < 1e-3)
        assert inside.any()
        np.testing.assert_allclose(new.components[axis][inside], tangent[axis], atol=1e-4)


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_a_particle_that_flies_into_the_bed_bounces(restitution):
    old = np.array([[0.4, 0.3, 0.22]], np.float32)
    incoming = np.array([[1.0, 0.0, -4.0]], np.float32)
    velocities, new = incoming.copy(), old + 0.02 * incoming
    boundaries.collide(
        new, old, velocities, incoming, walls_of(), dt=0.02, restitution=restitution, tangential_share=1.0
    )
    np.testing.assert_allclose(velocities[0], [1.0, 0.0, 4.0 * restitution], atol=1e-5)
    assert new[0, 2] > 0.2


def test_wall_damping_fades_with_distance():
    old = np.array([[0.4, 0.3, z] for z in (0.2001, 0.25, 0.35)], np.float32)
    velocities = np.tile(np.float32([1.0, 0.0, 0.0]), (3, 1))
    new = old.copy()
    boundaries.collide(
        new, old, velocities, velocities.copy(), walls_of(), dt=0.01, restitution=0.0, tangential_share=0.6
    )
    np.testing.assert_allclose(velocities[:, 0], [0.6, 0.8, 1.0], atol=2e-3)


def test_no_particle_ends_in_a_rough_solid():
    rng = np.random.default_rng(0)
    distance = np.float32(GRID.nodes()[..., 2] - 0.3 + rng.uniform(-0.1, 0.1, GRID.nodes().shape[:3]))
    walls = walls_of(distance)
    points = rng.uniform(GRID.low + 0.01, GRID.high - 0.01, (4000, 3)).astype(np.float32)
    old = points[sample_nodes(distance, GRID, points) > 0]
    incoming = rng.normal(scale=5, size=old.shape).astype(np.float32)
    new = (old + 0.02 * incoming).astype(np.float32)
    boundaries.collide(new, old, incoming.copy(), incoming, walls, dt=0.02, restitution=0.0, tangential_share=1.0)
    assert sample_nodes(distance, GRID, new).min() >= 0 and GRID.contains(new).all()


def inlet_of(profile=None, fluctuation=0.0, velocity=(2.0, 0.0, 0.0)):
    regions = np.zeros(GRID.shape, np.uint8)
    regions[:2, :, 2:] = CellType.INFLOW
    parameters = FluidParameters(inflow_velocity=velocity, inflow_fluctuation=fluctuation)
    return Inlet(walls_of(regions=regions), parameters, profile, 0, 8)


def test_the_inflow_profile_keeps_its_shape_and_gets_the_wanted_mean():
    rng = np.random.default_rng(1)
    profile = FaceVelocity(*(rng.uniform(0.5, 1.5, GRID.face_shape(a)).astype(np.float32) for a in range(3)))
    inlet = inlet_of(profile)
    centers = GRID.centers()[:2, :, 2:].reshape(-1, 3)
    got = inlet.velocity(centers, 0.0)
    np.testing.assert_allclose(got.mean(axis=0), [2.0, 0.0, 0.0], atol=1e-5)
    assert got.std(axis=0).min() > 0.05


def test_the_fluctuation_has_its_root_mean_square_and_no_divergence():
    rng = np.random.default_rng(3)
    waves = random_fluctuation(1.0, 0.1, np.array([1.0, 0, 0]), 0.2, rng)
    points = rng.uniform(-20, 20, (4000, 3))
    values = np.concatenate([waves(points, t) for t in np.linspace(0, 30, 5)])
    # twelve waves sampled over many wavelengths
    assert np.sqrt((values**2).sum(axis=1).mean()) == pytest.approx(1.0, abs=0.05)
    step = 1e-5
    slope = sum(
        (waves(points + step * e, 0.3) - waves(points - step * e, 0.3))[:, a] / (2 * step)
        for a, e in enumerate(np.eye(3))
    )
    assert np.abs(slope).max() < 1e-6


def test_a_full_inlet_misses_nothing_and_an_empty_one_all():
    inlet, rng = inlet_of(), np.random.default_rng(0)
    new = inlet.missing(np.zeros((0, 3), np.float32), rng)
    assert len(new) == 2 * 6 * 5 * 8 and inlet.inside(new).all()
    assert len(inlet.missing(new, rng)) == 0
    half_gone = new[new[:, 1] < 0.3]
    assert len(inlet.missing(half_gone, rng)) == len(new) - len(half_gone)


@pytest.mark.parametrize("bulk", [(2.0, 0.0, 0.0), (-0.3, 0.1, -1.0)])
def test_an_inlet_that_runs_askew_has_all_the_places_of_its_lattice(bulk):
    regions = np.zeros(GRID.shape, np.uint8)
    steps = np.arange(6)
    regions[steps, steps, np.minimum(2 + steps, 6)] = CellType.INFLOW
    inlet = Inlet(walls_of(regions=regions), FluidParameters(inflow_velocity=bulk), None, 0, 8)
    for _ in range(5):
        own = inlet.lattice
        index = [np.arange(f, f + n) for f, n in zip(own.first, own.counts, strict=True)]
        every = np.stack(np.meshgrid(*index, indexing="ij"), axis=-1).reshape(-1, 3)
        beside = [a for a in range(3) if a != own.along]
        places = own.start + own.spacing * every
        places[:, own.along] += own.spacing * np.mod((every - own.turns)[:, beside] @ PHASES, 1.0)
        cells = np.clip(GRID.cell_of(places), 0, np.array(GRID.shape) - 1)
        there = GRID.contains(places) & (regions[tuple(cells.T)] == CellType.INFLOW)
        there &= sample_nodes(walls_of().signed_distance, GRID, places) > own.clear
        found = inlet.missing(np.zeros((0, 3), np.float32), np.random.default_rng(0))
        # a tenth of the spacing to either side is jitter
        assert len(found) == there.sum() > 0
        np.testing.assert_allclose(found, places[there], atol=0.11 * own.spacing)
        inlet.travel(0.013)


def test_without_inflow_cells_the_inlet_is_idle():
    inlet = Inlet(walls_of(), FluidParameters(), None, 0, 8)
    velocity = FaceVelocity.zeros(GRID)
    assert not inlet.active and inlet.impose(velocity, 0.0) is velocity
    assert len(inlet.missing(np.zeros((0, 3), np.float32), np.random.default_rng(0))) == 0


def outlet_walls():
    regions = np.zeros(GRID.shape, np.uint8)
    regions[-2:] = CellType.OUTFLOW
    return walls_of(regions=regions)


def test_standing_columns_hold_their_head_and_hanging_ones_none():
    walls = outlet_walls()
    wet = np.zeros(GRID.shape, bool)
    wet[-2:, :3, 2:5] = True  # stands on the bed
    wet[-2:, 3:, 4:6] = True  # hangs in the air
    levels = water_levels(wet, walls)
    assert (levels[-2:, :3] == 5).all() and (levels[-2:, 3:] == -1).all() and (levels[:-2] == -1).all()
    heads = outlet_heads(levels, levels, walls)
    np.testing.assert_allclose(heads[-1, 0, 2:], [0.25, 0.15, 0.05, 0, 0])  # depth of the cells' centres
    assert (heads[-2:, 3:] == 0).all() and (heads[:-2] == 0).all()
    assert outlet_heads(np.full_like(levels, -1), levels, walls) is None


def test_the_head_cancels_gravity_inside_the_outlet():
    walls = outlet_walls()
    wet = np.zeros(GRID.shape, bool)
    wet[:, :, 2:5] = True
    levels = water_levels(wet, walls)
    velocity = add_gravity(FaceVelocity.zeros(GRID), (0.0, 0.0, -9.81), 0.01)
    pull = 9.81 * 0.01
    heads = outlet_heads(levels, levels, walls)
    new = hold_columns(velocity, heads * pull, walls, weight=pull * GRID.spacing)
    np.testing.assert_allclose(new.w[-2:, :, 3:6], 0.0, atol=1e-7)
    np.testing.assert_allclose(new.u, 0.0, atol=1e-7)


def test_the_surface_of_a_column_lies_where_the_distance_says():
    walls = outlet_walls()
    wet = np.zeros(GRID.shape, bool)
    wet[-2:, :3, 2:5] = True
    for height in (0.41, 0.45, 0.49):
        distance = np.broadcast_to(GRID.centers()[..., 2] - GRID.low[2] - height, GRID.shape)
        heights = surface_heights(water_levels(wet, walls), distance, GRID.spacing)
        np.testing.assert_allclose(heights[-2:, :3], height / GRID.spacing, rtol=1e-6)
        assert (heights[-2:, 3:] == -1).all() and (heights[:-2] == -1).all()


def test_buoyancy_acts_against_gravity_where_there_is_smoke():
    smoke = np.zeros(GRID.shape)
    smoke[:, :, 3:] = 1.0
    new = add_buoyancy(FaceVelocity.zeros(GRID), smoke, strength=2.0, gravity=(0, 0, -9.81), dt=0.1)
    np.testing.assert_allclose(new.w[0, 0], [0, 0, 0, 0.1, 0.2, 0.2, 0.2, 0.2], atol=1e-6)
    assert (new.u == 0).all() and (new.v == 0).all()


def test_capacity_is_the_open_share_of_the_kernel():
    capacity = cell_capacity(GRID.nodes()[..., 2] - 0.2, GRID)
    # half a cell above a flat bed the hat function leaves 1/8 below it; samples at quarters give 1/16 + 1/16
    np.testing.assert_allclose(capacity[0, 0], [0.0, 0.125, 0.875, 1, 1, 1, 1], atol=0.02)


def test_crowded_particles_spread():
    walls = walls_of()
    rng = np.random.default_rng(0)
    points = rng.uniform([0.1, 0.1, 0.2], [0.7, 0.5, 0.5], (1200, 3)).astype(np.float32)
    clump = rng.uniform([0.35, 0.25, 0.3], [0.45, 0.35, 0.4], (40, 3)).astype(np.float32)
    points = np.concatenate([points, clump])
    volumes = np.full(len(points), 0.6 * 0.4 * 0.3 / 1200, np.float32)
    capacity = cell_capacity(walls.signed_distance, GRID)
    order = sort_by_cell(points, GRID)
    occupied = (np.diff(order.start) > 0).reshape(GRID.shape)
    system = build_system(boundaries.liquid_cells(occupied, walls), walls.openings, GRID, open_border=True)
    ratio = fill_ratio(points, volumes, GRID, order, capacity)
    moves = spreading(points, ratio, capacity, system, GRID, order)
    outward = ((clump - clump.mean(axis=0)) * moves[-40:]).sum(axis=1)
    assert outward.mean() > 0
    assert np.linalg.norm(moves, axis=1).max() <= 0.2 * GRID.spacing * 1.001
    moved = points + moves
    after = fill_ratio(moved, volumes, GRID, sort_by_cell(moved, GRID), capacity)
    assert after.max() < ratio.max()


def test_displacements_are_sampled_and_limited_as_in_the_plain_form():
    rng = np.random.default_rng(3)
    field = FaceVelocity(*(rng.normal(size=GRID.face_shape(a)).astype(np.float32) for a in range(3)))
    low, high = GRID.low - 0.05, GRID.high + 0.05  # also beyond the outer faces
    points = rng.uniform(low, high, (3000, 3)).astype(np.float32)
    moves = limited_moves(field, GRID, points, 0.4, sort_by_cell(points, GRID))
    plain = limited_moves_plain(field, GRID, points, 0.4)
    np.testing.assert_allclose(moves, plain, atol=2e-5)  # single precision of coordinates in cells
    assert 0 < (np.linalg.norm(plain, axis=1) > 0.399).sum() < len(points)
