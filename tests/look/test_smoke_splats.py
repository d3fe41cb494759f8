"""Splats that share an optical depth: drawn together they are as thin as the picture that they were given."""

import numpy as np
import pytest

from fluidlift.look.rasterize import render
from fluidlift.look.smoke_splats import (
    BLUR,
    DRAWN,
    FAINTEST,
    REACH,
    _gathered,
    _spread,
    depth_of,
    drawn_splats,
    opacity_of,
    shared_depth,
)
from fluidlift.numerics import splatting_projection
from fluidlift.types import Gaussians, PinholeCamera

SIZE = (64, 64)
CAMERA = PinholeCamera.looking((0.0, -4.0, 0.0), (0.0, 0.0, 0.0), fov_degrees=40.0, size=SIZE)


def ball(count: int, seed: int = 0) -> np.ndarray:
    """Points in a ball of 0.6 m."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.6, 0.6, (4 * count, 3))
    return points[np.linalg.norm(points, axis=1) < 0.6][:count]


def splats(points: np.ndarray, widths: np.ndarray, weight: np.ndarray, camera: PinholeCamera) -> Gaussians:
    _, far = camera.project(points)
    rgb = np.full((len(points), 3), 0.5)
    return Gaussians.isotropic(points, widths * far / camera.focal[0], rgb, opacity_of(weight).astype(np.float32))


def puff(thickest: float) -> np.ndarray:
    v, u = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    return thickest * np.exp(-((u - 32) ** 2 + (v - 32) ** 2) / (2 * 5.0**2)) * (1 + 0.5 * np.sin(u))


@pytest.mark.parametrize("count", [4000, 40000])
@pytest.mark.parametrize("thickest", [0.15, 0.6, 2.5])
def test_together_they_are_as_thin_as_the_picture(count, thickest):
    points, depth = ball(count), puff(thickest)
    uv, _ = CAMERA.project(points)
    chance = np.random.default_rng(1).random(len(points))
    drawn, widths = drawn_splats(uv, np.full(len(points), 3.0), depth, chance)
    weight = shared_depth(uv[drawn], widths[drawn], depth, np.zeros(int(drawn.sum())))
    shown = render(splats(points[drawn], widths[drawn], weight, CAMERA), CAMERA).alpha
    wanted = 1 - np.exp(-depth)
    there = wanted > 0.03
    assert np.abs(shown - wanted)[there].mean() < 0.12 * wanted[there].mean()
    assert shown[there].mean() == pytest.approx(wanted[there].mean(), rel=0.06)


def test_from_the_side_they_hold_as_much_smoke():
    points, depth = ball(20000), puff(0.5)
    uv, _ = CAMERA.project(points)
    widths = np.full(len(points), 1.2)
    body = splats(points, widths, shared_depth(uv, widths, depth, np.zeros(len(points))), CAMERA)
    aside = PinholeCamera.looking((4.0, 0.0, 0.0), (0.0, 0.0, 0.0), fov_degrees=40.0, size=SIZE)
    taken = [-np.log1p(-np.minimum(render(body, c).alpha, 0.99)).sum() for c in (CAMERA, aside)]
    assert taken[1] == pytest.approx(taken[0], rel=0.1)


def test_they_do_not_stand_in_for_smoke_beside_them():
    """At the rim of the simulated smoke, splats are not made denser for what is filmed beyond it."""
    points = ball(8000)
    points = points[points[:, 0] < 0.0]
    uv, _ = CAMERA.project(points)
    depth, widths = np.full(SIZE[::-1], 0.5), np.full(len(points), 1.5)
    weight = shared_depth(uv, widths, depth, np.zeros(len(points)))
    assert depth_of(uv, widths, weight, SIZE).max() < 1.4 * 0.5


def test_splats_behind_each_other_keep_their_proportion():
    uv = np.repeat([[32.0, 32.0]], 2, axis=0)
    weight = shared_depth(uv, np.full(2, 2.0), np.full(SIZE[::-1], 0.5), np.array([0.1, 0.3]))
    assert weight[1] / weight[0] == pytest.approx(3.0, rel=1e-6)


def test_beside_the_picture_they_stay_as_they_are():
    uv = np.array([[-50.0, 10.0], [32.0, 32.0], [10.0, 1e6]])
    weight = shared_depth(uv, np.full(3, 2.0), np.full(SIZE[::-1], 0.5), np.array([0.2, 0.2, 0.3]))
    assert weight[0] == 0.2 and weight[2] == 0.3 and weight[1] != 0.2


def test_thin_smoke_is_drawn_with_fewer_splats_that_can_be_seen():
    points, depth = ball(40000), np.full(SIZE[::-1], 0.1)
    uv, _ = CAMERA.project(points)
    drawn, widths = drawn_splats(uv, np.full(len(points), 3.0), depth, np.random.default_rng(1).random(len(points)))
    weight = shared_depth(uv[drawn], widths[drawn], depth, np.zeros(int(drawn.sum())))
    assert 0.02 < drawn.mean() < 0.6
    assert np.median(weight) > 0.3 * FAINTEST and (opacity_of(weight) > DRAWN).mean() > 0.8


def test_the_rasteriser_is_the_one_that_it_is_made_for():
    assert splatting_projection.BLUR == np.float32(BLUR) and splatting_projection.ALPHA_MIN == np.float32(DRAWN)


def test_no_splats_are_no_smoke():
    none = np.zeros((0, 2))
    drawn, widths = drawn_splats(none, np.zeros(0), puff(1.0), np.zeros(0))
    assert not len(drawn) and not len(shared_depth(none, widths, puff(1.0), np.zeros(0)))


def test_the_kernels_do_what_the_formula_says():
    rng = np.random.default_rng(3)
    uv, sigma = rng.uniform(-2, 18, (30, 2)), rng.uniform(0.7, 3.0, 30)
    weight, field = rng.random(30), rng.random((16, 16))
    v, u = np.mgrid[:16, :16] + 0.5
    away = np.stack([u - uv[:, 0, None, None], v - uv[:, 1, None, None]])
    near = (np.abs(away) <= REACH * sigma[:, None, None]).all(axis=0)
    kernel = near * np.exp(-0.5 * np.square(away).sum(axis=0) / np.square(sigma)[:, None, None])
    total = np.zeros((16, 16))
    _spread(uv, sigma, weight, total)
    np.testing.assert_allclose(total, np.einsum("n,nij->ij", weight, kernel), atol=1e-12)
    mean, there = np.empty(30), kernel.sum(axis=(1, 2)) > 0
    _gathered(uv, sigma, field, mean)
    np.testing.assert_allclose(mean[there], (kernel * field).sum(axis=(1, 2))[there] / kernel.sum(axis=(1, 2))[there])
    assert (mean[~there] == -1).all()
