"""What kind of fluid a clip shows, and where up is: decided from evidence that the report can show."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.messages import Notice
from fluidlift.shape import chute, passing, prism, slope
from fluidlift.shape.filled_vessel import fills_a_vessel
from fluidlift.shape.frame_pictures import typical_picture
from fluidlift.shape.kind_weights import WEIGHTS
from fluidlift.shape.open_water import recession
from fluidlift.shape.spreading import CLEAR_PX, FALLS, spreading
from fluidlift.shape.thrown import Thrown
from fluidlift.shape.view import Ellipse, PictureEvidence, habit_prior, horizon_evidence, open_horizon
from fluidlift.shape.view.habit import ROLL
from fluidlift.types import FluidKind, KindEvidence, PinholeCamera, RigidTransform, UpEvidence, kind_of
from fluidlift.types.flow import TRUSTED
from fluidlift.types.kind import KINDS as FLUID_KINDS
from fluidlift.types.kind import STREAM

KINDS: tuple[str, ...] = tuple(name for name, kind in FLUID_KINDS.items() if kind.recognised)
"""names of the kinds whose evidence is weighed"""

LEAST_SURE = 0.7
"""probability of the kind below which a user is warned and told the next one: so 7 of 34 real clips (each judged by
weights fitted to the others), the wrong one among them; 22 of 68 parts of their pictures, 12 of the 17 wrong ones"""
FOLLOWED = 0.3
"""share of the fluid that reliable flow sees falling, from which the flow counts as able to follow it. A fall of h
metres takes 0.45 s times the root of h, so a jet of a few decimetres moves farther per frame than its pattern is wide:
in six pours 0 to 0.09 of the fluid is seen to fall, in five falls and fountains 0.27 to 0.57"""
RECEDES = (1.0, 1.5)
"""growth of the log of the wander over the picture's height (`open_water.recession`) from which a fluid may lie, and
from which it does: six falls and fountains have -0.6 to 0.9, eleven of 16 streams, seas and brooks 1.0 to 3.3"""
ALL_RISES = (0.8, 0.95)
"""share of the motion that goes up from which a fluid may rise as a whole, and from which it does. The pattern of a jet
moves by more than itself between two frames, and seems to go any way: up to 0.74 of it rises in seven pours, 0.98 to 1
in smoke and in steam"""
IN_VESSEL = 0.1
"""share of the fluid within one rim from which it is in a vessel: splashes and jets are beside it. Of 25 real streams,
falls, seas and plumes none has a rim, of nine pours and pots four do"""
SHARP = (6.0, 10.0)
"""grey levels of detail (`detail`) up to which a body may have no surface, and from which it has one. Smoke and steam
have 4 to 8 in ten looks at four clips, jets whose pattern seems to rise 9 to 24 in five looks at three"""
FINE = 1.0 / 160.0
"""of the picture's longer side, standard deviation of the bell that takes what is coarse from it: 2 px of 320"""
GRAIN = 1.0 / 320.0
"""of the picture's longer side: standard deviation of the bell that takes a codec's noise off a pattern: 1 px of 320"""
RIM = 0.01
"""of the same: what is nearer to the outline of the fluid has the change of the outline in it"""
STILL = 0.2
"""grey levels per px: gradients of a pattern that count as none"""
WIDER, THREADS = 1.1, 0.02
"""log of width below over width above that counts in full: three times as wide (a plume widens on its way up, as it
takes in air: of 12 looks at three none is wider below by over 0.02; pools below jets are by 0.4 to 2.2); and share of a
fluid at either end that is no part of its shape"""
DRAWN_OUT = 1.0
"""`drawn_down` that says all it can. Seas, rivers and brooks seen at a slant have -2.5 to -0.5, streams and vessels
seen from above -0.8 to 0.3, smoke -0.3 to 0.7, falls, jets and fountains -0.6 to 1.2 (34 real clips, half of the falls
and jets above 0.3)"""
FEWEST_PAIRS = 12
"""pairs of frames: half a second, in which a wave rises or falls"""
SHAKE = 0.05
"""px per frame and axis that the bulk motion changes by where the fluid's does not: what steadying leaves of a camera's
shake, and errors of optical flow (`slope.LEAST_NOISE`)"""
SPREADS = 0.5
"""of `spreading.spreading`, from which it is taken to: of 34 real clips one has more than 0, and 1"""
RISES, SEEN_TO_FALL = (0.03, 0.12), (0.08, 0.16)
"""shares of `shape.thrown` from which a body may be thrown up, and from which it is. Near their top 0.15 to 0.6 of what
moves in made and real fountains goes up, 0.00 in ten falls, weirs and cascades; 0.16 to 0.72 of the bodies of the
former is seen to fall, less than 0.07 of what circles in vessels"""
STRAIGHT = 10.0
"""degrees: a larger lean of what falls is a thrown jet or wind, not a turned camera"""


