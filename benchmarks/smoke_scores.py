"""How near a picture of smoke is to the true one, and the tiles in which FluidNexus' project page shows four methods.

Pictures are intensities in [0, 1], smoke bright on black; what is drawn dark on white is turned first. PSNR over whole
pictures is weak where most of a picture is empty: the figures in the smoke stand beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fluidlift.errors import InputRejected

SMOKE = 0.05
"""intensity from which a pixel counts as smoke: 13 levels of 255, above what H.264 leaves in a black ground"""
EVERY, EVERY_SMOKE = 8, 12
"""frames of which one is scored: whole pictures, and in the smoke (which costs more)"""
BEST = 99.0
"""dB: of pictures without any difference, so that means stay finite"""
Frames = Sequence[np.ndarray] | np.ndarray
FIGURES = {"PSNR": "dB", "PSNR in the smoke": "dB", "IoU of the smoke": "", "gradient over the truth's": ""}
"""with their units"""


def psnr(picture: np.ndarray, truth: np.ndarray, where: np.ndarray | None = None) -> float:
    """dB, over all pixels or those of a mask."""
    error = (picture.astype(np.float64) - truth) ** 2
    mean = float(error.mean() if where is None else error[where].mean())
    return min(-10.0 * float(np.log10(mean)), BEST) if mean > 0 else BEST


def steepness(picture: np.ndarray, where: np.ndarray) -> float:
    """Mean slope of the intensity, per px: how much detail is left."""
    down, right = np.gradient(picture.astype(np.float64))
    return float(np.hypot(down, right)[where].mean())


def scores(pictures: Frames, truth: Frames, first: int = 0) -> dict[str, float]:
    """Figures of a view, means over frames.

    Args:
        pictures: [h,w] in [0, 1], of the frames from `first` on.
        truth: the same view's own, as many.
        first: number of the first of them, so that the same frames are scored whatever the beginning.

    Raises:
        ValueError: not as many pictures, another size, or no smoke in any frame that is scored.
    """
    if len(pictures) != len(truth) or len(truth) == 0:
        raise ValueError(f"{len(pictures)} pictures of {len(truth)} frames. Needed: as many.")
    found: dict[str, list[float]] = {name: [] for name in FIGURES}
    for t, (picture, true) in enumerate(zip(pictures, truth, strict=True), first):
        if picture.shape != true.shape:
            raise ValueError(f"a picture of {picture.shape} for one of {true.shape}. Needed: one size.")
        if t % EVERY == 0:
            found["PSNR"].append(psnr(picture, true))
        smoke = true > SMOKE
        if t % EVERY_SMOKE == 0 and smoke.any():
            seen = picture > SMOKE
            found["PSNR in the smoke"].append(psnr(picture, true, smoke))
            found["IoU of the smoke"].append(float((seen & smoke).sum() / (seen | smoke).sum()))
            found["gradient over the truth's"].append(steepness(picture, smoke) / max(steepness(true, smoke), 1e-9))
    if not all(found.values()):
        raise ValueError(f"no frame with smoke among {len(truth)} from {first} on. Needed: one of every {EVERY_SMOKE}.")
    return {name: float(np.mean(values)) for name, values in found.items()}


def mean_of(views: Sequence[dict[str, float]]) -> dict[str, float]:
    """The mean over views."""
    return {name: float(np.mean([view[name] for view in views])) for name in views[0]}


@dataclass(frozen=True)
class Tiles:
    """Where the tiles of a film lie, px; side by side, in step, dark smoke on white."""

    names: tuple[str, ...] = ("input copied", "PINF", "HyFluid", "STG", "FluidNexus", "truth")
    """the last is the truth"""
    size: tuple[int, int] = (4096, 1314)
    """of the film"""
    first: float = 23.0
    pitch: float = 678.8
    width: int = 656
    height: int = 1164
    margin: int = 8
    """left away on all sides: edges of the tiles are rounded"""

    def cut(self, frame: np.ndarray) -> dict[str, np.ndarray]:
        """Intensities [h,w] in [0, 1] of a frame u8 [H,W,3], smoke bright."""
        grey, m = 1.0 - cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255.0, self.margin
        found = {}
        for k, name in enumerate(self.names):
            left = round(self.first + k * self.pitch)
            found[name] = grey[m : self.height - m, left + m : left + self.width - m]
        return found


PAGE = Tiles()
"""`docs/static/videos` of FluidNexus' repository"""
VIEWS = ("00", "01", "03", "04")
"""that are scored; 02 is the input"""


def tiles_scored(folder: Path, what: str, tiles: Tiles = PAGE) -> dict[str, dict[str, float]]:
    """Figures of each method, means over the views.

    Args:
        folder: with `{what}_scalar_view00.mp4` and those of the other views.
        what: nvs (new views), resim or future.
        tiles: where they lie.

    Raises:
        InputRejected: a film is missing, or has another size.
    """
    from fluidlift.io.video import read_clip

    by_method: dict[str, list[dict[str, float]]] = {name: [] for name in tiles.names[:-1]}
    for view in VIEWS:
        path = folder / f"{what}_scalar_view{view}.mp4"
        if not path.is_file():
            raise InputRejected(f"no {path.name} in '{folder}'", "the films of FluidNexus' page", "bring them by hand")
        frames = read_clip(path, max_size=max(tiles.size)).frames
        if frames.shape[2:0:-1] != tiles.size:
            raise InputRejected(f"{path.name} of {frames.shape[2]} x {frames.shape[1]} px", f"{tiles.size}")
        cut = [tiles.cut(np.asarray(frame)) for frame in frames]
        for name, found in by_method.items():
            found.append(scores([c[name] for c in cut], [c[tiles.names[-1]] for c in cut]))
    return {name: mean_of(found) for name, found in by_method.items()}
