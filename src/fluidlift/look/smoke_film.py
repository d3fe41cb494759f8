"""How opaque smoke is in each place of a film, and its own color there: matting before a known background.

Smoke adds to and takes from what is behind it: a picture is opacity x color + (1 - opacity) x background. With the
background known and one color of thick smoke, a film of it becomes two: its color and its opacity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require

HALF = 0.5
"""opacity of the thickest smoke to begin with, where the background tells"""

TRIES = 6
"""steps from there: each halves what is left at least"""

FEWEST = 300
"""pixels, over the frames that are looked at, that tell how opaque smoke is at least: some ten patches of `_gone`"""

LEAST_OF = 8
"""of so many frames one counts for what a pixel shows with the least smoke"""

GOES = (0.5, 1.5)
"""by how much smoke changes at a pixel, over how far that is from the background with the least: from the second on
all of that is background, up to the first all of it smoke"""

STILL = 0.04
"""change of a pixel (0 to 1, root of the sum over channels) under which smoke stands still: the noise of a clip"""

AGREES = 0.5
"""correlation, over places, of opacity and what has gone of the grain, from which the background is believed; on made
smoke it is 0.98"""

THICKEST = 0.02
"""share of the smoke's pixels that differ most from what is behind: they show its color"""

OPAQUE = 0.9
"""opacity of those, where nothing behind tells: they are what hides best, and no smoke hides all"""

GRAIN = 2.0
"""standard deviation (px) of the blur that tells the grain of a background from its shades"""

BARE = 0.02
"""root mean square grain (0 to 1) of the background from which it tells how much of it is seen: twice the noise of a
compressed picture"""

THIN = 0.5
"""opacity under which the color of a pixel is drawn to that of thick smoke: noise, and what is wrong with the
background, over a small opacity is no color"""

TINT = 0.15
"""by how much the color of smoke in a place may differ from that of thick smoke, 0 to 1, per channel: more of it is the
background's, which is guessed where smoke always hides it"""

BEYOND = 0.02
"""shares of the picture's longer side over which smoke fades out beyond its mask, whose rim lies inside the thin one"""

LOOKED_AT = 8
"""frames, spread over the film, that the color is taken from"""

SOLID = 0.98
"""opacity at most: an optical depth of 3.9"""

FADE = 0.3
"""s over which a film that begins again fades over: as long as eddies of smoke keep their outline"""

LATE = 1 / 3
"""part at the end of a film that is not begun again at: there would be little to repeat"""

SHOWN = 0.02
"""opacity from which a place shows smoke"""

NEW = 0.05
"""part of the smoke of the last frame in places that showed none in the first two thirds, from which it still spreads:
eddies of a steady plume reach beyond its outline by less"""


@dataclass(frozen=True)
class SmokeColor:
    """What thick smoke looks like."""

    color: Float[np.ndarray, "3"]
    """sRGB, 0 to 1"""
    told: bool
    """whether the background, where it shows through, told how opaque the smoke is; else its thickest is `OPAQUE`"""


def smoke_color(
    frames: UInt8[np.ndarray, "t h w 3"], fluid: Bool[np.ndarray, "t h w"], behind: UInt8[np.ndarray, "h w 3"]
) -> SmokeColor:
    """The color that smoke would have if nothing showed through.

    The pixels that differ most from the background give its direction. How far along it thick smoke lies is told by
    the grain of the background: through smoke of opacity a, 1 - a of it is left.

    Args:
        frames: of the clip, a few spread over it are enough.
        fluid: where the smoke is.
        behind: the picture without it.

    Raises:
        ValueError: masks of another size.
    """
    require(fluid.shape == frames.shape[:3], f"masks {fluid.shape} for pictures {frames.shape}", "one each")
    back = behind.astype(np.float32) / 255.0
    away = frames.astype(np.float32) / 255.0 - back
    if not fluid.any():
        return SmokeColor(np.ones(3), False)
    direction = _direction(away, fluid)
    along = np.where(fluid, away @ direction, -np.inf)
    thick = fluid & (along >= np.quantile(along[fluid], 1.0 - THICKEST))
    under = np.broadcast_to(back, away.shape)[thick].mean(axis=0)
    toward = direction * max(float(along[thick].mean()), 1e-3)
    own = _grain(back)
    power = _power(own)
    # where smoke always is, the background is a guess, and has no grain that could be told from it
    known = ndimage.binary_erosion(~np.all(fluid, axis=0), iterations=int(2 * GRAIN), border_value=1)
    grainy = known & (power > BARE**2)
    clear = [ndimage.binary_erosion(mask, iterations=int(2 * GRAIN)) & grainy for mask in fluid]
    if np.sum(clear) < FEWEST:
        return SmokeColor(_within(under, toward / OPAQUE), False)
    gone = [_gone(_grain(shown), own, power) for shown in away + back]
    color = _within(under, toward / HALF)
    for _ in range(TRIES):  # the opacity that this color means, against what has gone of the background's grain
        means = [_mean(_opacity(shown, back, color), own, power) for shown in away + back]
        above = sum(float((power * a * g)[use].sum()) for a, g, use in zip(means, gone, clear, strict=True))
        below = sum(float((power * a * a)[use].sum()) for a, use in zip(means, clear, strict=True))
        ratio = float(np.clip(above / max(below, 1e-9), 0.5, 2.0))
        color = _within(under, (color - under) / ratio)
    a, g = (np.concatenate([m[use] for m, use in zip(part, clear, strict=True)]) for part in (means, gone))
    if a.std() < 1e-3 or g.std() < 1e-3 or np.corrcoef(a, g)[0, 1] < AGREES:
        return SmokeColor(_within(under, toward / OPAQUE), False)
    return SmokeColor(color, True)


