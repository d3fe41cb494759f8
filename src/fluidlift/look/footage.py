"""Video texture: what a fluid looks like in each place over time, from its film; what stays, what comes and goes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import ndimage

from fluidlift.errors import require
from fluidlift.look.surface_map import sampled
from fluidlift.numerics.mirror import folded
from fluidlift.numerics.sharing import shared
from fluidlift.types.fluid_masks import outline_grows

BROAD = 0.03
"""standard deviation of the blur that separates the shade of a place from its fine look, shares of the picture's longer
side; as `look.appearance`"""

SHOWN = 0.1
"""share of the film in which a place is fluid, from which its look counts: rarer, it is spray, or ground with noise"""

RIM = 2
"""px inside its outline in which a pixel may show half of the bank: lens, coding and mask are no sharper than that. It
does in its own place, as filmed, and nowhere else"""

SHARPER = 3
"""steps of the deconvolution. With 2 and 3 the finest band of five level waters has 0.89 to 0.99 and 0.95 to 1.06 of
the clip's, that of four falls 0.77 to 1.11 and 0.82 to 1.11"""

LOOKS = 5
"""frames of a film in which its grain is looked at: they are alike"""

AGREE = 3
"""frames of which most have to show fluid in a place: the least of which one can be outvoted"""

FEWEST = 8
"""frames: a shorter film has no life of its own to show"""

Blur = tuple[float, float]
"""standard deviations of a blur across and down the picture, px"""


