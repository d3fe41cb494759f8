"""The process that `io.confined` starts: it reads one file after the other within bounds, until there are no more."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import resource
import select
import signal
import traceback
from pathlib import Path
from typing import Any

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.confined import LENGTH, MESH, reading_here
from fluidlift.io.limits import ReadLimits
from fluidlift.types import TriangleMesh

IDLE = 20.0
"""s without a request, after which the memory is given back"""
_LONGEST = 2**12
"""characters of a message"""


def main() -> None:
    """Serve the requests on stdin until it ends, or until none comes for a while."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # meant for the process that asks, which then ends this one
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    back = os.dup(1)
    os.dup2(2, 1)  # what a library prints is no answer
    waiting, base = select.poll(), _held()
    waiting.register(0, select.POLLIN)
    with reading_here(), open(0, "rb", buffering=0) as requests:
        while waiting.poll(1e3 * IDLE):
            head = _exactly(requests, LENGTH.size)
            if not head:
                return
            request = json.loads(_exactly(requests, *LENGTH.unpack(head)))
            limit(request["memory"], request["seconds"], base)
            answer, arrays = _answer(request)
            _send(back, answer, arrays)


def limit(memory: int, seconds: int, base: int) -> None:
    """From now on, at most so many bytes more than `base` and so many seconds of processor time.

    What counts are bytes that the process asks for and may write (RLIMIT_DATA, as Linux has it), not those that
    libraries map, nor those that it has touched: the first is what a file can drive up.
    """
    use = resource.getrusage(resource.RUSAGE_SELF)
    for kind, most in (
        (resource.RLIMIT_DATA, base + memory),
        (resource.RLIMIT_CPU, int(use.ru_utime + use.ru_stime) + 1 + seconds),
    ):
        hard = resource.getrlimit(kind)[1]
        # the soft limit alone: the next file has another; past it, a processor's time ends the process (SIGXCPU)
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def _held() -> int:
    """Bytes that this process may write, now."""
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmData:"))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _exactly(file: Any, size: int) -> bytes:
    """So many bytes; fewer where the other side has closed the line."""
    data = b""
    while len(data) < size:
        more = file.read(size - len(data))
        if not more:
            break
        data += more
    return data


def _answer(request: dict[str, Any]) -> tuple[dict[str, Any], list[np.ndarray]]:
    """What the reader gives, or why it gives nothing, as a header and arrays."""
    module, name = request["reader"]
    try:
        reader = getattr(importlib.import_module(module), name)
        return _packed(reader(Path(request["path"]), ReadLimits(**request["limits"])))
    except InputRejected as error:
        return {"what": "refused", "why": [str(part)[:_LONGEST] for part in (error.got, error.needed, error.do)]}, []
    except MemoryError:
        return {"what": "memory"}, []
    except Exception as error:
        why = f"{type(error).__name__}: {error}"[:200]
        return {"what": "failed", "why": [why, traceback.format_exc()[-_LONGEST:]]}, []


def _packed(value: np.ndarray | dict[str, np.ndarray] | TriangleMesh) -> tuple[dict[str, Any], list[np.ndarray]]:
    if isinstance(value, np.ndarray):
        return {"what": "array"}, [np.ascontiguousarray(value)]
    held = value if isinstance(value, dict) else {n: getattr(value, n) for n in MESH if getattr(value, n) is not None}
    what = "arrays" if isinstance(value, dict) else "mesh"
    return {"what": what, "names": list(held)}, [np.ascontiguousarray(a) for a in held.values()]


def _send(line: int, head: dict[str, Any], arrays: list[np.ndarray]) -> None:
    text = json.dumps(head | {"arrays": [[a.dtype.str, a.shape] for a in arrays]}).encode()
    for part in (LENGTH.pack(len(text)) + text, *(a.reshape(-1).view(np.uint8).data for a in arrays)):
        left = memoryview(part)
        while left:
            left = left[os.write(line, left) :]


if __name__ == "__main__":
    main()
