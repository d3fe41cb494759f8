import numpy as np
import pytest

from fluidlift.shape.jets import JetOutline
from fluidlift.shape.puddle import down_to_landing, grows_taller, jet_over_pool, jets_into_puddle
from fluidlift.types import PinholeCamera, UpEvidence

H, W = 160, 160
CAMERA = PinholeCamera.from_fov(40.0, (W, H))
ROW, COL = np.mgrid[:H, :W] + 0.5
JET = (np.abs(COL - 80) < 7) & (ROW < 100)


def pool(height, width=50.0):
    return ((COL - 80) / width) ** 2 + ((ROW - 100) / height) ** 2 < 1


def scene(body):
    """Mask, motion (10 px down in the jet, still below) and trust."""
    motion = np.zeros((H, W, 2))
    motion[JET, 1] = 10.0
    return JET | body, motion, np.where(JET | body, 0.8, 0.0)


def test_a_jet_into_a_round_pool_seen_from_above_is_a_puddle_with_a_jet():
    found = jets_into_puddle(CAMERA, UpEvidence(40.0, 0.0, "", 1.0), *scene(pool(32.0)))
    assert found is not None and len(found.jets) == 1
    assert found.lying[130, 80] and not found.lying[20, 80]


def test_wet_traces_around_a_pool_are_no_part_of_its_outline():
    mask, motion, trust = scene(pool(32.0))
    ring = ((COL - 80) / 66) ** 2 + ((ROW - 100) / 46) ** 2
    mask |= (np.abs(ring - 1.0) < 0.03) & (ROW < 90) & ~JET
    found = jets_into_puddle(CAMERA, UpEvidence(40.0, 0.0, "", 1.0), mask, motion, trust)
    assert found is not None
    assert not found.lying[ring > 0.9].any()


def test_a_glass_seen_from_the_side_is_no_puddle():
    glass = (np.abs(COL - 80) < 32) & (ROW > 60) & (ROW < 150)
    assert jets_into_puddle(CAMERA, None, *scene(glass)) is None


def test_a_round_vessel_seen_level_is_no_puddle():
    body = scene(pool(40.0))
    assert jets_into_puddle(CAMERA, UpEvidence(5.0, 0.0, "", 1.0), *body) is None
    assert jets_into_puddle(CAMERA, None, *body) is not None  # nothing says that the camera is level


def test_over_what_spreads_the_silhouette_shows_the_jet():
    found = jet_over_pool(UpEvidence(40.0, 0.0, "", 1.0), JET | pool(32.0))
    assert found is not None and len(found.jets) == 1
    outline = found.jets[0]
    assert outline.pixels[20:60, 80].all() and not outline.pixels[100:].any()
    assert outline.half_widths == pytest.approx(7.0, abs=1.0)
    assert found.lying[130, 80] and not found.lying[20, 80]
    assert jet_over_pool(None, pool(32.0)) is None, "there is none"


def test_without_a_jet_there_is_no_puddle():
    mask, motion, trust = scene(pool(32.0))
    assert jets_into_puddle(CAMERA, None, mask, 0 * motion, trust) is None


@pytest.mark.parametrize(("below", "reach"), [(0.0, 12.0), (0.8, 0.0), (0.4, 6.0)])
def test_a_jet_goes_on_over_the_way_on_which_its_flow_is_lost(below, reach):
    """Flow of 12 px a frame ends 12 px above the landing; where it is still trusted, the jet has ended."""
    pixels = (np.abs(COL - 80) < 6) & (ROW < 90)
    outline = JetOutline(pixels, np.array([[80.0, 0.0], [80.0, 90.0]]), np.array([6.0, 6.0]), True)
    motion = np.zeros((H, W, 2))
    motion[pixels, 1] = 12.0
    drawn = down_to_landing(outline, np.ones((H, W), bool), motion, np.where(pixels, 0.8, below))
    assert drawn.centers[-1][1] == pytest.approx(90.0 + reach, abs=1e-6)
    assert drawn.pixels.any(axis=1).sum() == pytest.approx(90 + reach, abs=1)


def test_what_fills_a_glass_gets_taller_and_a_puddle_stays_as_flat_as_it_is_seen():
    found = jets_into_puddle(CAMERA, None, *scene(pool(20.0)))
    assert found is not None
    spread = ((COL - 80) / 65.0) ** 2 + ((ROW - 106) / 26.0) ** 2 < 1
    glass = (np.abs(COL - 80) < 50) & (ROW > 40) & (ROW < 100)
    sways = JET | np.roll(JET, 6, axis=1)
    assert not grows_taller(found, JET | pool(20.0)) and not grows_taller(found, sways | spread)
    assert grows_taller(found, sways | pool(20.0) | glass)
