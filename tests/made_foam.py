"""Made films and surfaces whose share of foam, and whose law of white water, are known exactly or to any precision."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from fluidlift.look.whitewater_splats import FilmedFoam
from fluidlift.scene.whitewater_law import SurfaceRecord

WATER, FOAM = (40, 90, 120), (225, 232, 235)
"""sRGB"""


def foam_film(seed, *, share, frames=90, interval=1 / 30, life=0.5, radius=4.0, speed=40.0, size=(96, 64)):
    """u8 [t,h,w,3]: white discs that are born anywhere at any time, drift and last.

    They overlap as they like (a Boolean model in space and time), so a pixel is bare with exp(-births x area x life):
    `births` are those that cover a share exactly, in a film without end.

    Args:
        seed: of births.
        share: of the picture that is foam.
        frames, interval: of the film; interval in s.
        life: s of a disc.
        radius: px of a disc.
        speed: px/s to the right.
        size: width and height, px.
    """
    rng, (width, height) = np.random.default_rng(seed), size
    margin, seconds = radius + speed * life, frames * interval
    area = (width + 2 * margin) * (height + 2 * radius)
    many = rng.poisson(-np.log1p(-share) / (np.pi * radius**2 * life) * area * (seconds + life))
    x, y = rng.uniform(-margin, width + margin, many), rng.uniform(-radius, height + radius, many)
    born = rng.uniform(-life, seconds, many)
    rows, columns = np.indices((height, width)) + 0.5
    found = np.empty((frames, height, width, 3), np.uint8)
    for k in range(frames):
        age = (k + 0.5) * interval - born
        white = np.zeros((height, width), bool)
        for i in np.flatnonzero((age >= 0) & (age < life)):
            at = x[i] + speed * age[i]
            white |= (columns - at) ** 2 + (rows - y[i]) ** 2 < radius**2
        found[k] = np.where(white[..., None], FOAM, WATER)
    return found


def filmed(frames):
    """The foam of pictures that are fluid all over."""
    return FilmedFoam.of(frames, np.ones(frames.shape[:3], bool))


def surface(seed, frames, *, memory, shape=(24, 16), grain=2.0, spread=0.7):
    """A surface whose potentials vary from column to column and from frame to frame, with a memory of some frames.

    Args:
        seed: of it.
        frames: many.
        memory: frames in which what a column has falls to 1/e.
        shape: columns.
        grain: columns over which they are alike.
        spread: standard deviation of their logarithms.
    """
    rng, keep = np.random.default_rng(seed), float(np.exp(-1.0 / memory))
    usual = 1.0 / np.sqrt(np.square(ndimage.gaussian_filter(_point(shape), grain, mode="wrap")).sum())
    fields = []
    for size in (0.05, 0.8, 0.02):
        made, now = np.empty((frames, *shape)), None
        for k in range(frames):
            fresh = usual * ndimage.gaussian_filter(rng.normal(size=shape), grain, mode="wrap")
            now = fresh if now is None else keep * now + np.sqrt(1.0 - keep**2) * fresh
            made[k] = size * np.exp(spread * now)
        fields.append(made)
    flow = np.zeros((frames, *shape, 2))
    flow[..., 0] = 0.3
    return SurfaceRecord(np.ones((frames, *shape), bool), *fields, flow)


def _point(shape):
    found = np.zeros(shape)
    found[shape[0] // 2, shape[1] // 2] = 1.0
    return found
