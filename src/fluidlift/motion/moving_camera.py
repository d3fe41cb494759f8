"""A clip of a camera that goes somewhere as from one that stands: each frame drawn again from one place.

The poses of the camera and the depth of what stands say where every pixel of one frame is seen in the others
(image-based rendering by depth). The water has the depth of its plane, for which that is the homography
K (R - t n^T / h) K^-1 (Hartley, Zisserman 2004, 13.1): it moves as before a tripod, and so does nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import MissingPackage
from fluidlift.messages import Notice
from fluidlift.motion.parallax import parallax_of
from fluidlift.motion.plane_sweep import Swept, sweep
from fluidlift.motion.tracks import follow
from fluidlift.motion.water_plane import FLOWS, STANDS, SURE, WaterPlane, flowing, water_plane
from fluidlift.seams import PoseSolver
from fluidlift.types import CameraPath, MeasuredView

CLOSE_FIT = 0.5
"""px, median error of the path's points above which it is not believed. A corner is found to 0.2 px"""
GAIN = 0.1
"""of the picture that must stand better, drawn again, than as from a camera that only turns, less what stands worse. Of
real clips 0.28 and 0.33 where the camera went, 0.14 of a flood in nine frames, 0.00 to 0.06 where hands with a jug or a
kettle moved before one that sways: two things that move as wholes agree on one path, too"""
BETTER = 2.0
"""grey levels, of the difference to the frame of reference, by which a pixel stands better or worse: less is noise, or
the blur of drawing again"""
SAMPLES = 9
"""frames in which that is looked at"""
REACH = 3.0
"""px of working size over which depth is taken from what is known beside"""


STANDING = -2.4
"""log odds of fluid where the frames agree at some depth: so does 0.07 of the water before made cameras and a real one,
and 0.75 of the rest. Where they do not, nothing is said: twigs hide each other, and fine detail is not read exactly"""


@dataclass(frozen=True)
class Lens:
    """What is known of the focal length."""

    focal: float
    """px"""
    told: bool = False
    """it is no guess"""


@dataclass(frozen=True)
class Walking:
    """With what a camera that goes somewhere is looked for."""

    lens: Lens
    solver: Callable[[], PoseSolver]
    """makes the one that finds poses; it raises MissingPackage where it cannot"""


