"""Ray as the engine: the same files, whatever process or machine is lost."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from catalogue import digests, stream_pictures, write_clip

from fluidlift.cli import REJECTED, main
from fluidlift.errors import InputRejected
from fluidlift.farm import ray_cluster
from fluidlift.farm.local import LocalEngine
from fluidlift.farm.ray_cluster import RayEngine
from fluidlift.farm.ray_session import session
from fluidlift.farm.state import claimed, is_running, read_outcome
from fluidlift.farm.store import Store

# not imported here: what it listens on is decided when it is
pytestmark = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs ray")

HASTY = (
    "shape.cells=12", "shape.refine_iterations=0", "motion.targets=1", "fit.max_seconds=60", "simulate.frames=2",
    "show.usd=false",
)  # fmt: skip
WAIT = 60.0
"""s until what is waited for should have happened"""


@pytest.fixture(scope="module")
def ray():
    """Ray on this machine alone, for the tests that end none of its processes but workers."""
    with session(None) as connected:
        yield connected


def made(shots, folder: Path, limits, engine: RayEngine, told=None):
    folder.mkdir(exist_ok=True)
    tell = ([] if told is None else told).append
    return {o.name: o for o in engine.shots(shots, folder, limits, tell, lambda text: None)}


def until(happened) -> None:
    end = time.monotonic() + WAIT
    while not happened():
        assert time.monotonic() < end, "did not happen"
        time.sleep(0.05)


def test_shots_become_what_the_local_engine_makes_of_them_and_are_not_made_twice(ray, tmp_path, limits, shot, runs):
    one = RayEngine(cores=1)
    out, told = tmp_path / "out", []
    shots = [shot(n) for n in "abc"]
    first = made(shots, out, limits, one, told)
    assert {n: o.outcome for n, o in first.items()} == dict.fromkeys("abc", "done") and "Ray: 1 machine" in told[0]
    assert json.loads((out / "a.fluid" / "manifest.json").read_text())["threads"] == "1"
    assert made(shots, out, limits, one) == first  # as a resume of either engine
    assert {o.name: o for o in LocalEngine().shots(shots, out, limits, print, print)} == first
    assert [runs(out, n) for n in "abc"] == [1, 1, 1]


def test_the_bytes_are_those_of_the_local_engine(ray, tmp_path):
    clip = write_clip(tmp_path / "stream.mp4", stream_pictures())
    options = ["batch", str(clip), "--warnings-ok", *(f"--set={text}" for text in HASTY)]
    assert main([*options, "-o", str(tmp_path / "local")]) == 0
    assert main([*options, "-o", str(tmp_path / "ray"), "--engine", "ray", "--csv"]) == 0
    assert digests(tmp_path / "ray" / "stream.fluid") == digests(tmp_path / "local" / "stream.fluid")
    assert (tmp_path / "ray" / "batch.csv").read_text().splitlines()[1].startswith('stream,"done')


def test_each_machine_makes_in_a_folder_of_its_own_what_belongs_on_a_store(ray, tmp_path, limits, shot, runs):
    store = Store(f"file://{tmp_path}/there", tmp_path / "scratch")
    store.require()
    store.pull()
    told: list[str] = []
    shots = [shot("a"), shot("b"), shot("w", "wrong")]
    engine = RayEngine(cores=1, store=store)
    first = made(shots, store.folder, limits, engine, told)
    assert {n: o.outcome for n, o in first.items()} == {"a": "done", "b": "done", "w": "rejected"}
    assert sorted(p.name for p in (tmp_path / "there").glob("*.state.json")) == [f"{n}.state.json" for n in "abw"]
    assert (tmp_path / "there" / "a.fluid" / "manifest.json").is_file() and not (store.folder / "a.fluid").exists()
    found = made(shots, store.folder, limits, engine)
    assert found["a"] == first["a"] and [runs(store.folder, n) for n in "abw"] == [1, 1, 2]
    (tmp_path / "there").rename(tmp_path / "gone")
    (tmp_path / "there").write_text("no folder")
    with pytest.raises(InputRejected, match="cannot be written"):
        made(shots, store.folder, limits, engine)


def test_failures_are_tried_again_by_their_class(ray, tmp_path, limits, shot, runs):
    out, told = tmp_path / "out", []
    shots = [shot("w", "wrong"), shot("b", "broken"), shot("m", "big")]
    found = made(shots, out, replace(limits, memory=150e6, tries=2), RayEngine(cores=1), told)
    assert {n: o.failure for n, o in found.items()} == {"w": "input", "b": "crash", "m": "memory"}
    assert {n: runs(out, n) for n in "wbm"} == {"w": 1, "b": 2, "m": 2}
    assert any(line.startswith("m: took more memory") and "tried again, with 0.3 GB" in line for line in told)


def test_a_worker_that_is_killed_loses_no_shot_and_its_make_ends_with_it(ray, tmp_path, limits, shot, runs):
    out = tmp_path / "out"
    out.mkdir()
    told = []
    making = RayEngine(cores=1).shots([shot("k", size=3)], out, replace(limits, tries=3), told.append, print)
    begun = False

    def kill() -> bool:
        nonlocal begun
        note = out / "k.lock"
        if runs(out, "k") == 1 and not begun:
            begun = True
            os.kill(json.loads(note.read_text())["pid"], signal.SIGKILL)  # the worker, which holds the shot
        return begun

    killer = threading.Thread(target=until, args=(kill,))
    killer.start()
    (outcome,) = making
    killer.join()
    assert outcome.outcome == "done" and runs(out, "k") == 2 and any("was lost" in line for line in told)


def test_a_shot_that_somebody_else_makes_is_left_to_him_in_the_end(ray, tmp_path, limits, shot, runs, monkeypatch):
    monkeypatch.setattr(ray_cluster, "_ELSEWHERE", 0.0)
    out, told = tmp_path / "out", []
    out.mkdir()
    with claimed(out, "a"):
        assert made([shot("a"), shot("b")], out, limits, RayEngine(cores=1), told).keys() == {"b"}
    assert any("left to it" in line for line in told) and runs(out, "a") == 0


def test_a_machine_that_came_later_with_another_version_ends_the_batch(ray, tmp_path, limits, shot, runs, monkeypatch):
    monkeypatch.setattr(ray_cluster, "__version__", "0.0.1")  # here alone: the worker has its own
    monkeypatch.setattr(ray_cluster, "require_fit", lambda *a, **k: [])  # as before it came
    with pytest.raises(InputRejected, match=r"is .*, here 0\.0\.1"):
        made([shot("a")], tmp_path / "out", limits, RayEngine(cores=1))
    assert runs(tmp_path / "out", "a") == 0


def test_a_machine_that_dies_in_the_middle_loses_no_shot(ray, tmp_path, limits, shot, runs):
    """In a process of its own: a process is connected to one cluster at a time."""
    out = tmp_path / "out"
    out.mkdir()
    code = f"""
