"""Advected textures (Lagrangian patches): the fine look of a liquid's surface, on patches that are not drawn out.

Foam, glitter and ripples are carried by the flow, and are made anew all the time. Carried alone they would be stirred
into streaks after a second. So the look is that of overlapping patches (Lagrangian texture advection: Yu, Neyret,
Bruneton, Holzschuch 2011): each moves with the flow as a rigid piece of the look at rest, turns as its path does, and
gives way to a new one when the flow has sheared it too far. Speed and pattern both stay those that were seen, for any
time.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Num
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.look.footage import FluidFootage
from fluidlift.look.picture_texture import PictureTexture
from fluidlift.look.seen_texture import SeenTexture
from fluidlift.look.surface_map import SurfaceMap, sampled
from fluidlift.numerics.nearest import nearest, nearest_of_few
from fluidlift.numerics.short_axis import mean_of, most
from fluidlift.types.rows import rows

APART = 0.6
"""radii between patches: each place is covered by several"""

LIMIT = 1.0
"""shear (no unit: strain added up) after which a patch gives way"""

FADE = (2.0, 12.0)
"""frames in which patches come and go, at least and at most; in between, a third of the time that the limit takes"""

FILM_FADE = 1 / 6
"""of the film, in which its patches come and go: of 1/4, made films that drift by a quarter of a pixel per frame
seem to drift otherwise by 0.25 of it, of 1/6 by 0.22, of 1/9, where they pop, by 0.24"""

BEGIN = 0.15
"""of the film, within which a patch begins that follows another one: from half of it on, patches give way so often that
the same films seem to drift otherwise by 0.5 of their speed; from the start on, all films would repeat themselves"""

AFTER = 0.5
"""frames after the film's last one at which patches that show all of it give way: with the next frame, however instants
are rounded"""

LATEST = 0.6
"""of the film, before which patches begin where all give way at once, as the first ones do (a choice); where a part of
them does, so much less beyond `BEGIN`. Then they do not end at once again"""

SHARPNESS = 8
"""power of the weights: blends of two patterns have less contrast than either, and stay narrow; between places, not in
time where patches stay"""

OVERLAP = 8
"""patches that share a place at most"""

SMOOTH = 0.35
"""radii over which a patch feels the flow"""

TRIES = 12
"""places that are looked at for the source of a new patch"""

LARGEST_RATIO = 1.5
"""by which a colour is brightened or darkened at most where it comes from another shade"""

FASTEST = 2.0
"""times its own speed that footage plays at most: faster, frames are skipped that a viewer misses"""

UNLIKE = 0.5
"""difference of the flow from the filmed one, over the filmed one, from which a place looks otherwise than it was
filmed: as when a stream is half as fast, or turned by 30 degrees"""

SAME = 0.25
"""px from a point's own place in the picture within which a patch is at home"""

GOOD = 0.8
"""share of a source that was seen, from which it is taken at once"""

FirstEnd = Literal["carried", "faded", "apart"]
"""how the first patches of a film give way (`TexturePatches`)"""


@dataclass
class Patches:
    """State of m patches."""

    centers: Float[np.ndarray, "m 2"]
    """x, y, m"""
    sources: Float[np.ndarray, "m 2"]
    """where the centre's look is taken from at rest, m"""
    turns: Float[np.ndarray, " m"]
    """about the vertical, radians"""
    strains: Float[np.ndarray, " m"]
    """shear so far, no unit"""
    presences: Float[np.ndarray, " m"]
    """0 to 1"""
    instants: Num[np.ndarray, " m"]
    """of the footage that they show, frames"""
    ends: Float[np.ndarray, " m"]
    """instants at which they give way"""

    def __post_init__(self) -> None:
        m = len(self.turns)
        shapes = [(self.centers, (m, 2)), (self.sources, (m, 2))]
        shapes += [(a, (m,)) for a in (self.turns, self.strains, self.presences, self.instants, self.ends)]
        for array, shape in shapes:
            require(array.shape == shape, f"patches with arrays of another shape, {array.shape}", str(shape))

    @classmethod
    def none(cls) -> Patches:
        """No patches."""
        return cls(np.zeros((0, 2)), np.zeros((0, 2)), *np.zeros((5, 0)))

    def __len__(self) -> int:
        return len(self.turns)

    def select(self, index: np.ndarray) -> Patches:
        """Some of them."""
        return Patches(*(getattr(self, f.name)[index] for f in fields(self)))

    def joined(self, other: Patches) -> Patches:
        """These and others."""
        return Patches(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))

    @property
    def going(self) -> Bool[np.ndarray, " m"]:
        """Those that give way."""
        return (self.strains > LIMIT) | (self.instants >= self.ends)


