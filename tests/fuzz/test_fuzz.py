"""Readers of text and arrays take a thousand damaged files each: refused or read, in bounds, and nothing else opened.

Meshes, pictures, films and USD have targets as well, which are not held to this yet: `python -m tests.fuzz.trial NAME
INPUTS SEED FOLDER` from the repository tries one and keeps what it trips over (with PYTHONPATH=tests).
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from fuzz.trial import LARGEST, SLOWEST

INPUTS, SEED = 1000, 20261125
HELD = (
    "yaml", "scene", "scene-edited", "settings", "values", "shots", "camera", "distortion", "view", "manifest",
    "parameters", "asset-camera", "terrain", "velocity", "frames", "force", "history", "splats", "depth", "flow-npz",
    "flow-npy", "flow-flo", "checkpoint", "stage-facts", "stage-arrays", "stage-mapped",
)  # fmt: skip


@pytest.mark.parametrize("target", HELD)
def test_damaged_files_are_refused_or_read_within_bounds(target):
    # in a process of its own: its memory is its own, and the watch over files that are opened ends with it
    run = subprocess.run(
        [sys.executable, "-m", "fuzz.trial", target, str(INPUTS), str(SEED), ""],
        capture_output=True, text=True, timeout=300, cwd=Path(__file__).parents[1],
    )  # fmt: skip
    assert run.returncode == 0, run.stderr[-2000:]
    found = json.loads(run.stdout.strip().splitlines()[-1])
    assert found["raw"] == {}
    assert found["inputs"] == INPUTS == found["accepted"] + found["refused"]
    assert found["outside"] == []
    assert found["slowest"] < SLOWEST
    assert found["peak_bytes"] < LARGEST