def doubts(evidence: KindEvidence, built: str) -> tuple[Notice, ...]:
    """What a user should know of how sure the kind is; empty where it is. `built`: the kind that was taken, which is
    neither of the likeliest where several bodies make up one."""
    (best, share), (second, other) = sorted(evidence.scores.items(), key=lambda item: -item[1])[:2]
    if share >= LEAST_SURE:
        return ()
    return (
        Notice(
            "kind-unsure",
            f"what kind of fluid this is, is unsure: {best} ({share:.2f}) or {second} ({other:.2f}); "
            f"it is built as {built}, and --kind decides",
        ),
    )


def thrown_up(ways: Thrown) -> float:
    """0 to 1: how far a body is one that rises out of its pool and falls back, standing free of its background."""
    shares = ((ways.rises, RISES), (ways.falls, SEEN_TO_FALL))
    up, down = (float(np.clip((share - low) / (high - low), 0.0, 1.0)) for share, (low, high) in shares)
    return up * down * ways.free


def spreads(evidence: KindEvidence) -> bool:
    """Whether it spreads over what it lies on, from where it comes down.

    On a slope it would keep its speed (a film under its friction: v = g sin(slope) h^2 / (3 nu)) or gain some, so that
    a pool of what spreads is level.
    """
    return evidence.features.get("spreading", 0.0) > SPREADS


def estimate_kind(
    frames: UInt8[np.ndarray, "t h w 3"],
    fluid: Bool[np.ndarray, "t h w"],
    displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"],
    *,
    pitch: float | None = None,
    bulk: tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]] | None = None,
    ways: Thrown | None = None,
    rims: tuple[Ellipse, ...] = (),
) -> KindEvidence:
    """Weigh direction of motion, shape of the mask and colour against what each kind looks like.

    A softmax of weighed terms (`terms`); their weights (`shape.kind_weights`) are fitted.

    Args:
        frames: sRGB pictures (a few, spread over the clip, are enough).
        fluid: mask of each of these frames.
        displacement: mean optical flow, px per frame.
        confidence: of the flow, 0 to 1.
        pitch: known tilt of the camera, degrees below the horizon, or None.
        bulk: mean motion of the whole fluid, and of the ground, in each of many pairs of frames, px per frame, nan
            where it is not known (`motion.steady_flow.bulk_motion`); None: nothing is known of how it changes.
        ways: how much of it goes up and how much comes down (`shape.thrown`), from consecutive frames; None: nothing
            is known of that.
        rims: of vessels that are seen.
    """
    require(fluid.shape == frames.shape[:3], f"masks {fluid.shape} for frames {frames.shape}")
    f = _features(frames, fluid, displacement, confidence) | {"swinging": 0.0 if bulk is None else swinging(*bulk)}
    f |= _open_water(frames, fluid, displacement, confidence, bulk)
    # down in the picture is towards the viewer on what recedes from him, and on what spreads and loses its speed; a jet
    # that splashes at its foot seems to recede, and so does a curtain that breaks up on its way, but no ground that
    # recedes draws its pattern out that way
    recedes = f["receding"] * (1.0 - f["slender"]) * (1.0 - f["drawn down"])
    f["falling"] *= 1.0 - max(recedes, f["spreading"])
    f["followed"] *= 1.0 - f["spreading"]
    f["thrown"] = 0.0 if ways is None else thrown_up(ways) * f["followed"]
    f["returning"] *= 1.0 - f["thrown"]  # what rises comes back as well
    wet = np.any(fluid, axis=0)
    f["contained"] = max((rim.share_inside(wet) for rim in rims), default=0.0)
    f["vessel filled by a jet"] = float(fills_a_vessel(rims, fluid))
    weighed = terms(f, pitch)
    values = np.array([sum(w * weighed[term] for term, w in WEIGHTS[kind].items()) for kind in KINDS])
    share = np.exp(values - values.max())
    share /= share.sum()
    best = KINDS[int(np.argmax(share))]
    return KindEvidence(best, {k: float(s) for k, s in zip(KINDS, share)}, f)


