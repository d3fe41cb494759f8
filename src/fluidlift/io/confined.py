"""Readers of files from strangers, run in another process with bounds on memory and time.

What a header says is bounded before anything is decoded (`io.limits`). This is the net below that, for what a decoder
does with a file that nobody has thought of: reading it ends in one line, and the caller lives.

A process has one child, which the first file starts: that takes 0.3 s, most of it NumPy and OpenCV, which is why there
is not one for every file. It serves one request after the other, and ends when it has had none for a while. What comes
back are plain arrays behind a header of JSON, never pickles: bytes of the child are trusted as little as the file.

Read like this are pictures (OpenCV decodes PNG, JPEG, TIFF, WebP and BMP in C and C++), OpenEXR, panoramas, and meshes
with their textures; all of them, since a file does not say who wrote it. Not read like this are splats and arrays,
which are read by the thousand and which NumPy takes as they are, and videos and USD, whose libraries keep open what
they have opened. The bounds are no sandbox: a decoder that a file takes over may do what the user may do.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import math
import os
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fluidlift.errors import FluidliftError, InputRejected
from fluidlift.io.limits import MAX_PIXEL_BYTES, ReadLimits
from fluidlift.machine import THREADS
from fluidlift.types import TriangleMesh

T = TypeVar("T", np.ndarray, dict[str, np.ndarray], TriangleMesh)

LENGTH = struct.Struct("<Q")
"""bytes of the JSON that follows"""
MAX_HEAD = 2**20
"""bytes of that JSON"""
MESH = ("vertices", "faces", "colors", "uv", "texture")
"""arrays of a mesh; the last three may be missing"""
_KINDS = "biuf"
"""of NumPy's types: whole numbers, floats and truth values"""
_UNSOUND = ("an undamaged file", "do not use it if it comes from a stranger; otherwise export it again")


@dataclass(frozen=True)
class Bounds:
    """What reading one file may take."""

    memory: int = 3 * 2**30
    """bytes, besides what the child holds anyway: for a file of 1 GiB and the largest picture, three times over"""
    seconds: int = 120
    """s of processor time: twice what the largest OBJ that is taken needs on a busy machine"""
    patience: float = 600.0
    """s on the clock, for what waits and takes no processor time: a drive that does not answer"""

    @classmethod
    def of(cls, limits: ReadLimits) -> Bounds:
        """More memory where a user lets larger pictures in."""
        return cls(max(cls.memory, 2**30 + 3 * MAX_PIXEL_BYTES * limits.max_pixels))


def read_confined(
    reader: Callable[[Path, ReadLimits], T], path: Path, limits: ReadLimits | None = None, bounds: Bounds | None = None
) -> T:
    """What `reader(path, limits)` gives, from the child; called directly where this is the child.

    Args:
        reader: a function of a module; the child imports it by its name.
        path: an existing file.
        limits: handed on.
        bounds: by default `Bounds.of(limits)`.

    Raises:
        InputRejected: what the reader raises; or reading takes more than the bounds, or crashes.
        FluidliftError: the child cannot be started.
    """
    limits = limits or ReadLimits()
    if _this.direct:
        return reader(path, limits)
    if _this.child is None or _this.child.owner != os.getpid():  # a fork would talk on the line of its parent
        _this.child = Child()
    return _this.child.read(reader, path, limits, bounds or Bounds.of(limits))


@contextlib.contextmanager
def reading_here() -> Iterator[None]:
    """Readers are called directly while the block runs: in the child, and where tests look into a reader."""
    before, _this.direct = _this.direct, True
    try:
        yield
    finally:
        _this.direct = before


class _Late(Exception):
    """Nothing came in time."""


