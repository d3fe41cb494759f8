"""Chutes that come down onto level water, from exact motion on two planes."""

import numpy as np
import pytest
from scipy import ndimage

from fluidlift.shape.channel import ChannelConfig, channel_setting
from fluidlift.shape.chute import (
    LOSES,
    USUAL,
    Chute,
    ChuteHeight,
    chute_pixels,
    energy_kept,
    find_chutes,
    head_acceleration,
    pieces,
    stand,
)
from fluidlift.shape.composite import BodyParts, trust_beside_jets, with_chute
from fluidlift.shape.jets import JetOutline
from fluidlift.shape.kind import level_camera
from fluidlift.shape.plan import PlanEvidence
from fluidlift.shape.registration import PlacedHeight, VelocityEvidence
from fluidlift.shape.sections import SURE, estimate_sections
from fluidlift.shape.slope import flow_patches, plane_axes
from fluidlift.shape.surface import chutes_on_level, level_surface, stream_surface
from fluidlift.types import CellType, Label, MetricScale, PinholeCamera, Similarity3, UpEvidence

SIZE = (192, 144)


def scene(slope, heading, pitch, *, speed=0.05, pool=0.012, half_width=0.13, length=0.3, energy=None):
    """A chute that runs down onto a pool that goes on the same way: camera, mask, px per frame, which pixels show the
    chute, true depth. `energy`: of the share of the way (0 at its top), times that at the mean speed."""
    camera = level_camera(PinholeCamera.from_fov(50.0, SIZE), UpEvidence(pitch, 0.0, "", 1.0))
    steep, level = (plane_axes(np.radians(a), np.radians(heading)) for a in (slope, 0.0))
    grid = camera.pixel_grid()
    rays = camera.rays(grid)
    foot = camera.rays(np.array([[0.5 * SIZE[0], 0.45 * SIZE[1]]]))[0]
    facing = -(rays @ steep[2])
    onto = np.where(facing > 1e-3, -(foot @ steep[2]) / np.maximum(facing, 1e-3), np.inf)
    below = np.where(rays[..., 2] < -1e-3, foot[2] / np.minimum(rays[..., 2], -1e-3), np.inf)
    p = rays * np.where(np.isfinite(onto), onto, 0.0)[..., None] - foot
    run, across = p @ level[0], p @ level[1]
    chute = np.isfinite(onto) & (onto > 0) & (run < 0) & (run > -length) & (np.abs(across) < half_width)
    q = rays * np.where(np.isfinite(below), below, 0.0)[..., None] - foot
    wet = np.isfinite(below) & (np.abs(q @ level[1]) < 0.5) & (q @ level[0] > -0.15) & (q @ level[0] < 0.6)
    mask = chute | wet
    depth = np.where(chute, onto, np.where(wet, below, 0.0))
    share = np.clip(run / length + 1.0, 0.0, 1.0)
    fast = speed * np.sqrt(np.ones_like(share) if energy is None else energy(share))
    velocity = np.where(chute[..., None], fast[..., None] * steep[0], pool * level[0])
    points = rays * np.where(mask, depth, 1.0)[..., None]
    later, _ = camera.project(points + np.where(mask[..., None], velocity, 0.0))
    return camera, mask, np.where(mask[..., None], later - grid, 0.0), chute, depth


OFF = 8.0
"""degrees, of the slope: half of its prior's standard deviation"""
SCENES = [(35.0, -150.0, 30.0), (45.0, -30.0, 40.0), (30.0, -90.0, 25.0), (55.0, 180.0, 20.0)]


@pytest.mark.parametrize(("slope", "heading", "pitch"), SCENES)
def test_a_chute_above_a_pool_is_found_with_its_slope_and_the_pool_is_level(slope, heading, pitch):
    camera, mask, motion, chute, _ = scene(slope, heading, pitch)
    trust = np.ones(mask.shape)
    level = level_surface(camera, mask & ~chute).height
    found = find_chutes(camera, mask, motion, trust, level)
    assert len(found) == 1
    # the motion turns a little over the chute, by perspective, and the prior (35 +- 15) draws
    assert found[0].slope == pytest.approx(slope, abs=OFF)
    turn = (np.degrees(found[0].heading) - heading + 180.0) % 360.0 - 180.0
    assert abs(turn) < 6.0
    overlap = (found[0].pixels & chute).sum() / (found[0].pixels | chute).sum()
    assert overlap > 0.85  # flow is exact here, opening takes corners


