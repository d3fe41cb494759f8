"""Which pixels of a clip are fluid, without learned weights.

The user's mask wins, then the alpha channel of the clip, then the evidence of change and motion
(`fluidlift.shape.evidence`), cut along the edges of the picture by GrabCut (Rother, Kolmogorov, Blake 2004) for a
fluid that fills the same region all the time, and by comparison with the still background for one that advances.
Points that the user gave correct what was found.

Working memory does not grow with the clip beyond the labels: evidence comes from a sample of frames, frames and flow
are read one by one and may lie in a file, and labels may be written to arrays of the caller's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from fluidlift.errors import InputRejected, require
from fluidlift.messages import Notice
from fluidlift.shape.background import in_own_colours
from fluidlift.shape.carried_layers import by_either, carried_layers
from fluidlift.shape.change_points import Arrivals, arrivals, bare_before
from fluidlift.shape.colour_growth import grown_steadily, still_below_jet, with_quiet_water
from fluidlift.shape.evidence import Evidence, PairReader, fluid_score, gather_evidence, pair_reader, solids_by_flow
from fluidlift.shape.frame_pictures import working_size
from fluidlift.shape.hints import VOICE, Clicks, Point, clicks_at, heed, holes_asked_for
from fluidlift.shape.intermittently_wet import WashedGround, bare_over_time, washed_ground
from fluidlift.shape.mirrored_edges import mirrored_edges
from fluidlift.shape.moving_front import advancing_labels, without_strays
from fluidlift.shape.moving_solids import SharedPairs, moving_solids
from fluidlift.shape.open_sea import reaching_over, sea_horizon, with_sea
from fluidlift.shape.open_water import with_open_water
from fluidlift.shape.presence import Presence, always, grows, remaining, stay, watch
from fluidlift.shape.quiet_reaches import with_quiet_reaches
from fluidlift.shape.region import clean_region, cut_along_edges, solids_in, still_pixels
from fluidlift.shape.still_regions import without_ground
from fluidlift.shape.swaying_jets import SwayingJets, swaying_jets, uncovered_over_time
from fluidlift.shape.thin_outlines import slimmed
from fluidlift.shape.vegetation import without_plants
from fluidlift.shape.vessel_contents import Vessel, filled_vessels, with_contents
from fluidlift.shape.view import OpenHorizon
from fluidlift.shape.waterline import dry_over_time
from fluidlift.types.clip import Label, PixelLabels, VideoClip
from fluidlift.types.flow import PixelFlow

Progress = Callable[[float, str], None]
"""Called with the part done (0 to 1) and a few words."""

DOUBTFUL = 1.5
"""log odds: what lies nearer to zero could be either"""
MUCH_DOUBT = 0.4
"""doubtful places as part of the fluid from which a user is told: with half of them wrong, a fifth of the mask is"""
BIAS, IN_OUTLINE, OF_SCORE, LOUDEST = 0.51, 1.75, 0.31, 8.0
"""log odds of fluid of a pixel whose score is 0 and outline unknown, for one inside an outline (against it, outside),
per unit of the score, and the score beyond which it says no more: logistic regression on pixels of 34 real clips
(`benchmarks/masks_fit.py` gives 1.87 and 0.30; 1.7 to 2.0 for an outline with each clip left out; held lower, so that
nothing is sure where the loudest score speaks against it). Of those pixels
with a chance of 0.8 by it, 8 in 10 are right"""
FALLING, EARLY = 0.02, 0.2
"""part of the area that fills, which is seen of the jet above it at least: a jet of a tenth of a glass's width, as long
as a fifth of that is filled; part of the clip in which it is there from the first frame on for most of it"""


class LabelWriter:
    """Labels and confidence at the size of the clip, filled frame by frame; outlines are interpolated, not stepped."""

    def __init__(self, shape: tuple[int, int, int], out: tuple[np.ndarray, np.ndarray] | None = None) -> None:
        """Into arrays u8 and float16 of `shape` [T,H,W], new ones where `out` is None."""
        if out is None:
            out = (np.empty(shape, np.uint8), np.empty(shape, np.float16))
        self.labels, self.confidence = out
        require(
            self.labels.shape == shape and self.labels.dtype == np.uint8
            and self.confidence.shape == shape and self.confidence.dtype == np.float16,
            f"out {self.labels.shape} {self.labels.dtype}, {self.confidence.shape} {self.confidence.dtype}",
            f"u8 and float16 of {shape}",
        )  # fmt: skip
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def write(self, t: int, labels: np.ndarray, sure: np.ndarray) -> None:
        """Frame t from labels u8 and confidence float [h,w]; the same arrays as last time are not worked out again."""
        if self._last is None or self._last[0] is not labels or self._last[1] is not sure:
            height, width = self.labels.shape[1:]
            full = np.zeros((height, width), np.uint8)
            for label in (Label.FLUID, Label.SOLID):
                part = cv2.resize((labels == label).astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
                full[part > 0.5] = label
            self.labels[t] = full
            self.confidence[t] = np.clip(cv2.resize(sure.astype(np.float32), (width, height)), 0.0, 1.0)
        else:
            self.labels[t], self.confidence[t] = self.labels[t - 1], self.confidence[t - 1]
        self._last = (labels, sure)


@dataclass(frozen=True)
class Bed:
    """The outline of a fluid that stays in its bed, bool [h,w] each."""

    region: np.ndarray
    rocks: np.ndarray
    """what stands in it"""
    washed: WashedGround | None = None
    """ground that it runs over now and then"""


@dataclass(frozen=True)
class Clues:
    """What a clip shows of its fluid, before a person says anything: all that is slow in finding it."""

    evidence: Evidence
    solids: np.ndarray
    """bool [h,w], what moves and is no fluid"""
    inside: np.ndarray
    """bool [h,w], where fluid is looked for"""
    interval: float
    """s between two frames"""
    said: np.ndarray | None = None
    """float32 [h,w], log odds of fluid from elsewhere"""
    mirrored: float = 0.0
    """share of the picture that only mirrors the rest of it, at its edges"""
    horizon: OpenHorizon | None = None
    """px at working size, on which open water ends"""

    @cached_property
    def score(self) -> np.ndarray:
        """float32 [h,w], log odds of fluid."""
        possible = self.inside & ~self.solids
        found = fluid_score(self.evidence)
        if self.said is not None:
            found = np.clip(found + self.said / OF_SCORE, -12.0, 12.0)  # the score is as many times too loud
        return np.where(possible, found, -12.0).astype(np.float32)

    @property
    def told(self) -> np.ndarray:
        """float32 [h,w], the score, but not against quiet water that the horizon told: it would be too far to move."""
        if self.horizon is None:
            return self.score
        return np.where(self.bed.region, np.maximum(self.score, np.float32(DOUBTFUL)), self.score)

    @cached_property
    def presence(self) -> Presence:
        """When it is there. The sea always is, though its quiet parts move now and then only."""
        found = watch(self.evidence, self.score > 0.0)
        return found if self.horizon is None else always(found)

    @cached_property
    def grown(self) -> np.ndarray | None:
        """bool [h,w], the fluid grown from its streams, where change does not tell it; else None."""
        if self.horizon is not None or trustworthy(self.score):
            return None
        return grown_steadily(self.evidence, self.inside & ~self.solids)

    @cached_property
    def advances(self) -> bool:
        """Whether it comes into the picture, or leaves it, instead of staying in its bed.

        What a jet sways over is seen active in the course of the clip, too, and is there from first to last; so is the
        jet that fills a glass.
        """
        if self.grown is not None or self.horizon is not None:
            return False
        return grows(self.presence, self.score > 2.0) and self.jets is None and self.arrivals is None

    @cached_property
    def _first(self) -> np.ndarray:
        """bool [h,w], the outline of what stays, plants and washed ground with it."""
        return lasting_region(self.evidence, self.score, self.inside)

    @cached_property
    def _without_plants(self) -> np.ndarray:
        """bool [h,w], the same without plants, and with thin parts as thin as they are."""
        return without_plants(self.evidence, self.score, slimmed(self.evidence, self._first), self.interval)

    @cached_property
    def jets(self) -> SwayingJets | None:
        """What sways as jets do; None without any, and where change or a horizon tells otherwise."""
        if self.grown is not None or self.horizon is not None:
            return None
        return swaying_jets(self.evidence, self._without_plants)

    @cached_property
    def arrivals(self) -> Arrivals | None:
        """Where it comes for good below a jet; None where it does nowhere, and where change or a horizon tells
        otherwise. What rises by itself, as smoke does, has nothing above it but air."""
        if self.grown is not None or self.horizon is not None:
            return None
        found = arrivals(self.evidence, self.bed.region, self.inside)
        if found is None or self.jets is not None:
            return found
        top = int(np.argmax(found.where.any(axis=1)))
        above = self.presence.first[:top][self.bed.region[:top]]
        early = len(above) > FALLING * found.where.sum() and np.median(above) < EARLY * self.presence.frames
        return found if early else None

    @cached_property
    def heap(self) -> np.ndarray:
        """bool [h,w], what lies still where it has been poured; nothing where change or a horizon tells otherwise."""
        if self.grown is not None or self.horizon is not None:
            return np.zeros(self.score.shape, bool)
        return still_below_jet(self.evidence, self._without_plants, self.inside & ~self.solids)

    @cached_property
    def vessels(self) -> tuple[Vessel, ...]:
        """Those that hold a liquid."""
        return () if self.horizon is not None else filled_vessels(self.evidence, self.solids)

    @cached_property
    def bed(self) -> Bed:
        """Where it is, if it stays in its bed."""
        evidence = self.evidence
        if self.grown is not None:
            region = with_open_water(evidence, clean_region(self.grown), self.solids | ~self.inside)
            return Bed(region, np.zeros_like(region))
        region = self._without_plants
        if self.horizon is not None:
            # nothing passes on a sea: what goes nowhere, or looks the same between two waves, is no rock for that
            barred = self.solids | ~self.inside
            found = with_sea(evidence, region, barred, self.horizon)
            found = with_quiet_reaches(evidence, found, barred | (self.horizon.below(found.shape) <= 0.0))
            return Bed(found, np.zeros_like(found))
        if self.jets is not None:  # what they pour lies still, and is no ground
            return Bed(self._with_heap(region), np.zeros_like(region))
        washed = washed_ground(evidence, region)
        region, rocks = without_ground(evidence, region)
        taken = self._first & ~region  # plants and washed ground wander, too, and were told from water already
        barred = rocks | self.solids | taken | ~self.inside
        region = with_quiet_reaches(evidence, with_open_water(evidence, region, barred), barred)
        return Bed(self._with_heap(region), rocks & ~self.heap, washed)

    def _with_heap(self, region: np.ndarray) -> np.ndarray:
        return clean_region(region | self.heap) if self.heap.any() else region


def clues_of(
    clip: VideoClip, flow: PixelFlow | PairReader, roi: tuple[int, int, int, int] | None = None,
    said: np.ndarray | None = None,
) -> Clues:  # fmt: skip
    """The clues of a clip of at least 2 frames; operands as those of `segment`.

    `said` are log odds of fluid from elsewhere, float32 [h,w] of the whole picture at any size.
    """
    pairs = SharedPairs(clip, pair_reader(flow))
    small = working_size(*clip.frames.shape[1:3])
    with ThreadPoolExecutor(1, "layers") as beside:  # neither asks for the flow, which takes most of the time
        edges, carried = beside.submit(mirrored_edges, clip.frames), beside.submit(carried_layers, clip, small)
        evidence = gather_evidence(clip, pairs)
    mirrored, layers = edges.result(), carried.result()
    inside = region_of_interest(roi, *clip.frames.shape[1:3]) & ~mirrored
    inside = shrink_mask(inside, evidence.noise.shape)
    if said is not None:
        said = cv2.resize(said, evidence.noise.shape[::-1], interpolation=cv2.INTER_LINEAR)
    solids = by_either(layers, moving_solids(clip, pairs, evidence.noise.shape))
    horizon = sea_horizon(evidence, layers)
    if horizon is not None:
        evidence, solids = evidence.without_carried(), reaching_over(solids, horizon)
    return Clues(evidence, solids, inside, clip.interval, said, float(mirrored.mean()), horizon)


def segment(
    clip: VideoClip,
    flow: PixelFlow | PairReader,
    *,
    user_mask: np.ndarray | None = None,
    roi: tuple[int, int, int, int] | None = None,
    points: Sequence[Point] = (),
    progress: Progress | None = None,
    out: tuple[np.ndarray, np.ndarray] | None = None,
    clues: Callable[[], Clues] | None = None,
) -> PixelLabels:
    """Labels of every frame.

    Args:
        clip: at least 2 frames from a camera that stands still (see `motion.stabilize`), unless a mask is given.
        flow: optical flow of the clip, px per frame, or what reads it for a pair (only some are asked for). Flow of
            single pairs as they are tells most: one that is blind to still things cannot say that they are.
        user_mask: bool [H,W] or [T,H,W], True where there is fluid; taken as it is, with confidence 1.
        roi: x, y, width, height in px: fluid is only looked for inside.
        points: (x, y, label) in px, label 1 where there is fluid and 0 where there is none: they correct the mask
            around them (`fluidlift.shape.hints`); not looked at where a mask is given.
        progress: told how far the work has got.
        out: labels u8 and confidence float16 [T,H,W] to write to, such as memory maps; None: new arrays.
        clues: gives those of this clip and flow where they may be known already; None: they are found.

    Raises:
        InputRejected: nothing moves, or the region or the mask is empty, or a point lies outside.
        ValueError: operands of unlike size.
    """
    frames, height, width = clip.frames.shape[:3]
    tell = progress or (lambda part, words: None)
    inside = region_of_interest(roi, height, width)
    given = user_mask if user_mask is not None else alpha_mask(clip)
    if given is not None:
        return labels_from_mask(given, LabelWriter((frames, height, width), out), inside)
    if frames < 2:
        raise InputRejected("nothing moves in a clip of one frame", "two frames or more", "give a --mask")
    if not callable(flow):
        found = flow.displacement.shape
        require(found == (frames - 1, height, width, 2), f"flow {found}", f"{(frames - 1, height, width, 2)}")
    tell(0.0, "evidence")
    known = clues_of(clip, flow, roi) if clues is None else clues()
    evidence, solids, score = known.evidence, known.solids, known.score
    small_inside, seen = known.inside, score > 0.0
    clicks = clicks_at(points, clip.size, evidence.noise.shape)
    if (seen.mean() < 1e-3 or float(score.max()) < 1.0) and len(clicks.fluid) == 0:
        raise InputRejected("nothing moves in this clip", "a fluid that moves before a camera that stands still",
                            "give a --mask")  # fmt: skip
    tell(0.3, "presence")
    presence = known.presence
    if known.advances:
        told = heed(clicks, evidence, score, score > 0.0)[1] if clicks else np.zeros_like(score)
        # a jet that sways with its jug changes as its flow says too: where all clues together speak for fluid, it is
        carried = solids_by_flow(evidence) & (score <= 0.0)
        leaves = carried & ~solids & (evidence.streaming > evidence.swaying)  # what sways in its colours is a plant
        fluid = in_own_colours(evidence, score, presence, leaves)
        barred = (solids | (carried & ~fluid)) & (told <= 0.0)
        # where its colours speak for it, motion no longer speaks against it: how it differs from what is behind decides
        score = np.where(fluid, np.maximum(score, np.float32(0.0)), score)
        found = advancing_labels(evidence, score, presence, np.where(barred, -12.0, told))
    else:
        found = staying_labels(known, clicks)
    if known.vessels:
        held = np.abs(heed(clicks, evidence, score, score > 0.0)[1]) > VOICE if clicks else np.zeros_like(solids)
        alone = known.grown is not None
        found = with_contents(found, known.vessels, evidence, solids | ~small_inside, held, alone=alone)
    tell(0.5, "labels")
    writer = LabelWriter((frames, height, width), out)
    share = write_labels(found, writer, small_inside, tell)
    if known.advances:
        share -= without_strays(writer.labels) / writer.labels.size
    told = doubts(share, known.told) + mirror_notice(known.mirrored)
    return PixelLabels(writer.labels, writer.confidence, warnings=told)


def staying_labels(known: Clues, clicks: Clicks) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Labels and confidence of every frame of a fluid that stays in its bed.

    Args:
        known: what the clip shows.
        clicks: what a person said of some pixels.
    """
    evidence, score, presence, grown = known.evidence, known.score, known.presence, known.grown
    region, rocks, washed, arriving = known.bed.region, known.bed.rocks, known.bed.washed, known.arrivals
    if arriving is not None:
        region = arriving.with_what_was_there(evidence, score, region, known.inside & ~known.solids) & ~rocks
    asked = held = np.zeros_like(region)
    if clicks:
        before = region
        region, told = heed(clicks, evidence, score, region)
        held = (region & ~before) | (told > VOICE)
        asked, rocks = holes_asked_for(region, clicks), rocks & ~region
        region = clean_region(region) & ~asked & ~rocks
    still = still_pixels(evidence)
    if grown is not None:  # change says nothing in such a clip: neither when the fluid came nor what is a rock
        presence, still = always(presence), np.zeros_like(still)
    elif known.jets is not None:  # a heap lies still where it has been poured: it neither leaves nor is a rock
        presence, still = remaining(presence), np.zeros_like(still)
    if arriving is not None:  # the change tells when, and activity near it does not; what is as still is no rock
        presence, still = always(presence, arriving.and_below), np.zeros_like(still)
    if known.heap.any():
        presence, still = always(presence, known.heap), still & ~known.heap
    still = still | asked | rocks
    found = lasting_labels(known.told, region, still, presence)
    if grown is None:
        outline, solid = solids_in(region, still)
        dry = dry_over_time(evidence, outline, solid, presence.picked)
        if washed is not None:
            dry = (ashore | bare for ashore, bare in zip(dry, bare_over_time(evidence, washed), strict=True))
        if known.jets is not None:
            dry = (bare | free for bare, free in zip(dry, uncovered_over_time(evidence, known.jets), strict=True))
        if arriving is not None:
            dry = (bare | free for bare, free in zip(dry, bare_before(evidence, arriving), strict=True))
        found = given_back(found, (bare & ~held for bare in dry))
    return found


