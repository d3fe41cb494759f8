"""A stand-in for `fluidlift make` that takes a moment, and shots for it."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fluidlift.farm.engine import Limits
from fluidlift.farm.shots import Shot

MAKE = """
import json, os, pathlib, sys, time
from fluidlift.farm.guard import end_with_parent
end_with_parent()
args = dict(a.removeprefix("--").split("=", 1) for a in sys.argv if a.startswith("--") and "=" in a)
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
with (out.parent / (out.stem + ".runs")).open("a") as runs:
    runs.write("run\\n")
what = args.get("kind", "")
print("[1/2] reading", file=sys.stderr, flush=True)
if what == "slow":
    time.sleep(60)
if what == "big":
    held = bytearray(300_000_000); time.sleep(60)
if what == "wrong":
    print("fluidlift: no such video", file=sys.stderr); sys.exit(3)
if what == "broken":
    sys.exit(1)
time.sleep(float(args.get("size", 0)))
out.mkdir(exist_ok=True)
(out / "manifest.json").write_text(json.dumps({"of": sys.argv[2], "threads": os.environ["OMP_NUM_THREADS"]}))
told = {"warnings": ["foam"] if what == "foamy" else [], "stages": {"read": {"peak_memory_mb": 12.5}},
        "as_filmed": {"verdict": "usable"}}
print(json.dumps(told))
sys.exit(4 if what == "foamy" else 0)
"""


@pytest.fixture
def limits(tmp_path: Path) -> Limits:
    """One at a time, made by the stand-in."""
    script = tmp_path / "make.py"
    script.write_text(MAKE)
    return replace(Limits(), program=(sys.executable, str(script)))


@pytest.fixture
def shot(tmp_path: Path):
    """Makes a shot of a clip of its own; `kind` says how it ends."""

    def of(name: str, kind: str = "", **options) -> Shot:
        clip = tmp_path / f"{name}.mp4"
        if not clip.exists():
            clip.write_text(f"film {name}")
        return Shot(clip, name, ({"kind": kind} if kind else {}) | options)

    return of


@pytest.fixture
def runs():
    """How often the stand-in was started for a shot of a folder."""

    def of(folder: Path, name: str) -> int:
        file = folder / f"{name}.runs"
        return len(file.read_text().splitlines()) if file.exists() else 0

    return of