@pytest.mark.parametrize(("slope", "heading", "pitch"), SCENES)
def test_the_surface_of_a_chute_above_a_pool_lies_where_both_planes_are(slope, heading, pitch):
    camera, mask, motion, chute, depth = scene(slope, heading, pitch)
    front = stream_surface(camera, mask, motion, np.ones(mask.shape), 0.04)
    assert front.slope is not None and front.slope.chute == pytest.approx(slope, abs=OFF)
    (part,) = front.chutes
    assert (part & chute).sum() / (part | chute).sum() > 0.85
    seen = mask & (front.depth > 0)
    ratio = front.depth[seen] / depth[seen]
    error = np.abs(ratio / np.median(ratio) - 1.0)
    on = chute[seen]
    assert np.median(error[~on]) < 1e-3  # a level plane, as it was given
    level = level_surface(camera, mask & ~chute).depth[seen]
    flat = np.abs((level / depth[seen]) / np.median((level / depth[seen])[~on]) - 1.0)
    # its slope is found to some degrees: at least three quarters of what a level surface is wrong by goes
    assert np.median(error[on]) < max(0.25 * float(np.median(flat[on])), 0.01)


def test_noise_of_the_flow_does_not_hide_a_chute():
    camera, mask, motion, _, _ = scene(40.0, -140.0, 35.0)
    noise = np.random.default_rng(0).normal(0.0, 0.25, motion.shape)
    front = stream_surface(camera, mask, motion + noise * mask[..., None], np.ones(mask.shape), 0.04)
    assert front.slope is not None and front.slope.chute == pytest.approx(40.0, abs=10.0)


@pytest.mark.parametrize("pitch", [25.0, 45.0])
def test_a_swift_thread_that_keeps_its_speed_on_level_water_is_no_chute(pitch):
    camera = level_camera(PinholeCamera.from_fov(50.0, SIZE), UpEvidence(pitch, 0.0, "", 1.0))
    front = level_surface(camera, np.indices((SIZE[1], SIZE[0]))[0] > 50)
    grid = camera.pixel_grid()
    mask = (np.indices((SIZE[1], SIZE[0]))[0] > 50) & (front.depth > 0)
    points = camera.unproject(grid, np.where(mask, front.depth, 1.0).astype(float))
    across = points[..., 0] - np.median(points[mask][:, 0])
    speed = 0.01 + 0.04 * np.exp(-((across / 0.08) ** 2))
    later, _ = camera.project(points + speed[..., None] * np.array([0.0, -1.0, 0.0]))
    motion = np.where(mask[..., None], later - grid, 0.0)
    assert stream_surface(camera, mask, motion, np.ones(mask.shape), 0.04).slope.chute == 0.0


def test_a_chute_that_was_filmed_slowed_down_is_found_all_the_same():
    camera, mask, motion, chute, _ = scene(45.0, -30.0, 40.0)
    slow = motion * 0.4 / np.median(np.linalg.norm(motion[chute], axis=-1))  # px, of a weir at 72 frames per second
    (found,) = chute_pixels(camera, mask, slow, np.ones(mask.shape))
    (usual,) = chute_pixels(camera, mask, motion, np.ones(mask.shape))
    assert (found & usual).sum() / (found | usual).sum() > 0.99


def test_what_spreads_fast_from_the_foot_of_a_jet_is_no_chute():
    camera, mask, motion, chute, _ = scene(45.0, -30.0, 40.0)
    rows, cols = np.nonzero(chute)
    at, trust = (int(np.median(cols)), int(rows.min())), np.ones(mask.shape)

    def front_with(u: int, v: int):
        """Where a jet of 6 px stands in the picture, over fluid."""
        pixels = np.zeros_like(mask)
        pixels[max(v - 20, 0) : v + 6, u - 3 : u + 3] = True
        outline = JetOutline(pixels, np.array([[u, v - 20.0], [u, v + 6.0]]), np.array([3.0, 3.0]), False)
        known = trust_beside_jets(BodyParts((outline,), mask), camera, motion, trust * ~pixels)
        return chutes_on_level(camera, mask, motion, known)

    assert front_with(*at) is None
    away = int(cols.max()) + 40 if cols.max() + 43 < SIZE[0] else int(cols.min()) - 40
    far = front_with(away, at[1])
    assert far is not None and (far.chutes[0] & chute).sum() > 0.9 * chute.sum()


