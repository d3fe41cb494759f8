"""A liquid's light: energy, Snell's offset and Beer's law of a slab, what lies before and what lies behind."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from fluidlift.look.environment import Environment
from fluidlift.look.liquid import (
    COOL,
    HOT,
    WARM,
    Behind,
    SurfaceBuffer,
    film_shown,
    followed,
    glow,
    shaded,
    shaded_plain,
)
from fluidlift.look.liquid_lookup import borders, fetch_beyond, hides, pyramid, seen_beside
from fluidlift.look.materials import PRESETS, Material
from fluidlift.look.optics import fresnel, refract
from fluidlift.look.screen_space import mesh_surface
from fluidlift.look.transparent_rays import fanned
from fluidlift.types import PinholeCamera, TriangleMesh

SIZE = (80, 60)
CAMERA = PinholeCamera.looking((0.0, -2.0, 3.0), (0.0, 0.0, 0.0), 40.0, SIZE)
WHITE = Environment.white()
CLEAR = Material("clear", 1.333)


def level(height):
    """Camera z (m) of the level plane at a height, everywhere before the camera here."""
    rays = CAMERA.rays(CAMERA.pixel_grid())
    return (height - CAMERA.position[2]) / rays[..., 2]


def slab(top=0.3, thick=0.25, **more):
    """A level layer of liquid that fills the picture."""
    rays = CAMERA.rays(CAMERA.pixel_grid())
    along = thick * np.linalg.norm(rays, axis=-1) / -rays[..., 2]
    shape = SIZE[::-1]
    normal = np.broadcast_to([0.0, 0.0, 1.0], (*shape, 3))
    return SurfaceBuffer(level(top), normal, along, np.full((*shape, 3), 0.5), np.ones(shape), **more)


def every_pixel():
    return np.stack(np.nonzero(np.ones(SIZE[::-1], bool)), axis=-1)


def snell(top, thick, floor):
    """Points of the floor that are seen through the slab, and the cosine in the liquid."""
    rays = CAMERA.rays(CAMERA.pixel_grid()).reshape(-1, 3)
    entry = CAMERA.position + rays * level(top).reshape(-1, 1)
    d = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    t, _ = refract(d, np.broadcast_to([0.0, 0.0, 1.0], d.shape), 1 / 1.333)
    leave = entry + t * (thick / -t[:, 2:])
    return leave + d * ((leave[:, 2:] - floor) / -d[:, 2:]), -t[:, 2]


@pytest.mark.parametrize("floor", [0.05, -0.6])  # the slab lies on it, and floats above it
def test_through_a_slab_one_sees_the_point_that_snells_law_says(floor):
    z = level(floor)
    points = CAMERA.unproject(CAMERA.pixel_grid(), z)
    behind = Behind(points + 10.0, z)  # its colours are places
    seen = followed(slab(), behind, CAMERA, every_pixel(), 1.333).color - 10.0
    expected, _ = snell(0.3, 0.25, floor)
    got, _ = CAMERA.project(seen)
    wanted, _ = CAMERA.project(expected)
    inside = ((wanted > 1) & (wanted < np.array(SIZE) - 1)).all(axis=1)
    straight = CAMERA.pixel_grid().reshape(-1, 2)
    assert np.abs(wanted - straight)[inside].max() > 1.5  # px: there is something to see
    # places are not quite linear between pixels, and the depth behind is looked up in whole pixels
    assert np.abs(got - wanted)[inside].max() < 0.1


def test_a_slab_absorbs_by_the_way_of_the_bent_ray():
    z = level(-0.6)
    behind = Behind(np.ones((*SIZE[::-1], 3)), z)
    a = np.array([0.5, 2.0, 8.0])
    picture = shaded(slab(), behind, CAMERA, Material("dye", 1.333, absorption=tuple(a)), WHITE)
    _, cos = snell(0.3, 0.25, -0.6)
    rays = CAMERA.rays(CAMERA.pixel_grid()).reshape(-1, 3)
    mirrored = fresnel(-rays[:, 2] / np.linalg.norm(rays, axis=1), 1.333)[:, None]
    expected = mirrored + (1 - mirrored) * np.exp(-a * 0.25 / cos[:, None])
    np.testing.assert_allclose(picture.reshape(-1, 3), expected, atol=3e-6)  # float32


@pytest.mark.parametrize("index", [1.0, 1.333, 1.5, 2.4])
def test_a_clear_body_of_any_shape_in_a_white_world_is_white(index):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.6)
    ball.vertices *= [1.5, 0.7, 1.0]
    surface = mesh_surface(TriangleMesh(np.array(ball.vertices), np.array(ball.faces)), CAMERA)
    behind = Behind(np.ones((*SIZE[::-1], 3)), np.zeros(SIZE[::-1]))
    picture = shaded(surface, behind, CAMERA, Material("glass", index), WHITE)
    np.testing.assert_allclose(picture, 1.0, atol=2e-5)  # float32, through the environment's filters
    cloudy = Material("white", index, scattering=3.0, albedo=(1.0, 1.0, 1.0), roughness=0.3)
    np.testing.assert_allclose(shaded(surface, behind, CAMERA, cloudy, WHITE), 1.0, atol=2e-5)


def test_no_preset_gives_more_light_than_it_gets_unless_it_glows():
    behind = Behind(np.ones((*SIZE[::-1], 3)), level(-0.6))
    for material in PRESETS.values():
        picture = shaded(slab(), behind, CAMERA, material, WHITE)
        assert np.isfinite(picture).all() and picture.min() >= 0
        if max(material.emission) == 0:
            assert picture.max() <= 1.0 + 2e-5  # float32, through the environment's filters
        else:
            cold = shaded(slab(), behind, CAMERA, replace(material, emission=(0.0, 0.0, 0.0)), WHITE)
            assert (picture[..., 0] > cold[..., 0] + 0.1).all()


def test_a_deep_turbid_body_shows_its_albedo_and_a_carrying_one_the_splats_colour():
    behind = Behind(np.zeros((*SIZE[::-1], 3)), level(-0.6))
    for carried, expected in ((0.0, (0.2, 0.4, 0.6)), (1.0, (0.5, 0.5, 0.5)), (0.5, (0.35, 0.45, 0.55))):
        material = Material("paint", 1.0, scattering=1e4, albedo=(0.2, 0.4, 0.6), carried=carried)
        picture = shaded(slab(), behind, CAMERA, material, WHITE)  # index 1: nothing is mirrored
        np.testing.assert_allclose(picture, np.broadcast_to(expected, picture.shape), atol=1e-5)


def test_what_lies_before_the_liquid_hides_it_and_is_never_seen_through_it():
    z, image = level(-0.6), np.full((*SIZE[::-1], 3), 0.25)
    post = np.zeros(SIZE[::-1], bool)
    post[:, 36:44] = True
    image[post] = [9.0, 0.0, 0.0]
    z = np.where(post, 0.5 * level(0.3), z)
    picture = shaded(slab(), Behind(image, z), CAMERA, CLEAR, WHITE)
    np.testing.assert_array_equal(picture[post], image[post].astype(np.float32))
    assert picture[~post].max() <= 1.0
    # but what stands behind it is
    z = np.where(post, level(0.0), level(-0.6))
    through = shaded(slab(), Behind(image, z), CAMERA, CLEAR, WHITE)
    assert through[30, 40, 0] > 8.0


def test_what_a_rock_hides_is_taken_from_beside_its_outline():
    depth = np.full((20, 40), 3.0, np.float32)
    depth[:, 10:14], depth[:, 20:] = 1.0, 1.0  # two rocks before water at 2
    water = np.where(depth > 2.0, 2.0, 0.0).astype(np.float32)

    def looked(start, end, rests=False, coarse=1.0):
        return seen_beside((start, 5.5), (end, 5.5), depth, 2.0, 2.5, water, rests, coarse)

    assert looked(17.5, 30.0) == (19.5, 5.5)  # the last pixel that is seen on the way there
    assert looked(15.5, 30.0, coarse=2.0) == (17.5, 5.5)  # two of the former pixels off, and not beyond the start
    assert looked(17.5, 30.0, coarse=9.0) == (17.5, 5.5)
    assert looked(3.5, 30.0) == (9.5, 5.5)  # before the first rock, not between the two
    assert hides(depth, water, False, 5, 30, 2.0) and not hides(depth, water, False, 5, 17, 2.0)
    assert borders(depth, 5, 9, 9.8, 5.5, 2.0) and not borders(depth, 5, 9, 9.2, 5.5, 2.0)
    depth[:, 20:] = 2.5  # a shore that lies deeper than this water's surface, and is dry
    assert not hides(depth, water, False, 5, 30, 2.0)  # through the air below a jet it is seen
    assert hides(depth, water, True, 5, 30, 2.0)  # under water that rests on its bed it is not
    assert looked(17.5, 30.0, rests=True) == (19.5, 5.5)


def test_behind_a_rock_one_sees_no_band_of_another_place():
    width, height = SIZE
    bright = np.broadcast_to(
        np.linspace(1.0, 0.0, height)[:, None, None], (height, width, 3)
    )  # the farther the brighter
    rock = np.zeros((height, width), bool)
    rock[height // 2 :] = True  # hides the near half of the bed
    image, z = np.where(rock[..., None], 9.0, bright), np.where(rock, 0.5 * level(0.3), level(-0.6))
    picture = shaded(slab(), Behind(image, z), CAMERA, CLEAR, WHITE)
    column = picture[: height // 2, width // 2, 0]
    # light is bent towards the viewer, and close to the outline comes from what the rock hides
    assert column.max() <= 1.0 + 1e-5
    assert (np.diff(column) < 1e-6).all()  # a step back to a farther place would be brighter


def test_the_blurred_rim_of_a_rock_in_an_enlarged_picture_is_not_drawn_out():
    width, height = SIZE
    rock = np.arange(height)[:, None] * np.ones(width) >= height // 2
    image, z = (
        np.where(rock[..., None], 1.0, np.zeros((height, width, 3))),
        np.where(rock, 0.5 * level(0.3), level(-0.6)),
    )
    image[height // 2 - 2 : height // 2] = np.array([0.3, 0.6])[:, None, None]  # two of the former pixels

    def seen(image, coarse):
        return shaded(slab(), Behind(image, z, coarse=coarse), CAMERA, CLEAR, WHITE)[: height // 2 - 2, width // 2, 0]

    assert (seen(image, 1.0) - seen(0.0 * image, 1.0)).max() > 0.2
    assert (seen(image, 2.0) - seen(0.0 * image, 2.0)).max() < 0.1  # half a pixel over, as every look-up


def test_the_ground_cuts_the_thickness_off():
    # the layer reaches below the floor: light meets the floor first
    behind = Behind(np.ones((*SIZE[::-1], 3)), level(0.2))
    deep, cut = (followed(slab(thick=t), behind, CAMERA, every_pixel(), 1.0).path for t in (0.5, 0.1))
    np.testing.assert_allclose(deep, cut, rtol=1e-5)


def test_a_share_of_a_pixel_gets_a_share_of_the_liquids_light():
    surface = slab()
    part = SurfaceBuffer(surface.depth, surface.normal, surface.thickness, surface.albedo, 0.25 * surface.covered)
    behind = Behind(np.zeros((*SIZE[::-1], 3)), level(-0.6))
    whole = shaded(surface, behind, CAMERA, PRESETS["milk"], WHITE)
    np.testing.assert_allclose(shaded(part, behind, CAMERA, PRESETS["milk"], WHITE), 0.25 * whole, rtol=1e-5)


def test_normals_that_turn_within_a_pixel_are_as_rough_as_they_are():
    surface = slab()
    tilt = 0.05 * np.arange(SIZE[0]) * np.ones((SIZE[1], 1))
    bent = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=-1)
    curved = SurfaceBuffer(surface.depth, bent, surface.thickness, surface.albedo, surface.covered)
    behind = Behind(np.zeros((*SIZE[::-1], 3)), level(-0.6))
    assert followed(surface, behind, CAMERA, every_pixel(), 1.3).spread.max() < 1e-3
    spread = followed(curved, behind, CAMERA, every_pixel(), 1.3).spread.reshape(SIZE[::-1])
    # half the step of the normal, of the mean square over four neighbours of which two step
    np.testing.assert_allclose(spread[1:-1, 1:-1], 0.5 * 0.05 / np.sqrt(2), rtol=1e-2)


def test_bright_lava_is_hotter_and_dull_lava_redder():
    shine = glow(np.array([[0.0, 0, 0], [0.1, 0.1, 0.1], [0.9, 0.9, 0.9]]), 0.1)
    np.testing.assert_allclose(shine[2], 1.0, rtol=1e-5)  # nine times the usual luminance: all but melted
    warm = COOL + (HOT - COOL) * WARM
    np.testing.assert_allclose(shine[1, 0], np.exp(0.014388 / 611e-9 * (1 / HOT - 1 / warm)), rtol=1e-5)
    assert (np.diff(shine, axis=0) > 0).all()
    assert shine[0, 1] / shine[0, 0] < shine[1, 1] / shine[1, 0] < 1.0
    wien = np.exp(0.014388 / 611e-9 * (1 / HOT - 1 / COOL))
    np.testing.assert_allclose(shine[0, 0], wien, rtol=1e-5)
    # of a clip that is darker as a whole, the same: what counts is the contrast
    np.testing.assert_allclose(glow(np.full((1, 3), 0.02), 0.02), glow(np.full((1, 3), 0.5), 0.5), rtol=1e-5)


def test_total_reflection_at_the_far_side_sets_in_without_a_step():
    # a layer whose far side is tilted more and more from left to right, until no light leaves through it
    tilt = np.linspace(0.0, 1.4, SIZE[0]) * np.ones((SIZE[1], 1))
    back = np.stack([np.sin(tilt), 0 * tilt, -np.cos(tilt)], axis=-1)
    behind = Behind(np.zeros((*SIZE[::-1], 3)), np.zeros(SIZE[::-1]))  # far away: nothing lies at the far side
    rays = followed(slab(back_normal=back), behind, CAMERA, every_pixel(), 1.333)
    turned = rays.turned.reshape(SIZE[::-1])[30]
    assert turned[0] < 0.03 and turned.max() > 0.99
    # Fresnel's rise is steep at the end: from pixel to pixel of 1 degree it never jumps by more than half
    assert 0.1 < np.diff(turned).max() < 0.5
    # and where the ray would run along in the far side, it goes on through without a step too
    assert np.abs(np.diff(turned)).max() < 0.5


def test_light_is_taken_to_fan_out_as_far_as_the_normals_of_a_pixel_turn_it():
    rng, index, turn = np.random.default_rng(0), 1.333, 1e-4
    near = np.array([0.0, 0.0, 1.0])  # light goes down, in at a level surface and out at a tilted one
    for _ in range(200):
        v, b = (w / np.linalg.norm(w) for w in (rng.normal(size=(2, 3)) * 0.35 + [0.0, 0.0, -1.0]))

        def out(n1, n2, v=v):
            t, _ = refract(v, n1, 1 / index)
            return t, refract(t, -n2, index)[0]

        t, straight = out(near, b)
        cos, leaving = -v[2], t @ b
        if 1 - index**2 * (1 - leaving**2) < 0.04:  # close to total reflection: bounded on purpose
            continue
        bend = cos / index + t[2]
        for one, two in ((turn, 0.0), (0.0, turn), (turn, turn)):
            most = 0.0
            for angle in np.arange(8) * np.pi / 4:  # whichever way they turn
                side = np.array([np.cos(angle), np.sin(angle), 0.0])
                n1 = near + 2 * one * side
                n2 = b + 2 * two * (side - (side @ b) * b)
                moved = out(n1 / np.linalg.norm(n1), n2 / np.linalg.norm(n2))[1]
                most = max(most, np.linalg.norm(moved - straight) / 4)  # a mirror turns its light twice as far
            # the bend's own change with the normal is left out; parts at right angles are added up
            assert 0.75 * most < fanned(bend, leaving, one, two, index) < 2.5 * most


def test_fanned_out_light_is_the_mean_of_the_picture_behind():
    board = (np.indices((64, 96)).sum(axis=0) % 2 * np.ones((3, 1, 1))).transpose(1, 2, 0)
    values, levels = pyramid(board, deep=True)
    out = np.zeros(3)
    for wide, contrast in ((0.5, 1.0), (1.5, 1.0 - np.log2(1.5)), (2.0, 0.0), (1e4, 0.0)):
        fetch_beyond(values, levels, 40.5, 30.5, wide, np.zeros(4), out, 0)
        np.testing.assert_allclose(out, 0.5 - 0.5 * contrast, atol=1e-6)  # a dark field of 0 before a mean of 0.5
    assert len(pyramid(board, deep=False)[1]) == 1


@pytest.mark.parametrize("name", ["water", "honey", "lava", "source"])
def test_the_compiled_light_is_that_of_the_formulas(name):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.6)
    ball.vertices *= [1.5, 0.7, 1.0]
    rng = np.random.default_rng(0)
    colors = rng.uniform(0.1, 1.0, (len(ball.vertices), 3))
    surface = mesh_surface(TriangleMesh(np.array(ball.vertices), np.array(ball.faces), colors), CAMERA)
    behind = Behind(rng.uniform(0, 1, (*SIZE[::-1], 3)), np.where(level(-0.6) > 3.5, 0.0, level(-0.6)))
    one, other = (f(surface, behind, CAMERA, PRESETS[name], Environment.sky()) for f in (shaded, shaded_plain))
    # float32 directions into a picture with a sun: a rounded place beside it is another brightness
    np.testing.assert_allclose(one, other, rtol=2e-3, atol=2e-4)


def test_one_measure_of_heat_keeps_the_glow_of_what_stays():
    behind = Behind(np.zeros((*SIZE[::-1], 3)), level(-0.6))
    albedo = np.full((*SIZE[::-1], 3), 0.5)
    albedo[:, 40:] = 0.05  # a cold half that leaves the picture
    both = SurfaceBuffer(*(getattr(slab(), k) for k in ("depth", "normal", "thickness")), albedo, slab().covered)
    alone = slab()
    first, second = (shaded(s, behind, CAMERA, PRESETS["lava"], WHITE, usual=0.3)[:, :40] for s in (both, alone))
    np.testing.assert_array_equal(first, second)
    changed = shaded(both, behind, CAMERA, PRESETS["lava"], WHITE)[:, :40]
    assert np.abs(changed - shaded(alone, behind, CAMERA, PRESETS["lava"], WHITE)[:, :40]).max() > 0.1


def test_pictures_of_other_sizes_are_refused():
    with pytest.raises(ValueError, match="background"):
        shaded(slab(), Behind(np.zeros((10, 10, 3)), np.zeros((10, 10))), CAMERA, CLEAR, WHITE)
    with pytest.raises(ValueError, match="normal of shape"):
        SurfaceBuffer(np.ones((4, 4)), np.ones((4, 4)), np.ones((4, 4)), np.ones((4, 4, 3)), np.ones((4, 4)))


def test_a_film_fades_with_its_height_over_the_ground_however_slanting_it_is_seen():
    z, rays = level(0.0), CAMERA.rays(CAMERA.pixel_grid())
    behind = Behind(np.full((*SIZE[::-1], 3), 0.25), z)
    for height, share in ((0.0, 0.0), (0.005, 0.5), (0.01, 1.0), (0.5, 1.0)):
        film = slab(top=height, thick=1.0, grain=0.01)
        # heights of a hundredth at 4 m, in float32: 1e-4 of the grain and its slope of 1.5
        np.testing.assert_allclose(film_shown(film, behind, CAMERA), share, atol=2e-3)
        found = shaded(film, behind, CAMERA, PRESETS["milk"], WHITE)
        whole = shaded(slab(top=height, thick=1.0), behind, CAMERA, PRESETS["milk"], WHITE)
        if height > 0:
            np.testing.assert_allclose(found, 0.25 + share * (whole - 0.25), atol=5e-3)
    assert rays[..., 2].max() < -0.5  # it is seen from 20 to 60 degrees off the vertical


def test_round_a_rock_in_a_pond_there_is_no_bright_ring():
    # a wall stands in a pond 0.3 m deep that its mesh reaches into: the far side is the bed or the wall
    top, bed = level(0.0), level(-0.3)
    wall = np.zeros(SIZE[::-1], bool)
    wall[20:35, 30:50] = True
    rock = np.where(wall, 0.98 * top, bed)  # it stands out of the pond there
    below = np.broadcast_to([0.0, 0.0, -1.0], (*SIZE[::-1], 3)).copy()
    below[15:40, 25:55] = [0.0, 0.8, -0.6]  # the mesh follows the rock's flank, which would mirror all light in air
    surface = slab(top=0.0, thick=0.5, back_normal=below)
    behind = Behind(np.full((*SIZE[::-1], 3), 0.05), rock)
    picture = shaded(surface, behind, CAMERA, CLEAR, WHITE)[..., 0]
    around = np.zeros_like(wall)
    around[15:40, 25:55] = True
    share = fresnel(-CAMERA.rays(CAMERA.pixel_grid())[..., 2] / np.linalg.norm(
        CAMERA.rays(CAMERA.pixel_grid()), axis=-1), 1.333)  # fmt: skip
    expected = share + (1 - share) * 0.05
    np.testing.assert_allclose(picture[around & ~wall], expected[around & ~wall], atol=1e-4)
    np.testing.assert_array_equal(picture[wall], np.float32(0.05))
