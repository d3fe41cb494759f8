"""Lit ground: where shadows lie, how dark they are, what light a liquid lets through, and what hides what."""

import numpy as np
import pytest
import trimesh

from fluidlift.look.environment import Environment
from fluidlift.look.ground_picture import (
    GroundLight,
    GroundMeshes,
    bounced,
    received,
    spread_directions,
)
from fluidlift.look.liquid import Behind
from fluidlift.look.materials import Material
from fluidlift.numerics.srgb import linear_from_srgb
from fluidlift.types import PinholeCamera, TriangleMesh

CAMERA = PinholeCamera.looking((0.0, -3.0, 3.0), (0.0, 0.0, 0.0), 45.0, (120, 90))
WHITE = Environment.white()
NO_AMBIENT = GroundLight(directions=0, soft=0.0)


def floor(half=4.0, height=0.0, color=(0.5, 0.5, 0.5)):
    v = np.array([[-half, -half, height], [half, -half, height], [half, half, height], [-half, half, height]])
    return TriangleMesh(v, np.array([[0, 1, 2], [0, 2, 3]]), np.tile(np.asarray(color, float), (4, 1)))


def body(mesh):
    return TriangleMesh(np.array(mesh.vertices), np.array(mesh.faces))


def ground_picture(meshes, environment, behind=None, lit=None):
    return GroundMeshes(meshes, environment, lit).picture(CAMERA, behind)


def lamp(direction=(0.6, 0.0, 0.8), brightness=300.0, around=0.2):
    """A small bright light in a gray world."""
    from fluidlift.look.environment_lookup import grid_directions

    d = np.asarray(direction) / np.linalg.norm(direction)
    return Environment(np.where((grid_directions(64) @ d > 0.997)[..., None], brightness, around) * np.ones(3))


def test_open_ground_in_a_white_world_has_its_own_colour():
    picture = ground_picture([floor(color=(0.8, 0.4, 0.1))], WHITE)
    expected = linear_from_srgb(np.array([0.8, 0.4, 0.1]))
    # of light along the ground a pixel of the shadow map more or less is lost: 0.3 %
    np.testing.assert_allclose(picture.image[picture.depth > 0], np.broadcast_to(expected, (120 * 90, 3)), rtol=3e-3)
    assert (picture.depth > 0).all()


def test_a_white_world_is_white_in_every_cleft_and_beside_every_body():
    white, ball = (1.0, 1.0, 1.0), trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    ball.apply_translation([0.0, 0.0, 0.4])  # a little in the ground: a narrow cleft around its foot
    walls = trimesh.creation.box((2.0, 0.2, 1.0))
    walls.apply_translation([0.0, 0.6, 0.5])
    stays = [floor(color=white), *(TriangleMesh(*m, np.ones_like(m[0])) for m in [(walls.vertices, walls.faces)])]
    stone = TriangleMesh(np.array(ball.vertices), np.array(ball.faces), np.ones_like(ball.vertices))
    for moves in (False, True):
        ground = GroundMeshes(stays if moves else [*stays, stone], WHITE)
        picture = ground.picture(CAMERA, bodies=[stone] if moves else [])
        assert (picture.depth > 0).all()
        np.testing.assert_allclose(picture.image, 1.0, atol=1e-3)  # eight bits of the environment's own picture


def test_light_between_surfaces_takes_their_colour_and_never_adds_to_the_sky():
    left, albedo = np.array([[1.0, 0.5, 0.0]]).T, np.array([[0.0, 0.3, 0.9]])
    light = left * bounced(np.repeat(left, 3, axis=1), albedo)
    assert (light <= 1.0).all() and (light >= left).all()  # nobody gets more than the open sky, nor less than alone
    np.testing.assert_allclose(light[0], 1.0)  # nothing beside it: nothing is added
    np.testing.assert_allclose(light[1, 0], 0.5)  # black walls send nothing
    # half the sky, walls of 0.3: 0.5 (1 + 0.15 + 0.15^2 ...), less what a cleft is held open
    assert light[1, 1] == pytest.approx(0.5 / 0.85, rel=5e-3)


def test_a_texture_lies_where_its_coordinates_say():
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:, 32:] = 255
    plain = floor()
    uv = np.stack([plain.vertices[plain.faces][..., 0] / 8 + 0.5, 0.5 - plain.vertices[plain.faces][..., 1] / 8], -1)
    mesh = TriangleMesh(plain.vertices, plain.faces, plain.colors, uv, texture)
    image = ground_picture([mesh], WHITE).image
    # white to the right of x = 0, the middle column; half a texel of 0.125 m, 3 px in front, is between
    assert image[:, :56].max() < 0.01 and image[:, 64:].min() > 0.99


