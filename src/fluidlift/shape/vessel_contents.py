"""What is in a vessel whose rim is seen: a level that shows as an ellipse within that of the rim.

A rim that lies level and a liquid's surface below it are two level circles about one upright axis. From far away they
are ellipses of one flatness, and circles on the rim's own disc (its center 0, its radius 1, down is down):
the surface's center lies below the rim's by as much as the liquid stands below the rim, its radius is that of the
wall at that height. The wall is taken as a cone. What is seen of the surface is what the near part of the rim does not
hide; what lies above it within the rim is wall. There the look changes along the whole arc in one way: that places the
level, one for a frame, and it goes one way while a vessel fills.

A rim says nothing of a liquid. That there is one is seen when its level rises, or when what lies within the rim is
lively and what lies around it is not: a plate, an empty pan or a hub have neither.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from fluidlift.shape.evidence import Evidence
from fluidlift.shape.min_cut import disc as patch
from fluidlift.shape.min_cut import spread
from fluidlift.shape.view import find_rims
from fluidlift.shape.view.roundness import Ellipse
from fluidlift.types.clip import Label

PIXELS = 128
"""of a disc's picture, from side to side"""
REACH = 1.15
"""radii that it shows to each side"""
NARROWEST = 12.0
"""px, half the width of a rim within which a level is looked for: in flatter ones an arc lies on the rim itself"""
AROUND = np.radians(np.arange(0.0, 360.0, 5.0))
"""places on a circle"""
ACROSS = 0.04
"""radii from an outline to where the look is read on both of its sides: a pixel or two of a small vessel"""
THINNEST = 0.8
"""radius of a rim's inner edge, at least (a choice: the wall of a thick mug is an eighth of its radius)"""
HALF_AS_CLEAR = 0.5
"""of the clearest edge of a rim: the innermost that is as clear is its inner edge"""
LOWEST, STEP = 1.3, 0.03
"""radii in the disc's picture that a level's center lies below the rim's at most, and between two that are tried"""
SMALLEST_LEVEL, STEP_LEVEL = 0.4, 0.02
"""radius of a level, at least, and between two that are tried"""
TAPERS = np.radians(np.arange(-10.0, 61.0, 10.0))
"""angles of the wall to the upright that are tried, wider above"""
TAPER_SPREAD = np.radians(30.0)
"""of them, standard deviation (a choice: mugs have 5 degrees, cups 15 to 25, bowls 45 at the rim)"""
LIPS, LIP_SPREAD = np.array([0.0, 0.05, 0.1]), 0.15
"""radii that the wall starts within the rim's inner edge, for a rim that is rolled or has a lip, and their standard
deviation (a choice)"""
CLEAR_OF_RIM = 0.08
"""radii within the rim's inner edge, beyond which what is seen beside an arc may be the rim"""
FEWEST = 10
"""places of an arc that must be seen, 50 degrees"""
WIDTH = 0.6
"""radii that an arc must span to be told from a spot"""
CONTRAST = 10.0
"""grey levels of difference across an arc that is half believed"""
AGREES = 0.5
"""of an arc's median difference, along it: places with as much agree with it"""
ENOUGH = 20.0
"""places of an arc that are half believed: 100 degrees"""
BRIM = 0.25
"""what a level at the rim itself, which has no arc, is worth: half an arc of `CONTRAST` that agrees"""
AT_RIM = 0.06
"""radii below the rim at which it counts as there"""
ONE_WAY = 0.02
"""of an arc's worth that a level which goes up or down must gain by it over one that stays"""
TIMES = 16
"""at which the level is looked for, at most"""
LIVELY = 0.2
"""of a level, at least, that moves or changes where a liquid is in the vessel: a shadow or a glint is less"""
AROUND_IT = (1.12, 1.5)
"""radii between which a vessel's surroundings are looked at, on its near side: what pours in comes from above"""
QUIETER = 0.25
"""of the share of the level that is lively, at most, around it: in a stream, or under a hand, a plate is no vessel"""
RISES = 0.1
"""radii that a level rises on the disc, from which it is taken to: three steps between levels that are tried"""
GAP = 0.1
"""radii over which pieces of a jet are of one piece with what it falls into"""
AFLOAT = 0.8
"""of something that moves as a whole, within a rim, from which it is taken to drift on the liquid: what swings in
before it reaches beyond the rim"""
WIDER = 3.0
"""times as wide as where it is seen before a vessel's wall a jet is above it, at most: falling, it draws in as the root
of its speed, here from a ninth of that (a choice). What is wider is what it is poured from"""
MARGIN = 1.04
"""radii to which what is seen within a rim may be marked over it"""


