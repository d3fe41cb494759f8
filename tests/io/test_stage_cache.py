"""Kept results: packed where that pays, bounded where a stranger may have written them."""

import io
import zipfile

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.array_archive import members_of, most_unpacked, packs_to, write_packed_arrays
from fluidlift.io.stage_cache import Scratch, load_stage, save_stage


def noise(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=shape).astype(np.float32)


def test_arrays_come_back_as_they_were_and_masks_take_a_hundredth(tmp_path):
    arrays = {
        "mask": np.zeros((40, 100, 100), bool), "noise": noise(300, 3), "none": np.zeros((0, 3)), "one": np.array(3),
        "columns": np.asfortranarray(noise(50, 4)), "words": np.array(["a", "bc"]),
        "faces": np.arange(3000).reshape(-1, 3),
    }  # fmt: skip
    save_stage(tmp_path, "geometry", "k", arrays, {"n": 1})
    found = load_stage(tmp_path, "geometry", "k")
    assert found is not None and found[1] == {"n": 1}
    for name, array in arrays.items():
        assert found[0][name].dtype == array.dtype
        np.testing.assert_array_equal(found[0][name], array)
    with zipfile.ZipFile(tmp_path / "work" / "geometry" / "k.npz") as archive:
        sizes = {m.filename: (m.compress_size, m.file_size) for m in archive.infolist()}
    assert sizes["mask..npy"][0] < sizes["mask..npy"][1] / 100
    assert sizes["noise..npy"][0] == sizes["noise..npy"][1]  # packing would cost time for nothing


def test_labels_of_a_clip_are_packed_and_stay_mapped_for_who_made_them_and_pictures_keep_their_file(tmp_path):
    scratch = Scratch(tmp_path, "segment")
    labels, frames = scratch.array("labels", (50, 64, 64), np.uint8), scratch.array("frames", (5, 64, 64, 3), np.uint8)
    labels[:, 20:40] = 1
    frames[:] = np.random.default_rng(0).integers(0, 256, frames.shape)
    save_stage(tmp_path, "segment", "k", {"labels": labels, "frames": frames}, {}, scratch=scratch)
    place = tmp_path / "work" / "segment"
    assert sorted(p.name for p in place.iterdir()) == ["k.frames.npy", "k.json", "k.npz"]
    assert (place / "k.npz").stat().st_size < labels.nbytes / 20
    assert labels[3, 30, 5] == 1 and labels[49, 50, 63] == 0  # its file is gone, its map is not
    found = load_stage(tmp_path, "segment", "k")
    assert found is not None
    np.testing.assert_array_equal(found[0]["labels"], labels)
    np.testing.assert_array_equal(found[0]["frames"], frames)
    found[0]["labels"][0, 0, 0] = 7  # a copy: what is kept stays
    assert load_stage(tmp_path, "segment", "k")[0]["labels"][0, 0, 0] == 0


def test_what_would_unpack_to_more_than_is_believed_is_not_packed(tmp_path, monkeypatch):
    monkeypatch.setattr("fluidlift.io.array_archive._MAX_ARRAYS", 10_000)
    with (tmp_path / "a.npz").open("w+b") as file:
        write_packed_arrays(file, {"a": np.zeros(100_000, np.uint8)})
    size = (tmp_path / "a.npz").stat().st_size
    assert size > 100_000 and most_unpacked(size) > 100_000
    with np.load(tmp_path / "a.npz") as found:
        np.testing.assert_array_equal(found["a"], np.zeros(100_000, np.uint8))


def test_a_cache_that_unpacks_to_more_than_ours_do_counts_as_none(tmp_path, monkeypatch):
    save_stage(tmp_path, "geometry", "k", {"a": np.zeros(100_000, np.uint8)}, {})
    monkeypatch.setattr("fluidlift.io.array_archive._MAX_ARRAYS", 10_000)
    assert load_stage(tmp_path, "geometry", "k") is None


def test_an_archive_tells_its_size_before_it_is_unpacked():
    data = io.BytesIO()
    np.savez_compressed(data, a=np.zeros(10**7, np.uint8))
    with zipfile.ZipFile(data) as archive, pytest.raises(InputRejected, match="unpacks to too much"):
        members_of(archive, 10**6)


@pytest.mark.parametrize(
    ("array", "wanted"),
    [(noise(1000, 3), False), (np.zeros(1000), True), (np.zeros(0), False), (np.arange(9000) % 251, True),
     (noise(100, 100).T[::2], False)],
)  # fmt: skip
def test_a_glance_tells_whether_packing_pays(array, wanted):
    assert packs_to(array, 0.75) is wanted


def test_a_result_that_takes_the_place_of_one_with_more_files_leaves_none_behind(tmp_path):
    scratch = Scratch(tmp_path, "read")
    frames = scratch.array("frames", (100, 3), np.float32)
    frames[:] = noise(100, 3)
    save_stage(tmp_path, "read", "k", {"frames": frames}, {}, scratch=scratch)
    save_stage(tmp_path, "read", "k", {"frames": np.zeros((100, 3))}, {})
    assert sorted(p.name for p in (tmp_path / "work" / "read").iterdir()) == ["k.json", "k.npz"]
