"""Which pixels of a clip are fluid, without learned weights.

The user's mask wins, then the alpha channel of the clip, then the evidence of change and motion
(`fluidlift.shape.evidence`), cut along the edges of the picture by GrabCut (Rother, Kolmogorov, Blake 2004) for a
fluid that fills the same region all the time, and by comparison with the still background for one that advances.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from fluidlift.errors import InputRejected, require
from fluidlift.shape.background import still_background, typical_contrast
from fluidlift.shape.evidence import (
    POOLING,
    Evidence,
    fluid_score,
    gather_evidence,
    pool,
    typical_picture,
)
from fluidlift.types.clip import Label, PixelLabels, VideoClip
from fluidlift.types.flow import PixelFlow

Progress = Callable[[float, str], None]
"""Called with the part done (0 to 1) and a few words."""

SMALLEST_PART = 0.04
"""components below this part of the whole fluid are dropped"""
SMALLEST_SOLID = 4e-4
"""holes below this part of the picture are filled"""
DOUBTFUL = 1.5
"""log odds: what lies nearer to zero could be either"""
FEEBLE = 0.4
"""of the fluid's typical score: what moves less must look like the fluid to be counted as fluid"""
SHADOW = 0.2
"""factor on changes of brightness against the sign of the fluid's own contrast"""
FAINTEST = 0.3
"""of the fluid's typical contrast with the background: what is fainter is not counted as fluid"""
SATURATION = 0.9
"""a region that is nearly all seen active early (mean of the union's growth curve above this) is one that stays"""


def segment(
    clip: VideoClip,
    flow: PixelFlow,
    *,
    user_mask: np.ndarray | None = None,
    roi: tuple[int, int, int, int] | None = None,
    progress: Progress | None = None,
) -> PixelLabels:
    """Labels of every frame.

    Args:
        clip: at least 2 frames from a camera that stands still (see `motion.stabilize`), unless a mask is given.
        flow: optical flow of the clip, px per frame; its confidence weighs the motion evidence.
        user_mask: bool [H,W] or [T,H,W], True where there is fluid; taken as it is, with confidence 1.
        roi: x, y, width, height in px: fluid is only looked for inside.
        progress: told how far the work has got.

    Raises:
        InputRejected: nothing moves, or the region or the mask is empty.
        ValueError: operands of unlike size.
    """
    frames, height, width = clip.frames.shape[:3]
    tell = progress or (lambda part, words: None)
    inside = region_of_interest(roi, height, width)
    given = user_mask if user_mask is not None else alpha_mask(clip)
    if given is not None:
        return labels_from_mask(given, frames, height, width, inside)
    if frames < 2:
        raise InputRejected("nothing moves in a clip of one frame", "two frames or more", "give a --mask")
    require(
        flow.displacement.shape == (frames - 1, height, width, 2),
        f"flow {flow.displacement.shape}",
        f"{(frames - 1, height, width, 2)}",
    )
    tell(0.0, "evidence")
    evidence = gather_evidence(clip, flow)
    small_inside = shrink_mask(inside, evidence.noise.shape)
    score = np.where(small_inside, fluid_score(evidence), -12.0).astype(np.float32)
    seen = score > 0.0
    if seen.mean() < 1e-3 or float(score.max()) < 1.0:
        raise InputRejected("nothing moves in this clip", "a fluid that moves before a camera that stands still",
                            "give a --mask")  # fmt: skip
    tell(0.5, "labels")
    active = activity_per_frame(evidence) & seen
    if grows(active & (score > 2.0)):
        labels, sure = advancing_labels(evidence, score, active)
    else:
        labels, sure = lasting_labels(evidence, score, active)
    sure = np.where(small_inside, sure, np.float32(1.0))
    labels[:, ~small_inside] = Label.BACKGROUND
    if not (labels == Label.FLUID).any():
        raise InputRejected("nothing that moves holds together as a fluid", "a fluid larger than a few dots",
                            "give a --mask")  # fmt: skip
    tell(0.9, "full size")
    warnings = doubts(labels, score)
    return PixelLabels(*at_full_size(labels, sure, height, width), warnings=warnings)


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
    return clip.alpha > 127


def labels_from_mask(mask: np.ndarray, frames: int, height: int, width: int, inside: np.ndarray) -> PixelLabels:
    """Labels of a mask that is known, confidence 1; closed holes in it stay background (they were drawn so)."""
    mask = np.asarray(mask)
    require(mask.dtype == bool, f"mask of {mask.dtype}", "bool")
    if mask.shape == (height, width):
        mask = np.broadcast_to(mask, (frames, height, width))
    if mask.shape != (frames, height, width):
        raise InputRejected(f"a mask of shape {mask.shape}", f"{(height, width)} or {(frames, height, width)}",
                            "draw the mask on a frame of the clip at its working size")  # fmt: skip
    labels = np.where(mask & inside, np.uint8(Label.FLUID), np.uint8(Label.BACKGROUND))
    if not labels.any():
        raise InputRejected("an empty mask", "at least one pixel of fluid", "draw the fluid white")
    return PixelLabels(labels, np.ones(labels.shape, np.float16))


