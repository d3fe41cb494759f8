"""Jobs for other schedulers: read by the programs that they are for, where these are here."""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from fluidlift.cli import main
from fluidlift.farm.plans import KINDS, TaskPlan, written
from fluidlift.farm.state import read_outcome


@pytest.fixture
def clips(tmp_path: Path) -> Path:
    folder = tmp_path / "clips of a day"
    folder.mkdir()
    for name in ("a", "b", "c"):
        (folder / f"{name}.mp4").write_text("no film")
    return folder


def plan_of(clips: Path, kind: str, *options: str) -> str:
    assert main(["batch", str(clips), "-o", str(clips.parent / "out"), "--plan", kind, *options]) == 0
    (path,) = (clips.parent / "out").glob("plan*")
    return path.read_text()


def test_a_command_per_shot_covers_the_list_once(clips):
    lines = [shlex.split(line) for line in plan_of(clips, "commands", "--preset", "hero").splitlines()]
    assert len(lines) == 3
    for k, words in enumerate(lines, 1):
        assert words[:3] == ["fluidlift", "batch", str(clips)] and f"{k}/3" in words and "--preset=hero" in words
        assert main(words[1:]) == 1  # no films, and said so
        assert [n for n in "abc" if read_outcome(clips.parent / "out", n)] == list("abc")[:k]


def test_slurm_gets_an_array_with_what_a_task_needs(clips):
    text = plan_of(clips, "slurm", "--memory-limit", "6GiB", "--time-limit", "90 min")
    assert "#SBATCH --array=1-3\n" in text and "#SBATCH --mem=6144M\n" in text and "#SBATCH --time=92\n" in text
    ran = subprocess.run(
        ["sh", "-c", text.replace("exec fluidlift", "echo")], capture_output=True, text=True,
        env=os.environ | {"SLURM_ARRAY_TASK_ID": "2"},
    )  # fmt: skip
    assert ran.returncode == 0 and "--shard 2/3 --warnings-ok" in ran.stdout and str(clips) in ran.stdout


def test_an_open_job_description_passes_its_own_validator_and_runs(clips, tmp_path):
    found = shutil.which("openjd", path=str(Path(sys.executable).parent))
    if found is None:
        pytest.skip("needs openjd-cli")
    text = plan_of(clips, "openjd", "--time-limit", "30min")
    job = yaml.safe_load(text)
    assert job["steps"][0]["script"]["actions"]["onRun"]["timeout"] == 1920
    path = tmp_path / "out" / "plan.openjd.yaml"
    checked = subprocess.run([found, "check", str(path)], capture_output=True, text=True)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    names = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    ran = subprocess.run(
        [found, "run", str(path), "--step", "make", "--tasks", '[{"Shot": 2}]'], capture_output=True, text=True,
        env=os.environ | {"PATH": names},
    )  # fmt: skip
    assert "[1/1] b: rejected" in ran.stdout + ran.stderr
    outcome = read_outcome(tmp_path / "out", "b")
    assert outcome is not None and outcome.failure == "input" and read_outcome(tmp_path / "out", "a") is None


@pytest.mark.parametrize("kind", KINDS)
def test_every_plan_has_as_many_tasks_as_shots(kind, tmp_path):
    text = written(kind, TaskPlan(["clips", "-o", "out"], 40, 2, 4e9), tmp_path).read_text()
    assert "1-40" in text or text.count("/40 ") == 40


@pytest.mark.parametrize("shard", ["0/3", "4/3", "1/0", "x", "1/3/5", "-1/3", "1/3\n"])
def test_a_shard_that_is_none_is_refused(shard, clips, capsys):
    assert main(["batch", str(clips), "-o", str(clips.parent / "out"), f"--shard={shard}"]) == 3
    assert "--shard" in capsys.readouterr().err and not (clips.parent / "out").exists()
