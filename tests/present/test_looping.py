"""A loop's last frame leads into its first one, and the fluid stays as opaque as it is while it fades."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.io.frames import FIRST_FRAME, FluidFrame
from fluidlift.look.rasterize import render
from fluidlift.pipeline.resimulate import resimulate
from fluidlift.pipeline.settings import SimulateSettings, taken
from fluidlift.pipeline.stages.simulate import simulate
from fluidlift.pipeline.work import Work
from fluidlift.present.looping import (
    blended,
    blended_poses,
    changed_over,
    faded,
    patch_size,
    seam,
)
from fluidlift.scene.build import LOOP_FADE, loop_overlap
from fluidlift.scene.edits import EditSession
from fluidlift.scene.splat_files import checkpoint_file, frame_file, frame_files, read_frame
from fluidlift.types import CellType, FluidParameters, Gaussians


def pictures(folder, count, camera):
    frames = [read_frame(frame_file(folder, FIRST_FRAME + k)).gaussians for k in range(count)]
    return np.stack([render(g, camera).image for g in frames])


def frame(ids, opacity=0.9, shift=0.0):
    ids = np.asarray(ids)
    means = np.stack([0.1 * ids + shift, 0.4 + 0.0 * ids, 0.2 + 0.0 * ids], axis=1)
    gaussians = Gaussians.isotropic(means, 0.05, np.full((len(ids), 3), 0.7), opacity)
    return FluidFrame(gaussians, ids, np.zeros((len(ids), 3), np.float32))


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 1.0])
def test_two_bodies_that_fade_into_each_other_let_through_as_much_light_as_one(share, camera):
    rng = np.random.default_rng(0)

    def clouds():
        """Splats of a river's opacities by chance; in a regular sheet, somewhere; the opacity in their middle."""
        even = np.stack(np.meshgrid(*[np.arange(-4, 16) * 0.06] * 2, indexing="ij"), -1).reshape(-1, 2)
        loose = rng.uniform([0.3, 0.2, 0.1], [0.9, 0.6, 0.3], (60, 3))
        sheet = np.column_stack([even + rng.uniform(0, 0.06, 2), np.full(len(even), 0.2)])
        for means in (loose, sheet):
            n = len(means)
            gaussians = Gaussians.isotropic(means, 0.03, np.full((n, 3), 0.7), rng.uniform(0.7, 0.96, n))
            yield FluidFrame(gaussians, np.arange(n), np.zeros((n, 3), np.float32))

    def opacity(gaussians):
        return render(gaussians, camera).alpha[16:32, 24:40].mean()

    found = [
        (opacity(tail.gaussians), opacity(blended(head, tail, share).gaussians))
        for _ in range(60) for head, tail in zip(clouds(), clouds())
    ]  # fmt: skip
    one, two = np.array(found).reshape(-1, 2, 2).mean(axis=0).T
    # two sets that do not know of each other leave smaller gaps than one that has gaps by chance, and a closed sheet
    # as light as one: within 6 %; linear opacities would let twice as much light through the sheet
    np.testing.assert_allclose(two, one, atol=0.06)
    assert two[1] > one[1] - 0.03


def test_a_splat_that_does_not_fade_keeps_its_opacity():
    opacities = np.linspace(0.0, 1.0, 101, dtype=np.float32)
    np.testing.assert_allclose(faded(opacities, 1.0), opacities, atol=1e-6)
    np.testing.assert_array_equal(faded(opacities, 0.0), 0.0)


def test_ids_are_unique_while_two_frames_are_shown_and_those_of_one_frame_at_its_ends():
    head, tail = frame([0, 1, 2, 7]), frame([2, 7, 9], shift=0.02)
    middle = blended(head, tail, 0.5)
    assert len(set(middle.ids)) == 7
    assert set(head.ids) <= set(middle.ids)
    assert sorted(blended(head, tail, 1.0).ids) == [2, 7, 9]
    assert sorted(blended(head, tail, 0.0).ids) == [0, 1, 2, 7]


def test_patches_change_over_evenly_in_time_and_most_places_show_one_instant():
    points = np.random.default_rng(1).uniform(0, [2.0, 0.6, 0.2], (20000, 3))
    patch = patch_size(points)
    assert patch == pytest.approx(0.25 * 0.96 * 2.0, rel=0.02)
    shares = np.linspace(0.0, 1.0, 21)
    found = np.array([changed_over(points, s, patch) for s in shares])
    assert (found[0] == 0).all() and (found[-1] == 1).all() and (np.diff(found, axis=0) >= 0).all()
    # four patches along the body: a few times as much in one frame as on the mean at most
    assert np.diff(found.mean(axis=1)).max() < 3 / 20
    between = ((found > 0.02) & (found < 0.98)).mean(axis=1)
    assert between.max() < 0.5 and between.mean() < 0.3


def test_what_is_shown_while_it_fades_stays_about_as_much_as_one_body_without_opacities():
    # looks that draw a surface of particles do not know opacities: two bodies over each other were twice as many
    rng = np.random.default_rng(0)

    def body():
        means = rng.uniform(0, [2.0, 0.6, 0.2], (5000, 3))
        gaussians = Gaussians.isotropic(means, 0.02, np.full((5000, 3), 0.5), 0.9)
        return FluidFrame(gaussians, np.arange(5000), np.zeros((5000, 3), np.float32))

    head, tail = body(), body()
    patch = patch_size(head.gaussians.means)
    counts = [len(blended(head, tail, s, patch).ids) / 5000 for s in np.linspace(0, 1, 11)]
    assert counts[0] == counts[-1] == 1.0
    assert max(counts) < 1.0 + 0.5 and np.abs(np.diff(counts)).max() < 0.35


