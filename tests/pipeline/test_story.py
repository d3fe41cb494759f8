"""A story runs what has changed and takes the rest from its cache."""

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.pipeline.story import Result, Silence, Story, content_hash, file_hash, peak_memory_mb

STAGES = ("one", "two", "three")


class Workshop:
    """Three stages, each building on the one before, that count how often they work."""

    def __init__(self, folder):
        self.folder, self.done = folder, []

    def stage(self, name, value, story):
        def work():
            self.done.append(name)
            before = story["one"].arrays["x"] if name != "one" else np.zeros(3)
            return Result({"x": before + value}, {"value": value, "warnings": [f"{name} warns"] if value > 5 else []})

        return work

    def run(self, values=(1, 2, 3), *, force=(), still_there=None, stop_at=None):
        """Run all stages with one setting each; the story."""
        story = Story(self.folder, STAGES, force=frozenset(force), progress=Silence())
        self.done = []
        for name, value in zip(STAGES, values):
            after = STAGES[: STAGES.index(name)][-1:]
            work = self.stage(name, value, story)
            if name == stop_at:
                work = interrupted
            check = still_there if still_there and name == "two" else lambda result: True
            story.run(name, work, settings={"value": value}, after=after, still_there=check)
        return story


def interrupted():
    raise KeyboardInterrupt


@pytest.fixture
def workshop(tmp_path):
    w = Workshop(tmp_path / "x.fluid")
    w.run()
    assert w.done == ["one", "two", "three"]
    return w


def test_the_same_settings_are_not_worked_on_twice(workshop):
    story = workshop.run()
    assert workshop.done == []
    assert all(t["cached"] for t in story.timings.values())
    np.testing.assert_array_equal(story["three"].arrays["x"], [4.0, 4.0, 4.0])
    assert story["three"].meta["value"] == 3


def test_a_changed_setting_runs_its_stage_and_those_that_build_on_it(workshop):
    workshop.run((1, 7, 3))
    assert workshop.done == ["two", "three"]
    workshop.run((1, 7, 8))
    assert workshop.done == ["three"]


def test_a_change_upstream_reaches_the_end(workshop):
    story = workshop.run((5, 2, 3))
    assert workshop.done == ["one", "two", "three"]
    np.testing.assert_array_equal(story["three"].arrays["x"], [8.0, 8.0, 8.0])


def test_going_back_to_earlier_settings_is_free(workshop):
    workshop.run((1, 7, 3))
    workshop.run((1, 2, 3))
    assert workshop.done == []


def test_a_forced_stage_runs_again_with_all_later_ones(workshop):
    story = workshop.run(force=["two"])
    assert workshop.done == ["two", "three"]
    assert story.timings["one"]["cached"] and not story.timings["three"]["cached"]
    workshop.run()
    assert workshop.done == []  # forcing does not spoil the cache


def cached_files(workshop, stage, suffix):
    return list((workshop.folder / "work" / stage).glob(f"*{suffix}"))


@pytest.mark.parametrize("suffix", [".npz", ".json"])
@pytest.mark.parametrize("damage", ["cut", "emptied", "removed", "garbage"])
def test_damaged_results_are_computed_again(workshop, suffix, damage):
    (file,) = cached_files(workshop, "two", suffix)
    data = file.read_bytes()
    if damage == "removed":
        file.unlink()
    else:
        file.write_bytes({"cut": data[: len(data) // 2], "emptied": b"", "garbage": b"\x00garbage" * 20}[damage])
    story = workshop.run()
    assert workshop.done == ["two"]  # its content is the same again, so that what follows stays
    np.testing.assert_array_equal(story["two"].arrays["x"], [3.0, 3.0, 3.0])
    workshop.run()
    assert workshop.done == []


def test_results_of_another_stage_under_the_same_name_are_not_believed(workshop):
    (one,), (two,) = cached_files(workshop, "one", ".json"), cached_files(workshop, "two", ".json")
    two.write_bytes(one.read_bytes())
    workshop.run()
    assert workshop.done == ["two"]


def test_a_stage_whose_files_are_gone_runs_again(workshop):
    workshop.run(still_there=lambda result: False)
    assert workshop.done == ["two"]
    workshop.run(still_there=lambda result: result.meta["value"] == 2)
    assert workshop.done == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, InputRejected, ValueError])
def test_an_interrupted_stage_leaves_the_earlier_results(tmp_path, error):
    workshop = Workshop(tmp_path / "x.fluid")
    story = Story(workshop.folder, STAGES, progress=Silence())

    def fails():
        raise error("stop")

    story.run("one", workshop.stage("one", 1, story), settings={"value": 1}, after=())
    with pytest.raises(error):
        story.run("two", fails, settings={"value": 2}, after=("one",))
    workshop.run()
    assert workshop.done == ["two", "three"]


def test_warnings_are_told_again_from_the_cache_but_only_once(workshop):
    told = []

    class Listener(Silence):
        def warn(self, text):
            told.append(text)

    for _ in range(2):
        story = Story(workshop.folder, STAGES, progress=Listener())
        story.run("one", workshop.stage("one", 9, story), settings=9, after=())
        story.warn("one warns")
        assert story.warnings == ["one warns"]
    assert told == ["one warns", "one warns"]  # once per run


def test_progress_hears_of_every_stage(workshop):
    heard = []

    class Listener(Silence):
        def stage(self, name, number, count):
            heard.append((name, number, count))

        def finished(self, name, seconds, cached):
            heard.append((name, seconds >= 0, cached))

    story = Story(workshop.folder, STAGES, progress=Listener())
    story.run("one", workshop.stage("one", 1, story), settings={"value": 1}, after=())
    assert heard == [("one", 1, 3), ("one", True, True)]


def test_the_time_of_a_cached_stage_is_the_time_it_once_took(workshop):
    times = [workshop.run().timings["two"]["seconds"] for _ in range(2)]
    assert times[0] == times[1]


# keys -----------------------------------------------------------------------------------------------------------


def test_equal_settings_have_equal_keys_in_any_order():
    assert content_hash({"a": 1, "b": [1.5, None]}) == content_hash({"b": [1.5, None], "a": 1})


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (("ab", "c"), ("a", "bc")),
        ((1,), ("1",)),
        ((None,), ("",)),
        ((["x"], []), ([], ["x"])),
        ((1,), (1.5,)),
        ((b"1",), (b"2",)),
    ],
)
def test_different_settings_have_different_keys(a, b):
    assert content_hash(*a) != content_hash(*b)


def test_the_hash_of_a_file_is_that_of_its_content(tmp_path):
    a, b = tmp_path / "x" / "clip.mp4", tmp_path / "y" / "clip.mp4"
    for f in (a, b):
        f.parent.mkdir()
        f.write_bytes(b"frames" * 1000)
    assert file_hash(a) == file_hash(b)
    b.write_bytes(b"frames" * 999 + b"framez")
    assert file_hash(a) != file_hash(b)


def test_the_hash_of_a_folder_knows_which_file_holds_what(tmp_path):
    hashes = []
    for names in (("1.png", "2.png"), ("2.png", "1.png")):
        folder = tmp_path / "_".join(names)
        folder.mkdir()
        for name, data in zip(names, (b"dark", b"light")):
            (folder / name).write_bytes(data)
        hashes.append(file_hash(folder))
    assert hashes[0] != hashes[1]


def test_memory_is_told_in_megabytes():
    assert 10 < peak_memory_mb() < 1e6  # an interpreter with NumPy takes tens of megabytes
