"""The force that keeps the filmed flow: where it comes from, what it does, and where a person's edits take it away."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.io.asset_folder import FILES, load_asset, read_manifest
from fluidlift.io.force_file import read_filmed, write_filmed
from fluidlift.messages import code_of
from fluidlift.numerics.sampling import sample_faces
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.pipeline.stages.calibrate import STRONG, calibrate
from fluidlift.scene.build import SimulationRequest, scene_of
from fluidlift.scene.coarse_copy import coarser
from fluidlift.scene.force_weight import following
from fluidlift.scene.simulator import simulator_of
from fluidlift.types import FaceVelocity, Filmed

FRAMES = 14


def of(scene) -> SimpleNamespace:
    """What counts of the asset that a scene comes from."""
    return SimpleNamespace(grid=scene.terrain.grid, terrain=scene.terrain)


def uniform(grid, acceleration) -> FaceVelocity:
    """The same force everywhere."""
    return FaceVelocity(*(np.full(grid.face_shape(a), acceleration[a], np.float32) for a in range(3)))


def away_from(scene, target: FaceVelocity, force: FaceVelocity | None) -> float:
    """Mean difference of the particles' horizontal velocity from a target over the last half of a run, m/s."""
    simulator, found = simulator_of(replace(scene, force=force)), []
    for k in range(1, FRAMES):
        simulator.advance(scene.interval)
        if k >= FRAMES // 2:
            p = simulator.particles
            wanted = sample_faces(target, scene.terrain.grid, p.positions)
            found.append(np.linalg.norm((p.velocities - wanted)[:, :2], axis=1).mean())
    return float(np.mean(found))


def test_the_force_of_a_calibration_keeps_a_flow_that_a_free_run_leaves(channel):
    scene = channel(FRAMES)
    # twice as fast as what flows in: bed and discharge do not explain it
    target = FaceVelocity(*(2.0 * c for c in scene.velocity.components))
    found = calibrate(scene, target)
    free, kept = away_from(scene, target, None), away_from(scene, target, found.force)
    assert kept < 0.8 * free, "the force alone brings the flow at least a fifth of the way to the target"


def test_a_target_that_contradicts_shape_and_mass_is_said(channel):
    scene = channel(FRAMES)
    against = FaceVelocity(*(-c for c in scene.velocity.components))  # towards the inlet
    found = calibrate(scene, against)
    assert found.left > STRONG
    assert "flow-not-held" in map(code_of, found.warnings)


def test_smoke_and_pours_are_not_calibrated(channel):
    scene = replace(channel(2), kind="pour")
    assert calibrate(scene, scene.velocity).force is None


def test_an_asset_of_a_stream_carries_its_force_and_says_how_strong_it_is(made):
    asset, force = load_asset(made.folder), read_filmed(made.folder).force
    assert force is not None and force.shape == asset.grid.shape
    assert all(np.isfinite(c).all() for c in force.components)
    figures = read_manifest(made.folder)["metrics"]["calibration"]
    assert figures["acceleration"] > 0 and figures["frames"] > 1
    assert "force" in read_manifest(made.folder)["files"]


def test_the_force_fades_around_what_was_put_in_and_stays_elsewhere(tmp_path, channel):
    scene = channel(2)
    grid = scene.terrain.grid
    force, asset = uniform(grid, (1.0, 0.0, 0.0)), of(scene)
    assert following(scene, asset, Filmed(force), 0.0).force is None
    np.testing.assert_allclose(following(scene, asset, Filmed(force), 0.5).force.u, 0.5)
    dug = scene.terrain.signed_distance.copy()
    place = (2, 4, 2)
    dug[place] += grid.spacing
    there = following(
        replace(scene, terrain=replace(scene.terrain, signed_distance=dug)), asset, Filmed(force), 1.0
    ).force
    assert there.u[place] == 0.0, "no force where the ground was dug"
    assert there.u[-1, 4, 2] == 1.0, "all of it ten cells from there: two of them were touched, and it needs six"
    assert (np.diff(there.u[2:, 4, 2]) >= 0).all()


@pytest.mark.parametrize("change", ["fluid", "inflow"])
def test_another_fluid_or_inflow_takes_the_force_away_and_that_is_noted(channel, change):
    scene = channel(2)
    force = uniform(scene.terrain.grid, (1.0, 0.0, 0.0))
    if change == "fluid":
        other = replace(scene, changes=("kinematic_viscosity",))
    else:
        other = replace(scene, inflow=InflowSchedule(((0.0, 2.0),)))
    found = following(other, of(scene), Filmed(force), 1.0)
    assert found.force is None and found.dry is None and "left out" in found.notes[-1]


def test_a_coarser_copy_gets_a_coarser_force(tmp_path, made):
    asset = coarser(load_asset(made.folder))
    grid = load_asset(made.folder).grid
    dry = np.zeros(grid.shape, bool)
    dry[:4, :3] = True
    write_filmed(tmp_path, Filmed(uniform(grid, (1.0, 2.0, 3.0)), dry))
    (tmp_path / "empty").mkdir()
    scene = scene_of(asset, tmp_path / "empty", SimulationRequest(meshes=tmp_path), JobConfig(), footage=None, start=0)
    assert scene.force.shape == asset.grid.shape
    np.testing.assert_allclose(scene.force.w[1:-1, 1:-1, 1:-1], 3.0)
    assert scene.dry.shape == asset.grid.shape and scene.dry[:2, 0].all() and not scene.dry[2:].any()
    assert not scene.dry[:, 1:].any(), "a wide cell is dry where all of it is"


def test_a_damaged_force_is_refused_with_what_to_do(tmp_path):
    (tmp_path / "rest").mkdir()
    (tmp_path / FILES["force"]).write_bytes(b"no arrays")
    with pytest.raises(InputRejected):
        read_filmed(tmp_path)
    np.savez(tmp_path / FILES["force"], u=np.zeros((3, 2, 2)), v=np.zeros((2, 2, 2)), w=np.zeros((2, 2, 3)))
    with pytest.raises(InputRejected, match="make the asset again"):
        read_filmed(tmp_path)
