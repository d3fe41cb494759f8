"""Background subtraction: the still scene behind a fluid that moves through the picture; what stands out from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import convolve1d, gaussian_filter

from fluidlift.shape.evidence import Evidence
from fluidlift.shape.min_cut import geodesic_distance, spread
from fluidlift.shape.presence import Presence
from fluidlift.shape.region import clean_region

DECISIVE = 3.5
"""log odds at which colour alone is held to say no more"""
FAINT = 0.25
"""of the activity that separates still from moving: what is less is noise; 0.5 loses 3 % of a noisy or a small plume"""
RARE = 20.0
"""times rarer around the fluid than in it is a colour that tells fluid without any activity"""
ROUNDS = 3
"""in which the colours of the scene are read anew from all of it that is known"""
OWN = 0.5
"""trust in the fluid's colours above which it has colours of its own: through clear water edges are those behind it"""
TINTED = 0.6
"""of the places that move must have at least half of their typical colour difference, or the fluid has none of its own;
they reach a little over its outline"""
SURE = 2.0
"""log odds from which a place where no background was seen is held to be fluid"""
COMMONER = 5.0
"""times rarer around the fluid than in it is a colour that may be steady fluid rather than its surroundings"""
TINGED, TINT_BLUR = 0.4, 1.5
"""of the fluid's own colour, in the mean over px: what is darker than the ground and has less is ground in shade, which
may be tinged by the sky"""
LEAST_TINT = 8.0
"""grey levels: before a ground to which the fluid would give less tint of its own, the tint tells nothing"""
MIXED = 0.5
"""of the way from the ground's colour to the fluid's from which what stands still can be fluid"""
LEAST_SEEN = 3
"""frames of a place without fluid from which its picture is known"""
TOLD = 1.0
"""log odds by which colours tell which of two pictures of a place is the fluid: one is three times as likely"""
MEAN = 5
"""px of the working picture over which odds of colours are averaged: the foam on water has specks of any colour"""
BESIDE = 0.05
"""part of the longer side: so near to what is carried, what moves may be a part of it"""
RIM = 0.012
"""part of the longer side: so far a steady column is thinner, and nearer to its ground's colours, than its core"""


@dataclass(frozen=True)
class StillScene:
    """What is behind the fluid, and what of the fluid stands still before it."""

    background: np.ndarray
    """float32 [h,w,3], opponent colours"""
    known: np.ndarray
    """bool [h,w], where it is"""
    steady: np.ndarray
    """bool [h,w], `steady_fluid`: its picture is not the background"""
    like_fluid: Callable[[np.ndarray], np.ndarray]
    """log odds of fluid of opponent colours [...,3]"""
    fluid: np.ndarray
    """float [3], the fluid's own colour"""


def still_background(evidence: Evidence, presence: Presence, domain: np.ndarray) -> StillScene:
    """The picture behind the fluid and a colour test of fluid.

    A pixel is taken before the fluid first reached it, or after it was last seen there. What looks more like the
    moving fluid than like the surroundings is not believed: a steady column of smoke is quiet too. The domain,
    bool [h,w], is extended, in place, over such quiet fluid where it touches the moving one, and freed of
    `smooth_ground` where the fluid has colours of its own. Colour is trusted as far as the moving places have: clear
    water shows those of the background. The scene's colours are those of all that is known, so that ground of one
    colour with the smoke is believed where the rest of that ground is.
    """
    bare = _bare(evidence, presence)
    pictures = np.stack([evidence.source[t] for t in presence.picked])
    moving, around = colour_histogram(pictures[presence.active]), colour_histogram(pictures[:, ~domain])
    background, count = _told_apart(bare, 4.0 * evidence.noise, colour_test(moving, around)[0])
    faint = evidence.activity > FAINT * evidence.level
    quiet = quiet_fluid(background, domain, moving, around, faint)
    seen = count >= LEAST_SEEN
    own = without_background(moving, around)
    alien = rarer_around(background, own, around, COMMONER)
    ground = filled_in(background, seen & ~domain & ~quiet & ~spread(alien, RIM * max(domain.shape)))
    fluid = fluid_colour(pictures, presence.active, ground)
    rare = rarer_around(background, own, colour_histogram(pictures[:, ~domain & ~alien]), RARE)
    steady = steady_fluid(background, seen & rare, domain, ground=ground, fluid=fluid)
    domain |= quiet | steady
    known = seen & ~domain
    for _ in range(ROUNDS):
        scene = len(pictures) * colour_histogram(background[known])
        like_fluid, trust = colour_test(moving, scene)
        known = seen & ~steady & (like_fluid(background) <= np.log(2.0))
    if trust > OWN:
        domain &= steady | ~smooth_ground(evidence, background, known, like_fluid)
    return StillScene(background, known, steady, like_fluid, fluid)