def terms(f: dict[str, float], pitch: float | None) -> dict[str, float]:
    """What is weighed for each kind, from features of 0 to 1; those that are products say when a feature counts.

    Args:
        f: `KindEvidence.features`.
        pitch: known tilt of the camera, degrees below the horizon, or None.
    """
    still = 1.0 - f["changing"]
    slender = f["slender"] * (1.0 - f["contained"])  # what moves on a liquid in its vessel is no jet
    lies = 1.0 - slender  # what runs off the drops beside a jet goes any way
    lifted = float(np.clip((f["rising"] - ALL_RISES[0]) / (ALL_RISES[1] - ALL_RISES[0]), 0.0, 1.0))
    inside = f["enclosed"] * (1.0 - f["hanging"])  # what ends within the picture passes nothing on
    vessel = min(f["contained"] / IN_VESSEL, 1.0)
    # what a vessel holds stays in it, whatever it does there but fall, unless a jet fills that
    held = vessel * inside * (1.0 - f["falling"]) * (1.0 - f["vessel filled by a jet"])
    staying = max(f["swinging"], inside * f["circling"], lies * f["returning"], f["horizon"], f["bay"], held)
    plain = ("rising", "sideways", "falling", "followed", "wide", "bulky", "hanging", "changing", "grey",
             "foreground", "thrown", "contained", "collapsing", "drawn across", "drawn down", "wider below",
             "vessel filled by a jet")  # fmt: skip
    return (
        {"always": 1.0}
        | {name: f[name] for name in plain}
        | {
            "vessel": vessel,
            "slender": slender,
            "grey and rising": f["grey"] * f["rising"],
            # it goes up and out at the top
            "lifted": lifted,
            # a surface mirrors and bends light, and has edges; of smoke a sum along each ray is seen, which is smooth
            "lifted and sharp": lifted * f["sharp"],
            "lifted and smooth": lifted * (1.0 - f["sharp"]),
            "hanging, not lifted": f["hanging"] * (1.0 - lifted),
            "hanging, not bulky": f["hanging"] * (1.0 - f["bulky"]),
            # a steady jet keeps its outline; what rises by its heat puffs, the thinner the faster (at 1.5 Hz over the
            # root of its width in metres: Cetegen and Ahmed 1993)
            "slender and still": slender * still * (1.0 - f["followed"]),
            # its outline stays, from side to side or along the lower edge of the picture
            "filling": still * max(f["wide"] * (1.0 - lifted * f["hanging"]), f["ground"]),
            "wide and still": f["wide"] * (0.5 + still),
            "wide, not falling": f["wide"] * (0.5 + still) * (1.0 - f["falling"]),
            # along the line of sight a body runs out of the foreground or into it
            "wide foreground": f["foreground"] * lies,
            "falling, far": f["falling"] * (1.0 - f["foreground"]),
            "rising, not filling": f["rising"] * (1.0 - still * f["ground"]),
            # it goes to and fro, round and round, or has but one side to go to
            "staying": staying,
            "staying inside": staying * inside,
            # steep views of bodies in the air are rare
            "seen from above": 0.0 if pitch is None else float(np.clip((pitch - 20.0) / 20.0, -1.0, 1.0)),
        }
    )


