"""Light comes to a display without clipping and without changes of hue."""

import numpy as np

from fluidlift.look.display import KNEE, displayed


def test_what_a_display_can_show_stays_itself():
    light = np.random.default_rng(0).uniform(0, KNEE, (50, 3))
    np.testing.assert_allclose(displayed(light), light, rtol=1e-6)


def test_brighter_light_stays_brighter_and_below_one():
    ramp = np.linspace(0, 50, 2001)[:, None] * np.array([1.0, 0.5, 0.1])
    shown = displayed(ramp)
    assert shown.max() < 1.0
    assert (np.diff(shown[:, 0]) > 0).all()
    # smooth at the knee: the slope before and after it differ by no more than the bend over two steps
    slope = np.diff(displayed(np.linspace(KNEE - 0.01, KNEE + 0.01, 21)[:, None] * np.ones(3))[:, 0]) / 0.001
    assert np.abs(np.diff(slope)).max() < 0.02


def test_hue_is_kept_up_to_the_knee_and_turns_towards_white_above_it():
    lava = np.array([1.0, 0.25, 0.04])
    moderate = displayed(KNEE * lava[None])[0]
    np.testing.assert_allclose(moderate, KNEE * lava, rtol=1e-6)
    # like film: the brighter, the paler, without ever changing which channel is the brightest
    shown = displayed(np.geomspace(KNEE, 200, 50)[:, None] * lava)
    assert (np.diff(shown[:, 1] / shown[:, 0]) > 0).all()
    assert (shown[:, 0] > shown[:, 1]).all() and (shown[:, 1] > shown[:, 2]).all()
    white = displayed(np.full((1, 3), 7.0))[0]
    assert np.ptp(white) == 0


def test_exposure_counts_in_stops():
    np.testing.assert_allclose(displayed(np.full((1, 3), 0.1), exposure=2.0), 0.4, rtol=1e-6)
