"""Rotations, rigid motions and similarities form groups, and quaternions say the same as matrices."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fluidlift.types import RigidTransform, Similarity3, matrix_from_quat, quat_from_matrix

# double precision; products of a few rotations of unit entries lose a few units in the last place
TIGHT = 1e-12

quats = arrays(np.float64, 4, elements=st.floats(-1, 1)).filter(lambda q: np.linalg.norm(q) > 0.1)
offsets = arrays(np.float64, 3, elements=st.floats(-100, 100))
points = arrays(np.float64, (5, 3), elements=st.floats(-100, 100))
scales = st.floats(0.01, 100)


@st.composite
def rigid(draw):
    return RigidTransform(matrix_from_quat(draw(quats)), draw(offsets))


@st.composite
def similarities(draw):
    return Similarity3(draw(scales), matrix_from_quat(draw(quats)), draw(offsets))


def about(axis, degrees):
    """Rotation matrix by Rodrigues' formula, written independently of quaternions."""
    k = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    a = np.radians(degrees)
    return np.eye(3) + np.sin(a) * cross + (1 - np.cos(a)) * cross @ cross


# quaternions ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("axis", "degrees", "largest"),
    [
        ((1, 2, 3), 0, 0), ((1, 2, 3), 60, 0),
        ((1, 0, 0), 180, 1), ((1, 0.1, 0.2), 179, 1),
        ((0, 1, 0), 180, 2), ((0.1, 1, 0.2), 179, 2),
        ((0, 0, 1), 180, 3), ((0.1, 0.2, 1), 179, 3),
        ((1, 1, 1), 120, None), ((1, 1, 0), 180, None),  # ties between branches
    ],
)  # fmt: skip
def test_a_matrix_survives_the_way_over_its_quaternion_on_every_branch(axis, degrees, largest):
    m = about(axis, degrees)
    q = quat_from_matrix(m)
    if largest is not None:  # the branch that this case is about is really taken
        assert np.argmax(np.abs(q)) == largest
    np.testing.assert_allclose(matrix_from_quat(q), m, atol=TIGHT)


def test_a_quaternion_is_half_the_angle_about_its_axis():
    q = quat_from_matrix(about((0, 0, 1), 90))
    np.testing.assert_allclose(q, [np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)], atol=TIGHT)  # w x y z


@given(quats)
def test_a_quaternion_survives_the_way_over_its_matrix_up_to_its_sign(q):
    q = q / np.linalg.norm(q)
    back = quat_from_matrix(matrix_from_quat(q))
    assert back[0] >= 0
    assert np.linalg.norm(back) == pytest.approx(1, abs=TIGHT)
    assert abs(back @ q) == pytest.approx(1, abs=TIGHT)


@given(quats)
def test_every_quaternion_gives_a_proper_rotation(q):
    m = matrix_from_quat(q)
    np.testing.assert_allclose(m @ m.T, np.eye(3), atol=TIGHT)
    assert np.linalg.det(m) == pytest.approx(1, abs=TIGHT)


def test_many_quaternions_convert_as_each_alone():
    q = np.random.default_rng(0).normal(size=(2, 7, 4))
    m = matrix_from_quat(q)
    assert m.shape == (2, 7, 3, 3)
    np.testing.assert_allclose(m[1, 3], matrix_from_quat(q[1, 3]))
    np.testing.assert_allclose(quat_from_matrix(m)[1, 3], quat_from_matrix(m[1, 3]))


def test_single_precision_stays_single_and_accurate():
    m = np.stack([about(axis, a) for axis in np.eye(3) for a in (0.01, 90, 179.99)]).astype(np.float32)
    q = quat_from_matrix(m)
    assert q.dtype == np.float32
    np.testing.assert_allclose(matrix_from_quat(q), m, atol=1e-6)  # a few float32 roundings of numbers up to 1


# rigid motions and similarities -----------------------------------------------------------------------------------


@given(rigid(), points)
def test_a_rigid_motion_keeps_distances_and_can_be_undone(t, x):
    moved = t.points(x)
    np.testing.assert_allclose(
        np.linalg.norm(moved[1:] - moved[0], axis=1), np.linalg.norm(x[1:] - x[0], axis=1), atol=1e-10
    )
    # positions of some hundred units in double precision
    np.testing.assert_allclose(t.inverse().points(moved), x, atol=1e-10)


