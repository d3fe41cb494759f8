"""A level set's surface is closed, turned outwards and has the right volume."""

import numpy as np
import pytest

from fluidlift.numerics.isosurface import surface_nets


def signed_volume(vertices, faces):
    a, b, c = (vertices[faces[:, i]].astype(float) for i in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_a_sphere_has_its_volume_and_its_normals_point_outwards():
    n, h = 33, 1 / 16
    x = (np.arange(n) - 16) * h
    field = np.sqrt(sum(g**2 for g in np.meshgrid(x, x, x, indexing="ij"))) - 0.8
    vertices, faces = surface_nets(field, spacing=h, origin=(-1, -1, -1))
    # surface nets smooth the surface by a share of a cell: 3 % at 13 cells of radius
    assert signed_volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.03)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.8).max() < 0.5 * h


def test_a_body_that_leaves_the_box_is_capped_watertight():
    z = np.meshgrid(np.arange(6), np.arange(5), np.arange(7), indexing="ij")[2]
    _, faces = surface_nets(z - 2.5)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert (uses % 2 == 0).all()


def test_no_sign_change_gives_no_surface():
    vertices, faces = surface_nets(np.ones((4, 4, 4)))
    assert len(vertices) == 0 and len(faces) == 0
