"""A model of depth in another Python: its answers come over, and whatever else it does is said and survived."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from fluidlift.backends import depth_process
from fluidlift.backends.depth_anything import LICENCE_3
from fluidlift.backends.monocular_depth import make_depth_estimator
from fluidlift.backends.registry import ModelChoice
from fluidlift.errors import FluidliftError, InputRejected, MissingPackage
from fluidlift.types import PinholeCamera

H, W = 30, 44

NETWORK = '''
import os, signal, sys, time, types
import numpy as np, torch

print("a package that is talkative")

class DepthAnything3(torch.nn.Module):
    """Answers with the red of the picture, as metres for a focal length of 300 px."""

    model_name = "da3metric-large"

    def __init__(self):
        super().__init__()
        self.body = torch.nn.Linear(2, 2)

    @classmethod
    def from_pretrained(cls, folder, local_files_only):
        assert local_files_only and os.environ["HF_HUB_OFFLINE"] == "1"
        return cls()

    def inference(self, images):
        print("thinking")
        what = os.environ.get("STAND_IN", "")
        if what == "crash":
            print("the last words of a network", file=sys.stderr, flush=True)
            os._exit(7)
        if what == "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        if what == "slow":
            time.sleep(60)
        if what == "wild":
            np.ones(2**48, np.uint8)
        if what == "nothing":
            images = [0 * image for image in images]
        depth = images[0][None, ..., 0].astype(np.float32)
        return types.SimpleNamespace(depth=depth, sky=None, intrinsics=None, is_metric=0)
'''


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Depth Anything 3's package in the other Python, and weights for it."""
    save_file = pytest.importorskip("safetensors.torch", reason="safetensors is not installed").save_file
    package = tmp_path / "elsewhere" / "depth_anything_3"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "api.py").write_text(NETWORK)
    monkeypatch.setenv("PYTHONPATH", str(package.parent))
    weights = tmp_path / "weights"
    weights.mkdir()
    save_file({f"body.{k}": v for k, v in torch.nn.Linear(2, 2).state_dict().items()}, weights / "model.safetensors")
    return weights


def model_of(weights, told=None, **more):
    announce = (lambda line: None) if told is None else told.append
    choice = ModelChoice(weights, announce=announce, **{"python": Path(sys.executable), **more})
    return make_depth_estimator("depth-anything-3", choice)


