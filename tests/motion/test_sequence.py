"""Velocities of a clip, frame by frame: steady in time, the same however the clip is read, with a window in memory."""

from __future__ import annotations

import gc
import math
import weakref
from dataclasses import replace

import numpy as np
import pytest

from fluidlift.motion.lift import depth_change
from fluidlift.motion.screen_divergence import project_screen_divergence
from fluidlift.motion.sequence import (
    FrameMotion,
    MotionOptions,
    MotionScene,
    mean_velocity,
    motion_sequence,
    screen_downhill,
)
from fluidlift.types import CellType, Grid, PinholeCamera, PixelFlow, Terrain, TriangleMesh

INTERVAL = 0.04
SPEED = np.array([0.6, 0.0, 0.0])
GRID = Grid((20, 12, 6), 0.1, (-1.0, -0.6, 0.0))
LEVEL = 0.4
CAMERA = PinholeCamera.looking((0.0, -1.2, 2.2), (0.0, 0.0, LEVEL), 45.0, (64, 48))


def level_depth(level: float = LEVEL) -> np.ndarray:
    """Camera z of the water level, within the box."""
    rays = CAMERA.rays(CAMERA.pixel_grid())
    depth = (level - CAMERA.position[2]) / rays[..., 2]
    points = CAMERA.unproject(CAMERA.pixel_grid(), depth)
    inside = (np.abs(points[..., 0]) < 0.95) & (np.abs(points[..., 1]) < 0.55)
    return np.where(inside & (depth > 0), depth, 0.0).astype(np.float32)


def flow_of(velocity: np.ndarray, depth: np.ndarray) -> np.ndarray:
    uv = CAMERA.pixel_grid()
    moved, _ = CAMERA.project(CAMERA.unproject(uv, np.where(depth > 0, depth, 2.0)) + velocity * INTERVAL)
    return np.where((depth > 0)[..., None], moved - uv, 0.0).astype(np.float32)


def channel(kind: str = "stream", **changes) -> MotionScene:
    """A straight channel, three cells of water over one of ground, that flows from end to end."""
    cells = np.full(GRID.shape, CellType.EMPTY, np.uint8)
    cells[:, :, 1:4] = CellType.FLUID
    cells[0, :, 1:4], cells[-1, :, 1:4] = CellType.INFLOW, CellType.OUTFLOW
    cells[:, :, 0] = CellType.SOLID
    mesh = TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    terrain = Terrain(GRID, GRID.nodes()[..., 2] - 0.1, np.array([1.0, 0.0, 0.0]), mesh)
    return MotionScene(CAMERA, level_depth(), terrain, cells, kind, INTERVAL, **changes)


class Clip:
    """A flow that is made when it is read, and counts what of it is alive."""

    def __init__(self, pairs: int, *, noise: float = 0.1, velocity: np.ndarray = SPEED) -> None:
        self.pairs = pairs
        self.noise = noise
        self.truth = flow_of(velocity, level_depth())
        self.alive = 0
        self.most_alive = 0
        self.read: list[tuple[int, int]] = []

    def __call__(self, first: int, last: int) -> PixelFlow:
        assert 0 <= first < last <= self.pairs
        self.read.append((first, last))
        made = [np.random.default_rng(t).normal(0, self.noise, self.truth.shape) for t in range(first, last)]
        flow = (self.truth + np.stack(made)).astype(np.float32)
        self.alive += 1
        self.most_alive = max(self.most_alive, self.alive)
        weakref.finalize(flow, self._gone)
        return PixelFlow(flow, np.full(flow.shape[:-1], 0.9, np.float32))

    def _gone(self) -> None:
        self.alive -= 1


def still_mask(frame: int) -> np.ndarray:
    return level_depth() > 0