def write_labels(
    found: Iterator[tuple[np.ndarray, np.ndarray]], writer: LabelWriter, inside: np.ndarray, tell: Progress
) -> float:
    """Part of the clip that is fluid; labels and confidence of every frame go to the writer.

    Raises:
        InputRejected: no frame has any fluid.
    """
    frames = len(writer.labels)
    last, held, share = None, None, 0.0
    for t, (labels, sure) in enumerate(found):
        if last is None or last[0] is not labels or last[1] is not sure:
            held = (np.where(inside, labels, np.uint8(Label.BACKGROUND)), np.where(inside, sure, np.float32(1.0)))
            last = (labels, sure)
        assert held is not None
        writer.write(t, *held)
        share += float((held[0] == Label.FLUID).mean()) / frames
        if t % 16 == 0:
            tell(0.5 + 0.5 * t / frames, "labels")
    if share == 0.0:
        raise InputRejected("nothing that moves holds together as a fluid", "a fluid larger than a few dots",
                            "give a --mask")  # fmt: skip
    return share


def region_of_interest(roi: tuple[int, int, int, int] | None, height: int, width: int) -> np.ndarray:
    """bool [H,W]; everything when `roi` (x, y, width, height in px) is None."""
    inside = np.ones((height, width), bool)
    if roi is not None:
        x, y, w, h = (int(value) for value in roi)
        inside[:] = False
        inside[max(y, 0) : max(y + h, 0), max(x, 0) : max(x + w, 0)] = True
        if not inside.any():
            raise InputRejected(f"a region {roi} outside the {width} x {height} picture", "x,y,width,height in px",
                                "move the region")  # fmt: skip
    return inside


