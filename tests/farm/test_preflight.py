"""What would fail every shot is said once, before work starts."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fluidlift.cli import FAILED, REJECTED, main
from fluidlift.errors import InputRejected
from fluidlift.farm import making, preflight
from fluidlift.farm.engine import Limits, next_limits
from fluidlift.farm.local import LocalEngine
from fluidlift.farm.preflight import NOTE, Machine, looked_at, require_fit
from fluidlift.farm.state import ShotOutcome
from fluidlift.io.asset_lock import held

OURS = Machine("here", "2.0", "ab", clock=1000.0)
THERE = replace(OURS, host="node7", clock=1003.0, file_clock=-0.2)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"version": "1.9"}, "fluidlift on node7 is 1.9, here 2.0"),
        ({"source": "cd"}, "of another source"),
        ({"clock": 1003.0 + 3600.0}, "the clock on node7 is 60 min fast"),
        ({"clock": 1003.0 - 3600.0}, "60 min slow"),
        ({"file_clock": 3600.0}, "the clock of 'out' as seen on node7 is 60 min fast"),
        ({"free": 1_000_000}, "1 MB free"),
        ({"sees": False}, "not the folder that is seen here"),
        ({"missing": "/clips/a.mp4"}, "'/clips/a.mp4' is not there on node7"),
        ({"error": "cannot write to 'out' (Read-only file system)"}, "Read-only file system"),
    ],
)
def test_a_machine_that_cannot_be_used_is_named_with_the_remedy(wrong, words, tmp_path):
    assert require_fit([THERE], Path("out"), ours=OURS) == []
    with pytest.raises(InputRejected) as refused:
        require_fit([THERE, replace(THERE, **wrong)], Path("out"), ours=OURS)
    assert words in str(refused.value) and refused.value.do


def test_locks_that_do_not_reach_are_no_error_but_said(tmp_path):
    (line,) = require_fit([replace(THERE, locks=False)], tmp_path, ours=OURS)
    assert "node7" in line and "no second batch" in line


def test_a_machine_looks_at_itself(tmp_path):
    found = looked_at(tmp_path)
    assert require_fit([found], tmp_path) == [] and abs(found.file_clock) < 5 and not list(tmp_path.iterdir())
    with held(tmp_path / NOTE, "looking 42"):
        seen = looked_at(tmp_path, "looking 42", [tmp_path / "gone.mp4"])
        assert seen.sees and seen.locks and seen.missing.endswith("gone.mp4")
        assert not looked_at(tmp_path, "looking 43").sees
    assert not looked_at(tmp_path, "looking 42").locks  # nobody holds it, so as where locks do not reach
    assert "cannot write" in looked_at(tmp_path / "nowhere").error


def test_a_full_disk_ends_a_batch_before_the_next_shot(tmp_path, limits, shot, runs, monkeypatch):
    out = tmp_path / "out"
    out.mkdir()
    engine = LocalEngine().shots([shot("a"), shot("b")], out, limits, print, print)
    assert next(engine).name == "a"
    del engine
    monkeypatch.setattr(making, "ROOM", 10**18)
    with pytest.raises(InputRejected, match="MB free"):
        list(LocalEngine().shots([shot("a"), shot("c")], out, limits, print, print))
    assert runs(out, "c") == 0
    monkeypatch.setattr(preflight, "ROOM", 10**18)
    with pytest.raises(InputRejected, match="for each shot at a time"):
        next(LocalEngine().shots([shot("c")], out, limits, print, print))


def outcome(failure: str) -> ShotOutcome:
    return ShotOutcome("a", "failed" if failure else "done", 1.0, "", "", failure=failure)


def test_a_shot_is_tried_again_where_that_can_help():
    limits = Limits(memory=4e9, tries=3, retry="crash")
    assert [next_limits(outcome(f), limits, 64e9) for f in ("", "input", "time")] == [None] * 3
    assert next_limits(outcome("crash"), limits, 64e9) == replace(limits, tries=2, retry=None)
    more = next_limits(outcome("memory"), limits, 6e9)
    assert more == replace(limits, tries=2, retry=None, memory=6e9)
    assert more is not None and next_limits(outcome("memory"), more, 6e9) is None
    assert next_limits(outcome("crash"), replace(limits, tries=1), 64e9) is None


def test_the_local_engine_tries_again_too(tmp_path, limits, shot, runs):
    out, told = tmp_path / "out", []
    out.mkdir()
    shots = [shot("b", "broken"), shot("w", "wrong")]
    found = list(LocalEngine().shots(shots, out, replace(limits, tries=3), told.append, print))
    assert [o.failure for o in found] == ["crash", "input"] and (runs(out, "b"), runs(out, "w")) == (3, 1)
    assert sum("tried again" in line for line in told) == 2


def test_a_make_ends_with_the_batch_that_is_killed_and_the_next_one_makes_its_shot(tmp_path, limits, shot, runs):
    out = tmp_path / "out"
    out.mkdir()
    code = f"""
