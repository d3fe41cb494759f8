"""Simulation while somebody edits: coarse, cancellable, the newest wish first, the last good frames kept."""

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.pipeline import preview
from fluidlift.pipeline.preview import (
    LivePreview,
    PreviewFrame,
    PreviewRequest,
    PreviewSize,
    coarse_asset,
    obstacles_of,
    preview_frames,
    preview_scene,
    thinned,
)
from fluidlift.scene.simulator import simulator_of
from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Grid,
    PinholeCamera,
    Similarity3,
    Terrain,
    TriangleMesh,
)

SPACING = 0.05


def tank(cells=(12, 8, 8)) -> FluidAsset:
    """A block of water that is let go at one end of a tank."""
    grid = Grid(cells, SPACING)
    centers = grid.centers()
    wet = (centers[..., 0] < 0.5 * grid.high[0]) & (centers[..., 2] < 0.75 * grid.high[2])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    means = (centers[wet][:, None, :] + 0.25 * SPACING * corners).reshape(-1, 3)
    rest = Gaussians.isotropic(means, 0.4 * SPACING, np.full((len(means), 3), 0.5))
    solid = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    terrain = Terrain(grid, (grid.nodes()[..., 2] + 0.5 * SPACING).astype(np.float32), np.array([1.0, 0, 0]), solid)
    camera = PinholeCamera.looking(np.array([0.3, -2.0, 0.5]), np.array([0.3, 0.2, 0.2]), 50.0, (64, 48))
    types = np.where(wet, CellType.FLUID, CellType.EMPTY).astype(np.uint8)
    return FluidAsset(
        "pour", rest, terrain, grid, types, FaceVelocity.zeros(grid), FluidParameters(), {}, camera, Similarity3(),
        0.04, 6,
    )  # fmt: skip


# coarsening ----------------------------------------------------------------------------------------------------


def test_cells_double_until_both_limits_hold():
    asset = tank((24, 16, 16))
    coarse = coarse_asset(asset, PreviewSize(particles=2000, cells=10_000))
    assert len(coarse.rest) <= 2000 and coarse.grid.cells <= 10_000
    ratio = coarse.grid.spacing / SPACING
    assert ratio == 2 ** round(np.log2(ratio)) > 1
    assert coarse.velocity.shape == coarse.cell_types.shape == coarse.grid.shape == coarse.terrain.grid.shape
    wet = (coarse.cell_types == CellType.FLUID).sum() * coarse.grid.spacing**3
    # the block ends on even cells: its volume is kept
    assert wet == pytest.approx((asset.cell_types == CellType.FLUID).sum() * SPACING**3, rel=1e-9)


def test_an_asset_that_is_small_enough_stays_as_it_is():
    asset = tank()
    assert coarse_asset(asset) is asset


def test_thinned_splats_keep_their_volume_cell_by_cell():
    asset = tank((8, 8, 8))
    few = thinned(asset.rest, asset.grid, 2)
    cells, count = np.unique(asset.grid.cell_of(few.means), axis=0, return_counts=True)
    assert (count == 2).all() and len(cells) == len(asset.rest) // 8
    assert np.prod(few.scales, axis=1).sum() == pytest.approx(np.prod(asset.rest.scales, axis=1).sum(), rel=1e-5)


# one simulation ------------------------------------------------------------------------------------------------


def test_the_block_falls_and_the_first_frame_is_the_body_at_rest(tmp_path):
    asset = tank()
    frames = list(preview_frames(preview_scene(asset, tmp_path, {}, 5)))
    assert [f.number for f in frames] == [0, 1, 2, 3, 4]
    heights = [f.gaussians.means[:, 2].mean() for f in frames]
    assert heights[-1] < heights[0] - 0.5 * SPACING
    assert frames[0].velocities.shape == frames[0].gaussians.means.shape


def test_edits_that_are_written_nowhere_change_the_simulation(tmp_path):
    asset = tank()
    up = {"parameters": {"gravity": [0, 0, 4.0]}, "look": {"environment": "not-here.hdr"}}
    last = list(preview_frames(preview_scene(asset, tmp_path, up, 4)))[-1]
    assert last.velocities[:, 2].mean() > 0.1
    assert not list(tmp_path.iterdir())


