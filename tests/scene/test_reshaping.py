"""Edits of the world reach the scene: emitters get a look and room, and a simulation that fails names its edits."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.io.obstacles import Obstacle
from fluidlift.numerics.solid_mesh import box_mesh
from fluidlift.physics.emitter import Emitter
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.physics.stepping import ParticleSimulator
from fluidlift.physics.terrain_edit import Rotate
from fluidlift.pipeline.settings import SimulateSettings, taken
from fluidlift.pipeline.stages.simulate import simulate
from fluidlift.scene.reshaping import (
    changed_parameters,
    in_words,
    slow_edits,
    with_emitters,
    with_terrain,
)
from fluidlift.scene.simulator import sides_open_to_air, simulator_of
from fluidlift.scene.splat_files import frame_file, frame_files, read_frame
from fluidlift.types import FluidParameters, TriangleMesh

CONFIG = taken(SimulateSettings, build_config().simulate)


def tap(at=(0.6, 0.4, 0.9), **more):
    mesh = box_mesh(np.full(3, 0.2))
    return Emitter("tap", TriangleMesh(mesh.vertices + np.array(at), mesh.faces), (0.0, 0.0, -1.0), **more)


def test_a_red_tap_above_the_box_pours_red_water_into_the_frames(tmp_path, channel):
    scene = with_emitters(channel(6), [tap(color=(0.9, 0.1, 0.1))])
    assert scene.terrain.grid.high[2] > 1.0  # the box was 0.6 m high
    assert simulate(scene, CONFIG, folder=tmp_path).frames == 6
    shown = read_frame(frame_file(tmp_path, FIRST_FRAME + 5)).gaussians
    new = shown.means[:, 2] > 0.5
    assert new.sum() > 50
    np.testing.assert_allclose(shown.rgb[new].mean(axis=0), [0.9, 0.1, 0.1], atol=0.03)  # 4 % lighter and darker
    assert not (shown.rgb[~new][:, 0] > 0.8).all()


def test_a_tap_without_a_colour_takes_that_of_the_nearest_water(channel):
    scene = with_emitters(channel(6), [tap((0.2, 0.2, 0.3)), tap((1.0, 0.6, 0.3))])
    first, second = scene.emitter_looks
    own = scene.rest.select(np.arange(first[0]))
    for look, at in ((first, (0.2, 0.2, 0.3)), (second, (1.0, 0.6, 0.3))):
        nearest = np.argsort(((own.means - at) ** 2).sum(axis=1))[: len(look)]
        np.testing.assert_allclose(scene.rest.rgb[look].mean(axis=0), own.rgb[nearest].mean(axis=0), atol=0.02)
    np.testing.assert_allclose(scene.rest.scales[first], 0.042)


@pytest.mark.parametrize(
    ("at", "words"),
    [((5.0, 0.4, 0.4), "outside the simulated box"), ((0.6, 0.4, 90.0), "outside the simulated box"),
     ((0.6, 0.4, -0.04), "inside the ground")],
)  # fmt: skip
def test_a_tap_without_room_is_refused_with_its_line(at, words, channel):
    with pytest.raises(InputRejected, match=rf"scene\.yaml, line 3: emitter 'tap'.*{words}"):
        with_emitters(channel(6), [tap(at, line="scene.yaml, line 3")])


def test_a_checkpoint_knows_its_emitters_inflow_and_terrain(channel):
    plain = channel(6)
    scenes = [
        with_emitters(plain, [tap()]), with_emitters(plain, [tap(end=1.0)]), with_terrain(plain, [Rotate(10.0)]),
        replace(plain, inflow=InflowSchedule(((0.0, 2.0),))), plain,
    ]  # fmt: skip
    assert len({tuple(sorted(s.parts.items())) for s in scenes}) == len(scenes)
    assert with_terrain(plain, []) is plain
    assert with_emitters(plain, []) is plain


def test_a_turned_channel_has_a_turned_inflow(channel):
    scene = with_terrain(channel(6), [Rotate(90.0)])
    np.testing.assert_allclose(scene.parameters.inflow_velocity, [0.0, 0.6, 0.0], atol=1e-6)
    np.testing.assert_allclose(scene.painted, channel(6).rest.means)
    assert scene.reshaped


def test_the_edit_farthest_from_the_fit_is_named_first():
    fitted = FluidParameters(kinematic_viscosity=1e-6, inflow_velocity=(1.0, 0.0, 0.0))
    words = changed_parameters(
        fitted, {"inflow_velocity": [2.0, 0.0, 0.0], "kinematic_viscosity": 1e3, "density": 1000.0}
    )
    assert words == ("kinematic_viscosity 1e+03 (fitted: 1e-06)", "inflow_velocity [2, 0, 0] (fitted: [1, 0, 0])")


def test_a_simulation_that_breaks_down_names_the_edits_and_keeps_its_frames(tmp_path, monkeypatch, channel):
    scene = replace(channel(6), changes=("kinematic_viscosity 1e+03 (fitted: 1e-06)",))
    advance, calls = ParticleSimulator.advance, []

    def breaking(self, duration):
        calls.append(duration)
        if len(calls) == 4:
            raise FluidliftError("the simulation blew up.")
        return advance(self, duration)

    monkeypatch.setattr(ParticleSimulator, "advance", breaking)
    result = simulate(scene, CONFIG, folder=tmp_path)
    assert result.frames == 4
    assert "blew up. Edited in scene.yaml: kinematic_viscosity 1e+03" in result.failed
    assert in_words(channel(6)) == ""


def test_too_many_particles_end_a_simulation_with_its_frames_and_a_word(tmp_path, channel):
    few = replace(CONFIG, max_particles=780)
    result = simulate(with_emitters(channel(8), [tap(color=(1.0, 0.0, 0.0))]), few, folder=tmp_path)
    assert 0 < result.frames < 8
    assert "max_particles=780" in result.warnings[0]


@pytest.mark.parametrize(
    ("gravity", "open_sides"),
    [
        ((0.0, 0.0, -9.81), [[2, 1]]),
        ((1.7, 0.3, -9.66), [[2, 1]]),  # a slope that was filmed level
        ((0.0, 6.0, -8.0), [[2, 1]]),  # tilted by less than 45 degrees: still a tank
        ((0.0, 8.0, -6.0), [[1, 0], [1, 1], [2, 1]]),  # it falls to high y, and the sky stays open
        ((-9.81, 0.0, 0.0), [[0, 0], [0, 1], [2, 1]]),
        ((0.0, 0.0, 9.81), [[2, 0], [2, 1]]),
        ((0.0, 0.0, 0.0), [[2, 1]]),  # what drifts up leaves: there never was a lid
    ],
)
def test_a_box_is_open_to_the_sky_and_where_turned_gravity_points_to(gravity, open_sides):
    assert np.argwhere(sides_open_to_air(gravity)).tolist() == open_sides


def test_the_simulator_is_told_which_sides_are_open(channel):
    turned = replace(channel(6).parameters, gravity=(0.0, 8.0, -6.0))
    simulator = simulator_of(channel(6, parameters=turned))
    np.testing.assert_array_equal(simulator._walls.open_sides, sides_open_to_air(turned.gravity))


def obstacle(**more):
    return Obstacle("block", box_mesh(np.array([0.3, 1.0, 1.0])), line="scene.yaml, line 7", **more)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"changes": ("inflow_velocity [100, 0, 0] (fitted: [1, 0, 0])",)}, "the inflow at 100 m/s"),
        ({"inflow": InflowSchedule(((0.0, 1.0), (1.0, 0.5)))}, "the inflow at 100 m/s"),
        ({"emitters": (replace(tap(), velocity=(0.0, 0.0, -100.0)),)}, "emitter 'tap' at 100 m/s"),
        ({"obstacles": (obstacle(motion="free", velocity=(0.0, 100.0, 0.0)),)}, "obstacle 'block' at 100 m/s"),
        ({"longest_step": 0.001}, "time_step 0.001 s needs about 40 steps"),
    ],
)
def test_an_edit_that_takes_long_says_so_before_it_does(channel, more, words):
    fast = replace(channel(6).parameters, inflow_velocity=(100.0, 0.0, 0.0))
    (said,) = slow_edits(channel(6, parameters=fast, **more))
    assert words in said and "this may take very long" in said  # 40 cells of 0.1 m from frame to frame
    assert slow_edits(channel(6)) == []
    assert slow_edits(channel(6, parameters=fast)) == []  # as it was fitted: nothing to undo


def test_what_no_machine_would_finish_is_refused_by_name(channel):
    with pytest.raises(InputRejected, match=r"emitter 'tap' at 9e\+03 m/s needs 3,600 steps .* at most 1,000"):
        slow_edits(channel(6, emitters=(replace(tap(), velocity=(0.0, 0.0, -9e3)),)))


def test_nothing_flows_out_of_an_obstacle_that_covers_the_inlet_and_that_is_said(channel, tmp_path):
    dammed = channel(6, obstacles=(obstacle(position=(0.1, 0.4, 0.3)),))
    result = simulate(dammed, CONFIG, folder=tmp_path)
    assert "line 7: obstacle 'block' over the whole inlet: nothing flows in" in result.warnings[0]
    frames = [read_frame(frame_file(tmp_path, FIRST_FRAME + k)) for k in (0, 5)]
    particles = [set(f.ids[f.ids % 2 == 0]) for f in frames]  # odd ids are the skin's
    assert particles[1] and particles[1] <= particles[0]  # no new particle
    half = obstacle(position=(0.1, 0.0, 0.3))
    assert simulate(channel(6, obstacles=(half,)), CONFIG, folder=tmp_path / "half").warnings == ()


def test_an_obstacle_in_the_place_of_all_of_the_fluid_is_refused(channel, tmp_path):
    whole = Obstacle("block", box_mesh(np.full(3, 4.0)), line="scene.yaml, line 7")
    with pytest.raises(InputRejected, match="line 7: obstacle 'block' in the place of all of the fluid"):
        simulate(channel(6, obstacles=(whole,)), CONFIG, folder=tmp_path)
    assert not frame_files(tmp_path)


def test_among_obstacles_no_particle_passes_more_than_a_cell_in_a_substep(channel):
    free = simulator_of(channel(6))
    kept = simulator_of(channel(6, obstacles=(obstacle(position=(0.1, 0.0, 0.3)),)))
    assert kept._reach() == pytest.approx(kept.grid.spacing)
    # a particle meets a wall where its step ends: where nothing thin stands it may go twice as far
    assert free._reach() == pytest.approx(2.0 * free.grid.spacing)