@given(rigid(), rigid(), points)
def test_rigid_motions_compose_like_cancelling_units(a_from_b, b_from_c, x):
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).points(x), a_from_b.points(b_from_c.points(x)), atol=1e-10
    )  # fmt: skip


@settings(max_examples=60)
@given(similarities(), similarities(), points)
def test_similarities_compose_like_cancelling_units(a_from_b, b_from_c, x):
    size = 100 * a_from_b.scale * (1 + b_from_c.scale) + 100  # largest number that occurs on the way
    np.testing.assert_allclose(
        (a_from_b @ b_from_c).points(x), a_from_b.points(b_from_c.points(x)), atol=1e-13 * size * 10
    )  # fmt: skip


@settings(max_examples=60)
@given(similarities(), points)
def test_a_similarity_times_its_inverse_does_nothing(t, x):
    size = 100 * (1 + 1 / t.scale)
    np.testing.assert_allclose(t.inverse().points(t.points(x)), x, atol=1e-13 * size * 10)
    one = t @ t.inverse()
    assert one.scale == pytest.approx(1, rel=TIGHT)
    np.testing.assert_allclose(one.rotation, np.eye(3), atol=TIGHT)
    np.testing.assert_allclose(one.translation, 0, atol=1e-13 * size * 1000)


@given(similarities(), points)
def test_vectors_are_differences_of_points(t, x):
    # the translation of up to 100 cancels in the difference
    np.testing.assert_allclose(t.vectors(x[1:] - x[0]), t.points(x[1:]) - t.points(x[0]), atol=1e-10 * (1 + t.scale))


@given(similarities(), quats)
def test_orientations_turn_with_the_body(t, q):
    np.testing.assert_allclose(matrix_from_quat(t.quats(q)), t.rotation @ matrix_from_quat(q), atol=1e-11)


def test_second_moments_are_those_of_the_moved_points():
    rng = np.random.default_rng(1)
    t = Similarity3(2.5, about((1, -2, 0.5), 73), np.array([1.0, 2, 3]))
    x = rng.normal(size=(50, 3)) * [1, 2, 3]
    np.testing.assert_allclose(t.covariances(np.cov(x.T)), np.cov(t.points(x).T), rtol=1e-10, atol=1e-12)


# what is refused ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "rotation",
    [np.diag([1.0, 1, -1]), 2 * np.eye(3), np.ones((3, 3)), np.full((3, 3), np.nan), np.eye(2)],
    ids=["mirror", "scaling", "singular", "nan", "2d"],
)
def test_what_is_no_rotation_is_refused(rotation):
    with pytest.raises(ValueError):
        RigidTransform(rotation, np.zeros(3))
    with pytest.raises(ValueError):
        Similarity3(1.0, rotation, np.zeros(3))


@pytest.mark.parametrize("scale", [0.0, -1.0, np.inf, np.nan])
def test_a_scale_is_positive_and_finite(scale):
    with pytest.raises(ValueError, match="scale"):
        Similarity3(scale)


@pytest.mark.parametrize("number", [np.float32, np.float64])
def test_many_points_and_vectors_are_those_of_the_plain_formula_in_rows(number):
    rng = np.random.default_rng(0)
    rotation = matrix_from_quat(rng.normal(size=4))
    rigid, alike = RigidTransform(rotation, rng.normal(size=3)), Similarity3(1.7, rotation, rng.normal(size=3))
    x = rng.normal(size=(4, 5, 3)).astype(number)
    for t, scale in ((rigid, 1.0), (alike, 1.7)):
        turned = scale * np.einsum("ij,...j->...i", rotation, x.astype(np.float64))
        np.testing.assert_allclose(t.vectors(x), turned, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(t.points(x), turned + t.translation, rtol=1e-12, atol=1e-12)
        assert t.points(x).flags.c_contiguous and t.vectors(x).flags.c_contiguous
        assert t.points(x).dtype == t.vectors(x).dtype == np.float64
    np.testing.assert_array_equal(rigid.coordinates(x), rigid.points(x).reshape(-1, 3).T)
