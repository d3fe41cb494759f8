"""A generator in a process of its own: what it makes is taken, and whatever else it does is said and survived."""

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fluidlift.backends import generator_process
from fluidlift.backends.generator_card import GeneratorCard
from fluidlift.backends.generator_process import (
    GeneratorFailed,
    GeneratorProcess,
    Picture,
    ProcessChoice,
    checked_elsewhere,
    environment,
)
from fluidlift.errors import MissingPackage
from fluidlift.shape.external_body import near_and_far

RUNNER = Path(__file__).with_name("stand_in_runner.py")
CARD = GeneratorCard(
    name="trellis",  # one that the real runner knows
    title="Stand-in (2026)",
    licence="free",
    licence_commercial=True,
    home="https://example.org",
    packages=("a_package_that_is_not_there",),
    hardware="a GPU with 99 GB",
    weights=(),
)
SIZE = (48, 40)


def pictures(frames=(3,)):
    mask = np.zeros(SIZE[::-1], bool)
    mask[10:30, 8:40] = True
    image = np.random.default_rng(0).integers(0, 255, (*mask.shape, 3), dtype=np.uint8)
    return [Picture(frame, image, mask) for frame in frames]


@pytest.fixture
def asked(tmp_path, monkeypatch):
    """Where the stand-in notes the frames that it was asked for."""
    monkeypatch.setenv("STAND_IN_ASKED", str(tmp_path / "asked"))
    return tmp_path / "asked"


@pytest.fixture
def process(tmp_path, asked, monkeypatch):
    """Makes a process that behaves in a named way; its job folders must all be gone at the end."""
    jobs = tmp_path / "jobs"
    jobs.mkdir()

    def make(what, **choice):
        monkeypatch.setenv("STAND_IN", what)
        return GeneratorProcess(CARD, ProcessChoice(**{"runner": RUNNER, "temporary": jobs, **choice}))

    yield make
    assert not list(jobs.iterdir())


def test_bodies_of_all_frames_come_over_with_the_camera_that_shows_them_at_the_fluid(process, asked):
    found = list(process("success").bodies(pictures((3, 5))))
    assert [frame for frame, _, _ in found] == [3, 5] and asked.read_text().split() == ["3", "5"]
    picture = pictures()[0]
    for _, body, camera in found:
        assert camera.size == SIZE and len(body) == 2 * picture.mask.sum()
        near, far = near_and_far(body, camera, picture.mask)
        assert (far >= near)[picture.mask].all()
        uv, _ = camera.project(body.means)
        shown = np.zeros_like(picture.mask)
        shown[tuple(np.floor(uv).astype(int).T[::-1])] = True
        # the back side lies deeper on the same rays: both show where the mask is and nowhere else
        np.testing.assert_array_equal(shown, picture.mask)


def test_one_body_is_what_the_seam_asks_for(process):
    picture = pictures()[0]
    body, camera = process("success").generate(picture.image, picture.mask, 7)
    assert len(body) and camera.size == SIZE


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("crash", "tensors of different size"),
        ("memory", "out of memory"),
        ("killed", "out of memory"),
        ("nothing", "without a body"),
        ("rejected", "refused frame 3"),
        ("garbage", "not a PLY"),
        ("half a file", "promises"),
        ("no camera", "no body of frame 3"),
        ("empty", "empty body"),
        ("faint", "empty body"),
        ("nan", "not finite"),
        ("elsewhere", "does not show where the fluid is"),
        ("behind", "does not show where the fluid is"),
    ],
)
def test_a_failure_is_said_with_its_remedy(process, what, said):
    with pytest.raises(GeneratorFailed) as failure:
        list(process(what).bodies(pictures()))
    text = str(failure.value)
    assert said in text and "Stand-in" in text
    if what in ("memory", "killed"):
        assert "a GPU with 99 GB" in text and "generate.device" in text
    if what == "crash":
        assert "fluidlift generators trellis" in text and "loading the network" in text


def test_packages_that_the_other_environment_lacks_are_named(process):
    with pytest.raises(MissingPackage, match="No module named 'spconv'"):
        list(process("missing").bodies(pictures()))


def test_what_was_made_before_a_crash_is_not_lost(process, asked):
    found = []
    with pytest.raises(GeneratorFailed, match="frame 5"):
        for frame, _, _ in process("second: crash").bodies(pictures((3, 5, 8))):
            found.append(frame)
    assert found == [3] and asked.read_text().split() == ["3", "5"]