def with_friction(first, last, lengths):
    """v^2 down a slope under gravity and a drag in proportion to v^2: from `first` towards `last`, where both balance,
    over that many e-folds."""
    return lambda share: last + (first - last) * np.exp(-lengths * share)


RUNS = {
    "no friction": lambda share: 0.4 + 1.2 * share,
    "friction": with_friction(0.4, 1.2, 3.0),
    "balanced": with_friction(1.0, 1.0, 1.0),
    "enters faster than it can keep": with_friction(1.25, 0.9, 2.0),
}


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize(("slope", "heading", "pitch"), SCENES)
def test_water_that_runs_down_keeps_its_energy_with_friction_and_without(slope, heading, pitch, run):
    camera, mask, motion, chute, _ = scene(slope, heading, pitch, energy=RUNS[run])
    trust = np.ones(mask.shape)
    foot = camera.rays(np.array([[0.5 * SIZE[0], 0.45 * SIZE[1]]]))[0]
    true = Chute(tuple(foot), np.radians(heading), slope, 0.13, 0.3, chute)
    assert energy_kept(camera, true, motion, trust) > 1.0 - LOSES
    # and on the plane as it is found
    level = level_surface(camera, mask & ~chute).height
    assert level is not None
    assert len(find_chutes(camera, mask, motion, trust, level)) == 1


@pytest.mark.parametrize("end", [0.3, 1.0, 2.5])
def test_the_energy_that_is_kept_is_measured_on_a_plane_in_perspective(end):
    seen = []

    def energy(share):
        seen.append(share)
        return 1.0 + (end - 1.0) * share

    camera, _, motion, chute, _ = scene(45.0, -30.0, 40.0, speed=0.005, energy=energy)
    foot = camera.rays(np.array([[0.5 * SIZE[0], 0.45 * SIZE[1]]]))[0]
    true = Chute(tuple(foot), np.radians(-30.0), 45.0, 0.13, 0.3, chute)
    first, last = (1.0 + (end - 1.0) * share for share in np.percentile(seen[0][chute], [2, 98]))
    assert energy_kept(camera, true, motion, np.ones(chute.shape)) == pytest.approx(last / first, rel=0.05)


def outflow(pitch, towards, drift, *, power):
    """Level water that spreads from a place of the picture within 30 degrees of a heading, its speed as 1 / r^power,
    over water that drifts slowly along another heading (degrees): camera, mask, px per frame."""
    camera = level_camera(PinholeCamera.from_fov(50.0, SIZE), UpEvidence(pitch, 0.0, "", 1.0))
    grid = camera.pixel_grid()
    mask = np.indices((SIZE[1], SIZE[0]))[0] > 30
    front = level_surface(camera, mask)
    mask &= front.depth > 0
    points = camera.unproject(grid, np.where(mask, front.depth, 1.0).astype(float))
    away = points[..., :2] - points[55, 90, :2]
    r = np.maximum(np.linalg.norm(away, axis=-1), 1e-6)
    to, on = (np.array([np.cos(a), np.sin(a)]) for a in np.radians([towards, drift]))
    inside = (r > 0.08) & (r < 0.35) & (away @ to > np.cos(np.radians(30.0)) * r)
    velocity = 0.004 * on + away / r[..., None] * np.where(inside, 0.05 * (0.1 / r) ** power, 0.0)[..., None]
    later, _ = camera.project(points + np.concatenate([velocity, np.zeros((*r.shape, 1))], axis=-1))
    return camera, mask, np.where(mask[..., None], later - grid, 0.0)


@pytest.mark.parametrize("power", [1.0, 1.5], ids=["a film", "a film that friction slows"])
@pytest.mark.parametrize(
    ("pitch", "towards", "drift"), [(30.0, -40.0, 0.0), (45.0, -125.0, -160.0), (35.0, -50.0, 10.0)]
)
def test_what_spreads_from_a_source_on_the_level_is_no_chute(pitch, towards, drift, power):
    camera, mask, motion = outflow(pitch, towards, drift, power=power)
    trust = np.ones(mask.shape)
    (part,) = chute_pixels(camera, mask, motion, trust)  # it is fast, runs down the picture and ends on the fluid
    level = level_surface(camera, mask & ~part).height
    assert level is not None
    stood = stand(camera, part, mask, motion, trust, -1.0)
    assert stood is not None and stood.slope > 20.0  # and leans as a chute does
    assert energy_kept(camera, stood, motion, trust) < 1.0 - LOSES
    assert find_chutes(camera, mask, motion, trust, level) == []
    assert chutes_on_level(camera, mask, motion, trust) is None
    assert find_chutes(camera, mask, motion, trust, level, [part])  # a person may know better