def alpha_mask(clip: VideoClip) -> np.ndarray | None:
    """bool [T,H,W] from the alpha channel, or None where it is absent or says nothing."""
    if clip.alpha is None or int(clip.alpha.max()) - int(clip.alpha.min()) < 8:
        return None
    return np.stack([alpha > 127 for alpha in clip.alpha])


def labels_from_mask(mask: np.ndarray, writer: LabelWriter, inside: np.ndarray) -> PixelLabels:
    """Labels of a mask that is known, confidence 1; closed holes in it stay background (they were drawn so)."""
    mask = np.asarray(mask)
    require(mask.dtype == bool, f"mask of {mask.dtype}", "bool")
    frames, height, width = writer.labels.shape
    if mask.shape == (height, width):
        mask = np.broadcast_to(mask, (frames, height, width))
    if mask.shape != (frames, height, width):
        raise InputRejected(f"a mask of shape {mask.shape}", f"{(height, width)} or {(frames, height, width)}",
                            "draw the mask on a frame of the clip at its working size")  # fmt: skip
    some = False
    for t in range(frames):
        fluid = mask[t] & inside
        some = some or bool(fluid.any())
        writer.labels[t] = np.where(fluid, np.uint8(Label.FLUID), np.uint8(Label.BACKGROUND))
        writer.confidence[t] = 1.0
    if not some:
        raise InputRejected("an empty mask", "at least one pixel of fluid", "draw the fluid white")
    return PixelLabels(writer.labels, writer.confidence)


