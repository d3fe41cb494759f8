"""Materials of liquids: what is asked for by name, and what is no material."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.look.environment import Environment
from fluidlift.look.liquid import Behind, LiquidSurface, shaded
from fluidlift.look.materials import PRESETS, TINT_DEPTH, WATER, Material, material_named
from fluidlift.numerics.srgb import srgb_from_linear
from fluidlift.types import PinholeCamera


def test_every_preset_is_found_by_its_name_however_it_is_written():
    assert {"water", "muddy_water", "honey", "lava", "milk", "oil", "chocolate", "source"} <= set(PRESETS)
    for name, material in PRESETS.items():
        assert material_named(name) is material and material.name == name
    assert material_named(" Muddy Water ") is PRESETS["muddy_water"]


def test_an_unknown_name_is_rejected_with_the_nearest_one():
    with pytest.raises(InputRejected, match="did you mean honey"):
        material_named("hony")
    with pytest.raises(InputRejected, match="muddy_water"):  # all names are told
        material_named("xyzzy")


@pytest.mark.parametrize(
    "wrong",
    [
        {"refractive_index": 0.9}, {"absorption": (-1.0, 0, 0)}, {"absorption": (0.0, np.nan, 0.0)},
        {"scattering": -1.0}, {"albedo": (1.2, 0, 0)}, {"roughness": 1.5}, {"carried": -0.1}, {"emission": (1.0, 2.0)},
    ],
)  # fmt: skip
def test_what_no_material_can_be_is_refused(wrong):
    with pytest.raises(ValueError, match="material 'x'"):
        Material("x", **wrong)


def test_water_takes_red_first_and_honey_takes_blue_first():
    assert WATER.absorption[0] > WATER.absorption[1] > WATER.absorption[2] > 0
    honey = PRESETS["honey"].absorption
    assert honey[2] > honey[1] > honey[0]


def test_a_tint_is_taken_on_by_white_light_after_the_depth_that_is_said():
    tint = np.array([0.9, 0.5, 0.25])
    dyed = WATER.tinted(tuple(tint))
    left = np.exp(-(np.array(dyed.absorption) - WATER.absorption) * TINT_DEPTH)
    np.testing.assert_allclose(left, tint, rtol=1e-12)
    np.testing.assert_allclose(dyed.albedo, tint * WATER.albedo)
    assert WATER.tinted((1.0, 1.0, 1.0)) == WATER
    assert np.isfinite(WATER.tinted((0.0, 1.0, 1.0)).absorption).all()
    with pytest.raises(ValueError, match="tint"):
        WATER.tinted((2.0, 0.0, 0.0))


def test_a_spoon_of_honey_is_pale_gold_and_a_barrel_deep_gold():
    honey = PRESETS["honey"]
    spoon, barrel = honey.before_white(0.01), honey.before_white(1.0)
    assert spoon[0] > 0.8 and spoon[0] > spoon[1] > 1.3 * spoon[2]
    assert barrel[0] > 1.5 * barrel[1] > 7.0 * barrel[2] and barrel[0] < 0.4 * spoon[0]
    np.testing.assert_allclose(barrel, honey.albedo, rtol=2e-3)  # exp(-9) of the white is left
    np.testing.assert_allclose(PRESETS["water"].before_white(0.0), 1.0)


def test_a_stream_of_honey_is_gold_under_the_sky():
    # twelve centimetres of it on a brown bed, looked at from 45 degrees
    n, camera = 40, PinholeCamera.looking(np.array([0.0, -2.0, 2.0]), np.zeros(3), 20.0, (40, 40))
    rays = camera.rays(camera.pixel_grid())
    z = -camera.position[2] / rays[..., 2]
    deeper = (-0.12 - camera.position[2]) / rays[..., 2]
    up = np.broadcast_to(np.float32([0, 0, 1]), (n, n, 3))
    thick = (deeper - z) * np.linalg.norm(rays, axis=-1)
    surface = LiquidSurface(z, up, thick, np.full((n, n, 3), 0.3), np.ones((n, n)))
    bed = Behind(np.broadcast_to(np.float32([0.06, 0.04, 0.025]), (n, n, 3)), deeper)
    seen = shaded(surface, bed, camera, PRESETS["honey"], Environment.sky())[10:30, 10:30].mean(axis=(0, 1))
    red, green, blue = srgb_from_linear(np.clip(seen, 0.0, 1.0))
    assert red > green > blue
    hue = 60.0 * (green - blue) / (red - blue)
    assert 25.0 < hue < 50.0, hue
    assert (red - blue) / red > 0.3  # no caramel
