"""A pattern goes on beyond its ends as in a mirror: without a jump, with all of its points, and as it moves."""

import numpy as np
import pytest

from fluidlift.numerics.mirror import MirroredPoints, folded

ALONG = np.array([1.0, 0.0, 0.0])


def flat(y):
    return np.zeros(len(y))


def carpet(step=0.1, size=(4.0, 2.0)):
    """One point in each square of the plane z = 0; y is not at a border of rows, which lie half a square apart."""
    x, y = np.meshgrid(np.arange(0.5, size[0] / step) * step, np.arange(0.4, size[1] / step) * step, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def test_folding_turns_back_at_both_ends():
    inside, turned = folded(np.array([-0.25, 0.25, 1.25, 2.25, 3.75]), 0.0, 1.0)
    np.testing.assert_allclose(inside, [0.25, 0.25, 0.75, 0.25, 0.25], atol=1e-12)
    assert turned.tolist() == [True, False, True, False, True]


def test_inside_the_pattern_is_the_pattern():
    points = carpet()
    at = MirroredPoints(points, ALONG, 0.1, flat)
    places = points[200:230]
    found = at.around(places)
    np.testing.assert_array_equal(np.sort(found.place), np.arange(30))  # one point in each box
    np.testing.assert_allclose(places[found.place] + found.offset, points[found.point], atol=1e-12)


def test_before_its_beginning_stands_its_mirror_image():
    points = carpet()
    points[:, 0] += 0.02 * np.sin(40 * points[:, 1])  # asymmetric, so that a copy that is not turned would show
    at = MirroredPoints(points, ALONG, 0.1, flat)
    places = carpet(size=(1.0, 2.0)) - np.array([1.0, 0.0, 0.0])
    found = at.around(places)
    copies = places[found.place] + found.offset
    row = np.round(points[:, 1] / 0.1).astype(int)
    first = np.array([points[row == r, 0].min() for r in row[found.point]])  # each row has its own beginning
    inside = (copies[:, 1] > 0.1) & (copies[:, 1] < 1.9)  # rows at the rim may share one
    images = points[found.point]
    images[:, 0] = 2 * first - images[:, 0]
    np.testing.assert_allclose(copies[inside], images[inside], atol=1e-9)


def test_a_slanting_edge_is_continued_row_by_row():
    points = carpet()
    seen = points[points[:, 0] > 0.5 + points[:, 1] * 0.5]
    at = MirroredPoints(seen, ALONG, 0.1, flat)
    place = np.array([[0.85, 1.04, 0.0], [0.35, 0.14, 0.0]])
    beginning = np.array([seen[np.abs(seen[:, 1] - y) < 0.01, 0].min() for y in place[:, 1]])
    image = seen[at.nearest(place)]
    # rows are 0.1 wide and points stand 0.1 apart
    np.testing.assert_allclose(image[:, 0], 2 * beginning - place[:, 0], atol=0.1)
    np.testing.assert_allclose(image[:, 1], place[:, 1], atol=0.1)


def test_the_pattern_moves_on_without_a_jump():
    at = MirroredPoints(carpet(), ALONG, 0.1, flat)
    x = np.array([carpet()[at.nearest(np.array([[0.05, 1.04, 0.0]]), run)[0], 0] for run in np.arange(0.0, 12.0, 0.04)])
    assert np.abs(np.diff(x)).max() <= 0.1 + 1e-9  # a point at a time
    assert x.min() < 0.1 and x.max() > 3.9  # all of it comes in


def test_places_keep_their_depth_below_a_sloping_surface():
    def level(xy):
        return -0.2 * xy[:, 0]

    points = carpet()
    points[:, 2] = level(points)
    at = MirroredPoints(points, ALONG, 0.1, level)
    found = at.around(np.array([[-1.04, 1.04, 0.21], [-1.04, 1.04, -0.79]]))
    assert 0 in found.place  # 0.21 is the surface there
    assert found.offset[found.place == 0, 2] == pytest.approx(0.0, abs=0.03)  # the slope over a spacing
    assert 1 not in found.place  # a metre below it there is nothing


def test_a_hole_is_filled_from_elsewhere():
    points = carpet()
    hole = np.linalg.norm(points[:, :2] - [1.0, 1.0], axis=1) < 0.4
    at = MirroredPoints(points[~hole], ALONG, 0.1, flat)
    places = np.stack([-points[hole, 0], points[hole, 1], np.zeros(hole.sum())], axis=1)  # whose images fall into it
    assert len(np.unique(at.around(places).place)) > 0.9 * hole.sum()


@pytest.mark.parametrize(("points", "spacing"), [(np.zeros((0, 3)), 0.1), (carpet(), 0.0), (carpet(), np.nan)])
def test_a_pattern_that_is_none_is_refused(points, spacing):
    with pytest.raises(ValueError):
        MirroredPoints(points, ALONG, spacing)