def shrink_mask(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """bool mask at another size, nearest pixel."""
    return cv2.resize(mask.astype(np.uint8), (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST) > 0


def lasting_region(evidence: Evidence, score: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """bool [h,w]: the outline of a fluid that stays where it is."""
    if not (score > 0.0).any():
        return np.zeros(score.shape, bool)
    region = cut_along_edges(evidence.typical, evidence.fine_activity, evidence.level, score)
    region = clean_region(region)
    return clean_region(with_quiet_water(evidence.typical, score, region) & inside) if region.any() else region


def lasting_labels(
    score: np.ndarray, region: np.ndarray, still: np.ndarray, presence: Presence
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Labels u8 and confidence f32 [h,w] of every frame of a fluid that stays where it is; frames alike share arrays.

    Args:
        score: float32 [h,w], log odds of fluid.
        region: bool [h,w], its outline.
        still: bool [h,w], what does not move: holes of that kind are solids.
        presence: of activity, for the times of arrival.
    """
    region, solid = solids_in(region, still)
    arrived, left = stay(presence)
    sure = sureness(region, score)
    present, labels = None, np.zeros(region.shape, np.uint8)
    for t in range(presence.frames):
        now = region & (arrived <= t) & (t <= left)
        if present is None or not np.array_equal(now, present):
            present, labels = now, np.zeros(region.shape, np.uint8)
            labels[solids_in(now, np.zeros_like(now))[0] & region] = Label.FLUID
            labels[solid] = Label.SOLID
        yield labels, sure


def sureness(region: np.ndarray, score: np.ndarray) -> np.ndarray:
    """float [h,w] in [0,1]: twice the chance that an outline, bool [h,w], is right, less one.

    Score [h,w] is the log odds of change and motion, which speak for themselves three times too loudly.
    """
    odds = BIAS + IN_OUTLINE * (2.0 * region - 1.0) + OF_SCORE * np.clip(score, -LOUDEST, LOUDEST)
    right = np.where(region, odds, -odds)
    return np.maximum(2.0 / (1.0 + np.exp(-right)) - 1.0, 0.0).astype(np.float32)


def given_back(
    found: Iterator[tuple[np.ndarray, np.ndarray]], bare: Iterator[np.ndarray]
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The labels and confidence of every frame with what lies bare in it, bool [h,w], given back to the background.

    What does not hang together with it is a rock.
    """
    for (labels, sure), dry in zip(found, bare, strict=True):
        dry = dry & (labels == Label.FLUID)
        if not dry.any():
            yield labels, sure
            continue
        ground = labels == Label.BACKGROUND
        parts = cv2.connectedComponents((dry | ground).astype(np.uint8), connectivity=4)[1]
        rock = dry & ~np.isin(parts, np.unique(parts[ground]))
        yield np.where(rock, np.uint8(Label.SOLID), np.where(dry, np.uint8(Label.BACKGROUND), labels)), sure


def doubtful_part(score: np.ndarray) -> float:
    """How much of the picture could be either, as part of what is fluid, from log odds [h,w]."""
    return float((np.abs(score) < DOUBTFUL).sum() / max(int((score > 0.0).sum()), 1))


def trustworthy(score: np.ndarray) -> bool:
    """Whether change tells fluid from the rest: less of the picture is doubtful than is fluid (log odds [h,w])."""
    return doubtful_part(score) <= 1.0


def doubts(share: float, score: np.ndarray) -> tuple[Notice, ...]:
    """What a user should look at before he trusts the labels, from the part of the clip that is fluid and the score."""
    warnings = []
    if not trustworthy(score):
        warnings.append(
            Notice(
                "mask-doubtful",
                "more of the picture is doubtful than is fluid (a moving camera, or a fluid that hardly changes): "
                "look at the overlay and give a --mask",
            )
        )
    elif doubtful_part(score) > MUCH_DOUBT:
        warnings.append(
            Notice(
                "mask-doubtful-in-places",
                f"what is fluid is doubtful in places as large as {100 * doubtful_part(score):.0f} % of it (still "
                f"water, "
                "noise, strong compression): look at the overlay; a --mask would help "
                "(fluidlift mask finds one, with --roi and --click)",
            )
        )
    if share > 0.9:
        warnings.append(
            Notice("mask-nearly-everything", "nearly the whole picture was taken for fluid: was the camera moving?")
        )
    return tuple(warnings)


def mirror_notice(share: float) -> tuple[Notice, ...]:
    """What to say of edges that only mirror the picture."""
    if share == 0.0:
        return ()
    return (
        Notice(
            "mirrored-edge",
            f"edges of the picture, {max(100 * share, 1):.0f} % of it, mirror what lies within, as a stabilizer fills "
            "what a moved frame leaves open: no fluid is looked for there; a clip that is cropped, or as it was "
            "filmed, shows more",
        ),
    )


def overlay(frame: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """u8 [H,W,3]: the frame with fluid tinted blue and outlined, solids hatched in orange, for a person to check.

    Args:
        frame: u8 [H,W,3], sRGB.
        labels: u8 [H,W], values of `Label`.
    """
    require(frame.shape[:2] == labels.shape, f"frame {frame.shape}, labels {labels.shape}", "one size")
    picture = frame.astype(np.float32)
    fluid, solid = labels == Label.FLUID, labels == Label.SOLID
    picture[fluid] = 0.6 * picture[fluid] + 0.4 * np.array([0.0, 150.0, 255.0], np.float32)
    rows, columns = np.mgrid[0 : labels.shape[0], 0 : labels.shape[1]]
    hatched = solid & ((rows + columns) % 6 < 3)
    picture[hatched] = 0.4 * picture[hatched] + 0.6 * np.array([255.0, 140.0, 0.0], np.float32)
    result = np.ascontiguousarray(np.clip(picture, 0.0, 255.0).astype(np.uint8))
    for part, colour in ((fluid, (255, 255, 255)), (solid, (255, 140, 0))):
        outlines = cv2.findContours(part.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(result, outlines, -1, colour, 1)
    return result