def _bare(evidence: Evidence, presence: Presence) -> list[tuple[np.ndarray, np.ndarray]]:
    """Mean pictures, float32 [h,w,3], of each place before the fluid came and after it was last seen, of how many."""
    found = []
    for free in (lambda t: t < presence.first - 1, lambda t: t > presence.last + 1):
        total, count = np.zeros((*presence.first.shape, 3), np.float32), np.zeros(presence.first.shape, np.float32)
        for t in range(presence.frames):
            here = free(t).astype(np.float32)
            total += here[..., None] * evidence.source[t].astype(np.float32)
            count += here
        found.append((total / np.maximum(count, 1.0)[..., None], count))
    return found


def _told_apart(
    bare: list[tuple[np.ndarray, np.ndarray]], limit: np.ndarray, like_fluid: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """What is behind, float32 [h,w,3], and of how many frames, float32 [h,w].

    A heap that grows comes over a place and stays, and lies still there: what is seen after is the fluid, not what is
    behind it. So where the two pictures are not the same, that one counts which looks less like fluid, if one does.

    Args:
        bare: the pictures before and after, and of how many frames they are.
        limit: float32 [h,w], grey levels, within which they are the same.
        like_fluid: log odds of fluid of opponent colours.
    """
    (before, early), (after, late) = bare
    odds = like_fluid(after) - like_fluid(before)
    differ = (early >= LEAST_SEEN) & (late >= LEAST_SEEN) & (np.abs(after - before).sum(axis=-1) > limit)
    early = np.where(differ & (odds < -TOLD), 0.0, early)
    late = np.where(differ & (odds > TOLD), 0.0, late)
    count = early + late
    total = early[..., None] * before + late[..., None] * after
    return (total / np.maximum(count, 1.0)[..., None]).astype(np.float32), count


def fluid_colour(pictures: np.ndarray, active: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """float [3]: median of the quarter of the moving places that differs most from the ground: the rest shows it too.

    Args:
        pictures: float [n,h,w,3], opponent colours.
        active: bool [n,h,w], where there was motion in them.
        ground: float32 [h,w,3], what is behind.
    """
    colours = pictures[active].astype(np.float32)
    if len(colours) == 0:
        return np.zeros(3)
    size = np.abs(pictures - ground).sum(axis=-1)[active]
    return np.median(colours[size >= np.quantile(size, 0.75)], axis=0)


def steady_fluid(
    picture: np.ndarray, rare: np.ndarray, domain: np.ndarray, *, ground: np.ndarray, fluid: np.ndarray
) -> np.ndarray:
    """bool [h,w]: fluid that looks the same all the time, touches the domain, and a rim of `RIM` around it.

    Its colour is rare around the fluid, and lies on the way from the ground's to the fluid's: where smoke brightens,
    its shadow darkens; where both darken, the shadow has no tint of the smoke.

    Args:
        picture: float32 [h,w,3], opponent colours that were seen without motion.
        rare: bool [h,w], where they are the fluid's own and rare in its surroundings.
        domain: bool [h,w], where the fluid moves.
        ground: float32 [h,w,3], what the surroundings let expect there.
        fluid: float [3], the fluid's own colour.
    """
    step, way = picture - ground, fluid - ground
    mixed = (step * way).sum(axis=-1) > MIXED * (way**2).sum(axis=-1)
    shade = darker(step) & (own_tint(picture, ground, fluid) < TINGED)
    found = touching(rare & mixed & ~shade, domain)
    return spread(found, RIM * max(domain.shape)) if found.any() else found


def rarer_around(picture: np.ndarray, fluid: np.ndarray, around: np.ndarray, times: float | np.ndarray) -> np.ndarray:
    """bool [h,w]: colours so many times rarer in one histogram than in the fluid's."""
    bins = colour_bins(picture)
    return fluid[bins] / max(fluid.sum(), 1.0) + 1e-5 > times * (around[bins] / max(around.sum(), 1.0) + 1e-5)


def touching(found: np.ndarray, domain: np.ndarray) -> np.ndarray:
    """The parts of what was found that hang together with the domain, bool [h,w]."""
    parts = cv2.connectedComponents((domain | found).astype(np.uint8), connectivity=4)[1]
    return found & np.isin(parts, np.unique(parts[domain]))


def colour_test(moving: np.ndarray, around: np.ndarray) -> tuple[Callable[[np.ndarray], np.ndarray], float]:
    """Log odds of fluid of opponent colours [...,3], and how far they are trusted, 0 to 1.

    Args:
        moving: histogram of the moving places.
        around: histogram of the scene around.
    """
    fluid = without_background(moving, around)
    rare = 1e-5 * (around.sum() + fluid.sum())
    trust = float(np.clip((fluid.sum() / max(moving.sum(), 1.0) - 0.3) / 0.4, 0.0, 1.0))

    def like_fluid(picture: np.ndarray) -> np.ndarray:
        bins = colour_bins(picture)
        return trust * np.clip(np.log((fluid[bins] + rare) / (around[bins] + rare)), -DECISIVE, DECISIVE)

    return like_fluid, trust


def in_own_colours(evidence: Evidence, score: np.ndarray, presence: Presence, where: np.ndarray) -> np.ndarray:
    """bool [h,w]: places that were seen in colours that the moving fluid has, and nothing around it.

    The top of a body of liquid that is let go leaves as a whole, in one direction and for good: by its motion it could
    be a hand. A hand has other colours than what it pours.

    Args:
        evidence: of the clip.
        score: float32 [h,w], log odds of fluid by change and motion.
        presence: of what has a score above 0.
        where: bool [h,w], the places that are asked for.
    """
    domain = spread(clean_region(score > -1.0), 0.01 * max(score.shape)) | where
    moves = presence.active & ~spread(where, BESIDE * max(score.shape))  # its rim has its colours, and a score above 0
    if not where.any() or not moves.any() or domain.all():
        return np.zeros_like(where)
    pictures = np.stack([evidence.source[t] for t in presence.picked]).astype(np.float32)
    moving, around = colour_histogram(pictures[moves]), colour_histogram(pictures[:, ~domain])
    like_fluid, trust = colour_test(moving, around)
    if trust <= OWN:
        return np.zeros_like(where)
    likest = np.max([cv2.blur(like_fluid(p).astype(np.float32), (MEAN, MEAN)) for p in pictures], axis=0)
    return where & (likest > SURE)


def smooth_ground(
    evidence: Evidence, background: np.ndarray, known: np.ndarray, like_fluid: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """bool [h,w]: what always moves a little, but no edge parts it from the still ground.

    Light that a plume sheds on the ground flickers, and has the plume's colours. What is doubtful, and nearer to known
    background than to sure fluid along the picture (geodesic distance), is ground.

    Args:
        evidence: of the clip.
        background: float32 [h,w,3].
        known: bool [h,w], where it is known.
        like_fluid: log odds of colours.
    """
    typical = evidence.typical
    moved = (evidence.activity - evidence.level) / 0.3
    fluid = ~known & (np.maximum(moved, moved + like_fluid(typical)) > SURE)
    if not known.any() or not fluid.any():
        return np.zeros_like(known)
    picture, step = np.where(known[..., None], background, typical), float(np.median(evidence.noise))
    near, far = (geodesic_distance(picture, seeds, step=step) for seeds in (known, fluid))
    return ~known & ~fluid & (near < far)


def filled_in(picture: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The picture, float32 [h,w,c], with what is not known, bool [h,w], guessed from its rim.

    Means over ever larger neighbourhoods of what is known, coarse to fine (Gortler et al. 1996, "The lumigraph",
    push-pull); all zero where nothing is known.
    """
    if known.all() or min(known.shape) < 2:
        return np.where(known[..., None], picture, 0.0).astype(np.float32)
    height, width = known.shape
    size = ((width + 1) // 2, (height + 1) // 2)
    weight = known.astype(np.float32)
    share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
    mean = cv2.resize(picture * weight[..., None], size, interpolation=cv2.INTER_AREA)
    coarse = filled_in(mean / np.maximum(share, 1e-6)[..., None], share > 0.0)
    smooth = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.where(known[..., None], picture, smooth).astype(np.float32)


def weight_of_unseen(seen: np.ndarray) -> np.ndarray:
    """How much of a guess is blended in, float32 [h,w]: 1 where nothing was `seen`, bool [h,w], 0 a few pixels off."""
    weight = np.clip(2.0 * gaussian_filter((~seen).astype(np.float32), 1.5), 0.0, 1.0)
    weight[~seen] = 1.0
    return weight


def quiet_fluid(
    picture: np.ndarray, domain: np.ndarray, moving: np.ndarray, around: np.ndarray, faint: np.ndarray
) -> np.ndarray:
    """bool [h,w]: what touches the domain and has a colour of the moving fluid that is rare around it.

    Where there is `faint` activity, bool [h,w], the colour need only be more common in the fluid than around.
    """
    return touching(rarer_around(picture, moving, around, np.where(faint, 1.0, RARE)), domain)


def typical_contrast(
    evidence: Evidence, presence: Presence, background: np.ndarray, known: np.ndarray
) -> tuple[float, float]:
    """Median difference between the moving fluid and what is behind it, grey levels, and its sign.

    The sign is +1 where the fluid is brighter than its background nearly everywhere, -1 where it is darker, else 0:
    with a clear sign, the opposite change is a shadow or a reflection of the fluid.
    """
    values = [
        (evidence.source[t].astype(np.float32) - background)[active & known]
        for t, active in zip(presence.picked, presence.active, strict=True)
    ]
    together = np.concatenate(values)
    if len(together) == 0:
        return 0.0, 0.0
    brightness = together[:, 0]
    bias = float(brightness.sum() / max(float(np.abs(brightness).sum()), 1e-6))
    return float(np.median(np.abs(together).sum(axis=-1))), float(np.sign(bias)) if abs(bias) > 0.7 else 0.0


def darker(step: np.ndarray) -> np.ndarray:
    """bool [h,w]: changes [h,w,3] that are mostly a loss of brightness."""
    return step[..., 0] < -0.5 * np.abs(step).sum(axis=-1)


def is_tinted(evidence: Evidence, presence: Presence, scene: StillScene) -> bool:
    """Whether the fluid has a colour of its own: nearly all that moves changes in colour alike, not so clear water."""
    moving = zip(presence.picked, presence.active, strict=True)
    parts = [_tint(evidence.source[t], scene.background)[active & scene.known] for t, active in moving]
    tints = np.concatenate(parts)
    if len(tints) == 0:
        return False
    own = np.median(tints, axis=0)
    size = float(own @ own)
    return size > 0.0 and float((tints @ own > 0.5 * size).mean()) >= TINTED


def own_tint(picture: np.ndarray, ground: np.ndarray, fluid: np.ndarray) -> np.ndarray:
    """float [h,w]: how much of the fluid's colour a picture has, 1 in the fluid and 0 in any shade of the ground.

    A shadow scales all colours of the ground alike. What is left of a change after that is compared with what the
    fluid would leave before the same ground; 1 where that is below `LEAST_TINT`.

    Args:
        picture: float32 [h,w,3], opponent colours.
        ground: float32 [h,w,3], what is behind.
        fluid: float [3], the fluid's own colour.
    """
    expected = _tint(np.broadcast_to(fluid, ground.shape), ground)
    size = (expected**2).sum(axis=-1)
    part = (_tint(picture, ground) * expected).sum(axis=-1) / np.maximum(size, LEAST_TINT**2)
    part[size < LEAST_TINT**2] = 1.0
    return cv2.GaussianBlur(part, (0, 0), TINT_BLUR)


def _tint(picture: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """[h,w,2], colour differences less those of the ground in as much light."""
    light = np.clip(picture[..., :1] / np.maximum(ground[..., :1], 1.0), 0.0, 1.0)
    return picture[..., 1:] - light * ground[..., 1:]


def colour_bins(colours: np.ndarray, *, bins: int = 16) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Index of each opponent colour [...,3] in a histogram of `bins` per axis."""
    scaled = np.asarray(colours, np.float32) / 256.0 + np.array([0.0, 0.5, 0.5], np.float32)
    index = np.clip((scaled * bins).astype(int), 0, bins - 1)
    return index[..., 0], index[..., 1], index[..., 2]


def colour_histogram(colours: np.ndarray, *, bins: int = 16) -> np.ndarray:
    """Smoothed counts of opponent colours [...,3], float32 [bins,bins,bins]."""
    counts = np.zeros((bins, bins, bins), np.float32)
    np.add.at(counts, colour_bins(colours.reshape(-1, 3), bins=bins), 1.0)
    kernel = np.array([0.25, 0.5, 0.25], np.float32)
    for axis in range(3):
        counts = convolve1d(counts, kernel, axis=axis, mode="constant")
    return counts.astype(np.float32)


def without_background(mixed: np.ndarray, around: np.ndarray) -> np.ndarray:
    """The histogram of active places less the background that shows through and beside the fluid in them.

    The share of background is the one that explains the surroundings' own colours (their median ratio).
    """
    common = np.sort(around.ravel())[::-1]
    main = around >= common[min(int(np.searchsorted(np.cumsum(common), 0.9 * common.sum())), len(common) - 1)]
    share = float(np.quantile((mixed[main] / np.maximum(around[main], 1e-6)), 0.5))
    return np.maximum(mixed - share * around, 0.0)
