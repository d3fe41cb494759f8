"""Normals of vertices are the mean of the faces around, by area."""

import numpy as np

from fluidlift.numerics.mesh_normals import vertex_normals
from fluidlift.numerics.solid_mesh import ellipsoid_mesh
from fluidlift.types import TriangleMesh


def test_the_normals_of_a_ball_point_outwards():
    ball = ellipsoid_mesh((1.0, 1.0, 1.0))
    outwards = ball.vertices / np.linalg.norm(ball.vertices, axis=1, keepdims=True)
    # faces of a few degrees each: their mean is off by much less
    assert (vertex_normals(ball) * outwards).sum(axis=1).min() > 0.999


def test_a_large_face_counts_more_than_a_small_one():
    vertices = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 1, 0], [0, 0, 1.0]])
    normal = vertex_normals(TriangleMesh(vertices, np.array([[0, 1, 2], [0, 3, 4]])))[0]
    np.testing.assert_allclose(normal, np.array([1.0, 0, 100.0]) / np.hypot(1, 100), rtol=1e-12)


def test_a_vertex_without_faces_has_what_is_asked_for():
    lone = TriangleMesh(np.zeros((1, 3)), np.zeros((0, 3), int))
    np.testing.assert_array_equal(vertex_normals(lone, otherwise=(0.0, 1.0, 0.0)), [[0, 1, 0]])