from pathlib import Path
from fluidlift.farm.engine import Limits
from fluidlift.farm.local import LocalEngine
from fluidlift.farm.shots import Shot
shots = [Shot(Path({str(shot("a").clip)!r}), "a", {{"size": 30}})]
list(LocalEngine().shots(shots, Path({str(out)!r}), Limits(program={limits.program!r}), print, print))
"""
    batch = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL)
    while runs(out, "a") == 0 and batch.poll() is None:
        pass
    batch.kill()
    batch.wait()
    (found,) = LocalEngine().shots([shot("a")], out, limits, print, print)
    assert found.outcome == "done" and runs(out, "a") == 2
    own = [p for p in os.listdir("/proc") if p.isdecimal()] if os.path.isdir("/proc") else []
    assert not [p for p in own if limits.program[1] in _words(p)]


def _words(process: str) -> str:
    try:
        with open(f"/proc/{process}/cmdline", encoding="utf-8", errors="replace") as file:
            return file.read()
    except OSError:
        return ""


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--jobs", "0"], "--jobs 0"),
        (["--tries", "0"], "--tries 0"),
        (["--cores", "0"], "--cores 0"),
        (["--gpus", "1"], "without --engine ray"),
        (["--address", "10.0.0.5:6379"], "without --engine ray"),
    ],
)
def test_options_that_cannot_be_are_refused(options, words, tmp_path, capsys):
    (tmp_path / "a.mp4").write_text("no film")
    assert main(["batch", str(tmp_path / "a.mp4"), "-o", str(tmp_path / "out"), *options]) == REJECTED
    assert words in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_without_ray_its_engine_says_what_to_install_and_others_never_look_for_it(tmp_path):
    (tmp_path / "a.mp4").write_text("no film")
    code = """
import sys
sys.modules["ray"] = None  # as where it is not installed
from fluidlift.cli import main
sys.exit(main(sys.argv[1:]))
"""
    words = ["batch", str(tmp_path / "a.mp4"), "-o", str(tmp_path / "out")]
    for more, code_wanted, said in (([], FAILED, ""), (["--engine", "ray"], 1, "pip install 'fluidlift[ray]'")):
        ran = subprocess.run([sys.executable, "-c", code, *words, *more], capture_output=True, text=True)
        assert ran.returncode == code_wanted and said in ran.stderr
    assert (tmp_path / "out" / "a.state.json").is_file()


def test_the_summary_is_written_as_tables_too(tmp_path):
    pq = pytest.importorskip("pyarrow.parquet")
    (tmp_path / "a.mp4").write_text("no film")
    assert main(["batch", str(tmp_path / "a.mp4"), "-o", str(tmp_path / "out"), "--csv", "--parquet"]) == FAILED
    (row,) = pq.read_table(tmp_path / "out" / "batch.parquet").to_pylist()
    assert (row["name"], row["failure"], row["warnings"]) == ("a", "input", []) and "fingerprint" not in row
    assert (tmp_path / "out" / "batch.csv").read_text().count("\n") == 2