def same(a: FrameMotion, b: FrameMotion) -> None:
    """Equal to the last bit."""
    assert a.frame == b.frame and a.front_factor == b.front_factor and a.free_fall_share == b.free_fall_share
    for name in ("displacement", "confidence", "observed"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.velocity is None) == (b.velocity is None)
    if a.velocity is not None and b.velocity is not None and a.surface is not None and b.surface is not None:
        np.testing.assert_array_equal(a.surface.velocities, b.surface.velocities)
        for mine, other in zip(a.velocity.components, b.velocity.components):
            np.testing.assert_array_equal(mine, other)


def test_a_uniform_stream_has_its_speed_on_the_screen_on_the_surface_and_below() -> None:
    clip = Clip(9)
    (found,) = motion_sequence(clip, still_mask, 9, channel(), frames=(), volume_frames=[4])
    fluid = still_mask(0)
    assert found.surface is not None and found.velocity is not None and found.report is not None
    # 0.1 px of noise, averaged over three pairs
    assert np.abs(found.displacement - clip.truth)[fluid].mean() < 0.1
    assert np.abs(found.surface.velocities.mean(axis=0) - SPEED).max() < 0.02
    inside = found.velocity.at_centers()[3:-3, 3:-3, 3]
    # the top cells; 10 % for what the bed's layer and the projection take
    assert inside[..., 0].mean() == pytest.approx(SPEED[0], rel=0.1)
    assert found.report.solve.converged


def test_the_mean_of_a_clip_is_nearer_to_a_steady_stream_than_that_of_frames_in_a_row() -> None:
    """Eddies that are as large in eight frames in a row as in one, and gone in the mean of the clip."""
    fluid, depth = still_mask(0), level_depth()
    u = CAMERA.pixel_grid()[..., :1]
    eddies = 0.4 * np.sin(2 * np.pi * u / 20.0).astype(np.float32) * flow_of(SPEED, depth)

    class Eddies(Clip):
        def __call__(self, first: int, last: int) -> PixelFlow:
            flow = super().__call__(first, last)
            return PixelFlow(flow.displacement + eddies, flow.confidence)

    clip = Clip(9)
    scene = channel(prior=(clip.truth, np.full(fluid.shape, 0.9, np.float32)))
    in_a_row = motion_sequence(Eddies(9), still_mask, 9, channel(), frames=(), volume_frames=range(8))
    eight = np.mean([f.velocity.at_centers() for f in in_a_row if f.velocity is not None], axis=0)
    mean = mean_velocity(fluid, scene)
    assert mean is not None
    top = (slice(3, -3), slice(3, -3), 3)
    off_eight, off = (np.abs(v[top][..., 0] - SPEED[0]).mean() for v in (eight, mean.at_centers()))
    assert off < 0.5 * off_eight
    assert off < 0.1 * SPEED[0]
    assert mean_velocity(np.zeros_like(fluid), scene) is None
    with pytest.raises(ValueError, match="mean motion"):
        mean_velocity(fluid, channel())


def test_waves_that_pass_over_standing_water_are_no_motion_of_it() -> None:
    """The same flow as of the stream, over the same water without ends."""
    scene = channel("basin")
    cells = np.where(np.isin(scene.cell_types, (CellType.INFLOW, CellType.OUTFLOW)), CellType.FLUID, scene.cell_types)
    scene = replace(scene, cell_types=cells.astype(np.uint8))
    clip = Clip(9)
    (found,) = motion_sequence(clip, still_mask, 9, scene, frames=(), volume_frames=[4])
    assert found.report is not None and found.velocity is not None
    assert np.abs(found.displacement - clip.truth)[still_mask(0)].mean() < 0.1, "the pictures move all the same"
    assert found.report.circulating is not None and found.report.circulating < 0.25
    assert np.linalg.norm(found.velocity.at_centers().mean(axis=(0, 1))[1:4], axis=-1).max() < 0.05 * SPEED[0]
    (stream,) = motion_sequence(clip, still_mask, 9, channel(), frames=(), volume_frames=[4])
    assert stream.report is not None and stream.report.circulating is None


