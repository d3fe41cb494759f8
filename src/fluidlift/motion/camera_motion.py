"""How the camera moves: features tracked from key frames (pyramidal Lucas-Kanade), RANSAC, refined on all pixels.

What flows away is not found again, so that even a fluid that fills most of the picture does not pass for the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fluidlift.motion.align import refined_similarity
from fluidlift.motion.confidence import photometric_agreement
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

PROBES = 12
"""frames, spread over the shot, from which it is looked whether the scene holds together on its way"""
LEAST_WAY = 2.5
"""px that a camera goes before that can be told from standing still: such surroundings look the same after less"""
FOUND_AGAIN, LOST = 0.8, 0.5
"""photometric agreement of a feature's surroundings with those where the camera's motion carries it, above which it was
found again, and with those at its old place, below which it has moved"""
SCENE = 5.0
"""cells of the grid with such features over half of the way or `limit` / 2 px. Of 34 clips of 3 s, seven need more than
one key frame: four cameras that moved (hands, one that walks over a torrent) have 8 to 23 cells, three that stood
before smoke and a jet 1 to 3"""


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
    lost, several_keys = 0, False
    for order in (range(middle + 1, len(grey)), range(middle - 1, -1, -1)):
        key, key_frame, before = first, middle, middle
        for t in order:
            found, agreed = key.motion_to(grey[t], motions[before], limit)
            if not agreed and before != key_frame:
                nearer = _KeyFrame.of(grey[before], motions[before])
                chained, agreed = nearer.motion_to(grey[t], motions[before], limit)
                if agreed:
                    key, key_frame, found, several_keys = nearer, before, chained, True
            lost += not agreed
            motions[t], before = found, t
    if lost > 0.5 * (len(grey) - 1) or (several_keys and not scene_holds(grey, motions, limit)):
        return None
    return motions


def scene_holds(grey: Sequence[np.ndarray], motions: np.ndarray, limit: float) -> bool:
    """Whether a scene goes along with the motion of a camera over half of its way; True of one that hardly moves.

    From frame to frame smoke that rises as one is carried like a picture, and may be all that has features: before a
    dark room the camera would follow it, from key frame to key frame. Over a longer way it changes its look, and a
    scene does not.

    Args:
        grey: u8 [H,W] pictures of one shot.
        motions: similarities [T,2,3], frame from reference.
        limit: px, the farthest that features are followed.
    """
    height, width = grey[0].shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    places = np.einsum("tij,nj->tni", motions[:, :, :2], corners) + motions[:, None, :, 2]
    probes = np.unique(np.linspace(0, len(grey) - 1, PROBES).astype(int))
    ways = np.array([np.linalg.norm(places - places[t], axis=-1).mean(axis=-1) for t in probes])
    far = 0.5 * min(float(ways.max()), limit)
    if far < LEAST_WAY:
        return True
    cells = []
    for t, way in zip(probes, ways, strict=True):
        beyond = np.flatnonzero(way >= far)
        if len(beyond):
            other = int(beyond[np.abs(beyond - t).argmin()])
            cells.append(_cells_found_again(grey[t], grey[other], composed(motions[other], inverse(motions[t]))))
    return float(np.mean(cells)) >= SCENE


def _cells_found_again(first: np.ndarray, second: np.ndarray, motion: np.ndarray) -> int:
    """Cells of the grid with features of one picture that a similarity [2,3], and not standing still, finds again."""
    height, width = first.shape
    features = spread_features(first)[:, 0]
    if not len(features):
        return 0
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
    flow = (pixels @ motion[:, :2].T + motion[:, 2] - pixels).astype(np.float32)
    a, b = first.astype(np.float32), second.astype(np.float32)
    here = np.round(features).astype(int)
    there = here + flow[here[:, 1], here[:, 0]]
    here = here[((there >= 0) & (there <= np.array([width - 1, height - 1]))).all(axis=1)]
    carried, stayed = (photometric_agreement(a, b, f)[here[:, 1], here[:, 0]] for f in (flow, np.zeros_like(flow)))
    moved = here[(carried > FOUND_AGAIN) & (stayed < LOST)]
    columns, rows = (moved * np.array(GRID) // np.array([width, height])).T
    return len(np.unique(rows * GRID[0] + columns))


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