def test_the_shadow_of_a_ball_lies_where_the_light_throws_it():
    d = np.array([0.6, 0.0, 0.8])
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.4)
    ball.apply_translation([0.0, 0.0, 1.2])
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-2, 1, 61), np.linspace(-1, 1, 41)))
    points = np.stack([x, y, 0 * x], axis=-1)
    up = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    light = lamp(d)
    got = received(points, up, [floor(), body(ball)], light, lit=NO_AMBIENT)[:, 1]
    toward, _, share = light.light()
    assert share > 0.5 and np.degrees(np.arccos(toward @ d)) < 1.0
    away = np.linalg.norm(np.cross(points - [0, 0, 1.2], d), axis=1)
    lit_up, dark = got[away > 0.45].min(), got[(away < 0.35)].max()  # a texel of 0.01 m, and the polyhedron
    assert dark < 0.45 * lit_up
    # what is left in the shadow is the light from all around: 0.2 with the lamp taken out
    assert got[away < 0.35].mean() == pytest.approx(0.2, rel=0.15)


@pytest.mark.parametrize("soft", [0.0, 0.02])
def test_flat_ground_and_balls_do_not_shade_themselves(soft):
    ball = trimesh.creation.icosphere(subdivisions=4, radius=1.0)
    normals = np.array(ball.vertices) / np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    light = lamp((0.1, 0.0, 1.0))
    facing = normals @ light.light()[0] > 0.3
    lit = GroundLight(directions=0, soft=soft)
    got = received(np.array(ball.vertices)[facing], normals[facing], [body(ball)], light, lit=lit)
    # where a soft edge looks beside the point, the ball curves away: nothing else may be missing
    np.testing.assert_allclose(got, light.irradiance(normals[facing]), rtol=0.02)


def test_a_liquid_lets_its_own_colour_of_light_through():
    slab = trimesh.creation.box((2.0, 2.0, 0.1))
    slab.apply_translation([0.0, 0.0, 0.5])
    light = lamp((0.0, 0.0, 1.0), around=0.0)
    point, up = np.array([[0.0, 0.0, 0.0], [1.8, 0.0, 0.0]]), np.tile([0.0, 0.0, 1.0], (2, 1))
    a = np.array([1.0, 5.0, 40.0])
    material = Material("dye", 1.0, absorption=tuple(a))  # index 1: nothing is mirrored
    scene = {"caster": body(slab), "lit": NO_AMBIENT}
    under, beside = received(point, up, [floor()], light, material=material, **scene)
    # the light stands within a degree of the vertical
    np.testing.assert_allclose(under / beside, np.exp(-0.1 * a), rtol=5e-3)
    opaque, _ = received(point, up, [floor()], light, **scene)
    assert opaque.max() < 0.02 * beside.min()


def test_below_a_body_near_the_ground_it_is_darker_the_nearer_it_is():
    plate = trimesh.creation.box((1.0, 1.0, 0.05))
    middle, up = np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]])
    light = []
    for height in (0.1, 0.5, 2.0):
        raised = plate.copy()
        raised.apply_translation([0.0, 0.0, height])
        lit = GroundLight(directions=64)
        light.append(received(middle, up, [floor()], WHITE, caster=body(raised), lit=lit)[0, 0])
    assert light[0] < light[1] < light[2] < 1.0
    # a plate of half width a at height h hides about a^2 / (a^2 + h^2) of the cosine-weighted sky (of a disk, exactly)
    assert light[0] < 0.1
    assert light[2] == pytest.approx(1 - 0.32 / (0.32 + 4.0), abs=0.08)  # the disk of equal area; 64 directions


def test_directions_are_spread_evenly_and_seldom_look_up_from_below():
    d = spread_directions(200)
    np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1.0, atol=1e-6)
    assert np.linalg.norm(d[:, :2].mean(axis=0)) < 0.02 and d[:, 2].min() > -0.16


