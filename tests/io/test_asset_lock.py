"""One process at a time writes an asset, and a lock ends with the process that held it."""

import os

import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.asset_lock import WRITING, editing, require_not_written, writer_of, writing


def test_a_second_writer_is_told_who_the_first_one_is(tmp_path):
    with writing(tmp_path, "a simulation"):
        assert (writer_of(tmp_path).pid, writer_of(tmp_path).work) == (os.getpid(), "a simulation")
        with pytest.raises(InputRejected, match=rf"a simulation \(process {os.getpid()}\)"), writing(tmp_path, "a fit"):
            pass
    assert writer_of(tmp_path) is None
    with writing(tmp_path, "a fit"):
        assert writer_of(tmp_path).work == "a fit"


def test_the_lock_of_a_killed_process_is_gone(tmp_path):
    child = os.fork()
    if child == 0:
        with writing(tmp_path, "a simulation"):
            os._exit(9)
    os.waitpid(child, 0)
    assert (tmp_path / WRITING).is_file()  # what it wrote there is still there, and means nothing
    assert writer_of(tmp_path) is None
    require_not_written(tmp_path)


def test_looking_is_no_holding(tmp_path):
    assert writer_of(tmp_path) is None
    assert list(tmp_path.iterdir()) == []


def test_an_error_inside_ends_the_lock(tmp_path):
    with pytest.raises(ZeroDivisionError), editing(tmp_path):
        raise ZeroDivisionError
    with editing(tmp_path, wait=0.0):
        pass


def test_a_lock_that_is_a_link_is_refused(tmp_path):
    (tmp_path / "other").write_text("precious")
    (tmp_path / "work").mkdir()
    (tmp_path / WRITING).symlink_to(tmp_path / "other")
    with pytest.raises(InputRejected, match="link"), writing(tmp_path, "a simulation"):
        pass
    assert (tmp_path / "other").read_text() == "precious"
