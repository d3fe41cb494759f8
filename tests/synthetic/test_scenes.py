"""A scene is consistent with itself: its flow moves its surface, its liquid stays, its case can be read and scored."""

import json
from dataclasses import replace

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.evaluate import evaluate_arrays, read_case
from fluidlift.synthetic.record import Births, record, write_case
from fluidlift.synthetic.scenes import SCENES, scene_of
from fluidlift.types import CellType, FaceVelocity, FluidAsset, Gaussians, Grid, Particles, Similarity3

FRAMES = 3


@pytest.fixture(scope="module")
def tiny():
    """A stream of 24 cells and 3 frames."""
    scene = replace(scene_of("stream", size=(48, 32), seed=3, cells=24), settle=0.08)
    return scene, record(scene, FRAMES, seed=3)


@pytest.mark.parametrize("name", sorted(SCENES))
def test_scenes_are_seeded_outside_their_ground(name):
    scene = scene_of(name, size=(48, 32), seed=0, cells=20)
    assert len(scene.particles) > 100
    assert (scene.solid(scene.particles.positions) > 0).all()
    assert (scene.cell_types == CellType.INFLOW).any() == (name != "dam")
    assert scene.terrain.signed_distance.min() < 0 < scene.terrain.signed_distance.max()
    slope = np.linalg.norm(np.stack(np.gradient(scene.terrain.signed_distance, scene.grid.spacing), -1), axis=-1)
    near = np.abs(scene.terrain.signed_distance) < scene.grid.spacing
    # a first-order signed distance: the median slope next to the surface is 1 to a tenth
    assert np.median(slope[near]) == pytest.approx(1.0, abs=0.1)


def test_an_unknown_scene_and_an_impossible_size_are_rejected():
    with pytest.raises(InputRejected, match="stream"):
        scene_of("ocean", size=(48, 32), seed=0, cells=24)
    with pytest.raises(InputRejected, match="cells"):
        scene_of("stream", size=(48, 32), seed=0, cells=4)


def test_the_flow_carries_the_surface_onto_the_next_surface(tiny):
    scene, r = tiny
    moving = r.mask[:-1] & r.visible[:-1]
    assert moving.sum() > 0.6 * r.mask[:-1].sum()
    misses, still = [], []
    for t in range(FRAMES - 1):
        rows, columns = np.nonzero(moving[t])
        uv = np.stack([columns, rows], -1) + 0.5 + r.flow[t][moving[t]].astype(float)
        j, i = np.clip(np.floor(uv).astype(int), 0, np.array([47, 31])).T
        depth = r.depth[t][moving[t]].astype(float)
        misses.append(np.abs(r.depth[t + 1][i, j] - depth - r.dz[t][moving[t]])[r.mask[t + 1][i, j]])
        still.append(np.linalg.norm(r.flow[t][moving[t]], axis=-1))
    # the median miss is a fraction of a cell: one pixel of the sloped view already covers a third of one
    assert np.median(np.concatenate(misses)) < 0.35 * scene.grid.spacing
    assert np.median(np.concatenate(still)) > 0.2  # and it does move


def test_the_flow_on_the_screen_is_the_velocity_in_the_grid(tiny):
    scene, r = tiny
    key = int(r.key_frames[0])
    mask = r.mask[key]
    points = scene.camera.unproject(scene.camera.pixel_grid()[mask], r.depth[key][mask].astype(float))
    below = points - np.array([0, 0, 0.5 * scene.grid.spacing])
    cells = np.clip(scene.grid.cell_of(below), 0, np.array(scene.grid.shape) - 1)
    velocity = r.grid_velocity[0][tuple(cells.T)].astype(float)
    uv, _ = scene.camera.project(points)
    there, _ = scene.camera.project(points + velocity / scene.fps)
    flow = r.flow[key][mask].astype(float)
    error = np.linalg.norm(there - uv - flow, axis=-1)
    # the velocity is that of one instant and one cell, the flow an average over a frame: a quarter of the motion
    assert np.median(error) < 0.25 * np.median(np.linalg.norm(flow, axis=-1))