@dataclass(frozen=True)
class Disc:
    """The rim's own disc in the picture, where a circle is a level circle."""

    center: np.ndarray
    """px"""
    long: np.ndarray
    """[2], px: its half length, to the right"""
    down: np.ndarray
    """[2], px: its half width, downwards"""

    @classmethod
    def of(cls, rim: Ellipse) -> Disc:
        """Of a rim."""
        values, axes = np.linalg.eigh(rim.covariance)
        axis = axes[:, 1] if axes[0, 1] >= 0.0 else -axes[:, 1]
        if abs(axis[1]) > abs(axis[0]):  # nearly round: no axis of its own
            axis = np.array([1.0, 0.0])
        across = np.array([-axis[1], axis[0]])
        half = 2.0 * np.sqrt(values)
        return cls(np.asarray(rim.center), axis * half[1], across * half[0])

    @property
    def flatness(self) -> float:
        """Its width over its length: sine of the tilt from which it is seen."""
        return float(np.linalg.norm(self.down) / np.linalg.norm(self.long))

    def lookup(self) -> tuple[np.ndarray, np.ndarray]:
        """u, v (float32, samples of the picture) of the disc's own picture."""
        x, y = np.meshgrid(*[np.linspace(-REACH, REACH, PIXELS)] * 2)
        u, v = (self.center + x[..., None] * self.long + y[..., None] * self.down - 0.5).transpose(2, 0, 1)
        return u.astype(np.float32), v.astype(np.float32)

    def radius(self, place: np.ndarray) -> float:
        """Of a place of the picture [2] px, on the disc."""
        return float(np.linalg.norm((place - self.center) @ np.linalg.inv(np.stack([self.long, self.down]))))

    def coordinates(self, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """x, y on the disc of a picture's pixels [h,w]."""
        pixels = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), -1) + 0.5 - self.center
        found = pixels @ np.linalg.inv(np.stack([self.long, self.down]))
        return found[..., 0], found[..., 1]


