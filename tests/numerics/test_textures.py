"""Colours of a picture at texture coordinates."""

import numpy as np

from fluidlift.numerics.textures import sample_texture

PICTURE = np.arange(24, dtype=np.uint8).reshape(2, 4, 3) * 10


def test_the_middle_of_a_texel_has_its_colour():
    col, row = np.meshgrid(np.arange(4), np.arange(2))
    uv = np.stack([(col + 0.5) / 4, (row + 0.5) / 2], axis=-1)
    np.testing.assert_allclose(sample_texture(PICTURE, uv), PICTURE / 255.0, atol=1e-6)  # single precision


def test_between_texels_colours_are_mixed_and_beyond_them_the_rim_goes_on():
    mixed = 0.25 * (PICTURE[0, 0] + 0.0 + PICTURE[0, 1] + PICTURE[1, 0] + PICTURE[1, 1]) / 255.0
    np.testing.assert_allclose(sample_texture(PICTURE, np.array([0.25, 0.5])), mixed, atol=1e-6)
    np.testing.assert_allclose(sample_texture(PICTURE, np.array([[0.0, 0.0]]))[0], PICTURE[0, 0] / 255.0, atol=1e-6)
    np.testing.assert_allclose(sample_texture(PICTURE, np.array([1.0, 1.0])), PICTURE[1, 3] / 255.0, atol=1e-6)


def test_a_texture_of_one_texel_is_one_colour():
    one = np.full((1, 1, 3), 51, np.uint8)
    np.testing.assert_allclose(sample_texture(one, np.array([[0.1, 0.9], [0.5, 0.5]])), 0.2, atol=1e-6)
