import numpy as np

from fluidlift.synthetic.vessels import filmed_vessel

SMALL = {"frames": 4, "size": (120, 90)}


def test_a_clip_follows_from_its_seed():
    first, again, other = (filmed_vessel(seed, "fill", **SMALL) for seed in (1, 1, 2))
    assert np.array_equal(first.frames, again.frames)
    assert not np.array_equal(first.frames, other.frames)


def test_the_level_of_a_pour_rises_and_an_empty_vessel_has_none():
    rows = [np.flatnonzero(m.any(axis=1))[0] for m in filmed_vessel(1, "fill", **SMALL).contents]
    assert rows[-1] < rows[0]
    assert not filmed_vessel(1, "empty", **SMALL).fluid.any()
    beside = filmed_vessel(1, "beside", **SMALL)
    assert beside.fluid.any() and not beside.contents.any()


def test_what_floats_is_no_fluid():
    made = filmed_vessel(1, "boil", pieces=True, **SMALL)
    assert made.floating.any()
    assert not (made.floating & made.fluid).any()
