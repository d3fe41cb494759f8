"""A channel that is made longer goes on as it was."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.numerics.ground_block import ground_mesh
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.channel_extension import extended_body, extended_downstream, extended_velocity, find_outlet
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Particles, Terrain, TriangleMesh

H = 0.1
SPEED = 0.8


def channel(sign=1, axis=0, slope=0.0):
    """A bed that falls by `slope` along the stream, with banks, in a box of 2.4 by 0.8 by 0.8 m."""
    shape = (24, 8, 8) if axis == 0 else (8, 24, 8)
    grid = Grid(shape, H, (1.0, -2.0, 0.5))
    nodes, centers = grid.nodes(), grid.centers()

    def along(points):
        x = points[..., axis] - grid.origin[axis]
        return x if sign > 0 else 2.4 - x

    def bed(points):
        across = points[..., 1 - axis] - grid.origin[1 - axis] - 0.4
        return 0.5 + 0.25 - slope * (along(points) - 1.2) + np.maximum(np.abs(across) - 0.25, 0.0) * 2.0

    colors = np.full((len(nodes.reshape(-1, 3)), 3), 0.25)
    mesh = TriangleMesh(nodes.reshape(-1, 3), np.zeros((1, 3), int), colors)
    mainstream = np.zeros(3)
    mainstream[axis] = sign
    terrain = Terrain(grid, np.float32(nodes[..., 2] - bed(nodes)), mainstream, mesh)
    open_cells = sample_nodes(terrain.signed_distance, grid, centers.reshape(-1, 3)).reshape(shape) >= 0
    wet = open_cells & (centers[..., 2] < 0.5 + 0.55 - slope * (along(centers) - 1.2))
    cells = np.where(wet, CellType.FLUID, np.where(open_cells, CellType.EMPTY, CellType.SOLID)).astype(np.uint8)
    cells[wet & (along(centers) < 2 * H)] = CellType.INFLOW
    cells[open_cells & (along(centers) > 2.4 - 2 * H)] = CellType.OUTFLOW
    return terrain, cells


def body_of(terrain, cells, kinds=(CellType.FLUID, CellType.INFLOW), axis=0, sign=1):
    step = np.array([-0.25, 0.25])
    offsets = np.stack(np.meshgrid(step, step, step, indexing="ij"), -1).reshape(-1, 3) * H
    points = (terrain.grid.centers()[np.isin(cells, kinds)][:, None] + offsets).reshape(-1, 3)
    velocity = np.zeros((len(points), 3))
    velocity[:, axis] = SPEED * sign
    return Particles.at_rest(points, 1.0, np.arange(len(points)), velocity)


def uniform(grid, axis=0, sign=1):
    velocity = FaceVelocity.zeros(grid)
    velocity.components[axis][:] = SPEED * sign
    return velocity


@pytest.mark.parametrize(("axis", "sign"), [(0, 1), (0, -1), (1, 1), (1, -1)])
def test_the_bed_goes_on_with_its_cross_section_and_slope(axis, sign):
    terrain, cells = channel(sign, axis, slope=0.1)
    longer, _ = extended_downstream(terrain, cells, 1.0)
    assert find_outlet(terrain, cells).slope == pytest.approx(0.1, rel=1e-3)  # of a plane, in single precision
    rng = np.random.default_rng(0)
    points = rng.uniform(terrain.grid.low, terrain.grid.high, (200, 3))
    end = (terrain.grid.high if sign > 0 else terrain.grid.low)[axis]
    points[:, axis] = end + sign * rng.uniform(0.0, 1.0, 200)
    before = points.copy()
    before[:, axis], before[:, 2] = end, points[:, 2] + 0.1 * np.abs(points[:, axis] - end)
    inside = before[:, 2] < terrain.grid.high[2]
    np.testing.assert_allclose(
        sample_nodes(longer.signed_distance, longer.grid, points[inside]),
        sample_nodes(terrain.signed_distance, terrain.grid, before[inside]),
        atol=0.05 * H,  # both are interpolated between nodes 0.1 m apart, at different places between them
    )


def test_nothing_changes_before_the_old_outlet():
    terrain, cells = channel(slope=0.1)
    longer, types = extended_downstream(terrain, cells, 1.0)
    assert longer.grid.shape == (34, 8, 9)  # a drop of 0.1 m is one cell
    np.testing.assert_array_equal(types[:22, :, 1:], cells[:22])
    np.testing.assert_allclose(longer.signed_distance[:25, :, 1:], terrain.signed_distance, atol=1e-6)
    assert longer.grid.low[2] == pytest.approx(terrain.grid.low[2] - H)


def test_the_outlet_moves_to_the_new_end_and_the_old_one_becomes_water():
    terrain, cells = channel()
    _, types = extended_downstream(terrain, cells, 1.0)
    solid = types == CellType.SOLID
    assert ((types[-3:] == CellType.OUTFLOW) | solid[-3:]).all()
    assert not (types[:-3] == CellType.OUTFLOW).any()
    depth = (types == CellType.FLUID).sum(axis=(1, 2))
    assert (depth[2:31] == depth[10]).all()  # a prismatic channel holds the same water everywhere


def test_an_upright_fall_or_a_box_without_outlet_cannot_be_extended():
    terrain, cells = channel()
    with pytest.raises(InputRejected, match="outlet"):
        extended_downstream(terrain, np.where(cells == CellType.OUTFLOW, 0, cells).astype(np.uint8), 1.0)
    falling = Terrain(terrain.grid, terrain.signed_distance, np.array([0.0, 0.0, -1.0]), terrain.mesh)
    with pytest.raises(InputRejected, match="mainstream"):
        extended_downstream(falling, cells, 1.0)


def test_the_colours_of_the_bed_go_on():
    longer, _ = extended_downstream(*channel(), 1.0)
    assert len(longer.mesh.colors) == len(longer.mesh.vertices) > 0
    np.testing.assert_allclose(longer.mesh.colors, 0.25)


def test_the_longer_ground_is_a_closed_block_without_a_wall_at_the_inlet():
    terrain, cells = channel(slope=0.1)
    low, h = terrain.grid.low, terrain.grid.spacing
    nodes = terrain.grid.nodes()
    shown = np.where(terrain.signed_distance > 0, -np.inf, nodes[..., 2]).max(axis=2)  # without the wall
    walled = np.array(terrain.signed_distance)
    walled[:2] = np.minimum(walled[:2], nodes[:2, ..., 2] - (low[2] + 0.7))  # solid up to 0.7 m behind the inlet
    block = Terrain(terrain.grid, walled, terrain.mainstream, ground_mesh(terrain.grid, shown))
    mesh = extended_downstream(block, cells, 1.0)[0].mesh
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    across = np.abs(mesh.vertices[:, 1] - (low[1] + 0.4))
    behind = (mesh.vertices[:, 0] < low[0] + 2 * h) & (across < 0.2)
    # heights are of nodes, and the spline through them swings by less than a cell
    assert mesh.vertices[behind, 2].max() < shown[:2].min() + 1.5 * h
    assert mesh.vertices[:, 0].max() == pytest.approx(terrain.grid.high[0] + 1.0, abs=h)


def test_the_added_water_is_as_dense_and_as_fast_as_what_it_repeats():
    terrain, cells = channel(slope=0.1)
    longer, types = extended_downstream(terrain, cells, 1.0)
    body = body_of(terrain, cells)
    velocity = uniform(terrain.grid)
    more = extended_body(body, velocity, (terrain, cells), (longer, types))
    new = more.positions[len(body) :]
    assert (new[:, 0] > terrain.grid.high[0] - 2.01 * H).all()
    assert sample_nodes(longer.signed_distance, longer.grid, new).min() > 0
    np.testing.assert_allclose(more.velocities[len(body) :], [[SPEED, 0.0, 0.0]] * len(new), atol=1e-6)
    assert more.source.max() < len(body) and len(np.unique(more.ids)) == len(more)
    # 8 per cell as before, fewer where the bed cuts a cell: banks of 45 degrees and more cut a third of them
    wet = (types[24:31] == CellType.FLUID).sum()
    there = (new[:, 0] > terrain.grid.high[0]) & (new[:, 0] < terrain.grid.high[0] + 7 * H)
    assert 6.0 < there.sum() / wet < 9.0


def discharge(simulator, low, high):
    """m^3/s between two places along x."""
    p = simulator.particles
    here = (p.positions[:, 0] > low) & (p.positions[:, 0] < high)
    volumes = p.masses[here].astype(np.float64) / simulator.parameters.density
    return float((volumes * p.velocities[here, 0]).sum() / (high - low))


def test_a_river_flows_on_through_the_added_part_without_a_jump_in_discharge():
    terrain, cells = channel()
    longer, types = extended_downstream(terrain, cells, 1.0)
    velocity = uniform(terrain.grid)
    body = extended_body(body_of(terrain, cells), velocity, (terrain, cells), (longer, types))
    simulator = LiquidSimulator(
        longer.grid, longer, FluidParameters(inflow_velocity=(SPEED, 0, 0), time_step=0.04), body,
        cell_types=types, inflow_profile=extended_velocity(velocity, find_outlet(terrain, cells), longer.grid),
    )  # fmt: skip
    end = terrain.grid.high[0]
    found = []
    for _ in range(50):
        simulator.advance(0.1)
        found.append([discharge(simulator, x, x + 0.4) for x in (end - 1.0, end - 0.5, end + 0.1, end + 0.5)])
    # at once: the added water moves as that before it does, up to the particles that a section of 0.4 m gains or loses
    first = np.mean(found[:10], axis=0)
    np.testing.assert_allclose(first, first[0], rtol=0.05)
    # after three passages: what enters arrives everywhere
    last = np.mean(found[-10:], axis=0)
    np.testing.assert_allclose(last, last[0], rtol=0.05)
    assert last[0] > 0.75 * first[0]