def test_ground_that_was_dry_a_moment_ago_does_not_slow_a_front() -> None:
    fluid, columns = still_mask(0), np.arange(CAMERA.size[0])
    clip = Clip(9, noise=0.0)

    def advancing(frame: int) -> np.ndarray:
        return fluid & (columns < 20 + 3 * frame)

    def with_ground(first: int, last: int) -> PixelFlow:
        seen = clip(first, last)
        dry = np.stack([~advancing(t) for t in range(first, last)])
        return PixelFlow(np.where(dry[..., None], 0.0, seen.displacement).astype(np.float32), seen.confidence)

    scene = MotionScene(CAMERA, None, None, None, "stream", INTERVAL)
    (found,) = motion_sequence(with_ground, advancing, 9, scene, frames=[4])
    new = advancing(4) & ~advancing(3)
    assert new.sum() > 20
    # the truth is smooth; the mean of a wet and a dry pair, both trusted, would be at most 2/3 of it
    assert np.abs(found.displacement - clip.truth)[new].max() < 0.05 * np.abs(clip.truth[new]).max()


def test_only_a_window_of_the_clip_is_in_memory_however_long_it_is() -> None:
    most = []
    for pairs in (30, 150):
        clip = Clip(pairs)
        options = MotionOptions(half_window=1, reach=3)
        scene = MotionScene(CAMERA, None, None, None, "stream", INTERVAL)
        count = 0
        for _ in motion_sequence(clip, still_mask, pairs, scene, options, frames=range(pairs)):
            count += 1
        gc.collect()
        most.append(clip.most_alive)
        assert count == pairs
        assert clip.read == [(t, t + 1) for t in range(pairs)]  # each pair once, in order
    # the window of 7 and the pair that comes in
    assert most[0] == most[1] <= 8


def test_each_frame_is_the_same_whichever_others_are_asked_for() -> None:
    options = MotionOptions(reach=3)
    together = {
        m.frame: m
        for m in motion_sequence(Clip(12), still_mask, 12, channel(), options, frames=range(12), volume_frames=[5, 7])
    }
    assert sorted(together) == list(range(12))
    for frame in (0, 5, 11):
        volumes = [5] if frame == 5 else None
        (alone,) = motion_sequence(Clip(12), still_mask, 12, channel(), options, frames=[frame], volume_frames=volumes)
        same(alone, together[frame])


def test_the_same_clip_gives_the_same_velocities() -> None:
    first, second = (
        list(motion_sequence(Clip(6), still_mask, 6, channel(), frames=(), volume_frames=[2, 3])) for _ in range(2)
    )
    for a, b in zip(first, second):
        same(a, b)


def test_neighbouring_frames_of_a_steady_stream_differ_less_than_their_flow() -> None:
    clip, single = Clip(12, noise=0.3), MotionOptions(half_window=0, reach=0)
    scene = MotionScene(CAMERA, None, None, None, "stream", INTERVAL)
    fluid = still_mask(0)

    def step(options: MotionOptions) -> float:
        found = [m.displacement for m in motion_sequence(clip, still_mask, 12, scene, options, frames=range(4, 9))]
        return float(np.linalg.norm(np.diff(found, axis=0), axis=-1)[:, fluid].mean())

    # white noise: windows of three that move on by one differ by two samples of three, sqrt(2)/3 against sqrt(2)
    assert step(MotionOptions()) < 0.5 * step(single)


def test_a_surface_that_rises_has_an_upward_velocity_only_where_its_depth_is_followed() -> None:
    rising = np.array([0.0, 0.0, 0.25])
    levels = [level_depth(LEVEL + 0.25 * INTERVAL * t) for t in range(8)]
    flows = [flow_of(rising, depth) for depth in levels]

    def read(first: int, last: int) -> PixelFlow:
        d = np.stack(flows[first:last])
        return PixelFlow(d, np.full(d.shape[:-1], 0.9, np.float32))

    def mask(frame: int) -> np.ndarray:
        return levels[frame] > 0

    def upward(depth) -> np.ndarray:
        base = channel()
        scene = MotionScene(CAMERA, depth, base.terrain, base.cell_types, "stream", INTERVAL)
        (found,) = motion_sequence(read, mask, 7, scene, frames=(), volume_frames=[3])
        assert found.surface is not None
        return np.median(found.surface.velocities, axis=0)

    # float32 depth of 2 m over 0.04 s
    assert upward(lambda t: levels[t]) == pytest.approx(rising, abs=0.01)
    assert abs(upward(levels[3])[2]) < 0.01  # along a surface at rest nothing rises


