"""Pruning takes what is no piece of the body, and nothing else."""

import numpy as np
import pytest

from fluidlift.shape.prune import prune
from fluidlift.types.gaussians import Gaussians, concatenate


def sheet(side: int = 30) -> Gaussians:
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    means = np.stack([x, y, np.sin(x / 5)], -1).reshape(-1, 3) * 0.01
    return Gaussians.isotropic(means.astype(np.float32), 0.006, np.full((side**2, 3), 0.5), 0.9)


def one(mean=(0.1, 0.1, 0.0), scales=(0.006, 0.006, 0.006), opacity=0.9, quat=(1, 0, 0, 0)) -> Gaussians:
    return Gaussians(np.array([mean]), np.array([quat]), np.array([scales]), np.array([opacity]), np.zeros((1, 1, 3)))


def test_a_clean_body_stays_whole():
    left, report = prune(sheet())
    assert len(left) == 900 and report.left == 900
    np.testing.assert_array_equal(left.means, sheet().means)


@pytest.mark.parametrize(
    "bad, reason",
    [
        (one(opacity=0.01), "faint"),
        (one(scales=(0.02, 0.001, 0.001)), "stretched"),
        (one(scales=(3.0, 3.0, 3.0)), "huge"),
        (one(mean=(5.0, 5.0, 5.0)), "isolated"),
        (one(scales=(np.nan, 0.01, 0.01)), "broken"),
        (one(scales=(-1.0, 0.01, 0.01)), "broken"),
        (one(mean=(np.inf, 0, 0)), "broken"),
        (one(quat=(0, 0, 0, 0)), "broken"),
        (one(opacity=np.nan), "broken"),
    ],
)
def test_each_kind_of_rubbish_goes_for_its_own_reason(bad, reason):
    left, report = prune(concatenate([sheet(), bad]))
    assert len(left) == 900
    assert getattr(report, reason) == 1
    assert sum([report.broken, report.faint, report.stretched, report.huge, report.isolated]) == 1


def test_flat_discs_are_pieces_of_a_surface():
    left, _ = prune(concatenate([sheet(), one(scales=(0.01, 0.01, 1e-5))]))
    assert len(left) == 901


def test_a_body_that_thins_out_with_distance_is_not_eaten():
    # pixels of one picture lie ten times as far apart at ten times the depth
    z = np.geomspace(1, 10, 60)
    a = np.linspace(-0.3, 0.3, 60)
    means = np.stack([(z[:, None] * a).ravel(), np.repeat(z, 60), np.zeros(3600)], 1)
    g = Gaussians.isotropic(means.astype(np.float32), 0.01 * np.repeat(z, 60), np.full((3600, 3), 0.5))
    assert len(prune(g)[0]) == 3600


def test_nothing_left_is_no_accident():
    left, report = prune(concatenate([one(opacity=0.0), one(scales=(np.inf, 1, 1))]))
    assert len(left) == 0 and report.left == 0
    assert len(prune(Gaussians.empty())[0]) == 0
