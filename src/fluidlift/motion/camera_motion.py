"""How the camera moves: features tracked from key frames (pyramidal Lucas-Kanade), RANSAC, refined on all pixels.

What flows away is not found again, so that even a fluid that fills most of the picture does not pass for the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fluidlift.motion.align import refined_similarity
from fluidlift.numerics.similarity2 import composed, inverse

GRID = (8, 6)
"""columns and rows of cells that each give features of their own, whatever the contrast elsewhere"""
HYPOTHESES = 3
"""motions tried, each among the features that the ones before left over"""
LEAST_CELLS = 6
"""cells of the grid that must agree on the motion of the camera"""
LEAST_FIT = 0.5
"""part of the textured pixels that must agree with a motion refined on all pixels: where the fluid has more than half
of them, those that fit by chance pull it off by some tenths of a pixel, and features do better"""
LEAST_AGREEMENT = 0.35
"""part of the features found again that must agree on some motion, whichever it is"""
LEAST_ALTERNATIVE = 0.2
"""part of the features found again that must agree on another motion, for that to be the camera's"""


def spread_features(picture: np.ndarray, *, per_cell: int = 8) -> np.ndarray:
    """Corners float32 [n,1,2], px (x,y of pixel indices), the best few of every cell of the grid."""
    height, width = picture.shape
    found = []
    strength = cv2.cornerMinEigenVal(picture, 5)
    for row in range(GRID[1]):
        for column in range(GRID[0]):
            y0, y1 = row * height // GRID[1], (row + 1) * height // GRID[1]
            x0, x1 = column * width // GRID[0], (column + 1) * width // GRID[0]
            cell = np.ascontiguousarray(picture[y0:y1, x0:x1])
            if float(strength[y0:y1, x0:x1].max(initial=0.0)) < 1e-4:
                continue
            corners = cv2.goodFeaturesToTrack(cell, per_cell, 0.1, max(3, min(height, width) // 60), blockSize=5)
            if corners is not None:
                found.append(np.asarray(corners, np.float32).reshape(-1, 1, 2) + np.array([x0, y0], np.float32))
    return np.concatenate(found) if found else np.zeros((0, 1, 2), np.float32)


def camera_motion(grey: Sequence[np.ndarray], *, limit: float) -> np.ndarray | None:
    """Similarities [T,2,3], frame from reference (the middle frame), or None where there is too little to go by.

    Features of a key frame are found again in the frames after it (and, from the middle frame backwards, before it)
    for as long as enough of them agree; then the last of these becomes the next key frame, and motions are chained.
    Key frames are as rare as they can be: what flows has changed its look by the time that another is needed.

    Args:
        grey: u8 [H,W] pictures of one shot.
        limit: px, the farthest that a feature may have moved since its key frame.
    """
    middle = len(grey) // 2
    first = _KeyFrame.of(grey[middle], np.eye(2, 3))
    if len(first.features) < 4 * LEAST_CELLS:
        return None
    motions = np.tile(np.eye(2, 3), (len(grey), 1, 1))
    lost = 0
    for order in (range(middle + 1, len(grey)), range(middle - 1, -1, -1)):
        key, key_frame, before = first, middle, middle
        for t in order:
            found, agreed = key.motion_to(grey[t], motions[before], limit)
            if not agreed and before != key_frame:
                nearer = _KeyFrame.of(grey[before], motions[before])
                chained, agreed = nearer.motion_to(grey[t], motions[before], limit)
                if agreed:
                    key, key_frame, found = nearer, before, chained
            lost += not agreed
            motions[t], before = found, t
    return None if lost > 0.5 * (len(grey) - 1) else motions


@dataclass(frozen=True)
class _KeyFrame:
    """A frame that the ones near it are found from."""

    picture: np.ndarray
    """u8 [H,W]"""
    motion: np.ndarray
    """[2,3], of this frame from the reference"""
    features: np.ndarray
    """float32 [n,1,2]"""
    cells: np.ndarray
    """int [n], in which cell of the grid each lies"""

    @classmethod
    def of(cls, picture: np.ndarray, motion: np.ndarray) -> _KeyFrame:
        features = spread_features(picture)
        places = features[:, 0] * np.array(GRID, np.float32) / np.array(picture.shape[::-1], np.float32)
        columns, rows = places.astype(int).T
        return cls(picture, motion, features, rows * GRID[0] + columns)

    def motion_to(self, picture: np.ndarray, last: np.ndarray, limit: float) -> tuple[np.ndarray, bool]:
        """Similarity [2,3] of a picture from the reference, and whether enough of it agrees; `last` is a guess."""
        guess = composed(last, inverse(self.motion))
        found = similarity_to(self.picture, picture, self.features, self.cells, guess, limit)
        settled, fits = _settled(self.picture, picture, guess if found is None else found, guess)
        return composed(settled, self.motion), found is not None or fits


def _settled(
    reference: np.ndarray, picture: np.ndarray, found: np.ndarray, last: np.ndarray
) -> tuple[np.ndarray, bool]:
    """The similarity refined on all pixels, from the features' guess or from the frame before, whichever fits more.

    Where too little of the picture agrees with either to be refined by it (False), the better guess stays as it is.
    """
    best, most = found, LEAST_FIT
    for guess in (found, last):
        refined, fit, cells = refined_similarity(reference, picture, guess)
        if cells >= LEAST_CELLS and fit > most:
            best, most = refined, fit
    if most > LEAST_FIT:
        return best, True
    return max((found, last), key=lambda guess: refined_similarity(reference, picture, guess, iterations=1)[1]), False


def similarity_to(
    reference: np.ndarray, picture: np.ndarray, features: np.ndarray, cells: np.ndarray, guess: np.ndarray, limit: float
) -> np.ndarray | None:
    """Similarity [2,3] that carries the features to the picture, or None when too few of them agree on one."""
    options = {"winSize": (17, 17), "maxLevel": 3, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    start = (features @ guess[:, :2].T + guess[:, 2]).astype(np.float32)
    ahead, ok_ahead, _ = cv2.calcOpticalFlowPyrLK(reference, picture, features, start.copy(), **options)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(picture, reference, ahead, features.copy(), **options)
    gone = np.linalg.norm(back - features, axis=-1)[:, 0]
    moved = np.linalg.norm(ahead - features, axis=-1)[:, 0]
    good = (ok_ahead[:, 0] > 0) & (ok_back[:, 0] > 0) & (gone < 0.5) & (moved < limit)
    if good.sum() < 3 * LEAST_CELLS:
        return None
    return calmest_similarity(features[good, 0], ahead[good, 0], cells[good])


def calmest_similarity(source: np.ndarray, target: np.ndarray, cells: np.ndarray) -> np.ndarray | None:
    """RANSAC: the similarity [2,3] of least motion among those that enough of the pairs [n,2] agree on, or None.

    A river that slides by as one sheet is a similarity too, and may have more features than its banks: it moves
    farther from the reference than a camera on its place does.
    """
    left = np.ones(len(source), bool)
    best, least = None, np.inf
    cv2.setRNGSeed(0)
    for part in [LEAST_AGREEMENT] + [LEAST_ALTERNATIVE] * (HYPOTHESES - 1):
        if left.sum() < max(3 * LEAST_CELLS, part * len(source)):
            break
        similarity, inliers = cv2.estimateAffinePartial2D(
            source[left], target[left], method=cv2.RANSAC, ransacReprojThreshold=0.7, maxIters=500, confidence=0.995
        )
        if similarity is None:
            break
        agree = np.flatnonzero(left)[inliers[:, 0] > 0]
        if len(agree) < part * len(source):
            break
        moved = float(np.linalg.norm(target[agree] - source[agree], axis=-1).mean())
        if len(np.unique(cells[agree])) >= LEAST_CELLS and moved < least:
            best, least = similarity, moved
        left[agree] = False
    return best
