"""Mainstream correction on fields that can be written down."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fluidlift.motion.direction import mainstream_direction
from fluidlift.motion.interpolation import conductances
from fluidlift.motion.mainstream import ANISOTROPY, complete_flow

H, W = 72, 96


def test_uniform_flow_is_continued_as_it_is() -> None:
    mask = np.ones((H, W), bool)
    d = np.tile(np.array([3.0, 0.5], np.float32), (H, W, 1))
    c = np.ones((H, W), np.float32)
    c[20:50, 30:80] = 0.0
    d[20:50, 30:80] = 0.0
    n = mainstream_direction(d, c, mask)
    completed, observed = complete_flow(d, c, mask, n)
    assert not observed[20:50, 30:80].any() and observed[:20].all()
    assert np.abs(completed - [3.0, 0.5]).max() < 1e-3  # weights are normalised: nothing is lost with distance


def test_flow_against_the_mainstream_does_not_count() -> None:
    mask = np.ones((H, W), bool)
    d = np.tile(np.array([2.0, 0.0], np.float32), (H, W, 1))
    d[: H // 2 - 4] = (-2.0, 0.0)  # a back eddy above, observed as well
    c = np.ones((H, W), np.float32)
    c[H // 2 - 4 : H // 2 + 4] = 0.0
    n = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    completed, observed = complete_flow(d, c, mask, n)
    assert np.abs(completed[~observed] - [2.0, 0.0]).max() < 1e-3
    assert (completed[: H // 2 - 4] == d[: H // 2 - 4]).all()  # what was seen stays
    # where everything seen runs against it, the speed is kept and the direction is the mainstream's
    d[:] = (-2.0, 0.0)
    completed, observed = complete_flow(d, c, mask, n)
    assert np.abs(completed[~observed] - [2.0, 0.0]).max() < 1e-3


def test_standstill_amid_motion_is_not_believed_but_a_fluid_at_rest_is() -> None:
    mask = np.ones((H, W), bool)
    n = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    d = np.tile(np.array([3.0, 0.0], np.float32), (H, W, 1))
    d[30:40, 40:50] = 0.0  # the bed seen through clear water: textured, still, and trusted by the estimator
    completed, observed = complete_flow(d, np.ones((H, W), np.float32), mask, n)
    assert not observed[32:38, 42:48].any() and np.abs(completed[32:38, 42:48] - [3.0, 0.0]).max() < 0.1
    believed, _ = complete_flow(d, np.ones((H, W), np.float32), mask, n, stall=0.0)
    assert (believed == d).all()
    _, observed = complete_flow(np.zeros_like(d), np.ones((H, W), np.float32), mask, n)
    assert observed.all()


def operator_of(edges: np.ndarray, h: int, w: int) -> np.ndarray:
    """-div D grad as a full matrix, from the edges to the right, below, and on both diagonals."""
    out = np.zeros((h * w, h * w))
    for k, (down, right) in enumerate(((0, 1), (1, 0), (1, 1), (1, -1))):
        for i in range(h):
            for j in range(w):
                strength = edges[k, i + 1, j + 1]
                if strength > 0:
                    a, b = i * w + j, (i + down) * w + j + right
                    out[a, a] += strength
                    out[b, b] += strength
                    out[a, b] -= strength
                    out[b, a] -= strength
    return out


def test_the_filling_is_the_papers_sum() -> None:
    h, w = 14, 18
    rng = np.random.default_rng(3)
    v, u = np.mgrid[:h, :w]
    d = np.stack([2 + np.sin(u / 3.0), np.cos(v / 2.0 + u / 4.0)], axis=-1).astype(np.float32)
    c = rng.uniform(0.5, 0.95, (h, w)).astype(np.float32)
    c[4:9, 6:13] = 0.0
    d[4:9, 6:13] = 0.0
    angle = 0.4
    n = np.tile(np.array([np.cos(angle), np.sin(angle)], np.float32), (h, w, 1))
    every = np.ones((h, w), bool)
    completed, observed = complete_flow(d, c, every, n, stall=0.0)
    # w_ki is what diffusion carries from i to k, times the odds of the confidence, times the cosine
    cosine = np.maximum(0.0, (d * n).sum(-1) / np.maximum(np.linalg.norm(d, axis=-1), 1e-6))
    odds = (c / (1 - c) * cosine).ravel()
    green = np.linalg.inv(operator_of(conductances(every, n, ANISOTROPY), h, w) + np.diag(odds))
    weight = green * odds
    assert np.allclose(weight.sum(axis=1), 1.0)  # normalised without a division
    plain = (weight @ d.reshape(-1, 2)).reshape(h, w, 2)
    # the tolerance of the solve, 3e-4 of the residual at the start, is some 1e-3 of the speed at most
    assert np.abs(completed - plain)[~observed].max() < 0.005


def test_measured_turbulence_stays_untouched() -> None:
    rng = np.random.default_rng(6)
    mask = np.abs(np.mgrid[:H, :W][0] - H / 2) < 25
    d = (rng.standard_normal((H, W, 2)) + [2.0, 0.0]).astype(np.float32)
    c = np.where(rng.random((H, W)) < 0.3, 0.1, rng.uniform(0.5, 1.0, (H, W))).astype(np.float32)
    n = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    completed, observed = complete_flow(d, c, mask, n, stall=0.0)
    assert (observed == (mask & (c >= 0.4))).all()
    assert (completed[observed] == d[observed]).all()


def test_motion_comes_round_a_bank_and_not_through_it() -> None:
    # two arms side by side, 2 px of land between them, unlike speeds; the far half of one is not seen
    rows, cols = np.mgrid[:H, :W]
    mask = np.abs(rows - H / 2) > 1
    d = np.where(rows < H / 2, 1.0, 5.0)[..., None] * np.array([1.0, 0.0]) * mask[..., None]
    c = np.where(mask & ~((rows < H / 2) & (cols > W / 3)), 0.9, 0.0).astype(np.float32)
    n = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    completed, observed = complete_flow(np.where(c[..., None] > 0, d, 0.0), c, mask, n)
    assert np.abs(completed - d)[mask & ~observed].max() < 0.01  # a window in the distance would mix in the other arm


def test_motion_does_not_spread_from_a_jet_to_the_pool_behind_it() -> None:
    _, cols = np.mgrid[:H, :W]
    jet = np.abs(cols - W / 2) < 8
    depth = np.where(jet, 1.0, 1.5)
    d = np.where(jet[..., None], [0.0, 12.0], [1.0, 0.0])
    c = np.full((H, W), 0.9, np.float32)
    c[20:52, 34:62] = 0.0  # not seen: part of the jet and the pool on both sides of it
    n = np.where(jet[..., None], [0.0, 1.0], [1.0, 0.0])
    seen, every = np.where(c[..., None] > 0, d, 0.0), np.ones((H, W), bool)
    apart, mixed = (
        np.linalg.norm(complete_flow(seen, c, every, n, z)[0] - d, axis=-1)[c == 0].mean() for z in (depth, None)
    )
    assert apart < 0.3 < 0.5 * mixed  # a half of depth is 25 jumps: 1/600 of the influence is left


def test_flow_beside_a_jump_of_depth_is_a_mixture_and_gives_way_to_what_is_seen_on_its_own_side() -> None:
    # a jet before its pool: within half a patch of its edge flow finds the mean of the two, and is sure of it
    _, cols = np.mgrid[:H, :W]
    jet = np.abs(cols - W / 2) < 12
    depth = np.where(jet, 1.0, 1.5)
    d = np.where(jet[..., None], [0.0, 12.0], [0.0, 2.0])
    edge = np.abs(np.abs(cols - W / 2) - 12) < 3
    found = np.where(edge[..., None], [0.0, 7.0], d).astype(np.float32)
    n, every = np.tile(np.array([0.0, 1.0], np.float32), (H, W, 1)), np.ones((H, W), bool)
    sure = np.full((H, W), 0.9, np.float32)
    with_depth, observed = complete_flow(found, sure, every, n, depth)
    error = np.linalg.norm(with_depth - d, axis=-1)
    assert not observed[edge].any() and observed[~jet & (np.abs(cols - W / 2) > 18)].all()
    # a jump of a half leaves the mixture odds of 0.04; with a conductance of 1/4 across n that is a length of 2.5 px in
    # a strip of 3: about half of the 5 px that it errs by is left, on either side
    assert max(error[edge & jet].mean(), error[edge & ~jet].mean()) < 3.0
    assert complete_flow(found, sure, every, n)[1][edge].all()  # without depth nothing tells


def film(rise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A stream between banks 52 px apart: mask, true motion, what flow finds with patches of 8 px, and n.

    Its speed is 6 px in the middle and rises from rest at the bank over `rise` px.
    """
    rows, _ = np.mgrid[:H, :W]
    bank = 26.0 - np.abs(rows - (H - 1) / 2)
    mask = bank > 0
    speed = 6.0 * (1.0 - np.exp(-np.maximum(bank, 0.0) / rise))
    d = np.stack([speed, 0 * speed], axis=-1).astype(np.float32)
    # the nearest whole patch stands for what is nearer to the bank
    seen = np.stack([6.0 * (1.0 - np.exp(-np.maximum(bank, 4.0) / rise)), 0 * speed], axis=-1).astype(np.float32)
    return mask, d, seen, np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))


