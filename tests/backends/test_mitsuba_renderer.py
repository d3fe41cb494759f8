"""Final frames: the same camera, axes and light as everywhere, and liquids that obey the textbook."""

import importlib.util
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fluidlift.backends import mitsuba_renderer
from fluidlift.backends.mitsuba_renderer import MitsubaRenderer, square_pixels, trial
from fluidlift.backends.mitsuba_scene import FinalScene, mean_chord, medium, resting
from fluidlift.errors import FluidliftError, MissingPackage
from fluidlift.look.environment import Environment
from fluidlift.look.environment_lookup import grid_directions
from fluidlift.look.liquid import Behind, glow, shaded
from fluidlift.look.materials import PRESETS, Material
from fluidlift.look.optics import fresnel
from fluidlift.look.screen_space import mesh_surface
from fluidlift.numerics.solid_mesh import box_mesh, ellipsoid_mesh
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.types import Grid, PinholeCamera, Terrain, TriangleMesh

needs_mitsuba = pytest.mark.skipif(
    importlib.util.find_spec("mitsuba") is None, reason="needs mitsuba: pip install 'fluidlift[mitsuba]'"
)
NOTHING = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
WHITE = np.ones((8, 16, 3), np.float32)


def tilted(size=(64, 48), focal=(60.0, 60.0), center=(22.3, 29.1)) -> PinholeCamera:
    """A camera that looks down from the side, its principal point far from the middle."""
    camera = PinholeCamera.looking(np.array([1.0, -3.0, 2.0]), np.array([0.1, 0.0, 0.3]), 50.0, size)
    return PinholeCamera(focal, center, size, camera.camera_from_world)


def ball(center, radius, color=(0.0, 0.0, 0.0)) -> TriangleMesh:
    mesh = ellipsoid_mesh((radius, radius, radius))
    vertices = np.asarray(mesh.vertices) + center
    return TriangleMesh(vertices, mesh.faces, np.tile(color, (len(vertices), 1)))


def rendered(scene: FinalScene) -> np.ndarray:
    return MitsubaRenderer("scalar_rgb").picture(scene)


@needs_mitsuba
@pytest.mark.parametrize("focal", [(60.0, 60.0), (75.0, 50.0), (48.0, 66.0)])
def test_a_point_lies_where_our_own_camera_puts_it(focal):
    camera = tilted(focal=focal)
    for point in ([0.0, 0.0, 0.0], [0.5, 0.2, 0.6], [-0.4, 0.4, 0.3]):
        scene = FinalScene(NOTHING, Material("none"), camera, WHITE, (ball(point, 0.06),), samples=64)
        dark = np.clip(1.0 - rendered(scene)[..., 0], 0.0, 1.0)
        dark[dark < 0.02] = 0.0
        found = (camera.pixel_grid() * dark[..., None]).sum((0, 1)) / dark.sum()
        # perspective moves the middle of a small ball's outline by (radius / depth)^2 of its distance from the axis,
        # 0.02 px here; the rest is the noise of 64 samples at the rim
        assert np.abs(found - camera.project(np.array(point))[0]).max() < 0.12


@needs_mitsuba
def test_an_edge_at_the_border_of_pixels_covers_them_in_full_or_not_at_all():
    # the side of a box seen straight on, its edges at u = 10 and 40, v = 8 and 20
    camera = PinholeCamera.looking(np.zeros(3), np.array([0.0, 1.0, 0.0]), 50.0, (64, 48))
    camera = PinholeCamera((50.0, 50.0), (25.0, 30.0), (64, 48), camera.camera_from_world)
    corners = camera.unproject(np.array([[10.0, 8.0], [40.0, 8.0], [40.0, 20.0], [10.0, 20.0]]), np.full(4, 2.0))
    wall = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros((4, 3)))
    scene = FinalScene(NOTHING, Material("none"), camera, WHITE, (wall,), samples=16)
    picture, alpha = MitsubaRenderer("scalar_rgb").picture_and_alpha(replace(scene, show_environment=False))
    wanted = np.zeros((48, 64))
    wanted[8:20, 10:40] = 1.0
    # a sample may fall on the other side of an edge by a rounding of float32
    assert np.abs(alpha - wanted).max() < 0.07 and picture.max() < 1e-6
    assert np.abs(rendered(scene)[..., 1] - (1 - wanted)).max() < 0.07


