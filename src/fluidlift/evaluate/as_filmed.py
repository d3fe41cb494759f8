"""How near a re-simulation stays to its own clip, without a truth: figures, their floors, a verdict and advice.

A fluid never does the same thing twice, so pictures are not compared one by one but by what they are like over time.
The floor of a figure is the same figure between the two halves of the clip (the current, which is of the last third
alone: between that and the first third): no re-simulation can be asked for less. The current of a clip that hardly
agrees with itself on it does not fail for being as unlike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from fluidlift.errors import require
from fluidlift.evaluate.film import (
    BANDS,
    CELL,
    LATE,
    LEAST,
    MOST,
    FilmStatistics,
    Foam,
    Places,
    film_statistics,
    growth,
    late_pairs,
    mean_flows,
    spread,
)
from fluidlift.evaluate.images import mask_iou
from fluidlift.messages import Notice
from fluidlift.types import triple

GOOD, USABLE, WRONG = "good", "usable", "does not hold"
VERDICTS = (GOOD, USABLE, WRONG)
"""from the best to the worst"""

LEVEL = (0.95, 0.88)
"""IoU in the last third: above the first good, above the second usable. 0.95 is what two people agree on who draw the
outline of water; at 0.88 a river is an eighth too narrow or too wide"""
LEVEL_LEAST = 0.90
"""IoU that is good in any case where the halves of the clip agree no better: waves on a bank"""
MEAN_OVER_FLOOR = (3.0, 8.0)
"""levels: a difference of 3 in 255 is just seen side by side, one of 8 at once"""
RING_OVER_FLOOR = (2.0, 5.0)
"""levels: tighter, as the ground does not move: what differs there is water on it"""
CRISPNESS = (0.9, 1.1, 0.75)
"""finest band over the clip's: good between the first two, usable above the third, where blur begins to be seen"""
LIVELINESS = (0.85, 1.15, 0.7, 1.3)
"""standard deviation in time over the clip's: good between the first two, usable between the others"""
CURRENT_ERROR = (0.25, 0.5)
"""of the mean flow, over the clip's: optical flow of water itself is not surer than a fifth"""
CURRENT_COSINE = (0.95, 0.85)
"""18 and 32 degrees"""
SLOWEST = 0.3
"""px/frame: a slower mean flow lies within what optical flow is wrong by, and is not judged"""
FOLLOWED = 0.1
"""correlation: what is less alike downstream in the clip is chance, and no number to divide by"""
STAYS = 0.8
"""share of the fluid that must be the same in both halves of a clip for frames after its end to be held against it"""
GROWS = 0.05
"""of the area that the fluid has on average: by how much more or less of it than a frame after the clip's end may show,
where the fluid grows or shrinks steadily, for that frame to be held against the clip. A level of 0.95 is good"""
FEWEST = 6
"""frames: the last third of fewer has no pair, and a half no mean"""
FEWEST_AT_A_PLACE = 0.005
"""of the fluid's pixels, in a zone whose colours count"""


@dataclass(frozen=True)
class Likeness:
    """One figure of a re-simulation against its clip."""

    key: str
    words: str
    value: float | None
    """over the clip's length; None: cannot be measured"""
    floor: float | None = None
    """the same figure between the halves of the clip"""
    beyond: float | None = None
    """in the frames after the end of the clip"""
    unit: str = ""
    verdict: str | None = None
    """of `VERDICTS`, the worse of `value` and `beyond`; None: not judged"""
    note: str = ""

    def against(self) -> str:
        """The floor in words, of figures that say nothing without it."""
        return f" against {_text(self.floor)}" if self.key in ("mean", "ring") and self.floor is not None else ""

    def row(self) -> tuple[str, str, str, str, str, str]:
        """Words with the unit, value, floor, beyond, verdict, note."""
        name = f"{self.words}, {self.unit}" if self.unit else self.words
        return name, _text(self.value), _text(self.floor), _text(self.beyond), self.verdict or "", self.note


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}" if abs(value) < 10 else f"{value:.1f}"


NONE = float("nan")
HEADER = ("figure", "value", "floor", "after the clip", "verdict", "")


