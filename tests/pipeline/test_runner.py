"""The runner runs what has changed and takes the rest from its cache."""

from dataclasses import dataclass, field

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.io.hashes import file_hash
from fluidlift.io.kept_values import kept_value, last_value
from fluidlift.io.stage_cache import load_stage, save_stage
from fluidlift.machine import peak_memory_mb
from fluidlift.pipeline import runner as running
from fluidlift.pipeline.inputs import BESIDE, GivenFile, Weights
from fluidlift.pipeline.runner import Runner, digest_of
from fluidlift.pipeline.work import Work
from fluidlift.seams import Silence
from fluidlift.types import FaceVelocity, Grid

STAGES = ("one", "two", "three")
DONE = []
"""names of the stages that have worked, in order"""
STOP = {}
"""error that a stage is stopped by"""


@dataclass(frozen=True)
class Sum:
    """What each of three stages leaves."""

    x: np.ndarray
    value: int
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Added:
    """Their settings."""

    name: str
    value: int
    speed: int = field(default=0, metadata=BESIDE)


def add(before: Sum | None, settings: Added) -> Sum:
    """Adds a value to the sum of the stage before."""
    DONE.append(settings.name)
    if settings.name in STOP:
        raise STOP[settings.name]
    x = np.zeros(3) if before is None else before.x
    told = (f"{settings.name} warns",) if settings.value > 5 else ()
    return Sum(x + settings.value, settings.value, told)


@pytest.fixture(autouse=True)
def quiet():
    """Nothing is done, and nothing is to be stopped."""
    DONE.clear()
    STOP.clear()


class Workshop:
    """Three stages, each building on the one before."""

    def __init__(self, folder):
        self.folder = folder

    def run(self, values=(1, 2, 3), *, force=(), still_there=None, progress=None, stages=STAGES, speed=0):
        """Run all stages with one setting each; the runner, and the last value."""
        DONE.clear()
        runner, found = Runner(self.folder, STAGES, force=frozenset(force), progress=progress or Silence()), None
        for name, value in zip(stages, values):
            check = still_there if still_there and name == "two" else lambda result: True
            found = runner.run(name, add, found, Added(name, value, speed), still_there=check)
        return runner, found


@pytest.fixture
def workshop(tmp_path):
    w = Workshop(tmp_path / "x.fluid")
    w.run()
    assert DONE == ["one", "two", "three"]
    return w


def test_the_same_settings_are_not_worked_on_twice(workshop):
    runner, found = workshop.run()
    assert DONE == []
    assert all(t["cached"] for t in runner.timings.values())
    np.testing.assert_array_equal(found.x, [6.0, 6.0, 6.0])
    assert found.value == 3


def test_a_changed_setting_runs_its_stage_and_those_that_build_on_it(workshop):
    workshop.run((1, 7, 3))
    assert DONE == ["two", "three"]
    workshop.run((1, 7, 8))
    assert DONE == ["three"]


def test_a_setting_that_changes_no_result_runs_nothing(workshop):
    workshop.run(speed=4)
    assert DONE == []


def test_a_change_upstream_reaches_the_end(workshop):
    _, found = workshop.run((5, 2, 3))
    assert DONE == ["one", "two", "three"]
    np.testing.assert_array_equal(found.x, [10.0, 10.0, 10.0])


def test_going_back_to_earlier_settings_is_free(workshop):
    workshop.run((1, 7, 3))
    workshop.run((1, 2, 3))
    assert DONE == []


def test_a_forced_stage_runs_again_with_all_later_ones(workshop):
    runner, _ = workshop.run(force=["two"])
    assert DONE == ["two", "three"]
    assert runner.timings["one"]["cached"] and not runner.timings["three"]["cached"]
    workshop.run()
    assert DONE == []  # forcing does not spoil the cache


def test_a_change_of_the_source_runs_what_uses_it(workshop, monkeypatch):
    real = running.source_hash
    monkeypatch.setattr(running, "source_hash", lambda module: real(module) + "changed")
    workshop.run()
    assert DONE == ["one", "two", "three"]
    monkeypatch.undo()
    workshop.run()
    assert DONE == []


# damage -----------------------------------------------------------------------------------------------------------


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
    _, found = workshop.run()
    assert DONE == ["two"]  # its content is the same again, so that what follows stays
    np.testing.assert_array_equal(found.x, [6.0, 6.0, 6.0])
    workshop.run()
    assert DONE == []