def test_a_floating_obstacle_is_in_the_frames_with_its_pose(tmp_path):
    asset = tank()
    body = {"shape": "sphere", "radius": 0.06, "position": [0.45, 0.2, 0.2], "motion": "free", "density": 300}
    frames = list(preview_frames(preview_scene(asset, tmp_path, {"obstacles": [body]}, 4)))
    assert frames[0].poses.shape == (1, 7)
    assert frames[-1].poses[0, 2] < frames[0].poses[0, 2] - 0.01  # in the air of the tank: it falls
    (found,) = obstacles_of(tmp_path, {"obstacles": [body]})
    np.testing.assert_allclose(found.position, frames[0].poses[0, :3])


def test_a_simulation_ends_as_soon_as_it_is_cancelled(tmp_path):
    seen = []
    for frame in preview_frames(preview_scene(tank(), tmp_path, {}, 100), lambda: len(seen) >= 3):
        seen.append(frame.number)
    assert seen == [0, 1, 2]


def test_what_moves_too_fast_to_follow_is_a_breakdown_and_not_a_wait(tmp_path):
    scene = preview_scene(tank(), tmp_path, {}, 10)
    extreme = replace(scene, parameters=replace(scene.parameters, gravity=(0.0, 0.0, -1e6)))
    frames = preview_frames(extreme)
    assert next(frames).number == 0
    with pytest.raises(FluidliftError):
        list(frames)


def test_edits_that_do_not_fit_are_refused_before_anything_moves(tmp_path):
    with pytest.raises(InputRejected, match="density"):
        preview_scene(tank(), tmp_path, {"parameters": {"density": -1}}, 5)


# the worker ----------------------------------------------------------------------------------------------------


class Studio:
    """Stands in for the simulator: frames come when they are allowed to, and some edits break."""

    def __init__(self, monkeypatch, total=4):
        self.total, self.allowed, self.served, self.asked = total, threading.Semaphore(0), [], []
        monkeypatch.setattr(preview, "preview_scene", self.scene)
        monkeypatch.setattr(preview, "preview_frames", self.frames)

    def scene(self, asset, folder, edits, frames):
        self.asked.append(edits)
        if edits.get("refused"):
            raise InputRejected("a gravity of nothing", "numbers")
        scene = type("Scene", (), {})()
        scene.edits, scene.frames, scene.interval, scene.terrain = edits, self.total, 0.1, asset.terrain
        return scene

    def frames(self, scene, cancelled=lambda: False):
        if "name" not in scene.edits:  # warming up, or rehearsed
            return
        self.served.append(scene.edits["name"])
        for k in range(self.total):
            while not self.allowed.acquire(timeout=0.01):
                if cancelled():
                    return
            if cancelled():
                return
            if k == scene.edits.get("breaks"):
                raise FluidliftError("too fast")
            yield PreviewFrame(k, (scene.edits["name"], k), np.zeros((0, 3)), np.zeros((0, 7)))

    def let(self, frames):
        for _ in range(frames):
            self.allowed.release()


@pytest.fixture
def studio(monkeypatch):
    return Studio(monkeypatch)


@pytest.fixture
def live(studio, tmp_path):
    worker = LivePreview(tank(), tmp_path, keep=lambda frame: frame.gaussians)
    worker.start()
    until(lambda: worker.phase == "ready")
    yield worker
    worker.close()


def until(condition, seconds=10.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.002)


def wish(name, **edits):
    return PreviewRequest({"name": name} | edits, f"{name} moved")


def test_what_an_edit_may_bring_is_rehearsed_on_a_scene_that_bears_it(tmp_path):
    thick, floating = (preview_scene(tank(), tmp_path, edits, 2) for edits in preview.rehearsals(tank()))
    simulator = simulator_of(thick)
    assert simulator.advance(thick.interval).viscosity  # solved for, which water at this resolution is not
    assert not simulator_of(preview_scene(tank(), tmp_path, {}, 2)).advance(thick.interval).viscosity
    frames = list(preview_frames(floating))
    assert len(frames) == 2 and frames[1].poses.shape == (1, 7)
    assert frames[1].poses[0, 2] != frames[0].poses[0, 2]  # it moves


