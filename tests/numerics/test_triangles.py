"""The rasteriser of triangles: against every ray meeting every face, against analytic bodies, and without seams."""

import numba
import numpy as np
import pytest
import trimesh

from fluidlift.numerics.triangles import interpolated, rasterize_closed, rasterize_triangles
from fluidlift.numerics.triangles_plain import crossings, nearest
from fluidlift.types import PinholeCamera

CAMERA = PinholeCamera.looking((0.4, -3.0, 1.1), (0.0, 0.0, 0.0), 50.0, (64, 48))


def ball(subdivisions=3, radius=1.0):
    b = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(b.vertices), np.array(b.faces)


def soup(n=60, spread=1.5):
    rng = np.random.default_rng(1)
    vertices = rng.uniform(-spread, spread, (3 * n, 3))
    return vertices, np.arange(3 * n).reshape(-1, 3)


@pytest.mark.parametrize("spread", [1.5, 6.0])  # the wider ones pass beside and behind the camera
@pytest.mark.parametrize("facing", ["both", "front", "back"])
def test_it_draws_what_every_ray_against_every_face_gives(spread, facing):
    vertices, faces = soup(spread=spread)
    found = rasterize_triangles(vertices, faces, CAMERA, facing=facing)
    z, shares, side = crossings(vertices, faces, CAMERA)
    if facing != "both":
        z = np.where(side == (1 if facing == "front" else -1), z, 0.0)
    expected = nearest(z)
    np.testing.assert_array_equal(found.face, expected)
    i, j = np.nonzero(found.hit)
    assert len(i) > 300
    f = expected[i, j]
    np.testing.assert_allclose(found.depth[i, j], z[i, j, f], rtol=1e-6)  # float32
    np.testing.assert_allclose(found.barycentric[i, j], shares[i, j, f], atol=1e-5)  # of slivers, float32


def test_slivers_across_the_picture_are_drawn_as_every_ray_meets_them():
    # of whose boxes next to nothing is theirs: only the columns that a row can have are asked
    rng = np.random.default_rng(7)
    one, way = rng.uniform(-1.5, 1.5, (400, 3)), rng.normal(size=(400, 3))
    thin = rng.normal(size=(400, 3)) * rng.choice([1e-3, 0.03, 0.2], (400, 1))
    vertices = np.stack([one - way, one + way, one + thin], axis=1).reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    found = rasterize_triangles(vertices, faces, CAMERA)
    np.testing.assert_array_equal(found.face, nearest(crossings(vertices, faces, CAMERA)[0]))
    assert len(np.unique(found.face)) > 100
    whole = rasterize_closed(vertices, faces, CAMERA)
    front = rasterize_triangles(vertices, faces, CAMERA, facing="front")
    np.testing.assert_array_equal(whole.front.face, front.face)


