"""Terrain in pictures: normals, surfels, depth, what rocks hide, and a camera that walks around."""

import numpy as np
import pytest
import trimesh

from fluidlift.look.scenery import (
    orbit_camera,
    side_camera,
    terrain_depth,
    terrain_surfels,
    vertex_normals,
    visible_beside_rocks,
)
from fluidlift.numerics.isosurface import surface_nets
from fluidlift.types import Gaussians, Grid, PinholeCamera, Terrain, TriangleMesh

GRID = Grid((24, 24, 16), 0.1, (-1.2, -1.2, -0.8))
CAMERA = PinholeCamera.looking((0.0, -3.0, 2.0), (0.0, 0.0, 0.0), 35.0, (60, 48))
BALL, RADIUS = np.array([0.0, 0.0, 0.1]), 0.35


def ground(ball=True, colour=None):
    """Level ground at z = 0, with a ball half buried in it."""
    nodes = GRID.nodes()
    phi = nodes[..., 2].copy()
    if ball:
        phi = np.minimum(phi, np.linalg.norm(nodes - BALL, axis=-1) - RADIUS)
    vertices, faces = surface_nets(phi, spacing=GRID.spacing, origin=GRID.origin)
    colors = None if colour is None else np.tile(np.float64(colour), (len(vertices), 1))
    return Terrain(GRID, phi.astype(np.float32), np.array([1.0, 0, 0]), TriangleMesh(vertices, faces, colors))


def test_normals_of_a_ball_point_away_from_its_middle():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=2.0)
    normals = vertex_normals(TriangleMesh(ball.vertices, ball.faces))
    # triangles of about 18 degrees, of two shapes: their mean leans by a small part of that
    assert np.degrees(np.arccos((normals * ball.vertices / 2.0).sum(axis=1).clip(-1, 1))).max() < 2.0


def test_normals_of_ground_point_up():
    terrain = ground(ball=False)
    v, n = terrain.mesh.vertices, vertex_normals(terrain.mesh)
    top = (np.abs(v[:, 2]) < 0.01) & (np.abs(v[:, :2]) < 1.0).all(axis=1)
    np.testing.assert_allclose(n[top], np.tile([0, 0, 1.0], (top.sum(), 1)), atol=1e-5)


def test_surfels_lie_flat_on_the_ground():
    terrain = ground(ball=False, colour=(0.4, 0.3, 0.2))
    surfels = terrain_surfels(terrain)
    top = (np.abs(surfels.means[:, 2]) < 0.01) & (np.abs(surfels.means[:, :2]) < 1.0).all(axis=1)
    c = surfels.covariances()[top]
    assert (c[:, 2, 2] < 0.1 * c[:, 0, 0]).all()
    np.testing.assert_allclose(c[:, 0, 0], c[:, 1, 1], rtol=1e-3)
    # all of one colour: the light shines on level ground everywhere alike, and never brightens
    assert np.ptp(surfels.rgb[top], axis=0).max() < 1e-4
    assert (surfels.rgb[top] < [0.401, 0.301, 0.201]).all() and (surfels.rgb[top] > 0.05).all()


def test_a_textured_ground_shows_what_is_finer_than_its_faces():
    vertices = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)[faces]
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:, :32, 0] = texture[:, 32:, 2] = 200
    mesh = TriangleMesh(vertices, faces, np.full((4, 3), 0.5), uv, texture)
    surfels = terrain_surfels(Terrain(GRID, np.ones((25, 25, 17), np.float32), np.array([1.0, 0, 0]), mesh), most=5000)
    assert 2000 < len(surfels) <= 5000
    left, right = (surfels.rgb[sign * surfels.means[:, 0] > 0.1] for sign in (-1, 1))
    assert (left[:, 0] > 0.4).all() and (left[:, 2] < 0.01).all()
    assert (right[:, 2] > 0.4).all() and (right[:, 0] < 0.01).all()
    # discs of 0.62 of a leg on triangles of half its square: together 2.4 times the ground
    area = np.pi * surfels.scales.max(axis=1) ** 2
    assert area.sum() / 4.0 == pytest.approx(2 * np.pi * 0.62**2, rel=0.02)


def test_ground_without_a_surface_has_no_surfels():
    empty = Terrain(
        GRID, np.ones(tuple(n + 1 for n in GRID.shape)), np.array([1.0, 0, 0]),
        TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)),
    )  # fmt: skip
    assert len(terrain_surfels(empty)) == 0
    assert np.isinf(terrain_depth(empty, CAMERA)).all()


def plane_depth():
    rays = CAMERA.rays(CAMERA.pixel_grid())
    return -CAMERA.position[2] / rays[..., 2]


def test_the_depth_of_level_ground_is_where_rays_meet_it():
    depth, exact = terrain_depth(ground(ball=False), CAMERA), plane_depth()
    p = CAMERA.position + CAMERA.rays(CAMERA.pixel_grid()) * exact[..., None]
    inner = (np.abs(p[..., :2]) < 1.1).all(axis=-1)
    assert inner.any()
    # a ray stops within 0.05 cells of the surface, which it meets at 25 degrees or more
    np.testing.assert_allclose(depth[inner], exact[inner], atol=0.05 * GRID.spacing / np.sin(np.radians(25)))


def test_a_ball_on_the_ground_is_nearer_than_the_ground_behind_it():
    depth = terrain_depth(ground(), CAMERA)
    uv, z = CAMERA.project(BALL[None])
    col, row = uv[0].astype(int)
    direction = BALL - CAMERA.position
    # trilinear interpolation of the distance over cells of 0.1 m flattens a ball of 0.35 m by about h^2 / 4 R
    expected = z[0] * (1 - RADIUS / np.linalg.norm(direction))
    assert depth[row, col] == pytest.approx(expected, abs=0.02)
    assert depth[row, col] < plane_depth()[row, col]


