"""Full-frame stabilisation: what a steadied frame does not see shows another time at which the camera did see it.

Laid on the others, a frame of a hand-held clip leaves an edge of the picture uncovered. Filled with what was seen there
last, ground is as it should be, but a fluid stands still there: in the film of its surface it is frozen, and the mask
has holes where it does not move. Other times of the same place show it as it moves (full-frame stabilisation by
mosaics: Litvin et al. 2003; motion inpainting: Matsushita et al. 2006), and stretches of the clip that go on for
longest make the fewest breaks. Ground stays as it was seen last: other times lie beside it by a pixel or two, and it
would jump with every break. Which is which is known once the fluid is found. It is looked for in pictures that stand
still there: in those that were filled so before, the masks of four of seven clips lost 0.02 to 0.11 (two gained 0.02).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

LONGEST = 160
"""cells of the longer side in which it is kept what a frame sees: 3 px of 512, over which the fill blends in"""
FEWEST = 8
"""frames that a stretch of another time goes on for, at least, unless the clip ends: shorter ones flicker"""
SLACK = 0.02
"""of what a frame does not see, that another one may not see either, beyond the best there is"""
WORTH = 0.5
"""of what a frame does not see, that the best other one has to see"""
TOGETHER = 600
"""frames that lend each other what they see: matrices of all pairs of them, 1.4 MB each"""


@dataclass
class UnseenEdges:
    """Which cells of the picture each frame of a steadied clip does not see, bool [T,h,w]."""

    frames: int
    size: tuple[int, int]
    """width and height of the pictures, px"""
    cells: Bool[np.ndarray, "t h w"] = field(init=False)

    def __post_init__(self) -> None:
        scale = min(1.0, LONGEST / max(self.size))
        width, height = (max(round(side * scale), 1) for side in self.size)
        self.cells = np.zeros((self.frames, height, width), bool)

    def put(self, frame: int, unseen: Bool[np.ndarray, "H W"]) -> None:
        """Note the pixels that a frame does not see; a cell is unseen where any of its pixels is."""
        size = self.cells.shape[:0:-1]
        self.cells[frame] = cv2.resize(unseen.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0


def seen_pixels(cells: Bool[np.ndarray, "t h w"], size: tuple[int, int]) -> Bool[np.ndarray, "t H W"]:
    """What each frame saw itself of pictures of a size (width, height), px, from `UnseenEdges.cells`."""
    return np.stack([_weight(c, size) == 0 for c in cells])


def donors(cells: Bool[np.ndarray, "t h w"]) -> Int[np.ndarray, " t"]:
    """For each frame the one that shows what it does not see, or -1: neighbours have neighbours for as long as can be.

    Args:
        cells: what each does not see.
    """
    count = len(cells)
    wanted = np.stack([_spread(c) for c in cells]).reshape(count, -1).astype(np.float32)
    missing = wanted @ wanted.T
    total = wanted.sum(axis=1)
    best = missing.min(axis=1)
    serves = missing <= (best + SLACK * total)[:, None]
    serves &= ((total > 0) & (best <= (1.0 - WORTH) * total))[:, None]
    goes_on = np.zeros((count + 1, count + 1), np.int32)
    for t in range(count - 1, -1, -1):
        goes_on[t, :-1] = np.where(serves[t], 1 + goes_on[t + 1, 1:], 0)
    found, last = np.full(count, -1), -1
    for t in range(count):
        following = last + 1
        if not (last >= 0 and following < count and serves[t, following]):
            near = np.abs(np.arange(count) - t)
            following = int(np.lexsort((near, -goes_on[t, :count]))[0])
            if goes_on[t, following] < min(FEWEST, count - t):
                following = -1
        found[t] = last = following
    return found


def lent(
    cells: Bool[np.ndarray, "t h w"], size: tuple[int, int]
) -> Iterator[tuple[int, int, Float[np.ndarray, "H W"]]]:  # fmt: skip
    """Frames that are lent what they do not see: number, that of the donor, and the donor's share in each pixel, which
    is 1 where it alone sees and falls to 0 over a cell beside that.

    Args:
        cells: what each frame does not see.
        size: width and height of the pictures, px.
    """
    for first in range(0, len(cells), TOGETHER):
        part = cells[first : first + TOGETHER]
        for t, donor in enumerate(donors(part)):
            if donor >= 0:
                yield first + t, first + int(donor), _weight(part[t], size) * (1.0 - _weight(part[donor], size))


def _spread(cells: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """With the cells beside them."""
    return cv2.dilate(cells.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0


def _weight(cells: Bool[np.ndarray, "h w"], size: tuple[int, int]) -> np.ndarray:
    """float32 [H,W]: 1 in all that is unseen, falling to 0 over a cell beside it."""
    return cv2.resize(_spread(cells).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
