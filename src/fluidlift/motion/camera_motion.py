"""How the camera turns: features tracked from key frames (pyramidal Lucas-Kanade), RANSAC, refined on all pixels.

What flows away is not found again, so that even a fluid that fills most of the picture does not pass for the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fluidlift.motion.align import refined_turn
from fluidlift.motion.confidence import photometric_agreement
from fluidlift.motion.perspective import Pair, perspective_of
from fluidlift.numerics.homography2 import carried, turn_rates, turned

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
LEAST_ALTERNATIVE = 0.12
"""part of the features found again that must agree on another motion, for that to be the camera's: what stands beside a
fall that fills three quarters of the picture has a sixth of them from one frame to the next, and six cells keep chance
out. With 0.2 the camera was carried along by such falls (made ones)"""

ASIDE = 0.015
"""part of the longer side by which a similarity may miss features, for these to tell its perspective: a turn by a tenth
of the picture bends it by as much at its corners"""
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
SURROUNDS = 20
"""cells of the grid in which a scene has features, at least. In parts of these clips' pictures smoke and a splash
before a dark room have them in 7 to 19, and up to 7 hold together over half of the way; cameras that moved saw 29 to
48"""


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
    """Homographies [T,3,3], frame from reference (the middle frame), or None where there is too little to go by.

    They are those of a camera that turns, with as much perspective as the clip itself shows (`motion.perspective`):
    similarities of the features alone say how far it goes and where they are found again to tell it.

    Args:
        grey: u8 [H,W] pictures of one shot.
        limit: px, the farthest that a feature may have moved since its key frame.
    """
    roughly = _followed(grey, limit, 0.0, settle=False)
    if roughly is None:
        return _followed(grey, limit, 0.0)
    return _followed(grey, limit, perspective_of(_far_pairs(grey, roughly, limit), grey[0].shape[::-1]))


def _followed(
    grey: Sequence[np.ndarray], limit: float, perspective: float, *, settle: bool = True
) -> np.ndarray | None:
    """Homographies [T,3,3] of a known perspective, or None; of features alone, if they need not be settled.

    Features of a key frame are found again in the frames after it (and, from the middle frame backwards, before it)
    for as long as enough of them agree; then the last of these becomes the next key frame, and motions are chained.
    Key frames are as rare as they can be: what flows has changed its look by the time that another is needed.
    """
    middle = len(grey) // 2
    first = _KeyFrame.of(grey[middle], np.eye(3))
    if len(first.features) < 4 * LEAST_CELLS:
        return None
    motions = np.tile(np.eye(3), (len(grey), 1, 1))
    lost, several_keys = 0, False
    for order in (range(middle + 1, len(grey)), range(middle - 1, -1, -1)):
        key, key_frame, before = first, middle, middle
        for t in order:
            found, agreed = key.motion_to(grey[t], motions[before], limit, perspective, settle=settle)
            if not agreed and before != key_frame:
                nearer = _KeyFrame.of(grey[before], motions[before])
                chained, agreed = nearer.motion_to(grey[t], motions[before], limit, perspective, settle=settle)
                if agreed:
                    key, key_frame, found, several_keys = nearer, before, chained, True
            lost += not agreed
            motions[t], before = found, t
    if lost > 0.5 * (len(grey) - 1) or (settle and several_keys and not scene_holds(grey, motions, limit)):
        return None
    return motions


def scene_holds(grey: Sequence[np.ndarray], motions: np.ndarray, limit: float) -> bool:
    """Whether a scene goes along with the motion of a camera over half of its way; True of one that hardly moves.

    From frame to frame smoke that rises as one is carried like a picture, and may be all that has features: before a
    dark room the camera would follow it, from key frame to key frame. Over a longer way it changes its look, and a
    scene does not; and a scene is all around, where smoke is a thing in the dark.

    Args:
        grey: u8 [H,W] pictures of one shot.
        motions: homographies [T,3,3], frame from reference.
        limit: px, the farthest that features are followed.
    """
    far, apart = _apart(motions, grey[0].shape[::-1], limit)
    if far < LEAST_WAY:
        return True
    if len(np.unique(_KeyFrame.of(grey[len(grey) // 2], np.eye(3)).cells)) < SURROUNDS:
        return False
    cells = [_cells_found_again(grey[t], grey[other], motions[other] @ np.linalg.inv(motions[t])) for t, other in apart]
    return float(np.mean(cells)) >= SCENE


def _apart(motions: np.ndarray, size: tuple[int, int], limit: float) -> tuple[float, list[tuple[int, int]]]:
    """Half of the way of a camera (`limit` / 2 px at most), and frames spread over the shot that are so far apart."""
    width, height = size
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], float)
    places = np.stack([carried(motion, corners) for motion in motions])
    probes = np.unique(np.linspace(0, len(motions) - 1, PROBES).astype(int))
    ways = np.array([np.linalg.norm(places - places[t], axis=-1).mean(axis=-1) for t in probes])
    far = 0.5 * min(float(ways.max()), limit)
    pairs = []
    for t, way in zip(probes, ways, strict=True):
        beyond = np.flatnonzero(way >= far)
        if len(beyond):
            pairs.append((int(t), int(beyond[np.abs(beyond - t).argmin()])))
    return far, pairs


def _far_pairs(grey: Sequence[np.ndarray], motions: np.ndarray, limit: float) -> list[Pair]:
    """Features of frames far apart, found again where the motions of the camera say or near it."""
    far, apart = _apart(motions, grey[0].shape[::-1], limit)
    pairs = []
    for t, other in apart if far >= LEAST_WAY else ():
        guess = motions[other] @ np.linalg.inv(motions[t])
        features = spread_features(grey[t])
        here, there, _ = found_again(grey[t], grey[other], features, guess, limit)
        near = np.linalg.norm(there - carried(guess, here), axis=-1) < ASIDE * max(grey[t].shape)
        pairs.append(Pair(here[near], there[near], guess))
    return pairs


def _cells_found_again(first: np.ndarray, second: np.ndarray, motion: np.ndarray) -> int:
    """Cells of the grid with features of one picture that a homography [3,3], and not standing still, finds again."""
    height, width = first.shape
    features = spread_features(first)[:, 0]
    if not len(features):
        return 0
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)
    flow = (carried(motion, pixels) - pixels).astype(np.float32)
    a, b = first.astype(np.float32), second.astype(np.float32)
    here = np.round(features).astype(int)
    there = here + flow[here[:, 1], here[:, 0]]
    here = here[((there >= 0) & (there <= np.array([width - 1, height - 1]))).all(axis=1)]
    alike, stayed = (photometric_agreement(a, b, f)[here[:, 1], here[:, 0]] for f in (flow, np.zeros_like(flow)))
    moved = here[(alike > FOUND_AGAIN) & (stayed < LOST)]
    columns, rows = (moved * np.array(GRID) // np.array([width, height])).T
    return len(np.unique(rows * GRID[0] + columns))


@dataclass(frozen=True)
class _KeyFrame:
    """A frame that the ones near it are found from."""

    picture: np.ndarray
    """u8 [H,W]"""
    motion: np.ndarray
    """[3,3], of this frame from the reference"""
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

    def motion_to(
        self, picture: np.ndarray, last: np.ndarray, limit: float, perspective: float, *, settle: bool
    ) -> tuple[np.ndarray, bool]:
        """Homography [3,3] of a picture from the reference, and whether enough of it agrees; `last` is a guess."""
        guess = last @ np.linalg.inv(self.motion)
        found = turn_to(self.picture, picture, self.features, self.cells, guess, limit, perspective)
        if not settle:
            return (guess if found is None else found) @ self.motion, found is not None
        settled, fits = _settled(self.picture, picture, guess if found is None else found, guess, perspective)
        return settled @ self.motion, found is not None or fits


def _settled(
    reference: np.ndarray, picture: np.ndarray, found: np.ndarray, last: np.ndarray, perspective: float
) -> tuple[np.ndarray, bool]:
    """The turn refined on all pixels, from the features' guess or from the frame before, whichever fits more.

    Where too little of the picture agrees with either to be refined by it (False), the better guess stays as it is.
    """
    best, most = found, LEAST_FIT
    for guess in (found, last):
        refined, fit, cells = refined_turn(reference, picture, guess, perspective=perspective)
        if cells >= LEAST_CELLS and fit > most:
            best, most = refined, fit
    if most > LEAST_FIT:
        return best, True
    return max((found, last), key=lambda guess: refined_turn(reference, picture, guess, iterations=1)[1]), False


def turn_to(
    reference: np.ndarray, picture: np.ndarray, features: np.ndarray, cells: np.ndarray, guess: np.ndarray,
    limit: float, perspective: float,
) -> np.ndarray | None:  # fmt: skip
    """Homography [3,3] that carries the features to the picture, or None when too few of them agree on one.

    Args:
        reference: grey, u8 [H,W], with the features (float32 [n,1,2], px) in it.
        picture: grey, u8 [H,W].
        features: px, as pixel indices.
        cells: int [n], of the grid, in which they lie.
        guess: [3,3], right to some px.
        limit: px, the farthest that a feature may have moved.
        perspective: 1 over the focal length squared, 1/px^2.
    """
    here, there, good = found_again(reference, picture, features, guess, limit)
    if len(here) < 3 * LEAST_CELLS:
        return None
    # the way that is left from the guess is short: a similarity, of which the turn is then made
    rest = carried(np.linalg.inv(guess), there)
    agree = calmest(here, rest.astype(np.float32), np.linalg.norm(there - here, axis=-1), cells[good])
    if agree is None:
        return None
    return guess @ _turn_between(here[agree], rest[agree], perspective, reference.shape[::-1])


def _turn_between(here: np.ndarray, there: np.ndarray, perspective: float, size: tuple[int, int]) -> np.ndarray:
    """The turn [3,3] that carries points [n,2] to others not far away, of least squares (Gauss-Newton)."""
    middle, motion = 0.5 * (np.asarray(size, float) - 1.0), np.eye(3)
    design = turn_rates(here - middle, perspective).reshape(4, -1).T
    for _ in range(3):  # of a way of 20 px the first step leaves tenths, the second thousandths
        left = carried(np.linalg.inv(motion), there) - here
        step = np.linalg.lstsq(design, left.T.ravel(), rcond=None)[0]
        motion = motion @ turned(step, perspective, middle)
    return motion


def found_again(
    reference: np.ndarray, picture: np.ndarray, features: np.ndarray, guess: np.ndarray, limit: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which features [n,1,2] of one picture another shows: [m,2] here, [m,2] there, px, and bool [n] which they are."""
    options = {"winSize": (17, 17), "maxLevel": 3, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    start = carried(guess, features).astype(np.float32)
    ahead, ok_ahead, _ = cv2.calcOpticalFlowPyrLK(reference, picture, features, start.copy(), **options)
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(picture, reference, ahead, features.copy(), **options)
    gone = np.linalg.norm(back - features, axis=-1)[:, 0]
    moved = np.linalg.norm(ahead - features, axis=-1)[:, 0]
    good = (ok_ahead[:, 0] > 0) & (ok_back[:, 0] > 0) & (gone < 0.5) & (moved < limit)
    return features[good, 0], ahead[good, 0], good


def calmest(source: np.ndarray, target: np.ndarray, moved: np.ndarray, cells: np.ndarray) -> np.ndarray | None:
    """RANSAC: of pairs [n,2] those (int) that agree on the similarity of least motion that enough agree on, or None.

    A river that slides by as one sheet is a similarity too, and may have more features than its banks: it moves
    farther from the reference than a camera on its place does.

    Args:
        source: px.
        target: px.
        moved: [n] px, the way of each that counts.
        cells: int [n], of the grid, in which they lie.
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
        way = float(moved[agree].mean())
        if len(np.unique(cells[agree])) >= LEAST_CELLS and way < least:
            best, least = agree, way
        left[agree] = False
    return best