@dataclass(frozen=True)
class AsFilmed:
    """The card: how near a re-simulation stays to its clip."""

    frames: int
    """compared with the clip at the same instants"""
    beyond: int
    """frames after the end of the clip that were judged"""
    figures: tuple[Likeness, ...]
    notes: tuple[str, ...] = ()
    advice: tuple[str, ...] = field(default=())

    @property
    def verdict(self) -> str | None:
        """The worst of the figures that are judged; None where none is."""
        found = [VERDICTS.index(f.verdict) for f in self.figures if f.verdict]
        return VERDICTS[max(found)] if found else None

    def __getitem__(self, key: str) -> Likeness:
        """The figure of this key; raises KeyError."""
        for figure in self.figures:
            if figure.key == key:
                return figure
        raise KeyError(key)

    def rows(self) -> list[tuple[str, str, str, str, str, str]]:
        """As in `HEADER`."""
        return [f.row() for f in self.figures]

    def sentence(self) -> str:
        """Verdict and main figures in one line; what is worst comes first."""
        judged = [f for f in self.figures if f.verdict and not (f.key.startswith("right_") and f.verdict == GOOD)]
        judged.sort(key=lambda f: -VERDICTS.index(str(f.verdict)))
        told = []
        for f in judged:
            later = f", {_text(f.beyond)} after the clip" if f.beyond is not None else ""
            told.append(f"{f.words} {_text(f.value)}{f.against()}{later}")
        return f"as filmed: {self.verdict or 'not judged'} ({'; '.join(told) or 'nothing could be measured'})"

    def warning(self) -> Notice | None:
        """What to say where it does not hold, with advice; None where it does."""
        if self.verdict != WRONG:
            return None
        wrong = ", ".join(f"{f.words} {_text(_worst(f))}{f.against()}" for f in self.figures if f.verdict == WRONG)
        text = f"the re-simulation does not hold to its clip: {wrong}. {' '.join(self.advice)}".strip()
        return Notice("not-as-filmed", text)

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "verdict": self.verdict, "frames": self.frames, "beyond": self.beyond,
            "figures": {f.key: {k: v for k, v in vars(f).items() if k != "key"} for f in self.figures},
            "notes": list(self.notes), "advice": list(self.advice),
        }  # fmt: skip

    @staticmethod
    def from_dict(plain: Mapping[str, Any]) -> AsFilmed:
        """Back from `to_dict`; raises KeyError or TypeError for anything else."""
        figures = tuple(Likeness(key, **entry) for key, entry in plain["figures"].items())
        notes, advice = tuple(plain["notes"]), tuple(plain["advice"])
        return AsFilmed(int(plain["frames"]), int(plain["beyond"]), figures, notes, advice)


_CERTAIN = {
    "mask": ("chance that the mask is right", "The mask is rather wrong than right: correct it (fluidlift mask)."),
    "kind": ("chance that the kind is right", "The kind is rather wrong than right: give --kind."),
    "tilt": ("chance that the tilt is right", "The tilt is rather wrong than right: give --pitch."),
}
"""what an asset is built from: words, and what to do where it is in doubt"""


def with_certainty(card: AsFilmed, found: Mapping[str, float]) -> AsFilmed:
    """The card with how likely it is that what the asset was built from is right.

    A wrong mask or kind can be re-simulated as it was found: what is rather wrong than right makes no asset good.

    Args:
        card: without that.
        found: probability of mask, kind and tilt, of those that nobody gave.
    """
    if card.verdict is None:
        return card
    told = [
        Likeness(f"right_{key}", words, round(float(found[key]), 4), verdict=GOOD if found[key] >= 0.5 else USABLE)
        for key, (words, _) in _CERTAIN.items() if key in found
    ]  # fmt: skip
    advice = [do for key, (_, do) in _CERTAIN.items() if found.get(key, 1.0) < 0.5]
    return replace(card, figures=(*card.figures, *told), advice=(*card.advice, *advice))


def _worst(figure: Likeness) -> float | None:
    """Of value and beyond, the one that the verdict is of."""
    values = [v for v in (figure.value, figure.beyond) if v is not None]
    return max(values, key=lambda v: VERDICTS.index(_judged(figure.key, v, figure.floor) or GOOD)) if values else None


