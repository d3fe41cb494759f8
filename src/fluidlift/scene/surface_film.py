"""The film that the surface of a simulated fluid plays: read from its asset, taken apart, and as finely as it needs."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from fluidlift.errors import InputRejected
from fluidlift.types import PinholeCamera, kind_of

if TYPE_CHECKING:
    from fluidlift.look.footage import Blur, FluidFootage
    from fluidlift.look.texture_patches import FirstEnd
    from fluidlift.scene.build import Scene

LATER = 0.5
"""share of a film from which it begins anew where its fluid grew (a vessel that fills): the later half is
nearer to where the fluid is then"""

LOOKED_UP = 1 / 6 + 0.3
"""variance (px^2) of the blur between a film and its splats' picture beside that of the splats: a bilinear look-up
(a triangle of one pixel to each side, 1/6), and what the rasteriser adds to each splat"""

AS_AT_REST = "its surface looks as it did at rest"
"""what follows where there is no film to play"""

FINE, FINER = 1.7, 1.2
"""px of the film between tracers of a skin that plays it, at most; and where its grain is too fine for that. Of 1.7,
1.2 and 0.85 (a level each) a fountain's finest band has 0.70, 0.83 and 0.88 of the clip's, sharpening included, and its
current is off by 0.52, 0.43 and 0.39; frames are larger by a fifth from each to the next"""

GRAIN = 0.6
"""of the amplitude of a film's finest band that splats `FINE` apart show, below which they lie closer. A shallow river,
which gains by it, has 0.56; two rivers that were as before by it 0.70 and 0.78, the demo, a made river and 13 more
0.71 to 0.90"""


def first_end(scene: Scene) -> FirstEnd:
    """How the pieces with which the film of a scene begins give way to others."""
    if scene.overlap > 0:
        return "apart"
    return "faded" if kind_of(scene.kind).is_still_water else "carried"


def surface_film(
    path: Path, camera: PinholeCamera, means: Float[np.ndarray, "n 3"], cell: float, *, level: bool = False
) -> tuple[FluidFootage, float] | str:
    """The film of an asset, taken apart, and how far apart (px of it) are what shows it; or what is wrong with it.

    Args:
        path: of the film.
        camera: that took it.
        means: of the body's Gaussians, m.
        cell: width of the simulator's cells, m.
        level: the skin that plays it lies on a map of heights, and is seen foreshortened; else it faces the camera.
    """
    from fluidlift.io.footage_file import size_of_film
    from fluidlift.look.surface_skin import PITCH, WIDTH, finer, level_for

    if not path.is_file():
        return f"is missing: {AS_AT_REST}; make the asset again"
    small = camera.resized(size_of_film(camera.size))
    coarse = PITCH * cell * small.focal[0] / np.maximum(small.project(means)[1], 1e-6)
    wide = [WIDTH * float(np.median(coarse * finer(level_for(coarse, wanted)))) for wanted in (FINE, FINER)]
    flat = foreshortening(small, means) if level else 1.0
    usual, closer = ((math.sqrt(w**2 + LOOKED_UP), math.sqrt((flat * w) ** 2 + LOOKED_UP)) for w in wide)
    written = path.stat()
    found = _taken_apart(path, camera.size, (usual, closer), (written.st_mtime_ns, written.st_size))
    return found if isinstance(found, str) else (found[0], FINER if found[1] else FINE)


def foreshortening(camera: PinholeCamera, means: Float[np.ndarray, "n 3"]) -> float:
    """How high in the picture, of its width there, a round patch of a surface is that faces up: at most 1.

    Args:
        camera: that sees it.
        means: places of the surface, m; the plane through them is asked for, in their middle.
    """
    middle = np.median(means, axis=0)
    away = means - middle
    slopes = np.linalg.lstsq(away[:, :2], away[:, 2], rcond=None)[0]
    normal = np.append(-slopes, 1.0)
    normal /= np.linalg.norm(normal)
    toward = camera.position - middle
    return float(np.clip(abs(normal @ toward) / max(float(np.linalg.norm(toward)), 1e-9), 0.0, 1.0))


@lru_cache(maxsize=1)
def _taken_apart(
    path: Path, size: tuple[int, int], blurs: tuple[Blur, Blur], written: tuple[int, int]
) -> tuple[FluidFootage, bool] | str:
    """As `surface_film`, of a file as it was `written`, and whether the second, smaller of two blurs was taken.

    The last one is kept: it takes a second or two, and a live preview begins anew with every edit.
    """
    from fluidlift.io.footage_file import read_footage
    from fluidlift.look.footage import FEWEST, FluidFootage, grain_kept

    try:
        frames, fluid, interval = read_footage(path, size)
    except InputRejected as error:
        return f"is damaged ({error.got}): {AS_AT_REST}; make the asset again"
    if len(frames) < FEWEST:
        return f"has {len(frames)} frames and needs {FEWEST}: {AS_AT_REST}; make the asset from a longer clip"
    closer = grain_kept(frames, fluid, blurs[0]) < GRAIN
    found = FluidFootage.of(frames, fluid, interval, blur=blurs[closer])
    return f"shows none: {AS_AT_REST}; make the asset again" if found is None else (found, closer)
