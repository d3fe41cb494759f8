"""Whether a mean motion can be a current, on motions whose truth is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from fluidlift.shape.kind import estimate_kind
from fluidlift.shape.passing import across, bay, returning, undirected

H, W = 90, 160
ROW, COL = np.mgrid[:H, :W]
STILL = np.zeros(2)
ALL = np.ones((H, W))


def field(u, v):
    return np.stack(np.broadcast_arrays(np.asarray(u, float), np.asarray(v, float), np.zeros((H, W)))[:2], axis=-1)


def bend():
    """A river that turns by 90 degrees, faster on its outside, with a whirl of a third of its speed behind a rock."""
    r = np.hypot(COL + 40.0, ROW + 40.0)
    motion = field((ROW + 40.0) / r * r / 60.0, -(COL + 40.0) / r * r / 60.0)
    x, y = COL - 80.0, ROW - 45.0
    behind = np.hypot(x, y) < 12
    motion[behind] = 0.05 * np.stack([-y, x], axis=-1)[behind]
    return motion


def surf():
    """A front runs up a beach to the left; before it water runs back at 0.6 of its speed, behind it water rests."""
    return field(np.where(np.abs(COL - 80) < 30, -2.0, np.where(COL < 80, 1.2, 0.0)), 0.0)


def crossing(rng):
    """What is left of crests that run in all directions, averaged over a second: no direction, a tenth of a pixel."""
    noise = [gaussian_filter(rng.normal(size=(H, W)), 6.0, mode="wrap") for _ in range(2)]
    return field(*(0.1 * n / n.std() for n in noise))


@pytest.mark.parametrize("motion", [field(2.0, 0.0), field(0.0, 1.0) * (ROW[..., None] / H) ** 2, bend()])
def test_a_current_goes_one_way_with_its_bends_and_whirls(motion):
    assert returning(motion, ALL, STILL) == 0.0
    assert undirected(motion, ALL, STILL) < 0.5


def test_surf_runs_up_and_back():
    assert returning(surf(), ALL, STILL) == 1.0
    assert returning(np.where(COL[..., None] < 110, surf(), -0.1), ALL, STILL) == 1.0
    assert returning(surf(), np.where(COL < 50, 0.0, 1.0), STILL) == 0.0, "without what runs back it is a current"


def test_crests_that_cross_have_no_direction():
    rng = np.random.default_rng(0)
    for _ in range(3):
        assert undirected(crossing(rng), ALL, STILL) == 1.0
    assert undirected(crossing(rng) + [0.5, 0.0], ALL, STILL) == 0.0


def test_a_camera_that_turns_makes_no_sea_of_a_river():
    """The river runs at 1 px per frame to the right; the picture goes to the left as fast, and shrinks."""
    shrinks = field(-0.01 * (COL - 80.0), 0.0)
    seen = field(1.0, 0.0) + shrinks - [1.0, 0.0]
    assert returning(seen, ALL, STILL) == 1.0
    assert returning(seen, ALL, np.array([-1.0, 0.0])) == 0.0
    # and what the camera does to the ground alone makes none either
    assert returning(field(1.0, 0.0) + shrinks, ALL, np.array([1.0, 0.0])) == 0.0


def test_what_comes_in_from_the_horizon_does_not_pass_across():
    assert across(field(1.5, 0.1), ALL, STILL) == 1.0
    assert across(field(-1.5, 0.1), ALL, np.array([-0.3, 0.0])) == 1.0
    assert across(field(0.2, 1.5), ALL, STILL) == 0.0
    assert across(surf(), ALL, STILL) == 0.0
    assert across(field(-0.8, 0.3), ALL, np.array([-0.8, 0.0])) == 0.0, "only the camera does"


def test_nothing_that_moves_says_nothing():
    for says in (returning, undirected):
        assert says(field(0.0, 0.0), ALL, STILL) == 0.0
        assert says(field(1.0, 0.0), 0.0 * ALL, STILL) == 0.0


def test_a_bay_has_one_opening():
    between_rocks = (ROW < 80) & (np.abs(COL - 80) < 90 - ROW)
    assert bay(between_rocks) == 1.0
    assert bay(between_rocks | (np.abs(COL - 80) < 70)) < 0.2, "it goes on below the picture"
    assert bay((ROW > 5) & (ROW < 70)) == 0.0, "it has a far bank"
    assert bay((np.abs(COL - 80) < 60) & (ROW < 70)) == 0.0, "it has banks on both sides"


T = 6


def waters(mask, motion, ground=0.0):
    """Frames, masks, motion, trust and bulk motion of blue water that moves steadily."""
    masks = np.broadcast_to(mask, (T, H, W)).copy()
    frames = np.full((T, H, W, 3), 90, np.uint8)
    frames[masks] = (60, 110, 160)
    bulk = (np.tile(motion[mask].mean(axis=0), (30, 1)), np.full((30, 2), ground))
    return frames, masks, motion * mask[..., None], mask.astype(float), bulk


@pytest.mark.parametrize(
    ("mask", "motion"),
    [(ROW > 30, surf()), ((ROW < 80) & (np.abs(COL - 80) < 90 - ROW), crossing(np.random.default_rng(0)))],
)
def test_such_water_is_a_basin_and_with_a_current_a_stream(mask, motion):
    *clip, bulk = waters(mask, motion)
    found = estimate_kind(*clip, bulk=bulk)
    assert found.kind == "basin", (found.scores, found.features)
    *clip, bulk = waters(mask, field(2.0, 0.1))
    assert estimate_kind(*clip, bulk=bulk).kind == "stream"


def test_a_person_who_says_where_it_runs_is_not_contradicted():
    *clip, _ = waters(ROW > 30, surf())
    assert estimate_kind(*clip).kind == "stream"
