"""Vessels that are looked into: axis, width and level from their rim and from what is seen of their liquid."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fluidlift.shape.channel import ChannelConfig, channel_setting
from fluidlift.shape.filled_vessel import (
    FilledVessel,
    behind_its_wall,
    filled_volume,
    find_vessel,
    look_of_vertices,
    pool_depths,
    seen_higher,
)
from fluidlift.shape.ground_mesh import VertexLook, ground_colours
from fluidlift.shape.heights import PlaneHeight
from fluidlift.shape.kind import level_camera
from fluidlift.shape.looked_into import bowl_of, level_below, rim_circle, seen_through
from fluidlift.shape.plan import PlanEvidence
from fluidlift.shape.view.roundness import Ellipse, fit_ellipse
from fluidlift.types import CellType, Label, PinholeCamera, Similarity3, TriangleMesh, UpEvidence, VesselRim

AWAY, RADIUS, TAPER = 2.0, 0.25, 0.3
"""m to the axis along the ground, of the rim's inner edge, and radius lost per height"""
EDGE = -AWAY * np.tan(np.radians(35.0)) + 0.1
PIXEL = AWAY / 330.0 / np.cos(np.radians(35.0))


def camera_at(pitch: float, roll: float = 0.0) -> PinholeCamera:
    return level_camera(PinholeCamera.from_fov(40.0, (240, 240)), UpEvidence(pitch, roll, "", 0.0))


def cup(level: float, outer: float = 1.0) -> FilledVessel:
    """Filled up to `level` m below its rim, whose outer edge is as many times as wide as the inner one."""
    heights = np.linspace(EDGE - 0.4, EDGE, 40)
    mouth = VesselRim((0.1, AWAY, EDGE), outer * RADIUS)
    radii = RADIUS - TAPER * (EDGE - heights)
    return FilledVessel((0.1, AWAY), heights, radii, EDGE - level, looked_into=True, edge=EDGE, mouth=mouth)


def ellipse_of(camera: PinholeCamera, rim: VesselRim) -> Ellipse:
    """A rim as it is found in a picture."""
    turns = np.linspace(0.0, 2.0 * np.pi, 400)
    ring = np.asarray(rim.center) + rim.radius * np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], axis=1)
    width, height = (8 * n for n in camera.size)  # what is filled has its outline in it, half a pixel too much
    corners = np.round(camera.project(ring)[0] * 8 - 0.5).astype(np.int32)
    found = fit_ellipse(cv2.fillPoly(np.zeros((height, width), np.uint8), [corners], 1) > 0)
    assert found is not None
    return Ellipse((found.center[0] / 8, found.center[1] / 8), found.covariance / 64, 1.0)


def shown(camera: PinholeCamera, vessel: FilledVessel, jet: float = 0.02) -> np.ndarray:
    """What is seen through the rim's inner edge of what it holds, and a jet that falls in."""
    whole = np.ones(camera.size[::-1], bool)
    assert vessel.mouth is not None
    held = np.isfinite(pool_depths(camera, whole, vessel)[0])
    held &= seen_through(VesselRim(vessel.mouth.center, RADIUS), camera)
    falls = FilledVessel(vessel.axis, np.array([vessel.level, EDGE + 0.1]), np.full(2, jet), EDGE + 0.1)
    return held | np.isfinite(pool_depths(camera, whole, falls)[0])


@pytest.mark.parametrize(("pitch", "roll"), [(35.0, 0.0), (25.0, 4.0), (60.0, 0.0)])
def test_an_ellipse_and_a_distance_are_a_level_circle(pitch, roll):
    camera = camera_at(pitch, roll)
    z = -AWAY * np.tan(np.radians(pitch))
    truth = VesselRim((0.1, AWAY, z), RADIUS)
    found = rim_circle(camera, ellipse_of(camera, truth), AWAY)
    assert found is not None
    assert found.center == pytest.approx(truth.center, abs=0.01) and found.radius == pytest.approx(RADIUS, rel=0.02)


def test_what_reaches_up_to_the_horizon_is_no_level_circle():
    assert rim_circle(camera_at(0.0), Ellipse((120.0, 120.0), np.diag([900.0, 100.0]), 1.0), AWAY) is None


@pytest.mark.parametrize("level", [0.08, 0.16, 0.24])
@pytest.mark.parametrize("outer", [1.0, 1.0 / 0.9])
def test_the_far_arc_tells_how_high_and_how_wide_a_level_is(level, outer):
    camera, truth = camera_at(35.0), cup(level, outer)
    assert truth.mouth is not None
    found = level_below(truth.mouth, camera, shown(camera, truth))
    assert found is not None
    assert found.z == pytest.approx(truth.level, abs=4.0 * PIXEL)
    assert found.radius == pytest.approx(float(truth.radius_at(np.array([truth.level]))[0]), abs=3.0 * PIXEL)
    assert found.inner == pytest.approx(RADIUS, rel=0.06)


