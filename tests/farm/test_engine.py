"""What becomes of shots: once each, whatever happens, with the reason where one fails."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

from fluidlift.farm.local import LocalEngine
from fluidlift.farm.making import RunningMakes, environment, make_shot
from fluidlift.farm.state import claimed, is_running, names_of, read_outcome
from fluidlift.farm.summary import Summary, status_of
from fluidlift.machine import THREADS, cores


def made(shots, folder: Path, limits, told=None, jobs=1):
    folder.mkdir(exist_ok=True)
    tell = ([] if told is None else told).append
    return {o.name: o for o in LocalEngine(jobs).shots(shots, folder, limits, tell, lambda text: None)}


def test_a_shot_that_is_finished_is_not_started_again(tmp_path, limits, shot, runs):
    out = tmp_path / "out"
    first = made([shot("a"), shot("b")], out, limits)
    assert [o.outcome for o in first.values()] == ["done", "done"]
    assert first["a"].verdict == "usable" and first["a"].peak_memory_mb == 12.5 and first["a"].version
    again = made([shot("a"), shot("b")], out, limits)
    assert again == first and (runs(out, "a"), runs(out, "b")) == (1, 1)


def test_another_option_another_clip_or_a_changed_asset_makes_it_again(tmp_path, limits, shot, runs):
    out = tmp_path / "out"
    made([shot("a"), shot("b"), shot("c"), shot("d")], out, limits)
    shot("b").clip.write_text("another film")
    (out / "c.fluid" / "manifest.json").write_text("{}")
    made([shot("a", size=0.01), shot("b"), shot("c"), shot("d")], out, limits)
    assert [runs(out, n) for n in "abcd"] == [2, 2, 2, 1]


def test_each_failure_has_its_class_and_can_be_tried_again_alone(tmp_path, limits, shot, runs):
    out = tmp_path / "out"
    shots = [
        shot("w", "wrong"),
        shot("b", "broken"),
        shot("s", "slow"),
        shot("m", "big"),
        shot("f", "foamy"),
        shot("g"),
    ]
    bounded = replace(limits, seconds=5.0, memory=150e6)
    found = made(shots, out, bounded, jobs=2)
    assert {n: o.failure for n, o in found.items()} == {
        "w": "input", "b": "crash", "s": "time", "m": "memory", "f": "", "g": "",
    }  # fmt: skip
    assert found["w"].reason == "no such video" and "took longer than 5 s" in found["s"].reason
    assert found["f"].outcome == "done, warnings" and found["f"].warnings == ["foam"]
    made(shots, out, replace(bounded, retry="crash"))
    assert {n: runs(out, n) for n in "wbsmfg"} == {"w": 1, "b": 2, "s": 1, "m": 1, "f": 1, "g": 1}
    told = status_of(out).lines()
    assert told[0] == "2 of 6 done (1 with warnings), 0 running, 0 waiting"
    assert "failed: 1 crash, 1 input, 1 memory, 1 time" in told


def test_cores_are_divided_among_the_jobs(tmp_path, limits, shot, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert environment(2) == dict.fromkeys(THREADS, "2") and environment(0)["OMP_NUM_THREADS"] == "1"
    made([shot("a")], tmp_path / "out", limits, jobs=4)
    assert json.loads((tmp_path / "out" / "a.fluid" / "manifest.json").read_text())["threads"] == "2"
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert cores() == 3


def test_two_batches_on_one_folder_make_each_shot_once_and_lose_none(tmp_path, limits, shot, runs):
    out = tmp_path / "out"
    lists = [[shot(n, size=0.2) for n in "abc"], [shot(n, size=0.2) for n in "bcd"]]
    out.mkdir()
    batches = [threading.Thread(target=made, args=(shots, out, limits)) for shots in lists]
    for batch in batches:
        batch.start()
    for batch in batches:
        batch.join()
    assert [runs(out, n) for n in "abcd"] == [1, 1, 1, 1]
    Summary(out).write()
    assert sorted(row["name"] for row in json.loads((out / "batch.json").read_text())) == list("abcd")
    assert sorted(names_of(out)) == list("abcd")


def test_a_shot_that_another_process_makes_is_left_to_it(tmp_path, limits, shot, runs):
    out, told = tmp_path / "out", []
    out.mkdir()
    with claimed(out, "a") as ours:
        assert ours is not None and is_running(out, "a")
        assert made([shot("a"), shot("b")], out, limits, told).keys() == {"b"}
        assert status_of(out).running == ("a",)
    assert any("left to it" in line for line in told)
    assert not is_running(out, "a") and runs(out, "a") == 0


def test_sigterm_ends_the_makes_too_and_what_is_left_is_made_by_the_next_run(tmp_path, limits, shot, runs):
    out = tmp_path / "out"
    code = f"""
import sys
from pathlib import Path
from fluidlift import cli
from fluidlift.farm import engine, local
from fluidlift.farm.shots import Shot
limits = engine.Limits(program={limits.program!r})
shots = [Shot(Path({str(shot("a").clip)!r}), "a", {{}}), Shot(Path({str(shot("s").clip)!r}), "s", {{"kind": "slow"}})]
Path({str(out)!r}).mkdir()
made = local.LocalEngine().shots(shots, Path({str(out)!r}), limits, print, print)
cli._COMMANDS[cli.Doctor] = lambda c: [0 for o in made] and 0
sys.exit(cli.main(["doctor"]))
"""
    batch = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 60
    while runs(out, "s") == 0 and time.monotonic() < end:
        time.sleep(0.05)
    batch.send_signal(signal.SIGTERM)
    assert batch.wait(60) == 143, batch.stderr.read()
    stopped = read_outcome(out, "s")
    assert stopped is not None and stopped.failure == "stopped" and not is_running(out, "s")
    made([shot("a"), shot("s")], out, limits)
    assert (runs(out, "a"), runs(out, "s")) == (1, 2)


def test_a_damaged_or_strange_state_is_no_state(tmp_path, limits, shot, runs):
    out = tmp_path / "out"
    made([shot("a")], out, limits)
    state = out / "a.state.json"
    good = state.read_text()
    for text in ("", "{", "[]", '{"name": "b"}', good.replace('"a"', '"b"', 1), '{"name": "a", "outcome": 3}'):
        state.write_text(text)
        assert read_outcome(out, "a") is None
    (out / "elsewhere").write_text(good)
    state.unlink()
    state.symlink_to(out / "elsewhere")
    assert read_outcome(out, "a") is None
    (out / "shots.json").write_text('["../../x", "a", 3]')
    assert names_of(out) == ["a"]


def test_a_make_that_is_killed_is_not_written_down_at_once_where_its_maker_may_be_next(tmp_path, limits, shot):
    making, out = RunningMakes(settle=1.0), tmp_path / "out"
    out.mkdir()
    maker = threading.Thread(target=make_shot, args=(shot("s", "slow"), out, limits, making))
    maker.start()
    while not making.processes:
        time.sleep(0.01)
    making.processes[0].kill()
    time.sleep(0.5)
    assert read_outcome(out, "s") is None
    maker.join()
    assert (known := read_outcome(out, "s")) is not None and known.failure == "memory"
