"""Optical flow against pictures whose motion is known."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from fluidlift.motion.optical_flow import (
    DenseInverseSearch,
    Farneback,
    estimate_flow,
    flow_confidence,
    flow_picture,
    mean_flow,
)
from fluidlift.types import PixelFlow


def texture(h: int, w: int, seed: int = 0) -> np.ndarray:
    """Smooth random grey values: something to follow at several scales."""
    rng = np.random.default_rng(seed)
    total = sum(s * cv2.GaussianBlur(rng.standard_normal((h, w)), (0, 0), s) for s in (1.5, 3.0, 6.0))
    total = (total - total.min()) / np.ptp(total)
    return np.repeat((255 * total).astype(np.uint8)[..., None], 3, axis=-1)


def shifted(image: np.ndarray, dx: float, dy: float) -> np.ndarray:
    move = np.array([[1, 0, dx], [0, 1, dy]], np.float64)
    return cv2.warpAffine(image, move, image.shape[1::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


@pytest.mark.parametrize("method", ["dis", "farneback"])
def test_translation_of_a_textured_picture_is_found_and_trusted(method: str) -> None:
    image = texture(96, 128)
    frames = np.stack([shifted(image, 2.5 * t, -1.25 * t) for t in range(3)])
    flow = estimate_flow(frames, method=method)
    inner = (slice(None), slice(16, -16), slice(16, -16))
    error = np.linalg.norm(flow.displacement[inner] - [2.5, -1.25], axis=-1)
    assert error.mean() < 0.15  # both estimators are good to about a tenth of a pixel on smooth texture
    assert flow.confidence[inner].mean() > 0.8
    assert flow.displacement.dtype == np.float32 and flow.confidence.dtype == np.float16


def test_a_patch_without_texture_gets_no_confidence() -> None:
    image = texture(96, 128)
    image[30:66, 40:88] = 128
    flow = estimate_flow(np.stack([image, image]))
    assert flow.confidence[0, 42:54, 56:72].max() < 0.05
    assert flow.confidence[0, :16].mean() > 0.8


def test_an_edge_without_texture_along_it_gets_no_confidence() -> None:
    image = np.full((64, 64, 3), 40, np.uint8)
    image[:, 32:] = 200  # motion along the edge cannot be seen (aperture problem)
    still = np.zeros((64, 64, 2), np.float32)
    assert flow_confidence(image, still, still).max() < 0.01


def test_flow_that_does_not_lead_home_gets_little_confidence() -> None:
    image = texture(64, 64)
    forward = np.full((64, 64, 2), 3.0, np.float32)
    good = flow_confidence(image, forward, -forward)[8:-8, 8:-8]
    bad = flow_confidence(image, forward, 0 * forward)[8:-8, 8:-8]
    assert good.mean() > 0.8 and bad.max() < 0.1
    # motion out of the picture cannot be checked
    assert flow_confidence(image, forward, -forward)[:, -2:].max() == 0.0


def test_the_mean_ignores_failed_frames_and_keeps_real_fluctuation() -> None:
    rng = np.random.default_rng(1)
    true = np.array([3.0, 1.0])
    d = (true + rng.normal(0, 0.5, (60, 8, 8, 2))).astype(np.float32)
    c = np.full((60, 8, 8), 0.9, np.float16)
    failed = rng.random((60, 8, 8)) < 0.5
    d[failed], c[failed] = 0.0, 0.1
    mean, confidence = mean_flow(PixelFlow(d, c))
    # 30 good frames with a deviation of 0.5: standard error 0.09; failed ones weigh 1/81 each
    assert np.abs(mean - true).mean() < 0.15
    assert confidence.min() > 0.7
    # a skewed fluctuation: the mean is kept, not the mode
    d = np.where(rng.random((400, 4, 4, 1)) < 0.15, 5.0, 2.0) * np.array([1.0, 0.0])
    mean, _ = mean_flow(PixelFlow(d.astype(np.float32), np.ones((400, 4, 4), np.float16)))
    assert abs(mean[..., 0].mean() - 2.45) < 0.1


def test_the_mean_counts_only_frames_inside_the_mask() -> None:
    d = np.zeros((4, 2, 2, 2), np.float32)
    d[2:] = 4.0
    mask = np.zeros((4, 2, 2), bool)
    mask[2:] = True
    mean, confidence = mean_flow(PixelFlow(d, np.ones((4, 2, 2), np.float16)), mask)
    assert np.allclose(mean, 4.0) and confidence.min() > 0.5
    _, nothing = mean_flow(PixelFlow(d, np.ones((4, 2, 2), np.float16)), np.zeros((2, 2), bool))
    assert nothing.max() == 0.0


def test_progress_and_an_estimator_of_ones_own() -> None:
    frames = np.repeat(texture(64, 64)[None], 4, axis=0)
    seen: list[tuple[int, int]] = []
    flow = estimate_flow(frames, method=Farneback(), progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 3), (2, 3), (3, 3)]
    # nothing moves; polynomials fitted over the border of the picture drift a little there
    assert np.abs(flow.displacement[:, 16:-16, 16:-16]).max() < 0.05


class SureOfTheLeftHalf(DenseInverseSearch):
    """An estimator that says itself how far it trusts its answer."""

    def estimate(self, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        d = self.displacement(first, second)
        own = np.ones(d.shape[:2], np.float32)
        own[:, d.shape[1] // 2 :] = 0.25
        return d, own


def test_an_estimators_own_doubt_lowers_the_trust_and_nothing_else() -> None:
    frames = np.stack([shifted(texture(64, 96), 2.0 * t, 0.0) for t in range(2)])
    plain, doubting = (estimate_flow(frames, method=m()) for m in (DenseInverseSearch, SureOfTheLeftHalf))
    assert np.array_equal(plain.displacement, doubting.displacement)
    share = doubting.confidence[0, 16:-16, 16:-16] / plain.confidence[0, 16:-16, 16:-16]
    assert (share[:, :32] == 1.0).all()
    assert np.allclose(share[:, 32:], 0.25, rtol=1e-3)  # float16


def test_values_that_are_not_finite_become_rest_without_trust() -> None:
    class WithHoles(DenseInverseSearch):
        def displacement(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
            d = super().displacement(first, second)
            d[20:30, 20:30] = np.nan
            return d

    frames = np.stack([shifted(texture(64, 96), 3.0 * t, 0.0) for t in range(2)])
    flow = estimate_flow(frames, method=WithHoles())
    assert (flow.displacement[0, 20:30, 20:30] == 0.0).all() and (flow.confidence[0, 20:30, 20:30] == 0.0).all()
    assert np.isfinite(flow.confidence).all() and flow.confidence[0, 40:56, 16:80].mean() > 0.8


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match="at least two"):
        estimate_flow(np.zeros((1, 16, 16, 3), np.uint8))
    with pytest.raises(ValueError, match="u8"):
        estimate_flow(np.zeros((2, 16, 16, 3), np.float32))
    with pytest.raises(ValueError, match="raft"):
        estimate_flow(np.zeros((2, 16, 16, 3), np.uint8), method="raft")


def test_colours_tell_directions_apart() -> None:
    d = np.zeros((2, 2, 2), np.float32)
    d[0, 0], d[0, 1], d[1, 0] = (4, 0), (-4, 0), (0.0, 0.0)
    picture = flow_picture(d, scale=4.0).astype(int)
    assert picture[0, 0].argmax() == 0 and picture[0, 0, 0] > 200  # right: red
    assert picture[0, 1].argmin() == 0 and picture[0, 1].max() > 200  # left: cyan
    assert picture[1, 0].max() == 0  # rest: black
    assert (flow_picture(d, np.zeros((2, 2), bool)) == 96).all()


def test_the_default_estimator_is_the_better_one_on_simulated_rivers() -> None:
    root = Path(os.environ.get("FLUIDLIFT_SHARED", Path(__file__).resolve().parents[3] / "shared"))
    case = root / "cases" / "river"
    if not (case / "truth.npz").exists():
        pytest.skip(f"no simulated river at {case}: set FLUIDLIFT_SHARED")
    capture = cv2.VideoCapture(str(case / "video.mp4"))
    frames = [cv2.cvtColor(capture.read()[1], cv2.COLOR_BGR2RGB) for _ in range(6)]
    with np.load(case / "truth.npz") as truth:
        flow = truth["flow"][:5].astype(np.float32)
        visible = np.unpackbits(truth["visible"], axis=-1)[:5, :, : flow.shape[2]].astype(bool)

    def error(method: object) -> float:
        estimate = estimate_flow(np.stack(frames), method=method).displacement
        return float(np.linalg.norm(estimate - flow, axis=-1)[visible].mean())

    default, other = error(DenseInverseSearch()), error(Farneback())
    # the motion is 4.1 px; a turbulent river with highlights leaves about a quarter of it
    assert default < 1.3 and default < other
