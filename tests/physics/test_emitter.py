"""What comes out of an emitter, how fast, and when."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.numerics.solid_mesh import box_mesh, cylinder_mesh, ellipsoid_mesh
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.emitter import Emitter, Supply, projected_area
from fluidlift.physics.gas import GasSimulator
from fluidlift.types import FluidParameters, Grid, Particles, Terrain, TriangleMesh

NO_MESH = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
H = 0.1


def placed(mesh, position=(0.0, 0.0, 0.0)):
    return TriangleMesh(np.asarray(mesh.vertices) + np.array(position), mesh.faces)


def nothing():
    return Particles.at_rest(np.zeros((0, 3)), 1.0)


def world(shape=(12, 12, 20), floor=0.0):
    grid = Grid(shape, H)
    distance = grid.nodes()[..., 2] - floor + (1.0 if floor == 0.0 else 0.0)
    return grid, Terrain(grid, distance.astype(np.float32), np.array([1.0, 0.0, 0.0]), NO_MESH)


def simulator(*emitters, gravity=(0.0, 0.0, -9.81), body=None, looks=(), kind=LiquidSimulator, **more):
    grid, terrain = world()
    parameters = FluidParameters(gravity=gravity, time_step=0.02)
    return kind(
        grid, terrain, parameters, nothing() if body is None else body, cell_types=np.zeros(grid.shape, np.uint8),
        supply=Supply(emitters=emitters, looks=looks), **more,
    )  # fmt: skip


@pytest.mark.parametrize(
    "mesh",
    [box_mesh(np.array([0.3, 0.2, 0.2])), cylinder_mesh(0.12, 0.1), ellipsoid_mesh(np.full(3, 0.15)),
     cylinder_mesh(0.02, 0.02)],
    ids=["box", "cylinder", "sphere", "thinner than a cell"],
)  # fmt: skip
@pytest.mark.parametrize("velocity", [(0.0, 0.0, -1.0), (0.6, 0.0, -0.8)])
def test_what_comes_out_is_the_area_times_the_speed_times_the_time(mesh, velocity):
    run = simulator(Emitter("tap", placed(mesh, (0.5, 0.55, 1.5)), velocity, start=0.1, end=0.4))
    run.advance(0.05)
    assert run.volume == 0.0  # not yet
    run.advance(0.3)
    run.advance(0.2)
    run.advance(0.02)
    area = projected_area(mesh, np.array(velocity))
    from fluidlift.numerics.solid_mesh import moments

    expected = area * 1.0 * 0.3 + moments(mesh).volume
    # the mesh's own volume is filled with whole particles: a tenth of it; the flow that follows is exact to a particle
    # per column of the lattice, of which 12 or more cross the mesh at different times: one in 30 of what passes
    assert run.volume == pytest.approx(expected, abs=0.1 * moments(mesh).volume + 0.03 * area * 0.3)


def test_long_after_its_start_the_flow_is_exact():
    mesh = cylinder_mesh(0.07, 0.1)
    run = simulator(Emitter("tap", placed(mesh, (0.6, 0.6, 1.0)), (0.0, 0.0, 2.0)), gravity=(0.0, 0.0, 0.0))
    run.advance(0.2)
    before, removed = run.volume, 0
    run.advance(0.2)
    # nothing has left the box yet; a particle per column of some 12: 0.4 m hold 8 or more of each
    assert run.volume - before == pytest.approx(projected_area(mesh, np.array([0.0, 0.0, 1.0])) * 2.0 * 0.2, rel=0.02)
    assert removed == 0


def test_what_has_come_out_moves_as_the_emitter_says_and_then_falls():
    run = simulator(Emitter("tap", placed(box_mesh(np.full(3, 0.2)), (0.3, 0.6, 1.5)), (1.0, 0.0, 0.0)))
    run.advance(0.4)
    p = run.particles
    out = p.positions[:, 0] > 0.42
    assert out.sum() > 100
    # free fall that begins between the mesh's end and the end of the last prescribed face's reach, a cell and a half on
    time = (p.positions[out, 0] - 0.4) / 1.0
    late = np.maximum(time - 1.5 * H / 1.0, 0.0)
    w, slack = -p.velocities[out, 2], 0.25  # a substep's fall
    assert ((w <= 9.81 * time + slack) & (w >= 9.81 * late - slack)).all()
    assert abs(p.velocities[out, 0].mean() - 1.0) < 0.05


def test_under_water_it_adds_water_and_draws_none_in_from_behind():
    axis = (np.arange(24) + 0.5) * 0.05
    still = np.stack(np.meshgrid(axis, axis, axis[:16], indexing="ij"), -1).reshape(-1, 3)
    nozzle = Emitter("nozzle", placed(box_mesh(np.full(3, 0.3)), (0.35, 0.65, 0.35)), (1.0, 0.0, 0.0))
    run = simulator(nozzle, body=Particles.at_rest(still, 1.0))
    before = run.volume
    for _ in range(5):
        run.advance(0.04)
    added = run.volume - before
    # 0.09 m^2 at 1 m/s for 0.2 s; the mesh stands in the water, so that filling it adds nothing but what lay open
    assert added == pytest.approx(0.018, rel=0.1)
    # the water that was there has risen by what came in, and was not blown to spray: 1.2 m x 1.2 m
    wet = run.particles.positions[:, 2]
    assert np.percentile(wet, 99.5) < 0.8 + 2 * H


def test_one_that_stands_still_fills_itself_and_lets_go_at_its_end():
    run = simulator(Emitter("drop", placed(ellipsoid_mesh(np.full(3, 0.2)), (0.6, 0.6, 1.2)), end=0.1))
    run.advance(0.08)
    p = run.particles
    assert run.volume == pytest.approx(4 / 3 * np.pi * 0.2**3, rel=0.02)  # the mesh is a polyhedron inside the sphere
    assert np.abs(p.velocities).max() == 0.0
    run.advance(0.12)
    assert run.particles.velocities[:, 2].mean() == pytest.approx(-9.81 * 0.1, abs=0.05)
    assert run.volume == pytest.approx(4 / 3 * np.pi * 0.2**3, rel=0.02)


def test_its_particles_take_the_look_that_they_are_given():
    emitters = [
        Emitter(n, placed(box_mesh(np.full(3, 0.2)), (x, 0.6, 1.0)), (0, 0, -1)) for n, x in (("a", 0.3), ("b", 0.9))
    ]
    run = simulator(*emitters, looks=(np.array([4, 5]), np.array([9])))
    run.advance(0.05)
    p = run.particles
    left = p.positions[:, 0] < 0.6
    assert set(p.source[left]) == {4, 5}
    assert set(p.source[~left]) == {9}


def test_smoke_comes_out_of_an_emitter_too():
    puff = Emitter("puff", placed(box_mesh(np.full(3, 0.3)), (0.65, 0.65, 0.65)), (0.0, 0.0, 1.0), end=0.2)
    run = simulator(puff, kind=GasSimulator, buoyancy=0.0)
    for _ in range(4):
        run.advance(0.05)
    assert run.volume == pytest.approx(0.09 * 1.0 * 0.2 + 0.027, rel=0.05)  # whole layers of half a cell: one in 10
    assert run.particles.positions[:, 2].max() > 0.9
    w = run.velocity.w
    assert w[6, 6, 8] > 0.3  # it drives the air above it
    run.advance(0.05)
    assert run.volume == pytest.approx(0.09 * 1.0 * 0.2 + 0.027, rel=0.05)


@pytest.mark.parametrize("stop", [0.1, 0.2, 0.35])
def test_a_simulation_with_emitters_goes_on_from_its_state_bit_for_bit(stop):
    def build():
        return simulator(
            Emitter("a", placed(cylinder_mesh(0.12, 0.1), (0.5, 0.5, 1.5)), (0.3, 0.0, -1.0), start=0.13, end=0.3),
            Emitter("b", placed(box_mesh(np.full(3, 0.2)), (0.8, 0.8, 0.6)), (0.0, 0.0, 0.5)),
        )

    steps = 10
    first = build()
    for k in range(steps):
        first.advance(0.05)
        if abs((k + 1) * 0.05 - stop) < 1e-9:
            kept = first.state()
    second = build()
    second.restore(kept)
    for _ in range(steps - round(stop / 0.05)):
        second.advance(0.05)
    for name, value in first.state().items():
        np.testing.assert_array_equal(value, second.state()[name], err_msg=name)


def test_the_state_of_other_emitters_is_refused():
    one = simulator(Emitter("a", placed(box_mesh(np.full(3, 0.2)), (0.5, 0.5, 1.0)), (0, 0, -1)))
    with pytest.raises(InputRejected, match="other emitters"):
        simulator().restore(one.state())


def test_an_open_mesh_is_refused_with_the_line_it_stands_on():
    mesh = box_mesh(np.full(3, 0.2))
    open_one = TriangleMesh(mesh.vertices, mesh.faces[1:])
    with pytest.raises(InputRejected, match=r"scene\.yaml, line 7: emitter 'tap'"):
        simulator(Emitter("tap", open_one, (0, 0, -1), line="scene.yaml, line 7"))


@pytest.mark.parametrize("wrong", [{"start": -1.0}, {"start": 1.0, "end": 1.0}, {"color": (2.0, 0.0, 0.0)},
                                   {"velocity": (np.inf, 0.0, 0.0)}])  # fmt: skip
def test_an_emitter_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(ValueError, match=r"start|end|color|velocity"):
        Emitter("tap", box_mesh(np.ones(3)), **wrong)
