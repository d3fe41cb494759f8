"""Closed meshes as solids: checks with advice, exact integrals, shapes."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.numerics.solid_mesh import (
    box_mesh,
    closed_mesh,
    cylinder_mesh,
    ellipsoid_mesh,
    flipped,
    moments,
    surface_points,
    welded,
)
from fluidlift.types import TriangleMesh, matrix_from_quat

TURN = matrix_from_quat(np.array([0.7, 0.1, -0.5, 0.3]))


def moved(mesh, shift):
    return TriangleMesh(mesh.vertices @ TURN.T + shift, mesh.faces)


def test_a_turned_and_shifted_box_has_the_moments_of_a_box():
    size, shift = np.array([1.0, 2.0, 3.0]), np.array([5.0, -3.0, 2.0])
    found = moments(moved(box_mesh(size), shift))
    assert found.volume == pytest.approx(6.0, rel=1e-12)
    np.testing.assert_allclose(found.center, shift, atol=1e-12)
    about_axes = (
        6.0 / 12.0 * np.diag([size[1] ** 2 + size[2] ** 2, size[0] ** 2 + size[2] ** 2, size[0] ** 2 + size[1] ** 2])
    )
    # exact integrals; what is left is rounding at a distance of six lengths
    np.testing.assert_allclose(found.inertia, TURN @ about_axes @ TURN.T, atol=1e-10)


def test_an_ellipsoid_has_the_volume_and_nearly_the_inertia_of_the_smooth_one():
    a, b, c = 1.0, 0.6, 0.3
    found = moments(ellipsoid_mesh((a, b, c)))
    volume = 4.0 / 3.0 * np.pi * a * b * c
    assert found.volume == pytest.approx(volume, rel=1e-12)
    wanted = volume / 5.0 * np.diag([b**2 + c**2, a**2 + c**2, a**2 + b**2])
    # facets of 1/15 of the radius: their inertia at equal volume differs by a few parts in ten thousand
    np.testing.assert_allclose(found.inertia, wanted, rtol=1e-3, atol=1e-12)


def test_a_cylinder_has_the_volume_of_the_round_one():
    found = moments(cylinder_mesh(0.5, 2.0))
    assert found.volume == pytest.approx(np.pi * 0.5, rel=1e-12)
    # the polygon of equal area has a slightly larger polar moment
    assert found.inertia[2, 2] == pytest.approx(0.5 * found.volume * 0.25, rel=2e-3)


@pytest.mark.parametrize("mesh", [box_mesh((1, 1, 1)), ellipsoid_mesh((1, 2, 3), 2), cylinder_mesh(1, 1)])
def test_the_shapes_are_closed_and_right_side_out(mesh):
    assert len(closed_mesh(mesh).faces) == len(mesh.faces)


def test_a_mesh_turned_inside_out_keeps_its_picture():
    mesh = box_mesh((1, 1, 1))
    rng = np.random.default_rng(0)
    painted = TriangleMesh(
        mesh.vertices, mesh.faces, uv=rng.uniform(size=(len(mesh.faces), 3, 2)).astype(np.float32),
        texture=rng.integers(0, 255, (4, 4, 3), np.uint8),
    )  # fmt: skip
    turned = flipped(painted)
    at = {tuple(v): tuple(map(tuple, uv)) for v, uv in zip(painted.faces, painted.uv)}
    for corners, uv in zip(turned.faces, turned.uv):
        assert at[tuple(corners[::-1])] == tuple(map(tuple, uv[::-1]))  # each corner has the place it had
    assert turned.texture is painted.texture


def test_a_mesh_cut_at_its_seams_is_welded():
    box = box_mesh((1, 1, 1))
    soup = TriangleMesh(box.vertices[box.faces].reshape(-1, 3), np.arange(36).reshape(12, 3))
    whole = closed_mesh(soup)
    assert len(whole.vertices) == 8 and moments(whole).volume == pytest.approx(1.0)


def test_triangles_that_collapse_when_welded_are_dropped():
    box = box_mesh((1, 1, 1))
    vertices = np.concatenate([box.vertices, box.vertices[:1]])
    faces = np.concatenate([box.faces, [[0, 8, 1]]])
    assert len(welded(TriangleMesh(vertices, faces)).faces) == 12


def test_an_open_mesh_is_refused_with_the_number_and_place_of_its_open_edges():
    box = box_mesh((1, 1, 1))
    with pytest.raises(InputRejected, match=r"crate: the surface is open: 3 edges.*near .*fill the holes"):
        closed_mesh(TriangleMesh(box.vertices, box.faces[1:]), name="crate")


def test_an_inside_out_mesh_is_refused_and_flipping_mends_it():
    box = flipped(box_mesh((1, 1, 1)))
    with pytest.raises(InputRejected, match=r"volume -1 m\^3, the surface is inside-out.*flip"):
        closed_mesh(box)
    assert moments(closed_mesh(flipped(box))).volume == pytest.approx(1.0)


def test_triangles_that_face_opposite_ways_are_refused():
    box = box_mesh((1, 1, 1))
    faces = box.faces.copy()
    faces[0] = faces[0][::-1]
    with pytest.raises(InputRejected, match=r"face opposite ways at 3 edges.*normals"):
        closed_mesh(TriangleMesh(box.vertices, faces))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: TriangleMesh(m.vertices * [1, 1, np.nan], m.faces), "not finite"),
        (lambda m: TriangleMesh(m.vertices * [1, 1, 1e-9], m.faces), "flat or degenerate"),
        (lambda m: TriangleMesh(m.vertices, m.faces + 1), "vertex numbers from 1 to 8"),
        (lambda m: TriangleMesh(m.vertices[:3], m.faces[:1]), "at least four"),
    ],
)
def test_broken_meshes_are_refused_with_the_reason(change, message):
    with pytest.raises(InputRejected, match=message):
        closed_mesh(change(box_mesh((1, 1, 1))))


def test_a_mesh_with_too_many_faces_is_refused_with_the_limit():
    with pytest.raises(InputRejected, match=r"1280 triangles. Needed: at most 1000.*decimate"):
        closed_mesh(ellipsoid_mesh((1, 1, 1), 3), max_faces=1000)


def test_surface_points_lie_on_the_surface_without_gaps_and_keep_the_corners():
    box = box_mesh((1.0, 0.6, 0.2))
    points = surface_points(box, 0.1)
    half = np.array([0.5, 0.3, 0.1])
    assert np.abs((np.abs(points) - half).max(axis=1)).max() < 1e-12
    for corner in box.vertices:
        assert np.abs(points - corner).max(axis=1).min() == 0.0
    on_top = points[np.isclose(points[:, 2], 0.1)]
    places = np.random.default_rng(0).uniform(-half, half, (500, 3))[:, :2]
    nearest = np.sqrt(((places[:, None] - on_top[None, :, :2]) ** 2).sum(-1)).min(axis=1)
    assert nearest.max() < 0.1


def test_a_mesh_finer_than_the_points_is_thinned():
    points = surface_points(ellipsoid_mesh((1, 1, 1), 5), 0.2)
    apart = np.sqrt(((points[:, None] - points[None]) ** 2).sum(-1)) + 9 * np.eye(len(points))
    assert apart.min() >= 0.1 * (1 - 1e-6) and len(points) < 2500