@dataclass(frozen=True)
class FluidFootage:
    """Pictures of a fluid, taken apart.

    A picture is shade + fine + residual: the mean over the time in which a pixel is fluid, in its broad and its fine
    part, and what differs from it in one frame.
    """

    frames: UInt8[np.ndarray, "t h w 3"]
    """sRGB"""
    fluid: Bool[np.ndarray, "t h w"]
    interval: float
    """s between frames"""
    mean: Float[np.ndarray, "h w 3"]
    """of the frames in which a pixel is fluid, 0 to 1; beside the fluid that of the nearest pixel"""
    inner: Float[np.ndarray, "h w 3"]
    """the same where nothing but fluid is shown; at the rim too that of the nearest inside"""
    pure: Bool[np.ndarray, "h w"]
    """pixels that show nothing but fluid: not those at its rim"""
    shade: Float[np.ndarray, "h w 3"]
    """the broad part of it"""
    outside: Float[np.ndarray, "h w"]
    """px to the nearest pixel that shows fluid (in `SHOWN` of the frames); 0 where it does"""

    @classmethod
    def of(
        cls, frames: np.ndarray, fluid: np.ndarray, interval: float, *, blur: Blur | None = None
    ) -> FluidFootage | None:  # fmt: skip
        """From pictures u8 [T,H,W,3] and masks bool [T,H,W]; None where they are too few, or show no fluid.

        Args:
            frames: sRGB.
            fluid: in each of them.
            interval: s between them.
            blur: of the splats that will show them, which is taken out beforehand; None: none is.
        """
        require(frames.shape[:3] == fluid.shape, f"{frames.shape} pictures for masks {fluid.shape}", "one each")
        if blur is not None:
            frames = np.stack([_sharpened(f, m, blur) for f, m in zip(frames, fluid, strict=True)])
        weight = fluid.mean(axis=0, dtype=np.float32)
        known = weight > SHOWN
        if len(frames) < FEWEST or not known.any():
            return None
        total = np.zeros(frames.shape[1:], np.float32)
        for picture, mask in zip(frames, fluid, strict=True):
            total += picture * mask[..., None]
        mean = total / (255.0 * len(frames) * np.maximum(weight, 1e-6)[..., None])
        outside, seen = ndimage.distance_transform_edt(~known, return_indices=True)
        own = _without_rim(known)
        nearest = ndimage.distance_transform_edt(~own, return_distances=False, return_indices=True)
        # what is rarely fluid, or mixed with the bank, counts less or nothing in the blur
        weight, sigma = np.where(own, weight, np.float32(0)), BROAD * max(weight.shape)
        spread = np.maximum(ndimage.gaussian_filter(weight, sigma), 1e-6)
        blurred = [ndimage.gaussian_filter(mean[..., k] * weight, sigma) / spread for k in range(3)]
        shade = np.stack(blurred, axis=-1)[tuple(nearest)]
        inner = mean[tuple(nearest)].astype(np.float32)
        mean = mean[tuple(seen)].astype(np.float32)
        return cls(
            frames, fluid & known, interval, mean, inner, own, shade.astype(np.float32), outside.astype(np.float32)
        )

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def grows(self) -> bool:
        """`outline_grows` of its fluid."""
        return outline_grows(self.fluid)

    def within(self, index: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Row and column in the picture of places in it or beside it: beyond its sides lies its mirror image.

        Its last row, continued, would be stripes.
        """
        sides = zip(index.T, self.outside.shape)
        return np.stack([folded(along, 0.0, size - 1.0)[0] for along, size in sides], axis=-1)

    def looked_up(
        self, index: Float[np.ndarray, "n 2"], instants: Float[np.ndarray, " n"], home: Bool[np.ndarray, " n"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean of places of the picture [n,3], 0 to 1, what differs from it [n,3], and the share of fluid there [n].

        Args:
            index: row and column, bilinear between pixels.
            instants: frames, counted from 0; the nearest one is taken, since a mean of two would show both.
            home: whether it is shown in its own place, with the rim as it was filmed.
        """
        frame = np.clip(np.rint(instants), 0, len(self) - 1).astype(np.int64)
        out, share = np.zeros((len(index), 3), np.float32), np.zeros(len(index), np.float32)
        _residual(self.frames, self.fluid, self.pure, self.mean, index.astype(np.float64), frame, home, out, share)
        steady, other = sampled(self.mean, index), np.flatnonzero(~home)
        steady[other] = sampled(self.inner, index[other])
        return steady, out, share

    def covers(self, index: Float[np.ndarray, "n 2"], instants: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Share 0 to 1 of fluid in places of the picture at instants of the film: 0 where a fluid that sways has left.

        1 where the film never shows fluid: what is simulated there is not the film's to hide.

        Args:
            index: row and column, bilinear between pixels.
            instants: frames, counted from 0; the nearest one counts.
        """
        frame = np.clip(np.rint(instants), 0, len(self) - 1).astype(np.int64)
        h, w = self.outside.shape
        row, column = (np.clip(along, 0.0, size - 1.0) for along, size in zip(index.T, (h, w)))
        r, c = np.minimum(row.astype(np.int64), h - 2), np.minimum(column.astype(np.int64), w - 2)
        found, corner = np.zeros(len(index), np.float32), r * w + c
        film, never = self._whole.ravel(), (self.outside > 0).ravel()
        for a, b in np.ndindex(2, 2):
            weight = (row - r if a else 1.0 - row + r) * (column - c if b else 1.0 - column + c)
            at = corner + (a * w + b)
            found += weight * (film.take(frame * (h * w) + at) | never.take(at))
        return found

    def settled(self, frame: int) -> Bool[np.ndarray, "h w"]:
        """Fluid by the majority of a frame and its neighbours: a mask that failed once opens no hole."""
        first = int(np.clip(frame - AGREE // 2, 0, max(len(self) - AGREE, 0)))
        return 2 * self.fluid[first : first + AGREE].sum(axis=0) > AGREE

    @cached_property
    def _whole(self) -> Bool[np.ndarray, "t h w"]:
        """`settled` without holes: of a mask that failed for a while none is opened, and what always stands in the
        fluid is none of it."""
        return np.stack([ndimage.binary_fill_holes(self.settled(t)) for t in range(len(self))])


def grain_kept(
    frames: UInt8[np.ndarray, "t h w 3"], fluid: Bool[np.ndarray, "t h w"], blur: Blur
) -> float:  # fmt: skip
    """Share of the amplitude of a film's finest band (of a Laplacian pyramid, in the fluid) that is left when splats
    with a `blur` show it, sharpened as it is for them; 1 where it has no grain.

    Args:
        frames: sRGB.
        fluid: in each of them.
        blur: as of `FluidFootage.of`.
    """
    import cv2

    def energy(picture: np.ndarray, where: np.ndarray) -> float:
        grey = picture.astype(np.float32).mean(axis=-1)
        return float(np.square((grey - cv2.GaussianBlur(grey, (0, 0), 1.0))[where]).sum(dtype=np.float64))

    own = shown = rounding = 0.0
    for t in np.unique(np.linspace(0, len(frames) - 1, LOOKS).round().astype(int)):
        inner = ndimage.binary_erosion(fluid[t], iterations=RIM, border_value=1)
        own, rounding = own + energy(frames[t], inner), rounding + inner.sum() / 12.0  # of whole numbers
        sharp = _sharpened(frames[t], fluid[t], blur).astype(np.float32)
        shown += energy(_blurred(sharp, blur), inner)
    return float(np.sqrt(shown / own)) if own > rounding else 1.0


def _without_rim(fluid: np.ndarray) -> np.ndarray:
    """Pixels that show nothing but fluid: not those at the rim, but for threads that are no wider."""
    inner = ndimage.binary_erosion(fluid, iterations=RIM, border_value=1)
    threads = fluid & ~ndimage.binary_dilation(inner, iterations=2 * RIM)
    return inner | threads


def _blurred(picture: np.ndarray, blur: Blur) -> np.ndarray:
    """Gaussian blur of [h,w] or [h,w,3]; beyond the picture goes on what its edge shows."""
    import cv2

    return cv2.GaussianBlur(picture, (0, 0), sigmaX=blur[0], sigmaY=blur[1], borderType=cv2.BORDER_REPLICATE)


def _sharpened(picture: np.ndarray, fluid: np.ndarray, blur: Blur) -> np.ndarray:
    """A picture that a blur G makes into the given one I, inside the fluid (van Cittert's deconvolution).

    X <- X + (I - G X), from X = I on, `SHARPER` times: frequencies that G leaves g of come out with 1 - (1 - g)^n of
    their size instead of g, n = `SHARPER` + 1, so noise is never amplified beyond what the blur takes from it.
    """
    weight = fluid.astype(np.float32)
    share = np.maximum(_blurred(weight, blur), 1e-3)[..., None]
    sharp = picture.astype(np.float32)
    for _ in range(SHARPER):
        smooth = _blurred(sharp * weight[..., None], blur) / share
        sharp = np.where(fluid[..., None], sharp + picture - smooth, sharp)
    return np.clip(np.rint(sharp), 0, 255).astype(np.uint8)


@shared(lambda frames, fluid, pure, mean, index, *_: (0, len(index)))
def _residual(begin, end, frames, fluid, pure, mean, index, instant, home, out, share):
    _, h, w, _ = frames.shape
    for i in range(begin, end):
        y, x = min(max(index[i, 0], 0.0), h - 1.0), min(max(index[i, 1], 0.0), w - 1.0)
        r, c, t = min(int(y), h - 2), min(int(x), w - 2), instant[i]
        fy, fx = y - r, x - c
        for a in range(2):
            for b in range(2):
                weight = (fy if a else 1.0 - fy) * (fx if b else 1.0 - fx)
                if fluid[t, r + a, c + b] and (home[i] or pure[r + a, c + b]):
                    share[i] += weight
                    for k in range(3):
                        out[i, k] += weight * (frames[t, r + a, c + b, k] / 255.0 - mean[r + a, c + b, k])
