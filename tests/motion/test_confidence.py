"""Trust in optical flow: each test by itself, and that more trust means less error."""

from __future__ import annotations

import cv2
import numpy as np

from fluidlift.motion.confidence import (
    SHARED_FAILURE,
    agreement_over_time,
    photometric_agreement,
    round_trip,
    texture_strength,
)
from fluidlift.motion.optical_flow import estimate_flow


def texture(h: int, w: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    total = np.sum([s * cv2.GaussianBlur(rng.standard_normal((h, w)), (0, 0), s) for s in (1.5, 3.0, 6.0)], axis=0)
    return ((total - total.mean()) / total.std()).astype(np.float32)


def uniform(u: float, v: float, h: int = 48, w: int = 64) -> np.ndarray:
    return np.full((h, w, 2), (u, v), np.float32)


def test_the_round_trip_is_home_within_its_tolerance() -> None:
    assert round_trip(uniform(3, 0), uniform(-3, 0))[:, :-4].min() == 1.0
    # 0.5 px astray after 3 px: 0.45 / (0.45 + 0.25), with the tolerance 0.3^2 + (0.2 * 3)^2
    assert np.allclose(round_trip(uniform(3, 0), uniform(-2.5, 0))[:, :-4], 0.45 / 0.70, atol=1e-5)
    assert round_trip(uniform(3, 0), uniform(-3, 0))[:, -2:].max() == 0.0  # left the picture


def test_pictures_that_agree_under_another_light_agree_and_unrelated_ones_do_not() -> None:
    first = texture(48, 64, 1)
    second = np.roll(first, 3, axis=1) + 0.7  # brighter everywhere
    right = photometric_agreement(first, second, uniform(3, 0))[8:-8, 8:-16]
    wrong = photometric_agreement(first, texture(48, 64, 2), uniform(3, 0))[8:-8, 8:-16]
    assert right.min() > 0.99
    # unrelated pictures differ by the sum of their variances, give or take what a window of 15 px holds
    assert wrong.mean() < 0.25


def test_texture_is_the_root_of_the_smaller_eigenvalue() -> None:
    image = texture(40, 40, 3)
    found = texture_strength(image)
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    gx = cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32)
    gy = cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32)
    for row, column in ((12, 14), (20, 20), (27, 25)):
        window = np.s_[row - 7 : row + 8, column - 7 : column + 8]
        g = np.stack([gx[window].ravel(), gy[window].ravel()])
        assert np.isclose(found[row, column], np.sqrt(np.linalg.eigvalsh(g @ g.T / 225)[0]), rtol=1e-3)


def test_steady_and_drifting_motion_agree_over_time_and_a_failure_does_not() -> None:
    h, w = 64, 96
    u = np.arange(w, dtype=np.float32)

    def wave(shift: float) -> np.ndarray:
        d = uniform(4, 0, h, w)
        d[..., 1] = 2.0 * np.sin((u - shift) / 5.0)
        return d

    inner = np.s_[:, 12:-12]
    standing = agreement_over_time(wave(0), wave(0), wave(0))
    drifting = agreement_over_time(wave(-4), wave(0), wave(4))
    assert standing.min() > 0.99 and drifting[inner].min() > 0.9  # linear interpolation of the wave
    failed = agreement_over_time(wave(0), uniform(0, 0, h, w), wave(0))
    # 4 px and more away with a tolerance of 0.3 px
    assert failed.max() < (0.09 / 16) ** SHARED_FAILURE + 0.01
    assert agreement_over_time(None, wave(0), None).min() == 1.0
    half = agreement_over_time(wave(0), wave(0), uniform(0, 0, h, w))
    assert half.mean() < standing.mean()


def test_more_trust_means_less_error() -> None:
    # a stream with an eddy, dark water without foam, a still rock, glitter and noise
    h, w, count = 128, 160, 14
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    swirl = 2.5 * np.exp(-((x - 90) ** 2 + (y - 70) ** 2) / 800)
    true = np.stack([3.0 - swirl * (y - 70) / 20, swirl * (x - 90) / 20], axis=-1)
    foam = cv2.GaussianBlur((rng.random((h, w + 400)) < 0.5).astype(np.float32), (0, 0), 6)
    foam = 1 / (1 + np.exp(-(foam - foam.mean()) / foam.std() * 4 + 2))
    paint = (foam * (60 + 25 * texture(h, w + 400, 6))).astype(np.float32)
    frames = np.empty((count, h, w, 3), np.uint8)
    back = np.stack([x, y], axis=-1)
    for t in range(count):  # carried backwards along the steady flow
        level = 60 + cv2.remap(paint, back[..., 0] + 200, back[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        level = level + 90 * cv2.dilate((rng.random((h, w)) < 0.001).astype(np.float32), np.ones((2, 2)))
        level[40:70, 20:50] = 120 + 20 * texture(30, 30, 7)
        frames[t] = np.clip(level + 1.5 * rng.standard_normal((h, w)), 0, 255).astype(np.uint8)[..., None]
        back = back - cv2.remap(true, back[..., 0], back[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    flow = estimate_flow(frames)
    water = np.ones((h, w), bool)
    water[36:74, 16:54] = False
    error = np.linalg.norm(flow.displacement[4:9] - true, axis=-1)[:, water]
    trust = flow.confidence[4:9].astype(np.float32)[:, water]
    order = np.array_split(np.argsort(trust, axis=None), 4)
    means = [float(error.ravel()[part].mean()) for part in order]
    assert means[0] > means[1] > means[2] > 0.9 * means[3]  # the best two quarters may be alike
    assert means[0] > 3 * means[3]
    bad = error > np.maximum(1.0, 0.5 * np.linalg.norm(true, axis=-1)[water])
    # most failures lie below 0.4, from where the mainstream takes over
    assert (trust[bad] < 0.4).mean() > 0.7
    assert (trust[~bad] < 0.4).mean() < 0.45