def test_the_liquid_stays(tiny):
    scene, r = tiny
    through = scene.parameters.inflow_velocity[0] / scene.fps  # m per frame at the inlet
    share = through / (scene.grid.high[0] - scene.grid.low[0])
    change = np.abs(np.diff(r.particle_count)) / r.particle_count[0]
    assert (change < share).all()  # in and out differ by less than all that comes in
    volume = (r.grid_phi[-1].astype(float) < 0).sum() / (r.grid_phi[0].astype(float) < 0).sum()
    assert volume == pytest.approx(1.0, abs=0.05)


def test_pictures_show_the_liquid_where_the_mask_is(tiny):
    _, r = tiny
    assert r.frames.shape == (FRAMES, 32, 48, 3) and r.frames.std() > 10
    mask = r.mask[0]
    blueness = r.frames[0][..., 2].astype(float) - r.frames[0][..., 0]
    assert blueness[mask].mean() > blueness[~mask].mean() + 10
    assert (r.static_depth > 0).all()


def asset_of(scene, r) -> FluidAsset:
    """The truth of a recording as an asset: velocities averaged from cells to faces."""
    grid = scene.grid
    fluid = r.grid_phi[0] < 0
    types = np.where(fluid, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    cells = r.grid_velocity[0].astype(np.float32)
    faces = []
    for axis in range(3):
        pad = [(0, 0)] * 3
        pad[axis] = (1, 1)
        wide = np.moveaxis(np.pad(cells[..., axis], pad, mode="edge"), axis, 0)
        faces.append(np.ascontiguousarray(np.moveaxis(0.5 * (wide[1:] + wide[:-1]), 0, axis)))
    return FluidAsset(
        scene.kind, Gaussians.empty(), scene.terrain, grid, types, FaceVelocity(*faces), scene.parameters, {},
        scene.camera, Similarity3(), 1 / scene.fps, FRAMES,
    )  # fmt: skip


def test_a_written_case_is_read_back_and_scores_its_own_truth_well(tiny, tmp_path):
    scene, r = tiny
    case = read_case(write_case(scene, r, tmp_path / "case"))
    np.testing.assert_array_equal(case.mask, r.mask)
    np.testing.assert_array_equal(case.flow, r.flow)
    assert case.level_set is not None and list(case.solids) == ["terrain"]
    assert case.interval == pytest.approx(1 / scene.fps)
    run = {"front_depth": r.depth[0].astype(np.float32), "flow_raw": r.flow[:-1], "labels": r.mask.astype(np.uint8)}
    sheet = evaluate_arrays(asset_of(scene, r), run, {}, case)
    assert sheet["flow.raw.epe"] == 0 and sheet["segmentation.iou"] == 1
    assert sheet["geometry.scale"] == pytest.approx(1.0)
    assert sheet["geometry.occupancy_iou"] == 1.0
    assert sheet["volume.cosine"] > 0.98  # two averages lie between the stored field and the sampled one
    for name in ("gravity", "viscosity"):
        assert sheet[f"parameters.{name}.relative_error"] == pytest.approx(0.0, abs=1e-12)
    assert sheet["parameters.gravity.within_2_sigma"] is None


def test_the_same_seed_gives_the_same_truth(tiny):
    scene, r = tiny
    again = record(scene, 2, seed=3)
    np.testing.assert_array_equal(again.frames[0], r.frames[0])
    np.testing.assert_array_equal(again.flow[0], r.flow[0])


def test_tracers_that_flow_in_continue_the_pattern():
    births = Births((2.0, 0.0, 0.0))
    first = Particles.at_rest(np.array([[0.0, 0, 0]]), 1.0)
    births.update(first, 0.0)
    later = Particles.at_rest(np.array([[1.0, 0, 0]]), 1.0, first_id=1)  # enters at x = 1 half a second later
    births.update(first.joined(later), 0.5)
    # both lie at the same place of the pattern that drifts with 2 m/s
    np.testing.assert_allclose(births.origins(np.array([0, 1])), 0.0, atol=1e-12)


def test_scene_json_holds_what_was_simulated(tiny, tmp_path):
    scene, r = tiny
    folder = write_case(scene, r, tmp_path / "case")
    data = json.loads((folder / "scene.json").read_text())
    assert data["gravity"] == [0, 0, -9.81] and data["viscosity_m2_s"] == scene.parameters.kinematic_viscosity
    assert Grid(tuple(data["grid"]), data["dx"], tuple(data["domain_min"])) == scene.grid