@needs_mitsuba
def test_the_environment_stands_where_our_own_lookup_finds_it():
    # red, green and blue grow towards +x, +y and +z
    environment = Environment(1.0 + 0.5 * grid_directions(16))
    for target in ([0.0, 1.0, 0.2], [1.0, 0.3, 0.5], [-0.4, -1.0, -0.6], [0.1, 0.05, 1.0]):
        camera = PinholeCamera.looking(np.zeros(3), np.array(target), 60.0, (32, 24))
        picture = rendered(FinalScene(NOTHING, Material("none"), camera, environment.radiance, samples=16, softness=0))
        ours = environment.toward(camera.rays(camera.pixel_grid()))
        # jitter within a pixel of 2 degrees, 0.5 * 0.035 / 2 / sqrt(16), and chords of a circle cut into 32
        assert np.abs(picture - ours).max() < 0.015


@needs_mitsuba
def test_a_texture_lies_as_it_does_in_our_own_pictures():
    texture = np.zeros((2, 2, 3), np.uint8)  # made of blocks below, so that nothing blends at their middles
    texture[0, 0], texture[0, 1], texture[1, 0], texture[1, 1] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (188, 188, 188)
    fine = np.kron(texture, np.ones((8, 8, 1), np.uint8))
    corners = np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    table = TriangleMesh(corners, faces, uv=uv[faces], texture=fine)
    camera = PinholeCamera.looking(np.array([0.0, 0.0, 3.0]), np.zeros(3), 50.0, (32, 32), up=(0.0, 1.0, 0.0))
    picture = rendered(FinalScene(NOTHING, Material("none"), camera, WHITE, (table,), samples=32))
    seen = np.array([[picture[11, 11], picture[11, 20]], [picture[20, 11], picture[20, 20]]])
    # a flat white body under white light of 1 shows its own linear colour
    assert np.abs(seen - linear_from_srgb(texture / 255.0)).max() < 0.02


@needs_mitsuba
def test_a_slab_of_liquid_takes_light_by_fresnel_and_by_its_thickness():
    # white light from everywhere: what is not absorbed comes back in full, by whatever ways
    slab = box_mesh((4.0, 0.1, 4.0))
    camera = PinholeCamera.looking(np.array([0.0, -2.0, 0.0]), np.zeros(3), 4.0, (16, 12))
    clear = FinalScene(slab, Material("clear", 1.333), camera, WHITE, samples=64)
    assert np.abs(rendered(clear).mean() - 1.0) < 1e-3
    absorber = Material("absorber", 1.333, absorption=(0.0, 5.0, 20.0))
    seen = rendered(replace(clear, material=absorber, samples=512)).mean(axis=(0, 1))
    mirrored = ((1.333 - 1) / (1.333 + 1)) ** 2
    passed = np.exp(-0.1 * np.array(absorber.absorption))
    # first mirror, then the series of the light that goes to and fro between both faces and leaves by either
    inside = (1 - mirrored) ** 2 * passed / (1 - mirrored * passed)
    # 512 samples on 192 pixels, each all or nothing: 0.5 / sqrt(98304) = 0.0016; three of them
    assert np.abs(seen - (mirrored + inside)).max() < 5e-3