def test_a_plume_is_held_against_its_silhouette_and_a_pour_against_free_fall() -> None:
    scene = MotionScene(CAMERA, None, None, None, "plume", INTERVAL)

    def growing(frame: int) -> np.ndarray:
        mask = np.zeros((48, 64), bool)
        mask[40 - 2 * frame : 46, 20:40] = True
        return mask

    def slow(first: int, last: int) -> PixelFlow:
        d = np.zeros((last - first, 48, 64, 2), np.float32)
        d[..., 1] = -1.0
        return PixelFlow(d, np.full(d.shape[:-1], 0.9, np.float32))

    (plume,) = motion_sequence(slow, growing, 12, scene, frames=[6])
    # flow that sees half of the cap's speed everywhere is scaled to 0.9 of it; that speed is known to 10 %
    assert plume.front_factor == pytest.approx(0.9 * 2.0, rel=0.1)
    found = {m.frame: m for m in motion_sequence(Clip(4), still_mask, 4, channel(), frames=[1], volume_frames=[2])}
    assert found[1].front_factor is None and found[1].surface is None and found[1].velocity is None
    assert found[2].free_fall_share is None
    (pour,) = motion_sequence(Clip(4), still_mask, 4, channel("pour"), frames=(), volume_frames=[1])
    assert pour.free_fall_share is not None


def test_flow_and_surface_tell_the_same_motion_where_free_fall_took_the_place_of_flow() -> None:
    (pour,) = motion_sequence(Clip(4), still_mask, 4, channel("pour"), frames=(), volume_frames=[1])
    assert pour.surface is not None and pour.free_fall_share
    start, _ = CAMERA.project(pour.surface.points)
    ends, z = CAMERA.project(pour.surface.points + INTERVAL * pour.surface.velocities)
    falls = (pour.surface.velocities[:, :2] == 0).all(axis=1) & (pour.surface.velocities[:, 2] < 0) & (z > 0)
    assert falls.sum() > 50
    rows, cols = (np.floor(start[falls, k]).astype(int) for k in (1, 0))
    # float32 points of a metre at a thousandth of a pixel
    assert np.abs(pour.displacement[rows, cols] - (ends - start)[falls]).max() < 0.02
    assert not pour.observed[rows, cols].any() and pour.confidence[rows, cols].max() == 0.0


def test_frames_without_fluid_are_left_out() -> None:
    def mask(frame: int) -> np.ndarray:
        return still_mask(frame) & (frame != 2)

    scene = MotionScene(CAMERA, None, None, None, "stream", INTERVAL)
    assert [m.frame for m in motion_sequence(Clip(5), mask, 5, scene, frames=range(5))] == [0, 1, 3, 4]


def test_a_slope_descends_on_the_screen_as_its_points_do_and_a_level_surface_nowhere() -> None:
    base = channel()
    slope = 0.5 - 0.4 * (np.arange(20) + 0.5) * 0.1
    tilted = MotionScene(
        CAMERA, base.depth, base.terrain, base.cell_types, "fall", INTERVAL, np.repeat(slope[:, None], 12, axis=1)
    )
    down = screen_downhill(tilted)
    assert down is not None and isinstance(base.depth, np.ndarray)
    known = base.depth > 0
    assert np.allclose(np.linalg.norm(down[known], axis=-1), 1.0, atol=1e-5)
    assert (down[known][:, 0] > 0.5).all()  # downhill is +x, to the right in this picture
    assert (down[known][:, 1] > 0.0).all()  # and downwards
    assert (down[~known] == 0).all()
    level = MotionScene(CAMERA, base.depth, base.terrain, base.cell_types, "stream", INTERVAL, np.full((20, 12), LEVEL))
    flat = screen_downhill(level)
    assert flat is not None and (flat == 0).all()
    assert screen_downhill(base) is None  # nothing that lies on the ground


