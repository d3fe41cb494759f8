"""Views that a person writes."""

import json

import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.views import read_view
from fluidlift.types import PinholeCamera, ViewKey


def test_keys_count_from_the_first_frame_of_an_asset(tmp_path):
    path = tmp_path / "view.json"
    keys = [
        {"frame": 1001, "eye": [0, -3, 1], "target": [0, 0, 0]},
        {"frame": 1011, "eye": [1, -3, 1], "target": [0, 0, 0], "fov": 55},
    ]
    path.write_text(json.dumps({"keys": keys}))
    assert read_view(path) == [ViewKey(0, (0, -3, 1), (0, 0, 0), 40), ViewKey(10, (1, -3, 1), (0, 0, 0), 55)]


def test_a_camera_file_is_a_standing_view(tmp_path):
    camera = PinholeCamera.looking((0, -3, 1), (0, 0, 0), 50.0, (64, 48))
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(camera.to_dict()))
    found = read_view(path)
    assert isinstance(found, PinholeCamera) and found.size == (64, 48)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"keys": []}, "holds no view"),
        ({"keys": [{"frame": 1001, "eye": [0, 0], "target": [0, 0, 0]}]}, "key 1"),
        ({"keys": [{"frame": 1001, "eye": [0, 0, 1], "target": [0, 0, 1]}]}, "eye beside its target"),
        ({"keys": [{"frame": 1001, "eye": [0, 0, float("nan")], "target": [0, 0, 1]}]}, "key 1"),
        ({"keys": [{"frame": 1001, "eye": [0, 0, 2], "target": [0, 0, 1], "lens": 3}]}, "key 1"),
        ({"keys": [{"frame": 1001, "eye": [0, 0, 2], "target": [0, 0, 1]}] * 2}, "two keys of one frame"),
        ([1, 2], "holds no view"),
    ],
)
def test_what_is_no_view_is_refused_with_its_place(tmp_path, content, words):
    path = tmp_path / "view.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputRejected, match=words):
        read_view(path)
