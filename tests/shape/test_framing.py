"""What a mask says against itself is told: fluid on all sides, fluid that is gone between others."""

import numpy as np
import pytest

from fluidlift.shape.framing import framing_warnings

ALWAYS = np.ones(5)


def test_a_fluid_that_leaves_background_on_one_side_needs_no_word():
    mask = np.ones((40, 60), bool)
    mask[:5] = False
    assert framing_warnings(mask, ALWAYS) == []


def test_a_fluid_that_touches_all_borders_at_a_corner_only_needs_no_word():
    mask = np.zeros((40, 60), bool)
    mask[:20], mask[:, :20] = True, True
    mask[-1, -1] = True
    assert framing_warnings(mask, ALWAYS) == []


@pytest.mark.parametrize(("hole", "said"), [(0, "whole picture"), (10, "all four borders")])
def test_a_fluid_on_all_sides_is_told(hole, said):
    mask = np.ones((40, 60), bool)
    mask[20 : 20 + hole, 20 : 20 + hole] = False
    (warning,) = framing_warnings(mask, ALWAYS)
    assert said in warning


def test_frames_without_fluid_count_only_between_others():
    mask = np.zeros((40, 60), bool)
    mask[10:20] = True
    assert framing_warnings(mask, np.array([0.0, 0, 5, 7, 0])) == []  # it comes late and goes early
    (warning,) = framing_warnings(mask, np.array([0.0, 5, 0, 0, 7, 0]))
    assert "2 frame(s)" in warning and "(2, 3)" in warning
