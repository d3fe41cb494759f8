"""The edits of benchmarks/edits fit an asset; those whose checks mean something in a few frames of a clip pass."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from fluidlift.cli import main

ROOT = Path(__file__).resolve().parents[1]
EDITS = sorted((ROOT / "benchmarks" / "edits").glob("0*.py"))
FRAMES = {"01": 4, "03": 6, "05": 8}
"""of the edits that are run; a duck needs a second to settle (06), a stream as long to turn (02), and honey is told
from water by the speed that it has lost until then (04)"""


def ran(script: Path, asset: Path, out: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """A script on a copy of an asset, as a person starts it."""
    return subprocess.run(
        [sys.executable, str(script), "--asset", str(asset), "--out", str(out), *options],
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip


def commands(script: Path) -> list[list[str]]:
    """The `fluidlift edit` lines of a script's first words, without the asset's name."""
    import shlex

    text = script.read_text().split('"""')[1].replace("\\\\\n", " ")
    lines = re.findall(r"^ +fluidlift edit demo\.fluid (.*)$", text, re.M)
    return [shlex.split(line) for line in lines]


def test_there_are_six_numbered_edits_and_each_is_named_in_the_readme_and_the_page_on_editing():
    assert [p.name[:2] for p in EDITS] == ["01", "02", "03", "04", "05", "06"]
    for page in ("benchmarks/edits/README.md", "docs/editing.md"):
        text = (ROOT / page).read_text()
        assert [p.name for p in EDITS if p.name not in text] == [], page


@pytest.mark.parametrize("script", EDITS, ids=lambda p: p.stem)
def test_an_edit_fits_the_asset(script, made, tmp_path):
    found = ran(script, made.folder, tmp_path, "--dry")
    assert found.returncode == 0, found.stdout + found.stderr
    assert "\n+" in found.stdout  # a line of scene.yaml that was not there
    assert "stale: " in found.stdout and "simulate" in found.stdout.rpartition("stale: ")[2]


@pytest.mark.parametrize("script", [p for p in EDITS if p.name[:2] in FRAMES], ids=lambda p: p.stem)
def test_an_edit_passes_its_own_checks(script, made, tmp_path):
    found = ran(script, made.folder, tmp_path, "--frames", str(FRAMES[script.name[:2]]))
    assert found.returncode == 0, found.stdout + found.stderr
    assert "all checks passed" in found.stdout and found.stdout.count("ok  ") >= 5
    assert list(tmp_path.glob(f"{script.name[:2]}_*.png"))


@pytest.mark.parametrize("script", EDITS, ids=lambda p: p.stem)
def test_the_commands_that_an_edit_names_are_accepted(script, made, tmp_path, capsys):
    from importlib import util

    asset = tmp_path / "demo.fluid"
    shutil.copytree(made.folder, asset)
    spec = util.spec_from_file_location("duck", ROOT / "benchmarks" / "edits" / "duck.py")
    duck = util.module_from_spec(spec)
    spec.loader.exec_module(duck)
    duck.write_duck(asset / "duck.obj", 0.2)
    for words in commands(script):
        words = [w for w in words if w != "--simulate"]
        assert main(["edit", str(asset), *words]) in (0, 4), capsys.readouterr()  # 4: with a warning
    assert commands(script)
