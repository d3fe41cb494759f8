"""A terrain that is moved, turned, scaled, twisted or replaced, and the water that goes with it."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.numerics.sampling import sample_nodes
from fluidlift.numerics.solid_mesh import box_mesh, closed_mesh, moments
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.terrain_edit import (
    FLOOR,
    Move,
    Place,
    Replace,
    Rotate,
    Scale,
    Twist,
    closed_below,
    place_of,
    solid_ground,
)
from fluidlift.physics.terrain_reshape import (
    raised_box,
    reshaped,
    reshaped_body,
    reshaped_gaussians,
    reshaped_velocity,
)
from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidParameters,
    Gaussians,
    Grid,
    Particles,
    Terrain,
    TriangleMesh,
)

H = 0.1
GRID = Grid((24, 12, 8), H, (-1.2, -0.6, 0.0))
BED = 0.25


def channel():
    """A bed with a bank on either side, water some 0.2 m deep, an inlet at the low end of x, an outlet at the other."""
    nodes, centers = GRID.nodes(), GRID.centers()
    ground = BED + 0.8 * np.maximum(np.abs(nodes[..., 1]) - 0.3, 0.0)
    distance = ((nodes[..., 2] - ground) / np.sqrt(1 + 0.64 * (np.abs(nodes[..., 1]) > 0.3))).astype(np.float32)
    cells = np.zeros(GRID.shape, np.uint8)
    open_here = sample_nodes(distance, GRID, centers.reshape(-1, 3)).reshape(GRID.shape) > 0
    wet = open_here & (centers[..., 2] < BED + 0.22)
    cells[wet], cells[~open_here] = CellType.FLUID, CellType.SOLID
    cells[:2][wet[:2]], cells[-3:][wet[-3:]] = CellType.INFLOW, CellType.OUTFLOW
    vertices = np.array([[-1.2, -0.6, 0.25], [1.2, -0.6, 0.25], [1.2, 0.6, 0.25]])
    mesh = TriangleMesh(vertices, np.array([[0, 1, 2]]), np.full((3, 3), 0.5))
    return Terrain(GRID, distance, np.array([1.0, 0.0, 0.0]), mesh), cells


def water():
    _, cells = channel()
    wet = np.argwhere(cells == CellType.FLUID)
    corners = np.stack(np.meshgrid(*[[0.25, 0.75]] * 3, indexing="ij"), -1).reshape(-1, 3)
    places = (GRID.low + (wet[:, None] + corners) * H).reshape(-1, 3)
    return Particles.at_rest(places, 1.0, velocities=np.broadcast_to([0.8, 0.0, 0.0], places.shape))


def around(mesh, at):
    return TriangleMesh(np.asarray(mesh.vertices) + np.array(at), mesh.faces)


EDITS = {
    "move": [Move((0.13, -0.07, 0.4))],
    "rotate": [Rotate(30.0)],
    "scale": [Scale((1.2, 1.0, 1.5))],
    "twist": [Twist(10.0)],
    "all": [Rotate(-20.0), Twist(8.0), Move((0.0, 0.0, 0.2)), Scale((1.0, 1.3, 1.0))],
}


@pytest.mark.parametrize("edits", EDITS.values(), ids=EDITS)
def test_what_the_edits_put_somewhere_came_from_where_they_took_it(edits):
    points = np.random.default_rng(0).uniform(GRID.low, GRID.high, (200, 3))
    place = place_of(*channel(), edits)
    np.testing.assert_allclose(place.origin(place.points(points)), points, atol=1e-12)


@pytest.mark.parametrize("edits", EDITS.values(), ids=EDITS)
def test_the_distance_to_the_ground_is_that_of_the_ground_in_its_new_place(edits):
    terrain, cells = channel()
    new = reshaped(terrain, cells, edits)
    rng = np.random.default_rng(0)
    flat = np.stack([rng.uniform(-0.9, 0.9, 300), rng.uniform(-0.2, 0.2, 300), np.full(300, BED)], axis=1)
    on = new.place.points(flat)
    tangents = np.einsum("nij,jk->nik", new.place.gradient(flat), np.eye(3)[:, :2])
    normal = np.cross(tangents[:, :, 0], tangents[:, :, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for away in (-0.1, 0.0, 0.1):
        found = sample_nodes(new.terrain.signed_distance, new.terrain.grid, on + away * normal)
        # trilinear sampling of a curved field on cells of 0.1 m, twice: a tenth of a cell
        np.testing.assert_allclose(found, away, atol=0.1 * H)


def test_moving_everything_changes_nothing_but_the_place():
    terrain, cells = channel()
    new = reshaped(terrain, cells, [Move((0.5, 0.25, -0.1))])
    np.testing.assert_array_equal(new.terrain.signed_distance, terrain.signed_distance)
    np.testing.assert_array_equal(new.cell_types, cells)
    np.testing.assert_allclose(new.terrain.grid.low, GRID.low + [0.5, 0.25, -0.1])
    np.testing.assert_allclose(new.terrain.mesh.vertices, terrain.mesh.vertices + [0.5, 0.25, -0.1])
    velocity = FaceVelocity.zeros(GRID)
    assert reshaped_velocity(velocity, GRID, new) is velocity
    np.testing.assert_allclose(reshaped_body(water(), new).positions, water().positions + [0.5, 0.25, -0.1], atol=1e-6)


@pytest.mark.parametrize("edits", EDITS.values(), ids=EDITS)
def test_the_box_holds_the_terrain_and_the_water_and_inlet_and_outlet_go_along(edits):
    terrain, cells = channel()
    new = reshaped(terrain, cells, edits)
    body = reshaped_body(water(), new)
    assert len(body) == len(water())
    assert new.terrain.grid.contains(body.positions).all()
    for kind in (CellType.INFLOW, CellType.OUTFLOW):
        old = GRID.low + (np.argwhere(cells == kind) + 0.5) * H
        now = new.terrain.grid.low + (np.argwhere(new.cell_types == kind) + 0.5) * H
        now = now[GRID.contains(new.place.origin(now))]  # beside the old box water drains away
        # cells are taken by their centres: either end may be off by half a cell and a bit
        placed = new.place.points(old)
        np.testing.assert_allclose(now.min(axis=0), placed.min(axis=0), atol=0.8 * H)
        np.testing.assert_allclose(now.max(axis=0), placed.max(axis=0), atol=0.8 * H)


def test_a_river_that_is_turned_flows_where_it_is_turned_to():
    terrain, cells = channel()
    new = reshaped(terrain, cells, [Rotate(90.0)])
    np.testing.assert_allclose(new.terrain.mainstream, [0.0, 1.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(reshaped_body(water(), new).velocities[0], [0.0, 0.8, 0.0], atol=1e-6)
    u = FaceVelocity.zeros(GRID)
    u = FaceVelocity(np.full_like(u.u, 0.8), u.v, u.w)
    turned = reshaped_velocity(u, GRID, new)
    np.testing.assert_allclose(turned.v, 0.8, atol=1e-6)
    np.testing.assert_allclose(turned.u, 0.0, atol=1e-6)


def test_a_scaled_river_is_longer_but_not_faster():
    new = reshaped(*channel(), [Scale((2.0, 1.0, 1.0))])
    body = reshaped_body(water(), new)
    assert np.ptp(body.positions[:, 0]) == pytest.approx(2 * np.ptp(water().positions[:, 0]), rel=1e-5)
    np.testing.assert_allclose(np.linalg.norm(body.velocities, axis=1), 0.8, rtol=1e-5)


def test_a_twist_leaves_the_inlet_upright_and_turns_the_outlet():
    terrain, cells = channel()
    new = reshaped(terrain, cells, [Twist(20.0)])
    gradient = new.place.gradient(np.array([[-1.15, 0.0, 0.35], [1.15, 0.0, 0.35]]))
    np.testing.assert_allclose(gradient[0][1:, 1:], np.eye(2), atol=0.02)  # a cell's length of twist
    turn = np.degrees(np.arctan2(gradient[1][2, 1], gradient[1][1, 1]))
    assert turn == pytest.approx(20.0 * 2.3, abs=2.0)  # 2.3 m from the first cell of water, give or take a cell
    np.testing.assert_allclose(new.terrain.mainstream, [1.0, 0.0, 0.0], atol=1e-6)


def test_splats_are_turned_and_stretched_with_the_ground():
    rest = Gaussians.isotropic(np.array([[0.3, 0.1, 0.3]]), 0.02, np.array([[0.2, 0.4, 0.6]]))
    place = place_of(*channel(), [Scale((3.0, 1.0, 1.0)), Rotate(90.0)])
    out = reshaped_gaussians(rest, place)
    np.testing.assert_allclose(out.covariances()[0], np.diag([0.02, 0.06, 0.02]) ** 2, atol=1e-8)
    np.testing.assert_allclose(out.means, place.points(rest.means), atol=1e-6)
    assert reshaped_gaussians(rest, Place()) is rest


def test_another_solid_takes_the_water_that_it_swallows_and_leaves_the_rest_where_it_is():
    terrain, cells = channel()
    slab = around(box_mesh(np.array([3.0, 2.0, 0.6])), (0.0, 0.0, 0.05))  # its top at 0.35, 0.1 above the bed
    new = reshaped(terrain, cells, [Replace(slab)])
    body, before = reshaped_body(water(), new), water().positions
    kept = before[before[:, 2] > 0.35]
    np.testing.assert_allclose(np.sort(body.positions, axis=0), np.sort(kept, axis=0), atol=1e-6)
    height = sample_nodes(new.terrain.signed_distance, new.terrain.grid, np.array([[0.0, 0.0, 0.45], [0.5, 0.2, 0.25]]))
    np.testing.assert_allclose(height, [0.1, -0.1], atol=1e-3)  # a flat top: linear, but for float32
    np.testing.assert_allclose(new.terrain.mesh.colors, 0.5)  # of the ground that it replaces
    # the box has grown to hold it: 3 m x 2 m where it was 2.4 m x 1.2 m
    assert (np.array(new.terrain.grid.shape[:2]) >= [30, 20]).all()


def test_a_solid_larger_than_the_world_does_not_blow_the_box_up():
    slab = around(box_mesh(np.array([300.0, 300.0, 0.4])), (0.0, 0.0, 0.0))
    new = reshaped(*channel(), [Replace(slab)])
    assert new.terrain.grid.cells < 30 * GRID.cells
    assert sample_nodes(new.terrain.signed_distance, new.terrain.grid, np.array([[0.0, 0.0, 0.05]]))[0] < 0


def test_edits_after_another_solid_move_it_and_the_water_together():
    slab = around(box_mesh(np.array([3.0, 2.0, 0.4])), (0.0, 0.0, 0.0))
    new = reshaped(*channel(), [Replace(slab), Move((0.0, 0.0, 1.0))])
    found = sample_nodes(new.terrain.signed_distance, new.terrain.grid, np.array([[0.0, 0.0, 1.3]]))
    assert found[0] == pytest.approx(0.1, abs=1e-3)
    assert reshaped_body(water(), new).positions[:, 2].min() > 1.2


def test_ground_that_buries_the_inlet_is_refused_with_its_line():
    block = around(box_mesh(np.array([1.0, 3.0, 4.0])), (-1.0, 0.0, 0.0))
    with pytest.raises(InputRejected, match=r"scene\.yaml, line 9: .* nothing flows in"):
        reshaped(*channel(), [Replace(block, "scene.yaml, line 9")])


def test_an_open_mesh_is_no_ground():
    mesh = box_mesh(np.ones(3))
    with pytest.raises(InputRejected, match=r"line 4: the terrain's mesh.*open"):
        reshaped(*channel(), [Replace(TriangleMesh(mesh.vertices, mesh.faces[2:]), "line 4")])


def test_the_new_box_is_told_before_it_is_made():
    def refuse(grid):
        raise InputRejected(f"{grid.cells} cells")

    with pytest.raises(InputRejected, match="cells"):
        reshaped(*channel(), [Scale((50.0, 50.0, 50.0))], check=refuse)


def test_a_higher_box_has_the_same_ground_and_water():
    terrain, cells = channel()
    new = raised_box(terrain, cells, 1.55)
    assert new.terrain.grid.shape == (24, 12, 16)
    np.testing.assert_allclose(new.terrain.signed_distance[:, :, :9], terrain.signed_distance, atol=1e-6)
    flowing = (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW)
    np.testing.assert_array_equal(np.isin(new.cell_types[:, :, :8], flowing), np.isin(cells, flowing))
    assert not np.isin(new.cell_types[:, :, 8:], flowing).any()


def test_water_that_comes_over_the_edge_falls_and_leaves():
    terrain, cells = channel()
    new = reshaped(terrain, cells, [Twist(40.0)])
    body = reshaped_body(water(), new)
    cells = np.where(new.cell_types == CellType.INFLOW, np.uint8(CellType.EMPTY), new.cell_types)
    simulator = LiquidSimulator(new.terrain.grid, new.terrain, FluidParameters(time_step=0.04), body, cell_types=cells)
    before = simulator.volume
    for _ in range(12):
        simulator.advance(0.1)
    # the outlet's end is turned by 90 degrees; nothing lies at the bottom of the box beside the block
    assert simulator.volume < 0.5 * before
    p = simulator.particles.positions
    beside = ~GRID.contains(new.place.origin(p.astype(np.float64)), -2 * H)
    assert beside.mean() < 0.05


@pytest.mark.parametrize("edits", [EDITS["rotate"], EDITS["twist"], EDITS["scale"]], ids=["rotate", "twist", "scale"])
def test_the_edited_river_flows_and_stays_out_of_the_ground(edits):
    terrain, cells = channel()
    new = reshaped(terrain, cells, edits)
    body = reshaped_body(water(), new)
    inflow = new.place.directions(np.array([[-1.1, 0.0, 0.35]]), np.array([[0.8, 0.0, 0.0]]))[0]
    simulator = LiquidSimulator(
        new.terrain.grid, new.terrain, FluidParameters(inflow_velocity=tuple(inflow), time_step=0.04), body,
        cell_types=new.cell_types,
    )  # fmt: skip
    before = simulator.volume
    for _ in range(10):
        simulator.advance(0.05)
    p = simulator.particles
    assert sample_nodes(new.terrain.signed_distance, new.terrain.grid, p.positions).min() > 0
    # the inlet goes on with what the outlet lets out; the bed is full from the start
    assert simulator.volume == pytest.approx(before, rel=0.35)
    assert (p.velocities @ new.terrain.mainstream).mean() > 0.3


@pytest.mark.parametrize("wrong", [lambda: Scale((1.0, 0.0, 1.0)), lambda: Move((np.nan, 0.0, 0.0)),
                                   lambda: Rotate(np.inf), lambda: Twist(np.nan)])  # fmt: skip
def test_an_edit_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(ValueError, match=r"finite|positive"):
        wrong()


def hill(n=7, hole=False, **more):
    """A sheet of 2 m x 1 m over z = 1 + 0.2 x y, seen from above; with a hole in its middle."""
    x, y = np.meshgrid(np.linspace(0, 2, n), np.linspace(0, 1, n), indexing="ij")
    number = np.arange(n * n).reshape(n, n)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    kept = np.ones((n - 1, n - 1), bool)
    kept[n // 2, n // 2] = not hole
    faces = np.concatenate([np.stack([a, b, c], -1)[kept], np.stack([a, c, d], -1)[kept]])
    return TriangleMesh(np.stack([x, y, 1 + 0.2 * x * y], -1).reshape(-1, 3), faces, **more)


@pytest.mark.parametrize("hole", [False, True])
def test_a_height_field_becomes_the_ground_below_it(hole):
    field = hill(13, hole)
    solid, note = solid_ground(field)
    assert "closed" in note
    closed_mesh(solid)  # says so where it is not
    a, b, c = (field.vertices[field.faces[:, i]] for i in range(3))
    area = 0.5 * np.cross(b - a, c - a)[:, 2]
    floor = 1.0 - FLOOR * 2.0
    # prisms between the triangles and the floor, exactly
    expected = (area * ((a + b + c)[:, 2] / 3 - floor)).sum()
    assert moments(solid).volume == pytest.approx(expected, rel=1e-9)
    # a sheet that faces down is meant as ground all the same
    upside = TriangleMesh(field.vertices, field.faces[:, ::-1])
    assert moments(solid_ground(upside)[0]).volume == pytest.approx(expected, rel=1e-9)


def test_a_closed_bed_is_taken_as_it_is():
    solid, note = solid_ground(box_mesh(np.ones(3)))
    assert note == ""
    assert moments(solid).volume == pytest.approx(1.0)


def test_a_sheet_with_an_overhang_or_in_two_storeys_is_no_ground():
    field = hill()
    bent = field.vertices.copy()
    bent[-7:, 0] = 1.0  # the last row folds back under its neighbours
    bent[-7:, 2] -= 0.5
    storeys = TriangleMesh(
        np.concatenate([field.vertices, field.vertices + [0, 0, 1.0]]), np.concatenate([field.faces, field.faces + 49])
    )
    for mesh in (TriangleMesh(bent, field.faces), storeys):
        with pytest.raises(InputRejected, match="open"):
            solid_ground(mesh)


def test_colours_and_texture_of_a_bed_stay_on_it_also_where_its_vertices_are_split_at_seams():
    rng = np.random.default_rng(1)
    field = hill()
    split = field.vertices[field.faces].reshape(-1, 3)
    uv = rng.random((len(field.faces), 3, 2)).astype(np.float32)
    picture = rng.integers(0, 255, (4, 4, 3), dtype=np.uint8)
    colors = (split - split.min(axis=0)) / np.ptp(split, axis=0)  # of the place: every copy of a vertex has the same
    mesh = TriangleMesh(split, np.arange(len(split)).reshape(-1, 3), colors, uv, picture)
    solid, _ = solid_ground(mesh)
    n = len(field.faces)
    assert solid.texture is picture
    np.testing.assert_array_equal(solid.uv[:n], uv)
    np.testing.assert_allclose(solid.colors[solid.faces[:n]].reshape(-1, 3), colors)
    terrain, cells = channel()
    shown = reshaped(terrain, cells, [Replace(mesh), Move((0.0, 0.0, -1.0))]).terrain.mesh
    np.testing.assert_array_equal(shown.uv[:n], uv)
    low = TriangleMesh(field.vertices, field.faces, uv=uv, texture=picture)
    skirt = closed_below(low)
    # the texture of the rim goes on down the skirt: both ends of each upright edge show the same of it
    rim = skirt.uv[n : 2 * n]
    upright = skirt.faces[n:-n]
    assert upright.shape[0] == 2 * 4 * 6
    top = {(int(v), *map(float, t)) for f, u in zip(low.faces, low.uv) for v, t in zip(f, u)}
    for face, at in zip(upright, skirt.uv[n:-n]):
        assert all((int(v) % 49, *map(float, t)) in top for v, t in zip(face, at))
    assert len(rim)
