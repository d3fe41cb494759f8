"""How people film what lies: over a landscape, or down on it. The prior of the camera's pitch, in one place.

Over a landscape the camera looks near the horizon, the water runs out of the picture at its sides or below, and its far
shore is seen not far below the horizon. What is looked down on (a vessel, a table, a river from a bridge or a drone) is
seen at any steeper angle, and nothing is known of its far edge but that it lies below the horizon.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.shape.view.horizon import AMISS, MISTAKEN

OVER = (10.0, 9.0)
"""degrees, mean and standard deviation of the pitch over a landscape. By the horizon or the far shore of 14 real clips,
read by hand, one of them surveyed: 2 to 29, mean 10, deviation 9"""
DOWN = (48.0, 18.0)
"""the same of what is looked down on: 25 to 88 of eight real and made ones"""
OVER_SHARE = 0.65
"""share of clips of a lying fluid that are filmed over a landscape (14 of 22)"""
OPEN_OVER, OPEN_DOWN = 0.9, 0.5
"""share of each whose fluid runs out of the picture at its sides or below (12 of 14; 4 of 8)"""
SKY_OVER, SKY_DOWN = 0.4, 0.05
"""share of each that is taken to show sky as one surface (6 of 14; 1 of 18, by mistake)"""
FAR_SHORE = (3.0, 1.1)
"""degrees and standard deviation of its logarithm: how far below the horizon the farthest water of a landscape is seen.
Half of all are between 1.4 and 6.3: a man (1.6 m) sees the far end of 15 to 65 m of water so. By hand, on 14 real clips:
0 to 10, median 2"""

_MEAN = OVER_SHARE * OVER[0] + (1.0 - OVER_SHARE) * DOWN[0]
USUAL_PITCH = (
    _MEAN,
    float(np.sqrt(sum(w * (s**2 + (m - _MEAN) ** 2) for w, (m, s) in ((OVER_SHARE, OVER), (1.0 - OVER_SHARE, DOWN))))),
)
"""degrees, mean and standard deviation of both together, where nothing is known yet"""


def habit(
    pitches: Float[np.ndarray, " p"], below: Float[np.ndarray, "p ..."] | None, *, open_ended: bool, sky: bool
) -> Float[np.ndarray, "p ..."]:
    """Log prior of the pitch of a camera over what lies, with what its upper outline says.

    Args:
        pitches: degrees.
        below: degrees that the farthest fluid is seen below its plane's vanishing line; None: not known.
        open_ended: whether the fluid runs out of the picture at its sides or below.
        sky: whether sky is seen.
    """
    shape = (len(pitches),) + (1,) * (0 if below is None else below.ndim - 1)
    at = pitches.reshape(shape)
    both = []
    for (mean, spread), share, ends, seen in (
        (OVER, OVER_SHARE, OPEN_OVER, SKY_OVER), (DOWN, 1.0 - OVER_SHARE, OPEN_DOWN, SKY_DOWN),
    ):  # fmt: skip
        log = -0.5 * ((at - mean) / spread) ** 2 - np.log(spread) + np.log(share)
        both.append(log + np.log(ends if open_ended else 1.0 - ends) + np.log(seen if sky else 1.0 - seen))
    if below is not None:
        median, spread = FAR_SHORE
        amiss = -0.5 * (np.minimum(below, 0.0) / AMISS) ** 2
        seen_at = np.maximum(below, 0.5)
        shore = amiss - 0.5 * (np.log(seen_at / median) / spread) ** 2 - np.log(seen_at * spread * np.sqrt(2.0 * np.pi))
        for k, log in enumerate((shore, amiss - np.log(90.0))):
            both[k] = both[k] + np.logaddexp(np.log1p(-MISTAKEN) + log, np.log(MISTAKEN / 90.0))
    return np.logaddexp(*both)


def runs_out(mask: Bool[np.ndarray, "h w"]) -> bool:
    """Whether a fluid meets the sides or the lower edge of the picture along a tenth of one of them."""
    return any(bool(edge.mean() > 0.1) for edge in (mask[:, 0], mask[:, -1], mask[-1]))
