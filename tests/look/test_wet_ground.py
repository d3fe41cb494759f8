"""Ground under a liquid is as dark as light in a layer of it makes it."""

import numpy as np
import pytest
from level_slabs import ABSORBS, CAMERA, INDEX, drawn, floor, slab

from fluidlift.backends.mitsuba_renderer import MitsubaRenderer
from fluidlift.backends.mitsuba_scene import FinalScene
from fluidlift.look.environment import Environment
from fluidlift.look.environment_lookup import grid_directions
from fluidlift.look.ground_picture import GroundMeshes
from fluidlift.look.materials import Material
from fluidlift.look.optics import fresnel, held_inside, wet_light
from fluidlift.look.screen_space import mesh_surface
from fluidlift.look.wet_ground import standing, wetted, wetted_plain
from fluidlift.types import PinholeCamera, TriangleMesh

HONEY = Material("clear honey", INDEX, absorption=ABSORBS)


def equation(absorption: float, depth: float, albedo: float, index: float = INDEX) -> float:
    """Light that leaves a level layer on matt ground straight up, under even light of radiance 1, by adding up.

    Light enters (n^2 as bright inside, in the cone of Snell), is absorbed on its slanting way, is sent back by the
    ground in all directions, of which the surface throws a part down again: a geometric series.
    """
    cos = (np.arange(20_000) + 0.5) / 20_000
    inside = fresnel(-cos, index)
    falls = 2 * index**2 * ((1 - inside) * np.exp(-absorption * depth / cos) * cos).mean()
    again = 2 * (inside * np.exp(-2 * absorption * depth / cos) * cos).mean()
    sent = albedo * falls / (1 - albedo * again)
    r = float(fresnel(np.ones(1), index)[0])
    return r + (1 - r) * np.exp(-absorption * depth) * sent / index**2


@pytest.mark.parametrize("albedo", [0.9, 0.35, 0.15])
@pytest.mark.parametrize("depth", [0.01, 0.03])
def test_a_slab_on_matt_ground_is_as_bright_as_the_equation_says(albedo, depth):
    expected = np.array([equation(a, depth, albedo) for a in ABSORBS])
    # light comes to the ground by twelve directions here, by all in the equation: 0.3 % of even light. Dry ground
    # would be off by up to 0.4
    np.testing.assert_allclose(drawn(depth, albedo, HONEY), expected, rtol=0.01, atol=0.001)
    # without a body that throws a shadow, even light is exact: only the lens' few degrees are left
    np.testing.assert_allclose(drawn(depth, albedo, HONEY, casts=False), expected, rtol=0.01, atol=0.001)


@pytest.mark.parametrize("albedo", [0.9, 0.35])
def test_path_traced_the_slab_is_as_bright_as_the_equation_says(albedo):
    scene = FinalScene(
        slab(0.03, 0.01), HONEY, CAMERA, np.ones((16, 32, 3)), (floor(albedo),), samples=256, denoise=False, depth=40
    )
    found = MitsubaRenderer("scalar_rgb").picture(scene).mean(axis=(0, 1))
    expected = [equation(a, 0.03, albedo) for a in ABSORBS]
    # 256 paths for each of 256 pixels; the slab and its ground end a quarter of a metre away
    np.testing.assert_allclose(found, expected, atol=0.015)


def test_white_ground_under_clear_liquid_in_a_white_world_is_white():
    for index in (1.2, 1.333, 1.49):
        clear = Material("clear", index)
        assert equation(0.0, 0.1, 1.0, index) == pytest.approx(1.0, abs=1e-4)
        # the light of the dry ground has Fresnel's share straight on taken off, as `wet_light` counts on
        np.testing.assert_allclose(drawn(0.03, 1.0, clear), 1.0, atol=0.01)


