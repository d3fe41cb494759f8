"""Jets above a film, on scenes whose geometry is known: a sloping film and a round vertical jet, seen by a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from fluidlift.shape import airborne, jets
from fluidlift.shape.heights import PlaneHeight
from fluidlift.shape.jet_column import Jet, with_columns
from fluidlift.shape.kind import level_camera
from fluidlift.shape.surface import FrontSurface
from fluidlift.types import CellType, Grid, PinholeCamera, Setting, Similarity3, Terrain, TriangleMesh, UpEvidence

INTERVAL = 0.04
RADIUS = 0.03


@dataclass(frozen=True)
class Scene:
    """A picture of the film and the jet, with its truth."""

    camera: PinholeCamera
    mask: np.ndarray
    motion: np.ndarray
    depth: np.ndarray
    falls: np.ndarray
    front: FrontSurface
    foot: float
    axis: tuple[float, float]

    @property
    def trust(self) -> np.ndarray:
        return self.mask.astype(float)


def scene(
    *, pitch=35.0, slope=10.0, downhill=(1.0, 0.0), axis: tuple[float, float] | None = (-0.2, 0.0), length=0.15,
    falls_at=1.0, film_speed=0.4, core=0.0, noise=0.3, roll=0.0, width=0.25,
) -> Scene:  # fmt: skip
    """A film 0.6 m long on a slope, whose speed falls off towards its banks, seen from 1.2 m; the jet slows over its
    radius above it. `noise`: px, of a flow that is blurred as well."""
    p, r = np.radians(pitch), np.radians(roll)
    eye = 1.2 * np.array([0.0, -np.cos(p), np.sin(p)])
    right, up = np.array([1.0, 0, 0]), np.array([0.0, np.sin(p), np.cos(p)])
    camera = PinholeCamera.looking(eye, np.zeros(3), 45.0, (320, 256), up=tuple(np.cos(r) * up + np.sin(r) * right))
    rays, fall = camera.rays(camera.pixel_grid()), np.tan(np.radians(slope))
    along = np.asarray(downhill, float)
    side = np.array([-along[1], along[0]])
    normal = np.array([fall * along[0], fall * along[1], 1.0])
    plane = -(eye @ normal) / np.minimum(rays @ normal, -1e-9)
    ground = (eye + rays * plane[..., None])[..., :2]
    across = (ground @ side) / (width / 2)
    film = (np.abs(ground @ along) < 0.3) & (np.abs(across) < 1)
    speed = film_speed * (1 - 0.7 * across**2) * (1 + core * np.exp(-((across / 0.2) ** 2)))
    velocity = speed[..., None] * np.array([along[0], along[1], -fall]) / np.hypot(1, fall)
    depth, airborne_pixels, foot = np.where(film, plane, 0.0), np.zeros(film.shape, bool), 0.0
    if axis is not None:
        foot = -fall * float(np.asarray(axis) @ along)
        near, _ = Jet(axis, np.array([foot - 2 * RADIUS, foot + length]), np.full(2, RADIUS)).seen(camera)
        airborne_pixels = (near > 0) & (near < np.where(plane > 0, plane, np.inf))
        z = eye[2] + near * rays[..., 2] - foot
        depth = np.where(airborne_pixels, near, depth)
        slowing = np.clip(z / RADIUS, 0.0, 1.0)
        velocity = np.where(
            airborne_pixels[..., None], -falls_at * slowing[..., None] * np.array([0, 0, 1.0]), velocity
        )
    mask = depth > 0
    end, _ = camera.project(eye + rays * depth[..., None] + INTERVAL * velocity)
    motion = np.where(mask[..., None], end - camera.pixel_grid(), 0.0)
    motion = np.where(mask[..., None], _seen(motion, mask, noise), 0.0)
    level = PlaneHeight((-fall * along[0], -fall * along[1]), 0.0)
    front = FrontSurface(np.where(plane > 0, plane, 0.0), np.zeros_like(plane), level)
    return Scene(camera, mask, motion, depth, airborne_pixels, front, foot, axis or (0.0, 0.0))


def _seen(motion, mask, noise):
    """A flow as it is measured: blurred by a window of a few pixels, with smooth errors."""
    from scipy import ndimage

    rng, weight = np.random.default_rng(0), np.maximum(ndimage.gaussian_filter(mask.astype(float), 2.0), 1e-6)
    parts = [
        ndimage.gaussian_filter(motion[..., k] * mask, 2.0) / weight
        + noise * 7.0 * ndimage.gaussian_filter(rng.normal(size=mask.shape), 2.0)  # 7: unit deviation after the filter
        for k in (0, 1)
    ]
    return np.stack(parts, axis=-1)


def overlap(found: np.ndarray, true: np.ndarray) -> float:
    return (found & true).sum() / (found | true).sum()


VIEWS = {
    "usual": {},
    "noisy": {"noise": 1.0},
    "low": {"pitch": 20.0},
    "steep": {"pitch": 50.0},
    "level": {"slope": 0.0},
    "steep slope": {"slope": 30.0},
    "towards the viewer": {"downhill": (0.0, -1.0), "slope": 20.0, "axis": (0.0, 0.2)},
    "turned": {"roll": 8.0},
    "long, cut by the picture": {"length": 0.8},
}


@pytest.mark.parametrize("view", VIEWS)
def test_a_jet_above_a_film_is_found_where_it_is(view):
    s = scene(**VIEWS[view])
    found = jets.find_jets(s.camera, s.mask, s.motion, s.trust)
    assert len(found) == 1
    # the flow is blurred over 4 px, and the jet is 25 px wide
    assert overlap(found[0].pixels, s.falls) > 0.8
    assert found[0].cut == ("cut" in view)


@pytest.mark.parametrize("view", VIEWS)
def test_the_depth_of_jet_and_film_is_that_of_the_scene(view):
    s = scene(**VIEWS[view])
    front, (jet,), falls = with_columns(s.front, jets.find_jets(s.camera, s.mask, s.motion, s.trust), s.camera, s.mask)
    away = np.hypot(jet.axis[0] - s.axis[0], jet.axis[1] - s.axis[1])
    assert away < RADIUS  # the foot is known to a few pixels, which at a low view are a radius on the ground
    assert abs(np.median(jet.radius) - RADIUS) < 0.15 * RADIUS
    error = np.abs(front.depth - s.depth)[s.falls & falls] / s.depth[s.falls & falls]
    # its axis is known to a radius and its radius to 15 %, at 1.2 m from the camera
    assert np.median(error) < 1.15 * RADIUS / 1.2
    film = s.mask & ~s.falls & ~falls
    np.testing.assert_allclose(front.depth[film], s.depth[film], rtol=1e-5)  # stored in single precision


@pytest.mark.parametrize("view", ["usual", "low", "steep", "turned"])
def test_a_jet_whose_top_is_hidden_by_a_nozzle_does_not_stand_out_before_it(view):
    s = scene(**VIEWS[view])
    row = np.arange(s.mask.shape[0])[:, None]
    nozzle = s.falls & (row < np.flatnonzero(s.falls.any(axis=1))[0] + 12)
    found = jets.find_jets(s.camera, s.mask & ~nozzle, s.motion, s.trust * ~nozzle)
    _, (jet,), _ = with_columns(s.front, found, s.camera, s.mask & ~nozzle)
    near, _ = jet.seen(s.camera)
    # the column is fitted to an outline that is blurred over 4 px
    high = np.flatnonzero((near > 0).any(axis=1))[0]
    assert high > np.flatnonzero((s.falls & ~nozzle).any(axis=1))[0] - 4
    assert jet.top - s.foot > 0.5 * 0.15  # of its length


LYING = {
    "a film": {},
    "a film towards the viewer": {"downhill": (0.0, -1.0), "slope": 20.0},
    "with a fast core towards the viewer": {"downhill": (0.0, -1.0), "core": 2.0, "width": 0.4},
    "with much noise": {"noise": 2.0},
    "with a fast core": {"core": 2.0},
}


@pytest.mark.parametrize("film", LYING)
def test_without_a_jet_all_is_lying(film):
    s = scene(axis=None, **LYING[film])
    assert jets.find_jets(s.camera, s.mask, s.motion, s.trust) == []


def test_what_falls_past_the_fluid_without_landing_is_no_jet_onto_it():
    s = scene()
    mask = s.mask & (s.falls | (s.camera.pixel_grid()[..., 0] > 150))  # nothing lies below it
    assert jets.find_jets(s.camera, mask, s.motion, s.trust) == []


def test_a_patch_that_moves_down_amid_the_film_is_no_jet():
    s = scene(axis=None, downhill=(0.0, -1.0), slope=20.0, width=0.4)
    motion = s.motion.copy()
    motion[120:150, 150:175] += 8.0 * np.array([0.0, 1.0])  # fluid lies above it as well
    assert jets.find_jets(s.camera, s.mask, motion, s.trust) == []


def test_vertical_lines_of_the_scene_follow_the_projected_vertical():
    camera = scene(roll=8.0).camera
    points = np.array([[0.1, 0.1, 0.0], [-0.2, 0.0, 0.1], [0.0, -0.1, 0.0]])
    start, _ = camera.project(points)
    end, _ = camera.project(points - np.array([0, 0, 1e-5]))
    step = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    rows, cols = np.floor(start[:, 1]).astype(int), np.floor(start[:, 0]).astype(int)
    # half a pixel turns the direction by less than a thousandth
    np.testing.assert_allclose(jets.projected_vertical(camera)[rows, cols], step, atol=1e-3)


def test_a_turned_picture_shows_in_its_jets():
    camera = PinholeCamera.from_fov(50.0, (320, 240))

    def roll(turn, half_width):
        """Found from a jet 100 px long that follows the vertical of a camera turned by so much."""
        down = jets.projected_vertical(level_camera(camera, UpEvidence(30.0, turn, "", 1.0)))[100, 120]
        centers = np.array([120.5, 100.5]) + np.linspace(-50, 50, 6)[:, None] * down
        outline = jets.JetOutline(np.zeros((240, 320), bool), centers, np.full(6, half_width), cut=False)
        return jets.roll_of([outline], level_camera(camera, UpEvidence(30.0, 0.0, "", 1.0)))

    assert abs(roll(0.0, 2.0)) < 0.1
    # a thin jet is known to 2.6 degrees, a thick one to 9, against 3 of the habit of holding a camera level
    assert 3.5 < roll(8.0, 2.0) < 6.0
    assert -6.0 < roll(-8.0, 2.0) < -3.5
    assert 0.4 < roll(8.0, 25.0) < 2.0
    assert jets.roll_of([], camera) == 0.0


def test_what_a_jet_hides_of_the_film_lies_and_what_stands_above_it_does_not():
    mask = np.zeros((60, 100), bool)
    mask[30:55, 5:95] = True
    jet = np.zeros_like(mask)
    jet[10:45, 40:50] = True
    lying = jets.lying_pixels(mask | jet, jet)
    np.testing.assert_array_equal(lying, mask)


def test_a_neck_above_a_wide_puddle_is_seen_in_the_silhouette():
    y, x = np.mgrid[:200, :240]
    puddle = ((x - 120) / 100) ** 2 + ((y - 130) / 55) ** 2 < 1
    neck = (np.abs(x - 120) < 10) & (y > 40) & (y < 130)
    found = jets.find_neck(puddle | neck)
    assert found is not None
    np.testing.assert_allclose(found.centers[:, 0], 120, atol=1)
    assert 40 <= found.centers[0, 1] < 44
    # it ends inside the puddle: below the far edge (75) by its foreshortened width
    assert 80 < found.centers[-1, 1] < 100
    assert jets.find_neck(puddle) is None


def test_the_far_edge_of_a_puddle_does_not_widen_the_threads_above_it():
    y, x = np.mgrid[:200, :240]
    # a bank lifts the far edge towards the threads
    puddle = (((x - 120) / 100) ** 2 + ((y - 130) / 55) ** 2 < 1) & (y > 85)
    edge = (np.abs(x - 120) < 22 - 0.8 * (85 - y)) & (y > 65) & (y < 90)
    neck = (np.abs(x - 120) < 10) & (y > 40) & (y < 130)
    found = jets.find_neck(puddle | edge | neck)
    assert found is not None
    # 19 pixels wide
    np.testing.assert_allclose(found.half_widths, 9.5, atol=1.0)
    assert not (found.pixels & (np.abs(x - 120) > 15)).any()


def test_a_jet_into_a_glass_seen_from_the_side_is_no_neck():
    y, x = np.mgrid[:200, :240]
    glass = (np.abs(x - 120) < 30) & (y > 110) & (y < 190)
    neck = (np.abs(x - 120) < 9) & (y < 130)
    assert jets.find_neck(glass | neck) is None


def _film_setting() -> Setting:
    """A film 6 cells deep in a box, open at both ends along x."""
    grid = Grid((40, 20, 12), 0.02, (-0.4, -0.2, -0.16))
    z = grid.nodes()[..., 2]
    cells = np.full(grid.shape, CellType.EMPTY, np.uint8)
    height = grid.centers()[..., 2]
    cells[height < -0.12] = CellType.SOLID
    cells[(height > -0.12) & (height < 0)] = CellType.FLUID
    cells[:2][cells[:2] == CellType.FLUID] = CellType.INFLOW
    cells[-2:][cells[-2:] != CellType.SOLID] = CellType.OUTFLOW
    mesh = TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    terrain = Terrain(grid, (z + 0.12).astype(np.float32), np.array([1.0, 0, 0]), mesh)
    return Setting(terrain, cells, np.zeros(grid.shape[:2]), np.full(grid.shape[:2], -0.12))


def _surface(speed):
    """Points all over the film and their velocities, `speed` of x."""
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.39, 0.39, 40), np.linspace(-0.19, 0.19, 20)))
    points = np.stack([x, y, np.zeros_like(x)], -1)
    return points, np.stack([speed(x), np.zeros_like(x), np.zeros_like(x)], -1)


WIDE = PinholeCamera.looking(np.array([0.0, -1.5, 1.5]), np.zeros(3), 60.0, (320, 240))
JET = Jet((-0.2, 0.0), np.array([-0.05, 0.3]), np.array([0.06, 0.06]))


def test_fluid_enters_at_the_top_of_a_jet_that_feeds_a_film_at_rest_behind_it():
    points, velocities = _surface(lambda x: np.where(x < -0.2, 0.0, 0.3))
    out = airborne.with_jets(_film_setting(), [JET], points, velocities, WIDE)
    centers = out.terrain.grid.centers()
    inlet = centers[out.cell_types == CellType.INFLOW]
    assert (np.hypot(inlet[:, 0] + 0.2, inlet[:, 1]) <= 0.06).all()
    assert inlet[:, 2].min() > 0.3 - 3 * out.terrain.grid.spacing
    assert (out.cell_types == CellType.OUTFLOW).any()
    # one connected body from the top to the film
    from scipy import ndimage

    wet = np.isin(out.cell_types, (CellType.FLUID, CellType.INFLOW))
    assert ndimage.label(wet)[1] == 1
    volume = (wet & (centers[..., 2] > 0)).sum() * out.terrain.grid.spacing**3
    assert abs(volume - np.pi * 0.06**2 * 0.3) < 0.2 * volume  # a circle of 32 cells
    assert out.terrain.signed_distance.shape == tuple(n + 1 for n in out.terrain.grid.shape)
    np.testing.assert_allclose(np.diff(out.terrain.signed_distance, axis=2), 0.02, atol=1e-6)


def test_a_stream_that_moves_behind_the_jet_keeps_its_own_inlet():
    points, velocities = _surface(lambda x: np.full_like(x, 0.3))
    downstream = Jet((0.1, 0.0), JET.z, JET.radius)
    out = airborne.with_jets(_film_setting(), [downstream], points, velocities, WIDE)
    assert (out.cell_types[:2] == CellType.INFLOW).any()
    assert (out.cell_types[5:] == CellType.INFLOW).any()


def test_a_puddle_that_ends_at_rest_is_closed_and_a_film_that_moves_there_is_open():
    points, velocities = _surface(lambda x: np.where(np.abs(x + 0.2) < 0.2, 0.3, 0.0))
    puddle = airborne.with_jets(_film_setting(), [JET], points, velocities, WIDE)
    assert not (puddle.cell_types == CellType.OUTFLOW).any()
    # what was an outlet holds the water that the puddle has elsewhere
    np.testing.assert_array_equal(puddle.cell_types[-1], puddle.cell_types[-5])
    points, velocities = _surface(lambda x: np.full_like(x, 0.3))
    film = airborne.with_jets(_film_setting(), [JET], points, velocities, WIDE)
    assert (film.cell_types == CellType.OUTFLOW).any()


def test_an_upstream_end_that_the_picture_cuts_stays_an_inlet():
    points, velocities = _surface(lambda x: np.where(x < 0, 0.0, 0.3))
    jet = Jet((0.1, 0.0), JET.z, JET.radius)
    narrow = PinholeCamera.looking(np.array([0.0, -1.5, 1.5]), np.zeros(3), 18.0, (320, 240))
    for camera, fed in ((narrow, True), (WIDE, False)):
        out = airborne.with_jets(_film_setting(), [jet], points, velocities, camera)
        assert (out.cell_types[:2] == CellType.INFLOW).any() == fed


def test_a_thread_thinner_than_half_a_cell_has_no_cells():
    setting = _film_setting()
    thread = Jet((-0.2, 0.0), np.array([-0.05, 0.3]), np.array([0.005, 0.005]))
    points, velocities = _surface(lambda x: np.full_like(x, 0.3))
    assert airborne.with_jets(setting, [thread], points, velocities, WIDE) is setting


def test_a_column_keeps_its_place_and_shape_when_it_is_scaled_and_turned():
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = JET.transformed(Similarity3(2.0, turn, np.array([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(moved.axis, (1.0, 1.6))
    np.testing.assert_allclose(moved.z, 2.0 * JET.z + 3.0)
    np.testing.assert_allclose(moved.radius, 2.0 * JET.radius)


def test_the_seen_depth_of_a_column_is_where_the_rays_meet_it():
    near, half = JET.seen(WIDE)
    hit = near > 0
    points = WIDE.unproject(WIDE.pixel_grid()[hit], near[hit])
    away = np.hypot(points[:, 0] + 0.2, points[:, 1])
    side = points[:, 2] < JET.top - 1e-6
    np.testing.assert_allclose(away[side], 0.06, atol=1e-9)
    assert (away[~side] <= 0.06 + 1e-9).all() and (~side).any()
    back = WIDE.unproject(WIDE.pixel_grid()[hit], (near + 2 * half)[hit])
    np.testing.assert_allclose(np.hypot(back[:, 0] + 0.2, back[:, 1]), 0.06, atol=1e-9)


def test_a_jet_that_feeds_all_of_a_film_is_told_from_one_above_a_stream_and_one_that_spreads():
    s = scene()
    found = jets.find_jets(s.camera, s.mask, s.motion, s.trust)
    lying = jets.lying_pixels(s.mask, jets.airborne_pixels(found, s.mask.shape))
    rows, cols = np.nonzero(lying)
    assert jets.feed_all(found, lying, s.motion, s.trust)
    assert not jets.feed_all([], lying, s.motion, s.trust)  # nothing is seen to bring it
    # the same cut off where it comes from: a stream over the border, under the same jet
    flow = s.motion[lying].mean(axis=0)
    upstream = int(np.argmax(np.abs(flow)))
    line = int(np.percentile((cols, rows)[upstream], 30))
    kept = slice(line, None) if flow[upstream] > 0 else slice(None, line)
    window = (slice(None), kept) if upstream == 0 else (kept, slice(None))
    cut = [replace(found[0], pixels=found[0].pixels[window])]
    assert not jets.feed_all(cut, lying[window], s.motion[window], s.trust[window])
    # off to all sides from the foot
    away = s.camera.pixel_grid() - found[0].centers[-1]
    assert not jets.feed_all(found, lying, away / np.linalg.norm(away, axis=-1, keepdims=True), s.trust)
