"""A jet is as wide as what changes by half of what its middle does; what is wide, or faint, is left as it was."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.shape.evidence import Evidence, gather_evidence
from fluidlift.shape.thin_outlines import slimmed
from fluidlift.types.clip import VideoClip
from fluidlift.types.flow import PixelFlow

FRAMES, HEIGHT, WIDTH = 24, 160, 240


def evidence_of(width: float, *, contrast: float = 40.0) -> tuple[Evidence, np.ndarray]:
    """Of a clip with a jet, columns from 120 on, whose pattern falls by 5 px per frame, blurred; and where it is."""
    rng = np.random.default_rng(2)
    room = 110.0 + 10.0 * gaussian_filter(rng.normal(size=(HEIGHT, WIDTH)), 2.0) / 0.14
    pattern = gaussian_filter(rng.normal(size=(HEIGHT + 5 * FRAMES, WIDTH)), 1.5)
    jet = np.broadcast_to(np.abs(np.arange(WIDTH) - 120.0) < 0.5 * width, (HEIGHT, WIDTH))
    pictures = []
    for t in range(FRAMES):
        falling = 120.0 + contrast * (pattern / pattern.std())[5 * (FRAMES - t) :][:HEIGHT]
        blurred = gaussian_filter(np.where(jet, falling, room), 1.0)
        pictures.append(blurred + rng.normal(size=blurred.shape))
    frames = np.clip(pictures, 0, 255).round().astype(np.uint8)[..., None].repeat(3, axis=-1)
    clip = VideoClip(frames, np.arange(FRAMES) / 25.0)
    still = PixelFlow(np.zeros((FRAMES - 1, HEIGHT, WIDTH, 2), np.float32), np.ones((FRAMES - 1, HEIGHT, WIDTH)))
    return gather_evidence(clip, still), jet


@pytest.mark.parametrize("width", [5.0, 7.0])
def test_flanks_that_blur_adds_are_taken_from_a_jet(width):
    evidence, jet = evidence_of(width)
    swollen = np.broadcast_to(np.abs(np.arange(WIDTH) - 120.0) < 0.5 * width + 3.0, jet.shape)
    found = slimmed(evidence, swollen)
    # half of the step lies at the outline, to a pixel: our own smoothing and the pattern's grain are as wide
    assert abs(found.sum(axis=1) - jet.sum(axis=1)).mean() < 1.5
    assert found[jet].mean() > 0.95


def test_what_is_wide_is_left_as_it_was():
    evidence, jet = evidence_of(60.0)
    assert np.array_equal(slimmed(evidence, jet), jet)


def test_where_half_of_the_change_is_no_more_than_noise_nothing_is_taken():
    evidence, _ = evidence_of(7.0, contrast=1.0)
    swollen = np.broadcast_to(np.abs(np.arange(WIDTH) - 120.0) < 6.5, (HEIGHT, WIDTH))
    assert np.array_equal(slimmed(evidence, swollen), swollen)


def test_an_empty_region_stays_empty():
    evidence, _ = evidence_of(7.0)
    assert not slimmed(evidence, np.zeros((HEIGHT, WIDTH), bool)).any()