def test_a_layer_holds_what_its_surface_throws_back():
    arrives, back, straight = wet_light(np.zeros(1), 1.333)
    # without absorption: the cone's share, and all else comes back
    assert back[0] == pytest.approx(held_inside(1.333), abs=1e-3)
    assert straight[0] == pytest.approx(1 - float(fresnel(np.ones(1), 1.333)[0]))
    assert arrives[0] * straight[0] == pytest.approx(1 - held_inside(1.333), abs=1e-3)
    # without a surface nothing happens; in a deep layer nothing comes back
    assert wet_light(np.ones(1), 1.0)[0][0] == pytest.approx(1.0) and wet_light(np.ones(1), 1.0)[1][0] < 1e-9
    assert wet_light(np.full(1, 50.0), 1.333)[1][0] < 1e-4


def test_ground_below_a_gap_or_beside_the_liquid_stays_dry():
    world = Environment.white()
    ground = GroundMeshes([floor(0.35)], world)
    wide = PinholeCamera.looking(np.array([0.0, -0.02, 1.2]), np.zeros(3), 34.0, (40, 40))
    lifted = TriangleMesh(slab(0.05).vertices + [0, 0, 0.3], slab(0.05).faces, np.full((8, 3), 0.5))
    for body, wet in ((slab(0.05), True), (lifted, False)):
        surface = mesh_surface(body, wide)
        behind = ground.picture(wide, None, body, material=HONEY)
        share, height = standing(surface, behind, wide)
        assert (share[20, 20] > 0.99) == wet
        assert height[20, 20] == pytest.approx(0.05, abs=2e-3)
        assert share[1, 1] == 0  # beside it
        found = wetted(behind, surface, wide, HONEY, (ground.albedo(wide), ground.depth(wide)))
        np.testing.assert_array_equal(found.image[share == 0], behind.image[share == 0])
        there = ground.albedo(wide), ground.depth(wide)
        for casts in (True, False):
            found, plain = (w(behind, surface, wide, HONEY, there, shaded=casts) for w in (wetted, wetted_plain))
            # one table, read evenly in the depth or in its root: 64 steps
            np.testing.assert_allclose(found.image, plain.image, rtol=5e-3, atol=1e-5)
        found = wetted(behind, surface, wide, HONEY, there)
        assert (found.image[20, 20, 0] < 0.6 * behind.image[20, 20, 0]) == wet


@pytest.mark.parametrize("height", [0.95, 0.64, 0.4])
@pytest.mark.parametrize("casts", [True, False])
def test_under_a_sun_the_ground_gets_what_one_bent_way_leaves(height, casts):
    """Snell, Fresnel and Beer for one direction, and the series of what the surface throws back."""
    toward = np.array([0.0, np.sqrt(1 - height**2), height])
    world = Environment(np.where((grid_directions(64) @ toward > 0.998)[..., None], 300.0, 0.0) * np.ones(3))
    ground, depth, albedo = GroundMeshes([floor(0.35)], world), 0.03, 0.35
    surface = mesh_surface(slab(depth), CAMERA)
    behind = ground.picture(CAMERA, None, slab(depth) if casts else None, material=HONEY)
    there = ground.albedo(CAMERA), ground.depth(CAMERA)
    found, plain = (w(behind, surface, CAMERA, HONEY, there, shaded=casts).image for w in (wetted, wetted_plain))
    np.testing.assert_allclose(found, plain, rtol=5e-3, atol=1e-6)  # a table's steps
    dry = ground.picture(CAMERA).image.mean(axis=(0, 1))
    inside = np.sqrt(1 - (1 - height**2) / INDEX**2)
    falls = (1 - float(fresnel(np.array([height]), INDEX)[0])) * np.exp(-np.array(ABSORBS) * depth / inside)
    again = wet_light(np.array(ABSORBS) * depth, INDEX)[1]
    expected = dry * falls / INDEX**2 / (1 - albedo * again)
    # the disc of the sun is 3.6 degrees wide, and shadow maps know nothing finer than a few thousandths of the scene.
    # Blue light is gone but for some hundredths, on ways that are bent by more than what is corrected
    np.testing.assert_allclose(found.mean(axis=(0, 1)), expected, rtol=0.03, atol=0.02 * dry[0])
