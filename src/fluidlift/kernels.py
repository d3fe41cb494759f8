"""The compiled functions that a job needs, compiled before it asks for them.

Numba compiles a function when it is first called and keeps the machine code in a cache beside the source. The first
job of an installation would spend two thirds of its time on that, on one processor. Here a list of what the jobs of
the package call (`kernels.json`, written by `benchmarks/record_kernels.py`) is compiled ahead: by a process beside
the first job (`compiling_beside`), or all of it at once (`compile_all`, `fluidlift doctor --compile`).

A list that is out of date costs time and changes nothing else: what is missing is compiled when it is called.
"""

from __future__ import annotations

import ast
import contextlib
import gc
import hashlib
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from fluidlift.machine import cores

PACKAGE = Path(__file__).parent
LIST = PACKAGE / "kernels.json"
RARELY = 50_000, 50, 1000
"""thresholds of the garbage collector: a compiler keeps what it makes, and looking for garbage in that takes a tenth of
its time"""


@dataclass(frozen=True)
class Kernel:
    """A function and the types it is called with, as Numba prints them."""

    stage: str
    """of a job in which it is first called"""
    function: str
    """module:name"""
    types: tuple[str, ...]
    seconds: float
    """of processor time that its compilation took where the list was recorded"""


def listed() -> list[Kernel]:
    """The kernels of the list, in the order in which a job calls them; first those that the demo does not call."""
    return [Kernel(s, f, tuple(t), c) for s, f, t, c in json.loads(LIST.read_text(encoding="utf-8"))]


def type_of(text: str) -> Any:
    """The Numba type that is printed like that.

    Raises:
        ValueError: a type that this list does not hold.
    """
    from numba import types

    families = {"Array": types.Array, "UniTuple": types.UniTuple, "Tuple": types.Tuple}

    def read(node: ast.expr) -> Any:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in families:
            options = {str(k.arg): read(k.value) for k in node.keywords}
            return families[node.func.id](*(read(a) for a in node.args), **options)
        if isinstance(node, ast.Tuple):
            return tuple(read(member) for member in node.elts)
        if isinstance(node, ast.Constant):
            return types.none if node.value is None else node.value
        if isinstance(node, ast.Name) and isinstance(found := getattr(types, node.id, None), types.Type):
            return found
        raise ValueError(f"not a type of a kernel: {text}")

    return read(ast.parse(text, mode="eval").body)


def compile_kernel(kernel: Kernel) -> None:
    """Compile one, or find it in the cache.

    Raises:
        AttributeError, ModuleNotFoundError: it is no longer there.
    """
    module, name = kernel.function.split(":")
    dispatcher = getattr(importlib.import_module(module), name)
    dispatcher.compile(tuple(type_of(t) for t in kernel.types))


def _sources() -> list[Path]:
    return sorted({PACKAGE.parent / f"{k.function.split(':')[0].replace('.', '/')}.py" for k in listed()})


def _stamp() -> Path:
    """A file that is there once all kernels were compiled, for this source and these versions."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    place = Path(given) if given else PACKAGE / "__pycache__"
    parts = [LIST.read_text(encoding="utf-8"), sys.version, metadata.version("numba"), os.uname().machine]
    parts += [f"{file} {file.stat().st_mtime_ns}" for file in _sources() if file.is_file()]
    return place / f"kernels-{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()[:16]}.done"


def compiled() -> bool:
    """Whether all that is listed was compiled; also where that cannot be remembered."""
    stamp = _stamp()
    return stamp.is_file() or not _writable(stamp.parent)


def _writable(place: Path) -> bool:
    with contextlib.suppress(OSError):
        place.mkdir(parents=True, exist_ok=True)
    return os.access(place, os.W_OK)


def _remember() -> None:
    stamp = _stamp()
    with contextlib.suppress(OSError):
        for old in stamp.parent.glob("kernels-*.done"):
            old.unlink()
        stamp.touch()


def compile_all(processes: int | None = None, told: Callable[[int, int], None] = lambda done, of: None) -> None:
    """Compile every kernel of the list, in several processes.

    Args:
        processes: as many as there are processors by default.
        told: called with kernels done and kernels in all.
    """
    kernels = listed()
    reader, writer = os.pipe()  # all processes print into one, a line for each kernel
    workers = [_worker(share, output=writer) for share in _shares(kernels, processes or cores())]
    os.close(writer)
    with open(reader, encoding="utf-8") as lines:
        for done, _ in enumerate(lines, 1):
            told(done, len(kernels))
    codes = [worker.wait() for worker in workers]
    if not any(codes):
        _remember()


def _shares(kernels: Sequence[Kernel], count: int) -> list[list[Kernel]]:
    """Kernels of one module stay together, since they call the same functions; shares take equally long."""
    modules: dict[str, list[Kernel]] = {}
    for kernel in kernels:
        modules.setdefault(kernel.function.split(":")[0], []).append(kernel)
    shares: list[list[Kernel]] = [[] for _ in range(count)]
    for group in sorted(modules.values(), key=lambda g: -sum(k.seconds for k in g)):
        min(shares, key=lambda s: sum(k.seconds for k in s)).extend(group)
    return [share for share in shares if share]


def _worker(kernels: Sequence[Kernel], output: int = subprocess.DEVNULL) -> subprocess.Popen[str]:
    """A process that compiles kernels in their order."""
    worker = subprocess.Popen(
        [sys.executable, "-m", "fluidlift.kernels"], stdin=subprocess.PIPE, stdout=output, stderr=subprocess.DEVNULL,
        text=True,
    )  # fmt: skip
    assert worker.stdin is not None
    with contextlib.suppress(BrokenPipeError), worker.stdin:
        json.dump([(k.stage, k.function, k.types, k.seconds) for k in kernels], worker.stdin)
    return worker


@contextlib.contextmanager
def compiling_beside(told: Callable[[str], None]) -> Iterator[None]:
    """While a job runs, let another process compile, unless that was done before.

    The job compiles what it calls on its way, and waits for nothing; the process begins with what is called last, so
    that the two do the same work only where they meet.

    Args:
        told: called with a line for the user if there is something to compile.
    """
    if compiled() or cores() < 2:
        yield
        return
    told("first run of this installation: compiling beside it, once")
    worker = _worker(listed()[::-1])
    before = gc.get_threshold()
    gc.set_threshold(*RARELY)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        if worker.poll() is None:
            worker.terminate()
        elif worker.returncode == 0:
            _remember()


def main() -> int:
    """Compile what stands in standard input; 1 if something could not be compiled."""
    failed = 0
    gc.set_threshold(*RARELY)
    for stage, function, types, seconds in json.load(sys.stdin):
        try:
            compile_kernel(Kernel(stage, function, tuple(types), seconds))
        except Exception:  # whatever it is, the job itself will meet it where it can be told
            failed = 1
        print(function, flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