def test_what_is_no_level_circle_has_no_level():
    camera, truth = camera_at(35.0), cup(0.1)
    assert truth.mouth is not None
    half = seen_through(truth.mouth, camera) & (np.arange(240)[None] < 100)
    assert level_below(truth.mouth, camera, half) is None
    assert level_below(truth.mouth, camera, np.zeros_like(half)) is None


def test_a_rim_tells_the_vessel_up_to_its_edge_and_the_volume_of_every_level():
    camera, truth = camera_at(35.0), cup(0.2)
    assert truth.mouth is not None
    mask = shown(camera, truth)
    found = find_vessel(camera, mask, AWAY, [ellipse_of(camera, truth.mouth)])
    assert found is not None and found.looked_into and found.mouth is not None
    assert found.axis == pytest.approx(truth.axis, abs=0.01) and found.rim == pytest.approx(EDGE, abs=0.01)
    z = np.linspace(truth.level, EDGE, 9)
    np.testing.assert_allclose(found.radius_at(z), truth.radius_at(z), atol=3.0 * PIXEL)
    assert found.floor < found.level - 0.05 and found.inflow == pytest.approx((0.0, 0.0, -1.0), abs=0.05)
    assert seen_higher(found, camera, mask) is found, "it is known up to its edge already"
    higher = shown(camera, cup(0.1))
    between = float(np.pi / 12.0 * 0.1 * (0.38**2 + 0.38 * 0.44 + 0.44**2))  # a frustum of radii 0.19 and 0.22
    gained = filled_volume(found, camera, higher) - filled_volume(found, camera, mask)
    assert gained == pytest.approx(between, rel=0.2)  # two levels, each to a pixel or two of 30
    same = find_vessel(camera, mask, AWAY, mouth=found.mouth)
    assert same is not None and same.level == pytest.approx(found.level, abs=1e-6)
    moved = found.transformed(Similarity3(2.0, np.eye(3), np.array([0.0, 0.0, 1.0])))
    assert moved.mouth is not None and moved.mouth.radius == pytest.approx(2.0 * found.mouth.radius)
    assert moved.mouth.center[2] == pytest.approx(moved.rim)


def test_its_wall_hides_all_of_it_but_what_is_seen_through_its_rim():
    camera, vessel = camera_at(35.0), cup(0.2)
    walls = behind_its_wall(vessel, camera, shown(camera, vessel))
    brimful = np.isfinite(pool_depths(camera, np.ones((240, 240), bool), replace(vessel, level=EDGE))[0])
    opening = seen_through(VesselRim((0.1, AWAY, EDGE), RADIUS), camera)
    assert walls[brimful & ~opening].all() and not walls[opening].any()


def test_a_rim_says_nothing_of_a_pool_beside_it_or_of_one_that_is_as_wide():
    camera, truth = camera_at(35.0), cup(0.2)
    assert truth.mouth is not None
    rim = ellipse_of(camera, truth.mouth)
    beside = Ellipse((rim.center[0] + 60.0, rim.center[1]), rim.covariance, 1.0)
    saucer = Ellipse((rim.center[0], rim.center[1] + 25.0), 4.0 * rim.covariance, 1.0)
    found = find_vessel(camera, shown(camera, truth), AWAY, [saucer, rim])
    assert found is not None and found.mouth is not None
    assert found.mouth.radius == pytest.approx(truth.mouth.radius, rel=0.05), "and not the saucer's"
    brimful = shown(camera, cup(0.0))
    for mask, other in ((shown(camera, truth), beside), (brimful, rim)):
        found = find_vessel(camera, mask, AWAY, [other])
        assert found is None or found.mouth is None


def test_the_look_of_its_wall_is_read_within_it_and_ground_behind_it_is_not_seen():
    camera, vessel = camera_at(35.0), cup(0.2, outer=1.12)
    assert vessel.mouth is not None
    thickness, turns = 0.1, np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    z = EDGE - 0.15
    outside = float(vessel.radius_at(np.array([z]))[0]) + thickness
    wall = np.column_stack([vessel.axis + outside * ring, np.full(40, z)])
    floor = vessel.floor
    behind, before = np.array([0.1, AWAY + 0.5, floor]), np.array([0.1, AWAY - 0.6, floor])
    found = look_of_vertices(vessel, camera, np.concatenate([wall, [behind, before]]), thickness)
    away = np.linalg.norm(found.places[:40, :2] - vessel.axis, axis=1)
    np.testing.assert_allclose(away, outside - thickness + 0.5 * 0.12 * RADIUS, atol=1e-6)
    np.testing.assert_array_equal(found.places[40:], [behind, before])
    assert found.stands.tolist() == [True] * 40 + [False] * 2
    assert found.covered.tolist() == [False] * 40 + [True, False]