def test_nothing_is_rehearsed_once_somebody_wants_something(studio, tmp_path):
    worker = LivePreview(tank(), tmp_path)
    worker.ask(wish("a"))
    studio.let(4)
    worker.start()
    until(lambda: worker.shown is not None and worker.shown.complete)
    assert [edits for edits in studio.asked if edits] == [{"name": "a"}]
    worker.close()


def test_a_wish_is_shown_frame_by_frame_until_it_is_complete(live, studio):
    live.ask(wish("a"))
    studio.let(2)
    until(lambda: live.shown is not None and len(live.shown.frames) == 2)
    assert live.busy and not live.shown.complete
    studio.let(2)
    until(lambda: live.shown.complete and not live.busy)
    assert live.shown.frames == [("a", k) for k in range(4)] and not live.problem


def test_the_newest_wish_wins_and_those_between_are_never_begun(live, studio):
    live.ask(wish("a"))
    until(lambda: studio.served == ["a"])
    for name in "bcde":
        live.ask(wish(name))
    studio.let(10)
    until(lambda: not live.busy)
    assert studio.served[0] == "a" and studio.served[-1] == "e" and len(studio.served) <= 3
    assert live.shown.frames == [("e", k) for k in range(4)]


def test_the_last_good_frames_stay_until_a_newer_first_frame_is_there(live, studio):
    live.ask(wish("a"))
    studio.let(4)
    until(lambda: not live.busy)
    live.ask(wish("b"))
    studio.let(1)  # the body at rest, which shows nothing of the edit
    until(lambda: studio.served[-1] == "b" and live.phase == "running")
    assert live.shown.frames[0][0] == "a"
    studio.let(1)
    until(lambda: live.shown.frames[0][0] == "b")


def test_a_refused_edit_keeps_what_is_shown_and_is_named(live, studio):
    live.ask(wish("a"))
    studio.let(4)
    until(lambda: not live.busy)
    live.ask(wish("b", refused=True))
    until(lambda: live.problem)
    assert live.shown.frames[0][0] == "a"
    assert "'b moved'" in live.problem and "gravity of nothing" in live.problem
    live.ask(wish("c"))
    studio.let(4)
    until(lambda: not live.busy)
    assert live.shown.frames[0][0] == "c" and not live.problem


def test_a_breakdown_keeps_the_frames_before_it_and_names_the_edit(live, studio):
    live.ask(wish("b", breaks=3))
    studio.let(4)
    until(lambda: live.problem)
    assert live.shown.frames == [("b", k) for k in range(3)] and not live.shown.complete
    assert "'b moved'" in live.problem and "frame 1004" in live.problem and "too fast" in live.problem
    assert not live.busy


def test_a_breakdown_at_once_keeps_the_take_before(live, studio):
    live.ask(wish("a"))
    studio.let(4)
    until(lambda: not live.busy)
    live.ask(wish("b", breaks=1))
    studio.let(2)
    until(lambda: live.problem)
    assert live.shown.frames[0][0] == "a"


def test_while_it_is_held_nothing_is_simulated_and_afterwards_the_wish_is_served(live, studio):
    live.hold(True)
    live.ask(wish("a"))
    time.sleep(0.05)
    assert studio.served == []
    live.hold(False)
    studio.let(4)
    until(lambda: live.shown is not None and live.shown.complete)


def test_a_complete_wish_is_not_done_again_after_a_hold(live, studio):
    live.ask(wish("a"))
    studio.let(4)
    until(lambda: not live.busy)
    live.hold(True)
    live.hold(False)
    time.sleep(0.05)
    assert studio.served == ["a"]


def test_it_ends_in_the_middle_of_a_wish(live, studio):
    live.ask(wish("a"))
    until(lambda: studio.served == ["a"])
    live.close()
    assert not live._thread.is_alive()
