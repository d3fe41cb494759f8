"""A checkpoint comes back bit for bit; one of another scene, another version, or from a stranger is refused."""

import io
import json
import zipfile

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.checkpoint import Checkpoint, differing_parts, read_checkpoint, read_parts, write_checkpoint

PARTS = {"grid": "a" * 64, "terrain": "b" * 64}


@pytest.fixture
def checkpoint():
    rng = np.random.default_rng(0)
    state = {
        "particles.positions": rng.normal(size=(50, 3)).astype(np.float32),
        "time": np.float64(0.1 + 0.2),
        "counts": np.array([3, 50], np.int64),
        "generator": np.frombuffer(b'{"state": 1}', np.uint8),
        "field": np.asfortranarray(rng.normal(size=(4, 3, 2))),
        "active": np.array([True, False]),
    }
    return Checkpoint(3, PARTS, state, {"volume": np.arange(3.0), "poses": np.zeros((3, 0, 7))})


@pytest.fixture
def file(tmp_path, checkpoint):
    return write_checkpoint(tmp_path / "work" / "simulation.npz", checkpoint)


def test_a_checkpoint_comes_back_bit_for_bit(file, checkpoint):
    found = read_checkpoint(file)
    assert (found.frames, found.parts) == (3, PARTS)
    for kept, back in ((checkpoint.state, found.state), (checkpoint.history, found.history)):
        assert set(kept) == set(back)
        for name, array in kept.items():
            assert back[name].dtype == np.asarray(array).dtype and back[name].shape == np.shape(array)
            np.testing.assert_array_equal(back[name], array)
    assert read_parts(file) == (3, PARTS)
    assert not [p for p in file.parent.iterdir() if p != file]


def test_what_differs_is_named():
    other = {"grid": "a" * 64, "terrain": "c" * 64, "obstacles": "d" * 64}
    assert differing_parts(PARTS, other) == ["obstacles", "terrain"]
    assert differing_parts(PARTS, dict(PARTS)) == []


def test_a_write_that_fails_leaves_the_checkpoint_before(file, checkpoint, monkeypatch):
    before = file.read_bytes()

    def broken(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez", broken)
    with pytest.raises(KeyboardInterrupt):
        write_checkpoint(file, checkpoint)
    assert file.read_bytes() == before and list(file.parent.iterdir()) == [file]


def rewritten(file, change, packing=zipfile.ZIP_STORED):
    """The same archive with its members changed by `change(name, data) -> data`."""
    with zipfile.ZipFile(file) as archive:
        members = {m.filename: archive.read(m) for m in archive.infolist()}
    with zipfile.ZipFile(file, "w", packing) as archive:
        for name, data in members.items():
            archive.writestr(name, change(name, data))


def array_bytes(array):
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def header(**changes):
    head = {"format": "fluidlift checkpoint", "version": 1, "frames": 3, "parts": PARTS} | changes
    return array_bytes(np.frombuffer(json.dumps(head).encode(), np.uint8))


@pytest.mark.parametrize(
    ("changes", "word"),
    [({"version": 2}, "version 2"), ({"format": "other"}, "another format"), ({"frames": -1}, "frames"),
     ({"frames": 4}, "another length"), ({"frames": "3"}, "frames"), ({"parts": [1]}, "parts")],
)  # fmt: skip
def test_another_version_or_a_header_that_contradicts_itself_is_refused(file, changes, word):
    rewritten(file, lambda name, data: header(**changes) if name == "header.npy" else data)
    with pytest.raises(InputRejected, match=word):
        read_checkpoint(file)


def test_pickles_are_refused_without_being_opened(file):
    class Trap:
        def __reduce__(self):
            return (exec, ("raise AssertionError('the pickle was opened')",))

    trap = np.array([Trap()], dtype=object)
    stream = io.BytesIO()
    np.save(stream, trap, allow_pickle=True)
    rewritten(file, lambda name, data: stream.getvalue() if name == "state.field.npy" else data)
    with pytest.raises(InputRejected, match="cannot be read"):
        read_checkpoint(file)


def test_an_array_that_promises_more_than_it_has_takes_no_memory(file):
    huge = array_bytes(np.zeros(2)).replace(b"(2,), ", b"(99999999999,), ").replace(b" " * 10 + b"\n", b"\n")
    rewritten(file, lambda name, data: huge if name == "state.field.npy" else data)
    with pytest.raises(InputRejected, match="promises 799999999992 bytes"):
        read_checkpoint(file)


def test_more_than_a_scene_can_need_is_refused_before_it_is_unpacked(file):
    rewritten(
        file,
        lambda name, data: array_bytes(np.zeros(10**6)) if name == "state.field.npy" else data,
        zipfile.ZIP_DEFLATED,
    )
    assert file.stat().st_size < 10**5  # zeros, packed
    with pytest.raises(InputRejected, match="unpacks to too much"):
        read_checkpoint(file, max_bytes=10**6)


@pytest.mark.parametrize("size", [0, 10, 300])
def test_a_damaged_file_is_refused(file, size):
    file.write_bytes(file.read_bytes()[:size])
    with pytest.raises(InputRejected, match=r"simulation\.npz"):
        read_checkpoint(file)


def test_a_link_or_nothing_is_refused(file, tmp_path):
    link = tmp_path / "link.npz"
    link.symlink_to(file)
    with pytest.raises(InputRejected, match="link"):
        read_checkpoint(link)
    with pytest.raises(InputRejected, match="no checkpoint"):
        read_parts(tmp_path / "nothing.npz")


def test_text_is_no_state(tmp_path, checkpoint):
    bad = Checkpoint(3, PARTS, checkpoint.state | {"text": np.array(["a"])}, checkpoint.history)
    with pytest.raises(ValueError, match="text"):
        write_checkpoint(tmp_path / "x.npz", bad)