def behind_smoke(
    frames: UInt8[np.ndarray, "t h w 3"], fluid: Bool[np.ndarray, "t h w"], guess: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """A guess of what is behind smoke, as the clip itself shows it where smoke is always there and lets it through.

    A pixel's own picture with the least smoke (the mean of a few) is what is behind, with some smoke. How far it is
    from the guess towards the smoke's color is background where the smoke comes and goes by more than that, and smoke
    where it stands; how far it is in other directions is background.

    Args:
        frames: of the clip, spread over it.
        fluid: where the smoke is.
        guess: the picture without it, right where `fluid` is not.
    """
    back = guess.astype(np.float32) / 255.0
    always = np.all(fluid, axis=0)
    if not always.any():
        return guess
    away = frames.astype(np.float32) / 255.0 - back
    direction = _direction(away, fluid).astype(np.float32)
    along = away @ direction
    order = np.argsort(along, axis=0)[: max(len(frames) // LEAST_OF, 1)]
    least = np.take_along_axis(away, order[..., None], axis=0).mean(axis=0)
    excess = np.maximum(least @ direction, 0.0)
    comes = (along.max(axis=0) - excess) / np.maximum(excess, 1.0 / 255.0)
    smoke = np.clip((GOES[1] - comes) / (GOES[1] - GOES[0]), 0.0, 1.0) * excess
    found = back + least - smoke[..., None] * direction
    weight = np.clip(ndimage.distance_transform_edt(always) / (BEYOND * max(always.shape)), 0.0, 1.0)[..., None]
    return _bytes(back + weight * (found - back))


def _direction(away: np.ndarray, fluid: np.ndarray) -> np.ndarray:
    """Unit vector (sRGB) from the background towards the smoke: what comes and goes is smoke, and what is wrong with
    the background stays. So each pixel counts by how far it is from its own picture with the least smoke."""
    size = np.where(fluid, np.linalg.norm(away, axis=-1), np.inf)
    least = np.take_along_axis(away, size.argmin(axis=0)[None, ..., None], axis=0)
    moved = np.where(fluid[..., None], away - least, 0.0)
    far = np.linalg.norm(moved, axis=-1)
    if far.max() < STILL:  # nothing comes and goes
        moved, far = np.where(fluid[..., None], away, 0.0), np.where(fluid, size, 0.0)
    thick = fluid & (far >= np.quantile(far[fluid], 1.0 - THICKEST))
    mean = moved[thick].mean(axis=0)
    return mean / max(float(np.linalg.norm(mean)), 1e-6)


def _gone(shown: np.ndarray, own: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Part of the background's grain that a picture has lost about each pixel: 1 less its regression on it."""
    left = ndimage.gaussian_filter((own * shown).sum(axis=-1), 2 * GRAIN) / np.maximum(power, 1e-9)
    return 1.0 - np.clip(left, 0.0, 1.0)


def _mean(opacity: np.ndarray, own: np.ndarray, power: np.ndarray) -> np.ndarray:
    """Opacity about each pixel, in the mean that `_gone` takes."""
    return ndimage.gaussian_filter(opacity * np.square(own).sum(axis=-1), 2 * GRAIN) / np.maximum(power, 1e-9)


def _within(under: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """The color `toward` from another one, or the last one on the way that there is."""
    room = np.where(toward > 0, 1.0 - under, under) / np.maximum(np.abs(toward), 1e-6)
    return np.clip(under + min(1.0, float(room.min())) * toward, 0.0, 1.0)


def _grain(picture: np.ndarray) -> np.ndarray:
    return picture - ndimage.gaussian_filter(picture, (GRAIN, GRAIN, 0))


def _power(grain: np.ndarray) -> np.ndarray:
    """Mean square about each pixel."""
    return ndimage.gaussian_filter(np.square(grain).sum(axis=-1), 2 * GRAIN)


def _opacity(picture: np.ndarray, back: np.ndarray, color: np.ndarray) -> np.ndarray:
    """How far each pixel is on its way from the background to a color, 0 to 1."""
    way = color - back
    return np.clip(((picture - back) * way).sum(axis=-1) / np.maximum((way * way).sum(axis=-1), 1e-4), 0.0, 1.0)


def smoke_layer(
    picture: UInt8[np.ndarray, "h w 3"],
    fluid: Bool[np.ndarray, "h w"],
    behind: UInt8[np.ndarray, "h w 3"],
    color: SmokeColor,
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Color and opacity (of 255) of the smoke in a picture; before the background they give it again."""
    shown, back = picture.astype(np.float32) / 255.0, behind.astype(np.float32) / 255.0
    opacity = _opacity(shown, back, color.color)
    reach = max(BEYOND * max(fluid.shape), 1.0)
    outside = ndimage.distance_transform_edt(~fluid) if fluid.any() else np.full(fluid.shape, np.inf)
    inside = np.clip(1.0 - outside / reach, 0.0, 1.0).astype(np.float32)
    opacity = opacity * inside
    rest = (shown - back) * inside[..., None] - opacity[..., None] * (color.color - back)
    own = color.color + np.clip(rest / np.maximum(opacity, THIN)[..., None], -TINT, TINT)
    return _bytes(own), _bytes(opacity)


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(255.0 * values), 0, 255).astype(np.uint8)


class FrameSequence(Protocol):
    """Pictures or masks one by one, of which a few are in memory at a time."""

    def __len__(self) -> int:
        """How many there are."""
        ...

    def __getitem__(self, index: int, /) -> Any:
        """One of them."""
        ...


def smoke_layers(
    frames: FrameSequence, fluid: FrameSequence, behind: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Color and opacity of each picture of a film, as `smoke_layer`.

    Args:
        frames: u8 [t,h,w,3], sRGB.
        fluid: bool [t,h,w], where the smoke is.
        behind: u8 [h,w,3], the picture without it.
    """
    looked = np.unique(np.linspace(0, len(frames) - 1, LOOKED_AT).round().astype(int))
    few, masks = (np.stack([np.asarray(part[t]) for t in looked]) for part in (frames, fluid))
    color = smoke_color(few, masks, behind)
    for t in range(len(frames)):
        yield smoke_layer(np.asarray(frames[t]), np.asarray(fluid[t]), behind, color)


@dataclass(frozen=True)
class SmokeFilm:
    """Color and opacity of smoke over time."""

    colors: UInt8[np.ndarray, "t h w 3"]
    """sRGB"""
    opacities: UInt8[np.ndarray, "t h w"]
    """of 255"""
    interval: float
    """s between frames"""

    def __len__(self) -> int:
        return len(self.colors)

    def layer(self, frame: int) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
        """Color (0 to 1) and optical depth, -log(1 - opacity), of one of its frames."""
        opacity = np.minimum(self.opacities[frame].astype(np.float32) / 255.0, SOLID)
        return self.colors[frame].astype(np.float32) / 255.0, -np.log1p(-opacity)

    def at(self, seconds: float, whole: float) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
        """Color and optical depth at a time of a film that is played for `whole` seconds: as filmed, and where that is
        longer, its later part again and again, each time faded over (video texture; Schödl et al. 2000)."""
        t, last = seconds / self.interval, len(self) - 1
        if last == 0 or whole / self.interval <= last + 0.5:
            return self.layer(int(np.clip(round(t), 0, last)))
        again, fade = self._again, min(FADE / self.interval, self._again)
        length = max(last - again, 1)
        if t > last:
            t = again + (t - again) % length
        share = np.clip((t - (last - fade)) / max(fade, 1e-6), 0.0, 1.0)
        color, depth = self.layer(int(np.clip(round(t), 0, last)))
        if share == 0.0:
            return color, depth
        other, before = self.layer(int(np.clip(round(t - length), 0, last)))
        mean = (1.0 - share) * depth + share * before
        weight = (share * before / np.maximum(mean, 1e-6))[..., None]
        return color + weight * (other - color), mean

    @cached_property
    def _again(self) -> int:
        """The frame that is most like the last one, from which the film begins again."""
        small = self.opacities[:, ::4, ::4].astype(np.float32)
        first, end = round(FADE / self.interval), round((1.0 - LATE) * (len(self) - 1))
        if first >= end:
            return max(end, 0)
        return first + int(np.abs(small[first:end] - small[-1]).mean(axis=(1, 2)).argmin())

    @property
    def end(self) -> float:
        """s, of its last frame"""
        return (len(self) - 1) * self.interval

    @cached_property
    def spreads(self) -> bool:
        """Whether the smoke still comes to places at the end where it never was before: then it is no steady plume."""
        late = round((1.0 - LATE) * len(self))
        if not 0 < late < len(self):
            return False
        new = self.opacities[:late].max(axis=0) <= 255.0 * SHOWN
        return float(self.opacities[-1][new].sum()) > NEW * float(self.opacities[-1].sum())


def shown_from(opacities: UInt8[np.ndarray, "t h w"], fluid: Bool[np.ndarray, "t h w"], usual: float) -> float:
    """Opacity (0 to 1) from which a film's smoke counts as such in its masks: with it as the bound, both overlap best.

    Args:
        opacities: of the film, of 255.
        fluid: the masks of the same frames.
        usual: where there is no smoke.
    """
    inside, outside = (np.bincount(opacities[part], minlength=256) for part in (fluid, ~fluid))
    if not inside.any():
        return usual
    # of each bound: what is as opaque or more
    both, beside = (np.cumsum(part[::-1])[::-1] for part in (inside, outside))
    overlap = both / (inside.sum() + beside)
    return float((1 + overlap[1:].argmax()) / 255.0)