def test_a_film_that_is_slow_towards_its_banks_is_at_rest_there() -> None:
    mask, d, seen, n = film(8.0)
    completed, observed = complete_flow(seen, np.full((H, W), 0.9, np.float32), mask, n)
    rim = mask & ~observed
    assert rim.any() and (rim[: H // 2] == np.flipud(rim[H - H // 2 :])).all()
    before, after = (np.linalg.norm(f - d, axis=-1)[rim].mean() for f in (seen, completed))
    assert after < 0.6 * before  # a straight line from the last measured speed to rest, where the truth is curved
    middle = mask & ~cv2.dilate(((~mask) | rim).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert (completed[middle] == seen[middle]).all()


def test_a_stream_that_is_as_fast_beside_its_banks_as_within_is_left_alone() -> None:
    mask, _, seen, n = film(0.5)
    completed, observed = complete_flow(seen, np.full((H, W), 0.9, np.float32), mask, n)
    assert observed[mask].all() and (completed[mask] == seen[mask]).all()


def test_neighbours_along_the_stream_tell_more_than_those_across() -> None:
    # a shear flow: speed changes across the stream only
    rows, _ = np.mgrid[:H, :W]
    d = np.stack([1 + rows / 12.0, 0 * rows], axis=-1).astype(np.float32)
    d[..., 0] += np.sin(rows / 4.0)
    c = np.full((H, W), 0.9, np.float32)
    c[20:52, 30:66] = 0.0
    every, seen = np.ones((H, W), bool), np.where(c[..., None] > 0, d, 0.0)
    along = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    right = complete_flow(seen, c, every, along)[0]
    # the same stream with the direction turned by 45 degrees, which favours nobody
    oblique = complete_flow(seen, c, every, np.full((H, W, 2), np.sqrt(0.5), np.float32))[0]
    errors = [np.linalg.norm(f - d, axis=-1)[c == 0].mean() for f in (right, oblique)]
    assert errors[0] < 0.6 * errors[1]


def test_a_pixel_that_was_observed_at_other_times_remembers() -> None:
    every, n = np.ones((H, W), bool), np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    rows, cols = np.mgrid[:H, :W]
    # a slow patch amid the stream, not seen now
    true = np.where(np.hypot(rows - H / 2, cols - W / 2) < 14, 1.0, 3.0)[..., None] * np.array([1.0, 0.0])
    c = np.where(np.hypot(rows - H / 2, cols - W / 2) < 18, 0.0, 0.9).astype(np.float32)
    now = np.where(c[..., None] > 0, true, 0.0)
    prior = true.astype(np.float32), np.full((H, W), 0.8, np.float32)
    failed = c == 0
    without, with_prior = (
        np.abs(complete_flow(now, c, every, n, prior=p)[0] - true)[failed].mean() for p in (None, prior)
    )
    assert with_prior < 0.5 * without
    # a mean that was never observed either says nothing
    unsure = prior[0], np.full((H, W), 0.2, np.float32)
    assert (complete_flow(now, c, every, n, prior=unsure)[0] == complete_flow(now, c, every, n)[0]).all()


def test_own_motion_counts_where_it_is_no_slower_than_the_neighbours() -> None:
    every, n = np.ones((H, W), bool), np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    d = np.tile(np.array([2.0, 0.0], np.float32), (H, W, 1))
    c = np.full((H, W), 0.9, np.float32)
    c[30:34, 40:44] = c[30:34, 70:74] = 0.0
    d[30:34, 40:44] = (3.0, 0.5)  # faster: real, if noisy; flow does not fail that way
    d[30:34, 70:74] = (0.5, 0.0)  # slower: it fails this way
    completed, _ = complete_flow(d, c, every, n, stall=0.0)
    assert np.abs(completed[30:34, 40:44] - [2.7, 0.35]).max() < 0.01  # TRUSTED_OWN = 0.7 of the way
    assert np.abs(completed[30:34, 70:74] - [2.0, 0.0]).max() < 0.01


def test_an_arm_that_is_never_seen_gets_the_speed_of_the_rest_along_the_mainstream() -> None:
    rows, _ = np.mgrid[:H, :W]
    mask = np.abs(rows - H / 2) > 1
    c = np.where(rows < H / 2, 0.9, 0.0).astype(np.float32) * mask
    d = np.where(rows[..., None] < H / 2, [0.0, 2.0], [0.0, 0.0]).astype(np.float32)
    n = np.where(rows[..., None] < H / 2, [0.0, 1.0], [1.0, 0.0]).astype(np.float32)
    completed, _ = complete_flow(d, c, mask, n)
    assert np.abs(completed[mask & (rows > H / 2)] - [2.0, 0.0]).max() < 1e-3


def test_the_same_stream_far_away_moves_fewer_pixels() -> None:
    mask = np.ones((H, W), bool)
    depth = np.tile(np.linspace(1.0, 4.0, W), (H, 1))
    d = np.stack([6.0 / depth, 0 * depth], axis=-1).astype(np.float32)
    c = np.ones((H, W), np.float32)
    c[:, 60:] = 0.0
    n = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    completed, _ = complete_flow(np.where(c[..., None] > 0, d, 0), c, mask, n, depth)
    assert np.abs(completed - d).max() < 0.02


def test_nothing_observed_is_said_so() -> None:
    mask = np.abs(np.mgrid[:H, :W][0] - H / 2) < 16
    zero = np.zeros((H, W), np.float32)
    n = np.tile(np.array([1.0, 0.0], np.float32), (H, W, 1))
    completed, observed = complete_flow(np.ones((H, W, 2), np.float32), zero, mask, n)
    assert not observed.any() and (completed[~mask] == 0).all()
    with pytest.raises(ValueError, match="empty mask"):
        complete_flow(np.ones((H, W, 2), np.float32), zero, np.zeros((H, W), bool), n)
