import numpy as np
import pytest
from scipy import ndimage

from fluidlift.shape.kinds import builder_of
from fluidlift.shape.plume import SIGHT, section_half_thickness

ROW, COL = np.mgrid[:120, :100]


def test_a_column_is_as_deep_as_it_is_wide():
    mask = np.abs(COL - 49.5) < 20
    half = section_half_thickness(mask)
    exact = np.sqrt(np.maximum(20.0**2 - (COL - 49.5) ** 2, 0.0))
    # smoothed over half a pixel: at the rim, where a circle is vertical, that is up to two pixels
    np.testing.assert_allclose(half[:, 35:65], exact[:, 35:65], atol=0.2)
    assert (half[~mask] == 0).all()


def test_the_section_of_a_cone_grows_with_height():
    radius = 5.0 + 0.25 * (119 - ROW)
    half = section_half_thickness(np.abs(COL - 49.5) < radius)
    middle = half[15:105, 49:51].mean(axis=1)
    # sections end on whole pixels
    np.testing.assert_allclose(middle, radius[15:105, 0], atol=0.8)


@pytest.mark.parametrize("roll", [20.0, -20.0])
def test_sections_are_level_in_a_picture_that_is_turned(roll):
    upright = np.abs(COL - 49.5) < 15
    turned = ndimage.rotate(upright, -roll, order=0, reshape=False)  # clockwise by roll
    right, wrong = (section_half_thickness(turned, r)[50:70, 48:52].mean() for r in (roll, -roll))
    assert right == pytest.approx(15.0, abs=0.7)  # turned by the nearest pixel
    assert wrong > 1.2 * right


def test_folds_and_holes_do_not_split_a_section():
    mask = np.abs(COL - 49.5) < 20
    torn = mask & ~(np.abs(COL - 45) < 2) & ~(np.hypot(COL - 60, ROW - 60) < 5)
    half, whole = section_half_thickness(torn), section_half_thickness(mask)
    np.testing.assert_allclose(half[torn][::7], whole[torn][::7], atol=1e-9)


def test_an_empty_mask_has_no_thickness():
    assert not section_half_thickness(np.zeros((8, 8), bool)).any()


@pytest.mark.parametrize(("depth", "share"), [(1.0, 0.45), (2.0, 0.40), (4.0, 0.32)])
def test_smoke_is_seen_where_its_light_comes_from_in_the_mean(depth, share):
    """The figures beside SIGHT: mean place along the ray, weighted by T(s) sigma ds, of a bell that ends at 5 %."""
    s = np.linspace(0.0, 1.0, 4001)
    sigma = 0.05 ** ((2 * s - 1) ** 2)
    sigma *= depth / sigma.mean()
    weight = sigma * np.exp(-np.cumsum(sigma) / len(s))
    assert (weight @ s) / weight.sum() == pytest.approx(share, abs=0.01)  # two digits are given
    assert (share - SIGHT) * (2.0 - depth) >= 0.0  # that of an optical depth of 2


def test_its_inlet_is_as_wide_as_the_stem_above_where_the_silhouette_is_round_below():
    x, y, z = np.meshgrid(*(np.arange(20) + 0.5,) * 3, indexing="ij")
    stem = np.hypot(x - 10, y - 10) < 5
    body = stem & ((z > 8) | (np.hypot(np.hypot(x - 10, y - 10), z - 8) < 5))  # a ball's lower half
    inlet = builder_of("plume").inlet(body, z, 1.0)
    layers = np.flatnonzero(inlet.any(axis=(0, 1)))
    assert list(layers) == [0, 1, 2, 3, 4, 5], "down to the ground, whichever cells that is in: no air comes from below"
    assert not body[:, :, :3].any() and body[:, :, 3].sum() < 0.4 * stem[:, :, 3].sum()
    above = body[:, :, 6]
    assert all((inlet[:, :, k] == above).all() for k in layers)
