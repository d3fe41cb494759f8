"""The scenes are filled as they say, and the gauges measure what is there."""

import pytest

from fluidlift.numerics.sampling import sample_nodes
from fluidlift.synthetic import tanks
from fluidlift.synthetic.gauges import Gauge

SCENES = {
    "dam": tanks.dam_break, "wave": tanks.standing_wave, "river": tanks.river, "slope": tanks.honey_slope,
    "thread": tanks.thread, "pool": tanks.pool, "drop": tanks.drop,
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_has_its_liquid_in_the_box_and_outside_the_solid(name):
    tank = SCENES[name]()
    simulator = tank.simulator()
    x = simulator.particles.positions
    assert len(x) == len(tank.particles)  # the simulator found none to drop
    assert tank.grid.contains(tank.particles.positions).all()
    if len(x):
        assert sample_nodes(tank.terrain.signed_distance, tank.grid, x).min() > 0
        # every particle stands for its share of the liquid: rims and jitter cost the masses a few per cent
        assert simulator.volume == pytest.approx(tank.fill, rel=0.04)


@pytest.mark.parametrize("depth", [0.3, 0.317, 0.35])
def test_water_is_filled_to_the_exact_height(depth):
    tank = tanks.standing_wave(cells=20, depth=depth, mode=0)
    z = tank.particles.positions[:, 2]
    # the mean of evenly filled layers is half the depth; the jitter of 8000 particles moves it by a fiftieth of a layer
    assert 2 * z.mean() == pytest.approx(depth, abs=0.02 * tank.grid.spacing)
    gauge = Gauge.of(tank)
    # bumps from jitter average out; the floor and walls cost the smoothed density up to half a per cent
    assert gauge.volume(tank.particles) == pytest.approx(tank.fill, rel=0.01)
    assert gauge.depth(tank.particles).mean() == pytest.approx(depth, rel=0.01)


@pytest.mark.parametrize("mode", [1, 2, 3])
def test_a_gauge_reads_the_amplitude_of_a_wave(mode):
    tank = tanks.standing_wave(cells=32, mode=mode, amplitude=0.04)
    gauge = Gauge.of(tank)
    # smoothing over 0.8 cells takes exp(-(0.8 k h)^2 / 2) = 3 % of the third mode; jitter leaves 1 %
    assert gauge.amplitude(tank.particles, mode) == pytest.approx(0.04, rel=0.04)
    assert gauge.amplitude(tank.particles, mode + 1) == pytest.approx(0.0, abs=0.0015)


def test_crowded_particles_enclose_less_than_they_stand_for():
    tank = tanks.standing_wave(cells=16, mode=0)
    gauge = Gauge.of(tank)
    full = gauge.volume(tank.particles)
    pressed = tank.particles.positions.copy()
    pressed[:, 2] *= 0.8
    squeezed = tanks.Particles.at_rest(pressed, tank.particles.masses)
    # the very loss that counting particles would not see
    assert gauge.volume(squeezed) == pytest.approx(0.8 * full, rel=0.03)