def as_filmed(
    clip: UInt8[np.ndarray, "t h w 3"],
    masks: Bool[np.ndarray, "t h w"],
    interval: float,
    renders: UInt8[np.ndarray, "k h w 3"],
    coverage: Bool[np.ndarray, "k h w"],
    *,
    runs: bool = True,
    fills: bool = False,
    seen: np.ndarray | None = None,
) -> AsFilmed:
    """Hold a re-simulation against its clip.

    Memory is that of a few pictures beside the arrays, which may be mapped from files.

    Args:
        clip: its frames.
        masks: where fluid was filmed.
        interval: s between frames, of both.
        renders: the re-simulation in the clip's camera, from the first frame of `clip` on; may be longer than it.
        coverage: pixels that its fluid covers.
        runs: False: it stays where it is. What moves over it are waves, which the clip shows at another time: no
            current to hold against another.
        fills: it fills or drains what it stands in: where it grows or shrinks steadily it goes on to. Else it comes
            back, as a fall in the wind.
        seen: bool [T,H,W], pixels that each frame of the clip saw, where it was steadied: where none was filmed no
            fluid is missing or too much. None: all.

    Raises:
        ValueError: arrays that do not fit each other, or fewer than `FEWEST` frames.
    """
    require(clip.shape[1:] == renders.shape[1:], f"renders {renders.shape}", f"pictures of the clip, {clip.shape}")
    require(masks.shape == clip.shape[:3] and coverage.shape == renders.shape[:3], "masks", "one per frame")
    length = min(len(clip), len(renders))
    require(length >= FEWEST, f"{length} frames", f"{FEWEST} or more")
    places, foam, half = Places.of(masks), Foam.of(clip, masks), len(clip) // 2
    moves = places.stays < STAYS
    longer = max(len(renders) - len(clip), 0)
    after = comparable(masks, longer, fills=fills)
    later = renders[len(clip) : len(clip) + after] if after >= FEWEST else renders[:0]

    def statistics(
        frames: np.ndarray, where: np.ndarray, late: float = LATE, flow: np.ndarray | None = None
    ) -> FilmStatistics:
        return film_statistics(frames, where, places, foam, interval=interval, late=late, flow=flow)

    of_half, behind = late_pairs(half, 0.0), len(clip) - half
    parts = late_pairs(length), of_half, [behind + t for t in of_half], first_third(length)
    flows = mean_flows(clip, masks, parts)
    whole, within = (
        statistics(clip[:length], masks[:length], flow=flows[0]),
        statistics(renders[:length], masks[:length]),
    )
    value = level(masks[:length], coverage[:length], places, seen) | likeness(whole, within, places.fluid, places)
    first, second = (
        statistics(clip[part], masks[part], 0.0, flow)
        for part, flow in zip((slice(0, half), slice(behind, None)), flows[1:3])
    )
    floor = likeness(first, second, places.steady, places) | _own_current(flows[3], whole, places)
    both = True if seen is None else seen[:half] & seen[-half:]
    floor["level"] = float(mask_iou(masks[:half] & both, masks[-half:] & both).mean())
    if moves:  # its halves differ because it is elsewhere
        floor.update((key, float("nan")) for key in ("level", "current_error", "current_cosine"))
    beyond: dict[str, float] = {}
    if len(later):
        still = np.broadcast_to(places.fluid, later.shape[:3])
        beyond = level(still, coverage[len(clip) : len(clip) + len(later)], places)
        beyond |= likeness(whole, statistics(later, still), places.fluid, places)
    notes = _notes(moves, longer, len(later))
    for known in () if runs else (value, floor, beyond):
        known.update((key, NONE) for key in ("current_error", "current_cosine") if key in known)
    figures = tuple(_figures(value, floor, beyond, _no_current(_speed(whole, places.fluid), runs=runs)))
    return AsFilmed(length, len(later), figures, notes, tuple(_advice(figures, value, beyond)))


def comparable(masks: Bool[np.ndarray, "t h w"], longer: int, *, fills: bool) -> int:
    """Of `longer` frames after the end of a clip, those in which its fluid is where it was filmed most of the time.

    Args:
        masks: where fluid was filmed.
        longer: frames.
        fills: as of `as_filmed`.
    """
    if Places.of(masks).stays < STAYS:
        return 0
    grows = growth(masks) if fills else 0.0
    return longer if not grows else int(np.clip(GROWS / abs(grows) - len(masks) / 2, 0, longer))


def _notes(moves: bool, longer: int, judged: int) -> tuple[str, ...]:
    """What is not compared after the end of the clip, and why; `longer`: frames there, `judged`: those compared."""
    if moves:
        return ("The fluid moves through the picture: after the end of the clip nothing is compared.",)
    if longer >= FEWEST and judged < longer:
        part = f"only {judged} frames are" if judged else "nothing is"
        return (f"The fluid grows or shrinks steadily: after the end of the clip {part} compared.",)
    return ()


def level(masks: np.ndarray, coverage: np.ndarray, places: Places, seen: np.ndarray | None = None) -> dict[str, float]:
    """Where the fluid stands in the last third: IoU in what is `seen` (None: all), share of the ring that it covers,
    share of it that is missing."""
    late = slice(int(LATE * len(masks)), len(masks))
    covered, known = coverage[late].mean(axis=0), masks[late].any()
    within = True if seen is None else seen[late]
    return {
        "level": float(mask_iou(masks[late] & within, coverage[late] & within).mean()) if known else float("nan"),
        "flooded": _mean(covered, places.ring),
        "missing": 1.0 - _mean(covered, places.always),
    }