class TexturePatches:
    """Patches over a moving surface.

    With footage, a patch shows what its place looked like from some instant of the film on, and gives way when the
    film ends. Foam is born at its rock, breaks up, and is carried on by the footage itself, so a patch stays where it
    is as long as the fluid flows as it was filmed (`edited` False). Where a person changed the scene it moves by the
    difference of the two flows, and its footage plays at the ratio of their speeds.

    Args:
        texture: the look at rest.
        radius: of a patch, m.
        footage: the fluid over time; None: patches are pieces of the look at rest.
        edited: whether the fluid flows otherwise than it was filmed.
        start: instant of the footage, frames, that the body at rest shows.
        together: all patches show the same instant: waves that pass over water that stays are one thing, from shore to
            shore, and so is a jet. At the end of the film all begin anew.
        again: instant of the footage, frames, at which they then begin.
        first_end: how the first ones give way. "carried": after the film's last frame, which the current carries on
            while they go (where nothing was edited); "faded": before it, as later ones do (waves leave the water where
            it is, and nothing carries them on); "apart": as many in each frame from the first one on, so that the step
            from a loop's end to its beginning is one as any other.

    Raises:
        ValueError: a radius that is not positive, or a texture without any usable place.
    """

    def __init__(
        self,
        texture: SeenTexture | PictureTexture,
        radius: float,
        *,
        footage: FluidFootage | None = None,
        edited: bool = False,
        start: float = 0.0,
        together: bool = False,
        again: float = 0.0,
        first_end: FirstEnd = "carried",
    ) -> None:
        require(radius > 0, f"radius {radius}", "positive metres")
        require(texture.usable, "a texture of which nothing was seen")
        self.state = Patches.none()
        self._texture, self._radius = texture, radius
        self._footage, self._edited, self._start = footage, edited, start
        self._together, self._again, self._first_end = together, again, first_end
        self._good = texture.trust_within(radius)
        self._seen_flow = _gradients(texture.surface, SMOOTH * radius)[0]

    def advance(self, surface: SurfaceMap, interval: float, rng: np.random.Generator) -> None:
        """Carry the patches along for an interval (s; 0: the first instant), and cover what they have left bare."""
        if interval > 0 and len(self.state):
            self._carry(surface, interval)
        bare = surface.columns()
        if not len(bare):
            return
        if self._stays:
            self._begin_anew(surface, rng)
        lasting = self.state.centers[~self.state.going]
        uncovered = np.ones(len(bare), bool)
        if len(lasting):
            uncovered = nearest_of_few(lasting, bare, 1)[0][:, 0] > APART * self._radius
        centers = _spread(bare, uncovered, APART * self._radius, rng)
        if len(centers):
            self.state = self.state.joined(self._fresh(centers, interval == 0, surface, rng))

    @property
    def leading(self) -> float | None:
        """Instant of the footage, frames, of the patch that is most present; None without patches or footage."""
        if self._footage is None or not len(self.state):
            return None
        return float(self.state.instants[int(np.argmax(self.state.presences))])

    @property
    def _stays(self) -> bool:
        """Patches stay in their places, each with the film's own motion in it."""
        return self._footage is not None and not self._edited

    def _begin_anew(self, surface: SurfaceMap, rng: np.random.Generator) -> None:
        """A patch that has come to the end of its film gives way to one in its own place."""
        going = self.state.going
        last, lasting = self.state.centers[going], self.state.centers[~going]
        if len(last) and len(lasting):
            last = last[nearest(lasting, last)[0] > 0]
        if len(last):
            self.state = self.state.joined(self._fresh(np.unique(last, axis=0), False, surface, rng))

    def _carry(self, surface: SurfaceMap, interval: float) -> None:
        s = self.state
        if self._stays and self._footage is not None:  # nothing is carried: how the surface moves need not be known
            rate, centers, turns = np.zeros(len(s)), s.centers, s.turns
            instants = s.instants + interval / self._footage.interval
            # what the last frame of a film shows is carried on as the fluid was when it was filmed
            over = instants > len(self._footage) - 1 + AFTER
            sources = s.sources.copy()
            sources[over] -= interval * self._texture.surface.at(self._seen_flow, centers[over])
        else:
            rate, centers, turns, instants = self._with_the_flow(surface, interval)
            sources = s.sources
        strains = s.strains + interval * rate
        fade = np.clip(LIMIT / 3 / np.maximum(rate * interval, 1e-9), *FADE)
        if self._footage is not None:  # later ones must be gone by the film's last frame
            fade = np.clip(_fade_of(len(self._footage)) / np.maximum(instants - s.instants, 1e-9), 1.0, fade)
        going = (strains > LIMIT) | (instants >= s.ends)
        presences = np.clip(s.presences + np.where(going, -1, 1) / fade, 0.0, 1.0)
        new = Patches(centers, sources, turns, strains, presences, instants, s.ends)
        away = nearest_of_few(surface.columns(), centers, 1)[0][:, 0]  # without any, endlessly far
        self.state = new.select(~(new.going & (presences <= 0)) & (away < self._radius))

    def _with_the_flow(
        self, surface: SurfaceMap, interval: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Shear (1/s), centres (m), turns (radians) and instants (frames) of patches that go with the surface."""
        s, (flow, spin, shear) = self.state, _gradients(surface, SMOOTH * self._radius)
        rate = surface.at(shear, s.centers)
        moved, instants = interval * surface.at(flow, s.centers), s.instants
        if self._footage is not None:
            there = self._texture.surface.at(self._seen_flow, s.sources)
            pace = np.linalg.norm(moved, axis=1) / np.maximum(interval * np.linalg.norm(there, axis=1), 1e-9)
            pace = np.minimum(pace, FASTEST)
            moved = moved - interval * pace[:, None] * _turned(there, s.turns)
            instants = s.instants + pace * interval / self._footage.interval
        centers = s.centers + moved
        # a line that is carried along turns at most so fast
        fastest = interval * (np.abs(surface.at(spin, s.centers)) + rate)
        turn = _wrapped(self._heading(surface, flow, centers, s.sources) - s.turns)
        return rate, centers, s.turns + np.clip(turn, -fastest, fastest), instants

    def _heading(self, surface: SurfaceMap, flow: np.ndarray, centers: np.ndarray, sources: np.ndarray) -> np.ndarray:
        """Turn (radians) that lies along the flow at `centers` as the look at rest lies along the flow at `sources`.

        Streaks of foam lie along the flow, however it shears them: turned with half of its vorticity they would not.
        """
        here, there = surface.at(flow, centers), self._texture.surface.at(self._seen_flow, sources)
        return np.arctan2(here[:, 1], here[:, 0]) - np.arctan2(there[:, 1], there[:, 0])

    def _fresh(self, centers: np.ndarray, first: bool, surface: SurfaceMap, rng: np.random.Generator) -> Patches:
        """New patches. Those of the first instant show the body as it is: whole ones, of different age; where that was
        not seen well they soon give way."""
        if self._footage is not None:
            return self._fresh_footage(centers, first, surface, rng)
        none, few = np.zeros(len(centers)), np.full(len(centers), 1 / FADE[1])
        lasting = np.full(len(centers), np.inf)
        if first:
            seen = self._texture.surface.at(self._good, centers) > 0.5 * GOOD
            strains = np.where(seen, rng.uniform(0, 0.5 * LIMIT, len(centers)), 2 * LIMIT)
            return Patches(centers, centers.copy(), none, strains, np.ones(len(centers)), none, lasting)
        sources = np.array([self._source(c, rng) for c in centers])
        turns = _wrapped(self._heading(surface, _gradients(surface, SMOOTH * self._radius)[0], centers, sources))
        return Patches(centers, sources, turns, none, few, none, lasting)

    def _fresh_footage(
        self, centers: np.ndarray, first: bool, surface: SurfaceMap, rng: np.random.Generator
    ) -> Patches:
        """New patches that play: their own place, where it was seen and flows as it did; else one that is like it."""
        assert self._footage is not None
        n, at_home, flow = len(centers), self._texture.trust(centers) > 0.5, None
        if self._edited:
            flow = _gradients(surface, SMOOTH * self._radius)[0]
            here, own = surface.at(flow, centers), self._texture.surface.at(self._seen_flow, centers)
            at_home &= np.linalg.norm(here - own, axis=1) < UNLIKE * np.linalg.norm(own, axis=1)
        if self._together or not self._edited:  # as far as a patch shows anything that was seen
            at_home |= self._seen_within(centers)
        sources = np.array([
            c if home else self._source(c, rng) for c, home in zip(centers, at_home, strict=True)
        ])  # fmt: skip
        turns = np.zeros(n)
        if not at_home.all():
            flow = _gradients(surface, SMOOTH * self._radius)[0] if flow is None else flow
            turns = np.where(at_home, 0.0, _wrapped(self._heading(surface, flow, centers, sources)))
        last, fade = len(self._footage) - 1.0, _fade_of(len(self._footage))
        ends, full = np.full(n, last - fade), np.ones(n)
        if first and self._stays and self._first_end == "carried":
            ends += fade + AFTER
        if self._together:
            lasting = self.state.instants[~self.state.going]
            now = float(np.median(lasting)) if len(lasting) else min(self._start, last) if first else self._again
            begin, presences = now * full, full if first else full / fade
        elif first:
            begin, presences = min(self._start, last) * full, full
            if self._first_end == "apart":
                ends = begin + (rng.permutation(n) + rng.uniform(0, 1, n)) / n * np.maximum(ends - begin, 0.0)
        else:
            begin, presences = rng.uniform(0, BEGIN * last, n), full / fade
            going = self.state.going
            if going.any():  # the more begin at once, the farther apart, or they would end at once again
                begin += rng.permutation(n) / n * going.mean() * (LATEST - BEGIN) * last
        return Patches(centers, sources, turns, 0 * full, presences, begin, ends)

    def _seen_within(self, centers: np.ndarray) -> np.ndarray:
        """Whether anything that was seen is within a radius of places."""
        places = self._texture.surface.middles().reshape(-1, 2)
        return nearest(places[self._texture.trust(places) > 0.5], centers)[0] < self._radius

    def _source(self, center: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Where a new patch takes its look from: near its place (foam is where rocks are), not the same again."""
        reach = self._radius * (1 + 0.3 * np.arange(TRIES))[:, None]
        tried = center + reach * rng.normal(size=(TRIES, 2))
        good = self._texture.surface.at(self._good, tried)
        fine = np.flatnonzero(good > GOOD)
        best = int(fine[0]) if len(fine) else int(np.argmax(good))
        if good[best] > 0.5 * GOOD:
            return tried[best]
        places = self._texture.surface.middles()[self._good > 0.6 * self._good.max()]
        nearest = np.argsort(((places - center) ** 2).sum(axis=1))[: max(len(places) // 10, 1)]
        return places[rng.choice(nearest)]

    def colors(self, points: Float[np.ndarray, "n 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """sRGB [n,3] at points (m) of the surface, in the shade of their place, whether a patch is there [n], and how
        much of the fluid that the patches show [n], 0 to 1: with a film, less where a fluid that sways has left."""
        s, n = self.state, len(points)
        if n == 0 or len(s) == 0:
            return np.zeros((n, 3)), np.zeros(n, bool), np.ones(n)
        places = np.asarray(points[:, :2], np.float64)
        away, patches = nearest_of_few(s.centers, places, min(OVERLAP, len(s)), within=self._radius)
        point, rank = np.nonzero(np.isfinite(away))
        patch, distance = patches[point, rank], away[point, rank]
        weight = (1 - (distance / self._radius) ** 2) ** (2 * SHARPNESS)
        # in one place one instant of the film goes over into another, both with the same motion: a front that runs
        # outwards would have one of its own
        weight = weight * s.presences[patch] ** (1 if self._stays else SHARPNESS)
        heaviest = np.zeros(n)
        np.maximum.at(heaviest, point, weight)
        counts = weight > 1e-3 * heaviest[point]
        point, patch, weight = point[counts], patch[counts], weight[counts]
        # patches in their own place, as all are where nothing was edited, show each point what is at the point
        texture, elsewhere = self._texture, (s.turns != 0.0) | (s.sources != s.centers).any(axis=1)
        sources, away = rows(places, point), np.flatnonzero(elsewhere[patch])
        trust = texture.trust(places).take(point)
        if len(away):
            own = patch[away]
            sources[away] = rows(s.sources, own) + _turned(rows(sources, away) - rows(s.centers, own), -s.turns[own])
            trust[away] = texture.trust(rows(sources, away))
        # what was not seen (a rock, a bank) shows only where no other patch is
        weight = weight * np.clip(2 * trust - 0.8, 1e-4, 1.0)
        if self._footage is not None or not isinstance(texture, SeenTexture):
            pairs = _Pairs(point, away, rows(sources, away), s.instants[patch], weight)
            return self._played(np.asarray(points, np.float64), pairs)
        color, there = texture.colors(sources)
        # brightness alone: tinted by the water of another place, white foam would turn pink
        bright = texture.shade(points).mean(axis=1)[point] / there.mean(axis=1)
        color = color * np.clip(bright, 1 / LARGEST_RATIO, LARGEST_RATIO)[:, None]
        total = np.bincount(point, weight, minlength=n)
        mean = _summed(point, weight[:, None] * color, n) / np.maximum(total, 1e-30)[:, None]
        return np.clip(mean, 0.0, 1.0), total > 0, np.ones(n)

    def _played(self, points: np.ndarray, pairs: _Pairs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Colours [n,3], whether there are any [n], and how much of the fluid is [n], from pairs of a point and a place
        of the footage.

        colour = shade + sum w gain fine / sum w + sum w gain residual / sqrt(sum w^2): the shade is that of the point's
        own place; what differs from the mean keeps its variance where patches overlap (Gagnon et al. 2019). A patch
        that is at home gives the clip's own picture. So do several of the same instant: what they show is one thing,
        whose weights add up before they are squared.
        """
        footage, texture = self._footage, self._texture
        assert footage is not None
        n, point, away, instants, weight = len(points), pairs.point, pairs.away, pairs.instants, pairs.weight
        # at home, a point is looked up where it is seen now, also where the level has changed
        straight = texture.seen_at(points)
        seen = footage.within(straight)
        shade = sampled(footage.shade, seen)
        index, home, there = rows(seen, point), np.ones(len(point), bool), rows(shade, point)
        if len(away):
            of = point[away]
            now, rest = rows(straight, of), texture.index_of(rows(points, of)[:, :2])
            moved = texture.index_of(pairs.sources) + (now - rest)
            home[away], index[away] = most(np.abs(moved - now)) < SAME, footage.within(moved)
            there[away] = sampled(footage.shade, rows(index, away))
        mean, residual, wet = footage.looked_up(index, instants, home)
        brighter = mean_of(shade).take(point) / np.maximum(mean_of(there), 1e-3)
        gain = np.clip(brighter, 1 / LARGEST_RATIO, LARGEST_RATIO)
        fine = mean - there
        covers = np.bincount(point, weight * footage.covers(index, instants), minlength=n)
        covers /= np.maximum(np.bincount(point, weight, minlength=n), 1e-30)
        weight = weight * np.clip(wet, 1e-2, 1.0)
        total = np.bincount(point, weight, minlength=n)
        spread = _spread_of(point, instants, home, weight, n)
        still = _summed(point, (weight * gain)[:, None] * fine, n) / np.maximum(total, 1e-30)[:, None]
        lively = _summed(point, (weight * gain)[:, None] * residual, n) / np.maximum(spread, 1e-30)[:, None]
        return np.clip(shade + still + lively, 0.0, 1.0), total > 0, covers


@dataclass(frozen=True)
class _Pairs:
    """A point and a patch that is there."""

    point: Int[np.ndarray, " m"]
    away: Int[np.ndarray, " k"]
    """pairs whose patch shows another place than its own"""
    sources: Float[np.ndarray, "k 2"]
    """x, y (m) of what these show"""
    instants: Float[np.ndarray, " m"]
    """frames of the footage"""
    weight: Float[np.ndarray, " m"]


def _summed(point: np.ndarray, values: np.ndarray, n: int) -> np.ndarray:
    """Sums [n,3] of the values of each point."""
    return np.stack([np.bincount(point, values[:, k], minlength=n) for k in range(values.shape[1])], axis=-1)


def _spread_of(point: np.ndarray, instants: np.ndarray, home: np.ndarray, weight: np.ndarray, n: int) -> np.ndarray:
    """Root [n] of the variance of a sum of weighted pieces of unit variance, of each point.

    Pieces are independent, but for those at home that show the same frame: these are equal.
    """
    frame = np.rint(instants).astype(np.int64)
    count = int(frame.max(initial=0)) + 1
    key, group = np.unique((point * count + frame)[home], return_inverse=True)
    alike = np.bincount(key // count, np.bincount(group, weight[home]) ** 2, minlength=n)
    return np.sqrt(alike + np.bincount(point[~home], weight[~home] ** 2, minlength=n))


def _fade_of(frames: int) -> float:
    """Frames of a film of so many over which a patch comes or goes."""
    return min(FADE[1], FILM_FADE * frames)


def instants_together(
    frames: int, *, start: float, again: float, pace: float, count: int, first_end: FirstEnd = "carried"
) -> Float[np.ndarray, " n"]:
    """Instant of a film that is most present in each frame of a scene where all patches show the same one.

    Args:
        frames: of the film.
        start: of it, that the first frame of the scene shows.
        again: at which it begins anew.
        pace: frames of the film per frame of the scene.
        count: frames of the scene.
        first_end: as of `TexturePatches`.
    """
    last, fade = frames - 1.0, _fade_of(frames)
    found, now, following = np.empty(count), min(start, last), None
    end = last + AFTER if first_end == "carried" else last - fade
    for frame in range(count):
        found[frame] = min(now, last)
        now += pace
        following = None if following is None else following + pace
        if following is None and now >= end:
            following = again
        if following is not None and following - again >= 0.5 * fade:  # it has come in by as much as the other is gone
            now, end, following = following, last - fade, None
    return found


def _turned(vectors: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Vectors [m,2] turned by angles [m], radians."""
    if not angles.any():  # as all are where nothing was edited
        return vectors
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack([cos * vectors[:, 0] - sin * vectors[:, 1], sin * vectors[:, 0] + cos * vectors[:, 1]], axis=-1)


def _wrapped(angles: np.ndarray) -> np.ndarray:
    """The same angles within half a turn to either side."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def _gradients(surface: SurfaceMap, width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Horizontal velocity [nx,ny,2] (m/s), its spin and its shear [nx,ny] (1/s), over a width (m)."""
    sigma, wet = max(width / surface.pitch, 1.0), surface.wet.astype(np.float64)
    share = np.maximum(ndimage.gaussian_filter(wet, sigma), 1e-6)
    flow = [ndimage.gaussian_filter(surface.velocity[..., a] * wet, sigma) / share for a in (0, 1)]
    (xx, xy), (yx, yy) = (np.gradient(f, surface.pitch) for f in flow)
    # at a shore the filter sees only half of its surroundings, and would turn that into shear
    inside = ndimage.binary_erosion(surface.wet, iterations=2)
    shear = np.sqrt(0.5 * (xx - yy) ** 2 + 0.5 * (xy + yx) ** 2 + 0.25 * (xx + yy) ** 2)
    return np.stack(flow, axis=-1), 0.5 * (yx - xy) * inside, shear * inside


def _spread(places: np.ndarray, bare: np.ndarray, apart: float, rng: np.random.Generator) -> np.ndarray:
    """Some of the bare places, none within a distance of another, so that all are near one."""
    bare, chosen = bare.copy(), []
    for i in rng.permutation(np.flatnonzero(bare)):
        if bare[i]:
            chosen.append(places[i])
            bare &= ((places - places[i]) ** 2).sum(axis=1) > apart**2
    return np.array(chosen).reshape(-1, 2)
