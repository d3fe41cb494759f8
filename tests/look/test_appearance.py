"""Shade stays where it is; pattern moves."""

import numpy as np
import pytest

from fluidlift.look.appearance import SteadyShading
from fluidlift.types import Gaussians, PinholeCamera


def scene():
    """Left half in shade (0.2), right half in light (0.6), seen straight from above."""
    camera = PinholeCamera.looking(np.array([0.0, 0.0, 2.0]), np.zeros(3), 60, (80, 40), up=(0, 1, 0))
    frames = np.full((6, 40, 80, 3), 51, np.uint8)
    frames[:, :, 40:] = 153
    return SteadyShading.of(frames, np.ones((40, 80), bool), camera, width=0.005), camera


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
