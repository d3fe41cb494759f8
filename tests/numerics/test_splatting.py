"""The rasteriser agrees with its plain twin, picture and gradients, and with finite differences."""

import numpy as np
import pytest
import torch

from fluidlift.numerics import splatting, splatting_torch
from fluidlift.numerics.splatting import View

NAMES = ("means", "quats", "scales", "opacities", "features")


def scene(count: int, size: tuple[int, int], seed: int = 0) -> tuple[View, list[np.ndarray]]:
    """Gaussians of many shapes before a turned camera; one lies outside the picture and reaches into it."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(count, 3)) * (0.6, 0.6, 0.3)
    scales = 0.12 * np.exp(0.4 * rng.normal(size=(count, 3)))
    means[0], scales[0] = (4, 0, 0), 1.5
    quats = rng.normal(size=(count, 4))
    opacities, features = rng.uniform(0.05, 0.9999, count), rng.random((count, 5))
    c, s = np.cos(0.2), np.sin(0.2)
    w, h = size
    view = View(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]), np.array([0.1, -0.05, 2.5]), (1.3 * h, 1.2 * h),
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


def test_the_plain_twin_has_the_slope_of_finite_differences():
    view, arrays = scene(30, (24, 20), seed=3)
    _, _, gradients = value_and_gradients(splatting_torch.splat_dense, view, arrays, torch.float64)

    def value(changed):
        rng = torch.Generator().manual_seed(0)
        g_image = torch.randn(20, 24, 5, generator=rng, dtype=torch.float64)
        g_light = torch.randn(20, 24, generator=rng, dtype=torch.float64)
        image, light = splatting_torch.splat_dense(*changed, view)
        return float((image * g_image).sum() + (light * g_light).sum())

    rng = np.random.default_rng(1)
    operands = [torch.tensor(a, dtype=torch.float64) for a in arrays]
    errors = []
    for which in range(5):
        for _ in range(6):
            index = tuple(rng.integers(0, n) for n in operands[which].shape)
            values = []
            for step in (1e-7, -1e-7):
                changed = [o.clone() for o in operands]
                changed[which][index] += step
                values.append(value(changed))
            slope = (values[0] - values[1]) / 2e-7
            errors.append(abs(slope - float(gradients[which][index])) / (abs(slope) + gradients[which].abs().mean()))
    # a step across the cut at 1/255 jumps; with a step of 1e-7 hardly any of the thirty does
    assert np.sort(errors)[-3] < 1e-4


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
    view = View(np.eye(3), np.zeros(3), (100.0, 100.0), (8, 8), (16, 16))
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