@dataclass(frozen=True)
class Vessel:
    """A rim and how high what it holds stands."""

    disc: Disc
    inner: float
    """radius of the rim's inner edge on the disc"""
    wall: float
    """radius of the wall at the rim's height"""
    taper: float
    """radii that the wall draws in per radius that the level's center lies lower"""
    below: Float[np.ndarray, " t"]
    """radii that the level's center lies below the rim's on the disc, in every frame"""
    worth: float
    """of the arcs that show it, 0 to 1"""

    @property
    def fills(self) -> bool:
        """Whether its level rises."""
        return float(self.below[0] - self.below[-1]) > RISES

    def opening(self, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
        """What is seen through the rim."""
        x, y = self.disc.coordinates(shape)
        return np.hypot(x, y) < self.inner

    def surface(self, t: int, shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
        """What is seen of the liquid's level in frame t."""
        x, y = self.disc.coordinates(shape)
        low = float(self.below[t])
        return (np.hypot(x, y) < self.inner) & (np.hypot(x, y - low) < self.wall - self.taper * low)

    def meets(self, other: Vessel) -> bool:
        """Whether one of both rims lies about the other's middle: a rim's two edges, or a level and its rim."""
        pairs = ((self, other), (other, self))
        return any(bool(a.disc.radius(b.disc.center) < a.inner) for a, b in pairs)


@dataclass(frozen=True)
class _Arcs:
    """All levels that are tried within a rim, and where the look is read beside them; k heights, s radii, a places."""

    below: Float[np.ndarray, " k"]
    radius: Float[np.ndarray, " s"]
    within: Float[np.ndarray, "2 k s a"]
    beyond: Float[np.ndarray, "2 k s a"]
    seen: Bool[np.ndarray, "k s a"]
    """not hidden by the near part of the rim"""

    @classmethod
    def of(cls, inner: float) -> _Arcs:
        below = np.arange(0.0, LOWEST, STEP)
        radius = np.arange(SMALLEST_LEVEL, inner + 1e-3, STEP_LEVEL)
        cosine, sine = np.cos(AROUND), np.sin(AROUND)
        low, size = below[:, None, None], radius[None, :, None]
        within, beyond = (
            np.stack(np.broadcast_arrays(0.0 * low + r * cosine, low + r * sine))
            for r in (size - ACROSS, size + ACROSS)
        )
        return cls(below, radius, within, beyond, np.hypot(*beyond) < inner - CLEAR_OF_RIM)

    def worth(self, picture: Float[np.ndarray, "n n 3"]) -> Float[np.ndarray, "k s"]:
        """Of each level, 0 to 1: how much of its arc agrees on a difference, times how much that is believed."""
        apart = _read(picture, self.within) - _read(picture, self.beyond)
        wide = np.where(self.seen, self.beyond[0], -9.0).max(-1) - np.where(self.seen, self.beyond[0], 9.0).min(-1)
        told = (self.seen.sum(-1) >= FEWEST) & (wide >= WIDTH)
        found = np.zeros(told.shape)
        for place in zip(*np.nonzero(told), strict=True):
            found[place] = _agreement(apart[place][self.seen[place]])
        return found


def filled_vessels(evidence: Evidence, solids: Bool[np.ndarray, "h w"]) -> tuple[Vessel, ...]:
    """Vessels that are seen to hold a liquid, one for each rim of several that are nested.

    Args:
        evidence: of the clip.
        solids: what moves and is no fluid.
    """
    lively = (evidence.fine_activity > evidence.level) & ~solids
    found: list[Vessel] = []
    for rim in find_rims(evidence.colours):
        disc = Disc.of(rim)
        x, y = disc.coordinates(lively.shape)
        radius = np.hypot(x, y)
        around = (radius > AROUND_IT[0]) & (radius < AROUND_IT[1]) & (y > 0.0)
        stirs = float(lively[around].mean()) if around.any() else 0.0
        if rim.axes[1] < NARROWEST or stirs > QUIETER or not lively[radius < 1.0].any():
            continue
        vessel = _levelled(evidence, disc)
        level = np.any([vessel.surface(t, lively.shape) for t in (0, len(vessel.below) // 2, -1)], axis=0)
        share = float(lively[level].mean()) if level.any() else 0.0
        if share >= LIVELY and stirs <= QUIETER * share:
            found.append(vessel)
    kept: list[Vessel] = []
    for vessel in sorted(found, key=lambda v: -v.worth):
        if not any(vessel.meets(other) for other in kept):
            kept.append(vessel)
    return tuple(kept)


def with_contents(
    found: Iterator[tuple[np.ndarray, np.ndarray]],
    vessels: Sequence[Vessel],
    evidence: Evidence,
    barred: Bool[np.ndarray, "h w"],
    held: Bool[np.ndarray, "h w"],
    *,
    alone: bool,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Labels u8 and confidence f32 [h,w] of every frame, where vessels show their liquid up to its level.

    What was taken for fluid on the wall above the level is only if it looks like the liquid and falls into it. While a
    vessel fills, the fluid is what it holds and what falls in: other pieces, and what is too wide for a jet, are of
    what pours, such as a pot of glass.

    Args:
        found: labels and confidence without that.
        vessels: with their levels.
        evidence: of the clip.
        barred: what hides a liquid or lies outside.
        held: where a person said what there is.
        alone: whether the rest of the fluid is a guess: then what does not come into a vessel from above is left out.
    """
    shape = (evidence.noise.shape[0], evidence.noise.shape[1])
    places = [vessel.disc.coordinates(shape) for vessel in vessels]
    withins = [np.hypot(x, y) < MARGIN for x, y in places]
    bars = [_from_outside(barred, within) for within in withins]
    mouths = [(np.hypot(x, y) < AROUND_IT[0]) & (y < 0.0) for x, y in places]
    others, jet = ~np.any(withins, axis=0) & ~held, 0.0
    for t, (before, doubted) in enumerate(found):
        labels, sure = before.copy(), doubted.copy()
        picture = evidence.source[t].astype(np.float32)
        near, in_air = np.zeros(shape, bool), np.zeros(shape, bool)
        for vessel, within, bar, mouth in zip(vessels, withins, bars, mouths, strict=True):
            wet = vessel.surface(t, shape) & ~bar
            falling = _falling_in(picture, wet, within & ~wet, before == Label.FLUID)
            own = within & ~held
            labels[own] = np.where(wet | falling, np.uint8(Label.FLUID), np.uint8(Label.BACKGROUND))[own]
            sure[own] = np.float32(vessel.worth)
            in_air |= falling
            near |= _within_reach(wet | falling, vessel) if vessel.fills else mouth
        if alone or any(vessel.fills for vessel in vessels):
            outside = (labels != Label.BACKGROUND) & others
            fluid = labels == Label.FLUID
            jet = _half_width(in_air) if in_air.any() else jet
            if jet > 0.0:
                wide = cv2.morphologyEx(fluid.astype(np.uint8), cv2.MORPH_OPEN, patch(WIDER * jet)) > 0
                labels[outside & spread(wide, jet)] = Label.BACKGROUND
                outside &= labels != Label.BACKGROUND
            parts = cv2.connectedComponents(outside.astype(np.uint8), connectivity=8)[1]
            labels[outside & ~np.isin(parts, np.unique(parts[near & outside]))] = Label.BACKGROUND
        yield labels, sure


def _half_width(jet: Bool[np.ndarray, "h w"]) -> float:
    """Px, of a jet in most of its rows."""
    rows = jet.sum(axis=1)
    return 0.5 * float(np.median(rows[rows > 0]))


def _within_reach(liquid: Bool[np.ndarray, "h w"], vessel: Vessel) -> Bool[np.ndarray, "h w"]:
    """A vessel's liquid with what is near enough to be of one piece with it."""
    return cv2.dilate(liquid.astype(np.uint8), patch(GAP * float(np.linalg.norm(vessel.disc.long)))) > 0


def _from_outside(barred: Bool[np.ndarray, "h w"], within: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """What is barred, without the pieces within a vessel: a pattern that drifts on its liquid is carried with it."""
    count, parts = cv2.connectedComponents(barred.astype(np.uint8), connectivity=4)
    parts = parts.astype(np.intp)
    inside = np.bincount(parts[within], minlength=count) > AFLOAT * np.bincount(parts.ravel(), minlength=count)
    inside[0] = False
    return barred & ~inside[parts]


def _falling_in(
    picture: Float[np.ndarray, "h w 3"], wet: Bool[np.ndarray, "h w"], wall: Bool[np.ndarray, "h w"],
    taken: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:  # fmt: skip
    """What was taken for fluid before a vessel's wall, is more like the liquid than like the wall and meets it."""
    if not wet.any() or not (wall & taken).any():
        return np.zeros_like(wet)
    liquid, dry = (np.median(picture[part], axis=0) for part in (wet, wall))
    apart = liquid - dry
    alike = (picture - dry) @ apart > 0.5 * float(apart @ apart)
    parts = cv2.connectedComponents((wet | (wall & taken & alike)).astype(np.uint8), connectivity=8)[1]
    return wall & taken & alike & np.isin(parts, np.unique(parts[wet]))


def _read(picture: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Colors [...,3] of a disc's picture at places [2,...]."""
    x, y = ((places + REACH) * ((PIXELS - 1) / (2.0 * REACH))).astype(np.float32)
    flat = (x.reshape(len(x), -1), y.reshape(len(y), -1))
    return cv2.remap(picture, *flat, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).reshape(*x.shape, -1)


def _agreement(apart: Float[np.ndarray, "n 3"]) -> float:
    """Share of differences that agree on one, 0 to 1, less where that is faint or they are few."""
    usual = np.median(apart, axis=0)
    size, count = float(np.linalg.norm(usual)), len(apart)
    agree = float((apart @ usual > AGREES * size * size).mean())
    return agree * size / (size + CONTRAST) * count / (count + ENOUGH)


def _levelled(evidence: Evidence, disc: Disc) -> Vessel:
    """A rim with the levels that fit it best."""
    lookup, kept = disc.lookup(), evidence.pictures

    def seen(picture: np.ndarray) -> np.ndarray:
        return cv2.remap(picture.astype(np.float32), *lookup, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    inner = _inner_edge(seen(evidence.typical))
    arcs = _Arcs.of(inner)
    times = np.unique(np.linspace(0, len(kept) - 1, min(TIMES, len(kept))).round().astype(int))
    near = [kept[max(t - 1, 0) : t + 2] for t in times]  # a jet's pattern and a splash are gone in their median
    worth = np.stack([arcs.worth(np.median([seen(p) for p in three], axis=0)) for three in near])
    # a level h lower is seen h cos(tilt) lower, h cot(tilt) of the disc's radii: tan(tilt) turns one into the other
    steep = disc.flatness / np.sqrt(max(1.0 - disc.flatness**2, 0.02))
    best = None
    for angle in TAPERS:
        taper = float(np.tan(angle) * steep)
        for lip in LIPS:
            place = np.round((inner - lip - taper * arcs.below - SMALLEST_LEVEL) / STEP_LEVEL).astype(int)
            known = (place >= 0) & (place < len(arcs.radius))
            of_height = worth[:, np.arange(len(place)), np.clip(place, 0, len(arcs.radius) - 1)] * known
            of_height *= np.exp(-0.5 * ((angle / TAPER_SPREAD) ** 2 + (lip / LIP_SPREAD) ** 2))
            of_height[:, arcs.below < AT_RIM] = BRIM if lip == 0.0 and angle == 0.0 else 0.0
            total, path = _course(of_height)
            if best is None or total > best[0]:
                best = (total, taper, float(inner - lip), arcs.below[path])
    assert best is not None
    total, taper, wall, below = best
    frames = np.arange(len(evidence.source))
    levels = np.interp(frames, evidence.source.sampled[times], cv2.blur(below[:, None], (1, 3))[:, 0])
    return Vessel(disc, inner, wall, taper, levels, total)


def _inner_edge(picture: Float[np.ndarray, "n n 3"]) -> float:
    """Radius of the innermost edge that runs along the near half of a rim."""
    near = np.stack([np.cos(AROUND), np.sin(AROUND)])[:, np.sin(AROUND) > 0.0]
    radii = np.arange(THINNEST, 1.0 + 1e-3, 0.02)
    inside, outside = (radii + away for away in (-0.03, 0.03))
    apart = _read(picture, near[:, None] * inside[:, None]) - _read(picture, near[:, None] * outside[:, None])
    usual = np.median(apart, axis=1)
    agree = (apart * usual[:, None]).sum(-1) > AGREES * (usual**2).sum(-1)[:, None]
    clear = np.linalg.norm(usual, axis=-1) * agree.mean(axis=1)
    padded = np.pad(clear, 1)
    peaks = (clear >= padded[:-2]) & (clear >= padded[2:]) & (clear >= HALF_AS_CLEAR * clear.max())
    return float(radii[np.flatnonzero(peaks)[0]])


def _course(worth: Float[np.ndarray, "t k"]) -> tuple[float, Int[np.ndarray, " t"]]:
    """Mean worth of the best course of a level that goes one way or stays, and its heights."""
    steady = worth.sum(axis=0)
    found = (float(steady.max()), np.full(len(worth), int(steady.argmax())))
    for table in (worth, worth[::-1]):  # rising, and sinking, which is rising backwards
        total, before = table[0].copy(), []
        for row in table[1:]:
            # the best that began at this height or below it
            best = np.maximum.accumulate(total[::-1])[::-1]
            at = np.where(total >= best, np.arange(len(total)), len(total))
            before.append(np.minimum.accumulate(at[::-1])[::-1])
            total = best + row
        path = [int(total.argmax())]
        for back in before[::-1]:
            path.append(int(back[path[-1]]))
        path = np.array(path[::-1] if table is worth else path)
        if total.max() > found[0] + ONE_WAY * len(worth):
            found = (float(total.max()), path)
    return found[0] / len(worth), found[1]