def likeness(a: FilmStatistics, b: FilmStatistics, inside: np.ndarray, places: Places) -> dict[str, float]:
    """Figures of film b against film a.

    Args:
        a: of the clip.
        b: of the other.
        inside: pixels that are compared.
        places: of the clip.
    """
    off = np.abs(a.mean - b.mean).mean(axis=-1)
    found = {
        "mean": _mean(off, inside),
        "ring": _mean(off, places.ring),
        "liveliness": _ratio(_mean(b.deviation, inside), _mean(a.deviation, inside)),
    }
    found |= {f"along_{lag:g}": _ratio(b.along[lag], own) if own > FOLLOWED else NONE for lag, own in a.along.items()}
    found |= {f"crispness_{k}": _ratio(b.bands[k], a.bands[k]) for k in range(BANDS)}
    found |= {"colours": colour_distance(a.colours, b.colours), "foam": foam_likeness(a.foam, b.foam, inside)}
    error, cosine = current(a.flow, b.flow, inside)
    return found | {"current_error": error, "current_cosine": cosine}


def _mean(values: np.ndarray, where: np.ndarray) -> float:
    known = values[where]
    known = known[np.isfinite(known)]
    return float(known.mean()) if len(known) >= LEAST else float("nan")


def _ratio(value: float, of: float) -> float:
    return float(value / of) if np.isfinite(of) and abs(of) > 1e-6 else float("nan")


