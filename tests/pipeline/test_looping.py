"""A loop's last frame leads into its first one, and the fluid stays as opaque as it is while it fades."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.io.frames import FIRST_FRAME
from fluidlift.look.rasterize import render
from fluidlift.pipeline.looping import SplatFrame, blended, blended_poses, faded, read_frame, seam
from fluidlift.pipeline.scene import Scene, loop_overlap
from fluidlift.pipeline.simulating import checkpoint_file, frame_file, simulate
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


def pictures(folder, count):
    frames = [read_frame(frame_file(folder, FIRST_FRAME + k)).gaussians for k in range(count)]
    return np.stack([render(g, camera()).image for g in frames])


def frame(ids, opacity=0.9, shift=0.0):
    ids = np.asarray(ids)
    means = np.stack([0.1 * ids + shift, 0.4 + 0.0 * ids, 0.2 + 0.0 * ids], axis=1)
    gaussians = Gaussians.isotropic(means, 0.05, np.full((len(ids), 3), 0.7), opacity)
    return SplatFrame(gaussians, ids, np.zeros((len(ids), 3), np.float32))


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 1.0])
def test_two_bodies_that_fade_into_each_other_let_through_as_much_light_as_one(share):
    rng = np.random.default_rng(0)

    def clouds():
        """Splats of a river's opacities by chance; in a regular sheet, somewhere; the opacity in their middle."""
        even = np.stack(np.meshgrid(*[np.arange(-4, 16) * 0.06] * 2, indexing="ij"), -1).reshape(-1, 2)
        loose = rng.uniform([0.3, 0.2, 0.1], [0.9, 0.6, 0.3], (60, 3))
        sheet = np.column_stack([even + rng.uniform(0, 0.06, 2), np.full(len(even), 0.2)])
        for means in (loose, sheet):
            n = len(means)
            gaussians = Gaussians.isotropic(means, 0.03, np.full((n, 3), 0.7), rng.uniform(0.7, 0.96, n))
            yield SplatFrame(gaussians, np.arange(n), np.zeros((n, 3), np.float32))

    def opacity(gaussians):
        return render(gaussians, camera()).alpha[16:32, 24:40].mean()

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


def test_a_body_glides_back_on_the_shorter_way():
    a = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
    b = np.array([[1.0, 0.0, 0.0, -np.cos(0.5), 0.0, 0.0, -np.sin(0.5)]])
    half = blended_poses(a, b, 0.5)
    np.testing.assert_allclose(half[0], [0.5, 0, 0, np.cos(0.25), 0, 0, np.sin(0.25)], atol=1e-12)


def test_the_fade_lasts_a_quarter_of_the_passage_within_bounds():
    assert loop_overlap(channel(100)) == round(0.25 * 0.9 * 1.15 / 0.6 / 0.04)  # 1.035 m at 0.6 m/s
    assert loop_overlap(channel(10)) == 5
    with pytest.raises(InputRejected, match="4 frames or more"):
        loop_overlap(channel(3))


def test_the_seam_of_a_loop_is_no_larger_than_the_clips_own_steps(tmp_path):
    config = build_config(None, None, (), {})
    plain, loop = channel(20), channel(20, overlap=6)
    simulate(plain, tmp_path / "plain", config)
    result = simulate(loop, tmp_path / "loop", config)
    assert result.meta["frames"] == 20
    assert result.meta["warnings"] == []
    assert {len(v) for v in result.arrays.values()} == {20}
    assert len(list((tmp_path / "loop" / "frames" / "splats").glob("*.ply"))) == 20
    across, mean, largest = seam(pictures(tmp_path / "loop", 20))
    before, usual, _ = seam(pictures(tmp_path / "plain", 20))
    assert across < 1.2 * usual  # the frame that follows the last one is the next of the simulation: a step like any
    assert before > 2 * usual  # without the fade it jumps
    # while it fades, up to a quarter of the difference between two unlike frames (pi / 2 of a sixth) comes on top
    assert largest < usual + before / 4
    assert mean < 1.5 * usual
    # frames after the fade are those of the simulation without a loop
    np.testing.assert_array_equal(*(pictures(tmp_path / n, 20)[6:] for n in ("plain", "loop")))


def test_a_closed_loop_has_no_checkpoint_to_go_on_from(tmp_path):
    config = build_config(None, None, (), {})
    simulate(channel(8, overlap=2), tmp_path, config)
    assert not checkpoint_file(tmp_path).exists()
    first = frame_file(tmp_path, FIRST_FRAME).read_bytes()
    again = simulate(channel(8, overlap=2), tmp_path, config)
    assert again.meta["resumed_at"] == 0
    assert frame_file(tmp_path, FIRST_FRAME).read_bytes() == first


def test_a_loop_that_was_interrupted_before_it_was_closed_is_closed_by_the_next_run(tmp_path):
    config = build_config(None, None, ("simulate.checkpoint_every=1",), {})
    scene, calls = channel(8, overlap=2), []

    def stop(done, total):
        calls.append(done)
        if len(calls) == 8:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(scene, tmp_path / "stopped", config, step=stop)
    resumed = simulate(scene, tmp_path / "stopped", config)
    assert resumed.meta["resumed_at"] > 0
    simulate(scene, tmp_path / "whole", config)
    for k in range(8):
        files = [frame_file(tmp_path / n, FIRST_FRAME + k).read_bytes() for n in ("stopped", "whole")]
        assert files[0] == files[1]


def test_a_vessel_that_fills_is_said_to_show_two_levels(tmp_path):
    scene = channel(12, overlap=4)
    cells = np.where(scene.cell_types == CellType.OUTFLOW, np.uint8(CellType.FLUID), scene.cell_types)
    result = simulate(channel(12, overlap=4, cell_types=cells), tmp_path, build_config(None, None, (), {}))
    assert any("more fluid at its end" in w for w in result.meta["warnings"])
