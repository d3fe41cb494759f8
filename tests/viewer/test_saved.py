"""What is on disk, and who else writes it."""

import os

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.asset_folder import update_manifest
from fluidlift.io.asset_lock import Holder
from fluidlift.io.stage_cache import mark_owner, save_stage
from fluidlift.io.stage_codec import packed
from fluidlift.scene.recall import simulated_poses
from fluidlift.types.stages import Simulation
from fluidlift.viewer import saved
from fluidlift.viewer.footage import InputPictures, input_pictures
from fluidlift.viewer.saved import SavedFrames


def test_frames_are_counted_and_missing_ones_named(tank_folder):
    found = SavedFrames(tank_folder)
    assert (found.count, found.interval, found.missing()) == (8, 0.04, [])
    (tank_folder / "frames" / "splats" / "1003.flsp").unlink()
    assert found.missing() == [1003]


def test_new_frames_of_somebody_else_are_noticed_once(tank_folder):
    found = SavedFrames(tank_folder)
    assert not found.look(ours=False)
    update_manifest(tank_folder, simulation={"frames": 5})
    assert found.look(ours=False) and found.count == 5
    assert not found.look(ours=False)


def test_another_process_that_writes_is_told_from_our_own_work(tank_folder, monkeypatch):
    found = SavedFrames(tank_folder)
    holder = [Holder(os.getpid() + 1, "a simulation")]
    monkeypatch.setattr(saved, "writer_of", lambda folder: holder[0])
    update_manifest(tank_folder, simulation={"frames": 5})
    assert not found.look(ours=False) and found.foreign and found.count == 8  # not read in the middle of it
    holder[0] = Holder(os.getpid(), "a simulation")
    assert found.look(ours=False) and not found.foreign
    holder[0] = None
    assert not found.foreign


def test_an_edit_by_hand_is_noticed(tank_folder):
    found = SavedFrames(tank_folder)
    assert not found.scene_changed()
    (tank_folder / "scene.yaml").write_text("parameters: {density: 900}\n")
    assert found.scene_changed() and not found.scene_changed()


def test_a_folder_that_is_no_asset_is_refused(tmp_path):
    with pytest.raises(InputRejected, match="not a fluidlift asset"):
        SavedFrames(tmp_path)


def test_without_clip_and_preview_there_are_no_input_pictures(tank_folder):
    found = SavedFrames(tank_folder)
    assert input_pictures(tank_folder, found.manifest, found.asset.camera, found.interval) is None


def test_the_picture_is_that_of_the_simulated_time():
    frames = np.arange(10, dtype=np.uint8)[:, None, None, None] * np.ones((1, 4, 6, 3), np.uint8)
    pictures = InputPictures("the clip", frames, interval=0.1, start=2)
    shown = [(int(p.max()), over) for p, over in map(pictures.at, (0.0, 0.31, 0.7, 5.0))]
    assert shown == [(2, False), (5, False), (9, False), (9, True)]


def test_poses_of_obstacles_are_those_of_the_last_simulation_and_of_so_many_bodies_and_frames(tank_folder):
    poses = np.arange(3 * 2 * 7, dtype=float).reshape(3, 2, 7)
    assert simulated_poses(tank_folder) is None
    arrays, data = packed(Simulation(np.ones(len(poses)), np.zeros(len(poses)), np.ones(len(poses), int), poses))
    save_stage(tank_folder, "simulate", "0" * 16, arrays, {"seconds": 1.0, "value": data})
    mark_owner(tank_folder, "simulate", "0" * 16)
    np.testing.assert_array_equal(simulated_poses(tank_folder, 2, 3), poses)
    assert simulated_poses(tank_folder, 1) is None  # of another scene
    assert simulated_poses(tank_folder, 2, 4) is None  # of a shorter one
    found = SavedFrames(tank_folder)
    np.testing.assert_array_equal(found.poses(2), poses[2])
    assert found.poses(3) is None
