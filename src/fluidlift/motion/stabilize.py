"""Camera motion by tracked features and RANSAC: shake, cuts, and video stabilisation where the shake is mild.

Everything downstream takes the camera to stand still. The camera's motion is read from features that are found
again, against one reference frame, over the whole picture: what flows away is not found again, so that even a fluid
that fills most of the picture does not pass for the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from fluidlift.errors import require
from fluidlift.motion.align import refined_similarity
from fluidlift.types.clip import VideoClip

GRID = (8, 6)
"""columns and rows of cells that each give features of their own, whatever the contrast elsewhere"""
STEADY_PX = 0.3
"""shake below this is left alone: resampling would blur more than it mends"""
STEADY_DRIFT_PX = 1.0
"""drift below this is left alone"""
MENDED = 0.6
"""the shake that is left, as part of what was, below which the correction is kept"""
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


@dataclass(frozen=True)
class ShakeReport:
    """How the camera moved."""

    shake_px: float
    """95th percentile over frames of the camera's motion between neighbouring frames, px"""
    drift_px: float
    """largest distance from the reference frame of each shot, px"""
    stabilised: bool
    """whether the picture was warped"""
    cuts: tuple[int, ...]
    """first frame of every shot but the first"""
    warnings: tuple[str, ...] = ()


class GreyFrames(Sequence[np.ndarray]):
    """The frames u8 [T,H,W,3] of a clip in grey, made when they are asked for: a long clip never lies in memory."""

    def __init__(self, frames: np.ndarray, first: int = 0, last: int | None = None) -> None:
        self.frames, self.first = frames, first
        self.last = len(frames) if last is None else last

    def __len__(self) -> int:
        return self.last - self.first

    def __getitem__(self, index):
        if not 0 <= index < len(self):
            raise IndexError(index)
        return cv2.cvtColor(np.ascontiguousarray(self.frames[self.first + index]), cv2.COLOR_RGB2GRAY)


def stabilise(
    clip: VideoClip, *, max_correction_px: float | None = None, out: np.ndarray | None = None
) -> tuple[VideoClip, ShakeReport]:
    """The clip as from a camera that stands still, and how the camera moved.

    Args:
        clip: any number of frames; they are read one after the other and may lie in a file.
        max_correction_px: a larger motion is reported but not corrected; default 4% of the longer side.
        out: u8 [T,H,W,3], where steady frames are written if there are any (such as a memory map); None: a new array.

    Returns:
        The same clip when nothing was to mend, or nothing could be.
    """
    width, height = clip.size
    limit = 0.04 * max(width, height) if max_correction_px is None else max_correction_px
    require(limit > 0, f"max_correction_px {limit}", "above 0")
    cuts = find_cuts(GreyFrames(clip.frames))
    warnings = [f"the clip is cut at frame {cut}: use one shot" for cut in cuts]
    motions, blind = motions_of_shots(clip.frames, cuts, limit)
    if blind:
        warnings.append(f"no features that stay, to see the camera by, in {blind} frames: assumed still")
    shake, drift = shake_and_drift(motions, width, height, cuts)
    strong = shake > limit or drift > limit
    restless = shake > STEADY_PX or drift > STEADY_DRIFT_PX
    if strong:
        warnings.append(f"the camera moves by up to {max(shake, drift):.1f} px: use a clip from a tripod")
    if restless and not strong:
        steady = warp_back(clip, motions, out)
        left, _ = shake_and_drift(motions_of_shots(steady.frames, cuts, limit)[0], width, height, cuts)
        if left < max(MENDED * shake, STEADY_PX):
            return steady, ShakeReport(shake, drift, True, cuts, tuple(warnings))
        warnings.append(f"a camera motion of {shake:.1f} px per frame does not read the same twice: not corrected")
    return clip, ShakeReport(shake, drift, False, cuts, tuple(warnings))


def motions_of_shots(frames: np.ndarray, cuts: tuple[int, ...], limit: float) -> tuple[np.ndarray, int]:
    """Similarities [T,2,3], frame from the reference of its shot, and in how many frames none could be found."""
    motions = np.tile(np.eye(2, 3), (len(frames), 1, 1))
    blind = 0
    for start, stop in zip((0, *cuts), (*cuts, len(frames))):
        found = camera_motion(GreyFrames(frames, start, stop), limit=4.0 * limit)
        if found is None:
            blind += stop - start
        else:
            motions[start:stop] = found
    return motions, blind