@pytest.mark.parametrize(
    "change",
    [
        lambda arrays, value: value.update(value="3"),
        lambda arrays, value: value.update(value=True),
        lambda arrays, value: value.pop("warnings"),
        lambda arrays, value: value.update(more=1),
        lambda arrays, value: value.update(x="y"),
        lambda arrays, value: value.update(warnings="one"),
        lambda arrays, value: arrays.update(x=np.array(["a"])) or arrays.pop("x"),
    ],
    ids=["text", "truth", "missing", "unknown", "another array", "no list", "no array"],
)
def test_a_value_of_another_type_is_computed_again(workshop, change):
    (file,) = cached_files(workshop, "two", ".json")
    arrays, meta = load_stage(workshop.folder, "two", file.stem)
    change(arrays, meta["value"])
    save_stage(workshop.folder, "two", file.stem, arrays, meta)
    assert kept_value(workshop.folder, "two", file.stem, Sum) is None
    workshop.run()
    assert DONE == ["two"]


def test_results_of_another_stage_under_the_same_name_are_not_believed(workshop):
    (one,), (two,) = cached_files(workshop, "one", ".json"), cached_files(workshop, "two", ".json")
    two.write_bytes(one.read_bytes())
    workshop.run()
    assert DONE == ["two"]


def test_a_stage_whose_files_are_gone_runs_again(workshop):
    workshop.run(still_there=lambda value: False)
    assert DONE == ["two"]
    workshop.run(still_there=lambda value: value.value == 2)
    assert DONE == []


@pytest.mark.parametrize("error", [KeyboardInterrupt, InputRejected, ValueError])
def test_an_interrupted_stage_leaves_the_earlier_results(tmp_path, error):
    workshop = Workshop(tmp_path / "x.fluid")
    STOP["two"] = error("stop")
    with pytest.raises(error):
        workshop.run()
    STOP.clear()
    workshop.run()
    assert DONE == ["two", "three"]


# what is told -----------------------------------------------------------------------------------------------------


def test_warnings_are_told_again_from_the_cache_but_only_once(workshop):
    told = []

    class Listener(Silence):
        def warn(self, text):
            told.append(text)

    for _ in range(2):
        runner, _ = workshop.run((9,), stages=("one",), progress=Listener())
        runner.warn("one warns")
        assert runner.warnings == ["one warns"] == runner.told
    assert told == ["one warns", "one warns"]  # once per run


def test_progress_hears_of_every_stage(workshop):
    heard = []

    class Listener(Silence):
        def stage(self, name, number, count):
            heard.append((name, number, count))

        def finished(self, name, seconds, cached):
            heard.append((name, seconds >= 0, cached))

    workshop.run((1,), stages=("one",), progress=Listener())
    assert heard == [("one", 1, 3), ("one", True, True)]


def test_the_time_of_a_cached_stage_is_the_time_it_once_took(workshop):
    times = [workshop.run()[0].timings["two"]["seconds"] for _ in range(2)]
    assert times[0] == times[1]


def test_memory_is_told_in_megabytes():
    assert 10 < peak_memory_mb() < 1e6  # an interpreter with NumPy takes tens of megabytes


# earlier runs -----------------------------------------------------------------------------------------------------


def made_from(keys: dict[str, str]) -> dict:
    """What a manifest says of the stages."""
    return {"provenance": {"stages": dict(keys)}}


def test_a_value_is_recalled_by_its_key_and_known_to_what_follows(workshop):
    before, _ = workshop.run()
    runner = Runner(workshop.folder, STAGES, progress=Silence())
    found = runner.recall(made_from(before.keys), "two", Sum)
    assert found is not None and found.value == 2 and runner.timings["two"]["cached"]
    DONE.clear()
    runner.run("three", add, found, Added("three", 3))
    assert DONE == []
    assert runner.recall(made_from({"two": "0" * 64}), "two", Sum) is None
    assert runner.recall(made_from({}), "two", Sum) is None


def test_what_is_forgotten_has_no_key(workshop):
    before, _ = workshop.run()
    runner = Runner(workshop.folder, STAGES, progress=Silence())
    runner.recall(made_from(before.keys), "two", Sum)
    runner.forget()
    assert runner.keys == {} == runner.timings


def test_the_last_value_is_the_one_whose_files_lie_there(tmp_path):
    runner = Runner(tmp_path, STAGES, progress=Silence())
    assert last_value(tmp_path, "one", Sum) is None
    for value in (1, 2):
        runner.run("one", add, None, Added("one", value), owns_files=True)
        assert last_value(tmp_path, "one", Sum).value == value
    DONE.clear()
    runner.run("one", add, None, Added("one", 1), owns_files=True)
    assert DONE == ["one"]  # its files were written over, though its value is still in the cache


# parts of a stage, room on disk -----------------------------------------------------------------------------------