def shrink_mask(mask: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """bool mask at another size, nearest pixel."""
    return cv2.resize(mask.astype(np.uint8), (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST) > 0


def activity_per_frame(evidence: Evidence) -> np.ndarray:
    """bool [T,h,w]: change around the frame above the level that separates still from moving."""
    sigma = POOLING * max(evidence.noise.shape)
    active = np.empty(evidence.change.shape, bool)
    for t, change in enumerate(evidence.change):
        active[t] = pool(np.log(np.maximum(change.astype(np.float32), 1.0)), sigma) > evidence.level
    return active


def grows(active: np.ndarray) -> bool:
    """Whether the fluid advances into (or retreats from) the picture, from bool [T,h,w].

    The union of all that was active up to a frame fills at once where a fluid stays in its bed, and fills in the
    course of the clip where smoke rises or a jet advances; the same backwards for a fluid that leaves.
    """
    for order in (active, active[::-1]):
        union = np.logical_or.accumulate(order).sum(axis=(1, 2))
        if union[-1] and union.mean() / union[-1] < SATURATION:
            return True
    return False


def lasting_labels(evidence: Evidence, score: np.ndarray, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels u8 and confidence f32 [T,h,w] of a fluid that stays where it is: one outline, times of arrival."""
    frames = len(active)
    still = typical_picture(evidence.pictures)
    region = cut_along_edges(still, evidence.fine_activity, evidence.level, score)
    region = clean_region(region)
    region, solid = solids_in(region, still_pixels(evidence))
    arrived, left = presence(active)
    times = np.arange(frames)[:, None, None]
    present = (times >= arrived) & (times <= left)
    labels = np.zeros(active.shape, np.uint8)
    for t in range(frames):
        labels[t][solids_in(region & present[t], np.zeros_like(region))[0] & region] = Label.FLUID
    labels[:, solid] = Label.SOLID
    chance = 1.0 / (1.0 + np.exp(-np.abs(score)))
    agrees = np.where(region == (score > 0.0), chance, 1.0 - chance)
    sure = np.broadcast_to(2.0 * np.clip(agrees, 0.5, 1.0) - 1.0, active.shape)
    return labels, sure


def presence(active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last frame of activity, int [h,w], smoothed; near the ends of the clip means from or to the end."""
    frames = len(active)
    ever = active.any(axis=0)
    first = np.where(ever, active.argmax(axis=0), 0).astype(np.uint16)
    last = np.where(ever, frames - 1 - active[::-1].argmax(axis=0), frames - 1).astype(np.uint16)
    first, last = cv2.medianBlur(first, 5).astype(int), cv2.medianBlur(last, 5).astype(int)
    margin = 0.2 * frames
    return np.where(first <= margin, 0, first), np.where(last >= frames - 1 - margin, frames - 1, last)


def cut_along_edges(picture: np.ndarray, activity: np.ndarray, level: float, score: np.ndarray) -> np.ndarray:
    """bool [h,w]: GrabCut on brightness, the stronger colour axis and the activity, seeded by the score.

    Activity is a channel of its own, so that motion edges and colour edges both hold the cut, and water of another
    colour than the seeds is still drawn by its motion.
    """
    colours = picture[..., 1:].reshape(-1, 2)
    centred = colours - colours.mean(axis=0)
    axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    chroma = (centred @ axis).reshape(score.shape)
    motion = np.clip(activity / (2.0 * level), 0.0, 1.0) * 160.0
    channels = np.stack([picture[..., 0], 128.0 + 1.5 * chroma, motion], axis=-1)
    channels = np.clip(channels, 0.0, 255.0).astype(np.uint8)
    core = np.ones((3, 3), np.uint8)
    lively = FEEBLE * float(np.median(score[score > 0.0]))
    trimap = np.where(score > lively, cv2.GC_PR_FGD, cv2.GC_PR_BGD).astype(np.uint8)
    trimap[cv2.erode((score > max(2.0 * lively, 3.0)).astype(np.uint8), core) > 0] = cv2.GC_FGD
    trimap[cv2.erode((score < -4.0).astype(np.uint8), core) > 0] = cv2.GC_BGD
    known = np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if known.all() or known.sum() < 16 or (~known).sum() < 16:
        return known
    cv2.setRNGSeed(0)
    cv2.grabCut(channels, trimap, None, np.zeros((1, 65)), np.zeros((1, 65)), 3, cv2.GC_INIT_WITH_MASK)
    return np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))


def disc(radius: float) -> np.ndarray:
    """Round structuring element, u8."""
    size = 2 * max(1, round(radius)) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))