def find_cuts(grey: Sequence[np.ndarray], *, least: float = 0.45) -> tuple[int, ...]:
    """First frames of new shots, from u8 [H,W] pictures.

    Two pictures differ by as much as the correlation of their layouts (32 x 18 px, so brightness and contrast do not
    count) and of their histograms fails. At a cut the frames before and after differ from each other but not among
    themselves: a flash or a flicker returns, a fluid changes a part of the layout and all the time.
    """
    layouts = [cv2.resize(picture, (32, 18), interpolation=cv2.INTER_AREA).astype(np.float32) for picture in grey]
    if len(layouts) < 3:
        return ()
    step = np.array([unlike(a, b) for a, b in pairwise(layouts)])
    cuts = []
    for t in range(1, len(layouts)):
        jump = step[t - 1]
        near = np.concatenate([step[max(t - 6, 0) : t - 1], step[t : t + 5]])
        lasting = min(
            unlike(layouts[max(t - 2, 0)], layouts[t]), unlike(layouts[t - 1], layouts[min(t + 1, len(layouts) - 1)])
        )
        usual = float(np.median(near)) if len(near) else 0.0
        if jump > least and lasting > 0.8 * least and jump > 3.0 * usual and jump >= near.max(initial=0.0):
            cuts.append(t)
    return tuple(cuts)


def unlike(first: np.ndarray, second: np.ndarray) -> float:
    """1 - correlation of two float32 layouts in [0,2]; flat pictures (deviation below 2 grey levels) are alike."""
    a, b = first - first.mean(), second - second.mean()
    strong_a, strong_b = float(np.sqrt((a**2).mean())), float(np.sqrt((b**2).mean()))
    if max(strong_a, strong_b) < 2.0:
        return 0.0
    if min(strong_a, strong_b) < 2.0:
        return min(1.0, abs(strong_a - strong_b) / 16.0)
    return float(1.0 - (a * b).mean() / (strong_a * strong_b))


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
    """Similarities [T,2,3], frame from reference (the middle frame), or None where there is too little to go by."""
    middle = len(grey) // 2
    reference = grey[middle]
    features = spread_features(reference)
    if len(features) < 4 * LEAST_CELLS:
        return None
    height, width = reference.shape
    places = features[:, 0] * np.array(GRID, np.float32) / np.array([width, height], np.float32)
    columns, rows = places.astype(int).T
    cells = rows * GRID[0] + columns
    motions = np.tile(np.eye(2, 3), (len(grey), 1, 1))
    weak = 0
    for order in (range(middle + 1, len(grey)), range(middle - 1, -1, -1)):
        last = np.eye(2, 3)
        for t in order:
            picture = grey[t]
            found = similarity_to(reference, picture, features, cells, last, limit)
            weak += found is None
            last = _settled(reference, picture, last if found is None else found, last)
            motions[t] = last
    return None if weak > 0.5 * (len(grey) - 1) else motions


def _settled(reference: np.ndarray, picture: np.ndarray, found: np.ndarray, last: np.ndarray) -> np.ndarray:
    """The similarity refined on all pixels, from the features' guess or from the frame before, whichever fits more.

    Where too little of the picture agrees with either to be refined by it, the better guess stays as it is.
    """
    best, most = found, LEAST_FIT
    for guess in (found, last):
        refined, fit, cells = refined_similarity(reference, picture, guess)
        if cells >= LEAST_CELLS and fit > most:
            best, most = refined, fit
    if most > LEAST_FIT:
        return best
    return max((found, last), key=lambda guess: refined_similarity(reference, picture, guess, iterations=1)[1])


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


def shake_and_drift(motions: np.ndarray, width: int, height: int, cuts: tuple[int, ...]) -> tuple[float, float]:
    """Shake and drift in px, as mean displacement over a grid of 9 points of the picture."""
    if len(motions) < 2:
        return 0.0, 0.0
    x, y = np.meshgrid(np.linspace(0, width, 3), np.linspace(0, height, 3))
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    moved = np.einsum("tij,nj->tni", motions[:, :, :2], points) + motions[:, None, :, 2] - points
    steps = np.linalg.norm(np.diff(moved, axis=0), axis=-1).mean(axis=-1)
    within = np.ones(len(steps), bool)
    within[[cut - 1 for cut in cuts]] = False
    shake = float(np.percentile(steps[within], 95)) if within.any() else 0.0
    return shake, float(np.linalg.norm(moved, axis=-1).mean(axis=-1).max())


def warp_back(clip: VideoClip, motions: np.ndarray, out: np.ndarray | None = None) -> VideoClip:
    """The clip with every frame carried back to its reference; what comes in from outside repeats the rim."""

    def moved(picture: np.ndarray, motion: np.ndarray) -> np.ndarray:
        way = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(picture, motion, clip.size, flags=way, borderMode=cv2.BORDER_REPLICATE)

    frames = np.empty(clip.frames.shape, np.uint8) if out is None else out
    for t, motion in enumerate(motions):
        frames[t] = moved(clip.frames[t], motion)
    alpha = clip.alpha
    if alpha is not None:
        alpha = np.stack([moved(a, m) for a, m in zip(alpha, motions)])
    return replace(clip, frames=frames, alpha=alpha)
