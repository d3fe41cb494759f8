"""Light looked up in one array of pictures is that of the pictures."""

import numba as nb
import numpy as np

from fluidlift.look.environment_lookup import lookup_plain
from fluidlift.look.environment_stack import fading, place_of, stacked, value_at


@nb.njit
def looked_up(values, places, k, directions, out):
    for n in range(len(directions)):
        across, down = place_of(directions[n, 0], directions[n, 1], directions[n, 2])
        out[n] = value_at(values, places[k, 0], places[k, 1], across, down)


@nb.njit
def faded(x, out):
    for n in range(len(x)):
        out[n] = fading(x[n])


@nb.njit
def placed(directions, out):
    for n in range(len(directions)):
        out[n] = place_of(directions[n, 0], directions[n, 1], directions[n, 2])


def directions_and_axes():
    rng = np.random.default_rng(0)
    axes = [[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z]
    return np.concatenate([rng.normal(size=(2000, 3)), axes]).astype(np.float32)


def test_every_picture_of_a_stack_shows_what_it_shows_alone():
    rng = np.random.default_rng(1)
    pictures = [rng.uniform(0, 1, (h, 2 * h, 3)).astype(np.float32) for h in (16, 8, 32)]
    values, places = stacked(pictures)
    some = directions_and_axes()
    for k, picture in enumerate(pictures):
        out = np.empty_like(some)
        looked_up(values, places, k, some, out)
        # a place is good to 1e-6 of the picture, 6e-5 of its 64 columns, between which values differ by up to 1
        np.testing.assert_allclose(out, lookup_plain(picture, some), atol=2e-4)


def test_the_place_of_a_direction_is_its_angles():
    some = directions_and_axes()
    out = np.empty((len(some), 2), np.float32)
    placed(some, out)
    x, y, z = some.astype(np.float64).T
    across, down = np.arctan2(x, y) / (2 * np.pi) + 0.5, np.arctan2(np.hypot(x, y), z) / np.pi
    # the left and the right edge are one line; float32 at 1 is good to 6e-8, a few roundings
    assert np.abs((out[:, 0] - across + 0.5) % 1.0 - 0.5).max() < 1e-6
    assert np.abs(out[:, 1] - down).max() < 1e-6


def test_what_is_left_after_a_way_is_the_exponential():
    x = np.linspace(0.0, 80.0, 10001).astype(np.float32)
    out = np.empty_like(x)
    faded(x, out)
    # rounding of x / ln 2 to float32 alone is 6e-8 of up to 115
    np.testing.assert_allclose(out, np.exp(-x.astype(np.float64)), rtol=1e-5)
    assert out[0] == 1.0
    faded(np.full_like(x, 1e9), out)
    assert (out < 1e-37).all()
