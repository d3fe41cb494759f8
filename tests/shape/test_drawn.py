"""What a person drew: pixels of it, carried by the flow, and what a horizon, a rim and a ruler say."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.shape.composite import LEVEL_SAID, BodyParts, level_prior, unused_marks, with_marks
from fluidlift.shape.drawn import LABELS, carried, drawn_pixels, frame_at
from fluidlift.shape.kind import level_camera
from fluidlift.shape.registration import ruler_scale
from fluidlift.shape.surface import FrontSurface
from fluidlift.shape.view import drawn_rim, horizon_line, sky_of, tilt_of_horizon
from fluidlift.shape.view.roundness import roundness_evidence
from fluidlift.types import Label, PinholeCamera, UpEvidence
from fluidlift.types.hints import ClipHints, Region, Ruler

LENS = PinholeCamera.from_fov(50.0, (320, 240))


def test_an_area_holds_the_pixels_inside_and_a_brush_those_under_it():
    area = drawn_pixels([(10.0, 10.0), (30.0, 10.0), (30.0, 20.0), (10.0, 20.0)], None, (40, 50))
    rows, columns = np.nonzero(area)
    assert abs(area.sum() - 200) <= 31 and rows.min() in (9, 10) and columns.max() in (29, 30)
    brush = drawn_pixels([(10.0, 20.0), (40.0, 20.0)], 8.0, (40, 50))
    assert brush[20, 6:44].all() and not brush[27].any() and 6 <= brush[:, 25].sum() <= 10
    assert drawn_pixels([(5.0, 5.0)], 4.0, (40, 50)).any()


def test_a_region_far_outside_the_picture_draws_nothing():
    assert not drawn_pixels([(-1e6, -1e6), (-9e5, -1e6), (-1e6, -9e5)], None, (40, 50)).any()


def test_what_moves_goes_with_the_flow_both_ways():
    mask = np.zeros((40, 60), bool)
    mask[10:20, 20:30] = True
    flow = np.zeros((4, 40, 60, 2), np.float16)
    flow[..., 0] = 3.0
    found = dict(carried(mask, flow, 2))
    assert sorted(found) == [0, 1, 2, 3, 4]
    for t, there in found.items():
        assert there.sum() == 100 and np.nonzero(there)[1].min() == 20 + 3 * (t - 2)


def test_what_leaves_the_picture_is_gone():
    mask = np.zeros((40, 60), bool)
    mask[10:20, 50:60] = True
    flow = np.full((2, 40, 60, 2), (12.0, 0.0), np.float16)
    assert not dict(carried(mask, flow, 0))[1].any()


def test_the_frame_of_a_time_is_the_nearest():
    assert frame_at(np.array([0.0, 0.1, 0.25]), 0.2) == 2
    assert frame_at(np.array([0.0, 0.1, 0.25]), 9.0) == 2


@pytest.mark.parametrize(("pitch", "roll"), [(12.0, 0.0), (-5.0, 3.0), (40.0, -7.0), (70.0, 2.0)])
def test_a_drawn_horizon_is_the_tilt_that_sees_it_there(pitch, roll):
    line = horizon_line(level_camera(LENS, UpEvidence(pitch, roll, "", 0.0)))
    assert tilt_of_horizon(LENS, line) == pytest.approx((pitch, roll), abs=1e-6)


def test_a_drawn_rim_speaks_for_the_tilt_at_which_it_is_round():
    def evidence(pitch):
        return roundness_evidence(level_camera(LENS, UpEvidence(pitch, 0.0, "", 0.0)), [rim])

    rim = drawn_rim((160.0, 120.0), (60.0, 30.0), 0.0)  # half as wide as long: seen from 30 degrees above
    assert max(range(5, 85, 5), key=evidence) == 30


def test_marked_sky_ends_at_its_lowest_marked_row():
    sky = np.zeros((40, 60), bool)
    sky[:12, 20:50] = True
    found = sky_of(sky)
    assert found is not None and (found.border[:, 1] == 12).all() and len(found.border) == 30
    assert sky_of(np.zeros((4, 4), bool)) is None


def test_a_ruler_on_the_ground_gives_metres_per_unit():
    camera = level_camera(LENS, UpEvidence(30.0, 0.0, "", 0.0))
    ground = np.array([[x, y, -1.0] for x in (-1.0, 0.0, 1.0) for y in (1.0, 2.0, 3.0)])
    ends, _ = camera.project(np.array([[-0.5, 2.0, -1.0], [0.5, 2.0, -1.0]]))
    found = ruler_scale(camera, ground, Ruler(tuple(ends[0]), tuple(ends[1]), 3.0))
    assert found.value == pytest.approx(3.0) and found.source == "ruler" and "ruler" in found.sentence
    with pytest.raises(InputRejected, match="horizon"):
        ruler_scale(camera, ground, Ruler((160.0, -400.0), (200.0, -400.0), 3.0))


MARKED = ClipHints(regions=(
    Region("ledge", ((10.0, 5.0), (30.0, 5.0), (30.0, 15.0), (10.0, 15.0))),
    Region("pool", ((10.0, 20.0), (30.0, 20.0), (30.0, 30.0))),
))  # fmt: skip


def test_marked_ledges_and_pools_belong_to_the_parts_of_a_stream():
    mask = np.zeros((40, 60), bool)
    mask[:, 20:] = True
    parts = with_marks(BodyParts((), mask), MARKED.view, mask)
    assert parts.ledges is not None and parts.ledges[5:15, 20:30].all()
    drawn = drawn_pixels(MARKED.regions[0].line, None, (40, 60))
    assert (parts.ledges == drawn & mask).all() and parts.ledges.sum() < drawn.sum()
    assert (parts.gentle == ~parts.ledges).all()
    still = np.zeros((40, 60, 2))
    assert level_prior(parts, still, np.ones((40, 60))) == LEVEL_SAID
    assert with_marks(BodyParts((), mask), None, mask) == BodyParts((), mask)
    front = FrontSurface(np.ones((40, 60), np.float32), np.zeros((40, 60), np.float32), None)
    assert [w.code for w in unused_marks(parts, front)] == ["ledge-not-used"]
    assert unused_marks(parts, replace(front, chutes=(mask,))) == [] == unused_marks(BodyParts((), mask), front)
    assert level_prior(BodyParts((), mask), still, np.ones((40, 60))) < LEVEL_SAID
    assert all(LABELS[word] == Label.FLUID for word in ("ledge", "pool"))