import os, sys, threading, time
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
from dataclasses import replace
from pathlib import Path
from ray.cluster_utils import Cluster
from fluidlift.farm.engine import Limits
from fluidlift.farm.ray_cluster import RayEngine
from fluidlift.farm.shots import Shot
cluster = Cluster(initialize_head=True, head_node_args={{"num_cpus": 1, "include_dashboard": False,
    "_system_config": {{"health_check_period_ms": 500, "health_check_failure_threshold": 2}}}})
second = cluster.add_node(num_cpus=1)
shots = [Shot(Path({str(tmp_path)!r}, f"{{n}}.mp4"), n, {{"size": 2}}) for n in "abcd"]
out = Path({str(out)!r})
def lose():
    while len(list(out.glob("*.runs"))) < 2:
        time.sleep(0.05)
    cluster.remove_node(second, allow_graceful=False)
    print("removed", flush=True)
thread = threading.Thread(target=lose)
thread.start()
limits = Limits(program={limits.program!r}, memory=2e8, tries=3)
engine = RayEngine(cluster.address, cores=1)
for outcome in engine.shots(shots, out, limits, lambda t: print(t, flush=True), print):
    print(outcome.line(), flush=True)
thread.join()
cluster.shutdown()
"""
    for name in "abcd":
        shot(name)
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=180)
    assert ran.returncode == 0, ran.stderr[-2000:]
    assert "Ray: 2 machines" in ran.stdout and "removed" in ran.stdout and "was lost" in ran.stdout, ran.stdout
    for name in "abcd":
        outcome = read_outcome(out, name)
        assert outcome is not None and outcome.outcome == "done", ran.stdout
    assert sorted(runs(out, n) for n in "abcd") == [1, 1, 1, 2]


def test_a_driver_that_is_killed_goes_on_where_it_was(ray, tmp_path, limits, shot, runs):
    out = tmp_path / "out"
    out.mkdir()
    code = f"""
