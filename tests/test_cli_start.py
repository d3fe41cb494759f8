"""The command line answers at once and says by its exit code whose fault it was."""

import subprocess
import sys

import pytest

from fluidlift import __version__
from fluidlift.cli import DONE, REJECTED, USAGE

HEAVY = {"torch", "numba", "scipy", "cv2", "av", "pxr", "trimesh", "matplotlib"}

ASK = """
import sys
from fluidlift import cli
for command in {commands!r}:
    try:
        code = cli.main(command)
    except SystemExit as stop:
        code = stop.code
    assert not code, (command, code)
print("loaded:", *sorted(set(sys.modules) & {heavy!r}), file=sys.stderr)
"""


def fluidlift(*args: str, cwd=None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "fluidlift", *args]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=cwd)


def test_help_and_version_load_no_heavy_package():
    names = ["make", "fit", "sim", "inspect", "mask", "motion", "evaluate", "validate", "demo", "doctor"]
    commands = [["--help"], ["--version"], *([n, "--help"] for n in names)]
    code = ASK.format(commands=commands, heavy=HEAVY)
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    assert run.stderr.strip().splitlines()[-1] == "loaded:"


def test_torch_is_not_loaded_before_it_is_needed():
    """Two seconds, for a mask, or for an asset whose body is known already."""
    code = "import sys, fluidlift.pipeline.make\nassert 'torch' not in sys.modules"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr


def test_the_version_is_that_of_the_package():
    run = fluidlift("--version")
    assert (run.returncode, run.stdout.strip()) == (DONE, f"fluidlift {__version__}")


@pytest.mark.parametrize(
    "args",
    [
        [],
        ["brew"],
        ["make"],
        ["make", "clip.mp4", "--preset", "best"],
        ["make", "clip.mp4", "--size", "wide"],
        ["make", "clip.mp4", "--colour", "blue"],
        ["mask", "clip.mp4"],
        ["motion", "clip.mp4"],
        ["motion", "clip.mp4", "-o", "out", "--format", "tiff"],
        ["evaluate"],
        ["fit"],
        ["fit", "a.fluid", "--method", "guess"],
    ],
    ids=" ".join,
)
def test_wrong_usage_is_told_apart_from_wrong_input(args):
    run = fluidlift(*args)
    assert run.returncode == USAGE
    assert run.stdout == "" or "usage" in run.stdout.lower()
    assert run.stderr.strip() and "Traceback" not in run.stderr


@pytest.mark.parametrize(
    "args",
    [
        ["make", "missing.mp4"],
        ["inspect", "missing.mp4"],
        ["validate", "missing.fluid"],
        ["evaluate", "missing.fluid"],
        ["fit", "missing.fluid"],
        ["mask", "missing.mp4", "-o", "out"],
        ["motion", "missing.mp4", "-o", "out"],
        ["motion", "missing.mp4", "-o", "out", "--set", "motion.half_window=-1"],
        ["make", "missing.mp4", "--set", "fit.hold=[viscosty=1e-6]"],
        ["make", "missing.mp4", "--set", "fit.colour=blue"],
        ["make", "missing.mp4", "--config", "missing.yaml"],
    ],
    ids=" ".join,
)
def test_wrong_input_is_rejected_in_one_line_and_leaves_nothing(args, tmp_path):
    run = fluidlift(*args, cwd=tmp_path)
    assert run.returncode == REJECTED
    assert run.stdout == ""
    assert run.stderr.startswith("fluidlift: ") and len(run.stderr.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_reading_a_scene_without_bodies_loads_nothing_that_bodies_need():
    code = f"import fluidlift.scene.edits, sys; print(*sorted(set(sys.modules) & {HEAVY!r}))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (run.returncode, run.stdout.strip()) == (0, ""), run.stderr
