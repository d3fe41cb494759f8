"""Homographies of a camera that turns."""

import cv2
import numpy as np
import pytest

from fluidlift.numerics.homography2 import carried, drawn_back, scaled, turn_rates, turned

MIDDLE = np.array([159.5, 119.5])
POINTS = np.array([[0.0, 0.0], [319.0, 0.0], [40.0, 200.0], [159.5, 119.5], [300.0, 239.0]])


def rotated(degrees: tuple[float, float, float], focal: float) -> np.ndarray:
    """K R K^-1 of a camera with its principal point in the middle."""
    camera = np.array([[focal, 0.0, MIDDLE[0]], [0.0, focal, MIDDLE[1]], [0.0, 0.0, 1.0]])
    turn = cv2.Rodrigues(np.radians(degrees))[0]
    return camera @ turn @ np.linalg.inv(camera)


@pytest.mark.parametrize("degrees", [(5.0, 0.0, 0.0), (0.0, -4.0, 0.0), (3.0, 2.0, 1.0)])
def test_a_turn_is_that_of_a_camera(degrees):
    focal = 300.0
    about_x, about_y, about_z = np.radians(degrees)
    step = np.array([focal * about_y, -focal * about_x, 0.0, about_z])
    there = carried(turned(step, focal**-2, MIDDLE), POINTS)
    assert there == pytest.approx(carried(rotated(degrees, focal), POINTS), abs=1e-9)  # exact, but for rounding


def test_without_perspective_it_is_a_similarity():
    motion = turned(np.array([3.0, -2.0, np.log(1.1), 0.2]), 0.0, MIDDLE)
    turn = 1.1 * np.array([[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]])
    assert motion[2] == pytest.approx([0.0, 0.0, 1.0]) and motion[:2, :2] == pytest.approx(turn)


def test_the_rates_are_the_derivatives_of_a_turn():
    perspective, small = 300.0**-2, 1e-4
    rates = turn_rates(POINTS - MIDDLE, perspective)
    for part, rate in zip(np.eye(4), rates, strict=True):
        ahead = carried(turned(small * part, perspective, MIDDLE), POINTS)
        back = carried(turned(-small * part, perspective, MIDDLE), POINTS)
        assert rate.T == pytest.approx((ahead - back) / (2 * small), abs=1e-4)


def test_a_homography_of_a_smaller_picture_does_the_same_there():
    motion = turned(np.array([9.0, 4.0, 0.02, 0.01]), 300.0**-2, MIDDLE)
    half = scaled(motion, 0.5)
    assert carried(half, 0.5 * POINTS - 0.25) == pytest.approx(0.5 * carried(motion, POINTS) - 0.25)


def test_a_picture_is_drawn_back_by_both_ways_alike():
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)).astype(np.float32), (0, 0), 2.0)
    similarity = turned(np.array([2.3, -1.2, 0.0, 0.01]), 0.0, MIDDLE)
    hardly = similarity.copy()
    hardly[2, 0] = 1e-12
    one, other = (drawn_back(picture, m, (320, 240), interpolation=cv2.INTER_CUBIC) for m in (similarity, hardly))
    # OpenCV places pixels to 1/32 px, and the two of its ways need not round alike: a slope of 10 levels, a step each
    assert np.abs(one - other)[4:-4, 4:-4].max() < 2 * 10.0 / 32.0 * 2


def test_a_perspective_below_nought_is_an_error():
    with pytest.raises(ValueError, match="perspective"):
        turned(np.zeros(4), -1.0, MIDDLE)
