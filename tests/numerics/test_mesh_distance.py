"""Signed distance of triangle meshes."""

import numpy as np
import pytest

from fluidlift.numerics.mesh_distance import (
    mesh_distance,
    mesh_distance_plain,
    squared_distance_to_triangle,
    thin_warning,
)
from fluidlift.numerics.solid_mesh import box_mesh, cylinder_mesh, ellipsoid_mesh, flipped
from fluidlift.types import TriangleMesh


def joined(*meshes):
    start = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return TriangleMesh(
        np.concatenate([m.vertices for m in meshes]), np.concatenate([m.faces + s for m, s in zip(meshes, start)])
    )


def shifted(mesh, by):
    return TriangleMesh(mesh.vertices + np.asarray(by), mesh.faces)


def box_distance(points, half):
    beyond = np.abs(points) - half
    return np.sqrt((np.maximum(beyond, 0) ** 2).sum(-1)) + np.minimum(beyond.max(-1), 0)


def test_the_distance_to_a_box_is_exact():
    half = np.array([0.5, 0.3, 0.2])
    found = mesh_distance(box_mesh(2 * half), 0.07)
    # single precision of the result
    np.testing.assert_allclose(found.distance, box_distance(found.grid.nodes(), half), atol=1e-7)


def test_the_distance_to_a_fine_sphere_is_that_of_the_sphere():
    found = mesh_distance(ellipsoid_mesh((1, 1, 1), 5), 0.1)
    wanted = np.sqrt((found.grid.nodes() ** 2).sum(-1)) - 1.0
    near = np.abs(wanted) < 0.2
    # the facets of 20480 triangles are 1/30 of the radius long: a sagitta of 2e-4
    assert np.abs(found.distance - wanted)[near].max() < 4e-4
    # farther away the triangle is that of a neighbour: an upper bound of the distance
    assert np.abs(found.distance - wanted).max() < 0.05


@pytest.mark.parametrize(
    "mesh",
    [
        ellipsoid_mesh((0.9, 0.5, 0.2), 2),
        joined(box_mesh((1, 1, 1)), shifted(ellipsoid_mesh((0.4, 0.4, 0.4), 1), (0.55, 0.1, 0.0))),
        joined(box_mesh((1, 1, 1)), flipped(box_mesh((0.5, 0.5, 0.5)))),
    ],
    ids=["ellipsoid", "two shells that overlap", "a hollow box"],
)
def test_the_fast_distance_agrees_with_the_plain_one(mesh):
    found = mesh_distance(mesh, 0.13)
    rng = np.random.default_rng(0)
    index = rng.choice(found.distance.size, 250, replace=False)
    plain = mesh_distance_plain(mesh, found.grid.nodes().reshape(-1, 3)[index])
    fast = found.distance.ravel()[index]
    assert (np.sign(fast) == np.sign(plain)).all()
    near = np.abs(plain) < 0.13
    np.testing.assert_allclose(fast[near], plain[near], atol=1e-6)
    np.testing.assert_allclose(fast, plain, atol=0.1 * 0.13)


def test_lines_through_edges_and_corners_are_counted_once():
    # nodes in line with the corners, edges and faces of the mesh, where a line along x meets many triangles at once
    for shape in (box_mesh((1.0, 1.0, 1.0)), ellipsoid_mesh((1, 1, 1), 1)):
        found = mesh_distance(shape, 0.125, margin=0.5)
        nodes = found.grid.nodes()
        inside = np.sqrt((nodes**2).sum(-1)) < 0.49
        assert (found.distance[inside] < 0).all()
        outside = np.abs(nodes).max(axis=-1) > 1.01
        assert (found.distance[outside] > 0).all()


def test_the_distance_to_a_triangle_is_that_to_its_closest_point():
    rng = np.random.default_rng(1)
    for _ in range(50):
        triangle, point = rng.normal(size=(3, 3)), rng.normal(size=3)
        s, t = (g.ravel() for g in np.meshgrid(*[np.linspace(0, 1, 201)] * 2))
        s, t = s[s + t <= 1], t[s + t <= 1]
        sampled = triangle[0] + s[:, None] * (triangle[1] - triangle[0]) + t[:, None] * (triangle[2] - triangle[0])
        wanted = np.sqrt(((sampled - point) ** 2).sum(-1).min())
        found = np.sqrt(squared_distance_to_triangle(triangle, *point))
        # the samples lie up to half a 200th of an edge from the closest point
        assert found <= wanted + 1e-12 and wanted - found < 0.02
    needle = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert squared_distance_to_triangle(needle, 1.5, 1.0, 0.0) == pytest.approx(1.0)


def test_a_body_thinner_than_a_cell_is_reported():
    sheet = mesh_distance(box_mesh((1, 1, 0.04)), 0.025)
    assert "less than a cell (0.1 m)" in thin_warning("sheet", sheet, 0.1)
    assert thin_warning("sheet", sheet, 0.03) == ""


def test_a_spacing_far_too_fine_is_refused():
    with pytest.raises(ValueError, match="coarser"):
        mesh_distance(box_mesh((1, 1, 1)), 0.001)


def test_nodes_that_lie_in_a_plane_of_vertices_are_on_their_side():
    """The axis of a cylinder lies among the nodes, to rounding: dividing by the spacing must not leave lines out."""
    mesh = cylinder_mesh(0.064, 0.477)
    for share in np.linspace(0.2, 0.5, 16):
        found = mesh_distance(mesh, share * 0.0393517810518048, margin=1.5 * 0.0393517810518048)
        nodes = found.grid.nodes()
        away = np.hypot(nodes[..., 0], nodes[..., 1])
        assert (found.distance[(away < 0.06) & (np.abs(nodes[..., 2]) < 0.23)] < 0).all(), share
        assert (found.distance[(away > 0.068) | (np.abs(nodes[..., 2]) > 0.24)] > 0).all(), share
