"""Eddies that a stream carries along stay; noise, and what one pair did not see, is made up from the others."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.motion.mainstream import OBSERVED_CONFIDENCE
from fluidlift.motion.multiframe import mean_flow
from fluidlift.motion.temporal import (
    along_path,
    backward,
    forward,
    mean_of_samples,
    pixel_indices,
    smoothed_flow,
)
from fluidlift.types import PixelFlow

SHAPE = (40, 72)
EVERYWHERE = np.ones(SHAPE, bool)


def carried_eddies(pairs: int, speed: float, amplitude: float, wavelength: float = 24.0) -> np.ndarray:
    """Cross-stream motion that a uniform stream carries along: constant on every path. [t,h,w,2] px/frame."""
    place = pixel_indices(SHAPE)
    flow = np.zeros((pairs, *SHAPE, 2), np.float32)
    flow[..., 0] = speed
    for t in range(pairs):
        flow[t, ..., 1] = amplitude * np.sin(2 * np.pi * (place[..., 0] - speed * t) / wavelength)
    return flow


def trusted(flow: np.ndarray, confidence: float = 0.9) -> PixelFlow:
    return PixelFlow(flow, np.full(flow.shape[:-1], confidence, np.float32))


def test_a_step_back_undoes_a_step_ahead() -> None:
    place = pixel_indices(SHAPE)
    step = np.stack([3 + np.sin(place[..., 1] / 6), 1 + np.cos(place[..., 0] / 8)], axis=-1).astype(np.float32)
    home = backward(forward(place, step), step)
    # gradients of 1/6 px/px shrink the error sixfold per round; pictures are sampled at 1/32 px
    assert np.abs(home - place)[6:-6, 6:-6].max() < 0.02


def test_along_its_path_an_eddy_that_is_carried_past_does_not_change() -> None:
    flow = carried_eddies(9, speed=3.0, amplitude=1.0)
    samples = along_path(trusted(flow), 4, EVERYWHERE, 2).displacement
    inner = (slice(None), slice(4, -4), slice(12, -12))
    # linear interpolation over a wavelength of 24 px: (2 pi / 24)^2 / 8 of the amplitude
    assert np.abs(samples[inner] - flow[4][inner[1:]]).max() < 0.02
    fixed = np.abs(flow[2:7] - flow[4])[inner]
    assert fixed.max() > 1.0


def test_smoothing_keeps_carried_eddies_that_a_mean_at_fixed_pixels_halves() -> None:
    flow = carried_eddies(13, speed=5.0, amplitude=1.0)  # a fixed pixel sees 0.21 of a wavelength per frame
    inner = (slice(4, -4), slice(20, -20))
    kept, _ = smoothed_flow(trusted(flow), 6, EVERYWHERE)
    fixed, _ = smoothed_flow(trusted(flow), 6, EVERYWHERE, along_paths=False)
    true = flow[6][inner][..., 1].std()
    # the mean of three over 0.21 wavelengths each: (1 + 2 cos(2 pi 0.21)) / 3 = 0.5
    assert fixed[inner][..., 1].std() < 0.6 * true
    # paths scatter far less, so they have nearly all the weight
    assert kept[inner][..., 1].std() > 0.9 * true


def test_noise_on_a_steady_stream_is_averaged_away() -> None:
    rng = np.random.default_rng(3)
    flow = np.zeros((13, *SHAPE, 2), np.float32)
    flow[..., 0] = 2.0
    noisy = flow + rng.normal(0, 0.3, flow.shape).astype(np.float32)
    smooth, _ = smoothed_flow(trusted(noisy), 6, EVERYWHERE)
    before = np.abs(noisy[6] - flow[6]).mean()
    after = np.abs(smooth - flow[6])[8:-8, 8:-8].mean()
    # three pairs at the pixel and two more along the path: between 1/sqrt(5) and 1/sqrt(3) of the noise
    assert after < 0.6 * before


def test_what_the_near_pairs_did_not_see_is_known_from_foam_that_passed_before() -> None:
    flow = np.zeros((13, *SHAPE, 2), np.float32)
    confidence = np.full((13, *SHAPE), 0.02, np.float32)
    flow[1:3, :, :, 0], confidence[1:3] = 3.0, 0.9  # five frames ago there was texture
    smooth, trust = smoothed_flow(PixelFlow(flow, confidence), 6, EVERYWHERE)
    # all weight lies on the two seen pairs: failures have (0.02 / 0.9)^2 of theirs
    assert np.allclose(smooth[..., 0], 3.0, atol=0.02)
    # it tells far more than the near pairs do, and is no observation of this frame
    _, alone = smoothed_flow(PixelFlow(flow, confidence), 6, EVERYWHERE, along_paths=False)
    assert (trust > 10 * alone).all() and (trust > 0.2).all() and (trust < OBSERVED_CONFIDENCE).all()


def test_paths_that_leave_the_fluid_count_nothing() -> None:
    mask = np.zeros(SHAPE, bool)
    mask[:, :40] = True
    flow = np.zeros((5, *SHAPE, 2), np.float32)
    flow[:, :, :40, 0] = 4.0  # beyond lies a bank, well textured and at rest
    found = along_path(trusted(flow), 2, mask, 1)
    assert (found.confidence[2, :, 37:40] == 0).all()  # 4 px on is the bank
    smooth, _ = smoothed_flow(trusted(flow), 2, mask)
    assert np.allclose(smooth[mask][:, 0], 4.0, atol=1e-5)
    assert (smooth[~mask] == 0).all()


def test_fixed_pixels_alone_are_the_plain_mean_of_the_window() -> None:
    rng = np.random.default_rng(1)
    flow = PixelFlow(
        rng.normal(size=(9, *SHAPE, 2)).astype(np.float32), rng.uniform(size=(9, *SHAPE)).astype(np.float32)
    )
    smooth, trust = smoothed_flow(flow, 3, EVERYWHERE, half_window=2, along_paths=False)
    mean, certain = mean_flow(PixelFlow(flow.displacement[1:6], flow.confidence[1:6]), EVERYWHERE)
    np.testing.assert_allclose(smooth, mean, atol=1e-6)
    np.testing.assert_allclose(trust, certain, atol=1e-6)


@pytest.mark.parametrize("pairs", [1, 3, 13])
def test_the_compiled_mean_is_the_plain_one(pairs: int) -> None:
    rng = np.random.default_rng(7)
    d = rng.normal(1.0, 2.0, (pairs, 500, 2)).astype(np.float32)
    d[:, :100] = 3.0  # without any spread
    d[0, 100:200] += 50.0  # one pair far off
    c = rng.uniform(size=(pairs, 500)).astype(np.float32)
    c[:, 200:220] = 0.0
    mean, trust, scatter = mean_of_samples(d, c)
    plain, certain = mean_flow(PixelFlow(d[:, None], c[:, None]))
    # float32 sums of some ten numbers up to 50
    np.testing.assert_allclose(mean, plain[0], atol=2e-5)
    np.testing.assert_allclose(trust, certain[0], atol=1e-5)
    assert np.allclose(scatter[:100], 0.0, atol=1e-9)
    if pairs == 3:
        assert (scatter[220:] > 0.01).all()


def test_at_the_ends_of_the_clip_the_pairs_that_are_there_answer() -> None:
    flow = carried_eddies(4, speed=2.0, amplitude=0.5)
    for at in (0, 3):
        smooth, trust = smoothed_flow(trusted(flow), at, EVERYWHERE)
        assert np.abs(smooth - flow[at])[4:-4, 8:-8].max() < 0.2  # a fixed pixel changes by 0.26 px in a frame
        assert (trust > 0.4).all()
    one, _ = smoothed_flow(trusted(flow[:1]), 0, EVERYWHERE)
    np.testing.assert_allclose(one, flow[0], atol=1e-6)


def test_wrong_input_is_named() -> None:
    flow = trusted(np.zeros((3, *SHAPE, 2), np.float32))
    with pytest.raises(ValueError, match="pair 3"):
        smoothed_flow(flow, 3, EVERYWHERE)
    with pytest.raises(ValueError, match="half window"):
        smoothed_flow(flow, 1, EVERYWHERE, half_window=-1)
    with pytest.raises(ValueError, match="mask"):
        smoothed_flow(flow, 1, EVERYWHERE[:5])