def clean_region(region: np.ndarray) -> np.ndarray:
    """bool [h,w]: gaps closed, threads and specks gone, only components that matter beside the largest."""
    longest = max(region.shape)
    mask = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_CLOSE, disc(0.008 * longest))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, disc(0.004 * longest))
    count, parts, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count <= 1:
        return np.zeros_like(region)
    areas = stats[:, cv2.CC_STAT_AREA].copy()
    areas[0] = 0
    return (areas >= SMALLEST_PART * areas.sum())[parts]


def still_pixels(evidence: Evidence) -> np.ndarray:
    """bool [h,w]: places with clearly less change than the fluid has, at fine scale."""
    return evidence.fine_activity < evidence.level


def solids_in(region: np.ndarray, still: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The region with its small or moving holes filled, and the still holes in it (rocks), both bool [h,w].

    A hole is a part of the rest that the fluid surrounds: it does not touch the rim of the picture.
    """
    framed = np.pad(~region, 1, constant_values=True).astype(np.uint8)
    count, parts = cv2.connectedComponents(framed, connectivity=4)
    outside, parts = parts[0, 0], parts[1:-1, 1:-1]
    filled, solid = region.copy(), np.zeros_like(region)
    for part in range(1, count):
        if part == outside:
            continue
        hole = parts == part
        if hole.sum() >= SMALLEST_SOLID * region.size and still[hole].mean() > 0.5:
            solid |= hole
        else:
            filled |= hole
    return filled, solid


def advancing_labels(evidence: Evidence, score: np.ndarray, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Labels u8 and confidence f32 [T,h,w] of a fluid that moves through the picture: an outline per frame."""
    domain = cv2.dilate(clean_region(score > -1.0).astype(np.uint8), disc(0.01 * max(score.shape))) > 0
    background, known, like_fluid = still_background(evidence, active, domain)
    contrast, brightens = typical_contrast(evidence, active, background, known)
    odds = np.empty(active.shape, np.float16)
    sigma = POOLING * max(evidence.noise.shape)
    for t, picture in enumerate(evidence.pictures):
        change = np.log(np.maximum(evidence.change[t].astype(np.float32), 1.0))
        moved = (pool(change, sigma) - evidence.level) / 0.3
        threshold = np.maximum(4.0 * evidence.noise, FAINTEST * contrast)
        change_of_colour = picture.astype(np.float32) - background
        differs = np.abs(change_of_colour).sum(axis=-1) / threshold
        differs[change_of_colour[..., 0] * brightens < -0.5 * np.abs(change_of_colour).sum(axis=-1)] *= SHADOW
        stands_out = np.log(np.maximum(differs, 1e-3)) / 0.3
        seen = stands_out + 0.25 * np.clip(moved, -4.0, 4.0)
        best = np.where(known, seen, np.clip(moved, -3.0, 3.0) + like_fluid(picture))
        odds[t] = np.clip(np.where(domain, best, -12.0), -12.0, 12.0)
    odds = median_over_time(odds)
    labels = np.zeros(active.shape, np.uint8)
    still = still_pixels(evidence)
    for t in range(len(labels)):
        region, solid = solids_in(clean_region(odds[t] > 0.0), still)
        labels[t][region], labels[t][solid] = Label.FLUID, Label.SOLID
    sure = np.tanh(0.5 * np.abs(odds.astype(np.float32)))
    return labels, sure


def median_over_time(odds: np.ndarray) -> np.ndarray:
    """Median of three neighbouring frames, ends kept."""
    if len(odds) < 3:
        return odds
    smooth = odds.copy()
    before, here, after = odds[:-2], odds[1:-1], odds[2:]
    smooth[1:-1] = np.maximum(np.minimum(before, here), np.minimum(np.maximum(before, here), after))
    return smooth


def at_full_size(labels: np.ndarray, sure: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Labels u8 and confidence f16 [T,H,W] at the size of the clip; outlines are interpolated, not stepped."""
    shape = (len(labels), height, width)
    full, confidence = np.zeros(shape, np.uint8), np.empty(shape, np.float16)
    for t in range(len(labels)):
        for label in (Label.FLUID, Label.SOLID):
            part = cv2.resize((labels[t] == label).astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
            full[t][part > 0.5] = label
        confidence[t] = np.clip(cv2.resize(sure[t].astype(np.float32), (width, height)), 0.0, 1.0)
    return full, confidence


def doubts(labels: np.ndarray, score: np.ndarray) -> tuple[str, ...]:
    """What a user should look at before he trusts the labels."""
    warnings = []
    if (np.abs(score) < DOUBTFUL).sum() > (score > 0.0).sum():
        warnings.append(
            "more of the picture is doubtful than is fluid (a moving camera, or a fluid that hardly changes): "
            "look at the overlay and give a --mask"
        )
    if (labels == Label.FLUID).mean() > 0.9:
        warnings.append("nearly the whole picture was taken for fluid: was the camera moving?")
    return tuple(warnings)


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
