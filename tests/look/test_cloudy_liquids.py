"""A cloudy liquid before its ground: two fluxes of light, against adding up layers, traced paths and plain twins."""

import numpy as np
import pytest
from level_slabs import ABSORBS, CAMERA, INDEX, drawn, floor, slab

from fluidlift.backends.mitsuba_renderer import MitsubaRenderer
from fluidlift.backends.mitsuba_scene import FinalScene
from fluidlift.look.environment import Environment
from fluidlift.look.liquid import Behind, SurfaceBuffer, shaded, shaded_plain
from fluidlift.look.materials import HONEY, LAVA, PRESETS, WATER, Material
from fluidlift.look.optics import deep_color, fresnel, held_inside, passed, two_fluxes
from fluidlift.types import PinholeCamera

WHITE = Environment.white()


def cloudy(scattering: float) -> Material:
    color = deep_color(ABSORBS, scattering, INDEX)
    return Material("cloudy", INDEX, absorption=ABSORBS, scattering=scattering, albedo=tuple(color))


def shown_of_cloud(fade, cloud, inside, depth):
    """How much of the colour of a deep body (`deep_color`) `depth` metres of it have before black, 0 to 1.

    Of two fluxes R_d / R = (1 - e^2) / (1 - R^2 e^2) with e = exp(-fade depth) returns; the surface throws a share
    `inside` of that back, again and again. Arguments as of `passed`.
    """
    left = np.exp(-2.0 * fade * depth)
    part = (1.0 - left) / np.maximum(1.0 - cloud * cloud * left, 1e-30)
    return part * (1.0 - inside * cloud) / (1.0 - inside * cloud * part)


def test_two_layers_on_each_other_are_one_of_their_depth():
    fade, cloud = two_fluxes(np.array([40.0, 60.0, 300.0]), np.array([0.3, 0.1, 0.8]))

    def layer(depth):  # without a surface
        return passed(fade, cloud, 0.0, depth), cloud * shown_of_cloud(fade, cloud, 0.0, depth)

    (t, r), (through, back) = layer(0.02), layer(0.04)
    np.testing.assert_allclose(through, t * t / (1 - r * r), rtol=1e-9)
    np.testing.assert_allclose(back, r + t * t * r / (1 - r * r), rtol=1e-9)
    assert (t + r < 1).all()  # the rest is absorbed


def test_light_that_is_scattered_forward_is_not_lost_and_without_a_cloud_beer_and_lambert_hold():
    honey = cloudy(30.0)
    fade, cloud = honey.fluxes
    absorbed, extinction = np.array(ABSORBS), np.array(ABSORBS) + 30.0
    assert (fade > absorbed).all() and (fade < extinction).all() and (cloud > 0).all()
    clear = Material("clear", INDEX, absorption=ABSORBS)
    np.testing.assert_allclose(passed(*clear.fluxes, held_inside(INDEX), 0.05), np.exp(-0.05 * absorbed), rtol=1e-12)
    # nothing absorbs: what does not come back goes through
    fade, cloud = two_fluxes(np.array([100.0]), np.array([1.0]))
    through, back = passed(fade, cloud, 0.0, 0.03), cloud * shown_of_cloud(fade, cloud, 0.0, 0.03)
    np.testing.assert_allclose(through + back, 1.0, atol=1e-4)
    # of isotropic scattering about 0.375 (3/8, diffusion) of the scatterings along a path turn light back
    np.testing.assert_allclose(through, 1 / (1 + 0.375 * 3.0), rtol=0.05)


def test_clear_glowing_and_painted_liquids_take_light_as_they_did():
    for material in (WATER, LAVA, PRESETS["source"]):
        fade, cloud = material.fluxes
        np.testing.assert_array_equal(fade, np.array(material.absorption) + material.scattering)
        assert not cloud.any()


@pytest.mark.parametrize("scattering", [6.0, 30.0])
@pytest.mark.parametrize("albedo", [0.8, 0.3])
@pytest.mark.parametrize("depth", [0.01, 0.06])
def test_a_cloudy_slab_on_matt_ground_is_as_bright_as_path_traced(scattering, albedo, depth):
    material = cloudy(scattering)
    scene = FinalScene(
        slab(depth, 0.01), material, CAMERA, np.ones((16, 32, 3)), (floor(albedo),), samples=64, denoise=False, depth=64
    )
    traced = MitsubaRenderer("scalar_rgb").picture(scene).mean(axis=(0, 1))
    # 64 paths for each of 256 pixels: 0.004. With all scattered light lost the slab was up to 0.25 too dark
    np.testing.assert_allclose(drawn(depth, albedo, material), traced, atol=0.055)


@pytest.mark.parametrize("depth", [0.05, 0.1, 0.3, 1.0])
def test_deep_honey_is_never_darker_than_its_cloud_and_is_amber(depth):
    mirrored = float(fresnel(np.ones(1), INDEX)[0])

    def body(albedo):  # without the mirror of its surface
        return (drawn(depth, albedo, HONEY) - mirrored) / (1.0 - mirrored)

    share = shown_of_cloud(*HONEY.fluxes, held_inside(INDEX), depth)
    np.testing.assert_allclose(body(0.0), share * np.array(HONEY.albedo), atol=0.003)
    over_steel, over_white = body(0.3), body(0.8)
    assert (over_white >= over_steel).all() and (over_white > 0.98 * np.array(HONEY.albedo)).all()
    if depth >= 1.0:
        assert (body(0.0) > 0.98 * np.array(HONEY.albedo)).all()
    # gold to amber: red before green before blue, and brighter than what 4 % of a sky add
    assert over_steel[0] > 2 * over_steel[1] > 4 * over_steel[2] and over_steel[0] > 0.14


def checked(material: Material) -> tuple[np.ndarray, np.ndarray]:
    """3 cm of liquid before ground in stripes of two pixels, a centimetre; and its twin."""
    camera = PinholeCamera.looking(np.array([0.0, 0.0, 1.0]), np.zeros(3), 20.0, (64, 64))
    flat = np.full((64, 64), 0.97, np.float32)
    up = np.zeros((64, 64, 3), np.float32) + np.float32([0, 0, 1])
    surface = SurfaceBuffer(flat, up, np.full((64, 64), 0.03), np.full((64, 64, 3), 0.5), np.ones((64, 64)), -up)
    stripes = np.where(np.arange(64) // 2 % 2, 0.8, 0.2)
    ground = Behind(np.broadcast_to(stripes[None, :, None], (64, 64, 3)), np.ones((64, 64)))
    return tuple(f(surface, ground, camera, material, WHITE) for f in (shaded, shaded_plain))


def test_through_a_cloud_a_picture_loses_its_sharpness_before_its_light():
    found, plain = checked(cloudy(30.0))
    np.testing.assert_allclose(found, plain, atol=2e-5)
    row = found[32, 16:48]
    contrast = (row.max(axis=0) - row.min(axis=0)) / 0.6
    straight = (1 - float(fresnel(np.ones(1), INDEX)[0])) * np.exp(-(np.array(ABSORBS) + 30.0) * 0.03)
    np.testing.assert_allclose(contrast, straight, atol=0.01)
    fade, cloud = cloudy(30.0).fluxes
    assert passed(fade, cloud, held_inside(INDEX), 0.03)[0] > 2 * straight[0]
