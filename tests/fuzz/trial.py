"""One input: what a reader makes of it, in which time and memory, and what else it opens."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import shutil
import signal
import struct
import sys
import sysconfig
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from fluidlift.errors import FluidliftError
from fluidlift.io.confined import reading_here

from .borders import changed
from .mutation import KINDS, LONGEST, Edit, mutated
from .target import Target
from .targets import TARGETS

SLOWEST, LARGEST = 20.0, 2 * 2**30
"""s and bytes of memory that no input may take"""


class TooSlow(BaseException):
    """An input took longer than `SLOWEST`; no reader may catch it."""


class Watched:
    """Names of files outside a folder that are opened while it is asked to look; Python's own packages apart."""

    def __init__(self) -> None:
        self.inside: str | None = None
        self.found: list[str] = []
        paths = {
            *sysconfig.get_paths().values(),
            sys.prefix,
            sys.base_prefix,
            "/dev/null",
            "/dev/urandom",
            "/proc/self",
        }
        self.known = tuple({os.path.realpath(p) for p in paths} | {str(Path(__file__).parents[2]), "/usr/share"})
        sys.addaudithook(self._heard)

    def _heard(self, event: str, args: tuple[Any, ...]) -> None:
        if self.inside is None or event not in ("open", "os.remove", "os.rename", "os.mkdir", "shutil.rmtree"):
            return
        for name in args[: 2 if event == "os.rename" else 1]:
            if isinstance(name, str | os.PathLike):
                path = os.path.realpath(name)
                if not path.startswith((self.inside, *self.known)):
                    self.found.append(path)

    @contextlib.contextmanager
    def only(self, folder: Path) -> Iterator[None]:
        """Look while the block runs."""
        self.inside, self.found = os.path.realpath(folder), []
        try:
            yield
        finally:
            self.inside = None


