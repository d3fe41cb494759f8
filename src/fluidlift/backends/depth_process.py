"""A learned model of depth in a process of its own, in another Python: for packages that cannot live beside ours.

`depth_runner` says what goes over. Here: the process is started with a group of its own, asked, waited for no longer
than agreed, ended as a group, and nothing that it says is believed before it was looked at.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import tempfile
import time
import weakref
from pathlib import Path
from typing import IO, Any

import numpy as np

from fluidlift.backends.depth_model import DepthModel, Guess
from fluidlift.backends.depth_pictures import require_answer, require_picture
from fluidlift.backends.generator_process import PACKAGE, end_group, foreign_environment, out_of_memory
from fluidlift.backends.registry import ModelChoice
from fluidlift.errors import FluidliftError, InputRejected, MissingPackage
from fluidlift.types import PinholeCamera

RUNNER = Path(__file__).with_name("depth_runner.py")
PROTOCOL = 1
MOST_LINE = 2**16
"""bytes of the line of a message"""
LAST_BYTES, LAST_LINES = 2**14, 8
"""of what a process that broke down has printed, which are shown"""
_HOLDS = ("metres", "relative", "disparity")
_WIDEST = 180.0


class DepthProcess(DepthModel):
    """A model of depth in another Python.

    Args:
        name: of the model, of `monocular_depth.DEPTH_MODELS`.
        choice: its weights and device, that Python, and the s that a picture may take (the loading of the weights with
            the first).

    Raises:
        MissingPackage: no such Python, or packages that it lacks.
        InputRejected: weights that do not fit.
        FluidliftError: it broke down, took too long or too much memory, or says what is no answer.
    """

    def __init__(self, name: str, choice: ModelChoice) -> None:
        self._name, self._python, self._seconds = name, choice.python, choice.seconds
        self._announce = choice.announce
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
        weights = str(choice.weights)
        job = {
            "protocol": PROTOCOL, "model": name, "device": choice.device, "allow_download": choice.allow_download,
            "weights": str(Path(weights).absolute()) if Path(weights).exists() else weights,
            "memory": _memory() if choice.device == "cpu" else None,
        }  # fmt: skip
        self._process = self._started(choice)
        # also when nobody asks any more: no process is left behind
        self._end = weakref.finalize(self, _ended, self._process, self._log)
        self._send(json.dumps(job).encode() + b"\n", time.monotonic() + self._seconds)
        if self._message(time.monotonic() + self._seconds).get("state") != "ready":
            raise self._broken("no word that it is ready")

    def guess(self, image: np.ndarray, camera: PinholeCamera | None) -> Guess:
        """What the model says of a picture; raises as the class does."""
        require_picture(image)
        if not self._end.alive:
            raise FluidliftError(f"{self._name} has ended. Needed: a process that runs. Do: ask anew.")
        height, width = image.shape[:2]
        until = time.monotonic() + self._seconds
        focal = None if camera is None else float(camera.focal[0] * width / camera.size[0])
        asked = {"width": width, "height": height, "focal": focal}
        self._send(json.dumps(asked).encode() + b"\n" + np.ascontiguousarray(image).tobytes(), until)
        said = self._message(until)
        holds, view, with_normals = said.get("holds"), said.get("field_of_view"), said.get("normals")
        if said.get("state") != "answer" or holds not in _HOLDS or with_normals not in (True, False):
            raise self._broken("an answer that is none")
        if view is not None and not (isinstance(view, int | float) and 0.0 < view < _WIDEST):
            raise self._broken("a field of view that is none")
        values = self._floats((height, width), until)
        values = np.where(np.isfinite(values), values, np.float32(np.nan))
        normals = self._floats((height, width, 3), until) if with_normals else None
        if holds != "disparity":
            values = require_answer(values, self._name)
        return Guess(values, holds, None if view is None else float(view), normals)

    def _started(self, choice: ModelChoice) -> subprocess.Popen:
        environment = foreign_environment() | {"PYTHONUNBUFFERED": "1"}
        if not choice.allow_download:
            environment |= {"HF_HUB_OFFLINE": "1", "TRANSFORMERS_OFFLINE": "1"}
        try:
            return subprocess.Popen(
                [str(choice.python), str(RUNNER), str(PACKAGE)], env=environment, stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, stderr=self._log, start_new_session=True, bufsize=0,
            )  # fmt: skip
        except OSError as error:
            raise MissingPackage(
                f"'{choice.python}' does not start ({error.strerror or error}). Needed: the Python of the environment "
                f"in which {self._name} is installed. Do: name it with --set depth.python=PATH."
            ) from None

    def _send(self, data: bytes, until: float) -> None:
        pipe = self._process.stdin
        assert pipe is not None
        os.set_blocking(pipe.fileno(), False)
        left = memoryview(data)
        while left:
            _, ready, _ = select.select([], [pipe], [], max(0.0, until - time.monotonic()))
            if not ready:
                raise self._late()
            try:
                left = left[os.write(pipe.fileno(), left[: 2**16]) :]
            except BlockingIOError:
                continue
            except BrokenPipeError:
                self._message(until)  # what it has said last
                raise self._broken("nothing more") from None

    def _message(self, until: float) -> dict[str, Any]:
        """The line of the next message; of a failure it is raised, and what the model announces is told."""
        while True:
            found = self._line(until)
            if found.get("state") == "failed":
                raise self._told(str(found.get("kind")), str(found.get("message"))[:600])
            if found.get("state") != "says":
                return found
            self._announce(str(found.get("line"))[:600])

    def _line(self, until: float) -> dict[str, Any]:
        line = bytearray()
        while not line.endswith(b"\n"):
            if len(line) > MOST_LINE:
                raise self._broken("a line without end")
            line += self._read(1, until)
        try:
            found = json.loads(line)
        except (ValueError, RecursionError):
            raise self._broken("what is no JSON") from None
        if not isinstance(found, dict):
            raise self._broken("what is no message")
        return found

    def _floats(self, shape: tuple[int, ...], until: float) -> np.ndarray:
        """float32 of a shape that was agreed: no more is read than that takes."""
        return np.frombuffer(self._read(4 * int(np.prod(shape)), until), "<f4").reshape(shape).astype(np.float32)

    def _read(self, count: int, until: float) -> bytes:
        pipe = self._process.stdout
        assert pipe is not None
        parts, left = [], count
        while left:
            ready, _, _ = select.select([pipe], [], [], max(0.0, until - time.monotonic()))
            if not ready:
                raise self._late()
            part = os.read(pipe.fileno(), min(left, 2**20))
            if not part:
                raise self._broken("the end")
            parts.append(part)
            left -= len(part)
        return b"".join(parts)

    def _late(self) -> FluidliftError:
        self._end()
        return FluidliftError(
            f"{self._name} took longer than {self._seconds:g} s for a picture and was stopped. Needed: a faster device "
            "or more time. Do: --set depth.seconds=..., or smaller pictures with read.max_size."
        )

    def _told(self, kind: str, message: str) -> FluidliftError:
        """What the process itself says of its failure."""
        self._end()
        if kind == "missing":
            return MissingPackage(
                f"{self._name} is not installed in {self._python} ({message}). Needed: its package there. Do: see "
                "docs/depth.md for the command."
            )
        if kind == "memory":
            return _no_memory(self._name, message)
        if kind == "rejected":
            return InputRejected(
                f"{self._name} refuses: {message}", "what it takes", "see what it says; --set depth.weights=PATH"
            )
        return FluidliftError(f"{self._name} broke down ({message}). Do: check its environment {self._python}.")

    def _broken(self, got: str) -> FluidliftError:
        """It ended, or says what nobody understands."""
        process = self._process
        try:
            code = process.wait(1.0)
        except subprocess.TimeoutExpired:
            code = None
        text = _tail(self._log)
        self._end()
        if code == -signal.SIGKILL or out_of_memory(text):
            return _no_memory(self._name, "the system stopped it" if code == -signal.SIGKILL else "")
        how = "" if code is None else f", signal {-code}" if code < 0 else f", exit code {code}"
        said = f"Its last lines:\n  {text}" if text else "It printed nothing."
        return FluidliftError(
            f"{self._name} in {self._python} broke down: it sent {got}{how}. Needed: an answer by depth_runner's "
            f"protocol. Do: check that environment. {said}"
        )


def _no_memory(name: str, message: str) -> FluidliftError:
    return FluidliftError(
        f"{name} ran out of memory{': ' + message if message else ''}. Needed: more memory, or smaller pictures. Do: "
        "lower read.max_size, or take a smaller model."
    )


def _ended(process: subprocess.Popen, log: IO[bytes]) -> None:
    end_group(process)
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            pipe.close()
    log.close()


def _tail(log: IO[bytes]) -> str:
    log.seek(max(0, log.seek(0, os.SEEK_END) - LAST_BYTES))
    lines = [line[:300] for line in log.read().decode("utf-8", "replace").splitlines() if line.strip()]
    return "\n  ".join("".join(c for c in line if c.isprintable()) for line in lines[-LAST_LINES:])


def _memory() -> int | None:
    """Bytes of this machine's memory, which the address space of a process on the CPU must not go beyond twice."""
    try:
        return 2 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return None
