"""Flow measured with the neighbours in time, against pictures whose motion is known."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from fluidlift.motion.multiframe import (
    DARK,
    MOST_AT_ONCE,
    REACH,
    SHORTEST,
    each_pair,
    log_brightness,
    moving_detail,
    multiframe_flow,
    refined,
    running_window,
)
from fluidlift.motion.optical_flow import DenseInverseSearch, estimate_flow

H, W = 96, 128
INNER = (slice(16, -16), slice(16, -16))
"""without the rim, where texture enters and leaves"""


def noise_texture(h: int, w: int, seed: int, sizes: tuple[float, ...] = (1.5, 3.0, 6.0)) -> np.ndarray:
    """Random values of mean 0 and deviation 1 with structure of several sizes (px)."""
    rng = np.random.default_rng(seed)
    total = np.sum([s * cv2.GaussianBlur(rng.standard_normal((h, w)), (0, 0), s) for s in sizes], axis=0)
    return ((total - total.mean()) / total.std()).astype(np.float32)


def pictures(levels: np.ndarray, seed: int = 0, noise: float = 1.0) -> np.ndarray:
    """Grey levels [T,H,W] as noisy u8 sRGB [T,H,W,3]."""
    noisy = levels + noise * np.random.default_rng(seed).standard_normal(levels.shape)
    return np.repeat(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., None], 3, axis=-1)


def drifting(velocity: tuple[float, float], count: int, seed: int = 1) -> np.ndarray:
    """Texture of deviation 1 that moves by `velocity` (px/frame), float32 [count,H,W]."""
    pad = int(np.ceil(count * max(abs(velocity[0]), abs(velocity[1])))) + 4
    wide = noise_texture(H + 2 * pad, W + 2 * pad, seed)
    u, v = np.meshgrid(np.arange(W, dtype=np.float32), np.arange(H, dtype=np.float32))
    return np.stack(
        [cv2.remap(wide, u + pad - velocity[0] * t, v + pad - velocity[1] * t, cv2.INTER_CUBIC) for t in range(count)]
    )


def carried(matrix: np.ndarray, count: int) -> np.ndarray:
    """Texture that x -> A x around the middle carries along, frame after frame; float32 [count,H,W]."""
    pad = 64
    wide = noise_texture(H + 2 * pad, W + 2 * pad, 5)
    u, v = np.meshgrid(np.arange(W) - W / 2, np.arange(H) - H / 2)
    out = []
    for t in range(count):
        back = np.linalg.inv(np.linalg.matrix_power(matrix, t))
        x, y = back[0, 0] * u + back[0, 1] * v, back[1, 0] * u + back[1, 1] * v
        x, y = (x + W / 2 + pad).astype(np.float32), (y + H / 2 + pad).astype(np.float32)
        out.append(cv2.remap(wide, x, y, cv2.INTER_CUBIC))
    return np.stack(out)


def mean_error(displacement: np.ndarray, true: tuple[float, float] | np.ndarray) -> float:
    return float(np.linalg.norm(displacement - np.asarray(true), axis=-1)[INNER].mean())


@pytest.mark.parametrize("frames", range(2, 30))
def test_both_frames_of_a_pair_see_the_same_window_inside_the_clip(frames: int) -> None:
    for pair in range(frames - 1):
        window = running_window(pair, frames)
        if window is None:
            assert frames - 1 < SHORTEST
            continue
        before, after = window
        assert SHORTEST <= before + after + 1 <= 2 * REACH + 1
        assert pair - before >= 0 and pair + 1 + after <= frames - 1
    assert running_window(12, 30) == (REACH, REACH)


@pytest.mark.parametrize("pair", [0, 1, 7, 12, 14])
def test_detail_is_the_log_picture_less_the_mean_of_its_window(pair: int) -> None:
    frames = pictures(128 + 40 * drifting((1.5, 0.5), 16))
    before, after = running_window(pair, 16) or (0, 0)
    log = np.log(cv2.cvtColor(frames.reshape(-1, W, 3), cv2.COLOR_RGB2GRAY).reshape(16, H, W) + DARK)
    detail = moving_detail(frames, pair)
    assert detail is not None
    for k, found in enumerate(detail):
        plain = log[pair + k] - log[pair + k - before : pair + k + after + 1].mean(axis=0)
        assert np.abs(found - plain).max() < 1e-5  # sums in another order, float32
    assert np.allclose(log_brightness(frames[3]), log[3], atol=1e-6)


def test_what_stands_still_has_no_detail_and_what_moves_keeps_its_motion() -> None:
    still = noise_texture(H, W, 3)
    moving = drifting((2.0, 0.0), 14)
    frames = np.exp(0.3 * (still + moving)) * 60
    both = moving_detail(pictures(frames, noise=0.0), 5)
    alone = moving_detail(pictures(np.exp(0.3 * moving) * 60, noise=0.0), 5)
    assert both is not None and alone is not None
    # shading multiplies brightness: its logarithm is the same in every frame. Rounding to 8 bits and `DARK` are left
    assert np.corrcoef(both[0].ravel(), alone[0].ravel())[0, 1] > 0.95
    # integer motion: the second picture is the first, moved
    assert np.corrcoef(both[1][:, 2:].ravel(), both[0][:, :-2].ravel())[0, 1] > 0.9


@pytest.mark.parametrize("velocity", [(0.6, -0.35), (1.5, 0.0), (3.0, 2.0), (12.0, -5.0)])
def test_translation_by_parts_of_a_pixel_and_by_many_is_found(velocity: tuple[float, float]) -> None:
    flow = estimate_flow(pictures(128 + 35 * drifting(velocity, 12)))
    # a tenth of a pixel is what the estimators leave on smooth texture with noise
    assert mean_error(flow.displacement[5], velocity) < 0.1
    # 0.7 px/frame lies between fast and slow, and the clip is short: neither of the two is sure by itself
    assert flow.confidence[5][INNER].mean() > (0.8 if np.hypot(*velocity) > 1 else 0.5)


@pytest.mark.parametrize("velocity", [(1.0, 0.0), (2.5, -1.0)])
def test_shading_that_stands_still_does_not_slow_the_flow_down(velocity: tuple[float, float]) -> None:
    frames = pictures(128 + 25 * drifting(velocity, 14) + 25 * noise_texture(H, W, 9, (2.0, 5.0)))
    plain = estimate_flow(frames[6:8], method="dis").displacement[0]
    several = estimate_flow(frames).displacement[6]
    speed = np.hypot(*velocity)

    def gain(d: np.ndarray) -> float:
        return float((d[INNER] @ np.asarray(velocity)).mean() / speed**2)

    assert gain(plain) < 0.8  # a compromise between what moves and what does not
    assert abs(gain(several) - 1) < 0.03
    assert mean_error(several, velocity) < 0.08 * speed  # the mean over 9 frames keeps a ninth of the still contrast


@pytest.mark.parametrize("speed", [0.1, 0.25])
def test_motion_below_the_noise_of_a_pair_is_measured_over_a_gap(speed: float) -> None:
    frames = pictures(128 + 35 * drifting((speed, 0.0), 24), noise=2.0)
    several = mean_error(estimate_flow(frames).displacement[12], (speed, 0.0))
    plain = mean_error(estimate_flow(frames[12:14], method="dis").displacement[0], (speed, 0.0))
    # noise of the two pictures is divided by the gap of 4
    assert several < 0.75 * plain and several < 0.05


def light_that_flickers(levels: np.ndarray) -> np.ndarray:
    gain = 1.0 + 0.25 * np.sin(2.1 * np.arange(len(levels)))
    return levels * gain[:, None, None]


def a_cloud_that_passes(levels: np.ndarray) -> np.ndarray:
    u = np.arange(W, dtype=np.float32)
    shade = [0.75 + 0.25 / (1 + np.exp(-(u - 8 * t) / 12)) for t in range(len(levels))]
    return levels * np.stack(shade)[:, None, :]


def glitter(levels: np.ndarray) -> np.ndarray:
    """Sparks of 2 px that flash up anywhere for one frame, on 2 % of the picture."""
    rng = np.random.default_rng(4)
    sparks = (rng.random(levels.shape) < 0.002).astype(np.float32)
    return levels + 140 * np.stack([cv2.dilate(s, np.ones((3, 3))) for s in sparks])


def highlights_that_run_against_the_stream(levels: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(6)
    spots = cv2.GaussianBlur((rng.random((H, 4 * W)) < 0.001).astype(np.float32), (0, 0), 2.5)
    spots *= 110 / spots.max()
    return np.stack([p + spots[:, 2 * W + 4 * t : 3 * W + 4 * t] for t, p in enumerate(levels)])


@pytest.mark.parametrize(
    ("disturbed", "share"),
    [
        (light_that_flickers, 0.03),
        (a_cloud_that_passes, 0.05),
        (glitter, 0.10),
        # a twelfth of the picture is brighter than its texture is deep, and moves the other way
        (highlights_that_run_against_the_stream, 0.30),
    ],
)
def test_changing_light_and_highlights_leave_the_motion(
    disturbed: Callable[[np.ndarray], np.ndarray], share: float
) -> None:
    velocity = (2.0, 1.0)
    flow = estimate_flow(pictures(disturbed(110 + 25 * drifting(velocity, 14))))
    assert mean_error(flow.displacement[6], velocity) < share * np.hypot(*velocity)


@pytest.mark.parametrize(
    "matrix",
    [
        np.array([[np.cos(0.03), -np.sin(0.03)], [np.sin(0.03), np.cos(0.03)]]),
        np.eye(2) * 1.03,
        np.array([[1.0, 0.04], [0.0, 1.0]]),
    ],
    ids=["rotation", "expansion", "shear"],
)
def test_rotation_expansion_and_shear_are_found(matrix: np.ndarray) -> None:
    flow = estimate_flow(pictures(128 + 35 * carried(matrix, 12)))
    u, v = np.meshgrid(np.arange(W) - W / 2, np.arange(H) - H / 2)
    x = np.stack([u, v], axis=-1)
    # up to 2 px/frame; the texture itself is resampled, which blurs it
    assert mean_error(flow.displacement[5], x @ matrix.T - x) < 0.08


def test_real_fluctuation_is_not_averaged_away() -> None:
    shift = np.cumsum([(2.0 + (0.8 if t % 2 else -0.8)) for t in range(14)])
    pad = 64
    wide = noise_texture(H, W + 2 * pad, 8)
    u, v = np.meshgrid(np.arange(W, dtype=np.float32), np.arange(H, dtype=np.float32))
    frames = pictures(
        np.stack([128 + 35 * cv2.remap(wide, u + np.float32(pad - s), v, cv2.INTER_CUBIC) for s in shift])
    )
    speeds = estimate_flow(frames).displacement[:, 16:-16, 16:-16, 0].mean(axis=(1, 2))
    # from one pair to the next the fluid speeds up and slows down by 0.8 px/frame
    assert np.abs(speeds[2:-2] - np.diff(shift)[2:-2]).max() < 0.1


def test_still_ground_far_from_the_stream_rests_for_certain_and_beside_it_is_doubted() -> None:
    levels = 128 + 35 * np.repeat(noise_texture(160, 256, 2)[None], 14, axis=0)
    stream = slice(0, 64)
    moving = noise_texture(64, 256 + 80, 7)
    for t in range(14):
        levels[t, stream] = 128 + 35 * moving[:, 60 - 3 * t : 60 - 3 * t + 256]
    levels[:, 12:52, 100:150] = levels[0, 12:52, 100:150]  # the bed is seen through the water here
    flow = estimate_flow(pictures(levels))
    d, c = flow.displacement[6], flow.confidence[6].astype(float)
    # single spots without texture are filled in
    assert np.linalg.norm(d[120:150, 16:-16], axis=-1).mean() < 0.05 and c[120:150, 16:-16].mean() > 0.8
    assert np.abs(d[8:56, 16:90] - [3.0, 0.0]).mean() < 0.1 and c[8:56, 16:90].mean() > 0.8
    assert c[28:36, 118:132].max() < 0.4


def test_a_place_without_texture_and_what_is_being_covered_get_no_confidence() -> None:
    levels = 128 + 35 * drifting((2.0, 0.0), 14)
    levels[:, 30:66, 40:88] = 128
    flow = estimate_flow(pictures(levels, noise=0.0))
    assert flow.confidence[6, 42:54, 56:72].max() < 0.05
    front = 128 + 35 * noise_texture(H, 48, 12)
    levels = 128 + 35 * drifting((-2.0, 0.0), 14)
    for t in range(14):
        levels[t, :, 10 + 4 * t : 58 + 4 * t] = front  # moves right, over texture that moves left
    flow = estimate_flow(pictures(levels))
    edge = 58 + 4 * 6
    hidden, open_ = flow.confidence[6, 16:-16, edge + 1 : edge + 4], flow.confidence[6, 16:-16, 46:70]
    assert hidden.mean() < 0.4 and open_.mean() > 0.7


def test_measuring_again_in_a_moving_frame_mends_an_error_of_the_mean_but_no_wild_match() -> None:
    frames = pictures(128 + 35 * drifting((5.0, 0.0), 12))
    mean = np.full((H, W, 2), (4.2, 0.5), np.float32)
    own = np.full((H, W, 2), (4.6, 0.3), np.float32)
    # believed to nine tenths: the pair by itself had been on its way there
    assert mean_error(refined(frames, 5, own, mean, DenseInverseSearch()), (5.0, 0.0)) < 0.35
    start = np.zeros((H, W, 2), np.float32)
    wild = np.full((H, W, 2), (0.0, 0.0), np.float32)
    # a remainder of 5 px, where neither the mean nor the pair had any motion, is hardly believed: 5 * 0.09 / 25
    assert np.linalg.norm(refined(frames, 5, start, wild, DenseInverseSearch()), axis=-1)[INNER].mean() < 0.1
    own = np.full((H, W, 2), (5.1, 0.0), np.float32)
    assert mean_error(refined(frames, 5, own, wild, DenseInverseSearch()), (5.0, 0.0)) < 0.6


def test_frames_on_disk_are_read_a_few_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "frames.npy"
    np.save(path, pictures(128 + 35 * drifting((2.0, 0.0), 60)))
    frames = np.load(path, mmap_mode="r")
    estimator = DenseInverseSearch()
    estimator.any_thread = False  # how many pairs lie in memory at the same time is a matter of chance else
    # the first call pays for what is loaded once
    multiframe_flow(frames[:8], estimator)

    def mapped(name: str, dtype: type, shape: tuple[int, ...]) -> np.memmap:
        return np.memmap(tmp_path / name, dtype, "w+", shape=shape)

    def most_memory(count: int, out: tuple[np.ndarray, np.ndarray] | None) -> float:
        tracemalloc.start()
        multiframe_flow(frames[:count], estimator, out=out)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    picture = H * W * 4
    grown = most_memory(60, None) - most_memory(20, None)
    assert grown < 40 * 2.5 * picture + 2 * picture  # 40 results more: two floats and a half float per pixel
    files = {
        n: (mapped(f"d{n}", np.float16, (n - 1, H, W, 2)), mapped(f"c{n}", np.float16, (n - 1, H, W))) for n in (20, 60)
    }
    # what is written to files is not in memory: not one picture of the 40 more
    assert most_memory(60, files[60]) - most_memory(20, files[20]) < picture


@pytest.mark.parametrize("processors", [1, 2, 16])
def test_pairs_side_by_side_are_few_and_come_in_order(monkeypatch: pytest.MonkeyPatch, processors: int) -> None:
    monkeypatch.setattr("fluidlift.motion.multiframe.cores", lambda: processors)
    begun: list[int] = []

    def calls():
        for k in range(40):
            begun.append(k)
            yield (k,)

    ahead = []
    for k, found in enumerate(each_pair(lambda n: n * n, calls(), DenseInverseSearch())):
        assert found == k * k
        ahead.append(len(begun) - k)
    assert max(ahead) <= min(processors, MOST_AT_ONCE) + 1


def test_flow_is_the_same_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = pictures(128 + 35 * drifting((2.0, 0.0), 9))
    side_by_side, alone = DenseInverseSearch(), DenseInverseSearch()
    alone.any_thread = False
    monkeypatch.setattr("fluidlift.motion.multiframe.cores", lambda: 4)
    one, two = multiframe_flow(frames, alone), multiframe_flow(frames, side_by_side)
    np.testing.assert_array_equal(one.displacement, two.displacement)
    np.testing.assert_array_equal(one.confidence, two.confidence)


@pytest.mark.parametrize("method", ["multiframe", "dis"])
def test_flow_is_written_into_the_arrays_that_are_given(method: str) -> None:
    frames = pictures(128 + 35 * drifting((2.0, 0.0), 9))
    plain = estimate_flow(frames, method=method)
    out = np.full((8, H, W, 2), np.nan, np.float32), np.full((8, H, W), np.nan, np.float16)
    given = estimate_flow(frames, method=method, out=out)
    assert given.displacement is out[0] and given.confidence is out[1]
    assert np.array_equal(out[0], plain.displacement) and np.array_equal(out[1], plain.confidence)
    half = estimate_flow(frames, method=method, out=(out[0].astype(np.float16), out[1]))
    # float16 holds 2 px to 1/1000; the mean of the neighbours and the pair are rounded before they are used
    assert np.abs(half.displacement[:, *INNER] - plain.displacement[:, *INNER]).max() < 0.02
    for displacement, confidence in ((out[0][1:], out[1]), (out[0], out[1][:, 1:]), (out[0].astype(np.int16), out[1])):
        with pytest.raises(ValueError, match="to fill"):
            estimate_flow(frames, method=method, out=(displacement, confidence))


def test_a_short_clip_is_measured_as_it_is_and_progress_is_told() -> None:
    frames = pictures(128 + 35 * drifting((2.0, 0.0), 8))
    short = estimate_flow(frames[:SHORTEST])
    plain = estimate_flow(frames[:SHORTEST], method="dis")
    assert np.array_equal(short.displacement, plain.displacement)
    with pytest.raises(ValueError, match="at least 6"):
        multiframe_flow(frames[:SHORTEST], DenseInverseSearch())
    seen: list[tuple[int, int]] = []
    estimate_flow(frames, progress=lambda done, total: seen.append((done, total)))
    assert seen == [(k, 14) for k in range(1, 15)]
