"""The made pour: its masks are those of its pictures, and its fluid falls and heaps up."""

import numpy as np
import pytest

from fluidlift.synthetic.hand_pour import hand_pour


def test_the_same_seed_gives_the_same_clip_and_another_gives_another():
    first, again, other = hand_pour(3, frames=4), hand_pour(3, frames=4), hand_pour(4, frames=4)
    assert np.array_equal(first.frames, again.frames) and np.array_equal(first.fluid, again.fluid)
    assert not np.array_equal(first.frames, other.frames)


@pytest.mark.parametrize("seed", [0, 7])
def test_nothing_is_both_fluid_and_carried_and_all_else_stands_still(seed):
    pour = hand_pour(seed, frames=12)
    assert not (pour.fluid & pour.carried).any()
    elsewhere = ~(pour.fluid | pour.carried).any(axis=0)
    elsewhere[1:] &= elsewhere[:-1]
    change = np.abs(np.diff(pour.frames.astype(float), axis=0)).mean(axis=(0, 3))
    # two draws of noise of 1.5 differ by 1.7 in the mean; outlines are mixed within a pixel or two
    assert np.median(change[elsewhere]) < 2.0 < np.median(change[pour.fluid.all(axis=0)])


def test_the_heap_grows_and_the_jet_starts_at_the_spout_in_every_frame():
    pour = hand_pour(1)
    area = pour.fluid.sum(axis=(1, 2))
    low = np.flatnonzero(pour.fluid[0].any(axis=1)).max()
    heaps = pour.fluid[:, low - 4 : low + 1].sum(axis=(1, 2))
    assert heaps[-1] > 1.2 * heaps[0] and (area > 0).all()
    for fluid, carried in zip(pour.fluid, pour.carried, strict=True):
        top = np.argwhere(fluid)[0]
        near = carried[top[0] - 4 : top[0] + 5, top[1] - 6 : top[1] + 7]
        assert near.any()