def slow(values: Sum, *, work: Work) -> Sum:
    """Part of a stage."""
    DONE.append("slow")
    return Sum(work.scratch.keep("x", values.x), 0)


def parted(values: Sum, shift: int, *, work: Work) -> Sum:
    """A stage with a slow part."""
    DONE.append("parted")
    return Sum(work.part("slow", slow, values).x + shift, shift)


def test_the_slow_part_of_a_stage_is_kept_by_itself(tmp_path):
    for shift, force, done in ((1, (), ["parted", "slow"]), (2, (), ["parted"]), (2, ("two",), ["parted"])):
        runner = Runner(tmp_path, STAGES, force=frozenset(force), progress=Silence())
        values = runner.run("one", add, None, Added("one", 4))
        DONE.clear()
        found = runner.run("two", parted, values, shift)
        assert DONE == done and found.x.tolist() == [4.0 + shift] * 3


def grown(count: int, *, work: Work) -> Sum:
    """A stage that writes its array on disk."""
    room = work.scratch.array("room", (count,), np.float64)
    room[:] = 7
    work.scratch.array("notes", (9,), np.uint8)
    return Sum(room, count)


def test_arrays_that_were_made_on_disk_stay_there_under_the_field_that_holds_them(tmp_path):
    for _ in range(2):
        runner = Runner(tmp_path, STAGES, progress=Silence())
        found = runner.run("one", grown, 5)
        assert isinstance(found.x, np.memmap) and found.x.tolist() == [7.0] * 5
        key = runner.keys["one"]
        place = tmp_path / "work" / "one"
        assert sorted(p.name for p in place.iterdir()) == [f"{key}.json", f"{key}.npz", f"{key}.x.npy"]


# keys -------------------------------------------------------------------------------------------------------------


def key_of(folder, *inputs, **named):
    """The key of a stage that is called so."""
    runner = Runner(folder, STAGES, progress=Silence())
    return runner._key("one", anything, inputs, named)


def anything(a=None, b=None, *, work=None) -> Sum:
    """A stage that takes all that there is."""
    return Sum(np.zeros(1), 0)


def test_equal_settings_have_equal_keys_in_any_order():
    assert digest_of({"a": 1, "b": [1.5, None]}) == digest_of({"b": [1.5, None], "a": 1})


def test_inputs_count_by_their_names_however_they_are_given(tmp_path):
    assert key_of(tmp_path, 1, 2) == key_of(tmp_path, b=2, a=1) != key_of(tmp_path, 2, 1)


GRID = Grid((2, 2, 2), 0.1)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (("ab", "c"), ("a", "bc")),
        ((1,), ("1",)),
        ((None,), ("",)),
        ((["x"], []), ([], ["x"])),
        ((1,), (1.5,)),
        ((np.zeros(3),), (np.zeros(3, np.float32),)),
        ((np.zeros((2, 3)),), (np.zeros((3, 2)),)),
        ((np.zeros(3),), (np.array([0.0, 0.0, 1e-300]),)),
        ((GRID,), (Grid((2, 2, 2), 0.2),)),
        ((Added("one", 1),), (Added("one", 2),)),
        (({"x": 1},), ({"y": 1},)),
    ],
)
def test_different_inputs_have_different_keys(tmp_path, a, b):
    assert key_of(tmp_path, *a) != key_of(tmp_path, *b)
    assert key_of(tmp_path, *a) == key_of(tmp_path, *a)


def test_values_count_with_their_arrays(tmp_path):
    still, moved = FaceVelocity.zeros(GRID), FaceVelocity.zeros(GRID)
    assert key_of(tmp_path, still) == key_of(tmp_path, moved)
    moved.w[0, 0, 0] = 1.0
    assert key_of(tmp_path, still) != key_of(tmp_path, moved)


def test_a_file_counts_by_its_content_and_not_by_its_name(tmp_path):
    one, two = (GivenFile(tmp_path / name, "same") for name in ("a.mp4", "b.mp4"))
    assert key_of(tmp_path, one) == key_of(tmp_path, two) != key_of(tmp_path, GivenFile(one.path, "other"))


def test_weights_count_by_their_content_where_they_are_here(tmp_path):
    path = tmp_path / "weights.bin"
    path.write_bytes(b"trained")
    before = key_of(tmp_path, Weights.of(str(path)))
    path.write_bytes(b"trained longer")
    assert key_of(tmp_path, Weights.of(str(path))) != before
    assert Weights.of("somebody/model") == Weights("somebody/model", "somebody/model") and Weights.of(None) is None


def test_what_says_nothing_of_its_content_is_refused(tmp_path):
    with pytest.raises(TypeError, match="no key"):
        key_of(tmp_path, tmp_path / "clip.mp4")


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
