"""Change is measured in units of the noise, and what advances is told from what stays."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

from fluidlift.motion.optical_flow import DenseInverseSearch, flow_of_pair
from fluidlift.shape.evidence import gather_evidence, noise_map, separating_level
from fluidlift.shape.presence import Presence, grows
from fluidlift.shape.region import solids_in
from fluidlift.types.clip import VideoClip


def test_two_populations_are_divided_between_them_and_one_is_not_divided_below_the_floor():
    rng = np.random.default_rng(1)
    activity = np.concatenate([rng.normal(0.2, 0.1, 3000), rng.normal(3.0, 0.3, 1000)]).clip(0)
    assert 0.6 < separating_level(activity) < 2.4
    # half of a normal distribution lies above its mean: a still clip must not be divided there
    assert separating_level(rng.normal(0.2, 0.1, 3000).clip(0)) >= np.log(1.8)


def test_the_noise_follows_the_tremble_of_edges_and_not_the_fluid():
    rng = np.random.default_rng(2)
    steep = rng.uniform(0.0, 40.0, (100, 100)).astype(np.float32)
    change = 1.0 + 0.1 * steep
    change[:40] += 60.0
    noise = noise_map(change, steep)
    # the base is read from a class of finite width, as is the slope: a fifth either way
    assert np.allclose(noise, 1.0 + 0.1 * steep, rtol=0.35)


def presence_of(active: np.ndarray) -> Presence:
    """First and last activity of bool [T,h,w]."""
    frames, ever = len(active), active.any(axis=0)
    first = np.where(ever, active.argmax(axis=0), frames)
    last = np.where(ever, frames - 1 - active[::-1].argmax(axis=0), -1)
    return Presence(frames, first, last, (0,), active[:1])


def test_a_front_grows_and_foam_that_comes_back_does_not():
    front = np.zeros((20, 30, 30), bool)
    for t in range(20):
        front[t, : t + 1] = True
    foam = np.random.default_rng(0).random((20, 30, 30)) < 0.4
    everywhere = np.ones((30, 30), bool)
    assert grows(presence_of(front), everywhere) and grows(presence_of(front[::-1]), everywhere)
    assert not grows(presence_of(foam), everywhere)


def test_small_holes_are_filled_still_ones_are_solid_and_open_bays_stay_outside():
    region = np.zeros((60, 60), bool)
    region[10:50, 10:50] = True
    region[20:30, 20:30] = False
    region[40, 40] = False
    region[10:20, 45:50] = False
    still = np.ones_like(region)
    filled, solid = solids_in(np.kron(region, np.ones((2, 2))) > 0, np.kron(still, np.ones((2, 2))) > 0)
    filled, solid = filled[::2, ::2], solid[::2, ::2]
    assert solid.sum() == 100 and solid[20:30, 20:30].all()
    assert filled[40, 40] and not filled[12, 47] and not solid[12, 47]
    assert solids_in(region, ~still)[0][25, 25], "a hole that moves is fluid"


def test_a_current_streams_at_every_frame_rate():
    """A band of a pattern that goes 24 px a second before a still one: 1 px or 0.2 between two frames."""
    rng = np.random.default_rng(0)
    patterns = [cv2.GaussianBlur(rng.normal(size=(72, 360)).astype(np.float32), (0, 0), 2.5) for _ in range(2)]
    moving, still = (128.0 + 8.0 * pattern / pattern.std() for pattern in patterns)
    inside = np.zeros((72, 120), bool)
    inside[18:54] = True
    found = []
    for rate in (24, 120):
        frames = []
        for t in range(rate):
            shift = np.float32([[1.0, 0.0, -24.0 * t / rate - 20.0], [0.0, 1.0, 0.0]])
            here = cv2.warpAffine(moving, shift, (120, 72), flags=cv2.INTER_CUBIC)
            grey = np.where(inside, here, still[:, :120]) + rng.normal(scale=1.5, size=inside.shape)
            frames.append(np.clip(grey, 0, 255).round().astype(np.uint8)[..., None].repeat(3, axis=-1))
        clip, estimator = VideoClip(np.stack(frames), np.arange(rate) / rate, "made"), DenseInverseSearch()
        flow = [flow_of_pair(a, b, estimator) for a, b in pairwise(clip.frames)]
        found.append(float(gather_evidence(clip, flow.__getitem__).streaming[inside].mean()))
    assert found[0] > 0.3 and found[1] == pytest.approx(found[0], rel=0.35)