def test_a_body_glides_back_on_the_shorter_way():
    a = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    b = np.array([[1.0, 0.0, 0.0, -np.cos(0.5), 0.0, 0.0, -np.sin(0.5)]])
    half = blended_poses(a, b, 0.5)
    np.testing.assert_allclose(half[0], [0.5, 0, 0, np.cos(0.25), 0, 0, np.sin(0.25)], atol=1e-12)


def test_the_fade_lasts_a_quarter_of_the_passage_within_bounds(channel):
    slow = channel(100, parameters=FluidParameters(inflow_velocity=(0.25, 0.0, 0.0), time_step=0.04))
    slow = replace(slow, body=replace(slow.body, velocities=slow.body.velocities * np.float32(0.25 / 0.6)))
    assert loop_overlap(slow) == round(0.25 * 0.9 * 1.15 / 0.25 / 0.04)  # 1.035 m at 0.25 m/s
    assert loop_overlap(channel(100)) == round(LOOP_FADE[0] / 0.04)  # at 0.6 m/s it would be 0.43 s
    assert loop_overlap(channel(10)) == 5
    with pytest.raises(InputRejected, match="4 frames or more"):
        loop_overlap(channel(3))


def test_the_seam_of_a_loop_is_no_larger_than_the_clips_own_steps(tmp_path, channel, camera):
    config = taken(SimulateSettings, build_config().simulate)
    plain, loop = channel(20), channel(20, overlap=6)
    simulate(plain, config, folder=tmp_path / "plain")
    result = simulate(loop, config, folder=tmp_path / "loop")
    assert result.frames == 20
    assert result.warnings == ()
    assert {len(v) for v in (result.volume, result.leak, result.count, result.poses)} == {20}
    assert len(frame_files(tmp_path / "loop")) == 20
    across, mean, largest = seam(pictures(tmp_path / "loop", 20, camera))
    before, usual, _ = seam(pictures(tmp_path / "plain", 20, camera))
    assert across < 1.2 * usual  # the frame that follows the last one is the next of the simulation: a step like any
    assert before > 2 * usual  # without the fade it jumps
    # while it fades, up to a quarter of the difference between two unlike frames (pi / 2 of a sixth) comes on top
    assert largest < usual + before / 4
    assert mean < 1.5 * usual
    # frames after the fade are those of the simulation without a loop
    np.testing.assert_array_equal(*(pictures(tmp_path / n, 20, camera)[6:] for n in ("plain", "loop")))


def test_a_closed_loop_has_no_checkpoint_to_go_on_from(tmp_path, channel):
    config = taken(SimulateSettings, build_config().simulate)
    simulate(channel(8, overlap=2), config, folder=tmp_path)
    assert not checkpoint_file(tmp_path).exists()
    first = frame_file(tmp_path, FIRST_FRAME).read_bytes()
    again = simulate(channel(8, overlap=2), config, folder=tmp_path)
    assert again.resumed_at == 0
    assert frame_file(tmp_path, FIRST_FRAME).read_bytes() == first


def test_a_loop_that_was_interrupted_before_it_was_closed_is_closed_by_the_next_run(tmp_path, channel):
    config = taken(SimulateSettings, build_config().simulate, checkpoint_every=1)
    scene, calls = channel(8, overlap=2), []

    def stop(done, total):
        calls.append(done)
        if len(calls) == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(scene, config, folder=tmp_path / "stopped", work=replace(Work.alone(tmp_path), step=stop))
    resumed = simulate(scene, config, folder=tmp_path / "stopped")
    assert resumed.resumed_at > 0
    simulate(scene, config, folder=tmp_path / "whole")
    for k in range(8):
        files = [frame_file(tmp_path / n, FIRST_FRAME + k).read_bytes() for n in ("stopped", "whole")]
        assert files[0] == files[1]


def test_a_vessel_that_fills_has_no_loop_and_keeps_its_frames(tmp_path, channel):
    config = taken(SimulateSettings, build_config().simulate)
    cells = channel(12).cell_types
    cells = np.where(cells == CellType.OUTFLOW, np.uint8(CellType.FLUID), cells)
    result = simulate(channel(12, overlap=4, cell_types=cells), config, folder=tmp_path / "loop")
    assert any("not closed" in w and "more fluid at its end" in w for w in result.warnings)
    simulate(channel(12, cell_types=cells), config, folder=tmp_path / "plain")
    files = [frame_files(tmp_path / n) for n in ("loop", "plain")]
    assert len(files[0]) == 12
    assert [p.read_bytes() for p in files[0]] == [p.read_bytes() for p in files[1]]


def test_the_frames_of_a_closed_loop_are_known_to_show_it(made, tmp_path):
    folder = shutil.copytree(made.folder, tmp_path / "stream.fluid")
    session = EditSession.open(folder)
    session.set("loop", True)
    assert session.stale() == {"simulate"}
    resimulate(folder, overrides=["show.usd=false"])
    assert not checkpoint_file(folder).exists()
    assert session.stale() == set()
    session.set("inflow.factor", 1.1)
    assert session.stale() == {"simulate"}
    session.undo()
    assert session.stale() == set()
    session.undo()
    assert session.stale() == {"simulate"}
