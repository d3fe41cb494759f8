"""hints.yaml: what is written is read again, and what is not meant is refused where it stands."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.hints_file import (
    content_hash,
    hints_beside,
    hints_data,
    hints_text,
    parse_hints,
    read_found,
    read_hints,
    require_same_clip,
    write_hints,
)
from fluidlift.types.hints import Arrow, Click, ClipHints, ClipIdentity, Region, Rim, Ruler

CLIP = {"name": "river.mp4", "size": [640, 360], "frames": 75}
ALL = ClipHints(
    ClipIdentity("river.mp4", (640, 360), 75, "ab" * 32),
    start=0.5,
    duration=2.0,
    kind="pour",
    fov=60.0,
    horizon=((-20.0, 100.5), (700.0, 96.0)),
    ruler=Ruler((10.0, 20.0), (110.0, 20.0), 1.5),
    rims=(Rim((300.0, 200.0), (80.0, 30.0), -4.0),),
    regions=(
        Region("fluid", ((1.0, 2.0), (50.0, 2.0), (50.0, 40.0))),
        Region("rock", ((5.0, 5.0), (9.0, 9.0)), width=6.0, time=0.4, moves=True),
        Region("ledge", ((20.0, 5.0), (30.0, 5.0), (30.0, 12.0))),
        Region("pool", ((20.0, 15.0), (30.0, 15.0), (30.0, 22.0)), begins=0.5, ends=1.25),
    ),
    clicks=(Click((64.0, 48.0), True), Click((3.0, 4.0), False)),
    roi=(0.0, 10.0, 600.0, 300.0),
    flow=(Arrow((100.0, 200.0), (160.0, 220.0)), Arrow((300.0, 200.0), (360.0, 190.0))),
    level=((50.0, 90.0), (600.0, 88.0)),
)


def parsed(**entries):
    return parse_hints({"hints": 1, "clip": CLIP} | entries)


def test_what_is_written_is_read_again(tmp_path):
    file = write_hints(tmp_path / "a.hints.yaml", ALL, {"kind": "stream", "mask": [{"is": "fluid"}]})
    assert read_hints(file) == ALL
    assert read_found(file)["kind"] == "stream"


def test_what_was_found_is_no_hint():
    assert parse_hints({"hints": 1, "found": {"kind": "dam", "anything": [1, 2]}}) == ClipHints()


def test_a_region_stands_in_one_line():
    lines = hints_text(ALL).splitlines()
    assert "- {is: fluid, area: [[1.0, 2.0], [50.0, 2.0], [50.0, 40.0]]}" in lines
    assert "kind: pour" in lines


@pytest.mark.parametrize(
    ("entries", "word"),
    [
        ({"colour": "red"}, "unknown entry 'colour'"),
        ({"kind": "soup"}, "kind = soup"),
        ({"ledge": [[1, 2], [3, 4]]}, "is: ledge, area"),
        ({"pool": [[1, 2], [3, 4]]}, "is: pool, area"),
        ({"flow": [[1, 2, 3, 4]]}, r"flow\[1\] is no mapping"),
        ({"flow": [{"at": [1, 2]}]}, r"flow\[1\].to = None"),
        ({"flow": [{"at": [1, 2], "to": [2, 2]}]}, r"flow\[1\] has no direction"),
        ({"flow": [{"at": [1, 2], "to": [9, 2], "speed": 3}]}, r"unknown entry 'flow\[1\].speed'"),
        ({"flow": {"at": [1, 2], "to": [9, 2]}}, "flow is no list"),
        ({"level": [[1, 2], [3, 4], [5, 6]]}, "3 points of a level"),
        ({"level": [[5, 1], [5, 200]]}, "two points beside each other"),
        ({"horizon": [[0, 1], [10, 2]], "pitch": 30}, "two horizons: one drawn, and a pitch"),
        ({"pitch": 91}, "pitch = 91"),
        ({"horizon": [[0, 1], [10, 2], [20, 3]]}, "one horizon: two points"),
        ({"horizon": [[5, 1], [5, 200]]}, "two points beside each other"),
        ({"ruler": {"from": [0, 0], "to": [1, 0], "metres": 1}}, "at least 2 px apart"),
        ({"ruler": {"from": [0, 0], "to": [50, 0]}}, "and metres"),
        ({"regions": [{"is": "fluid", "area": [[0, 0], [1, 1]]}]}, r"regions\[1\] has 2 points"),
        ({"regions": [{"is": "fluid", "brush": [[0, 0]]}]}, "'brush' and 'width'"),
        ({"regions": [{"is": "mud", "area": []}]}, r"regions\[1\].is = mud"),
        ({"regions": [{"is": "rock", "area": [[0, 0], [9, 0], [9, "x"]]}]}, "a number from"),
        (
            {"regions": [{"is": "rock", "brush": [[0, 0]], "width": 4, "from": 2, "until": 1}]},
            "an end after its beginning",
        ),
        ({"clicks": [{"at": [1, 2]}]}, "fluid: true or false"),
        ({"start": -1}, "start = -1"),
        ({"fov": ".nan"}, "fov = .nan"),
        ({"roi": [1, 2, 3]}, "4 numbers"),
        ({"rims": [{"center": [1, 2], "axes": [9, 0]}]}, "half the length"),
        ({"regions": [{"is": "rock", "area": [[0, 0]] * 2001}]}, "3 to 2000"),
    ],
)
def test_what_is_not_meant_is_refused_where_it_stands(entries, word):
    with pytest.raises(InputRejected, match=word):
        parsed(**entries)


def test_two_horizons_are_refused(tmp_path):
    (tmp_path / "h.yaml").write_text("hints: 1\nhorizon: [[0, 1], [9, 1]]\nhorizon: [[0, 5], [9, 5]]\n")
    with pytest.raises(InputRejected, match="line 3: 'horizon' twice"):
        read_hints(tmp_path / "h.yaml")


def test_points_need_the_size_that_they_are_counted_in():
    for drawn in ({"horizon": [[0, 1], [9, 1]]}, {"flow": [{"at": [0, 1], "to": [9, 1]}]}, {"level": [[0, 1], [9, 1]]}):
        with pytest.raises(InputRejected, match="without the size of the picture"):
            parse_hints({"hints": 1} | drawn)


def test_a_file_that_is_no_hints_file_is_told():
    with pytest.raises(InputRejected, match="no line 'hints: 1'"):
        parse_hints({"shape": {"kind": "pour"}})


def test_hints_of_another_clip_are_refused_and_a_renamed_one_is_the_same(tmp_path):
    clip = tmp_path / "river.mp4"
    clip.write_bytes(b"water")
    hints = replace(ALL, clip=ClipIdentity("river.mp4", (640, 360), 75, content_hash(clip)))
    require_same_clip(hints, clip.rename(tmp_path / "brook.mp4"), "h.yaml")
    (tmp_path / "other.mp4").write_bytes(b"milk")
    with pytest.raises(InputRejected, match=r"belongs to another clip than 'other.mp4'"):
        require_same_clip(hints, tmp_path / "other.mp4", "h.yaml")


def test_a_sequence_is_known_by_its_pictures_whether_named_by_folder_or_pattern(tmp_path):
    for number in (1, 2):
        cv2.imwrite(str(tmp_path / f"{number:04d}.png"), np.full((16, 16, 3), 40 * number, np.uint8))
    before = content_hash(tmp_path)
    assert content_hash(tmp_path / "%04d.png") == before
    cv2.imwrite(str(tmp_path / "0002.png"), np.zeros((16, 16, 3), np.uint8))
    assert content_hash(tmp_path) != before


def test_hints_lie_beside_their_clip(tmp_path):
    assert hints_beside(tmp_path / "river.mp4") == tmp_path / "river.hints.yaml"
    assert hints_beside(tmp_path / "shot" / "%04d.png") == tmp_path / "shot.hints.yaml"


def test_all_points_move_together_and_nothing_else_does():
    moved = ALL.moved((3.0, -2.0))
    assert moved.has_points and not ClipHints(ALL.clip, kind="dam").has_points
    assert moved.horizon == tuple((x + 3.0, y - 2.0) for x, y in ALL.horizon)
    assert moved.regions[1].line[0] == (ALL.regions[1].line[0][0] + 3.0, ALL.regions[1].line[0][1] - 2.0)
    assert moved.regions[1].width == ALL.regions[1].width and moved.rims[0].axes == ALL.rims[0].axes
    assert moved.roi[2:] == ALL.roi[2:] and moved.ruler.metres == ALL.ruler.metres
    back = moved.moved((-3.0, 2.0))
    assert hints_data(back) == hints_data(ALL)


def test_points_follow_the_picture_and_another_shape_is_refused():
    half = ALL.at((320, 180))
    assert half.horizon == ((-10.0, 50.25), (350.0, 48.0))
    assert half.flow[0] == Arrow((50.0, 100.0), (80.0, 110.0)) and half.level == ((25.0, 45.0), (300.0, 44.0))
    assert half.regions[1].width == 3.0 and half.rims[0].axes == (40.0, 15.0)
    assert half.clip.sha256 == ALL.clip.sha256
    with pytest.raises(InputRejected, match="640 x 360 picture for a clip of 320 x 320"):
        ALL.at((320, 320))


def test_a_camera_that_looks_straight_down_is_said_by_a_number():
    hints = parse_hints({"hints": 1, "pitch": 90})
    assert hints.settings == {"shape.pitch": 90.0} and hints_data(hints) == {"hints": 1, "pitch": 90.0}


def test_data_leave_out_what_was_not_said():
    assert hints_data(ClipHints(kind="dam")) == {"hints": 1, "kind": "dam"}
