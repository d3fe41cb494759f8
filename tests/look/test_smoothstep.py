"""The easing of edges."""

import numpy as np

from fluidlift.look.smoothstep import eased, smoothstep


def test_it_rises_from_nothing_to_all_without_a_kink_and_is_the_same_compiled():
    x = np.linspace(-1.0, 3.0, 401)
    y = smoothstep(x, 0.5, 1.5)
    assert (y[x <= 0.5] == 0).all() and (y[x >= 1.5] == 1).all() and (np.diff(y) >= 0).all()
    # level at both ends: the slope, 1.5 at most, changes by 6 times the step of 0.01 at most
    assert np.abs(np.diff(y, 2)).max() < 1.01 * 6.0 * 0.01**2
    np.testing.assert_allclose([eased(v) for v in x], smoothstep(x), rtol=1e-12)
