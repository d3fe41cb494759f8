"""Edits of the world reach the scene: emitters get a look and room, and a simulation that fails names its edits."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.numerics.solid_mesh import box_mesh
from fluidlift.physics.emitter import Emitter
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.physics.stepping import ParticleSimulator
from fluidlift.physics.terrain_edit import Rotate
from fluidlift.pipeline.looping import read_frame
from fluidlift.pipeline.reshaping import changed_parameters, in_words, with_emitters, with_terrain
from fluidlift.pipeline.scene import Scene
from fluidlift.pipeline.simulating import frame_file, simulate
from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidParameters,
    Gaussians,
    Grid,
    Particles,
    PinholeCamera,
    RigidTransform,
    Terrain,
    TriangleMesh,
)

H = 0.1
CONFIG = build_config(None, None, (), {})


def camera():
    """Looks straight down on the middle from 2 m above."""
    down = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return PinholeCamera((96.0, 96.0), (32.0, 24.0), (64, 48), RigidTransform(down, -down @ np.array([0.6, 0.4, 2.4])))


def channel(frames, **more):
    """Striped water that flows along a flat channel."""
    grid = Grid((12, 8, 6), H)
    nodes = grid.nodes()
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    terrain = Terrain(grid, (nodes[..., 2] - 0.1).astype(np.float32), np.array([1.0, 0.0, 0.0]), mesh)
    cells = np.zeros(grid.shape, np.uint8)
    cells[:, :, 0], cells[:, :, 1:3] = CellType.SOLID, CellType.FLUID
    cells[:2, :, 1:3], cells[-3:, :, 1:3] = CellType.INFLOW, CellType.OUTFLOW
    axes = [(np.arange(2 * n) + 0.5) * 0.5 * H for n in (12, 8, 2)]
    places = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3) + [0.0, 0.0, 0.1]
    shade = 0.5 + 0.4 * np.sin(17 * places[:, :1]) * np.cos(11 * places[:, 1:2])
    rest = Gaussians.isotropic(places, 0.04, np.repeat(shade, 3, axis=1), 0.9)
    velocity = FaceVelocity.zeros(grid)
    velocity = FaceVelocity(np.full_like(velocity.u, 0.6), velocity.v, velocity.w)
    body = Particles.at_rest(places, 1.0, np.arange(len(places)), np.broadcast_to([0.6, 0.0, 0.0], places.shape))
    parameters = FluidParameters(inflow_velocity=(0.6, 0.0, 0.0), time_step=0.04)
    scene = Scene("stream", rest, body, terrain, cells, velocity, parameters, camera(), 0.04, 0.04, frames, 0)
    return replace(scene, **more)


def tap(at=(0.6, 0.4, 0.9), **more):
    mesh = box_mesh(np.full(3, 0.2))
    return Emitter("tap", TriangleMesh(mesh.vertices + np.array(at), mesh.faces), (0.0, 0.0, -1.0), **more)


def test_a_red_tap_above_the_box_pours_red_water_into_the_frames(tmp_path):
    scene = with_emitters(channel(6), [tap(color=(0.9, 0.1, 0.1))])
    assert scene.terrain.grid.high[2] > 1.0  # the box was 0.6 m high
    assert simulate(scene, tmp_path, CONFIG).meta["frames"] == 6
    shown = read_frame(frame_file(tmp_path, FIRST_FRAME + 5)).gaussians
    new = shown.means[:, 2] > 0.5
    assert new.sum() > 50
    np.testing.assert_allclose(shown.rgb[new].mean(axis=0), [0.9, 0.1, 0.1], atol=0.03)  # 4 % lighter and darker
    assert not (shown.rgb[~new][:, 0] > 0.8).all()


def test_a_tap_without_a_colour_takes_that_of_the_nearest_water():
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
def test_a_tap_without_room_is_refused_with_its_line(at, words):
    with pytest.raises(InputRejected, match=rf"scene\.yaml, line 3: emitter 'tap'.*{words}"):
        with_emitters(channel(6), [tap(at, line="scene.yaml, line 3")])


def test_a_checkpoint_knows_its_emitters_inflow_and_terrain():
    plain = channel(6)
    scenes = [
        with_emitters(plain, [tap()]), with_emitters(plain, [tap(end=1.0)]), with_terrain(plain, [Rotate(10.0)]),
        replace(plain, inflow=InflowSchedule(((0.0, 2.0),))), plain,
    ]  # fmt: skip
    assert len({tuple(sorted(s.parts.items())) for s in scenes}) == len(scenes)
    assert with_terrain(plain, []) is plain
    assert with_emitters(plain, []) is plain


def test_a_turned_channel_has_a_turned_inflow():
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


def test_a_simulation_that_breaks_down_names_the_edits_and_keeps_its_frames(tmp_path, monkeypatch):
    scene = replace(channel(6), changes=("kinematic_viscosity 1e+03 (fitted: 1e-06)",))
    advance, calls = ParticleSimulator.advance, []

    def breaking(self, duration):
        calls.append(duration)
        if len(calls) == 4:
            raise FluidliftError("the simulation blew up.")
        return advance(self, duration)

    monkeypatch.setattr(ParticleSimulator, "advance", breaking)
    result = simulate(scene, tmp_path, CONFIG)
    assert result.meta["frames"] == 4
    assert "blew up. Edited in scene.yaml: kinematic_viscosity 1e+03" in result.meta["failed"]
    assert in_words(channel(6)) == ""


def test_too_many_particles_end_a_simulation_with_its_frames_and_a_word(tmp_path):
    few = build_config(None, None, ("simulate.max_particles=780",), {})
    result = simulate(with_emitters(channel(8), [tap(color=(1.0, 0.0, 0.0))]), tmp_path, few)
    assert 0 < result.meta["frames"] < 8
    assert "max_particles=780" in result.meta["warnings"][0]
