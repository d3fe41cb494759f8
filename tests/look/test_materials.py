"""Materials of liquids: what is asked for by name, and what is no material."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.look.materials import PRESETS, TINT_DEPTH, WATER, Material, material_named


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


def test_a_spoon_of_honey_is_gold_and_a_barrel_brown():
    honey = PRESETS["honey"]
    spoon, barrel = honey.before_white(0.01), honey.before_white(1.0)
    assert spoon[0] > 0.8 and spoon[0] > 1.1 * spoon[1] > 1.2 * spoon[2]
    np.testing.assert_allclose(barrel, honey.albedo, rtol=2e-3)  # exp(-9) of the white is left
    np.testing.assert_allclose(PRESETS["water"].before_white(0.0), 1.0)