def colour_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Wasserstein distance of histograms [z,3,256], levels, mean over channels and over zones with enough pixels."""
    least = max(FEWEST_AT_A_PLACE * a[:, 0].sum(), LEAST)
    zones = (a[:, 0].sum(axis=-1) >= least) & (b[:, 0].sum(axis=-1) >= least)
    if not zones.any():
        return float("nan")
    shares = [np.cumsum(x[zones] / x[zones].sum(axis=-1, keepdims=True), axis=-1) for x in (a, b)]
    return float(np.abs(shares[0] - shares[1]).sum(axis=-1).mean())


def foam_likeness(a: np.ndarray, b: np.ndarray, inside: np.ndarray) -> float:
    """Correlation over the picture of how often there is foam; NaN where the clip's foam has no place of its own."""
    side = max(round(CELL * max(inside.shape)), 2)
    size = tuple(-(-n // side) for n in inside.shape)
    rows, columns = (np.arange(n) // side for n in inside.shape)
    known = inside & np.isfinite(a) & np.isfinite(b)
    place = (rows[:, None] * size[1] + columns)[known]
    count = np.bincount(place, minlength=size[0] * size[1])
    full = count >= side * side // 2
    means = [np.bincount(place, x[known], len(count))[full] / count[full] for x in (a, b)]
    # two in a hundred is what single frames with a wave more or less make of it
    if full.sum() < 8 or means[0].std() < 0.02 or means[1].std() < 1e-6:
        return float("nan")
    return float(np.corrcoef(means[0], means[1])[0, 1])


def current(a: np.ndarray, b: np.ndarray, inside: np.ndarray) -> tuple[float, float]:
    """Relative error and cosine of mean flow b [h,w,2] against a; NaN where a is slower than `SLOWEST`."""
    known = inside & np.isfinite(a[..., 0]) & np.isfinite(b[..., 0])
    if known.sum() < LEAST:
        return float("nan"), float("nan")
    one, other = a[known], b[known]
    speed = float(np.linalg.norm(one, axis=-1).mean())
    if speed < SLOWEST:
        return float("nan"), float("nan")
    error = float(np.linalg.norm(one - other, axis=-1).mean()) / speed
    length = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return error, float((one * other).sum()) / length if length > 1e-9 else 0.0


def first_third(frames: int) -> list[int]:
    """First frames of the pairs that the floor of the current is taken from."""
    return spread(0, max(frames - int(LATE * frames), 2) - 1, MOST)


def _own_current(flow: np.ndarray, whole: FilmStatistics, places: Places) -> dict[str, float]:
    """The floor of the current, which is of the last third alone: the mean flow of the first third against it."""
    error, cosine = current(whole.flow, flow, places.steady)
    return {"current_error": error, "current_cosine": cosine}


def _speed(film: FilmStatistics, inside: np.ndarray) -> float:
    return _mean(np.linalg.norm(film.flow, axis=-1), inside)


_WORDS = {
    "level": ("level", ""),
    "flooded": ("water beside the fluid", "share"),
    "missing": ("fluid missing", "share"),
    "mean": ("mean picture", "levels"),
    "ring": ("ring around it", "levels"),
    "liveliness": ("liveliness", "of the clip's"),
    "along_0.2": ("alike 0.2 s downstream", "of the clip's"),
    "along_0.5": ("alike 0.5 s downstream", "of the clip's"),
    "along_1": ("alike 1 s downstream", "of the clip's"),
    "crispness_0": ("crispness", "of the clip's"),
    "crispness_1": ("detail of 2 px", "of the clip's"),
    "crispness_2": ("detail of 4 px", "of the clip's"),
    "crispness_3": ("detail of 8 px", "of the clip's"),
    "colours": ("colours by zone", "levels"),
    "foam": ("foam in its place", "correlation"),
    "current_error": ("current off by", "share"),
    "current_cosine": ("direction of the current", "cosine"),
}
"""figures in their order, with their units"""


def _no_current(speed: float, *, runs: bool) -> str:
    """Why no current is judged; empty where one is. `speed`: px per frame."""
    if not runs:
        return "not judged: waves that pass over water are no current"
    return f"not judged: {speed:.2f} px/frame is less than what optical flow is wrong by" if speed < SLOWEST else ""


def _figures(value: dict[str, float], floor: dict[str, float], beyond: dict[str, float], no_current: str):
    """Each figure with its verdict."""
    for key, (words, unit) in _WORDS.items():
        note = no_current if key.startswith("current") else ""
        numbers = triple(_plain(x.get(key)) for x in (value, floor, beyond))
        verdicts = [v for v in (_judged(key, x, numbers[1]) for x in (numbers[0], numbers[2])) if v]
        worst = max(verdicts, key=VERDICTS.index) if verdicts else None
        yield Likeness(key, words, *numbers, unit, worst, note)


def _plain(value: float | None) -> float | None:
    """Four digits, so that the last bits of a sum do not show; None for what is not finite."""
    return float(f"{value:.4g}") if value is not None and np.isfinite(value) else None


def _judged(key: str, value: float | None, floor: float | None) -> str | None:
    """The verdict on one value; None where this figure is told but not judged."""
    if value is None or (floor is None and key in ("mean", "ring")):
        return None
    least = floor or 0.0
    match key:
        case "level":
            wanted = LEVEL[0] if floor is None else min(LEVEL[0], max(floor, LEVEL_LEAST))
            good, usable = value >= wanted, value >= LEVEL[1]
        case "mean" | "ring":
            limits = MEAN_OVER_FLOOR if key == "mean" else RING_OVER_FLOOR
            good, usable = (value <= least + limit for limit in limits)
        case "crispness_0":
            good, usable = CRISPNESS[0] <= value <= CRISPNESS[1], value >= CRISPNESS[2]
        case "liveliness":
            good, usable = LIVELINESS[0] <= value <= LIVELINESS[1], LIVELINESS[2] <= value <= LIVELINESS[3]
        case "current_error":
            good, usable = value <= CURRENT_ERROR[0], value <= max(CURRENT_ERROR[1], min(least, 1.0))
        case "current_cosine":
            wanted = CURRENT_COSINE[1] if floor is None else min(CURRENT_COSINE[1], max(floor, 0.0))
            good, usable = value >= CURRENT_COSINE[0], value >= wanted
        case _:
            return None
    return GOOD if good else USABLE if usable else WRONG


def _advice(figures: tuple[Likeness, ...], value: dict[str, float], beyond: dict[str, float]):
    """What to give, for each thing that does not hold; short sentences."""
    wrong = {f.key for f in figures if f.verdict == WRONG}
    last = beyond or value
    if "level" in wrong:
        if last["missing"] > last["flooded"]:
            yield "Fluid is missing where it was filmed: correct the mask (fluidlift mask) or give --kind."
        else:
            yield "Fluid stands where none was filmed: correct the mask (fluidlift mask) or give --pitch."
    if "ring" in wrong and "level" not in wrong:
        yield "What is around the fluid differs: correct the mask (fluidlift mask)."
    if "mean" in wrong and not wrong & {"level", "ring"}:
        yield "Its colours drift from those filmed: choose a stretch of even light (--start, --duration)."
    if "current_cosine" in wrong:
        yield "It runs another way than filmed: give --kind or --pitch."
    elif "current_error" in wrong:
        yield "It runs slower or faster than filmed: give --size, which sets the time that gravity takes, or --pitch."
    if "crispness_0" in wrong:
        yield "It is softer than the clip: a finer --preset or a larger --max-size."
    if "liveliness" in wrong:
        yield "It is stiller or livelier than the clip: a longer --duration of the clip shows more of what changes."