def alive(pid):
    """Whether a process runs (one that has ended and is not waited for counts as gone)."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_a_process_that_takes_too_long_is_ended_with_its_children(process, asked, patience_ends):
    patience_ends(asked.with_suffix(".child"))
    with pytest.raises(GeneratorFailed, match="longer than 600 s for frame 3") as failure:
        list(process("hang", frame_seconds=600.0).bodies(pictures()))
    assert "generate.frame_seconds" in str(failure.value)
    child = int(asked.with_suffix(".child").read_text())
    for _ in range(100):
        if not alive(child):
            break
        time.sleep(0.02)
    assert not alive(child)


def test_a_caller_that_stops_asking_leaves_no_process(process, asked):
    one = process("second: hang").bodies(pictures((3, 5)))
    next(one)
    for _ in range(500):  # until it hangs
        if asked.with_suffix(".child").exists():
            break
        time.sleep(0.02)
    one.close()
    assert not alive(int(asked.with_suffix(".child").read_text()))


def test_a_python_that_is_not_there_is_named(process, tmp_path):
    with pytest.raises(MissingPackage, match="--generator-python"):
        list(process("success", python=tmp_path / "python").bodies(pictures()))


def test_the_real_runner_says_which_package_an_environment_lacks(process):
    with pytest.raises((MissingPackage, GeneratorFailed), match="not installed"):
        list(process("success", runner=generator_process.RUNNER, device="cpu").bodies(pictures()))


def test_a_check_tells_what_another_python_has():
    found = checked_elsewhere(Path(sys.executable), None, ("numpy", "a_package_that_is_not_there"))
    assert found["missing"] == ["a_package_that_is_not_there"]
    assert found["python"] == ".".join(map(str, sys.version_info[:3]))
    assert bool(found["gpu"]) != bool(found["no_gpu"])


def test_a_check_sees_the_code_of_a_checkout_but_not_the_adapter_of_the_same_name(tmp_path):
    """Beside the runner lies a module trellis.py, which is not TRELLIS."""
    (tmp_path / "torch.py").write_text("raise ModuleNotFoundError('no torch')\n")  # the real one takes seconds
    found = checked_elsewhere(Path(sys.executable), tmp_path, ("trellis",))
    assert found["missing"] == ["trellis"] and found["no_gpu"] == "torch is not installed"
    (tmp_path / "trellis").mkdir()
    (tmp_path / "trellis" / "__init__.py").write_text("")
    assert checked_elsewhere(Path(sys.executable), tmp_path, ("trellis",))["missing"] == []


def test_something_that_is_no_python_gives_no_answer():
    with pytest.raises(MissingPackage, match="no answer"):
        checked_elsewhere(Path("/bin/echo"), None, ())


def test_the_other_environment_does_not_inherit_what_is_about_ours(monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONPATH", "/the/users")
    monkeypatch.setenv("PYTHONHOME", "/ours")
    monkeypatch.setenv("VIRTUAL_ENV", "/ours")
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    found = environment(CARD, ProcessChoice())
    assert "PYTHONHOME" not in found and "VIRTUAL_ENV" not in found
    assert found["HF_HUB_OFFLINE"] == "1"
    assert "HF_HUB_OFFLINE" not in environment(CARD, ProcessChoice(allow_download=True))
    # a checkout comes before what the user has exported
    both = environment(CARD, ProcessChoice(code=tmp_path))["PYTHONPATH"].split(os.pathsep)
    assert both == [str(tmp_path), "/the/users"]


def test_a_runner_of_an_environment_without_jaxtyping_can_import_the_adapters(tmp_path):
    """As in a generator's own environment: only the package itself is lent, not what lies beside it."""
    import subprocess

    (tmp_path / "jaxtyping.py").write_text("raise ImportError('not here')\n")
    code = (
        "import sys; sys.path.insert(0, sys.argv[1])\n"
        "import importlib.util as u\n"
        "spec = u.spec_from_file_location('runner', sys.argv[2]); runner = u.module_from_spec(spec)\n"
        "spec.loader.exec_module(runner)\n"
        "runner.lend_package(sys.argv[3])\n"
        "from fluidlift.backends.generators import GENERATORS, generator_class\n"
        "import fluidlift.io.ply\n"
        "print([generator_class(name).__name__ for name in GENERATORS])\n"
    )
    arguments = [str(tmp_path), str(generator_process.RUNNER), str(generator_process.PACKAGE)]
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout.replace("'", '"'))) == 5
