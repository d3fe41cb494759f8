"""Mainstream correction (paper: section on fluid surface velocity): motion where optical flow failed.

The neighbours' motion along the direction of the bulk flow (`motion.direction`) fills the failed pixels; then
`motion.screen_divergence` makes the filled motion consistent with an incompressible fluid.

    v_k = sum_i w_ki max(0, n_i . v_i / |v_i|) v_i / sum_i w_ki max(0, n_i . v_i / |v_i|)

The paper leaves the weights w and their range B open and does not divide. Here they are what diffusion inside the mask
carries from i to k (`motion.interpolation`), times the odds c / (1 - c) of the confidence: on the simulated clips 1
over the squared error of flow, in px, is about that. Influence goes round rocks and banks instead of through them,
reaches further along the stream than across, and adds up to one, so that the neighbours' speed ("comparable kinetic
energy") is kept whatever the distance. The cosine is taken where the motion was seen (n_i, not n_k): in a bend the
stream turns, and motion that follows it counts in full. Where everything seen runs against n, its speed is taken along
n.

Flow does not fail all at once: a pixel of confidence c below the threshold takes part in the sum with its own odds, and
keeps the share c of its own motion. And it fails by finding too little motion, seldom by inventing some: own motion
that is not less than the filling's, along it, keeps up to `TRUSTED_OWN` (see `_own_share`). It also fails with full
confidence: where the eye looks through still water onto the bed or sees a fixed reflection, where the patch that it
compares lies on both sides of a jump of depth, and along a bank that a viscous fluid sticks to (`_believed`,
`_one_sided`, `_sticking`).
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import require
from fluidlift.motion.direction import checked_flow, gaussian_blur
from fluidlift.motion.interpolation import depth_jump, diffusion_interpolation

OBSERVED_CONFIDENCE = 0.4
"""Flow of at least this confidence is left alone. More than `types.flow.TRUSTED`: what was seen at other times alone
has up to 0.39 (`temporal.OTHER_TIMES`) and is no observation of this frame. At 0.3 errors differ by up to 1 %"""
ANISOTROPY = 4.0
"""Neighbours along the stream tell as much as those 4 times nearer across it. On seven simulated clips 2 to 8 give the
same error within 4 %; 1 (no direction) is up to a quarter worse where hidden patches are filled."""
PRIOR_SHARE = 0.1
"""weight of the clip's mean motion beside an observed neighbour of the same confidence (0.03 to 0.3: within 3 %)"""
MOST_CERTAIN = 0.98
"""confidence above this adds no weight: flow is never exact"""
STALL_WINDOW = 12.0
"""px, standard deviation of the surroundings with which a pixel's speed is compared"""
HALF_PATCH = 4
"""px from a jump of depth or from a bank within which the patches that flow compares (8 px in dense inverse search)
show both sides"""
CLEAR_JUMP = 0.1
"""Change of depth from pixel to pixel, as a share of it, at which flow beside it is believed half: a jet before its
pool. With 0.05 a filmed pour errs less by 3.5 % and rivers more by 0.03 %; with 0.1 it is 2 % and 0.01 %."""
BESIDE, WITHIN = (5.0, 8.0), (12.0, 18.0)
"""px from the bank: the first water that patches see alone, and that with which its speed is compared"""
CLINGS, SLIPS = 0.8, 0.95
"""Speed beside the bank over that within. Three quarters of it are below 0.80 and 0.71 on two clips of viscous films
and above 1.01 in six of streams, a pour and smoke; in between, sticking sets in."""
FEWEST = 50
"""pixels to tell that from"""