def test_nearer_meshes_and_nearer_things_behind_hide_ground():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    red = TriangleMesh(np.array(ball.vertices), np.array(ball.faces), np.tile([1.0, 0, 0], (len(ball.vertices), 1)))
    for meshes in ([floor(), red], [red, floor()]):
        picture = ground_picture(meshes, WHITE, lit=NO_AMBIENT)
        assert picture.image[40, 60, 1] < 0.01 < picture.image[40, 60, 0]
        assert picture.depth[40, 60] < np.linalg.norm(CAMERA.position) - 0.4
    depth = np.zeros((90, 120))
    depth[:, :60] = 0.5  # a curtain
    behind = Behind(np.full((90, 120, 3), 7.0), depth)
    picture = ground_picture([floor()], WHITE, behind, lit=NO_AMBIENT)
    assert (picture.image[:, :60] == 7.0).all() and (picture.depth[:, :60] == 0.5).all()
    assert (picture.image[:, 60:] < 1.0).all()


def test_without_meshes_the_environment_is_seen_and_with_small_ones_around_them():
    sky = lamp()
    empty = ground_picture([], sky)
    np.testing.assert_array_equal(empty.image, sky.toward(CAMERA.rays(CAMERA.pixel_grid())))
    assert not empty.depth.any()
    tile = ground_picture([floor(half=0.3)], sky)
    np.testing.assert_array_equal(tile.image[tile.depth == 0], empty.image[tile.depth == 0])
    with pytest.raises(ValueError, match="background"):
        ground_picture([floor()], sky, Behind(np.zeros((5, 5, 3)), np.zeros((5, 5))))


def test_what_is_kept_from_frame_to_frame_changes_no_picture():
    sky = Environment.sky()
    kept = GroundMeshes([floor()], sky)
    slab = trimesh.creation.box((1.0, 1.0, 0.2))
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.4)
    other = PinholeCamera.looking((2.0, -3.0, 2.0), (0.0, 0.0, 0.0), 45.0, (120, 90))
    water = Material("dye", 1.3, absorption=(1.0, 5.0, 40.0))
    for camera, x in ((CAMERA, 0.0), (CAMERA, 0.7), (other, 0.7), (CAMERA, 0.7)):
        liquid, obstacle = slab.copy(), ball.copy()
        liquid.apply_translation([x, 0.0, 0.5])
        obstacle.apply_translation([-1.0, x, 0.4])
        moving = {"caster": body(liquid), "material": water, "bodies": [body(obstacle)]}
        one, fresh = (g.picture(camera, **moving) for g in (kept, GroundMeshes([floor()], sky)))
        np.testing.assert_array_equal(one.image, fresh.image)
        np.testing.assert_array_equal(one.depth, fresh.depth)
    still = kept.picture(CAMERA)
    np.testing.assert_array_equal(still.image, ground_picture([floor()], sky).image)
    assert np.abs(still.image - one.image).max() > 0.1  # and the shadows are those of the frame


def test_what_moves_is_lit_as_if_it_stayed():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    ball.apply_translation([0.0, 0.0, 0.5])
    apart = GroundMeshes([floor()], Environment.sky()).picture(CAMERA, bodies=[body(ball)])
    whole = ground_picture([floor(), body(ball)], Environment.sky())
    np.testing.assert_array_equal(apart.depth, whole.depth)
    # maps of their own for what moves: edges of shadows lie a texel beside, and the rest is the same
    off = np.abs(apart.image - whole.image).max(axis=-1)
    assert np.median(off) < 0.005 and (off > 0.1).mean() < 0.02


def test_ground_that_a_caster_stands_out_over_is_lit_and_what_lies_deeper_is_not():
    sky, off = lamp((0.0, 0.0, 1.0), around=0.0), 0.1
    box = body(trimesh.creation.box((1.0, 1.0, 0.8)))
    ground = GroundMeshes([floor()], sky, NO_AMBIENT)
    whole, thin = (ground.picture(CAMERA, caster=box, inset=i).image.mean(axis=-1) for i in (0.0, off))
    middle = np.array(CAMERA.size[::-1]) // 2
    assert whole[tuple(middle)] < 0.01 and thin[tuple(middle)] < 0.01  # 0.4 m below its top
    low = TriangleMesh(box.vertices - [0.0, 0.0, 0.4 - 0.5 * off], box.faces)
    whole, thin = (ground.picture(CAMERA, caster=low, inset=i).image.mean(axis=-1) for i in (0.0, off))
    open_ = ground.picture(CAMERA).image.mean(axis=-1)
    assert whole[tuple(middle)] < 0.01  # 0.05 m below its top, which stands out by 0.1 m
    assert thin[tuple(middle)] == pytest.approx(open_[tuple(middle)], rel=1e-3)