@needs_mitsuba
def test_a_painted_body_is_as_bright_as_its_colour_and_a_glowing_one_as_its_glow():
    camera = PinholeCamera.looking(np.array([0.0, -3.0, 0.0]), np.zeros(3), 25.0, (24, 24))
    body = ball((0.0, 0.0, 0.0), 0.5)
    body = TriangleMesh(body.vertices, body.faces, np.tile([0.9, 0.2, 0.2], (len(body.vertices), 1)))
    paint = Material("paint", 1.0, scattering=1e4, albedo=(0.2, 0.4, 0.6))
    scene = FinalScene(body, paint, camera, WHITE, samples=64)
    assert scene.painted
    middle = np.s_[9:15, 9:15]
    assert np.abs(rendered(scene)[middle].mean((0, 1)) - (0.2, 0.4, 0.6)).max() < 0.02  # noise of 64 x 36 samples
    carried = rendered(replace(scene, material=replace(paint, carried=1.0)))[middle].mean((0, 1))
    assert np.abs(carried - linear_from_srgb(np.array([0.9, 0.2, 0.2]))).max() < 0.02
    black = replace(paint, albedo=(0.0, 0.0, 0.0), emission=(3.0, 1.0, 0.5))
    scene = replace(scene, surface=TriangleMesh(body.vertices, body.faces))  # without colours all of it is hot
    assert np.abs(rendered(replace(scene, material=black))[middle].mean((0, 1)) - (3.0, 1.0, 0.5)).max() < 1e-3


@needs_mitsuba
def test_bright_parts_of_lava_glow_more_than_dark_ones():
    camera = PinholeCamera.looking(np.array([0.0, -3.0, 0.0]), np.zeros(3), 25.0, (24, 24))
    body = ball((0.0, 0.0, 0.0), 0.5)
    bright = np.where(np.asarray(body.vertices)[:, :1] > 0, 0.8, 0.1) * np.ones(3)
    lava = TriangleMesh(body.vertices, body.faces, bright)
    seen = rendered(FinalScene(lava, PRESETS["lava"], camera, 0.01 * WHITE, samples=8))
    # a black body near 1430 K against one that is hundreds of kelvin cooler
    assert seen[9:15, 14:18, 0].mean() > 10 * seen[9:15, 6:10, 0].mean() and seen[9:15, 14:18, 0].mean() > 1.0


@needs_mitsuba
def test_lava_glows_before_a_backdrop_that_is_added_later():
    camera = PinholeCamera.looking(np.array([0.0, -3.0, 0.0]), np.zeros(3), 25.0, (24, 24))
    body = ball((0.0, 0.0, 0.0), 0.5)
    rock = TriangleMesh(body.vertices, body.faces, np.tile([0.3, 0.3, 0.3], (len(body.vertices), 1)))
    stone = ball((-0.48, 0.0, -0.48), 0.12, (0.9, 0.9, 0.9))
    scene = FinalScene(rock, PRESETS["lava"], camera, 0.01 * WHITE, (stone,), samples=8)
    middle, corner = np.s_[9:15, 9:15], np.s_[20:22, 2:4]
    shown = rendered(scene)
    picture, alpha = MitsubaRenderer("scalar_rgb").picture_and_alpha(replace(scene, show_environment=False))
    hot = np.array(PRESETS["lava"].emission) * glow(np.full((1, 3), 0.1), 0.1)[0]
    # rock in light of 0.01 returns and mirrors less than that
    assert (np.abs(shown[middle].mean((0, 1)) - hot) < 0.01).all() and hot[0] > 0.2
    # the same light: of the emitters that are hidden from the camera the liquid must be none
    np.testing.assert_allclose(picture[middle].mean((0, 1)), shown[middle].mean((0, 1)), rtol=0.02)
    assert alpha[middle].min() == 1.0 and alpha[0, 0] == 0.0 and picture[0, 0].max() == 0.0
    assert alpha[corner].min() == 1.0 and picture[corner].min() > 0.0  # what does not glow covers as well
    np.testing.assert_allclose(picture[corner].mean((0, 1)), shown[corner].mean((0, 1)), rtol=0.02)


@needs_mitsuba
def test_every_preset_makes_a_picture_and_a_seed_makes_it_again():
    camera = PinholeCamera.looking(np.array([0.0, -3.0, 1.0]), np.zeros(3), 30.0, (12, 10))
    table = box_mesh((2.0, 2.0, 0.1))
    table = TriangleMesh(np.asarray(table.vertices) - (0.0, 0.0, 0.3), table.faces)
    for material in PRESETS.values():
        scene = FinalScene(ball((0, 0, 0), 0.3), material, camera, WHITE, (table,), samples=4)
        first = rendered(scene)
        assert first.shape == (10, 12, 3) and first.dtype == np.float32 and np.isfinite(first).all()
        assert np.array_equal(first, rendered(scene))
    assert not np.array_equal(first, rendered(replace(scene, seed=1)))