def test_values_are_interpolated_in_space_and_not_in_the_picture():
    # a floor that runs away from the camera: its height, seen through the vertices, is the point's own
    vertices = np.array([[-4.0, -2, -1], [4, -2, -1], [4, 20, -1], [-4, 20, -1]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    found = rasterize_triangles(vertices, faces, CAMERA)
    seen = interpolated(found, vertices, faces)
    points = CAMERA.unproject(CAMERA.pixel_grid(), found.depth)
    np.testing.assert_allclose(seen[found.hit], points[found.hit], atol=2e-5)  # float32 at 20 m


def test_a_closed_mesh_has_no_seams_and_is_left_as_often_as_it_is_entered():
    # a cube whose edges and diagonals run exactly through pixel centres
    vertices, faces = np.array(trimesh.creation.box((2, 2, 2)).vertices), np.array(trimesh.creation.box().faces)
    camera = PinholeCamera.looking((0.0, -5.0, 0.0), (0.0, 0.0, 0.0), 60.0, (65, 65))
    found = rasterize_closed(vertices, faces, camera)
    np.testing.assert_array_equal(found.front.hit, found.back.hit)
    rows, columns = np.nonzero(found.front.hit)
    assert found.front.hit[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1].all()
    np.testing.assert_allclose(found.front.depth[found.front.hit], 4.0, rtol=1e-6)
    # depths where one leaves minus where one enters, in every pixel: no face is counted twice or left out
    back = found.back.depth[found.back.hit]
    np.testing.assert_allclose(found.inside[found.front.hit], back - 4.0, atol=1e-5)


def test_the_ways_through_two_balls_add_up_and_a_dent_is_left_out():
    v, f = ball(4, 0.5)
    one, two = v + [0.0, -0.8, 0.0], v + [0.0, 0.9, 0.0]
    both = rasterize_closed(np.concatenate([one, two]), np.concatenate([f, f + len(v)]), CAMERA).inside
    apart = rasterize_closed(one, f, CAMERA).inside + rasterize_closed(two, f, CAMERA).inside
    np.testing.assert_allclose(both, apart, atol=1e-5)
    # a hollow ball: the inner shell, turned inside out, takes its share away
    hollow = rasterize_closed(np.concatenate([v, 0.5 * v]), np.concatenate([f, f[:, ::-1] + len(v)]), CAMERA).inside
    less = rasterize_closed(v, f, CAMERA).inside - rasterize_closed(0.5 * v, f, CAMERA).inside
    np.testing.assert_allclose(hollow, less, atol=1e-5)


def test_depth_and_thickness_of_a_ball_are_those_of_the_formula():
    v, f = ball(5)
    found = rasterize_closed(v, f, CAMERA)
    rays = CAMERA.rays(CAMERA.pixel_grid())
    a, b, c = (rays**2).sum(-1), rays @ CAMERA.position, CAMERA.position @ CAMERA.position - 1.0
    left = b * b - a * c
    sure = left / a > 0.05  # away from the outline, where the chord of a polyhedron differs without bound
    root = np.sqrt(np.maximum(left, 0))
    # the middle of a face, 0.025 from its corners,
    # lies 0.025^2 / 2 = 3e-4 within the ball, and 1 / 0.22 of that along a ray
    np.testing.assert_allclose(found.front.depth[sure], ((-b - root) / a)[sure], atol=1.4e-3)
    np.testing.assert_allclose(found.inside[sure], (2 * root / a)[sure], atol=2.8e-3)


def test_the_order_of_threads_changes_nothing():
    v, f = ball(4)
    many = rasterize_closed(v, f, CAMERA)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        one = rasterize_closed(v, f, CAMERA)
    finally:
        numba.set_num_threads(threads)
    np.testing.assert_array_equal(one.inside, many.inside)
    np.testing.assert_array_equal(one.back.face, many.back.face)
    np.testing.assert_array_equal(one.front.barycentric, many.front.barycentric)


def test_from_within_a_body_the_far_wall_counts_alone():
    v, f = ball(5)
    camera = PinholeCamera.looking((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (20, 20))
    found = rasterize_closed(v, f, camera)
    assert not found.front.hit.any() and found.back.hit.all()
    length = found.inside * np.linalg.norm(camera.rays(camera.pixel_grid()), axis=-1)
    np.testing.assert_allclose(length, 1.0, atol=3e-4)  # the polyhedron's sagitta


def test_nothing_and_broken_faces_draw_nothing():
    empty = rasterize_triangles(np.zeros((0, 3)), np.zeros((0, 3), int), CAMERA)
    assert not empty.hit.any()
    vertices = np.array([[np.nan, 0, 0], [1, 0, 0], [0, 0, 1.0], [0, 0, 0], [2, 0, 0]])
    faces = np.array([[0, 1, 2], [3, 1, 4]])  # not a number, and no area
    assert not rasterize_triangles(vertices, faces, CAMERA).hit.any()
    with pytest.raises(ValueError, match="indices of 0 to 4"):
        rasterize_triangles(vertices, np.array([[0, 1, 5]]), CAMERA)
    with pytest.raises(ValueError, match="facing"):
        rasterize_triangles(vertices, faces, CAMERA, facing="left")
