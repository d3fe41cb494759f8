"""From evidence to an outline: GrabCut, gaps and specks, rocks in the stream."""

from __future__ import annotations

import cv2
import numpy as np

from fluidlift.shape.evidence import Evidence
from fluidlift.shape.min_cut import disc

SMALLEST_PART = 0.04
"""components below this part of the whole fluid are dropped"""
SMALLEST_SOLID = 4e-4
"""holes below this part of the picture are filled"""
FEEBLE = 0.4
"""of the fluid's typical score: what moves less must look like the fluid to be counted as fluid"""


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
    cv2.grabCut(channels, trimap, (0, 0, 1, 1), np.zeros((1, 65)), np.zeros((1, 65)), 3, cv2.GC_INIT_WITH_MASK)
    return np.isin(trimap, (cv2.GC_FGD, cv2.GC_PR_FGD))


def clean_region(region: np.ndarray, *, gap: float = 0.008) -> np.ndarray:
    """bool [h,w]: gaps (radius in parts of the longer side) closed, threads and specks gone, only components that
    matter beside the largest."""
    longest = max(region.shape)
    mask = cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_CLOSE, disc(gap * longest))
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


def largest_piece(region: np.ndarray) -> np.ndarray:
    """bool [h,w]: the largest of the connected pieces of a region."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(region.astype(np.uint8), connectivity=4)
    return region if count < 2 else label == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