def test_where_too_little_is_known_a_chute_is_not_said_to_slow_down():
    camera, mask, motion, chute, _ = scene(45.0, -30.0, 40.0)
    level = level_surface(camera, mask & ~chute).height
    assert level is not None
    (found,) = find_chutes(camera, mask, motion, np.ones(mask.shape), level)
    assert energy_kept(camera, found, motion * 0.0, np.zeros(mask.shape)) == 1.0


def test_errors_of_the_flow_alone_are_no_chute():
    camera, mask, motion, _, _ = scene(45.0, -30.0, 40.0, speed=0.0, pool=0.0)
    noise = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=motion.shape), (4, 4, 0))
    noise *= 0.05 / noise.std()
    assert chute_pixels(camera, mask, motion + noise, np.ones(mask.shape)) == []


def sliding(gravity, *, n=2000, begin=0.3):
    """Points on a chute of 40 degrees without friction, and their velocities."""
    drop = np.random.default_rng(0).uniform(0.0, 0.5, n)
    points = np.column_stack([drop / np.tan(np.radians(40.0)), np.zeros(n), -drop])
    speed = np.sqrt(begin**2 + 2.0 * gravity * drop)
    return points, speed[:, None] * np.array([np.cos(np.radians(40.0)), 0.0, -np.sin(np.radians(40.0))])


@pytest.mark.parametrize("gravity", [0.05, 2.0, 30.0])
def test_the_speed_on_a_chute_shows_gravity_in_its_own_units(gravity):
    points, velocities = sliding(gravity)
    noise = 1.0 + 0.1 * np.random.default_rng(1).normal(size=(len(points), 1))
    found = head_acceleration(points, velocities * noise, np.ones(len(points)))
    assert found == pytest.approx(gravity, rel=0.05)


def test_a_chute_on_which_water_gets_no_faster_shows_none():
    points, velocities = sliding(0.0)
    assert head_acceleration(points, velocities, np.ones(len(points))) is None
    assert head_acceleration(points, sliding(2.0)[1], np.zeros(len(points))) is None


ASSUMED = MetricScale(0.5, "assumed", across=1.0)


@pytest.mark.parametrize(
    ("gravity", "across", "slowed"), [(9.81, 2.0, False), (0.981, 20.0, False), (0.05, 392.4, True)]
)
def test_an_unknown_size_is_the_one_at_which_a_chute_runs_as_filmed(gravity, across, slowed):
    points, velocities = sliding(gravity)
    part = [np.ones(len(points), bool)]
    found = with_chute(ASSUMED, points, velocities, part, VelocityEvidence())
    assert (found.source, found.warning != "") == ("chute", slowed)
    assert found.across == pytest.approx(across, rel=0.01)
    assert found.value / ASSUMED.value == pytest.approx(found.across / ASSUMED.across)
    assert "chute" in found.sentence
    given = MetricScale(0.5, "size", across=1.0)
    assert with_chute(given, points, velocities, part, VelocityEvidence()) is given
    assert with_chute(ASSUMED, points, velocities, [], VelocityEvidence()) is ASSUMED


def test_a_size_beyond_belief_is_not_taken():
    points, velocities = sliding(0.001)
    assert with_chute(ASSUMED, points, velocities, [np.ones(len(points), bool)], VelocityEvidence()) is ASSUMED


