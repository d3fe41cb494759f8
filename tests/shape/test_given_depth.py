"""Depth pictures of several frames become one: factors, offsets, edges, and what cannot be right."""

from __future__ import annotations

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.shape.given_depth import DepthPictures, fuse, robust_line, robust_plane, scene_depth, without_rim
from fluidlift.shape.kind import level_camera
from fluidlift.types import PinholeCamera, UpEvidence

H, W = 60, 90
ROW, COL = np.mgrid[:H, :W]
FLUID = (np.abs(COL - 45) < 25) & (ROW > 20)


def ground() -> np.ndarray:
    """Camera z of level ground 2 m below a camera that looks 35 degrees down."""
    camera = level_camera(PinholeCamera.from_fov(50.0, (W, H)), UpEvidence(35.0, 0.0, "", 1.0))
    return 2.0 / -camera.rays(camera.pixel_grid())[..., 2]


def pictures(values, holds="relative") -> DepthPictures:
    values = np.atleast_3d(values) if np.ndim(values) == 2 else np.asarray(values)
    values = values.reshape(-1, H, W)
    return DepthPictures(values, tuple(range(len(values))), holds, "depth file")


def fused(values, holds="relative"):
    p = pictures(values, holds)
    return fuse(p, np.broadcast_to(FLUID, p.values.shape), FLUID)


@pytest.mark.parametrize("holds", ["relative", "disparity"])
def test_flicker_of_factor_and_offset_is_taken_out(holds):
    rng = np.random.default_rng(0)
    truth = ground() if holds == "relative" else 1.0 / ground()
    values = [truth * f + (0.05 * k if holds == "disparity" else 0.0) for k, f in enumerate((1.0, 1.2, 0.8, 1.1, 0.9))]
    values = np.array(values) * (1 + 0.01 * rng.normal(size=(5, H, W)))
    found = fused(values, holds)
    a, b = robust_line(truth.ravel(), found.values.ravel().astype(float))
    rest = found.values - (a + b * truth)
    # the median of five has 0.54 of the noise of one, and the offset's noise is that of thousands of pixels
    assert np.std(rest) / np.median(found.values) < 0.7 * 0.01 * (1.0 if holds == "relative" else 1.5)
    assert found.frames == 5 and found.flicker > 0.1


def test_a_fluid_that_moves_does_not_set_the_factor():
    # its depth halves in the second frame: the solids say that the factor is 1
    second = np.where(FLUID, 0.5, 1.0) * ground()
    found = fused([ground(), second])
    np.testing.assert_allclose(found.values[~FLUID], ground()[~FLUID], rtol=1e-5)


def test_disparity_gets_its_offset_from_level_water():
    disparity = 3.0 / ground() + 0.4
    scene = scene_depth(fused(disparity, "disparity"), ground(), FLUID)
    wanted = ground() / np.median(ground()[FLUID])
    known = np.isfinite(scene.depth) & FLUID
    assert known.mean() > 0.9 * FLUID.mean() and scene.unit is None
    np.testing.assert_allclose(scene.depth[known], wanted[known], rtol=2e-3)  # single precision, iterated weights


def test_nothing_of_a_disparity_lies_beyond_infinity():
    # the expected surface would put the offset far below what the far end allows
    disparity = 3.0 / ground() + 0.4
    wrong = 1.0 / (1.0 / ground() - 0.9 * (1.0 / ground()).min())
    scene = scene_depth(fused(disparity, "disparity"), wrong, FLUID)
    assert (scene.depth[FLUID & np.isfinite(scene.depth)] > 0).all()
    low, high = np.nanpercentile(scene.depth[FLUID], [1, 99])
    assert high / low < 12.5  # surface.FAR and what percentiles leave out


def test_metres_stay_metres():
    scene = scene_depth(fused(ground(), "metres"), ground(), FLUID)
    assert scene.unit == pytest.approx(np.median(ground()[FLUID]), rel=1e-5)


@pytest.mark.parametrize(
    ("values", "holds"), [(1.0 / ground(), "metres"), (1.0 / ground(), "relative"), (ground(), "disparity")]
)
def test_near_and_far_exchanged_is_said(values, holds):
    with pytest.raises(InputRejected) as caught:
        scene_depth(fused(values, holds), ground(), FLUID)
    assert "depth.holds" in caught.value.do


def test_what_faces_the_camera_may_be_either():
    wall = 2.0 + 0.001 * np.random.default_rng(0).normal(size=(H, W))
    scene_depth(fused(wall), np.full((H, W), 1.0), FLUID)


@pytest.mark.parametrize(
    ("values", "said"),
    [(np.zeros((H, W)), "empty"), (np.full((H, W), np.nan), "empty"), (np.full((H, W), 3.0), "same everywhere")],
)
def test_pictures_that_say_nothing_are_refused(values, said):
    with pytest.raises(InputRejected, match=said):
        fused(values)


def test_a_picture_that_says_nothing_about_the_fluid_is_refused():
    with pytest.raises(InputRejected, match="% of the fluid"):
        scene_depth(fused(np.where(FLUID, np.nan, ground())), ground(), FLUID)


def test_smeared_edges_say_nothing_but_slopes_do():
    near = (np.abs(COL - 30) < 8) & (np.abs(ROW - 15) < 8)
    depth = np.where(near, 0.4 * ground(), ground())
    from scipy import ndimage

    scene = scene_depth(fused(ndimage.gaussian_filter(depth, 1.5)), ground(), FLUID)
    edge = ndimage.binary_dilation(near, iterations=2) & ~ndimage.binary_erosion(near, iterations=2)
    assert np.isnan(scene.depth[edge]).mean() > 0.5
    assert np.isfinite(scene.depth[FLUID]).mean() > 0.95


def test_the_rim_goes_and_slender_things_stay():
    inner = without_rim(FLUID, share=0.03)
    assert inner.sum() < FLUID.sum() and not inner[21, 45] and inner[40, 45]
    assert inner[-1, 45]  # the picture's border is no rim
    jet = np.abs(COL - 45) < 2
    np.testing.assert_array_equal(without_rim(jet, share=0.03), jet)


def test_a_plane_is_found_beside_a_third_of_other_things():
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-1, 1, (2, 900))
    z = 1.0 + 0.2 * x - 0.3 * y + 0.001 * rng.normal(size=900)
    z[:300] += rng.uniform(0.3, 1.0, 300)
    # least squares alone would be off by a third of 0.65; the noise allows 1e-4
    np.testing.assert_allclose(robust_plane(x, y, z), [1.0, 0.2, -0.3], atol=1e-3)
