"""What white water looks like: small splats in the clip's foam colour, and where a clip shows foam at all."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from fluidlift.errors import require
from fluidlift.numerics.short_axis import least, most
from fluidlift.types import Gaussians, sh_from_rgb

SIZES = (0.06, 0.16, 0.08)
"""standard deviation of the splats of spray, foam and bubbles, cells: foam covers, spray is specks, bubbles are faint.
Foam of smaller splats is drawn as dots: a cell of the demo is 4 pixels wide"""
SHAPE = (0.8, 0.9, 1.0)
"""axes of a splat, shares of that: no other splat has them, so white water is told by them"""
OPACITIES = (0.85, 0.6, 0.25)
"""of spray, foam and bubbles: those are seen through the water above them"""
FADING = 1.0
"""s before its end over which a particle fades: foam thins out, it does not go out"""
ALIKE = 1e-3
"""by how much a splat's size may differ: files hold logarithms in single precision"""
BRIGHT = 0.7
"""of the darkest of three sRGB channels from which a pixel may be foam"""
GREY = 0.15
"""saturation (1 - least / most channel) up to which it may"""
STANDS_OUT = 1.2
"""times the fluid's median brightness from which it may: a body that is white throughout is no foam"""
FEWEST = 0.002
"""share of foam under which a clip shows none: glints and the noise of compression"""
WHITE = (0.93, 0.94, 0.95)
"""sRGB of foam where a clip shows none to take it from"""
_LUMA = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class FilmedFoam:
    """The foam that a film shows."""

    share: float
    """of the fluid's pixels"""
    color: tuple[float, float, float]
    """sRGB, 0 to 1"""
    places: Float[np.ndarray, "h w"]
    """share of the time in which each pixel shows foam, of that in which it shows fluid"""
    seen: Float[np.ndarray, "h w"]
    """share of the time in which each pixel shows fluid"""
    by_frame: Float[np.ndarray, "t 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """pixels of foam, and of fluid, in each frame"""

    @classmethod
    def of(cls, frames: UInt8[np.ndarray, "t h w 3"], fluid: Bool[np.ndarray, "t h w"]) -> FilmedFoam:
        """Bright pixels without a colour that stand out from the rest of the fluid, in pictures (sRGB) with masks.

        Assumption: what is bright and grey is foam. Limit: so are reflections of an overcast sky and glints.
        """
        require(frames.shape[:3] == fluid.shape, f"{frames.shape} pictures for masks {fluid.shape}", "one each")
        known, none = fluid.sum(axis=0), np.zeros(fluid.shape[1:])
        if not fluid.any():
            return cls(0.0, WHITE, none, none)
        middle = float(np.median(frames[fluid] @ _LUMA))
        count, total, pixels, by_frame = none.copy(), np.zeros(3), 0, np.zeros((len(frames), 2))
        for k, (picture, mask) in enumerate(zip(frames, fluid)):
            found = mask & foam_pixels(picture, middle)
            count += found
            by_frame[k] = found.sum(), mask.sum()
            total, pixels = total + picture[found].sum(axis=0, dtype=np.float64), pixels + int(found.sum())
        share = pixels / int(fluid.sum())
        r, g, b = (total / (255.0 * pixels)).tolist() if share >= FEWEST else WHITE
        places = count / np.maximum(known, 1)
        return cls(share if share >= FEWEST else 0.0, (r, g, b), places, known / len(fluid), by_frame)


def foam_pixels(picture: UInt8[np.ndarray, "h w 3"], middle: float) -> Bool[np.ndarray, "h w"]:
    """Which pixels (sRGB) are bright, grey, and brighter than `STANDS_OUT` times `middle` (0 to 255)."""
    darkest = least(picture)
    return (
        (darkest >= 255 * BRIGHT)
        & (darkest >= (1.0 - GREY) * most(picture).astype(np.float64))
        & (picture @ _LUMA >= STANDS_OUT * middle)
    )


def whitewater_splats(
    positions: Float[np.ndarray, "n 3"],
    kinds: UInt8[np.ndarray, " n"],
    lives: Float[np.ndarray, " n"],
    color: tuple[float, float, float],
    cell: float,
) -> Gaussians:
    """Splats of white water.

    Args:
        positions: m.
        kinds: 0 spray, 1 foam, 2 bubbles.
        lives: s that are left.
        color: sRGB of foam, 0 to 1.
        cell: width of the simulator's cells, m.
    """
    n = len(positions)
    scales = cell * np.array(SIZES)[kinds][:, None] * np.array(SHAPE)
    opacities = np.array(OPACITIES)[kinds] * np.clip(lives / FADING, 0.05, 1.0)
    quats = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (n, 1))
    rgb = np.broadcast_to(np.asarray(color, np.float32), (n, 3))
    return Gaussians(
        positions.astype(np.float32), quats, scales.astype(np.float32), opacities.astype(np.float32), sh_from_rgb(rgb)
    )


def kinds_of(gaussians: Gaussians, cell: float) -> Int[np.ndarray, " n"]:
    """0 spray, 1 foam, 2 bubbles; -1 for splats that are not white water.

    Args:
        gaussians: of a frame.
        cell: width of the simulator's cells, m.
    """
    found, least = np.full(len(gaussians), -1), gaussians.scales.min(axis=1) if len(gaussians) else np.zeros(0)
    for kind, size in enumerate(SIZES):
        wanted = cell * size * np.array(SHAPE)
        like = np.flatnonzero(np.abs(least - wanted[0]) < ALIKE * wanted[0])
        same = (np.abs(np.sort(gaussians.scales[like], axis=1) / wanted - 1.0) < ALIKE).all(axis=1)
        found[like[same]] = kind
    return found
