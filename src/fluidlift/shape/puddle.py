"""Puddles that jets fall into, seen from above: told from a vessel seen from the side.

Where a jet ends in a still pool the silhouette alone does not tell a puddle that lies from a body that hangs: the jet
is seen by its motion (shape/jets.py) or as a neck of the silhouette, and a pool that is round lies where its outline
is an ellipse wider than tall: what a glass holds is often wider than tall as well, and no ellipse. What spreads from
the foot of a jet (shape/spreading.py) moves faster than that seems to: there the silhouette alone says which is which.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.shape.jets import JetOutline, airborne_pixels, find_jets, find_neck, lying_pixels
from fluidlift.shape.kind import level_camera
from fluidlift.shape.looked_into import jet_rows
from fluidlift.shape.region import largest_piece
from fluidlift.shape.view.roundness import POOL_LIKENESS, fit_ellipse
from fluidlift.types import PinholeCamera, UpEvidence
from fluidlift.types.kind import LOOKING_DOWN

LEAST_SHARE = 0.4
"""share of the fluid that is in the pool, at least"""
UPRIGHT = 1.5
"""how many times taller than the tilt would show it a round pool may be, where the tilt is known, and than it was at
first: a taller one is no level surface (`POOL_SPREAD` at 95 %). Made glasses that fill get 1.25 to 4 times as tall, a
cup that is looked into 1.26"""


@dataclass(frozen=True)
class Poured:
    """What is poured, and the pool it ends in."""

    jets: tuple[JetOutline, ...]
    lying: Bool[np.ndarray, "h w"]
    """pixels of the pool, with what the jets hide of it"""


def jets_into_puddle(
    camera: PinholeCamera,
    up: UpEvidence | None,
    mask: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
) -> Poured | None:
    """Jets that end in a round pool; None where no pool is seen from above.

    Args:
        camera: of the picture.
        up: its tilt, where that is known.
        mask: fluid pixels.
        motion: mean over the clip, px per frame.
        trust: of it.
    """
    tilt = up or UpEvidence(LOOKING_DOWN[0], 0.0, "", 0.0)
    found = find_jets(level_camera(camera, tilt), mask, motion, trust)
    found = [down_to_landing(outline, mask, motion, trust) for outline in found]
    return _poured(found, up, mask)


def jet_over_pool(up: UpEvidence | None, mask: Bool[np.ndarray, "h w"]) -> Poured | None:
    """The jet that the silhouette shows above a round pool; None where it shows none.

    Args:
        up: tilt of the camera, where that is known.
        mask: fluid pixels.
    """
    neck = find_neck(mask, pitch=LOOKING_DOWN[0] if up is None else up.pitch)
    return None if neck is None else _poured([neck], up, mask)


def _poured(found: list[JetOutline], up: UpEvidence | None, mask: np.ndarray) -> Poured | None:
    """The jets with their pool, where that is one that is seen from above."""
    airborne = airborne_pixels(found, mask.shape)
    # wet traces on a bowl's rim, and what is left of a jet at the picture's edge, have no part in the outline
    lying = lying_pixels(airborne | largest_piece(mask & ~airborne), airborne)
    pool = fit_ellipse(lying)
    if not found or pool is None or pool.likeness < POOL_LIKENESS or lying.sum() < LEAST_SHARE * mask.sum():
        return None
    tallest = 1.0 if up is None else min(UPRIGHT * np.sin(np.radians(max(up.pitch, 0.0))), 1.0)
    return Poured(tuple(found), lying) if pool.flatness <= tallest else None


def grows_taller(poured: Poured, ever: Bool[np.ndarray, "h w"]) -> bool:
    """Whether what lies at first gets taller than it gets wider: what fills a glass, seen from the side. A puddle is as
    flat as the view of it however wide it gets.

    Args:
        poured: as it is at first.
        ever: pixels that are fluid in at least one frame.
    """
    first, later = fit_ellipse(poured.lying), fit_ellipse(largest_piece(ever & ~jet_rows(ever)))
    return first is not None and later is not None and later.flatness > UPRIGHT * first.flatness


def down_to_landing(
    outline: JetOutline,
    mask: Bool[np.ndarray, "h w"],
    motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
) -> JetOutline:
    """An outline that ends where its motion is lost, drawn on to where it lands.

    What lands within a frame is not seen again: optical flow ends a frame's way above the pool. How much of that way
    the jet is drawn on is how much of the trust is lost there.
    """
    step = outline.centers[-1] - outline.centers[-2]
    step = step / max(float(np.linalg.norm(step)), 1e-9)
    grid = np.stack(np.meshgrid(np.arange(mask.shape[1]), np.arange(mask.shape[0])), -1) + 0.5
    along = (grid - outline.centers[-1]) @ step
    aside = np.abs((grid - outline.centers[-1]) @ np.array([-step[1], step[0]]))
    half = float(outline.half_widths[-1])
    core = mask & (aside < 0.5 * half)
    end = core & outline.pixels & (along > -4.0 * half)
    if not end.any():
        return outline
    way = float(np.percentile((motion @ step)[end], 90))
    below = core & ~outline.pixels & (along > -half) & (along < way)
    if way <= 0 or not below.any():
        return outline
    kept = float(np.mean(trust[below])) / max(float(np.median(trust[outline.pixels])), 1e-6)
    reach = way * max(1.0 - kept, 0.0)
    drawn = outline.pixels | (mask & (aside < half) & (along > -half) & (along < reach))
    centers = np.concatenate([outline.centers, [outline.centers[-1] + reach * step]])
    return replace(outline, pixels=drawn, centers=centers, half_widths=np.append(outline.half_widths, half))
