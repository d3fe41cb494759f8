"""Every reader of files from strangers takes a thousand damaged ones: refused or read, in bounds, nothing else opened.

`python -m tests.fuzz` tries more.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz.targets import TARGETS
from fuzz.trial import LARGEST, SLOWEST

INPUTS, FORMED, BORDERS, SEED = 900, 100, 100, 20261125
"""of changed bytes; of those that keep their form, which take five times as long to draw; of those that are changed at
borders of it"""


@pytest.mark.parametrize("target", TARGETS)
def test_damaged_files_are_refused_or_read_within_bounds(target):
    # in a process of its own: its memory is its own, and the watch over files that are opened ends with it
    run = subprocess.run(
        [sys.executable, "-m", "fuzz.trial", target, str(INPUTS), str(FORMED), str(BORDERS), str(SEED), ""],
        capture_output=True, text=True, timeout=300, cwd=Path(__file__).parents[1],
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    found = json.loads(run.stdout.strip().splitlines()[-1])
    assert found["raw"] == {}
    assert found["inputs"] == INPUTS + BORDERS + found["formed"] == found["accepted"] + found["refused"]
    assert found["formed"] >= FORMED / 2  # Hypothesis ends where there is nothing else to draw
    assert found["outside"] == []
    assert found["slowest"] < SLOWEST
    assert found["peak_bytes"] < LARGEST


def test_the_command_tries_what_is_asked_for():
    def run(*args: str) -> subprocess.CompletedProcess[str]:
        root = Path(__file__).parents[2]
        return subprocess.run(
            [sys.executable, "-m", "tests.fuzz", *args], capture_output=True, text=True, timeout=100, cwd=root
        )

    done = run("--inputs", "20", "force")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[1].split()[:2] == ["force", "20"]
    assert run("nothing").returncode == 2