@dataclass(frozen=True)
class Walked:
    """A camera that went somewhere, and what it went along."""

    path: CameraPath
    """in the axes of the reference frame"""
    reference: int
    swept: Swept
    plane: WaterPlane | None
    """of the water; None where no level shore is seen, as behind a fall or a jet"""

    @property
    def view(self) -> MeasuredView | None:
        """How it stood over the water in the frame of reference, where there is a plane to tell it by."""
        path, plane = self.path, self.plane
        if plane is None:
            return None
        return MeasuredView(
            plane.pitch, plane.roll, path.focal, path.focal_error, plane.support, len(path.points), path.error_px
        )

    @property
    def fluid_evidence(self) -> Float[np.ndarray, "h w"]:
        """Log odds of fluid, float32 at working size: against it, or 0.

        What is seen the same from all places at one depth stands. What flows over the horizon of the water, apart from
        it, does not lie on it: twigs before the sky, which hide each other.
        """
        swept, plane = self.swept, self.plane
        share = np.clip((swept.unlike - STANDS) / (FLOWS - STANDS), 0.0, 1.0)
        odds = STANDING * (1.0 - share)
        odds = np.where(swept.sure > SURE, odds, 0.0)  # of one colour: alike wherever it is
        if plane is not None:
            over = plane.inverse_depth(swept.rays(self.path.focal)) < 0.0
            near_water = cv2.dilate(plane.water.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
            odds = np.where(over & flowing(swept) & ~near_water, STANDING, odds)
        return odds.astype(np.float32)

    def maps(self, t: int, size: tuple[int, int], inverse: Float[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
        """Where a frame shows the pixels of the reference, float32 [H,W] each, px from the middle of the first pixel.

        Args:
            t: number of the frame.
            size: of the picture, px.
            inverse: 1 over depth at full size.
        """
        path, (width, height) = self.path, size
        x, y = np.meshgrid(np.arange(width) + 0.5 - 0.5 * width, np.arange(height) + 0.5 - 0.5 * height)
        turn = path.rotations[t]
        at = [turn[k, 0] * x + turn[k, 1] * y + turn[k, 2] * path.focal for k in range(3)]
        at = [a + path.focal * path.translations[t, k] * inverse for k, a in enumerate(at)]
        z = np.maximum(at[2], 1e-6)
        return (
            (path.focal * at[0] / z + 0.5 * width - 0.5).astype(np.float32),
            (path.focal * at[1] / z + 0.5 * height - 0.5).astype(np.float32),
        )

    def inverse_depth(self, size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
        """1 over depth of each pixel of the reference at full size.

        Of the water its plane's; of what stands what was swept; of what else flows that of what stands around it.
        """
        swept, plane = self.swept, self.plane
        known = (swept.unlike < STANDS) & (swept.sure > SURE)
        stands = cv2.medianBlur(swept.inverse_depth.astype(np.float32), 5)
        if plane is None:
            return cv2.resize(_filled(stands, known), size, interpolation=cv2.INTER_LINEAR)
        level = np.maximum(plane.inverse_depth(swept.rays(self.path.focal)), 0.0)
        # what stands stands above the water, so nearer than its plane along each ray
        filled = _filled(np.where(plane.water, level, np.maximum(stands, level)), known | plane.water)
        above = np.where(plane.water, 0.0, filled - level).astype(np.float32)
        width, height = size
        x, y = np.meshgrid(np.arange(width) + 0.5 - 0.5 * width, np.arange(height) + 0.5 - 0.5 * height)
        rays = np.stack([x, y, np.full(x.shape, self.path.focal)], axis=-1) / self.path.focal
        return np.maximum(plane.inverse_depth(rays), 0.0) + cv2.resize(above, size, interpolation=cv2.INTER_LINEAR)


def _filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """float32 [h,w]: what is not known from what is beside it, nearest scale first (normalised convolution)."""
    out, left = np.where(known, values, 0.0).astype(np.float32), ~known
    weight = known.astype(np.float32)
    base = out.copy()
    sigma = REACH
    while left.any() and sigma < max(values.shape):
        near = cv2.GaussianBlur(weight, (0, 0), sigma)
        mean = cv2.GaussianBlur(base, (0, 0), sigma) / np.maximum(near, 1e-6)
        reached = left & (near > 0.05)
        out[reached] = mean[reached]
        left &= ~reached
        sigma *= 2.0
    out[left] = values[left]
    return out


def walked(
    grey: Sequence[np.ndarray], walking: Walking, steady: Sequence[np.ndarray] | None = None
) -> tuple[Walked | None, Notice | None]:
    """How a camera went, where it did and that can be told; else a notice where it did and cannot.

    Args:
        grey: u8 [H,W] pictures of one view.
        walking: what is known of the lens, and who finds poses.
        steady: the same pictures, laid as of a camera that only turns; None: they stand no better than `grey`.
    """
    tracks = follow(grey)
    parallax = parallax_of(tracks)
    if not parallax.went:
        return None, None
    standing = np.flatnonzero(parallax.standing)
    try:
        lens = walking.lens
        path = walking.solver().solve(tracks.places[standing], tracks.size, lens.focal, told=lens.told)
    except MissingPackage:
        return None, Notice(
            "camera-extra-missing",
            "the camera changes its place, so what is near moves against what is far: pip install 'fluidlift[camera]' "
            "would find its path, and show banks, trees and water as from a tripod",
        )
    found, why = _believed(grey, path)
    if found is not None and gain(grey, grey if steady is None else steady, found) < GAIN:
        found, why = None, "no more of the picture stands still along the path that was found: things may move instead"
    if found is not None:
        return found, None
    return None, Notice(
        "camera-path-unknown",
        f"the camera seems to change its place, but {why}. Its motion is taken out as if it only turned, so what is "
        "near may still move; a stretch in which it stands (--start, --duration), or a --mask, would help",
    )


def _believed(grey: Sequence[np.ndarray], path: CameraPath | None) -> tuple[Walked | None, str]:
    """The walk, or why not."""
    if path is None:
        return None, "what stands still does not agree on one path"
    if path.error_px > CLOSE_FIT:
        return None, f"the path that was found fits what stands still to {path.error_px:.1f} px only"
    reference = len(grey) // 2
    path = path.from_frame(reference)
    swept = sweep(grey, path, reference)
    return Walked(path, reference, swept, water_plane(swept, path)), ""


def gain(grey: Sequence[np.ndarray], steady: Sequence[np.ndarray], walk: Walked) -> float:
    """Share of the picture that stands better along a path, less the share that stands worse.

    Args:
        grey: u8 [H,W] pictures.
        steady: the same, as they stand without the path.
        walk: the path.
    """
    size, here = grey[0].shape[::-1], walk.reference
    inverse = walk.inverse_depth(size)
    changes = []
    for t in np.unique(np.linspace(0, len(grey) - 1, SAMPLES).round().astype(int)):
        again = cv2.remap(grey[t], *walk.maps(int(t), size, inverse), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        changes.append((cv2.absdiff(again, grey[here]), cv2.absdiff(steady[t], steady[here])))
    after, before = (np.median(each, axis=0) for each in zip(*changes))
    return float((after < before - BETTER).mean() - (after > before + BETTER).mean())


def drawn_again(
    frames: np.ndarray, walk: Walked, out: np.ndarray, alpha: np.ndarray | None = None,
    unseen: Callable[[int, Bool[np.ndarray, "h w"]], None] | None = None,
) -> None:  # fmt: skip
    """All frames u8 [T,H,W,3] from the place of the reference, written to `out`; alpha [T,H,W] is overwritten.

    What a frame does not see is what the frame before it, on the way from the reference, shows there; `unseen` is told
    where that is, of every frame.
    """
    count, height, width = frames.shape[:3]
    inverse = walk.inverse_depth((width, height))
    for order in (range(walk.reference, count), range(walk.reference - 1, -1, -1)):
        before = walk.reference
        for t in order:
            u, v = walk.maps(t, (width, height), inverse)
            picture = np.ascontiguousarray(frames[t])
            hidden = (u < -0.5) | (v < -0.5) | (u > width - 0.5) | (v > height - 0.5)
            if unseen is not None:
                unseen(t, hidden)
            if t != walk.reference:
                picture = cv2.remap(picture, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
                picture[hidden] = out[before][hidden]
                if alpha is not None:
                    alpha[t] = cv2.remap(
                        np.ascontiguousarray(alpha[t]), u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
                    )
            out[t], before = picture, t
