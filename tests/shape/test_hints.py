"""What the user says about a mask is read in px of the clip."""

import pytest

from fluidlift.errors import InputRejected
from fluidlift.shape.hints import clicks_at, polygon_mask


def test_points_are_read_in_px_of_the_clip_and_used_at_working_size():
    clicks = clicks_at([(511.9, 0.0, 1), (256, 144, 0)], (512, 288), (216, 384))
    assert clicks.fluid.tolist() == [[383, 0]] and clicks.other.tolist() == [[192, 108]]
    assert not clicks_at([], (512, 288), (216, 384))


def test_a_polygon_holds_its_area_and_nonsense_is_rejected():
    mask = polygon_mask([[(10, 10), (30, 10), (30, 20), (10, 20)], [(50, 30), (60, 30), (60, 40)]], 60, 80)
    # corners lie on the outline, half a px either way: the rim of 60 px and of 34 px
    assert abs(int(mask.sum()) - (200 + 50)) < 0.5 * (60 + 34) + 2
    assert mask[15, 20] and not mask[15, 40]
    with pytest.raises(InputRejected, match="polygon"):
        polygon_mask([[(1, 1), (2, 2)]], 60, 80)
    with pytest.raises(InputRejected, match="no pixel"):
        polygon_mask([[(-30, -30), (-20, -30), (-20, -20)]], 60, 80)
