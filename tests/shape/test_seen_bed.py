"""A bed that stays where it is is told from what a current carries over it, and from what stays at its surface."""

import numpy as np
import pytest
from made_beds import CAMERAS, GRID, filmed, ground_of, seen_in
from scipy import ndimage

from fluidlift.numerics.srgb import srgb_from_linear
from fluidlift.shape.seen_bed import still_layer

DEEP = {"depth": 0.8, "absorption": (1.6, 0.9, 1.4), "slope": 0.03}
SHALLOW = {"depth": 0.4, "slope": 0.06}


@pytest.mark.parametrize("view", list(CAMERAS))
@pytest.mark.parametrize("water", [DEEP, SHALLOW], ids=["deep", "rippled"])
def test_a_bed_is_seen_through_clear_water(view, water):
    _, film = filmed(view, **water)
    found = seen_in(film, CAMERAS[view])
    assert found is not None
    # where glints fall on each other nothing stays; the rest is seen. Of three seeds the least is 0.63
    assert found.share > 0.5
    assert not (found.seen & ~film.water).any()


@pytest.mark.parametrize("view", list(CAMERAS))
def test_none_is_seen_in_opaque_water_with_foam(view):
    _, film = filmed(view, opaque=True, slope=0.06)
    assert seen_in(film, CAMERAS[view]) is None


def test_the_still_layer_is_the_bed_without_glints_and_caustics():
    _, film = filmed("steep", **SHALLOW)
    found = seen_in(film, CAMERAS["steep"])
    seen = found.seen & ndimage.binary_erosion(film.water, iterations=2)
    true = srgb_from_linear(np.clip(film.still, 0.0, 1.0))

    def psnr(picture):
        error = picture[seen] / 255.0 - true[seen]
        return -10.0 * np.log10(np.var(error))  # the sky that a level surface mirrors is in all of them

    # single frames have 25 dB, their median over 24 of them 35: errors that are not alike fall with the root of that
    assert psnr(found.picture) > psnr(film.frames[0]) + 6.0


def test_water_that_stands_tells_nothing():
    """All of it stays, bed or not."""
    _, film = filmed("steep", **DEEP)
    masks = np.repeat(film.water[None], len(film.frames), axis=0)
    upright = np.ones(film.water.shape)
    assert still_layer(film.frames, masks, 0.0 * film.flow, film.water.astype(float), upright) is None


def test_a_mirror_shows_no_bed():
    """Seen so flat that the surface mirrors a sixth of the sky and more, whatever stays may be a mirror image."""
    _, film = filmed("steep", **DEEP)
    masks = np.repeat(film.water[None], len(film.frames), axis=0)
    flat = np.full(film.water.shape, 0.2)
    assert still_layer(film.frames, masks, film.flow, film.water.astype(float), flat) is None


def test_waves_that_stand_are_no_bed():
    """Crests against the current stay, but are smooth; foam drifts over them."""
    rng = np.random.default_rng(0)
    shape = (96, 160)
    y, x = np.mgrid[: shape[0], : shape[1]]
    foam = ndimage.gaussian_filter(rng.standard_normal((shape[0], shape[1] + 120)), 1.0, mode="wrap")
    foam = 40.0 * np.maximum(foam / foam.std() - 0.8, 0.0)
    crests = 25.0 * np.sin(2 * np.pi * x / 14.0 + 0.6 * np.sin(y / 9.0))
    frames = [90.0 + crests + foam[:, 3 * (36 - t) : 3 * (36 - t) + shape[1]] for t in range(36)]
    frames = np.clip(np.stack(frames)[..., None] * [1.0, 1.0, 0.95], 0, 255).astype(np.uint8)
    flow, all_of_it = np.tile([3.0, 0.0], (*shape, 1)), np.ones(shape)
    masks = np.ones((36, *shape), bool)
    assert still_layer(frames, masks, flow, all_of_it, all_of_it) is None
    # the same with the grain of gravel in place of crests
    stones = ndimage.gaussian_filter(rng.standard_normal(shape), 0.8)
    bed = np.clip(90.0 + 60.0 * stones / stones.std() * 0.4 + 0.5 * (frames[..., 0] - 90.0 - crests), 0, 255)
    bed = (bed[..., None] * [1.0, 0.9, 0.7]).astype(np.uint8)
    assert still_layer(bed, masks, flow, all_of_it, all_of_it) is not None


def test_pictures_and_masks_of_different_sizes_are_refused():
    _, film = filmed("steep", **DEEP)
    with pytest.raises(ValueError, match="pictures for masks"):
        still_layer(film.frames, film.water[None], film.flow, film.water.astype(float), np.ones(film.water.shape))


def test_the_ground_of_a_made_stream_has_its_bed_below_the_water():
    scene, _ = filmed("steep", **DEEP)
    mesh = ground_of(scene)
    assert mesh.vertices[:, 2].min() <= -0.75
    assert GRID.low[2] <= mesh.vertices[:, 2].min()
