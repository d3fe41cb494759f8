"""What is thick and smooth lies still where it was poured, and is told by the colours of its jet."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from fluidlift.motion.optical_flow import DenseInverseSearch, flow_of_pair
from fluidlift.shape.segment import segment
from fluidlift.types.clip import VideoClip

FRAMES, HEIGHT, WIDTH = 24, 200, 160
TOP, FLOOR, MIDDLE, HALF = 90, 170, 78, 40
"""rows of the top and the foot of what stands, its middle column and half its width, px"""
SAUCE = np.array([40.0, 90.0, 30.0])


def poured(seed: int, *, heap: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Pictures [T,h,w,3] of a jet that falls on a block, over which a film creeps down; and where it is, [T,h,w].

    The film is as smooth as its jet glitters; without a `heap` nothing lies on the block but its own paint, which has
    the jet's colour.
    """
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    grain = [gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), s)[..., None] for s in (12.0, 1.0)]
    room = np.array([190.0, 185.0, 210.0]) + 150.0 * grain[0] + 6.0 * grain[1]
    block = (np.abs(x - MIDDLE) < HALF) & (y > TOP) & (y < FLOOR)
    room[block] = (np.array([90.0, 190.0, 200.0]) + 12.0 * np.sign(np.sin(y[..., None] / 6.0)) + 6.0 * grain[1])[block]
    drips = gaussian_filter1d(rng.normal(size=WIDTH), 6.0, mode="wrap")
    drips = ((drips - drips.min()) / np.ptp(drips)) ** 2
    glitter = gaussian_filter(rng.normal(size=(HEIGHT + 4 * FRAMES, WIDTH)), (2.0, 1.0))
    pictures, where = [], []
    for t in range(FRAMES):
        jet = (np.abs(x - MIDDLE) < 3.0) & (y > 12) & (y <= TOP)
        film = (np.abs(x - MIDDLE) < 0.9 * HALF) & (y > TOP - 1) & (y < TOP + 12 + drips * (24 + 0.8 * t))
        bright = np.where(jet, 22.0 * (glitter / glitter.std())[4 * (FRAMES - t) :][:HEIGHT], 0.0)[..., None]
        here = jet | film if heap else jet | (film & (t < 0))
        painted = film if heap else (np.abs(x - MIDDLE) < 0.9 * HALF) & (y > TOP - 1) & (y < TOP + 24)
        picture = np.where((jet | painted)[..., None], SAUCE + bright, room)
        picture = gaussian_filter(picture, (0.7, 0.7, 0.0)) + rng.normal(size=picture.shape)
        pictures.append(np.clip(picture, 0, 255).round().astype(np.uint8))
        where.append(here)
    return np.stack(pictures), np.stack(where)


def fluid_of(frames: np.ndarray) -> np.ndarray:
    estimator = DenseInverseSearch()
    clip = VideoClip(frames, np.arange(len(frames)) / 25.0)
    return segment(clip, lambda t: flow_of_pair(frames[t], frames[t + 1], estimator)).fluid


@pytest.mark.parametrize("seed", [0, 1])
def test_what_lies_still_below_its_jet_is_fluid_in_every_frame(seed: int):
    frames, truth = poured(seed)
    found = fluid_of(frames)
    likeness = [(f & t).sum() / (f | t).sum() for f, t in zip(found, truth, strict=True)]
    assert np.mean(likeness) > 0.75
    inner = truth[0] & (np.mgrid[0:HEIGHT, 0:WIDTH][0] > TOP + 3)
    assert found[0][inner].mean() > 0.9 and found[-1][inner].mean() > 0.9


def test_paint_that_does_not_move_anywhere_is_none():
    frames, _ = poured(0, heap=False)
    found = fluid_of(frames)
    assert found[:, TOP + 8 :].mean() < 0.005