def test_what_no_frame_of_the_window_saw_is_filled_with_the_mean_of_the_clip() -> None:
    truth = flow_of(SPEED, level_depth())
    dark = np.zeros((48, 64), bool)
    dark[:, 30:44] = True
    truth[dark] *= 0.5  # slower water there, which its neighbours do not know

    def read(first: int, last: int) -> PixelFlow:
        d = np.repeat(np.where(dark[..., None], 0.0, truth)[None].astype(np.float32), last - first, axis=0)
        return PixelFlow(d, np.where(dark, 0.02, 0.9)[None].repeat(last - first, axis=0).astype(np.float32))

    def error(prior) -> float:
        scene = MotionScene(CAMERA, None, None, None, "stream", INTERVAL, prior=prior)
        (found,) = motion_sequence(read, still_mask, 5, scene, frames=[2])
        return float(np.linalg.norm(found.displacement - truth, axis=-1)[dark & still_mask(2)].mean())

    assert error((truth, np.full(dark.shape, 0.8, np.float32))) < 0.5 * error(None)


@pytest.mark.parametrize("filling", ["diffusion", "sum"])
def test_a_hard_constraint_is_the_projection_with_an_infinite_reach(filling) -> None:
    """On a stream with a gap in its flow, filled in either way."""
    scene = channel()

    def gap(first: int, last: int) -> PixelFlow:
        found = Clip(6, noise=0.4)(first, last)
        confidence = found.confidence.copy()
        confidence[:, 18:30, 24:44] = 0.0
        return PixelFlow(found.displacement, confidence)

    def made(constraint: str) -> FrameMotion:
        options = MotionOptions(
            half_window=0, reach=0, along_paths=False, filling=filling, divergence="paper", constraint=constraint
        )
        (found,) = motion_sequence(gap, still_mask, 6, scene, options, frames=[3])
        return found

    free, hard, depth = made("none"), made("hard"), scene.depth_at(3)
    body = still_mask(3) & (depth > 0)
    rate = depth_change(free.displacement, body, depth, depth, mask_t1=body)
    near = np.where(body, depth, 1.0)
    wanted, _ = project_screen_divergence(
        free.displacement, body, free.observed & body, near, rate, CAMERA, form="paper", reach=math.inf
    )
    np.testing.assert_allclose(hard.displacement[body], wanted[body], atol=1e-6)
    assert np.abs(hard.displacement - free.displacement)[~free.observed].max() > 0.01


def test_wrong_input_is_named() -> None:
    scene = MotionScene(CAMERA, None, None, None, "stream", INTERVAL)
    with pytest.raises(ValueError, match="frames"):
        motion_sequence(Clip(4), still_mask, 4, scene, frames=[4])
    with pytest.raises(ValueError, match="geometry"):
        motion_sequence(Clip(4), still_mask, 4, scene, frames=(), volume_frames=[1])
    with pytest.raises(ValueError, match="depth"):
        MotionScene(CAMERA, np.ones((3, 3)), None, None, "stream", INTERVAL)
    with pytest.raises(ValueError, match="2 pairs"):
        list(motion_sequence(lambda a, b: Clip(4)(0, 2), still_mask, 4, scene, frames=[1]))
    with pytest.raises(ValueError, match="wall"):
        MotionOptions(wall="slip")
    with pytest.raises(ValueError, match="filling"):
        MotionOptions(filling="guess")
    with pytest.raises(ValueError, match="constraint"):
        MotionOptions(constraint="soft")
    with pytest.raises(ValueError, match="half window"):
        MotionOptions(half_window=-1)
