"""The rasteriser agrees with its plain twin, picture and gradients, and with finite differences."""

import numba
import numpy as np
import pytest
import torch

from fluidlift.numerics import splatting, splatting_torch
from fluidlift.numerics.splatting import SplatCamera

NAMES = ("means", "quats", "scales", "opacities", "features")


def scene(count: int, size: tuple[int, int], seed: int = 0) -> tuple[SplatCamera, list[np.ndarray]]:
    """Gaussians of many shapes before a turned camera; one lies outside the picture and reaches into it."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3)) * (0.6, 0.6, 0.3)
    scales = 0.12 * np.exp(0.4 * rng.normal(size=(count, 3)))
    means[0], scales[0] = (4, 0, 0), 1.5
    quats = rng.normal(size=(count, 4))
    opacities, features = rng.uniform(0.05, 0.9999, count), rng.random((count, 5))
    c, s = np.cos(0.2), np.sin(0.2)
    w, h = size
    view = SplatCamera(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), np.array([0.1, -0.05, 2.5]), (1.3 * h, 1.2 * h),
                (w / 2 + 1, h / 2 - 2), size)  # fmt: skip
    return view, [np.ascontiguousarray(x, np.float32) for x in (means, quats, scales, opacities, features)]


def value_and_gradients(function, view, arrays, dtype, seed=0):
    """A random projection of picture and light, and its gradient in every operand."""
    rng = torch.Generator().manual_seed(seed)
    w, h = view.size
    g_image = torch.randn(h, w, 5, generator=rng, dtype=torch.float64).to(dtype)
    g_light = torch.randn(h, w, generator=rng, dtype=torch.float64).to(dtype)
    operands = [torch.tensor(a, dtype=dtype, requires_grad=True) for a in arrays]
    image, light = function(*operands, view)
    ((image * g_image).sum() + (light * g_light).sum()).backward()
    return image.detach(), light.detach(), [x.grad for x in operands]


@pytest.mark.parametrize("count, size", [(1, (16, 16)), (300, (52, 41)), (40, (17, 90))])
def test_the_fast_picture_and_its_gradients_equal_the_plain_twin(count, size):
    view, arrays = scene(count, size)
    image, light, gradients = value_and_gradients(splatting_torch.splat, view, arrays, torch.float32)
    exact, exact_light, exact_gradients = value_and_gradients(splatting_torch.splat_dense, view, arrays, torch.float64)
    # float32 with an exponential good to 1e-6: a few of these over hundreds of layers
    assert (image - exact).abs().max() < 1e-5 * exact.abs().max().clamp(min=1)
    assert (light - exact_light).abs().max() < 1e-5
    for name, fast, plain in zip(NAMES, gradients, exact_gradients):
        assert (fast - plain).norm() <= 3e-5 * plain.norm() + 1e-6, name
    if count == 300:
        assert exact_light.min() < 2e-4, "the scene must reach the early end of a pixel"


@pytest.mark.parametrize("count, size", [(300, (52, 41)), (40, (17, 90))])
def test_in_double_precision_the_kernels_are_the_plain_twin(count, size):
    view, arrays = scene(count, size)
    fast = value_and_gradients(splatting_torch.splat, view, arrays, torch.float64)
    exact = value_and_gradients(splatting_torch.splat_dense, view, arrays, torch.float64)
    assert fast[0].dtype == torch.float64
    # another order of the same sums: some hundreds of roundings of 1e-16
    assert (fast[0] - exact[0]).abs().max() < 1e-13 and (fast[1] - exact[1]).abs().max() < 1e-13
    for name, one, other in zip(NAMES, fast[2], exact[2]):
        assert (one - other).norm() < 1e-12 * other.norm(), name


@pytest.mark.parametrize("count, size", [(300, (52, 41)), (40, (17, 90))])
def test_gradients_are_finite_differences_to_one_in_a_million(count, size):
    view, arrays = scene(count, size)
    image, light, gradients = value_and_gradients(splatting_torch.splat, view, arrays, torch.float64)
    rng = torch.Generator().manual_seed(0)
    g_image = torch.randn(*image.shape, generator=rng, dtype=torch.float64)
    g_light = torch.randn(*light.shape, generator=rng, dtype=torch.float64)

    def value(which, index, step):
        changed = [torch.tensor(a, dtype=torch.float64) for a in arrays]
        changed[which][index] += step
        image, light = splatting_torch.splat(*changed, view)
        return float((image * g_image).sum() + (light * g_light).sum())

    random = np.random.default_rng(1)
    errors = []
    for which in range(5):
        step = 1e-5 * float(np.abs(arrays[which]).mean())
        mean = float(gradients[which].abs().mean())
        for _ in range(10):
            index = tuple(random.integers(0, n) for n in arrays[which].shape)
            at = {k: value(which, index, k * step) for k in (-2, -1, 1, 2)}
            slope = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * step)  # fourth order
            exact = float(gradients[which][index])
            errors.append(abs(slope - exact) / (abs(exact) + mean))
    # alpha jumps at the cut 1/255: a step that takes a pixel across it says nothing of the slope, and of fifty
    # steps hardly any does
    assert np.sort(errors)[-3] < 1e-6


def test_a_picture_has_the_same_bits_for_any_size_of_tile_and_its_gradients_are_equal():
    view, (means, quats, scales, opacities, features) = scene(400, (75, 61))
    projected = splatting.project(view, means, quats, scales, opacities)
    g_image = np.random.default_rng(0).normal(size=(61, 75, 5)).astype(np.float32)
    results = {}
    for tile in (16, 1, 5, 8, 17, 32, 48, 128):
        bins = splatting.bin_tiles(projected, view.size, tile)
        drawn = splatting.rasterize(projected, opacities, features, bins, view.size)
        gradients = splatting.rasterize_backward(
            projected, opacities, features, bins, *drawn, g_image, g_image[..., 0].copy()
        )
        results[tile] = drawn, gradients
    first, gradients = results[16]
    for tile, (drawn, others) in results.items():
        assert np.array_equal(drawn[0], first[0]) and np.array_equal(drawn[1], first[1]), tile
        for one, other in zip(gradients, others):  # float32 sums over pixels in another order
            assert np.linalg.norm(one - other) < 1e-5 * np.linalg.norm(one), tile


def test_threads_change_no_bit_of_picture_or_gradients():
    view, arrays = scene(5000, (120, 100))
    everyone = numba.get_num_threads()
    results = []
    try:
        for threads in {1, everyone}:
            numba.set_num_threads(threads)
            image, light, gradients = value_and_gradients(splatting_torch.splat, view, arrays, torch.float32)
            results.append([image, light, *gradients])
    finally:
        numba.set_num_threads(everyone)
    for one, other in zip(results[0], results[-1]):
        assert torch.equal(one, other)


def test_bands_of_tiles_make_the_same_picture_in_bounded_memory(monkeypatch):
    view, arrays = scene(300, (90, 70))
    whole = value_and_gradients(splatting_torch.splat, view, arrays, torch.float32)
    monkeypatch.setattr(splatting, "PAIRS_MAX", 400)
    projected = splatting.project(view, *arrays[:4])
    bins = splatting.bin_tiles(projected, view.size)
    assert len(bins.bands) > 3 and bins.whole is None
    assert bins.bands[0][0] == 0 and bins.bands[-1][1] == 6 * 5
    assert all(a[1] == b[0] for a, b in zip(bins.bands, bins.bands[1:]))
    parts = value_and_gradients(splatting_torch.splat, view, arrays, torch.float32)
    assert torch.equal(parts[0], whole[0]) and torch.equal(parts[1], whole[1])
    for name, one, other in zip(NAMES, parts[2], whole[2]):  # float32 sums over tiles in another order
        assert (one - other).norm() < 1e-5 * other.norm(), name


def test_tiles_that_a_needle_passes_by_do_not_get_it():
    view = SplatCamera(np.eye(3), np.zeros(3), (100.0, 100.0), (80, 80), (160, 160))
    quats = np.float32([[np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]])  # turned by 45 degrees in the picture
    arrays = np.float32([[0, 0, 2]]), quats, np.float32([[0.6, 0.005, 0.005]]), np.float32([0.9])
    projected = splatting.project(view, *arrays)
    bins = splatting.bin_tiles(projected, view.size)
    met = np.diff(bins.starts).reshape(10, 10) > 0
    light = splatting.rasterize(projected, arrays[3], np.ones((1, 1), np.float32), bins, view.size)[1]
    touched = (light < 1).reshape(10, 16, 10, 16).any((1, 3))
    assert (met | ~touched).all(), "no tile may be missed"
    assert met.sum() < 0.4 * 100, "the box holds all of them, the needle only the diagonal and its neighbours"


def test_no_gaussian_reaches_beyond_the_cap():
    view = SplatCamera(np.eye(3), np.zeros(3), (100.0, 100.0), (32, 32), (64, 64))
    means, quats = np.float32([[0, 0, 1], [0, 0, 1]]), np.float32([[1, 0, 0, 0]] * 2)
    scales, opacities = np.full((2, 3), 0.05, np.float32), np.float32([1.0, 0.1])
    sigma = np.sqrt(5.0**2 + 0.3)
    extents = splatting.project(view, means, quats, scales, opacities).extents
    # sqrt(2 ln 255) = 3.329 at most: under 3.33, so that the cap cuts nothing that is over 1/255
    np.testing.assert_allclose(extents[0], np.sqrt(2 * np.log(255)) * sigma, rtol=1e-6)
    assert extents[0, 0] < 3.33 * sigma
    np.testing.assert_allclose(extents[1], np.sqrt(2 * np.log(25.5)) * sigma, rtol=1e-6)


def test_colour_depth_normal_and_velocity_in_one_pass_are_those_of_four_passes():
    view, (means, quats, scales, opacities, _) = scene(200, (52, 41))
    features = np.random.default_rng(0).normal(size=(200, 10)).astype(np.float32)  # 3 + 1 + 3 + 3
    projected = splatting.project(view, means, quats, scales, opacities)
    bins = splatting.bin_tiles(projected, view.size)
    together, light = splatting.rasterize(projected, opacities, features, bins, view.size)
    for part in (slice(0, 3), slice(3, 4), slice(4, 7), slice(7, 10)):
        own = np.ascontiguousarray(features[:, part])
        alone, own_light = splatting.rasterize(projected, opacities, own, bins, view.size)
        assert np.array_equal(light, own_light)
        # the channels from the fifth on are added in a loop of their own, where the compiler may fuse or not
        np.testing.assert_allclose(alone, together[..., part], atol=2e-6)


def test_the_same_scene_gives_the_same_bits():
    view, arrays = scene(300, (52, 41))
    first, second = (value_and_gradients(splatting_torch.splat, view, arrays, torch.float32) for _ in range(2))
    assert torch.equal(first[0], second[0]) and torch.equal(first[1], second[1])
    assert all(torch.equal(a, b) for a, b in zip(first[2], second[2]))


@pytest.mark.parametrize("channels", [1, 3, 7])
def test_any_number_of_channels_is_composited_alike(channels):
    view, (means, quats, scales, opacities, _) = scene(50, (40, 30))
    features = np.ones((50, channels), np.float32)
    projected = splatting.project(view, means, quats, scales, opacities)
    bins = splatting.bin_tiles(projected, view.size)
    image, light = splatting.rasterize(projected, opacities, features, bins, view.size)
    # weights and what is left of the light add up to one
    np.testing.assert_allclose(image + light[..., None], 1, atol=2e-6)


def test_order_is_by_depth_and_ties_by_index():
    view = SplatCamera(np.eye(3), np.zeros(3), (100.0, 100.0), (8, 8), (16, 16))
    means = np.float32([[0, 0, 3], [0, 0, 2], [0, 0, 2], [0, 0, -1]])
    quats, scales = np.tile(np.float32([1, 0, 0, 0]), (4, 1)), np.full((4, 3), 0.05, np.float32)
    opacities = np.full(4, 0.5, np.float32)
    bins = splatting.bin_tiles(splatting.project(view, means, quats, scales, opacities), view.size)
    assert bins.order.tolist() == [1, 2, 0], "nearest first; behind the camera not at all"


def test_broken_numbers_are_not_drawn():
    view, arrays = scene(20, (24, 20))
    for which in range(4):
        for bad in (np.nan, np.inf):
            broken = [a.copy() for a in arrays]
            broken[which][5] = bad
            projected = splatting.project(view, *broken[:4])
            drawn = projected.extents[:, 0] > 0
            assert np.isfinite(projected.means).all() and np.isfinite(projected.extents).all()
            if which != 3 or np.isnan(bad):  # an infinite opacity is held at one by the caller
                assert not drawn[5], (which, bad)