def test_ground_that_a_vessel_hides_goes_on_as_the_ground_beside_it():
    camera = camera_at(60.0)
    z = -AWAY * np.tan(np.radians(60.0))
    vertices = np.array([[x, AWAY + y, z] for y in (-0.3, 0.0, 0.3) for x in (-0.3, 0.0, 0.3)] + [[0.0, AWAY, z + 0.1]])
    plate = np.full((240, 240, 3), 50, np.uint8)
    row, col, _ = camera.nearest_pixels(vertices[[4, 9]])
    for r, c in zip(row, col, strict=True):
        plate[r - 4 : r + 5, c - 4 : c + 5] = 250  # the vessel, and before the middle of the ground, too
    mesh = TriangleMesh(vertices, np.array([[0, 1, 3], [1, 2, 4], [3, 4, 6], [4, 5, 7], [5, 8, 7], [9, 0, 1]]))
    nothing = np.arange(10) < 0
    plain = ground_colours(mesh, plate, camera)
    assert plain[4].min() > 0.9
    covered, stands = nothing.copy(), nothing.copy()
    covered[4], stands[9] = True, True
    found = ground_colours(mesh, plate, camera, VertexLook(vertices, covered, stands))
    assert found[4].max() < 0.25 and found[9].min() > 0.9
    np.testing.assert_array_equal(np.delete(found, 4, axis=0), np.delete(plain, 4, axis=0))


@pytest.mark.parametrize("level", [0.08, 0.2])
def test_a_rim_above_standing_water_tells_the_bowl_that_it_stands_in(level):
    camera, truth = camera_at(35.0), cup(level)
    assert truth.mouth is not None
    mask = shown(camera, truth, jet=0.0)
    found = bowl_of(camera, ellipse_of(camera, truth.mouth), mask, truth.level)
    assert found is not None
    assert found.rim.center == pytest.approx(truth.mouth.center, abs=4.0 * PIXEL)
    assert found.rim.radius == pytest.approx(RADIUS, rel=0.06)
    hidden = np.isfinite(pool_depths(camera, np.ones_like(mask), truth)[0]) & ~mask
    pool = found.pool(camera)
    assert pool[mask].mean() > 0.95 and pool[hidden & pool_of(camera, truth)].mean() > 0.9
    assert bowl_of(camera, ellipse_of(camera, truth.mouth), np.zeros_like(mask), truth.level) is None
    beyond = mask | np.roll(mask, 20, axis=1)
    assert bowl_of(camera, ellipse_of(camera, truth.mouth), beyond, truth.level) is None, "another bank holds that"


def pool_of(camera: PinholeCamera, vessel: FilledVessel) -> np.ndarray:
    """Pixels of all of its level."""
    assert vessel.mouth is not None
    level = VesselRim((*vessel.axis, vessel.level), float(vessel.radius_at(np.array([vessel.level]))[0]))
    return seen_through(level, camera)


def test_the_ground_around_standing_water_is_its_bowl_on_a_table():
    camera, truth = camera_at(35.0), cup(0.1)
    assert truth.mouth is not None
    mask = shown(camera, truth, jet=0.0)
    bowl = bowl_of(camera, ellipse_of(camera, truth.mouth), mask, truth.level)
    assert bowl is not None
    pool = bowl.pool(camera)
    labels = np.where(pool, np.uint8(Label.FLUID), np.uint8(Label.BACKGROUND))
    rays = camera.rays(camera.pixel_grid()[pool])
    visible = camera.position + rays * ((truth.level - camera.position[2]) / rays[:, 2:])
    surface = PlaneHeight((0.0, 0.0), truth.level)
    seen = PlanEvidence(
        surface, labels, visible, camera, np.array([1.0, 0.0, 0.0]), closed=True, goes_on=True, ever=pool, bowl=bowl
    )
    setting = channel_setting(seen, ChannelConfig("basin", 48, 200_000))
    grid, ground = setting.terrain.grid, setting.bed_height
    away = np.linalg.norm(grid.centers()[:, :, 0, :2] - truth.axis, axis=-1)
    water = (setting.cell_types == CellType.FLUID).any(axis=2)
    assert water[away < bowl.level.radius - 1.5 * grid.spacing].all(), "also behind its near wall"
    ring = (away > bowl.rim.radius + 0.5 * grid.spacing) & (away < bowl.rim.radius + 2.5 * grid.spacing)
    np.testing.assert_allclose(ground[ring], bowl.rim.center[2], atol=1e-6)
    table = away > bowl.rim.radius + 5.5 * grid.spacing
    assert table.any() and np.ptp(ground[table]) < 1e-9 and ground[table].max() < truth.level - 2.0 * grid.spacing
