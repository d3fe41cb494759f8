"""Parts and lines that are told of a fluid, in its picture."""

from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.pipeline.found_parts import ledge_lines, lines_of, outlines, parts_of
from fluidlift.shape.composite import BodyParts
from fluidlift.shape.filled_vessel import FilledVessel
from fluidlift.shape.kind import level_camera
from fluidlift.types import KindEvidence, PinholeCamera, UpEvidence, kind_of

SIZE = (80, 120)


def seen(kind="stream", *, chutes=(), vessel=None, ledges=None, motion=None, puddle=False):
    """What `pipeline.sight.sighted` leaves of a fluid in the lower half of the picture."""
    mask = np.zeros(SIZE, bool)
    mask[40:] = True
    camera = PinholeCamera.from_fov(50.0, SIZE[::-1])
    sight = SimpleNamespace(
        kind=kind_of(kind), kind_free=True, evidence=KindEvidence(kind, {kind: 0.8}, {}), mask=mask,
        motion=np.zeros((*SIZE, 2)) if motion is None else motion, trust=np.ones(SIZE),
        parts=BodyParts((), mask, puddle=puddle, ledges=ledges),
    )  # fmt: skip
    canonical = level_camera(camera, UpEvidence(20.0, 0.0, "", 0.0))
    return SimpleNamespace(seen=sight, front=SimpleNamespace(chutes=chutes, vessel=vessel), canonical=canonical)


def a_ledge():
    pixels = np.zeros(SIZE, bool)
    for column in range(30, 70):
        pixels[45 + (column - 30) // 10 : 60, column] = True
    return pixels


def test_what_lies_has_the_probability_of_its_kind():
    (part,) = parts_of(seen("fall"))
    assert (part.what, part.probability, part.area) == ("fall", 0.8, ())
    assert lines_of(seen("fall")) == ()


def test_a_ledge_is_as_sure_as_its_motion_agrees_and_has_a_crest_and_a_foot():
    motion = np.zeros((*SIZE, 2))
    motion[..., 1] = 2.0
    motion[:, 60:] = (3.0, 0.0)
    ledge = a_ledge()
    _, part = parts_of(seen(chutes=(ledge,), motion=motion))
    assert part.what == "ledge" and part.probability == pytest.approx(ledge[:, :60].sum() / ledge.sum())
    crest, foot = lines_of(seen(chutes=(ledge,), motion=motion))
    assert crest.what == "crest" and foot.what == "foot"
    assert [crest.points[0][1], crest.points[-1][1], foot.points[0][1]] == [45.0, 48.0, 60.0]
    assert parts_of(seen(chutes=(ledge,), ledges=ledge))[1].probability == 1.0


def test_a_pool_has_its_outline_as_its_level():
    (line,) = lines_of(seen("basin"))
    rows = np.array(line.points)[:, 1]
    assert line.what == "level" and line.points[0] == line.points[-1] and rows.min() == pytest.approx(40.5, abs=1.0)
    assert [p.what for p in parts_of(seen(puddle=True))] == ["stream", "pool"]


def test_a_vessel_has_walls_and_the_level_of_what_it_holds():
    heights = np.linspace(-0.6, -0.2, 8)
    vessel = FilledVessel((0.0, 1.5), heights, np.full(8, 0.3), -0.3)
    given = seen("pour", vessel=vessel)
    walls = parts_of(given)[1]
    level = np.array(lines_of(given)[0].points)
    middle, _ = given.canonical.project(np.array([[0.0, 1.5, -0.3]]))
    assert walls.what == "vessel" and 0.5 * (level[:, 0].min() + level[:, 0].max()) == pytest.approx(
        middle[0, 0], abs=0.5
    )
    assert np.ptp(level[:, 0]) > np.ptp(level[:, 1]) > 0  # a circle seen from above is an ellipse wider than tall
    area = np.array(walls.area)
    assert area[:, 1].min() < level[:, 1].mean() < area[:, 1].max()


def test_outlines_have_few_corners_and_small_pieces_are_left_out():
    mask = np.zeros(SIZE, bool)
    mask[10:40, 10:60], mask[70, 100] = True, True
    (line,) = outlines(mask)
    assert len(line) == 4
    assert ledge_lines(np.zeros(SIZE, bool)) == []