def test_rays_beside_the_box_meet_nothing():
    away = PinholeCamera.looking((0.0, -3.0, 2.0), (0.0, -6.0, 2.5), 35.0, (20, 16))
    assert np.isinf(terrain_depth(ground(), away)).all()


def test_what_lies_behind_a_rock_is_hidden_and_what_lies_before_or_beside_it_is_not():
    terrain = ground()
    depth = terrain_depth(terrain, CAMERA)
    uv, z = CAMERA.project(BALL[None])
    before, behind = CAMERA.unproject(uv, z - 0.6), CAMERA.unproject(uv, z + 0.8)
    beside = CAMERA.unproject(uv + [[20.0, 0.0]], z + 0.8)
    rock = np.zeros((48, 60), bool)
    col, row = uv[0].astype(int)
    rock[row - 2 : row + 3, col - 2 : col + 3] = True
    seen = visible_beside_rocks(np.vstack([before, behind, beside]), CAMERA, depth, rock, margin=0.15)
    np.testing.assert_array_equal(seen, [True, False, True])


def test_points_behind_the_camera_do_no_harm():
    seen = visible_beside_rocks(
        np.array([CAMERA.position, [0.0, -9.0, 4.0], [np.nan] * 3]), CAMERA, np.ones((48, 60)), np.ones((48, 60), bool),
        margin=0.1,
    )  # fmt: skip
    assert seen.shape == (3,)


BODY = np.random.default_rng(0).uniform([-1, -0.3, 0], [1, 0.3, 0.2], (500, 3)) + [5.0, 2.0, 0.0]


@pytest.mark.parametrize("azimuth", [0.0, 65.0, -120.0])
@pytest.mark.parametrize("size", [(80, 60), (60, 80)])
def test_a_camera_that_walks_around_sees_the_whole_body(azimuth, size):
    view = orbit_camera(CAMERA, BODY, azimuth=azimuth, size=size)
    uv, z = view.project(BODY)
    assert view.size == size
    assert (z > 0).all()
    assert ((uv >= 0) & (uv <= size)).all()
    # and it is not far away: the body fills a good part of the picture along one side at least
    assert (np.ptp(uv, axis=0) / size).max() > 0.5


def test_the_camera_walks_counter_clockwise_at_its_elevation():
    centre = 0.5 * (BODY.min(axis=0) + BODY.max(axis=0))

    def bearing(camera):
        d = camera.position - centre
        return np.degrees(np.arctan2(d[1], d[0])), np.degrees(np.arcsin(d[2] / np.linalg.norm(d)))

    start = bearing(CAMERA)[0]
    around, up = bearing(orbit_camera(CAMERA, BODY, azimuth=65.0, elevation=24.0))
    assert (around - start) % 360 == pytest.approx(65.0)
    assert up == pytest.approx(24.0)


def test_surfels_cover_every_face_of_a_mesh_and_look_outwards():
    from fluidlift.look.scenery import mesh_surfels
    from fluidlift.numerics.solid_mesh import box_mesh

    surfels = mesh_surfels(box_mesh(np.array([1.0, 2.0, 0.5])), 0.1)
    half = np.array([0.5, 1.0, 0.25])
    on_face = np.abs(np.abs(surfels.means) - half) < 1e-6
    assert (on_face.sum(axis=1) == 1).all()
    # no place on a side is farther from a surfel than the spacing
    side = surfels.means[on_face[:, 2] & (surfels.means[:, 2] > 0)]
    y, x = np.mgrid[-1:1:41j, -0.5:0.5:21j]
    places = np.stack([x, y, np.full_like(x, 0.25)], -1).reshape(-1, 3)
    assert np.linalg.norm(places[:, None] - side[None], axis=-1).min(axis=1).max() < 0.1
    # flat: thin across the face they lie on
    thin = np.sqrt(np.einsum("nii->ni", surfels.covariances())[on_face])
    assert (thin < 0.5 * np.sort(surfels.scales, axis=1)[:, 1]).all()


def test_a_mesh_that_is_huge_for_its_spacing_gets_a_bounded_number_of_surfels():
    from fluidlift.look.scenery import mesh_surfels
    from fluidlift.numerics.solid_mesh import box_mesh

    assert len(mesh_surfels(box_mesh(np.ones(3)), 1e-4, most=5000)) < 20_000


def test_the_side_is_the_one_from_which_the_ground_hides_little():
    camera = PinholeCamera.looking((0.0, -3.0, 1.5), (0.0, 0.0, 0.0), 50.0, (96, 72))
    rng = np.random.default_rng(0)
    fluid = Gaussians.isotropic(rng.uniform((-0.5, -0.5, 0.0), (0.5, 0.5, 0.05), (800, 3)), 0.05, np.ones((800, 3)))
    points = np.array([[-1.0, -1, 0], [1.0, 1, 1]])

    def wall(x: float) -> Gaussians:
        place = rng.uniform((x, -1.0, 0.0), (x + 0.02, 1.0, 1.0), (3000, 3))
        return Gaussians.isotropic(place, 0.04, np.ones((3000, 3)))

    usual = side_camera(camera, fluid, Gaussians.empty(), points)
    side = float(np.sign(usual.position[0]))
    assert side == np.sign(orbit_camera(camera, points).position[0])
    # a wall on that side: the other one is taken; it stands behind the fluid from there
    assert np.sign(side_camera(camera, fluid, wall(0.9 * side), points).position[0]) == -side
    np.testing.assert_allclose(side_camera(camera, fluid, wall(-0.9 * side), points).position, usual.position)
