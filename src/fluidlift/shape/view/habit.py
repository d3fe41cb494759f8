"""How people film what lies: over a landscape, or down on it. The prior of the camera's pitch, in one place.

Over a landscape the camera looks near the horizon, the water runs out of the picture at its sides or below, and its far
shore is seen not far below the horizon. What is looked down on (a vessel, a table, a river from a bridge or a drone) is
seen at any steeper angle, it is often round and whole in the picture, and nothing is known of its far edge but that it
lies below the horizon. The shares are counts over real clips and made ones, one added to each side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import logsumexp

from fluidlift.shape.view.horizon import AMISS, MISTAKEN
from fluidlift.types import FluidKind

OPEN_OVER, OPEN_DOWN = 0.81, 0.5
"""share of each whose fluid runs out of the picture at its sides or below (12 of 14; 4 of 8)"""
SKY_OVER, SKY_DOWN = 0.44, 0.1
"""share of each that is taken to show sky as one surface (6 of 14; 1 of 18, by mistake)"""
ROUND_OVER, ROUND_DOWN, ROUND_VESSEL = 0.06, 0.36, 0.7
"""share of each in which a round pool or the rim of a vessel is found (0 of 14; 3 of 9), and of those that look down on
what falls into a vessel (3 of 4; 4 of 6 with one added)"""
ROLL = 2.5
"""degrees, standard deviation of how far people hold a camera off the level"""
FAR_SHORE = (3.0, 1.1)
"""degrees, and standard deviation of its logarithm: how far below the horizon the farthest water of a landscape is.
Half of all are between 1.4 and 6.3: a man (1.6 m) sees the far end of 15 to 65 m of water so. By hand, on 14 real
clips: 0 to 10, median 2"""


@dataclass(frozen=True)
class ViewContext:
    """What tells the two habits apart; None: not known."""

    open_ended: bool | None = None
    """the fluid runs out of the picture at its sides or below"""
    sky: bool | None = None
    """sky is seen"""
    round: bool | None = None
    """a round pool or the rim of a vessel is seen"""


def habit_prior(
    kind: FluidKind,
    pitches: Float[np.ndarray, " p"],
    scene: ViewContext,
    below: Float[np.ndarray, "p ..."] | None = None,
) -> Float[np.ndarray, "p ..."]:
    """Log prior of the pitch of a camera, with what the scene says of the habit.

    Args:
        kind: of the fluid.
        pitches: degrees.
        scene: what is seen.
        below: degrees that the farthest fluid is seen below its plane's vanishing line; None: not known.
    """
    at = pitches.reshape(len(pitches), *(1,) * (0 if below is None else below.ndim - 1))
    logs = [np.log(w / s) - 0.5 * ((at - m) / s) ** 2 for w, m, s in kind.pitch_habits]
    rounds = ROUND_VESSEL if kind.fills_vessel else ROUND_DOWN
    for over, down, seen in (
        (OPEN_OVER, OPEN_DOWN, scene.open_ended), (SKY_OVER, SKY_DOWN, scene.sky), (ROUND_OVER, rounds, scene.round),
    ):  # fmt: skip
        if seen is not None:
            logs = [log + np.log(p if seen else 1.0 - p) for log, p in zip(logs, (over, down, down), strict=False)]
    if below is not None:
        over, down = _far_shore(below)
        logs = [log + shore for log, shore in zip(logs, (over, down, down), strict=False)]
    return logsumexp(np.stack(np.broadcast_arrays(*logs)), axis=0)


def _far_shore(below: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log likelihood of the farthest water's place below the horizon: over a landscape, looking down."""
    median, spread = FAR_SHORE
    amiss = -0.5 * (np.minimum(below, 0.0) / AMISS) ** 2
    seen_at = np.maximum(below, 0.5)
    shore = amiss - 0.5 * (np.log(seen_at / median) / spread) ** 2 - np.log(seen_at * spread * np.sqrt(2.0 * np.pi))
    over, down = (np.logaddexp(np.log1p(-MISTAKEN) + s, np.log(MISTAKEN / 90.0)) for s in (shore, amiss - np.log(90.0)))
    return over, down


def runs_out(mask: Bool[np.ndarray, "h w"]) -> bool:
    """Whether a fluid meets the sides or the lower edge of the picture along a tenth of one of them."""
    return any(bool(edge.mean() > 0.1) for edge in (mask[:, 0], mask[:, -1], mask[-1]))