@pytest.mark.parametrize(("slope", "heading", "pitch"), SCENES)
def test_a_marked_ledge_stands_where_no_motion_shows_it(slope, heading, pitch):
    camera, mask, motion, chute, depth = scene(slope, heading, pitch)
    unseen = motion * ~chute[..., None]
    trust = np.where(chute, 0.0, 1.0)
    assert chutes_on_level(camera, mask, unseen, trust) is None
    front = chutes_on_level(camera, mask, unseen, trust, chute)
    assert front is not None and front.slope is not None
    assert front.slope.chute == pytest.approx(USUAL[0], abs=2.0)  # nothing says more
    (part,) = front.chutes
    assert (part == chute).all()
    # nearer to the truth than level water is
    level = level_surface(camera, mask & ~chute).depth
    off, flat = (np.abs((d / depth)[chute] / np.median((d / depth)[mask & ~chute]) - 1.0) for d in (front.depth, level))
    assert np.median(off) < 0.7 * np.median(flat)


def test_a_mark_too_small_to_stand_is_left_out():
    small = np.zeros((40, 60), bool)
    small[3:6, 3:6] = True
    assert pieces(small) == []
    large = np.zeros((40, 60), bool)
    large[10:30, 10:20], large[10:30, 30:50] = True, True
    assert [int(p.sum()) for p in pieces(small | large)] == [400, 200]


def test_a_plane_film_is_no_chute():
    camera, mask, motion, chute, _ = scene(35.0, -120.0, 30.0)
    assert chute_pixels(camera, chute, motion, np.ones(mask.shape)) == []


def test_beside_and_below_a_chute_the_surface_is_what_it_was():
    camera, mask, motion, chute, _ = scene(45.0, -90.0, 40.0)
    level = level_surface(camera, mask & ~chute).height
    (found,) = find_chutes(camera, mask, motion, np.ones(mask.shape), level)
    model = ChuteHeight(level, (found,))
    foot = np.asarray(found.foot[:2])
    ahead = np.array([np.cos(found.heading), np.sin(found.heading)])
    side = np.array([-ahead[1], ahead[0]])
    still = foot + np.array([0.2 * ahead, -0.1 * ahead + 2.0 * found.half_width * side])
    np.testing.assert_allclose(model.height(still), found.foot[2], atol=1e-9)
    up = foot - 0.1 * ahead
    rise = 0.1 * np.tan(np.radians(found.slope))
    assert model.height(up[None])[0] == pytest.approx(found.foot[2] + rise, abs=1e-9)
    # it ends, level, above its top
    far = foot - np.array([[2.0, 4.0]]).T * found.length * ahead
    assert np.ptp(model.height(far)) == pytest.approx(0.0, abs=1e-9)


def test_water_comes_in_at_the_top_of_a_chute_and_rests_in_its_bed():
    camera, mask, motion, chute, _ = scene(45.0, 0.0, 35.0, length=0.35)
    front = stream_surface(camera, mask, motion, np.ones(mask.shape), 0.04)
    points = camera.unproject(camera.pixel_grid()[mask], front.depth[mask].astype(float))
    labels = np.where(mask, Label.FLUID, Label.BACKGROUND).astype(np.uint8)
    still = Similarity3(1.0, np.eye(3), np.zeros(3))
    surface = PlacedHeight(front.height, still)
    assert surface.steps
    speed = np.where(mask, np.where(chute, 0.05, 0.012) / 0.04, np.nan)
    seen = PlanEvidence(surface, labels, points, camera, np.array([1.0, 0.0, 0.0]), speed)
    setting = channel_setting(seen, ChannelConfig("stream", 64, 400_000))
    cells, grid = setting.cell_types, setting.terrain.grid
    inlet = cells == CellType.INFLOW
    assert inlet.any()
    z = grid.centers()[..., 2]
    pool = float(np.median(points[:, 2]))
    top = float(points[:, 2].max())
    # all of it in the upper half of the chute: none in the pool, whose far end is further upstream
    assert setting.surface_height[inlet.any(axis=2)].min() > pool + 0.3 * (top - pool)
    # water that stands higher than the pool has ground below it
    high = (cells == CellType.FLUID) & (z > pool + 0.5 * (top - pool))
    assert (setting.bed_height[high.any(axis=2)] > pool).mean() > 0.9


# a chute as wide as its stream ----------------------------------------------------------------------------------


