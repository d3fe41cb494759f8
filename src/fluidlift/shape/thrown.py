"""Water that is thrown up: whether a body in the picture both rises and falls, and stands free of its background.

The mean flow of a fountain goes down: what falls is seen, on the outside and in drops, what rises is a smooth or white
core within. But near its apex the same water is slow on both ways, and where a jet leaves its nozzle it shows. So each
place is asked alone which vertical shifts from frame to frame its pattern follows, over the whole clip: a mean of two
layers would be neither. Of what falls over a brink, or out of a spout, no place rises.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

LONGEST = 320
"""px, longer side of the picture that is looked at: finer drops add nothing but work"""
FARTHEST = 0.05
"""of that side, which water may cross in a frame: at 25 per second a fountain that fills the picture leaves its nozzle
with 2 sqrt(2 h g) / 2, 0.9 m per frame of 4 m at the foot, and is followed from half of its height on"""
ASIDE = 1
"""px to either side that a pattern may go as well"""
WINDOW = (10.0, 5.0)
"""px, standard deviations along and across the vertical of the neighbourhood that follows one shift: a jet is taller
than wide"""
FINE, COARSE = 0.6, 2.0
"""px, standard deviations between which a pattern is looked at: drops and strands, no shading"""
SURE = 8.0
"""robust standard deviations by which the likeliest shift is likelier than others (most of 15 of noise: 3)"""
APEX = 1.0 / 3.0
"""of its height, from the top, in which a fountain is slow on both ways: half of the time of its flight"""
EDGE, CUT = 0.01, (0.25, 0.75)
"""of the picture's height, in which a body counts as at its upper edge; and of the body's width, from which it is cut
off there, to all of it: the tip of a jet may leave the picture"""
CORE = 0.04
"""of the longer side, half width of a notch in the mask that belongs to the body: a core that is white throughout does
not change, and is left out of masks that are found by change, up to the apex"""
PAIRS = 40
"""pairs of frames that are looked at, at most"""


@dataclass(frozen=True)
class Thrown:
    """What of a body rises and what falls."""

    rises: float
    """share of what moves along the vertical near its top that goes up, where the pattern says so clearly"""
    falls: float
    """share of the body, down to where anything moves so, that is seen to fall"""
    free: float
    """share of the rows of what moves so whose background is seen on both sides, less where the picture cuts its top"""


def thrown(frames: UInt8[np.ndarray, "t h w 3"], mask: Bool[np.ndarray, "h w"]) -> Thrown:
    """How much of a body is thrown up.

    Args:
        frames: consecutive, of a steadied clip.
        mask: fluid pixels.
    """
    if len(frames) < 4 or not mask.any():
        return Thrown(0.0, 0.0, 0.0)
    up, down, whole = vertical_ways(frames, mask)
    rows = np.flatnonzero((up | down).any(axis=1))
    if not len(rows):
        return Thrown(0.0, 0.0, 0.0)
    body = _body(whole, up | down)
    falls = float((down & body).sum()) / int(body[: rows[-1] + 1].sum())
    top = int(np.flatnonzero(body.any(axis=1))[0])
    apex = slice(top, top + max(round(APEX * (rows[-1] - top)), 1))
    rising, moving = int((up & body)[apex].sum()), int(((up | down) & body)[apex].sum())
    return Thrown(rising / max(moving, 1), falls, _free(body, rows[-1]))


def vertical_ways(
    frames: UInt8[np.ndarray, "t h w 3"], mask: Bool[np.ndarray, "h w"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """bool [k,l] each, of a smaller picture: what clearly goes up, what clearly goes down, and the body without holes.

    A place follows a shift where the pattern of a frame there is like that of the next one, so far up or down; which
    shift is asked of all pairs together.
    """
    scale = min(LONGEST / max(mask.shape), 1.0)
    size = (max(round(mask.shape[1] * scale), 1), max(round(mask.shape[0] * scale), 1))
    small = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    wide = 2 * round(CORE * max(size)) + 1  # closed in a frame of its own, or the picture's edges would grow inwards
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide, wide))
    padded = cv2.morphologyEx(np.pad(small, wide), cv2.MORPH_CLOSE, disc)[wide:-wide, wide:-wide]
    whole = np.asarray(ndimage.binary_fill_holes(padded > 0), bool)
    reach = max(round(FARTHEST * max(size)), 3)
    rows, columns = (np.flatnonzero(whole.any(axis=a)) for a in (1, 0))
    near = slice(max(rows[0] - reach, 0), rows[-1] + reach + 1), slice(max(columns[0] - 8, 0), columns[-1] + 9)
    likeness = _likeness(_patterns(frames, size, near), reach)
    usual = np.median(likeness, axis=0)
    spread = np.median(np.abs(likeness - usual), axis=0) + 0.005
    above, below = ((part.max(axis=0) - usual) / spread for part in (likeness[: reach - 1], likeness[reach + 2 :]))
    out = np.zeros((2, *whole.shape), bool)
    out[0][near] = (above > SURE) & (above > below)
    out[1][near] = (below > SURE) & (below >= above)
    return out[0] & whole, out[1] & whole, whole


def _patterns(frames: np.ndarray, size: tuple[int, int], near: tuple[slice, slice]) -> np.ndarray:
    """float32 [n,k,l]: what changes in consecutive frames, between two scales."""
    first = max((len(frames) - PAIRS - 1) // 2, 0)
    part = [cv2.resize(f, size, interpolation=cv2.INTER_AREA) for f in frames[first : first + PAIRS + 1]]
    grey = np.stack([f.astype(np.float32).mean(axis=-1)[near] for f in part])
    grey -= grey.mean(axis=0)
    return np.stack([cv2.GaussianBlur(g, (0, 0), FINE) - cv2.GaussianBlur(g, (0, 0), COARSE) for g in grey])


def _likeness(patterns: np.ndarray, reach: int) -> Float[np.ndarray, "s k l"]:
    """Correlation with the next frame at each vertical shift from -reach to reach, in a window around each place."""
    before, after = patterns[:-1], np.pad(patterns[1:], ((0, 0), (reach, reach), (ASIDE, ASIDE)))
    height, width = before.shape[1:]

    def pooled(values: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(values, (0, 0), WINDOW[1], sigmaY=WINDOW[0])

    power = pooled(np.mean(patterns**2, axis=0)) + 0.3  # grey levels squared, of sensors and of codecs
    found = []
    for shift in range(2 * reach + 1):
        aside = [
            pooled(np.einsum("tij,tij->ij", before, after[:, shift : shift + height, k : k + width]) / len(before))
            for k in range(2 * ASIDE + 1)
        ]
        found.append(np.max(aside, axis=0) / power)
    return np.stack(found)


def _body(whole: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """The piece that holds most of what moves along the vertical."""
    label, count = ndimage.label(whole)
    own = np.bincount(label[moving], minlength=count + 1)
    return np.asarray(label == int(np.argmax(own)))


def _free(body: np.ndarray, foot: int) -> float:
    """How far the background shows around a body down to a row: beside it, and above its top."""
    top = int(np.flatnonzero(body.any(axis=1))[0])
    upper = body[top : foot + 1]
    beside = ~upper[:, 0] & ~upper[:, -1]
    wide = float(np.median(upper.sum(axis=1)[upper.any(axis=1)]))
    cut = float(body[: max(round(EDGE * len(body)), 1)].any(axis=0).sum()) / max(wide, 1.0)
    return float(beside.mean() * np.clip((CUT[1] - cut) / (CUT[1] - CUT[0]), 0.0, 1.0))