def picture(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(1, 256, (H, W, 3), dtype=np.uint8)


def gone(process) -> bool:
    """Whether nothing of its group is left."""
    try:
        os.killpg(process.pid, 0)
    except ProcessLookupError:
        return True
    return process.poll() is not None


def test_answers_come_over_one_after_the_other(stand_in):
    told: list[str] = []
    model = model_of(stand_in, told)
    assert told == [LICENCE_3] and "depth_anything_3" not in sys.modules
    for seed in range(3):
        found = model.guess(picture(seed), None)
        assert found.holds == "relative" and found.field_of_view is None and found.normals is None
        np.testing.assert_array_equal(found.values, picture(seed)[..., 0])
    camera = PinholeCamera((600.0, 600.0), (W, H), (2 * W, 2 * H))  # of the clip at twice the size
    found = model.guess(picture(), camera)
    assert found.holds == "metres"
    np.testing.assert_allclose(found.values, picture()[..., 0], rtol=1e-6)  # a focal length of 300 px
    process = model._process
    del model
    assert gone(process)  # nobody asks any more


@pytest.mark.parametrize(
    ("what", "error", "says"),
    [
        ("crash", FluidliftError, "exit code 7"), ("crash", FluidliftError, "the last words of a network"),
        ("killed", FluidliftError, "out of memory"), ("wild", FluidliftError, "out of memory"),
        ("slow", FluidliftError, "longer than 8 s"), ("nothing", InputRejected, "no depth"),
    ],
)  # fmt: skip
def test_what_goes_wrong_is_told_and_nothing_is_left(stand_in, monkeypatch, what, error, says):
    monkeypatch.setenv("STAND_IN", what)
    model = model_of(stand_in, seconds=8.0 if what == "slow" else 60.0)
    began = time.monotonic()
    with pytest.raises(error, match=says):
        model.guess(picture(), None)
    assert time.monotonic() - began < 30.0 and gone(model._process)
    with pytest.raises(FluidliftError, match="has ended"):
        model.guess(picture(), None)


def test_that_python_needs_nothing_of_ours(stand_in):
    """Neither fluidlift nor jaxtyping, which its annotations name."""
    (stand_in.parent / "elsewhere" / "jaxtyping.py").write_text("raise ImportError('not here')")
    (stand_in.parent / "elsewhere" / "fluidlift.py").write_text("raise ImportError('not here')")
    np.testing.assert_array_equal(model_of(stand_in).guess(picture(), None).values, picture()[..., 0])


def test_what_is_missing_is_told(stand_in, monkeypatch, tmp_path):
    with pytest.raises(InputRejected, match=r"model\.safetensors"):
        model_of(tmp_path)
    (stand_in / "model.safetensors").write_bytes(b"nonsense")
    with pytest.raises(InputRejected, match="damaged"):
        model_of(stand_in)
    with pytest.raises(MissingPackage, match=r"depth\.python"):
        model_of(stand_in, python=tmp_path / "no_python")
    monkeypatch.delenv("PYTHONPATH")
    with pytest.raises(MissingPackage, match="depth_anything_3 is not installed"):
        model_of(stand_in)


READY = """print('{"state": "ready"}', flush=True)
sys.stdin.buffer.readline(), sys.stdin.buffer.readline()
"""
ANSWER = '{"state": "answer", "holds": "metres", "field_of_view": null, "normals": false}'


@pytest.mark.parametrize(
    ("script", "says"),
    [
        ("pass", "it sent the end"), ("print('hello', flush=True)", "no JSON"),
        ("print('[]', flush=True)", "no message"),
        ("print('x' * 100_000, flush=True)", "a line without end"), ("print('{}', flush=True)", "ready"),
        ("print('[' * 60_000, flush=True)", "no JSON"),
        (f"{READY}\nprint('{{}}', flush=True)", "an answer that is none"),
        (f"{READY}\nprint('{ANSWER}'.replace('metres', 'miles'), flush=True)", "an answer that is none"),
        (f"{READY}\nprint('{ANSWER}'.replace('null', '400'), flush=True)", "a field of view that is none"),
        (f"{READY}\nprint('{ANSWER}', flush=True)\nsys.stdout.write('too short')", "the end"),
        (f"{READY}\nsys.stdin.close()", "the end|nothing more"),
    ],
)  # fmt: skip
def test_a_runner_that_does_not_keep_to_the_protocol_is_not_believed(stand_in, monkeypatch, tmp_path, script, says):
    other = tmp_path / "other_runner.py"
    other.write_text(f"import sys\n{script}\n")
    monkeypatch.setattr(depth_process, "RUNNER", other)
    with pytest.raises(FluidliftError, match=says):
        model_of(stand_in, seconds=20.0).guess(picture(), None)


def test_no_more_is_read_than_was_agreed(stand_in, monkeypatch, tmp_path):
    """A process that sends without end fills no memory: what follows the answer stays in the pipe."""
    other = tmp_path / "other_runner.py"
    other.write_text(
        f"import sys\n{READY}\nprint('{ANSWER}', flush=True)\n"
        "while True:\n    sys.stdout.buffer.write(bytes([0, 0, 128, 63]) * 2**16)\n"
    )
    monkeypatch.setattr(depth_process, "RUNNER", other)
    model = model_of(stand_in, seconds=20.0)
    found = model.guess(picture(), None)
    assert found.values.shape == (H, W) and (found.values == 1.0).all()
    process = model._process
    del model
    assert gone(process)
