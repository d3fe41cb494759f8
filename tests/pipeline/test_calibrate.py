"""The force that keeps the filmed flow: where it comes from, what it does, and where a person's edits take it away."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.config import JobConfig, build_config
from fluidlift.errors import InputRejected
from fluidlift.io.asset_folder import FILES, load_asset, read_manifest
from fluidlift.io.force_file import read_filmed, write_filmed
from fluidlift.messages import code_of
from fluidlift.numerics.sampling import sample_faces
from fluidlift.physics import guidance
from fluidlift.physics.guidance import Nudging
from fluidlift.physics.inflow_schedule import InflowSchedule
from fluidlift.pipeline.stages.calibrate import GAIN, STRONG, calibrate, mean_target
from fluidlift.scene.build import SceneSettings, SimulationRequest, scene_of
from fluidlift.scene.coarse_copy import coarser
from fluidlift.scene.force_weight import following
from fluidlift.scene.simulator import simulator_of
from fluidlift.types import CellType, FaceVelocity, Filmed, FilmedMotion, Grid

FRAMES = 14


def of(scene) -> SimpleNamespace:
    """What counts of the asset that a scene comes from."""
    return SimpleNamespace(grid=scene.terrain.grid, terrain=scene.terrain)


def shares(follow: float = 0.0, guide: float = 0.0) -> SceneSettings:
    """How much of the filmed flow is kept."""
    return SceneSettings(None, follow, guide, 0)


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


def test_the_target_is_the_mean_of_all_frames_and_other_stretches_count_by_theirs(channel):
    scene = channel(2)
    grid, asset = scene.terrain.grid, SimpleNamespace(cell_types=scene.cell_types)
    targets = [uniform(grid, (1.0, 0.0, 0.0)), uniform(grid, (3.0, 0.0, 0.0))]
    motion = SimpleNamespace(velocities=targets, mean=None, completed=np.zeros((30, 1, 1, 2)))
    liquid = scene.cell_types == CellType.FLUID

    def along(*given) -> float:
        return float(mean_target(asset, *given).at_centers()[liquid][:, 0].mean())

    assert along(motion) == pytest.approx(2.0)
    whole = SimpleNamespace(velocities=targets, mean=uniform(grid, (1.0, 0.0, 0.0)), completed=motion.completed)
    assert along(whole) == pytest.approx(1.0)
    other = SimpleNamespace(velocities=[[uniform(grid, (5.0, 0.0, 0.0))] * 2])
    assert along(motion, other) == pytest.approx(3.5)
    assert along(whole, other) == pytest.approx((30 * 1.0 + 2 * 5.0) / 32)


def test_smoke_and_pours_are_not_calibrated(channel):
    scene = replace(channel(2), kind="pour")
    assert calibrate(scene, scene.velocity).force is None


def test_of_a_pour_that_stays_the_cells_that_the_clip_shows_dry_are_kept_and_no_force(channel):
    scene = replace(channel(2), kind="pour")
    shares = np.zeros(scene.camera.size[::-1], np.float32)
    shares[:, :20] = 0.9  # 96 px per 1.8 to 2 m: x below some 0.38 m
    shares[:, :10] = 1.0
    found = calibrate(scene, scene.velocity, shares)
    assert found.force is not None and not any(c.any() for c in found.force.components)
    assert found.frames is None and found.dry is not None
    centres = scene.terrain.grid.low + (np.argwhere(found.dry) + 0.5) * scene.terrain.grid.spacing
    assert len(centres) and centres[:, 0].min() > 0.38
    always = scene.terrain.grid.low + (np.argwhere(found.wet) + 0.5) * scene.terrain.grid.spacing
    assert len(always) and always[:, 0].max() < 0.2
    assert calibrate(replace(scene, kind="plume"), scene.velocity, shares).dry is None


def test_a_force_is_learnt_from_what_lies_and_not_from_what_falls(channel, monkeypatch):
    gains = []
    monkeypatch.setattr(
        guidance, "Nudging", lambda *args, **given: gains.append(given["gain"]) or Nudging(*args, **given)
    )
    for kind in ("stream", "fall"):
        scene = replace(channel(3), kind=kind)
        calibrate(scene, scene.velocity)
    assert gains == [GAIN, 0.0]


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
    assert following(scene, asset, Filmed(force), shares(0.0)).force is None
    np.testing.assert_allclose(following(scene, asset, Filmed(force), shares(0.5)).force.u, 0.5)
    dug = scene.terrain.signed_distance.copy()
    place = (2, 4, 2)
    dug[place] += grid.spacing
    there = following(
        replace(scene, terrain=replace(scene.terrain, signed_distance=dug)), asset, Filmed(force), shares(1.0)
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
    found = following(other, of(scene), Filmed(force), shares(1.0))
    assert found.force is None and found.dry is None and "left out" in found.notes[-1]


def test_a_coarser_copy_gets_a_coarser_force(tmp_path, made):
    asset = coarser(load_asset(made.folder))
    grid = load_asset(made.folder).grid
    dry = np.zeros(grid.shape, bool)
    dry[:4, :3] = True
    way = np.linspace(0.0, 0.3, 12).reshape(4, 3)
    write_filmed(tmp_path, Filmed(uniform(grid, (1.0, 2.0, 3.0)), dry, 0.4, dry[::-1], inlet=way))
    (tmp_path / "empty").mkdir()
    scene = scene_of(asset, tmp_path / "empty", SimulationRequest(meshes=tmp_path), JobConfig(), footage=None, start=0)
    assert scene.force.shape == asset.grid.shape
    np.testing.assert_allclose(scene.force.w[1:-1, 1:-1, 1:-1], 3.0)
    assert scene.dry.shape == asset.grid.shape and scene.dry[:2, 0].all() and not scene.dry[2:].any()
    assert not scene.dry[:, 1:].any(), "a wide cell is dry where all of it is"
    assert scene.dry_for == 0.4
    np.testing.assert_allclose(scene.inlet, way, atol=1e-6)
    assert scene.wet.any() and not (scene.wet & scene.dry).any(), "cells that stay wet are kept beside them"


def test_a_damaged_force_is_refused_with_what_to_do(tmp_path):
    (tmp_path / "rest").mkdir()
    (tmp_path / FILES["force"]).write_bytes(b"no arrays")
    with pytest.raises(InputRejected):
        read_filmed(tmp_path)
    np.savez(tmp_path / FILES["force"], u=np.zeros((3, 2, 2)), v=np.zeros((2, 2, 2)), w=np.zeros((2, 2, 3)))
    with pytest.raises(InputRejected, match="make the asset again"):
        read_filmed(tmp_path)


@pytest.mark.parametrize("inlet", [np.zeros((4, 2), np.float32), np.full((4, 3), np.nan, np.float32), np.zeros((4, 3)),
                                   np.zeros((0, 3), np.float32), np.zeros((100_000, 3), np.float32)])  # fmt: skip
def test_a_way_of_the_inlet_that_is_none_is_refused(tmp_path, inlet):
    (tmp_path / "rest").mkdir()
    force = {"u": np.zeros((3, 2, 2)), "v": np.zeros((2, 3, 2)), "w": np.zeros((2, 2, 3))}
    np.savez(tmp_path / FILES["force"], **force)
    assert read_filmed(tmp_path).inlet is None
    np.savez(tmp_path / FILES["force"], **force, inlet=inlet)
    with pytest.raises(InputRejected, match=r"inlet|finite"):
        read_filmed(tmp_path)


def film(grid, speeds, interval: float = 0.1, start: int = 0) -> FilmedMotion:
    """Frames that all move along x."""
    frames = [uniform(grid, (s, 0.0, 0.0)).components for s in speeds]
    u, v, w = (np.stack(c).astype(np.float16) for c in zip(*frames))
    return FilmedMotion(u, v, w, interval, start)


def test_a_pool_at_rest_needs_no_force(channel):
    """Gravity and pressure balance: a pull that saw the one without the other would carry a part of the weight."""
    scene = channel(FRAMES)
    still = FaceVelocity.zeros(scene.terrain.grid)
    calm = replace(scene, velocity=still, body=replace(scene.body, velocities=np.zeros_like(scene.body.velocities)),
                   cell_types=np.where(scene.cell_types == CellType.EMPTY, CellType.EMPTY, CellType.FLUID)
                   .astype(np.uint8))  # fmt: skip
    rates = tuple(np.full(c.shape, 10.0, np.float32) for c in still.components)
    pull = Nudging(still, rates, after=0.2)
    simulator = simulator_of(calm, forces=(pull,))
    for _ in range(FRAMES):
        simulator.advance(scene.interval)
    inside = scene.cell_types == CellType.FLUID
    assert abs(pull.mean().at_centers()[inside][:, 2].mean()) < 0.01 * 9.81


def test_a_guided_run_goes_through_the_speeds_of_its_film_where_a_free_one_does_not(channel):
    scene = channel(FRAMES)
    speed = 2.0 * float(np.linalg.norm(scene.parameters.inflow_velocity))
    asset, motion = of(scene), film(scene.terrain.grid, (speed, 0.0), interval=0.5 * FRAMES * scene.interval)
    guided = following(scene, asset, Filmed(motion=motion), shares(guide=1.0))
    assert guided.force is None and guided.guide is not None

    def pace(of_scene) -> list[float]:
        simulator, found = simulator_of(of_scene), []
        for _ in range(FRAMES - 1):
            simulator.advance(scene.interval)
            found.append(float(simulator.particles.velocities[:, 0].mean()))
        return found

    swinging, free = pace(guided), pace(scene)
    middle = FRAMES // 2 - 1
    # the film's second frame, which stands still, is in the middle of the run
    assert max(swinging[:middle]) - swinging[middle] > 3.0 * np.ptp(free)
    assert max(swinging[middle:]) - swinging[middle] > 3.0 * np.ptp(free)
    assert scene.parts.get("guide") is None and "guide" in guided.parts, "a run that goes on is not that of another"


def test_a_guide_that_the_asset_lacks_is_said(channel):
    scene = channel(2)
    found = following(scene, of(scene), Filmed(), shares(guide=1.0))
    assert found.guide is None and [code_of(n) for n in found.notes] == ["guide-missing"]


def test_the_guide_fades_where_the_ground_was_dug(channel):
    scene = channel(2)
    dug = scene.terrain.signed_distance.copy()
    dug[2, 4, 2] += scene.terrain.grid.spacing
    edited = replace(scene, terrain=replace(scene.terrain, signed_distance=dug))
    found = following(edited, of(scene), Filmed(motion=film(scene.terrain.grid, (1.0,))), shares(guide=1.0))
    assert found.guide_rates[0][2, 4, 2] == 0.0 < found.guide_rates[0][-1, 4, 2]


def test_the_motion_of_each_frame_is_kept_in_the_asset_and_read_when_asked_for(tmp_path, channel):
    grid = channel(2).terrain.grid
    motion = film(grid, (1.0, 2.0, 3.0), interval=0.04, start=1)
    write_filmed(tmp_path, Filmed(motion=motion))
    assert read_filmed(tmp_path).motion is None and not (tmp_path / FILES["force"]).exists()
    found = read_filmed(tmp_path, motion=True).motion
    assert found is not None and (found.interval, found.start) == (0.04, 1)
    np.testing.assert_array_equal(found.u, motion.u)
    write_filmed(tmp_path, Filmed())
    assert not (tmp_path / FILES["motion"]).exists(), "that of an older run"
    np.savez(tmp_path / FILES["motion"], u=motion.u, v=motion.v[:2], w=motion.w, interval=0.04, start=0)
    with pytest.raises(InputRejected, match="make the asset again"):
        read_filmed(tmp_path, motion=True)


def test_a_coarser_copy_gets_a_coarser_motion(tmp_path, made):
    asset, grid = coarser(load_asset(made.folder)), load_asset(made.folder).grid
    write_filmed(tmp_path, Filmed(motion=film(grid, (1.0, 2.0))))
    (empty := tmp_path / "empty").mkdir()
    config = build_config(overrides=["simulate.guide=1"])
    scene = scene_of(asset, empty, SimulationRequest(meshes=tmp_path), config, footage=None, start=0)
    assert scene.guide is not None and scene.guide.shape == asset.grid.shape
    np.testing.assert_allclose(scene.guide.u[:, 1:-1, 1:-1, 1:-1].mean(axis=(1, 2, 3)), (1.0, 2.0))


def test_between_the_frames_of_a_film_the_way_is_even_and_it_begins_anew():
    motion = film(Grid((2, 2, 2), 1.0), (0.0, 1.0, 2.0), interval=0.5, start=1)
    assert motion.around(0.0) == (1, 2, 0.0)
    assert motion.around(0.75) == (2, 0, pytest.approx(0.5))
    assert motion.around(1.5) == (1, 2, pytest.approx(0.0))
    with pytest.raises(ValueError, match="same frames"):
        replace(motion, v=motion.v[:2])