from pathlib import Path
from fluidlift.farm.engine import Limits
from fluidlift.farm.ray_cluster import RayEngine
from fluidlift.farm.shots import Shot
shots = [Shot(Path({str(tmp_path)!r}, "a.mp4"), "a", {{}}), Shot(Path({str(tmp_path)!r}, "s.mp4"), "s", {{"size": 20}})]
limits = Limits(program={limits.program!r}, memory=2e8)
for outcome in RayEngine(cores=1, jobs=1).shots(shots, Path({str(out)!r}), limits, print, print):
    pass
"""
    for name in "as":
        shot(name)
    driver = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until(lambda: runs(out, "s") == 1)
    driver.kill()
    driver.wait()
    until(lambda: not is_running(out, "s"))  # its make ended with it
    assert read_outcome(out, "s") is None
    found = made([shot("a"), shot("s", size=0)], out, limits, RayEngine(cores=1))
    assert {o.outcome for o in found.values()} == {"done"} and (runs(out, "a"), runs(out, "s")) == (1, 2)


def test_nothing_of_it_can_be_reached_from_elsewhere(ray):
    """All that its own processes listen on is the loopback address."""
    parents = {}
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            parents[int(process.name)] = int((process / "stat").read_text().rpartition(")")[2].split()[1])
    ours, more = set(), {os.getpid()}
    while more:
        ours |= more
        more = {child for child, parent in parents.items() if parent in more}
    inodes = set()
    for process in ours:
        with suppress(OSError):
            inodes |= {os.readlink(file) for file in Path(f"/proc/{process}/fd").iterdir()}
    rows = [row.split() for name in ("tcp", "tcp6") for row in Path("/proc/net", name).read_text().splitlines()[1:]]
    listens = [row for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in inodes]
    found = [row[1].rpartition(":")[0] for row in listens]
    loopback = {"0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"}
    assert len(found) >= 4 and set(found) <= loopback  # the head, the raylet and their agents


def test_what_no_machine_has_is_said_before_work_starts(ray, tmp_path, limits, shot, runs):
    with pytest.raises(InputRejected, match="largest machine"):
        made([shot("a")], tmp_path / "out", replace(limits, memory=1e15), RayEngine())
    with pytest.raises(InputRejected, match="--gpus"):
        made([shot("a")], tmp_path / "out", limits, RayEngine(gpus=64))
    assert runs(tmp_path / "out", "a") == 0


def test_no_cluster_at_an_address_is_said_in_a_line(tmp_path, capsys):
    (tmp_path / "a.mp4").write_text("no film")
    where = ["--engine", "ray", "--address", "127.0.0.1:1"]
    assert main(["batch", str(tmp_path / "a.mp4"), "-o", str(tmp_path / "out"), *where]) == REJECTED
    assert "nothing answers at 127.0.0.1:1" in capsys.readouterr().err and not list((tmp_path / "out").glob("*.log"))
