"""The paper's sum over neighbours: their weighted mean where they flow along, less where they do not."""

import numpy as np
import pytest

from fluidlift.motion.neighbour_sum import complete_by_sum

SHAPE = (40, 60)
ALONG = np.broadcast_to(np.array([1.0, 0.0], np.float32), (*SHAPE, 2))


def hole() -> np.ndarray:
    """Confidence with a gap in the middle."""
    confidence = np.full(SHAPE, 0.9, np.float32)
    confidence[15:25, 20:40] = 0.0
    return confidence


def test_a_uniform_stream_is_completed_exactly_and_what_was_seen_stays():
    flow = np.zeros((*SHAPE, 2), np.float32)
    flow[...] = (2.5, 0.0)
    broken = np.where(hole()[..., None] > 0, flow, 0.0)
    mask = np.ones(SHAPE, bool)
    mask[:3] = False
    full, observed = complete_by_sum(broken, hole(), mask, ALONG)
    np.testing.assert_allclose(full[mask], flow[mask], rtol=1e-6)
    np.testing.assert_array_equal(observed, mask & (hole() > 0))
    assert (full[~mask] == 0).all()


def test_the_sum_is_that_of_the_paper_for_one_neighbour_at_an_angle():
    """One observed pixel: w = 1, so v_k = cos(angle) v_i."""
    flow, confidence = np.zeros((*SHAPE, 2), np.float32), np.zeros(SHAPE, np.float32)
    flow[20, 30], confidence[20, 30] = (3.0, 4.0), 1.0
    full, observed = complete_by_sum(flow, confidence, np.ones(SHAPE, bool), ALONG)
    assert observed.sum() == 1
    np.testing.assert_allclose(full[5, 5], 0.6 * np.array([3.0, 4.0]), rtol=1e-6)


def test_neighbours_that_flow_against_the_mainstream_do_not_count():
    flow = np.zeros((*SHAPE, 2), np.float32)
    flow[:20], flow[20:] = (2.0, 0.0), (-2.0, 0.0)
    confidence = np.full(SHAPE, 0.9, np.float32)
    confidence[18:22, 25:35] = 0.0
    full, _ = complete_by_sum(flow, confidence, np.ones(SHAPE, bool), ALONG)
    filled = full[18:22, 25:35, 0]
    # half of the weight lies on either side, and that of the other side is lost
    assert (filled > 0).all() and 0.35 * 2.0 < filled.mean() < 0.65 * 2.0


def test_without_a_single_observed_pixel_the_flow_stays():
    flow = np.random.default_rng(0).normal(0, 1, (*SHAPE, 2)).astype(np.float32)
    full, observed = complete_by_sum(flow, np.zeros(SHAPE), np.ones(SHAPE, bool), ALONG)
    np.testing.assert_array_equal(full, flow)
    assert not observed.any()
    with pytest.raises(ValueError, match="mask"):
        complete_by_sum(flow, np.zeros(SHAPE), np.zeros(SHAPE, bool), ALONG)
