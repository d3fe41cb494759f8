"""The grain of unseen ground: as lively as what was seen, from random places of it, the same each time."""

import numpy as np
import pytest
from scipy import ndimage

from fluidlift.shape.texture_grain import grain

H, W = 120, 200


def gravel():
    """A texture with stones of 3 texels, of which a band was seen; its local mean."""
    noise = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(H, W)), 1.5)
    image = (110.0 + 12.0 * noise / noise.std())[..., None] * np.array([1.0, 0.8, 0.5])
    seen = np.zeros((H, W), bool)
    seen[:40] = True
    mean = np.broadcast_to(image[seen].mean(axis=0), image.shape)
    return image.astype(np.float32), mean.astype(np.float32), seen


def test_what_is_added_is_as_lively_as_what_was_seen_and_has_no_mean():
    image, mean, seen = gravel()
    found = grain(image, mean, seen)
    own = (image - mean)[seen]
    new = found[60:]
    # pieces are independent, so that the variance is kept; a plain mean of four of them would have half the deviation
    assert new[..., 0].std() == pytest.approx(own[:, 0].std(), rel=0.2)
    assert abs(new[..., 0].mean()) < 0.25 * own[:, 0].std()
    # and stones are about as large: neighbours are nearly as like each other, in spite of the slopes of the weights
    alike = [np.corrcoef(a[:, :-2].ravel(), a[:, 2:].ravel())[0, 1] for a in (new[..., 0], (image - mean)[:40, :, 0])]
    assert alike[0] == pytest.approx(alike[1], abs=0.2)


def test_it_is_the_same_each_time_and_of_too_little_there_is_none():
    image, mean, seen = gravel()
    np.testing.assert_array_equal(grain(image, mean, seen), grain(image, mean, seen))
    few = np.zeros_like(seen)
    few[:4, :4] = True
    assert not grain(image, mean, few).any() and not grain(image, mean, np.zeros_like(seen)).any()
    assert not grain(image[:6, :6], mean[:6, :6], seen[:6, :6]).any()
