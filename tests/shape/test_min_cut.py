"""The cheapest cut is the cheapest of all cuts."""

from itertools import product

import numpy as np
import pytest

from fluidlift.shape.min_cut import edge_weights, geodesic_distance, min_cut


def cost(labels: np.ndarray, odds: np.ndarray, across: np.ndarray, down: np.ndarray) -> float:
    """What `min_cut` minimises, written out."""
    cut = (across * (labels[:, 1:] != labels[:, :-1])).sum() + (down * (labels[1:] != labels[:-1])).sum()
    return float(cut - odds[labels].sum())


@pytest.mark.parametrize("seed", range(6))
def test_no_labelling_of_a_small_picture_is_cheaper(seed):
    rng = np.random.default_rng(seed)
    odds = rng.normal(scale=2.0, size=(3, 4))
    across, down = rng.uniform(0, 2, (3, 3)), rng.uniform(0, 2, (2, 4))
    every = (np.array(bits, bool).reshape(3, 4) for bits in product((False, True), repeat=12))
    best = min(cost(labels, odds, across, down) for labels in every)
    # capacities are whole numbers of 1/50: 12 pixels and 17 edges, each rounded by at most 0.01
    assert cost(min_cut(odds, across, down), odds, across, down) <= best + 29 * 0.01 * 2


def test_an_outline_follows_the_edge_of_the_picture_rather_than_noisy_odds():
    rng = np.random.default_rng(0)
    truth = np.zeros((40, 60), bool)
    truth[:, 25:] = True
    channels = 80.0 * truth[..., None] + rng.normal(size=(40, 60, 3))
    odds = np.where(truth, 0.5, -0.5) + rng.normal(scale=1.5, size=truth.shape)
    assert (min_cut(odds, *edge_weights(channels.astype(np.float32), 4.0)) == truth).all()


def test_without_an_outline_to_pay_every_pixel_decides_for_itself():
    odds = np.random.default_rng(1).normal(size=(8, 9))
    free = np.zeros((8, 8)), np.zeros((7, 9))
    # odds below half a unit of capacity are lost to rounding
    assert (min_cut(odds, *free) == (odds > 0))[np.abs(odds) > 0.01].all()


def test_the_way_round_a_wall_is_the_shorter_one():
    channels = np.zeros((9, 9, 1), np.float32)
    channels[:8, 4] = 100.0
    seeds = np.zeros((9, 9), bool)
    seeds[0, 0] = True
    distance = geodesic_distance(channels, seeds, step=1.0)
    assert distance[0, 3] == pytest.approx(3.0)
    assert distance[0, 8] == pytest.approx(8 + 8 + 8)  # down to the gap, across, and up again
    assert distance[0, 4] > 100.0