def complete_flow(
    displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    direction: Float[np.ndarray, "h w 2"],
    depth: Float[np.ndarray, "h w"] | None = None,
    *,
    prior: tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]] | None = None,
    stall: float = 0.1,
) -> tuple[Float[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]:
    """Motion of the failed pixels from their neighbours (paper: the interpolation of v_opz; see the module).

    With depth, motion is interpolated as px times depth, that is as metres across the line of sight: the same stream
    far away moves fewer pixels. Motion does not spread over a jump of depth, as between a jet and the pool behind it.

    Args:
        displacement: px/frame.
        confidence: 0 to 1.
        mask: the fluid.
        direction: n, from `mainstream_direction`.
        depth: camera z in m, positive inside the mask.
        prior: mean motion of the clip, px/frame, and its confidence, as `mean_flow` gives them: one more neighbour of
            a failed pixel that was observed at other times.
        stall: share of the surrounding speed at which confidence is halved; 0 believes in standstill.

    Returns:
        completed float32 [H,W,2] px/frame, equal to the input where observed and 0 outside the mask; observed
        bool [H,W]. Without a single observed pixel the flow is returned as it is, with nothing observed.

    Raises:
        ValueError: an empty mask, shapes that do not fit, depth that is not positive inside the mask.
    """
    d, mask = checked_flow(displacement, confidence, mask)
    near = _depth_or_one(depth, mask)
    alone = _one_sided(near, mask)
    confidence = _believed(d, np.asarray(confidence, np.float32), mask, stall) * alone
    n = np.asarray(direction, np.float32)
    slipping, rest = _sticking(d * near[..., None], confidence, mask, n)
    confidence = confidence * slipping
    observed = mask & (confidence >= OBSERVED_CONFIDENCE)
    failed = mask & ~observed
    if not observed.any() or not failed.any():
        return np.where(mask[..., None], d, 0.0).astype(np.float32), observed
    given, weight = _given(d, confidence, observed, mask, n)
    if prior is not None:
        given, weight = _with_prior(given, weight, _seen_before(prior, mask, stall), failed, n)
    weight = weight + rest
    given = given / np.maximum(weight, 1e-12)[..., None]
    filled, reached, _ = diffusion_interpolation(
        given * near[..., None], weight, mask, n, anisotropy=ANISOTROPY, depth=None if depth is None else near
    )
    filled /= near[..., None]
    if not reached[failed].all():
        filled = np.where(reached[..., None], filled, _mean_speed(d, confidence, observed) * n)
    own = _own_share(d, filled, confidence, alone * slipping)[..., None]
    completed = np.where(observed[..., None], d, own * d + (1 - own) * filled)
    return np.where(mask[..., None], completed, 0.0).astype(np.float32), observed


def _depth_or_one(depth: np.ndarray | None, mask: np.ndarray) -> np.ndarray:
    """Depth float32, m, 1 outside the mask; 1 everywhere where it is not known."""
    if depth is None:
        return np.ones(mask.shape, np.float32)
    require(bool((np.asarray(depth)[mask] > 0).all()), "depth that is not positive inside the mask")
    return np.where(mask, depth, 1.0).astype(np.float32)


def _one_sided(depth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Factor on confidence, 1 where a patch of flow sees one side of every jump of depth (`CLEAR_JUMP`)."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * HALF_PATCH + 1, 2 * HALF_PATCH + 1))
    jump = cv2.dilate(depth_jump(depth, mask), disc)
    return (1.0 / (1.0 + (jump / CLEAR_JUMP) ** 2)).astype(np.float32)


def _sticking(
    across: np.ndarray, confidence: np.ndarray, mask: np.ndarray, n: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where a fluid sticks to its banks: factor on confidence, and weight of rest, float32 [H,W]; 1 and 0 where not.

    A viscous film is at rest at its wall and its speed rises over its depth or more; a stream's layer is thinner than a
    patch. Nobody need say which it is: the water that patches see alone tells, beside the bank and within.

    Args:
        across: motion times depth [H,W,2], so that what is far away counts as fast as it is.
        confidence: 0 to 1.
        mask: the fluid; the picture's own border is no bank.
        n: direction of the bulk flow.
    """
    framed = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    bank = cv2.distanceTransform(framed, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    seen = mask & (confidence >= OBSERVED_CONFIDENCE)
    speed = np.hypot(across[..., 0], across[..., 1])
    weight = (seen & (bank > WITHIN[0]) & (bank <= WITHIN[1])) * confidence
    total, density = np.moveaxis(gaussian_blur(np.dstack([weight * speed, weight]), 0.5 * STALL_WINDOW), -1, 0)
    compared = seen & (bank > BESIDE[0]) & (bank <= BESIDE[1]) & (density > 0.01) & (total > 0)
    if compared.sum() < FEWEST:
        return np.ones(mask.shape, np.float32), np.zeros(mask.shape, np.float32)
    slow = np.percentile(speed[compared] * density[compared] / total[compared], 75)
    held = np.float32(np.clip((SLIPS - slow) / (SLIPS - CLINGS), 0.0, 1.0))
    return 1.0 - held * (1.0 - np.minimum(bank / HALF_PATCH, 1.0)), held * _rest_at_banks(bank, mask, n)


def _rest_at_banks(bank: np.ndarray, mask: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Weight of rest in the last pixel before the bank: 1 along the stream, 0 where it runs out across its rim."""
    inside = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), HALF_PATCH)
    gy, gx = np.gradient(inside)
    across = np.abs(gx * n[..., 0] + gy * n[..., 1]) / np.maximum(np.hypot(gx, gy), 1e-6)
    return np.where(mask & (bank <= 1.0), 1.0 - np.minimum(across, 1.0) ** 2, 0.0).astype(np.float32)


def _given(
    d: np.ndarray, confidence: np.ndarray, observed: np.ndarray, mask: np.ndarray, n: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Motion times weight [H,W,2] and weight [H,W] of what this frame says: what was observed as far as it goes along
    n, what failed in any direction."""
    weight = _odds(confidence) * np.where(observed, _cosine(d, n), mask)
    return weight[..., None] * d, weight


def _seen_before(prior: tuple[np.ndarray, np.ndarray], mask: np.ndarray, stall: float) -> tuple[np.ndarray, np.ndarray]:
    """The clip's mean motion, and the confidence that it deserves."""
    mean, trust = checked_flow(*prior, mask)[0], np.asarray(prior[1], np.float32)
    return mean, _believed(mean, trust, mask, stall)


def _with_prior(
    given: np.ndarray, weight: np.ndarray, prior: tuple[np.ndarray, np.ndarray], failed: np.ndarray, n: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """`_given` with the clip's mean as one more neighbour of failed pixels, where it was observed."""
    mean, trust = prior
    beside = np.where(failed & (trust >= OBSERVED_CONFIDENCE), PRIOR_SHARE * _odds(trust) * _cosine(mean, n), 0.0)
    return given + beside[..., None] * mean, weight + beside


def _mean_speed(d: np.ndarray, confidence: np.ndarray, observed: np.ndarray) -> float:
    """Of what was observed, weighted with its confidence, px/frame."""
    counted = np.where(observed, confidence, 0.0)
    return float((counted * np.hypot(d[..., 0], d[..., 1])).sum() / counted.sum())


TRUSTED_OWN = 0.7
"""share of its own motion that a failed pixel keeps at most for moving no less than its neighbours (0.5 to 1: within
1 % on seven simulated clips)"""


def _own_share(d: np.ndarray, filled: np.ndarray, confidence: np.ndarray, alone: np.ndarray) -> np.ndarray:
    """Share of a failed pixel's own motion, 0 to 1: its confidence, or more where it is no slower than the filling.

    On the simulated clips the own motion errs less than the filling where it is above 1.2 of it, they err alike at
    0.8 to 1.2, and below that the filling errs less; the share rises in between. Not so where faster water lies in the
    same patch: `alone`, 0 to 1, says how little of that there is.
    """
    along = (d * filled).sum(axis=-1) / np.maximum((filled**2).sum(axis=-1), 1e-6)
    return np.maximum(np.clip(confidence, 0.0, 1.0), TRUSTED_OWN * alone * np.clip((along - 0.8) / 0.4, 0.0, 1.0))


def _believed(d: np.ndarray, confidence: np.ndarray, mask: np.ndarray, stall: float) -> np.ndarray:
    """Confidence times 1 for pixels at the speed of their surroundings, 1/2 at `stall` times that, 0 at rest."""
    if stall <= 0:
        return confidence
    squared = (d**2).sum(axis=-1)
    weight = (confidence * mask) ** 2
    around = gaussian_blur(np.dstack([weight * squared, weight]), STALL_WINDOW)
    slow = stall**2 * around[..., 0] / np.maximum(around[..., 1], 1e-9) + 1e-6
    return (confidence * (squared + 1e-6) / (squared + slow)).astype(np.float32)


def _odds(confidence: np.ndarray) -> np.ndarray:
    c = np.clip(confidence, 0.0, MOST_CERTAIN)
    return c / (1.0 - c)


def _cosine(d: np.ndarray, n: np.ndarray) -> np.ndarray:
    """max(0, n . v / |v|); 0 at rest."""
    return np.maximum(0.0, (d * n).sum(axis=-1) / np.maximum(np.hypot(d[..., 0], d[..., 1]), 1e-6))
