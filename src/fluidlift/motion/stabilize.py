"""Video stabilisation: shake and drift taken out, cuts found.

Everything downstream takes the camera to stand still. Its motion (`motion.camera_motion`) is taken out by laying all
frames on one of them. Where the camera turns away, the longest run of frames that still share most of the picture is
what can be used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np

from fluidlift.errors import require
from fluidlift.messages import Notice
from fluidlift.motion.camera_motion import camera_motion
from fluidlift.motion.full_frame import UnseenEdges
from fluidlift.motion.moving_camera import Walked, Walking, drawn_again, walked
from fluidlift.numerics.homography2 import carried, drawn_back
from fluidlift.types import MeasuredView
from fluidlift.types.clip import VideoClip

STEADY_PX = 0.3
"""shake below this is left alone: resampling would blur more than it mends"""
STEADY_DRIFT_PX = 1.0
"""drift below this is left alone"""
FAR = 0.04
"""part of the longer side. Of 34 real clips the hand-held ones drift by 0.003 to 0.06 of it, those whose camera goes
somewhere by 0.02 to 0.2; parallax shows from 0.02 on (a tap before a wall)"""
MAY_WALK = 0.005
"""part of the longer side (2.5 px of 512) from which it is looked whether a camera went somewhere. One that drifts by
less shows no parallax that features could be read to"""
SEARCH = 0.16
"""part of the longer side that a feature may have moved since its key frame"""
LEAST_OVERLAP = 0.7
"""part of the picture that all frames used must see: what some of them did not see has no motion of its own there"""
NEAR_TOLD = ("camera-path-unknown", "camera-extra-missing")
"""warnings that say already that what is near still moves"""
MENDED = 0.6
"""the shake that is left, as part of what was, below which the correction is kept"""
WAY_MENDED = 0.25
"""the drift that is left, as part of what was (more than `STEADY_DRIFT_PX`), below which it is kept as well: where
single frames are read badly, the shake tells of these alone. Of real clips that were taken back for their shake, 0.08
and 0.16 is left where the camera did tilt and sway, 0.44 and 0.76 where a jet or surf moved before one that hardly
did"""


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
    runs: tuple[tuple[int, int], ...]
    """first frame and end of what can be used of each shot: where the camera moved on, that is a part of it"""
    warnings: tuple[Notice, ...] = ()
    path: np.ndarray | None = None
    """[T,2] px from the middle of the picture that its shot is laid on: where the middle of each frame lies on it;
    None: it was not looked for"""
    view: MeasuredView | None = None
    """how the camera stood over the water, where it went somewhere and its path was found"""
    fluid_evidence: np.ndarray | None = None
    """float32 [h,w], log odds of fluid from that path, of the whole picture at a size of its own"""
    unseen: np.ndarray | None = None
    """bool [T,h,w], `UnseenEdges.cells` of a picture that was warped"""


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
    clip: VideoClip, *, least_overlap: float = LEAST_OVERLAP, out: np.ndarray | None = None,
    walking: Walking | None = None,
) -> tuple[VideoClip, ShakeReport]:  # fmt: skip
    """The clip as from a camera that stands still, and how the camera moved.

    Args:
        clip: any number of frames; they are read one after the other and may lie in a file.
        least_overlap: part of the picture that each frame used must share with the one all are laid on, 0 to 1.
        out: u8 [T,H,W,3], where steady frames are written if there are any (such as a memory map); None: a new array.
        walking: with what a camera that goes somewhere is looked for; None: it is taken to turn only.

    Returns:
        The same clip when nothing was to mend, or nothing could be.
    """
    require(0 < least_overlap <= 1, f"least_overlap {least_overlap}", "above 0, at most 1")
    width, height = clip.size
    reach = SEARCH * max(width, height)
    cuts = find_cuts(GreyFrames(clip.frames))
    edges = (0, *cuts, len(clip))
    shots = tuple(zip(edges, edges[1:]))
    motions, blind = motions_of_shots(clip.frames, cuts, reach)
    warnings: list[Notice] = []
    if blind:
        warnings.append(
            Notice(
                "camera-not-seen",
                f"in {blind} frames nothing is seen that stands still and has edges, so whether the camera moved is "
                "not known: it is taken to stand still, and if it did not, its motion counts as the fluid's. Where it "
                "was on a tripod nothing is lost; else use a part of the clip that shows more of what stands around "
                "(--start, --duration)",
            )
        )
    shake, drift = shake_and_drift(motions, width, height, cuts)
    if shake <= STEADY_PX and drift <= STEADY_DRIFT_PX:
        path = path_of(motions, clip.size)
        return clip, ShakeReport(shake, drift, False, cuts, shots, tuple(warnings), path)
    runs, laid = [], motions.copy()
    for first, last in shots:
        begin, end, reference = steady_run(motions[first:last], clip.size, least_overlap)
        runs.append((first + begin, first + end))
        laid[first:last] = motions[first:last] @ np.linalg.inv(motions[first + reference])
    unseen = UnseenEdges(len(clip), clip.size)
    steady = warp_back(clip, laid, runs, out, unseen)
    if walking is not None and drift > MAY_WALK * max(width, height):
        first, last = max(runs, key=lambda run: run[1] - run[0])
        laid_plainly = GreyFrames(steady.frames, first, last)
        walk, said = walked(GreyFrames(clip.frames, first, last), walking, laid_plainly)
        if walk is not None:
            _laid_anew(clip, steady, walk, (first, last), unseen)
            told = path_of(laid, clip.size), walk.view, walk.fluid_evidence, unseen.cells
            return steady, ShakeReport(shake, drift, True, cuts, tuple(runs), tuple(warnings), *told)
        warnings += [] if said is None else [said]
    again = [shake_and_drift(motions_of_shots(steady.frames[a:b], (), reach)[0], width, height, ()) for a, b in runs]
    left, away = (max(each) for each in zip(*again))
    on_its_way = drift > STEADY_DRIFT_PX and left < shake and away < WAY_MENDED * drift
    if left < max(MENDED * shake, STEADY_PX) or on_its_way:
        if drift > FAR * max(width, height) and not any(w.code in NEAR_TOLD for w in warnings):
            warnings.append(
                Notice(
                    "camera-moves-far",
                    f"the camera moves by up to {drift:.0f} px: taken out as if it only turned; where it went "
                    f"somewhere, "
                    "what is near still moves",
                )
            )
        path = path_of(laid, clip.size)
        return steady, ShakeReport(shake, drift, True, cuts, tuple(runs), tuple(warnings), path, unseen=unseen.cells)
    warnings.append(
        Notice(
            "camera-motion-unclear",
            f"a camera motion of {shake:.1f} px per frame does not read the same twice: not corrected",
        )
    )
    return clip, ShakeReport(shake, drift, False, cuts, shots, tuple(warnings), path_of(laid, clip.size))


def _laid_anew(
    clip: VideoClip, steady: VideoClip, walk: Walked, run: tuple[int, int], edges: UnseenEdges
) -> None:  # fmt: skip
    """Write one run of frames over what was laid as of a camera that only turns."""
    part = slice(*run)
    alpha = None if steady.alpha is None or clip.alpha is None else steady.alpha[part]
    if alpha is not None and clip.alpha is not None:
        alpha[:] = clip.alpha[part]
    drawn_again(
        clip.frames[part], walk, steady.frames[part], alpha, unseen=lambda t, hidden: edges.put(run[0] + t, hidden)
    )


def path_of(motions: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """float64 [T,2], px from the middle of the common picture: where the middle of each frame lies on it.

    Args:
        motions: [T,3,3], of each frame from that picture.
        size: width, height, px.
    """
    middle = 0.5 * np.asarray(size, float)
    return np.array([carried(np.linalg.inv(motion), middle) - middle for motion in motions]).reshape(-1, 2)


def steady_run(motions: np.ndarray, size: tuple[int, int], least_overlap: float) -> tuple[int, int, int]:
    """The longest run of frames that share enough of the picture with one of them: first, end, and that one.

    Args:
        motions: [T,3,3], of each frame from a common reference.
        size: width, height, px.
        least_overlap: part of the picture.
    """
    width, height = size
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    middle, best = len(motions) // 2, (0, 1, 0)
    for reference in sorted(np.unique(np.linspace(0, len(motions) - 1, 65).astype(int)), key=lambda t: abs(t - middle)):
        here = motions[reference]

        def seen(t: int, here: np.ndarray = here) -> bool:
            view = carried(here @ np.linalg.inv(motions[t]), corners).astype(np.float32)
            return cv2.intersectConvexConvex(corners, view)[0] >= least_overlap * width * height

        begin, end = int(reference), int(reference) + 1
        while begin > 0 and seen(begin - 1):
            begin -= 1
        while end < len(motions) and seen(end):
            end += 1
        if end - begin > best[1] - best[0]:
            best = (begin, end, int(reference))
        if best[1] - best[0] == len(motions):
            break
    return best


def motions_of_shots(frames: np.ndarray, cuts: tuple[int, ...], limit: float) -> tuple[np.ndarray, int]:
    """Homographies [T,3,3], frame from the reference of its shot, and in how many frames none could be found."""
    motions = np.tile(np.eye(3), (len(frames), 1, 1))
    blind = 0
    for start, stop in zip((0, *cuts), (*cuts, len(frames))):
        found = camera_motion(GreyFrames(frames, start, stop), limit=limit)
        if found is None:
            blind += stop - start
        else:
            motions[start:stop] = found
    return motions, blind


def find_cuts(grey: Sequence[np.ndarray]) -> tuple[int, ...]:
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
        if jump > 0.45 and lasting > 0.36 and jump > 3.0 * usual and jump >= near.max(initial=0.0):
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


def shake_and_drift(motions: np.ndarray, width: int, height: int, cuts: tuple[int, ...]) -> tuple[float, float]:
    """Shake and drift in px, as mean displacement over a grid of 9 points of the picture."""
    if len(motions) < 2:
        return 0.0, 0.0
    x, y = np.meshgrid(np.linspace(0, width, 3), np.linspace(0, height, 3))
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    moved = np.stack([carried(motion, points) for motion in motions]) - points
    steps = np.linalg.norm(np.diff(moved, axis=0), axis=-1).mean(axis=-1)
    within = np.ones(len(steps), bool)
    within[[cut - 1 for cut in cuts]] = False
    shake = float(np.percentile(steps[within], 95)) if within.any() else 0.0
    return shake, float(np.linalg.norm(moved, axis=-1).mean(axis=-1).max())


def warp_back(
    clip: VideoClip, motions: np.ndarray, runs: Sequence[tuple[int, int]], out: np.ndarray | None = None,
    edges: UnseenEdges | None = None,
) -> VideoClip:  # fmt: skip
    """The clip with every frame of the runs carried back to its reference.

    What a frame does not see is what the frame before it, on the way from the reference, shows there: its own picture
    or what was filled in (full-frame stabilisation by mosaics, Litvin et al. 2003, without their blending). `edges`
    notes where that is.
    """
    frames = np.empty(clip.frames.shape, np.uint8) if out is None else out
    alpha = None if clip.alpha is None else np.array(clip.alpha)
    width, height = clip.size
    inside = np.full((height, width), 255, np.uint8)
    edged = {"interpolation": cv2.INTER_CUBIC, "border": cv2.BORDER_REPLICATE}
    for first, last in runs:
        reference = first + int(np.argmin([np.abs(m - np.eye(3)).sum() for m in motions[first:last]]))
        for order in (range(reference, last), range(reference - 1, first - 1, -1)):
            before = reference
            for t in order:
                picture = drawn_back(clip.frames[t], motions[t], clip.size, **edged)
                seen = drawn_back(inside, motions[t], clip.size, interpolation=cv2.INTER_NEAREST)
                if t != reference:
                    picture[seen == 0] = frames[before][seen == 0]
                    if edges is not None:
                        edges.put(t, seen == 0)
                frames[t], before = picture, t
                if alpha is not None:
                    alpha[t] = drawn_back(alpha[t], motions[t], clip.size, **edged)
    return replace(clip, frames=frames, alpha=alpha)
