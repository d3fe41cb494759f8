"""Cameras of the page that are kept are what `render --view` reads."""

import math

import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.views import read_view
from fluidlift.viewer import kept_views
from fluidlift.viewer.panel_run import SHOWN, in_words

WIDE = math.radians(60.0)


def test_kept_cameras_are_read_as_a_path_in_the_order_of_their_frames(tmp_path):
    later = kept_views.key_of(9, (1, 2, 3), (0, 0, 0), WIDE, 1.0)
    first = kept_views.key_of(0, (2, 2, 3), (0, 0, 0.5), WIDE, 0.5)
    assert [kept_views.keep(tmp_path, key) for key in (later, first)] == [1, 2]
    assert read_view(tmp_path / kept_views.FILE) == [first, later]
    again = kept_views.key_of(9, (5, 5, 5), (0, 0, 0), WIDE, 1.0)
    assert kept_views.keep(tmp_path, again) == 2  # one for a frame
    assert read_view(tmp_path / kept_views.FILE) == [first, again]
    assert (kept_views.forget(tmp_path), kept_views.forget(tmp_path)) == (True, False)


def test_the_angle_is_that_across_the_longer_side():
    square, tall = (kept_views.key_of(0, (1, 0, 0), (0, 0, 0), WIDE, a).fov for a in (1.0, 0.5))
    assert square == tall == 60.0
    wide = kept_views.key_of(0, (1, 0, 0), (0, 0, 0), WIDE, 16 / 9).fov
    assert math.tan(math.radians(wide / 2)) == pytest.approx(16 / 9 * math.tan(WIDE / 2), rel=1e-3)  # rounded to 0.01
    assert kept_views.key_of(0, (1, 0, 0), (0, 0, 0), 3.1, 4.0).fov == kept_views.MOST_FOV


def test_a_file_that_is_none_of_ours_is_left_alone(tmp_path):
    (tmp_path / kept_views.FILE).write_text("[1]")
    with pytest.raises(InputRejected):
        kept_views.keep(tmp_path, kept_views.key_of(0, (1, 0, 0), (0, 0, 0), WIDE, 1.0))
    assert (tmp_path / kept_views.FILE).read_text() == "[1]"


def test_edits_are_listed_in_words_the_last_one_first():
    assert in_words([]) == "No edits."
    told = in_words([("set a = 1", False), ("add [x](http://y) <b>", True)])
    assert told.splitlines() == [r"- ~~add \[x\]\(http://y\) \<b\>~~ (undone)", "- set a = 1"]
    many = in_words([(f"edit {k}", False) for k in range(SHOWN + 3)]).splitlines()
    assert many[0] == f"- edit {SHOWN + 2}" and many[-1] == "- and 3 before them"