@pytest.fixture(scope="module")
def optics():
    """The comparison of `benchmarks/optics_against_mitsuba.py`, which has no package."""
    path = Path(__file__).parents[2] / "benchmarks" / "optics_against_mitsuba.py"
    spec = importlib.util.spec_from_file_location("optics_against_mitsuba", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@needs_mitsuba
@pytest.mark.parametrize("name", ["slab", "ball"])
def test_quick_liquids_bend_and_absorb_light_as_traced_paths_do(optics, name):
    found, pictures = optics.compared(getattr(optics, name)(), 64, 16)
    moved, plain = found["mitsuba"]["moved"], found["none"]
    for way in ("mesh", "splats"):
        assert pictures[way].shape == pictures["mitsuba"].shape
        mine = found[way]
        # a pixel, and the grain of 16 paths: the far side is met where the bent line ends
        assert mine["bent"] < 0.12 * moved
        # 10 %: outlines of a pixel or two in a body of twenty, and 4 % mirrored inside that are not followed
        assert mine["light"] == pytest.approx(1.0, abs=0.1)
        # what is left at this size are the rims, and the grain of 16 paths
        assert mine["difference"] < 0.65 * plain["difference"]


def test_a_medium_takes_and_scatters_what_the_material_says():
    color = (0.0, 0.5, 1.0)
    extinction, share = medium(Material("m", absorption=(1.0, 3.0, 9.0), scattering=3.0, albedo=color), np.ones(3))
    assert extinction.tolist() == [4.0, 6.0, 12.0]
    assert share[0] == pytest.approx(0.0, abs=1e-9) and share[2] == pytest.approx(1.0) and 0.8 < share[1] < 1.0
    assert medium(Material("tea", absorption=(1.0, 3.0, 9.0)), np.ones(3))[1].tolist() == [0.0, 0.0, 0.0]
    assert medium(Material("clear"), np.ones(3)) is None
    for name in ("honey", "oil"):
        extinction, share = medium(PRESETS[name], np.ones(3))
        # their albedo is rounded to a unit of its last digit: 6 % of the blue of honey, 13 % of that of oil
        np.testing.assert_allclose(extinction * share, PRESETS[name].scattering, rtol=0.13)


@needs_mitsuba
@pytest.mark.parametrize(("depth", "allowed"), [(0.01, 0.06), (0.03, 0.1), (0.5, 0.015)])
def test_a_layer_of_honey_is_as_bright_as_in_the_quick_picture(depth, allowed):
    """Under white light from everywhere, from in front. A body so deep that nothing comes through shows its albedo: the
    quick picture by definition, the medium by thousands of collisions. Of a thinner one the quick picture lacks what is
    scattered forward: up to 0.08 of the red."""
    layer = box_mesh((4.0, depth, 4.0))
    corner = np.asarray(layer.faces).ravel()
    layer = TriangleMesh(np.asarray(layer.vertices)[corner], np.arange(len(corner)).reshape(-1, 3))
    camera = PinholeCamera.looking(np.array([0.0, -2.0, 0.0]), np.zeros(3), 4.0, (16, 12))
    scene = FinalScene(layer, PRESETS["honey"], camera, WHITE, samples=128, depth=24, denoise=False)
    traced = rendered(scene).mean(axis=(0, 1))
    behind = Behind(np.ones((12, 16, 3)), np.zeros((12, 16)))
    quick = shaded(mesh_surface(layer, camera), behind, camera, PRESETS["honey"], Environment(WHITE)).mean(axis=(0, 1))
    # the grain of all-or-nothing paths is 0.5 / sqrt(128 * 192) = 0.003
    assert np.abs(traced - quick).max() < allowed
    if depth == 0.5:
        mirrored = float(fresnel(np.ones(1), 1.49)[0])
        # van de Hulst's fit is for all directions in the mean; seen straight on a body is a tenth off
        expected = mirrored + (1 - mirrored) * np.array(PRESETS["honey"].albedo)
        assert np.abs(traced - expected).max() < 0.015


def test_the_mean_chord_of_a_ball_is_four_thirds_of_its_radius():
    assert mean_chord(ball((5.0, 0.0, 0.0), 0.3)) == pytest.approx(0.4, rel=0.02)  # of a polyhedron
    assert mean_chord(NOTHING) == 0.0
    milk = FinalScene(ball((0, 0, 0), 0.3), PRESETS["milk"], tilted(), WHITE)
    assert milk.painted and not replace(milk, opaque=False).painted
    assert not replace(milk, material=PRESETS["water"]).painted


def test_pixels_that_are_not_square_are_made_of_square_ones():
    camera = tilted(focal=(75.0, 50.0))
    drawn, across, down = square_pixels(camera)
    assert drawn.focal == (75.0, 75.0) and across.shape[0] == 64 and down.shape[0] == 48
    # a picture of v keeps it: the middle of a pixel is the mean of what makes it up
    v = down @ (np.arange(drawn.size[1]) + 0.5)
    assert np.abs(v / 1.5 - (np.arange(48) + 0.5)).max() < 0.35  # the last one lies half outside
    assert np.abs(v[:-1] / 1.5 - (np.arange(47) + 0.5)).max() < 0.12  # parts of pixels count with their middle
    assert square_pixels(tilted())[1] is None


def test_wrong_scenes_and_variants_are_told():
    with pytest.raises(ValueError, match="variant 'gpu'"):
        MitsubaRenderer("gpu")
    for wrong in (
        {"environment": np.ones((4, 4, 3))},
        {"environment": -WHITE},
        {"samples": 0},
        {"depth": 1},
        {"softness": 2},
    ):
        with pytest.raises(ValueError):
            FinalScene(
                **({"surface": NOTHING, "material": Material("m"), "camera": tilted(), "environment": WHITE} | wrong)
            )
    with pytest.raises(ValueError, match="not finite"):
        FinalScene(TriangleMesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]])), Material("m"), tilted(), WHITE)


