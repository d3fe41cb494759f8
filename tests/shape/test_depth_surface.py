"""Surfaces from a depth picture: what is sure is taken over, slow errors are not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.shape.depth_surface import (
    MODEL_TILT,
    airborne_surface,
    facing,
    fall_surface,
    model_normal,
    solid_heights,
    stream_surface,
    up_from_depth,
    weighed_up,
)
from fluidlift.shape.given_depth import SceneDepth
from fluidlift.shape.kind import level_camera
from fluidlift.types import Grid, Label, PinholeCamera, RigidTransform, UpEvidence

H, W = 72, 108
ROW, COL = np.mgrid[:H, :W]
BAND = (np.abs(ROW - 40) < 18) & (np.abs(COL - 54) < 48)
LENS = PinholeCamera.from_fov(50.0, (W, H))
SURE = np.ones((H, W), np.float32)


def view(pitch: float, roll: float = 0.0) -> PinholeCamera:
    return level_camera(LENS, UpEvidence(pitch, roll, "", 1.0))


def sloping(camera: PinholeCamera, degrees: float, heading: float = 0.0, crown: float = 0.0):
    """Depth, and displacement downstream, of a stream that falls by `degrees` towards `heading` (0: to the right)."""
    slope, turn = np.tan(np.radians(degrees)), np.radians(heading)
    ahead = np.array([np.cos(turn), np.sin(turn)])
    rays = camera.rays(camera.pixel_grid())
    depth = -1.0 / (rays[..., 2] + slope * rays[..., :2] @ ahead)
    middle = np.median(depth[BAND])
    depth = depth / middle
    if crown:
        p = rays * depth[..., None]
        across = p[..., :2] @ np.array([-ahead[1], ahead[0]])
        u = (across - np.median(across[BAND])) / np.ptp(across[BAND])
        depth = depth * (1 - crown * (1 - (2 * u) ** 2))
    points = camera.unproject(camera.pixel_grid(), depth)
    ends, _ = camera.project(points + 0.02 * np.array([*ahead, -slope]))
    return depth, (ends - camera.pixel_grid()).astype(np.float32)


def scene(depth, floor=0.003) -> SceneDepth:
    return SceneDepth(depth.astype(np.float32), None, "depth file", floor)


@pytest.mark.parametrize("degrees", [2.0, 10.0, 25.0])
@pytest.mark.parametrize("heading", [0.0, -70.0, 120.0])
def test_a_slope_that_is_sure_is_taken(degrees, heading):
    camera = view(40.0)
    depth, motion = sloping(camera, degrees, heading)
    front, evidence = stream_surface(scene(depth), camera, BAND, motion, SURE)
    # 0.3 % of depth over a stream that is about as long as it is away is half a degree
    assert evidence.degrees == pytest.approx(degrees, abs=0.8)
    error = np.abs(front.depth - depth)[BAND] / depth[BAND]
    assert np.median(error) < 0.005


def test_bumps_of_a_learned_depth_do_not_bend_level_water():
    camera = view(40.0)
    depth, motion = sloping(camera, 0.0)
    error, before = [], []
    for seed in range(6):
        field = cv2.resize(np.random.default_rng(seed).normal(size=(3, 3)), (W, H), interpolation=cv2.INTER_CUBIC)
        bent = depth * np.exp(0.04 * field / field.std())
        front, evidence = stream_surface(scene(bent, floor=0.02), camera, BAND, motion, SURE)
        assert evidence.degrees >= 0  # water does not run uphill
        for kept, found in ((error, front.depth), (before, bent)):
            scale = np.median(depth[BAND]) / np.median(found[BAND])
            kept.append(np.median(np.abs(scale * found - depth)[BAND]))
    # of the error, the part that looks like a slope along the stream stays
    assert np.mean(error) < 0.7 * np.mean(before)


def test_a_crown_is_kept_where_the_depth_is_sure_and_not_where_it_is_learned():
    camera = view(50.0)
    depth, motion = sloping(camera, 15.0, crown=0.03)
    errors = []
    for floor in (0.001, 0.03):
        front, _ = stream_surface(scene(depth, floor), camera, BAND, motion, SURE)
        inner = BAND & (np.abs(ROW - 40) < 14)
        scale = np.median(depth[inner]) / np.median(front.depth[inner])
        errors.append(np.median(np.abs(scale * front.depth - depth)[inner] / depth[inner]))
    assert errors[0] < 0.5 * errors[1]


def test_what_the_motion_says_about_the_slope_counts_where_the_depth_is_unsure():
    camera = view(40.0)
    depth, motion = sloping(camera, 8.0)
    told = ((1.0, 4.0, 0.2),)
    sure, _ = stream_surface(scene(depth, 0.0005), camera, BAND, motion, SURE, slopes=told)
    del sure
    _, unsure = stream_surface(scene(depth, 0.05), camera, BAND, motion, SURE, slopes=told)
    assert unsure.measured == pytest.approx(8.0, abs=0.2)
    assert unsure.degrees == pytest.approx(4.0, abs=0.3)


def test_a_surface_on_edge_is_not_of_this_view():
    camera = view(5.0)
    wall = 1.0 / np.maximum(camera.rays(camera.pixel_grid())[..., 1], 0.2)
    _, motion = sloping(view(40.0), 0.0)
    with pytest.raises(InputRejected, match="steep"):
        stream_surface(scene(wall), camera, BAND, motion, SURE)


@pytest.mark.parametrize(("pitch", "roll"), [(20.0, 0.0), (40.0, 4.0), (60.0, -4.0)])
def test_level_water_tells_up(pitch, roll):
    depth, motion = sloping(view(pitch, roll), 0.0)
    up, slope = up_from_depth(scene(depth), LENS, BAND, motion, SURE)
    # a level stream cannot be told from one that falls: the mean of what streams do is some degrees
    assert up.pitch == pytest.approx(pitch, abs=1.0) and up.roll == pytest.approx(roll, abs=5.0)
    assert 0 <= slope < 5.0


def normals_of(camera: PinholeCamera, seed: int = 0, waves: float = 0.2) -> np.ndarray:
    """Normals of level water with waves (radians), in the axes of the camera, of two frames."""
    up = camera.camera_from_world.rotation[:, 2]
    rippled = up + waves * np.random.default_rng(seed).normal(size=(2, H, W, 3))
    return (rippled / np.linalg.norm(rippled, axis=-1, keepdims=True)).astype(np.float16)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("pitch", "roll"), [(20.0, 0.0), (40.0, 6.0), (70.0, -4.0)])
def test_the_normals_of_level_water_tell_up(pitch, roll, sign):
    camera = view(pitch, roll)
    normals = sign * normals_of(camera)
    normals[:, :20] = np.nan  # the sky
    fluid = np.stack([BAND, BAND])
    up = facing(normals, fluid, BAND, LENS)
    off = np.degrees(np.arccos(up @ camera.camera_from_world.rotation[:, 2]))
    # a median of 6000 normals that waves of 11 degrees tilt; the steepest turn away, and are taken for their backs
    assert off < 1.5


def test_few_normals_or_such_as_point_everywhere_say_nothing():
    few = np.zeros((1, H, W), bool)
    few[0, 40, 40:60] = True
    assert facing(normals_of(view(40.0))[:1], few, BAND, LENS) is None
    random = np.random.default_rng(0).normal(size=(1, H, W, 3))
    random /= np.linalg.norm(random, axis=-1, keepdims=True)
    assert facing(random, BAND[None], BAND, LENS) is None


def test_two_answers_of_a_model_are_taken_together_and_tell_its_error_by_their_difference():
    depth, motion = sloping(view(40.0), 0.0)
    alone, error = model_normal(LENS, depth, BAND, None)
    assert error == MODEL_TILT and up_from_depth(scene(depth), LENS, BAND, motion, SURE, normal=alone)[0].pitch > 38
    other = view(60.0).camera_from_world.rotation[:, 2]  # 20 degrees away
    both, error = model_normal(LENS, depth, BAND, other)
    assert error == pytest.approx(10.0, abs=0.1)
    assert both @ alone == pytest.approx(both @ other, abs=1e-3) and np.linalg.norm(both) == pytest.approx(1.0)


def test_a_model_is_weighed_beside_what_the_clip_shows():
    model = UpEvidence(40.0, 2.0, "plane of the depth of moge", 0.8)
    vague = weighed_up(UpEvidence(20.0, 0.0, "usual view", 0.1, 18.0), model, 4.5)
    assert vague.pitch == pytest.approx(38.8, abs=0.1) and vague.error == pytest.approx(10.0)  # one of them is wrong
    sure = weighed_up(UpEvidence(43.0, 0.0, "sky", 0.9, 1.0), model, 4.5)
    assert sure.pitch == pytest.approx(42.9, abs=0.1) and sure.error == pytest.approx(1.5)
    assert "moge (5 %)" in sure.source and "sky" in sure.source
    unknown = weighed_up(UpEvidence(20.0, 0.0, "", 0.0), model, 4.5)
    assert unknown.pitch == 40.0 and unknown.error == 4.5
    assert weighed_up(UpEvidence(20.0, 1.0, "user and sky", 0.5, 6.0), model, 4.5).roll == 1.0


def test_a_fall_stands():
    camera = view(5.0)
    rays = camera.rays(camera.pixel_grid())
    depth = 1.0 / rays[..., 1]  # upright, facing the viewer
    mask = np.abs(COL - 54) < 20
    front = fall_surface(scene(depth), camera, mask)
    seen = mask & (front.depth > 0)
    assert seen.sum() > 0.9 * mask.sum()
    # it is leant back by LEAN over a height that is 0.9 of its distance: half of that each way, and finite rows
    np.testing.assert_allclose(front.depth[seen], depth[seen], rtol=0.035)
    with pytest.raises(InputRejected, match="rows"):
        fall_surface(scene(depth), camera, np.zeros((H, W), bool))


def test_a_jet_stands_where_its_depth_is():
    camera = view(5.0)
    depth = 1.0 / camera.rays(camera.pixel_grid())[..., 1]
    jet = np.abs(COL - 54) < 5
    tilted = depth * (1 + 0.2 * (ROW - 36) / H)  # its foot is farther away
    front = airborne_surface(scene(tilted), camera, jet, "pour")
    middle = (front.depth + front.half_thickness)[:, 54]
    assert middle[60] / middle[10] == pytest.approx((tilted[60, 54] / tilted[10, 54]), rel=0.03)
    assert front.height is None and (front.half_thickness[jet] > 0).mean() > 0.8


def test_banks_stand_as_high_as_they_are_seen():
    camera = PinholeCamera.looking((0.0, -3.0, 3.0), (0.0, 0.0, 0.0), 50.0, (W, H))
    rays = camera.rays(camera.pixel_grid())
    z = np.where(COL < 54, 0.0, 0.3)  # the right half is a step of 0.3 m
    depth = (z - camera.position[2]) / rays[..., 2]
    labels = np.full((H, W), Label.BACKGROUND, np.uint8)
    labels[:, 40:54] = Label.FLUID
    grid = Grid((20, 20, 10), 0.1, (-1.0, -1.0, -0.5))
    heights = solid_heights(depth, labels, camera, grid)
    assert heights.shape == (20, 20)
    np.testing.assert_allclose(heights[16:, 8:12], 0.3, atol=1e-6)
    np.testing.assert_allclose(heights[:3, 8:12], 0.0, atol=1e-6)
    assert np.isnan(heights[8, 10])  # water says nothing about the ground
    assert np.isnan(solid_heights(np.zeros((H, W)), labels, camera, grid)).all()


def test_rotating_the_world_does_not_change_the_surface():
    # the heading of the stream is found, not assumed to be along an axis of the picture
    camera = view(45.0)
    errors = [
        stream_surface(scene(sloping(camera, 12.0, h)[0]), camera, BAND, sloping(camera, 12.0, h)[1], SURE)[1].degrees
        for h in (0.0, 45.0, 90.0, 180.0)
    ]
    assert np.ptp(errors) < 1.0
    assert isinstance(camera.camera_from_world, RigidTransform)