class Child:
    """A process that reads, and the line to it."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        atexit.register(self.end)

    def read(self, reader: Callable[..., Any], path: Path, limits: ReadLimits, bounds: Bounds) -> Any:
        """As `read_confined`. Requests of several threads wait for each other."""
        asked = {
            "reader": [reader.__module__, reader.__name__], "path": os.path.abspath(path), "limits": vars(limits),
            "memory": bounds.memory, "seconds": bounds.seconds,
        }  # fmt: skip
        request = json.dumps(asked).encode()
        with self._lock:
            try:
                answer = self._asked(request, bounds)
                if answer is None and self._process is not None and self._process.returncode == 0:
                    answer = self._asked(request, bounds)  # it was idle, and ended as it was asked
            except _Late:
                self.end()
                raise _beyond(path, f"{bounds.patience:g} s") from None
            except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
                self.end()
                raise InputRejected(f"reading '{path.name}' gave nonsense ({error})", *_UNSOUND) from None
            except BaseException:  # an interrupt: the next request would get this one's answer
                self.end()
                raise
            if answer is None:
                raise self._death(path, bounds)
        return _value(*answer, path, bounds)

    def end(self) -> None:
        """End the process, whatever it does."""
        process = self._process
        if process is None or self.owner != os.getpid():
            return
        process.kill()
        process.wait()
        for line in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):  # what was not sent any more
                if line is not None:
                    line.close()

    def _asked(self, request: bytes, bounds: Bounds) -> tuple[dict[str, Any], list[np.ndarray]] | None:
        """Header and arrays of the answer; nothing where the process has ended."""
        if self._process is None or self._process.poll() is not None:
            self._process = _started()
        to, back = self._process.stdin, self._process.stdout
        assert to is not None and back is not None
        until = time.monotonic() + bounds.patience
        try:
            to.write(LENGTH.pack(len(request)) + request)
            to.flush()
            (length,) = LENGTH.unpack(_received(back.fileno(), LENGTH.size, until))
            if length > MAX_HEAD:
                raise ValueError(f"a header of {length} bytes")
            head = json.loads(bytes(_received(back.fileno(), length, until)))
            return head, _arrays(head["arrays"], back.fileno(), until, bounds.memory)
        except (BrokenPipeError, EOFError):
            self._process.wait()
            return None

    def _death(self, path: Path, bounds: Bounds) -> InputRejected:
        """What is to be said of a process that has ended."""
        code = -self._process.returncode if self._process is not None else 0
        if code == signal.SIGXCPU:
            return _beyond(path, f"{bounds.seconds} s of processor time")
        if code == signal.SIGKILL:  # by the system, which had no memory left
            return _beyond(path, "the memory that the machine has")
        with contextlib.suppress(ValueError):
            return InputRejected(f"'{path.name}' makes its reader crash ({signal.Signals(code).name})", *_UNSOUND)
        return InputRejected(f"'{path.name}' makes its reader crash (exit code {-code})", *_UNSOUND)


@dataclass
class _This:
    """What this process reads with."""

    child: Child | None = None
    direct: bool = False


_this = _This()


def _started() -> subprocess.Popen[bytes]:
    """A new child. It finds modules where this process does, and none in the folder that happens to be the current."""
    paths = os.pathsep.join(path for path in sys.path if path)
    try:
        return subprocess.Popen(
            [sys.executable, "-P", "-m", "fluidlift.io.confined_reader"],
            env=os.environ | dict.fromkeys(THREADS, "1") | {"PYTHONPATH": paths},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except OSError as error:
        raise FluidliftError(f"No process can be started to read files in ({error.strerror}).") from None


def _received(line: int, size: int, until: float) -> memoryview:
    """So many bytes; raises EOFError, or `_Late` after the time `until` of the monotonic clock."""
    data = memoryview(bytearray(size)) if size < 2**16 else np.empty(size, np.uint8).data
    left, ready = data, select.poll()
    ready.register(line, select.POLLIN)
    while left:
        if not ready.poll(max(0.0, 1e3 * (until - time.monotonic()))):
            raise _Late
        count = os.readv(line, [left])
        if not count:
            raise EOFError
        left = left[count:]
    return data


def _arrays(told: list[Any], line: int, until: float, most: int) -> list[np.ndarray]:
    """The arrays behind a header, which has type and shape of each; raises ValueError where it does not fit."""
    found: list[np.ndarray] = []
    for name, shape in told:
        kind = np.dtype(str(name))
        if kind.kind not in _KINDS or not all(type(n) is int and n >= 0 for n in shape):
            raise ValueError(f"an array {shape} of {kind}")
        size = kind.itemsize * math.prod(shape)
        most -= size
        if most < 0:
            raise ValueError("more than its memory holds")
        found.append(np.frombuffer(_received(line, size, until), kind).reshape(shape))
    return found


def _value(head: dict[str, Any], arrays: list[np.ndarray], path: Path, bounds: Bounds) -> Any:
    """The answer as the reader gave it, or as the error that it raised."""
    if head["what"] == "refused":
        raise InputRejected(*(str(part) for part in head["why"]))
    if head["what"] == "memory":
        raise _beyond(path, f"{bounds.memory / 2**30:.3g} GB of memory")
    if head["what"] == "failed":
        error = InputRejected(f"'{path.name}' cannot be read ({head['why'][0]})", *_UNSOUND)
        error.add_note(str(head["why"][1]))
        raise error
    if head["what"] == "array":
        return arrays[0]
    named = dict(zip(head["names"], arrays, strict=True))
    return TriangleMesh(**named) if head["what"] == "mesh" else named


def _beyond(path: Path, bound: str) -> InputRejected:
    return InputRejected(
        f"reading '{path.name}' takes more than {bound}", "a file that is read within that",
        "do not use it if it comes from a stranger; otherwise make it smaller",
    )  # fmt: skip
