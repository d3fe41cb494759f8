"""Shade stays where it is; pattern moves."""

import numpy as np
import pytest

from fluidlift.look.appearance import SteadyShading
from fluidlift.types import Gaussians, PinholeCamera


def camera_above():
    return PinholeCamera.looking(np.array([0.0, 0.0, 2.0]), np.zeros(3), 60, (80, 40), up=(0, 1, 0))


def scene():
    """Left half in shade (0.2), right half in light (0.6), seen straight from above."""
    camera = camera_above()
    frames = np.full((6, 40, 80, 3), 51, np.uint8)
    frames[:, :, 40:] = 153
    shading = SteadyShading.of(frames, np.ones((6, 40, 80), bool), camera, width=0.005)
    assert shading is not None
    return shading, camera


def test_water_that_flows_out_of_the_shade_gets_bright():
    shading, camera = scene()
    dark, light = camera.unproject(np.array([[10.5, 20.5], [70.5, 20.5]]), np.array([2.0, 2.0]))
    moved = shading.moved(Gaussians.isotropic(light[None], 0.1, np.full((1, 3), 0.2)), dark[None])
    # 0.6 / 0.2 = 3 is more than a colour may change: twice
    assert moved.rgb[0] == pytest.approx([0.4] * 3, abs=1e-3)


def test_what_stays_keeps_its_colour():
    shading, camera = scene()
    p = camera.unproject(np.array([[10.5, 20.5], [39.5, 8.5]]), np.array([2.0, 2.0]))
    colours = np.array([[0.1, 0.3, 0.9], [0.7, 0.2, 0.4]])
    moved = shading.moved(Gaussians.isotropic(p, 0.1, colours), p)
    np.testing.assert_allclose(moved.rgb, colours, atol=1e-6)


def test_a_lane_of_foam_is_no_light():
    frames = np.full((40, 40, 80, 3), 90, np.uint8)
    t, _, x = np.indices((40, 40, 80))
    passing = ((x - t) % 10 < 4) & (x >= 40)
    frames[passing] = 250
    shading = SteadyShading.of(frames, np.ones(passing.shape, bool), camera_above(), width=0.01)
    assert shading is not None
    np.testing.assert_allclose(shading.image, 90 / 255, atol=0.01)
    assert np.abs(frames.mean(axis=0)[:, 40:].mean() - 90) > 50  # the mean would be far brighter


def test_a_bank_that_waves_leave_bare_is_no_shade():
    frames = np.full((24, 40, 80, 3), 120, np.uint8)
    wet = np.ones((24, 40, 80), bool)
    wet[::3, :10] = False
    frames[~wet] = 20
    shading = SteadyShading.of(frames, wet, camera_above(), width=0.01)
    assert shading is not None
    np.testing.assert_allclose(shading.image, 120 / 255, atol=0.01)


def test_without_fluid_there_is_no_shade():
    frames = np.full((3, 40, 80, 3), 120, np.uint8)
    assert SteadyShading.of(frames, np.zeros((3, 40, 80), bool), camera_above()) is None


def test_water_takes_the_hue_of_its_place_and_foam_stays_white():
    frames = np.full((6, 40, 80, 3), (40, 120, 120), np.uint8)
    frames[:, :, 40:] = (90, 100, 90)
    camera = camera_above()
    shading = SteadyShading.of(frames, np.ones((6, 40, 80), bool), camera, width=0.005)
    assert shading is not None
    teal, grey = camera.unproject(np.array([[10.5, 20.5], [70.5, 20.5]]), np.array([2.0, 2.0]))
    colors = np.array([[40, 120, 120], [180, 180, 180]]) / 255
    moved = shading.moved(Gaussians.isotropic(np.stack([grey, grey]), 0.1, colors), np.stack([teal, teal]))
    assert moved.rgb[0, 0] / moved.rgb[0, 1] > 1.4 * 40 / 120
    np.testing.assert_allclose(moved.rgb[1], moved.rgb[1].mean(), atol=1e-3)
