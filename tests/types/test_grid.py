"""The staggered grid: where cells, nodes and faces are, and which cell holds a point."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluidlift.types import FaceVelocity, Grid, Terrain, TriangleMesh

GRID = Grid((4, 3, 2), 0.5, (1.0, -2.0, 0.25))


def test_every_cell_centre_lies_in_its_own_cell():
    index = np.stack(np.meshgrid(*(np.arange(n) for n in GRID.shape), indexing="ij"), -1)
    np.testing.assert_array_equal(GRID.cell_of(GRID.centers()), index)


@given(st.tuples(st.integers(0, 3), st.integers(0, 2), st.integers(0, 1)), st.tuples(*[st.floats(0.01, 0.99)] * 3))
def test_a_point_belongs_to_the_cell_whose_low_corner_is_just_below_it(cell, share):
    point = GRID.low + (np.array(cell) + share) * GRID.spacing
    np.testing.assert_array_equal(GRID.cell_of(point[None])[0], cell)


def test_points_outside_have_indices_outside():
    outside = np.stack([GRID.low - 0.01, GRID.high + 0.01])
    np.testing.assert_array_equal(GRID.cell_of(outside), [[-1, -1, -1], GRID.shape])
    assert not GRID.contains(outside).any()


def test_the_box_holds_its_low_side_and_not_its_high_side():
    np.testing.assert_array_equal(GRID.contains(np.stack([GRID.low, GRID.high])), [True, False])
    assert GRID.contains(GRID.centers()).all()
    assert not GRID.contains(GRID.centers(), margin=0.26)[0].any()  # centres of the first layer are 0.25 m inside


def test_nodes_span_the_box_and_centres_lie_between_them():
    nodes = GRID.nodes()
    assert nodes.shape == (5, 4, 3, 3)
    np.testing.assert_allclose(nodes[0, 0, 0], GRID.low)
    np.testing.assert_allclose(nodes[-1, -1, -1], GRID.high)
    np.testing.assert_allclose(GRID.centers(), 0.5 * (nodes[1:, 1:, 1:] + nodes[:-1, :-1, :-1]))
    assert GRID.cells == 24


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_faces_lie_between_neighbouring_centres(axis):
    faces = GRID.faces(axis)
    assert faces.shape[:3] == GRID.face_shape(axis)
    centers = GRID.centers()
    inner = np.take(faces, range(1, GRID.shape[axis]), axis=axis)
    left = np.take(centers, range(GRID.shape[axis] - 1), axis=axis)
    right = np.take(centers, range(1, GRID.shape[axis]), axis=axis)
    np.testing.assert_allclose(inner, 0.5 * (left + right))
    np.testing.assert_allclose(np.take(faces, 0, axis=axis)[..., axis], GRID.low[axis])
    np.testing.assert_allclose(np.take(faces, -1, axis=axis)[..., axis], GRID.high[axis])


def test_a_grid_is_a_value():
    same = Grid([4, 3, 2], 0.5, np.array([1.0, -2.0, 0.25]))
    assert same == GRID and hash(same) == hash(GRID)


@pytest.mark.parametrize(
    "fields", [((0, 3, 2), 0.5), ((4, 3), 0.5), ((4, 3, 2), 0.0), ((4, 3, 2), -1), ((4, 3, 2), np.nan)]
)
def test_impossible_grids_are_refused(fields):
    with pytest.raises(ValueError, match="grid"):
        Grid(*fields)


# velocity on faces ----------------------------------------------------------------------------------------------


def test_a_fluid_at_rest_has_zeros_of_the_right_shape():
    v = FaceVelocity.zeros(GRID)
    assert v.shape == GRID.shape
    assert [c.shape for c in v.components] == [GRID.face_shape(a) for a in range(3)]
    assert all((c == 0).all() and c.dtype == np.float32 for c in v.components)


def test_a_linear_velocity_is_exact_at_the_centres():
    gradient = np.array([[1.0, 2, 3], [-1, 0.5, 0], [0.1, 0.2, -1.5]])
    components = [GRID.faces(a) @ gradient[a] for a in range(3)]
    # the mean of two opposite faces is exact for a linear field; double precision
    np.testing.assert_allclose(FaceVelocity(*components).at_centers(), GRID.centers() @ gradient.T, atol=1e-12)


def test_faces_of_different_grids_do_not_mix():
    u, v, w = FaceVelocity.zeros(GRID).components
    with pytest.raises(ValueError, match="face arrays"):
        FaceVelocity(u, w, v)
    with pytest.raises(ValueError, match="face arrays"):
        FaceVelocity(u[1:], v, w)


def test_terrain_has_one_distance_per_node():
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    Terrain(GRID, np.zeros((5, 4, 3)), np.array([1.0, 0, 0]), mesh)
    with pytest.raises(ValueError, match="signed distance"):
        Terrain(GRID, np.zeros(GRID.shape), np.array([1.0, 0, 0]), mesh)


def test_a_mesh_consists_of_triangles_in_space():
    with pytest.raises(ValueError, match="vertices"):
        TriangleMesh(np.zeros((4, 2)), np.zeros((1, 3), int))
    with pytest.raises(ValueError, match="faces"):
        TriangleMesh(np.zeros((4, 3)), np.zeros((1, 4), int))
