"""Whether what moves on water that lies can be a current: what runs through goes one way, waves and surf do not.

A current passes every section with the same discharge, so its mean motion has one direction, but for bends and what
turns back behind rocks. Waves carry nothing in the mean (Stokes' drift is of second order in their slope): a front that
runs up a beach meets what runs back, and crests of several trains cross. Their motion, averaged over a second or two,
is left with parts in opposite directions that nearly cancel.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

RETURNS = (0.1, 0.2)
"""share of the power of the mean motion that goes against the whole from which water may stay, and from which it does.
Half of it does where nothing passes. A whirl behind a rock has a third of the current's speed, a tenth of its power; in
17 real streams and falls it is 0.02 and less but for one with 0.08, in two seas whose surf is seen 0.22 and 0.23"""
DIRECTED = (0.75, 0.9)
"""length of the sum of the mean motion over the sum of its lengths below which nothing in particular passes, and from
which a current does: over all directions of a half plane alike it is 2/pi = 0.64, over those of a wind sea (power as
the square of the cosine) 8/(3 pi) = 0.85. One inlet has 0.65 and 0.71, streams across a picture 0.85 to 0.99"""
OPEN = (0.9, 1.0)
"""share of the picture's upper edge that water fills from which no far bank may be seen, and from which none is"""
BLOCKS = 20
"""along the longer side of the picture, over which motion is averaged first: errors of single pixels go any way"""
EDGE = 60
"""part of the picture's height that its edge is taken to be wide"""


def returning(
    displacement: Float[np.ndarray, "h w 2"], trust: Float[np.ndarray, "h w"], ground: Float[np.ndarray, "2"]
) -> float:
    """How far a mean motion comes back: 0 where all goes one way, 1 where a fifth of its power goes against the rest.

    In the picture and against the ground, whichever is less: a camera that turns may make either.

    Args:
        displacement: mean optical flow, px per frame.
        trust: in it; 0 where there is no fluid.
        ground: mean motion of what is no fluid, px per frame; 0 where it is not known.
    """
    share = min(_against(displacement, trust), _against(displacement - ground, trust))
    return float(np.clip((share - RETURNS[0]) / (RETURNS[1] - RETURNS[0]), 0.0, 1.0))


def undirected(
    displacement: Float[np.ndarray, "h w 2"], trust: Float[np.ndarray, "h w"], ground: Float[np.ndarray, "2"]
) -> float:
    """How far a mean motion has no direction: 0 where it passes, 1 where it does not. Arguments as of `returning`."""
    share = max(_directed(displacement, trust), _directed(displacement - ground, trust))
    return float(np.clip((DIRECTED[1] - share) / (DIRECTED[1] - DIRECTED[0]), 0.0, 1.0))


def across(
    displacement: Float[np.ndarray, "h w 2"], trust: Float[np.ndarray, "h w"], ground: Float[np.ndarray, "2"]
) -> float:
    """How far a mean motion passes from one side of the picture to the other: 0 to 1. Arguments as of `returning`.

    What comes in from the horizon are waves: no land is seen from which a current could run down to the viewer.
    """
    share = min(_directed(m, trust, of=slice(0, 1)) for m in (displacement, displacement - ground))
    return float(np.clip((share - DIRECTED[0]) / (DIRECTED[1] - DIRECTED[0]), 0.0, 1.0))


def bay(fluid: Bool[np.ndarray, "h w"]) -> float:
    """How far water is open on its far side, and ends before the picture's lower edge: 0 to 1.

    It has one opening then. What comes in there goes out there.
    """
    rows = max(2, len(fluid) // EDGE)
    top, bottom = (float(edge.any(axis=0).mean()) for edge in (fluid[:rows], fluid[-rows:]))
    return float(np.clip((top - OPEN[0]) / (OPEN[1] - OPEN[0]), 0.0, 1.0)) * (1.0 - bottom)


def _against(motion: np.ndarray, trust: np.ndarray) -> float:
    """Share of the power of a motion that is in what goes against its mean."""
    motion, trust = _in_blocks(motion, trust)
    mean = (trust[..., None] * motion).sum(axis=(0, 1))
    power = trust * np.square(motion).sum(axis=-1)
    total = float(power.sum())
    return float(power[motion @ mean < 0].sum()) / total if total > 0 else 0.0


def _directed(motion: np.ndarray, trust: np.ndarray, of: slice = slice(None)) -> float:
    """Length of the sum of a motion, or of components of it, over the sum of its lengths; 1 where nothing moves."""
    motion, trust = _in_blocks(motion, trust)
    gross = float((trust * np.linalg.norm(motion, axis=-1)).sum())
    return float(np.linalg.norm((trust[..., None] * motion[..., of]).sum(axis=(0, 1)))) / gross if gross > 0 else 1.0


def _in_blocks(motion: np.ndarray, trust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean motion and summed trust in squares of the picture."""
    side = max(round(max(trust.shape) / BLOCKS), 1)
    pad = [(0, -n % side) for n in trust.shape]

    def summed(values: np.ndarray) -> np.ndarray:
        whole = np.pad(values, pad)
        return whole.reshape(whole.shape[0] // side, side, -1, side).sum(axis=(1, 3))

    total = summed(trust)
    moved = np.stack([summed(trust * motion[..., a]) for a in range(2)], axis=-1)
    return moved / np.maximum(total, 1e-12)[..., None], total