def _widening(region: Bool[np.ndarray, "h w"]) -> float:
    """Logarithm of the median width of a region's lower third over that of its upper third, by height; its threads
    above and below, of `THREADS` of it, are left out."""
    width = region.sum(axis=1)
    total = max(int(width.sum()), 1)
    share = np.cumsum(width) / total
    rows = width[(share >= THREADS) & (share - width / total <= 1.0 - THREADS) & (width > 0)]
    third = len(rows) // 3
    return float(np.log(np.median(rows[-third:]) / np.median(rows[:third]))) if third > 1 else 0.0


def _features(frames, fluid, displacement, confidence) -> dict[str, float]:
    height, width = fluid.shape[1:]
    union = fluid.mean(axis=0) > 0.25
    if not union.any():
        union = fluid.any(axis=0)
    speed = np.linalg.norm(displacement, axis=-1)
    weight = np.where(union, confidence * speed, 0.0)
    total = max(float(weight.sum()), 1e-9)
    angle = np.degrees(np.arctan2(displacement[..., 1], displacement[..., 0]))  # +90 is down in the picture

    def within(centre: float, span: float) -> float:
        return float(weight[np.abs((angle - centre + 180) % 360 - 180) < span].sum() / total)

    falling, rising = within(90, FALLS), within(-90, 50)
    followed = union & (confidence > TRUSTED) & (speed > CLEAR_PX) & (np.abs(angle - 90) < FALLS)
    # the shape of what moves: still water around a jet says nothing about the jet
    moving = union & (weight > 0.25 * np.percentile(weight[union], 95))
    moving = ndimage.binary_opening(moving) if ndimage.binary_opening(moving).any() else union
    rows, cols = np.where(moving)
    box_h = np.ptp(np.percentile(rows, [2, 98])) + 1
    box_w = np.ptp(np.percentile(cols, [2, 98])) + 1
    typical_width = float(np.median(moving.sum(axis=1)[moving.any(axis=1)]))
    lowest = slice(int(0.93 * height), None)
    foreground, ground = (float(m[lowest].any(axis=0).mean()) for m in (moving, union))
    change = float(np.mean(fluid[1:] != fluid[:-1]) / max(fluid.mean(), 1e-9)) if len(fluid) > 1 else 0.0
    colours = frames[fluid].astype(np.float32) / 255.0
    if len(colours) > 20000:
        colours = colours[:: len(colours) // 20000]
    chroma = float((colours.max(1) - colours.min(1)).mean()) if len(colours) else 0.0
    drawn = drawn_down(frames, fluid)
    return {
        "falling": falling,
        "followed": float(np.clip(followed.sum() / max(FOLLOWED * float(union.sum()), 1.0), 0.0, 1.0)),
        "rising": rising,
        "sideways": max(0.0, 1.0 - falling - rising),
        "slender": float(np.clip((box_h / max(typical_width, 1.0) - 2.0) / 3.0, 0.0, 1.0)),
        "wide": float(np.clip((box_w / box_h - 0.8) / 1.2, 0.0, 1.0)),
        "bulky": float(np.clip((np.median(union.sum(axis=1)[union.any(axis=1)]) / width - 0.3) / 0.3, 0.0, 1.0)),
        "foreground": foreground,
        "ground": ground,
        "wider below": float(np.clip(_widening(union) / WIDER, 0.0, 1.0)),
        "hanging": float(fluid[:, : max(2, height // 60)].any(axis=(1, 2)).mean() * (1 - ground)),
        "changing": float(np.clip(change / 0.3, 0.0, 1.0)),
        "circling": circling(displacement, weight),
        "enclosed": float(np.clip(1.0 - _border_share(union) / 0.1, 0.0, 1.0)),
        "grey": float(np.clip(1.0 - chroma / 0.15, 0.0, 1.0)),
        "collapsing": _collapsing(fluid),
        "spreading": spreading(union, displacement, confidence),
        "receding": float(np.clip((recession(frames, union) - RECEDES[0]) / (RECEDES[1] - RECEDES[0]), 0.0, 1.0)),
        "sharp": float(np.clip((detail(frames, union) - SHARP[0]) / (SHARP[1] - SHARP[0]), 0.0, 1.0)),
        "drawn across": float(np.clip(-drawn / DRAWN_OUT, 0.0, 1.0)),
        "drawn down": float(np.clip(drawn / DRAWN_OUT, 0.0, 1.0)),
        "speed_px": float(total / max(float((confidence * union).sum()), 1e-9)),
        "area_share": float(union.sum() / (height * width)),
    }


def detail(frames: UInt8[np.ndarray, "t h w 3"], region: Bool[np.ndarray, "h w"]) -> float:
    """Root mean square of what is fine in a region of pictures, grey levels; 0 for no region."""
    if not region.any():
        return 0.0
    squares = []
    for frame in frames:
        grey = frame.mean(axis=-1, dtype=np.float32)
        fine = grey - cv2.GaussianBlur(grey, (0, 0), FINE * max(grey.shape))
        squares.append(float(np.square(fine[region]).mean()))
    return float(np.sqrt(np.mean(squares)))


def drawn_down(frames: UInt8[np.ndarray, "t h w 3"], fluid: Bool[np.ndarray, "t h w"]) -> float:
    """How far the pattern of what changes in a fluid is drawn out down the picture (above 0), or across it (below).

    The logarithm of the energy of its horizontal gradients over that of its vertical ones; 0 where nothing changes. A
    surface that lies and is seen at a slant is foreshortened along the view, and so are its waves; what falls becomes
    faster on its way and is drawn out along it. What stands still (a bed, a mirrored bank) has no part in it.

    Args:
        frames: sRGB, spread over the clip.
        fluid: mask of each.
    """
    longest = max(fluid.shape[1:])
    grey = [cv2.GaussianBlur(cv2.cvtColor(f, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), GRAIN * longest)
            for f in np.asarray(frames)]  # fmt: skip
    changing = np.stack(grey) - np.median(grey, axis=0)
    inner = np.stack([ndimage.binary_erosion(m, iterations=max(round(RIM * longest), 1)) for m in fluid])
    down, across = (np.square(np.gradient(changing, axis=axis))[inner].sum(dtype=np.float64) for axis in (1, 2))
    least = STILL**2 * max(int(inner.sum()), 1)
    return float(np.log((across + least) / (down + least)))


def _open_water(frames, fluid, displacement, confidence, bulk) -> dict[str, float]:
    """What tells a sea from a stream beside what changes: no mean motion with one direction, no far bank."""
    if bulk is None:  # a person said where it runs
        return dict.fromkeys(("returning", "bay", "horizon"), 0.0)
    ever = fluid.any(axis=0)
    trust = np.where(fluid.mean(axis=0) > 0.25, confidence, 0.0)
    known = bulk[1][np.isfinite(bulk[1]).all(axis=1)]
    ground = known.mean(axis=0) if len(known) else np.zeros(2)
    horizon = open_horizon(typical_picture(frames).astype(np.uint8), ever)
    return {
        "returning": passing.returning(displacement, trust, ground),
        "bay": passing.bay(fluid.mean(axis=0) > 0.5) * passing.undirected(displacement, trust, ground),
        "horizon": 0.0 if horizon is None else horizon.share * (1.0 - passing.across(displacement, trust, ground)),
    }


def circling(displacement: Float[np.ndarray, "h w 2"], weight: Float[np.ndarray, "h w"]) -> float:
    """How far a motion goes round its middle: its angular momentum over what it would be were it all across the radius.

    Args:
        displacement: px per frame.
        weight: of each pixel, confidence times speed.

    Returns:
        0 (none, or half of it and less) to 1 (nine tenths).
    """
    total = float(weight.sum())
    if total <= 0:
        return 0.0
    grid = np.stack(np.meshgrid(np.arange(weight.shape[1]), np.arange(weight.shape[0])), axis=-1)
    arm = grid - (weight[..., None] * grid).sum(axis=(0, 1)) / total
    # seen obliquely, a circle is an ellipse: both axes are made as long
    spread = np.sqrt((weight[..., None] * arm**2).sum(axis=(0, 1)) / total)
    arm, moved = arm / np.maximum(spread, 1.0), displacement / np.maximum(spread, 1.0)
    trust = weight / np.maximum(np.linalg.norm(displacement, axis=-1), 1e-9)
    turning = abs(float((trust * (arm[..., 0] * moved[..., 1] - arm[..., 1] * moved[..., 0])).sum()))
    most = float((trust * np.linalg.norm(arm, axis=-1) * np.linalg.norm(moved, axis=-1)).sum())
    return float(np.clip((turning / max(most, 1e-12) - 0.5) / 0.4, 0.0, 1.0))


def _border_share(mask: np.ndarray) -> float:
    """Share of the picture's border that a fluid meets."""
    return float(np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).mean())


def swinging(bulk: Float[np.ndarray, "n 2"], ground: Float[np.ndarray, "n 2"]) -> float:
    """Share of the bulk motion that is to and fro: the square of what changes over that and the square of its mean.

    In the picture and against the ground: what only the camera does, or only the ground that it passes,
    does not count. A swing lasts for many frames: what one pair has alone (frames left out, a key frame that looks
    otherwise) does not count either, so each is the median of three. It is 0 where too little is known.

    What runs through passes every section with the same discharge. Waves carry nothing in the mean.
    """
    return min(_changing(bulk), _changing(bulk - np.where(np.isfinite(ground), ground, 0.0)))


def _changing(bulk: np.ndarray) -> float:
    known = bulk[np.isfinite(bulk).all(axis=1)]
    if len(known) < FEWEST_PAIRS:
        return 0.0
    known = ndimage.median_filter(known, size=(3, 1), mode="nearest")
    changes = max(float(known.var(axis=0).sum()) - 2.0 * SHAKE**2, 0.0)
    mean = float(np.square(known.mean(axis=0)).sum())
    return changes / (changes + mean) if changes > 0 else 0.0


def _collapsing(fluid: np.ndarray) -> float:
    """0 to 1: how far a body has come down for good, where it stood, for ground that was dry.

    Column by column of the picture: its top is lower in the end, and its foot still wet. Elsewhere the liquid may be
    seen higher than the body ever was: ground further away, and waves at its walls. What reaches the picture's upper
    edge is fed from there.
    """
    count = len(fluid)
    first, later = fluid[0], fluid[-max(count // 3, 1) :].mean(axis=0)
    area, rows = float(first.sum()), np.arange(fluid.shape[1])[:, None]
    if count < 4 or area == 0 or first[0].any():
        return 0.0
    gained = ~fluid[: max(count // 8, 1)].any(axis=0) & (later > 0.7)
    top, bottom = first.argmax(axis=0), len(first) - 1 - first[::-1].argmax(axis=0)
    foot = first & (rows >= bottom - (bottom - top) // 8)
    stayed = (later * foot).sum(axis=0) > 0.5 * np.maximum(foot.sum(axis=0), 1)
    left = first & stayed & (rows < (later > 0.3).argmax(axis=0))
    # seen from above, liquid behind it soon hides how far it came down: a few times what noise of the masks would leave
    return float(min(left.sum() / (0.1 * area), 1.0) * min(gained.sum() / (0.5 * area), 1.0))


def estimate_up(
    kind: str | FluidKind,
    mask: Bool[np.ndarray, "h w"],
    displacement: Float[np.ndarray, "h w 2"],
    confidence: Float[np.ndarray, "h w"],
    camera: PinholeCamera,
    picture: PictureEvidence | None = None,
    *,
    given: tuple[float | None, float | None] = (None, None),
    level_prior: float = slope.LEVEL,
) -> UpEvidence:
    """The camera's tilt: median pitch and mean roll of the posterior, and how much of the habit's spread it took away.

    How people hold cameras at such a fluid is the prior. Sky and plumb lines (`fluidlift.shape.view`) speak beside all
    kinds, a learned model of the view where one was asked, and the upper end of the water for a stream. Over a stream,
    the perspective of its motion and of its pattern shows the tilt as well (`slope.estimate_tilt`); of motion across
    the picture, or a pattern that is not the same all over, that is little. The edges of a body that stands point to
    what lies below the camera (`prism.upright_tilt`). What falls does so along the vertical, which gives the roll.

    Args:
        kind: of the fluid.
        mask: fluid pixels.
        displacement: mean optical flow, px per frame.
        confidence: of the flow.
        camera: for the focal length; its pose is not used.
        picture: what the pictures say beside the motion; None: nothing.
        given: pitch (degrees below the horizon) and roll (degrees clockwise), each where the user gave it.
        level_prior: share of such streams that are level.
    """
    kind = kind_of(kind)
    picture = picture or PictureEvidence()
    pitch, roll = given
    if kind.starts_at_rest and mask.any():
        (mean, sigma), lean, words = kind.usual_pitch, 0.0, ["upright edges of the body"]
        before = mean, sigma
        if picture.learned is not None:
            before, lean = picture.learned.pooled_pitch(before), picture.learned.pooled_roll(ROLL)
            words.append(picture.learned.words)
        turned = lean if roll is None else roll
        found, left = prism.upright_tilt(mask, lambda p: level_camera(camera, UpEvidence(p, turned, "", 0.0)), before)
        tilt = slope.TiltEvidence(found, lean, left, float(np.clip(1.0 - left / sigma, 0.0, 1.0)))
    elif kind.nearly_level:
        tilt, words = _tilt_of_plane(kind, mask, displacement, confidence, camera, picture, level_prior)
    else:
        tilt, words = _tilt_in_air(kind, mask, displacement, confidence, camera, picture)
    source = ", ".join(words) if words else f"usual view of a {kind}"
    trust = tilt.gained
    if pitch is not None or roll is not None:
        source = "user" if pitch is not None and roll is not None else f"user and {source}"
        trust = 1.0 if pitch is not None else trust
    return UpEvidence(
        float(tilt.pitch if pitch is None else pitch), float(tilt.roll if roll is None else roll), source, trust,
        tilt.pitch_error if pitch is None else 0.0,
    )  # fmt: skip


def _tilt_of_plane(
    kind, mask, displacement, confidence, camera, picture, level_prior
) -> tuple[slope.TiltEvidence, list[str]]:
    """What its motion, its pattern and its surroundings say; and which of them spoke.

    Waves and whirls of standing water are no motion of a plane as a whole: their perspective is not asked. That of its
    pattern is, where it is not in a vessel.
    """
    tilted = _tilted(camera)
    if picture.horizon is not None:
        return _without_motion(kind, tilted, replace(picture, waterline=None), None), picture.words
    if not kind.runs_nearly_level:
        if picture.contained:
            picture = replace(picture, texture=None)
        words = [] if picture.texture is None else ["perspective of its pattern"]
        return slope.estimate_tilt(None, tilted, picture, kind=kind), words + picture.words
    # a chute is another plane than what it comes down onto
    steep = chute.chute_pixels(tilted(STREAM.usual_pitch[0], 0.0), mask, displacement, confidence)
    lying = confidence * ~np.any(steep, axis=0) if steep else confidence
    if steep:
        picture = replace(picture, texture=None)
    patches = None if picture.contained else slope.flow_patches(mask, displacement, lying)
    tilt = slope.estimate_tilt(patches, tilted, picture, level_prior)
    motion = [] if patches is None else ["perspective of the flow"]
    pattern = ["perspective of its pattern"] if picture.texture is not None and patches is not None else []
    return tilt, motion + pattern + picture.words


def _tilt_in_air(kind, mask, displacement, confidence, camera, picture) -> tuple[slope.TiltEvidence, list[str]]:
    """Of a body in the air: its surroundings, and the direction in which it falls."""
    picture = replace(picture, waterline=None)
    lean = None
    if kind.falls_freely:  # wind leans smoke more often than hands turn cameras
        weight = np.where(mask, confidence * np.linalg.norm(displacement, axis=-1), 0.0)
        down = (weight[..., None] * displacement).sum((0, 1))
        if down[1] > 0 and weight.sum() > 0:
            lean = float(np.degrees(np.arctan2(-down[0], down[1])))
    if lean is not None and abs(lean) >= STRAIGHT:
        lean = None
    tilt = _without_motion(kind, _tilted(camera), picture, lean)
    return tilt, picture.words + (["direction of the fall"] if lean is not None else [])


def _without_motion(kind, tilted, picture, lean) -> slope.TiltEvidence:
    """The posterior of pitch and roll from habit, the pictures, and the lean of what falls (degrees)."""
    if len(kind.pitch_habits) == 1 and lean is None and not picture.speaks:
        return slope.TiltEvidence(kind.pitch_prior[0], 0.0, kind.pitch_prior[1], 0.0)  # free of the grid's rounding
    pitches, rolls = np.arange(-24.0, 89.0, 1.0), np.arange(-5.0, 5.01, 0.5) * ROLL
    log = habit_prior(kind, pitches, picture.scene)[:, None] - 0.5 * (rolls / ROLL) ** 2
    if lean is not None:
        log = log - 0.5 * ((rolls - lean) / ROLL) ** 2
    if picture.speaks:
        known = rolls[::2]  # and between them
        seen = np.array([[picture.tilt(tilted(float(p), float(r))) for r in known] for p in pitches])
        log += np.array([np.interp(rolls, known, row) for row in seen])
    if picture.horizon is not None:
        log += horizon_evidence(tilted(0.0, 0.0), picture.horizon, pitches, rolls)
    log = picture.with_learned(log, pitches, rolls)
    return slope.tilt_posterior(pitches, rolls, log, kind.usual_pitch)


def _tilted(camera: PinholeCamera):
    return lambda pitch, roll: level_camera(camera, UpEvidence(pitch, roll, "", 0.0))


def level_camera(camera: PinholeCamera, up: UpEvidence) -> PinholeCamera:
    """The camera at the origin of a frame whose z axis is up and whose y axis points away from the viewer."""
    p, r = np.radians(up.pitch), np.radians(up.roll)
    right = np.array([1.0, 0.0, 0.0])
    forward = np.array([0.0, np.cos(p), -np.sin(p)])
    down = np.cross(forward, right)
    turned_right = np.cos(r) * right - np.sin(r) * down  # the picture turns clockwise when the camera turns against it
    turned_down = np.cross(forward, turned_right)
    rotation = np.stack([turned_right, turned_down, forward])
    return PinholeCamera(camera.focal, camera.center, camera.size, RigidTransform(rotation, np.zeros(3)))