def peak_memory() -> int:
    """Bytes that the process held at most, so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


class Folder:
    """The folder of a target, in which one file changes from input to input."""

    def __init__(self, target: Target, place: Path) -> None:
        from .corpus import lay_out

        self.target, self.place = target, place
        self.file = place / target.name
        self.file.parent.mkdir(parents=True, exist_ok=True)
        lay_out(place, target.beside())

    def read(self, data: bytes) -> str:
        """accepted or refused; anything else that is raised passes."""
        self.file.write_bytes(data)
        try:
            self.target.read(self.place)
        except FluidliftError:
            return "refused"
        return "accepted"


def drawn(target: Target, random: Random) -> bytes:
    """One changed file."""
    seed = target.seed(random.randrange(1000))
    edits = [Edit(random.randrange(len(KINDS)), random.random(), random.getrandbits(30))
             for _ in range(random.choice((1, 1, 1, 2, 3, 5)))]  # fmt: skip
    return seed.pack(mutated(seed.data, edits))


def bordered(target: Target, random: Random) -> bytes:
    """One that is changed at a border of its format."""
    seed, other = target.seed(random.randrange(1000)), target.seed(random.randrange(1000))
    try:
        return seed.pack(changed(seed.data, other.pack(other.data), random))[:LONGEST]
    except (ValueError, OverflowError, struct.error):  # what is inside of a packed file no longer packs
        return drawn(target, random)


@dataclass
class Found:
    """What a run of one target found."""

    target: str
    inputs: int = 0
    formed: int = 0
    """of the inputs, those that keep the form of their format"""
    bordered: int = 0
    """and those that are changed at a border of it"""
    accepted: int = 0
    refused: int = 0
    seconds: float = 0.0
    """of processor time"""
    slowest: float = 0.0
    peak_bytes: int = 0
    raw: dict[str, int] = field(default_factory=dict)
    """exceptions that were no refusal, by type and place"""
    outside: list[str] = field(default_factory=list)
    """files outside the folder that were opened"""


def place_of(error: BaseException) -> str:
    """Type and the innermost place in our own source."""
    ours = [f for f in traceback.extract_tb(error.__traceback__) if "fluidlift" in f.filename]
    last = ours[-1] if ours else None
    where = "" if last is None else f" {Path(last.filename).name}:{last.lineno}"
    return f"{type(error).__name__}{where}: {str(error)[:120]}"


def run_target(
    name: str, inputs: int, seed: int, keep: Path | None = None, *, formed: int = 0, borders: int = 0
) -> Found:
    """Many inputs of one target, in this process.

    Args:
        name: of the target.
        inputs: how many of which bytes are changed.
        seed: of what is drawn.
        borders: how many more that are changed at borders of the format.
        formed: how many more that keep the form of their format, drawn with Hypothesis.
        keep: folder for the inputs that ended in something else than a refusal.
    """
    found, random, watched = Found(name), Random(f"{name} {seed}"), Watched()

    def late(*_: Any) -> None:
        raise TooSlow

    signal.signal(signal.SIGALRM, late)
    place = Path(tempfile.mkdtemp(prefix="fuzz"))
    try:
        folder = Folder(TARGETS[name], place)
        with (
            reading_here(),
            contextlib.suppress(Exception),
        ):  # what the first call imports and compiles is no part of an input
            folder.read(TARGETS[name].seed(0).pack(TARGETS[name].seed(0).data))
        for _ in range(inputs):
            _one(folder, drawn(TARGETS[name], random), found, watched, keep)
        elsewhere = Random(f"{name} {seed} borders")
        for _ in range(borders):
            _one(folder, bordered(TARGETS[name], elsewhere), found, watched, keep)
        found.bordered = borders
        if formed:
            _draw_formed(folder, formed, f"{name} {seed}", lambda data: _one(folder, data, found, watched, keep))
            found.formed = found.inputs - inputs - borders
    finally:
        shutil.rmtree(place, ignore_errors=True)
    found.peak_bytes = peak_memory()
    found.outside = sorted(set(found.outside))
    return found


def _draw_formed(folder: Folder, number: int, seed: str, take: Callable[[bytes], None]) -> None:
    """Draw inputs with Hypothesis; all are taken, none is made smaller, and no file of examples is kept."""
    import hypothesis

    from .structures import inputs_of

    kinds = hypothesis.settings(
        max_examples=number, database=None, deadline=None, phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip
    hypothesis.seed(seed)(kinds(hypothesis.given(inputs_of(folder.target.seeds()))(take)))()


def _one(folder: Folder, data: bytes, found: Found, watched: Watched, keep: Path | None) -> None:
    began, spent = time.perf_counter(), time.process_time()
    _tried(folder, data, found, watched, keep)
    found.inputs += 1
    found.seconds += time.process_time() - spent
    found.slowest = max(found.slowest, time.perf_counter() - began)
    found.outside += watched.found


def _tried(folder: Folder, data: bytes, found: Found, watched: Watched, keep: Path | None) -> None:
    signal.setitimer(signal.ITIMER_REAL, SLOWEST)
    try:
        with reading_here(), watched.only(folder.place):  # where a fault is seen, and the memory is this process's
            outcome = folder.read(data)
        setattr(found, outcome, getattr(found, outcome) + 1)
    except (Exception, TooSlow) as error:
        what = place_of(error)
        found.raw[what] = found.raw.get(what, 0) + 1
        if keep is not None and found.raw[what] == 1:
            keep.mkdir(parents=True, exist_ok=True)
            (keep / f"{found.target}.{len(found.raw)}{Path(folder.target.name).suffix}").write_bytes(data)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def main() -> None:
    """Run one target in a process of its own: name, inputs, formed and bordered inputs, seed and folder to keep in;
    figures as JSON on stdout."""
    name, inputs, formed, borders, seed, keep = sys.argv[1:7]
    resource.setrlimit(resource.RLIMIT_AS, (24 * 2**30, 24 * 2**30))
    found = run_target(
        name, int(inputs), int(seed), Path(keep) if keep else None, formed=int(formed), borders=int(borders)
    )
    print("\n" + json.dumps(vars(found)))


if __name__ == "__main__":
    main()