def stepped(slope, heading, pitch, *, noise=0.0, width=0.25):
    """A straight stream that falls down to a line across it and is level below: camera, mask, px per frame, depth.
    It gets faster on the chute, and half as fast below it."""
    camera = level_camera(PinholeCamera.from_fov(50.0, SIZE), UpEvidence(pitch, 0.0, "", 1.0))
    steep, level = (plane_axes(np.radians(a), np.radians(heading)) for a in (slope, 0.0))
    grid = camera.pixel_grid()
    rays = camera.rays(grid)
    foot = camera.rays(np.array([[0.5 * SIZE[0], 0.55 * SIZE[1]]]))[0]
    below = np.where(rays[..., 2] < -1e-3, foot[2] / np.minimum(rays[..., 2], -1e-3), 1e9)
    facing = rays @ steep[2]
    onto = np.where(facing < -1e-3, (foot @ steep[2]) / np.minimum(facing, -1e-3), 1e9)
    depth = np.minimum(below, onto)
    p = rays * np.minimum(depth, 50.0)[..., None] - foot
    run, across = p @ level[0], p @ level[1]
    chute = onto < below
    run = np.where(chute, run / np.cos(np.radians(slope)), run)
    mask = (np.abs(across) < width) & (run > -0.35) & (run < 0.5) & (depth < 50.0)
    speed = np.where(run < 0, 1.3 + run, 0.65 + 0.65 * np.exp(-np.maximum(run, 0.0) / 0.1)) * (1 - 8 * across**2)
    velocity = 0.02 * speed[..., None] * np.where(chute[..., None], steep[0], level[0])
    later, _ = camera.project(np.where(mask[..., None], p + foot + velocity, foot))
    motion = np.where(mask[..., None], later - grid, 0.0)
    if noise:
        eddies = ndimage.gaussian_filter(np.random.default_rng(1).normal(size=motion.shape), (6, 6, 0))
        motion = motion + mask[..., None] * eddies * noise * np.median(np.abs(motion[mask])) / eddies.std()
    return camera, mask, motion, np.where(mask, depth, 0.0), chute & mask


STEPS = [(30.0, -160.0, 15.0), (50.0, -30.0, 20.0), (25.0, 150.0, 40.0)]


@pytest.mark.parametrize("noise", [0.0, 0.1], ids=["exact", "eddies"])
@pytest.mark.parametrize(("slope", "heading", "pitch"), STEPS)
def test_a_stream_in_two_sections_is_told_from_one_slope_and_both_are_found(slope, heading, pitch, noise):
    camera, mask, motion, depth, chute = stepped(slope, heading, pitch, noise=noise)
    patches = flow_patches(mask, motion, np.ones(mask.shape))
    found = estimate_sections(camera, patches)
    assert found.share > SURE
    # chutes are tried in steps of 6 to 10 degrees; eddies of 10 % of the speed turn the motion by as many degrees
    assert found.mean == pytest.approx(slope, abs=12.0)
    front = stream_surface(camera, mask, motion, np.ones(mask.shape), 0.04)
    assert front.slope is not None and front.slope.chute == pytest.approx(found.mean)
    (part,) = front.chutes
    assert (part & chute).sum() / (part | chute).sum() > 0.7  # its line is tried in steps of a tenth
    seen = mask & (front.depth > 0)
    ratio = front.depth[seen] / depth[seen]
    error = np.abs(ratio / np.median(ratio[~chute[seen]]) - 1.0)
    flat = level_surface(camera, mask & ~chute).depth[seen] / depth[seen]
    level = np.abs(flat / np.median(flat[~chute[seen]]) - 1.0)
    assert np.median(error[chute[seen]]) < 0.5 * np.median(level[chute[seen]])
    # below it the stream is level: but for a strip beside the line, whose place is tried in steps of a tenth
    points = camera.unproject(camera.pixel_grid()[seen & ~chute], front.depth[seen & ~chute].astype(float))
    assert np.ptp(np.percentile(points[:, 2], [5, 75])) < 1e-3


@pytest.mark.parametrize(("heading", "pitch"), [(200.0, 20.0), (-30.0, 40.0), (-90.0, 30.0)])
def test_a_level_stream_that_slows_down_is_one_section(heading, pitch):
    camera, mask, motion, _, _ = stepped(0.0, heading, pitch, noise=0.15)
    assert estimate_sections(camera, flow_patches(mask, motion, np.ones(mask.shape))).share < SURE


def test_without_motion_there_is_one_section():
    camera = level_camera(PinholeCamera.from_fov(50.0, SIZE), UpEvidence(30.0, 0.0, "", 1.0))
    assert estimate_sections(camera, None).share == 0.0
