"""Reading in another process: what a reader may do to itself it does not do to the program."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time

import cv2
import hostile_readers
import numpy as np
import pytest
from small_asset import small_mesh

from fluidlift.errors import InputRejected
from fluidlift.io import confined
from fluidlift.io.confined import Bounds, Child, read_confined, reading_here
from fluidlift.io.environments import read_environment_image
from fluidlift.io.export_mesh import write_glb
from fluidlift.io.exr import read_channels
from fluidlift.io.exr_write import write_channels
from fluidlift.io.limits import ReadLimits
from fluidlift.io.pictures import read_picture
from fluidlift.io.read_mesh import read_any_mesh

TIGHT = Bounds(memory=2**28, seconds=1, patience=20.0)


@pytest.fixture
def file(tmp_path):
    (tmp_path / "a.png").write_bytes(b"x")
    return tmp_path / "a.png"


def test_what_a_reader_gives_comes_back_as_it_was(file):
    found = read_confined(hostile_readers.named, file)
    wanted = hostile_readers.named(file, ReadLimits())
    assert list(found) == list(wanted)
    for name, array in wanted.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
    mesh, plain = read_confined(hostile_readers.mesh, file), hostile_readers.mesh(file, ReadLimits())
    assert mesh.colors is None
    for part in ("vertices", "faces", "uv", "texture"):
        np.testing.assert_array_equal(getattr(mesh, part), getattr(plain, part))
    assert read_confined(hostile_readers.limited, file, ReadLimits(max_pixels=7)).tolist() == [7, 2000]
    array = read_confined(hostile_readers.talking, file)
    array[0] = 5  # it may be written
    assert array.tolist() == [5, 1, 2]


@pytest.mark.parametrize(
    ("reader", "bounds", "words"),
    [
        (hostile_readers.hungry, TIGHT, "reading 'a.png' takes more than 0.25 GB of memory"),
        (hostile_readers.sparse, TIGHT, "reading 'a.png' takes more than 0.25 GB of memory"),
        (hostile_readers.endless, TIGHT, "reading 'a.png' takes more than 1 s of processor time"),
        (hostile_readers.asleep, Bounds(patience=1.0), "reading 'a.png' takes more than 1 s"),
        (hostile_readers.aborting, TIGHT, r"'a.png' makes its reader crash \(SIGABRT\)"),
        (hostile_readers.leaving, TIGHT, r"'a.png' makes its reader crash \(exit code 0\)"),
        (hostile_readers.objects, TIGHT, "reading 'a.png' gave nonsense|makes its reader crash"),
        (hostile_readers.failing, TIGHT, r"'a.png' cannot be read \(ZeroDivisionError: by nothing\)"),
        (hostile_readers.refusing, TIGHT, "^'a.png' is blue. Needed: red. Do: paint it.$"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_reader_that_goes_wrong_ends_in_one_line_and_the_next_file_is_read(file, reader, bounds, words):
    with pytest.raises(InputRejected, match=words) as refused:
        read_confined(reader, file, bounds=bounds)
    assert "\n" not in str(refused.value)
    assert refused.value.do
    assert read_confined(hostile_readers.limited, file).tolist() == [8192 * 4320, 2000]


def test_a_fault_of_the_reader_keeps_its_traceback(file):
    with pytest.raises(InputRejected) as refused:
        read_confined(hostile_readers.failing, file)
    assert "hostile_readers.py" in refused.value.__notes__[0]


def test_one_child_reads_all_files_until_it_breaks(file):
    first, second = (int(read_confined(hostile_readers.whoami, file)[0]) for _ in range(2))
    assert first == second != os.getpid()
    with pytest.raises(InputRejected):
        read_confined(hostile_readers.aborting, file)
    assert int(read_confined(hostile_readers.whoami, file)[0]) != first
    with reading_here():
        assert int(read_confined(hostile_readers.whoami, file)[0]) == os.getpid()


def test_a_child_that_has_left_because_it_had_nothing_to_do_is_started_again(file):
    child = Child()
    before = int(child.read(hostile_readers.whoami, file, ReadLimits(), Bounds())[0])
    # as if it were asked in the moment in which it ends: its line is closed, and nobody has looked yet
    child._process.stdin.close()
    assert child._process.wait(10) == 0
    seen = iter([None])
    child._process.poll = lambda: next(seen, 0)
    with open(os.devnull, "wb") as nowhere:
        child._process.stdin = nowhere
        after = int(child.read(hostile_readers.whoami, file, ReadLimits(), Bounds())[0])
    child.end()
    assert after != before


def test_time_is_counted_for_each_file(file):
    child, spent = Child(), Bounds(seconds=1)  # a second more is let pass, as limits are whole seconds
    child.read(hostile_readers.whoami, file, ReadLimits(), spent)
    first = child._process
    for _ in range(25):  # in all it takes longer than one file may
        child.read(hostile_readers.busy, file, ReadLimits(), spent)
    assert child._process is first and first.poll() is None
    child.end()


def test_threads_get_their_own_answers(file):
    found: dict[int, list[int]] = {}

    def ask(pixels):
        found[pixels] = [int(read_confined(hostile_readers.limited, file, ReadLimits(pixels))[0]) for _ in range(20)]

    threads = [threading.Thread(target=ask, args=(n,)) for n in range(1, 6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {n: [n] * 20 for n in range(1, 6)}


def test_an_interrupted_request_leaves_no_answer_behind(file, monkeypatch):
    read_confined(hostile_readers.limited, file)

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(confined, "_received", interrupted)
        with pytest.raises(KeyboardInterrupt):
            read_confined(hostile_readers.limited, file)
    assert read_confined(hostile_readers.whoami, file).shape == (1,)


def alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_the_child_ends_with_its_parent(file, tmp_path):
    code = (
        "import sys, hostile_readers\nfrom pathlib import Path\nfrom fluidlift.io.confined import read_confined\n"
        f"print(int(read_confined(hostile_readers.whoami, Path({str(file)!r}))[0]), flush=True)\n"
        "import os, signal; os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    paths = os.pathsep.join(filter(None, sys.path))
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | {"PYTHONPATH": paths}
    )
    child, until = int(run.stdout), time.monotonic() + 10.0
    while alive(child) and time.monotonic() < until:
        time.sleep(0.1)
    assert not alive(child)


def test_modules_of_the_current_folder_are_not_run(file, tmp_path, monkeypatch):
    (tmp_path / "cv2.py").write_text("raise SystemExit(3)")
    (tmp_path / "json.py").write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    child = Child()
    assert child.read(hostile_readers.whoami, file, ReadLimits(), Bounds()).shape == (1,)
    child.end()


def test_pictures_meshes_and_light_are_read_there(tmp_path, monkeypatch):
    picture = np.random.default_rng(0).integers(0, 255, (20, 30, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), picture[..., ::-1])
    light = np.random.default_rng(1).uniform(1, 2, (32, 64)).astype(np.float32)
    write_channels(tmp_path / "a.exr", {"R": light, "G": light, "B": light})
    write_glb(tmp_path / "a.glb", small_mesh())
    readers = [(read_picture, "a.png"), (read_channels, "a.exr"), (read_environment_image, "a.exr"),
               (read_any_mesh, "a.glb")]  # fmt: skip
    for read, name in readers:
        asked: list[str] = []
        plain = Child.read

        def watched(self, reader, *rest, asked=asked, plain=plain):
            asked.append(reader.__name__)
            return plain(self, reader, *rest)

        monkeypatch.setattr(Child, "read", watched)
        there = read(tmp_path / name)
        monkeypatch.setattr(Child, "read", plain)
        assert len(asked) == 1, name
        with reading_here():
            here = read(tmp_path / name)
        for a, b in zip(_arrays(there), _arrays(here), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)


def _arrays(value):
    if isinstance(value, np.ndarray):
        return [value]
    parts = value if isinstance(value, dict) else vars(value)
    return [part for part in parts.values() if part is not None]