def test_a_missing_package_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(MissingPackage, match=r"pip install 'fluidlift\[mitsuba\]'"):
        MitsubaRenderer()


def test_a_variant_that_would_end_the_process_is_tried_in_another_one(monkeypatch):
    ran = subprocess.CompletedProcess([], -6, "", "In function: f\nLLVM ERROR: Cannot select: fminimum\n")
    monkeypatch.setattr(mitsuba_renderer.subprocess, "run", lambda *a, **k: ran)
    monkeypatch.setitem(sys.modules, "mitsuba", object())
    trial.cache_clear()
    try:
        assert MitsubaRenderer("auto").variant == "scalar_rgb"
        with pytest.raises(FluidliftError, match="Cannot select"):
            MitsubaRenderer("llvm_ad_rgb")
        ran.returncode = 0
        trial.cache_clear()
        assert MitsubaRenderer("auto").variant == "llvm_ad_rgb"
    finally:
        trial.cache_clear()


def test_the_underside_of_a_liquid_reaches_into_the_bed_that_it_nearly_touches():
    """A gap of a part of a cell would be a film of air; a drop that hangs above the bed stays as it is."""
    grid = Grid((20, 20, 20), 0.1, (0.0, 0.0, 0.0))
    height = np.arange(21) * 0.1 - 0.5
    terrain = Terrain(
        grid, np.broadcast_to(height, (21, 21, 21)).astype(np.float32), np.float32([1, 0, 0]),
        TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64)),
    )  # fmt: skip
    for gap, sunk in ((0.04, True), (0.5, False)):
        box = box_mesh(np.array([0.6, 0.6, 0.4]))
        standing = TriangleMesh(np.asarray(box.vertices, np.float32) + [1.0, 1.0, 0.7 + gap], box.faces)
        moved = resting(standing, terrain)
        low, top = moved.vertices[:, 2].min(), moved.vertices[:, 2].max()
        assert (low < 0.5) == sunk
        assert top == pytest.approx(0.9 + gap, abs=1e-6)
