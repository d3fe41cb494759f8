"""Front surfaces: level planes, falling profiles, inflated silhouettes, depths that the user gives."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.shape.kind import level_camera
from fluidlift.shape.plume import SIGHT
from fluidlift.shape.surface import (
    PlaneHeight,
    ProfileHeight,
    SampledHeight,
    falling_surface,
    given_surface,
    inflated_surface,
    intersect_height,
    level_surface,
)
from fluidlift.types import PinholeCamera, UpEvidence

H, W = 72, 108
ROW, COL = np.mgrid[:H, :W]
EVERYWHERE = np.ones((H, W), bool)


def view(pitch, fov=50.0):
    return level_camera(PinholeCamera.from_fov(fov, (W, H)), UpEvidence(pitch, 0.0, "", 1.0))


def points_of(camera, front, mask):
    return camera.unproject(camera.pixel_grid()[mask], front.depth[mask].astype(np.float64))


# a stream -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pitch", [15.0, 35.0, 70.0])
def test_still_water_is_level_and_about_one_unit_away(pitch):
    camera, mask = view(pitch), ROW > 30
    front = level_surface(camera, mask)
    z = points_of(camera, front, mask)[:, 2]
    # depths are single precision
    np.testing.assert_allclose(z, z[0], rtol=1e-5)
    assert z[0] < 0  # below the camera
    assert np.median(front.depth[mask]) == pytest.approx(1.0, rel=1e-2)  # the median of the inverse is meant
    assert (front.half_thickness == 0).all()
    np.testing.assert_allclose(front.height.height(np.zeros((1, 2))), z[0], rtol=1e-5)


def test_water_nearer_to_the_foot_of_the_picture_is_nearer_to_the_camera():
    front = level_surface(view(35.0), ROW > 30)
    assert (np.diff(front.depth[31:, 50]) < 0).all()


def test_the_sky_has_no_depth():
    front = level_surface(view(10.0), ROW > 50)
    horizon = H / 2 - view(10.0).focal[1] * np.tan(np.radians(10.0))
    assert (front.depth[ROW + 0.5 < horizon] == 0).all()


def test_water_above_the_horizon_is_rejected_with_advice():
    with pytest.raises(InputRejected) as caught:
        level_surface(view(0.0), ROW < 20)
    assert "horizon" in caught.value.got
    assert "--pitch" in caught.value.do


def test_an_empty_mask_has_no_surface():
    for make in (lambda m: level_surface(view(30.0), m), lambda m: inflated_surface(view(0.0), m, "pour")):
        with pytest.raises(ValueError, match="mask"):
            make(np.zeros((H, W), bool))


# a fall ---------------------------------------------------------------------------------------------------------


def fall_into_a_pool():
    """Falling above row 40, running sideways below: mask, displacement."""
    mask = (np.abs(COL - 54) < 30) & (ROW > 8) & (ROW < 66)
    displacement = np.zeros((H, W, 2), np.float32)
    displacement[..., 1] = np.where(ROW < 40, 5.0, 0.0)
    displacement[..., 0] = np.where(ROW < 40, 0.0, 1.0)
    return mask, displacement * mask[..., None]


def test_water_is_steep_where_it_falls_and_flat_where_it_runs():
    camera = view(15.0)
    mask, displacement = fall_into_a_pool()
    front = falling_surface(camera, mask, displacement, np.ones((H, W)))
    # inclination along the middle column, between rows well inside each part (its profile is smoothed over 2 rows)
    p = points_of(camera, front, (COL == 54) & mask)
    rows = np.where(mask[:, 54])[0]
    steps = np.diff(p, axis=0)
    slope = np.degrees(np.arctan2(-steps[:, 2], -steps[:, 1]))
    assert np.median(slope[(rows[:-1] > 14) & (rows[:-1] < 34)]) > 65
    assert np.median(slope[(rows[:-1] > 46) & (rows[:-1] < 62)]) < 3  # a basin that leans runs empty


def test_the_depth_of_a_fall_is_where_its_rays_meet_its_height():
    camera = view(15.0)
    mask, displacement = fall_into_a_pool()
    front = falling_surface(camera, mask, displacement, np.ones((H, W)))
    seen = mask & (front.depth > 0)
    assert seen.sum() > 0.98 * mask.sum()
    p = points_of(camera, front, seen)
    # the ray is halved ten times within one of 96 steps; on the steep part (78 degrees) height grows 5 times faster
    np.testing.assert_allclose(front.height.height(p[:, :2]), p[:, 2], atol=1e-3)


def test_a_fall_does_not_bend_back_under_itself():
    camera = view(15.0)
    mask, displacement = fall_into_a_pool()
    profile = falling_surface(camera, mask, displacement, np.ones((H, W))).height
    assert (np.diff(profile.away) > 0).all() and (np.diff(profile.z) >= 0).all()


@pytest.mark.parametrize("lean", [-20.0, 12.0])
def test_a_fall_that_leans_lies_on_a_face_whose_fall_line_is_seen_to_lean_so(lean):
    camera = view(8.0)
    mask, _ = fall_into_a_pool()
    mask &= ROW < 40
    motion = np.zeros((H, W, 2)) + 5.0 * np.array([np.sin(np.radians(lean)), np.cos(np.radians(lean))])
    front = falling_surface(camera, mask, motion * mask[..., None], np.ones((H, W)))
    middle = points_of(camera, front, (np.abs(COL - 54) < 2) & (np.abs(ROW - 24) < 2) & mask).mean(axis=0)
    step = 1e-3 * np.eye(2)
    slope = np.array([front.height.height(middle[:2] + d) - front.height.height(middle[:2] - d) for d in step]) / 2e-3
    down = np.array([*-slope, -(slope @ slope)])
    ends, _ = camera.project(np.stack([middle, middle + 1e-3 * down / np.linalg.norm(down)]))
    seen = np.degrees(np.arctan2(*(ends[1] - ends[0])))
    # the camera looks down by 8 degrees and the sheet is beside its axis; straight down would be off by all of the lean
    assert seen == pytest.approx(lean, abs=4.0)


def test_a_profile_goes_on_level_above_and_gently_down_below():
    profile = ProfileHeight(np.array([1.0, 1.2]), np.array([0.0, 0.8]))
    xy = np.array([[0, 1.1], [5, 1.1], [0, 3.0], [0, 0.0]])
    np.testing.assert_allclose(profile.height(xy), [0.4, 0.4, 0.8, -np.tan(np.radians(1))])


def test_rays_meet_a_sloping_plane_where_algebra_says():
    camera, plane = view(30.0), PlaneHeight((0.1, 0.2), -0.8)
    rays = camera.rays(camera.pixel_grid())
    exact = -0.8 / (rays[..., 2] - 0.1 * rays[..., 0] - 0.2 * rays[..., 1])
    hit = (exact > 0.3) & (exact < 3.0)
    found = intersect_height(camera, plane, 0.3, 3.0)
    # one of 96 steps of 2.4 % each, halved ten times
    np.testing.assert_allclose(found[hit], exact[hit], rtol=3e-5)
    assert (found[exact < 0] == 0).all()  # rays that go up never meet it


# bodies in the air ----------------------------------------------------------------------------------------------


def test_a_round_silhouette_is_inflated_to_a_ball():
    camera, radius = view(0.0, fov=20.0), 26.0
    distance = np.hypot(COL + 0.5 - W / 2, ROW + 0.5 - H / 2)
    mask = distance < radius
    front = inflated_surface(camera, mask, "pour")
    unit = camera.focal[0]  # px per unit at depth 1
    ball = np.sqrt(np.maximum(radius**2 - distance**2, 0.0)) / unit
    # the silhouette is smoothed over some pixels: 12 % of the radius; the rim, where a ball is vertical, is left out
    inner = distance < radius - 4
    np.testing.assert_allclose(front.half_thickness[inner], ball[inner], atol=0.12 * radius / unit)
    np.testing.assert_allclose(front.depth[inner], 1.0 - front.half_thickness[inner], atol=0.01)
    assert front.height is None
    assert (front.depth[~mask] == 0).all() and (front.half_thickness[~mask] == 0).all()


def test_smoke_is_seen_within_its_body_and_a_jet_on_its_near_side():
    mask = np.abs(COL - 54) < 20
    jet, smoke = (inflated_surface(view(0.0), mask, kind) for kind in ("pour", "plume"))
    np.testing.assert_array_equal(jet.sighted, jet.depth)
    inside = (smoke.sighted - smoke.depth) / np.where(mask, 2 * smoke.half_thickness, 1.0)
    np.testing.assert_allclose(inside[mask], SIGHT, rtol=1e-3)  # float32


def test_a_given_depth_of_smoke_lies_within_its_body():
    mask = np.abs(COL - 54) < 20
    front = given_surface(view(0.0), mask, np.full(mask.shape, 3.0), "plume")
    np.testing.assert_allclose(front.sighted[mask], 1.0, rtol=1e-6)


def test_a_jet_that_hangs_from_the_upper_edge_is_as_thick_there_as_below():
    mask = np.abs(COL - 54) < 8
    half = inflated_surface(view(0.0), mask, "pour").half_thickness
    np.testing.assert_allclose(half[0, 54], half[36, 54], rtol=0.02)


def test_the_middle_of_a_jet_hangs_in_a_vertical_plane():
    camera, mask = view(20.0), np.abs(COL - 54) < 8
    front = inflated_surface(camera, mask, "pour")
    middle = camera.unproject(camera.pixel_grid()[mask], (front.depth + front.half_thickness)[mask])
    assert np.ptp(middle[:, 1]) < 1e-4 * np.median(middle[:, 1])  # float32


# given depth ----------------------------------------------------------------------------------------------------


def test_a_given_depth_is_kept_up_to_its_scale():
    camera, mask = view(35.0), ROW > 30
    metres = 4.0 * level_surface(camera, EVERYWHERE & (ROW > 20)).depth.astype(np.float64)
    front = given_surface(camera, mask, metres, "stream")
    np.testing.assert_allclose(front.depth[mask], metres[mask] / np.median(metres[mask]), rtol=1e-5)
    p = points_of(camera, front, mask)
    # the height model goes through the same points; a plane is met to the spacing of its samples
    np.testing.assert_allclose(front.height.height(p[:, :2]), p[:, 2], atol=2e-3)


def test_holes_in_a_given_depth_are_filled_from_beside_them():
    camera, mask = view(0.0), np.abs(COL - 54) < 20
    depth = np.full((H, W), 2.0)
    depth[30:35, 50:55] = np.nan
    depth[40:42, 50:55] = 0.0
    front = given_surface(camera, mask, depth, "pour")
    np.testing.assert_allclose(front.depth[mask], 1.0)
    assert front.half_thickness[36, 54] > 0  # its far side is still unknown


def test_a_depth_that_says_nothing_on_the_fluid_is_rejected():
    with pytest.raises(InputRejected, match="empty on"):
        given_surface(view(35.0), ROW > 30, np.where(ROW > 60, 1.0, 0.0), "stream")


def test_a_sampled_height_goes_through_its_samples():
    xyz = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    # the nearest sample has a weight of a million over its neighbours some hundredths away
    np.testing.assert_allclose(SampledHeight(xyz).height(xyz[:, :2]), xyz[:, 2], atol=1e-3)


def kinds_level(camera):
    from fluidlift.shape.kind import level_camera

    return level_camera(camera, UpEvidence(0.0, 0.0, "given", 1.0))
