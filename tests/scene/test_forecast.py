"""What is told before a simulation: how many frames, in place of which, how much disk, how long."""

import pytest

from fluidlift.scene.forecast import ahead, in_time


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "frames" / "splats").mkdir(parents=True)
    for number in range(1001, 1041):
        (tmp_path / "frames" / "splats" / f"{number}.flsp").write_bytes(b"FLSP")
    return tmp_path


def manifest(seconds, frames=40):
    return {"metrics": {"stages": {"simulate": {"seconds": seconds}}}, "simulation": {"frames": frames}}


def test_a_shorter_simulation_says_what_it_takes_the_place_of(folder):
    told = ahead(folder, {}, 5, 0.04, 100_000)
    assert told == "simulating 5 frames (0.2 s) in place of the 40 on disk: about 9 MB of disk"
    assert "in place of" not in ahead(folder, {}, 40, 0.04, 100_000)


def test_the_time_of_the_last_simulation_says_how_long_the_next_takes(folder):
    told = ahead(folder, manifest(80.0), 400, 0.04, 100_000)
    assert told.endswith("(16 s): about 720 MB of disk, and 13 min if each takes as long as the last time")


@pytest.mark.parametrize("found", [{}, manifest(None), manifest("long"), manifest(1.0, 0), manifest(0.0), manifest(-1)])
def test_where_no_time_is_known_none_is_told(folder, found):
    assert "last time" not in ahead(folder, found, 5, 0.04, 1000)


def test_times_are_told_in_the_unit_that_fits():
    assert [in_time(s) for s in (0.1, 89, 90, 3600, 7200)] == ["1 s", "89 s", "2 min", "60 min", "2.0 h"]
