"""Runs stages: cache by content, progress, timing, warnings. The stages themselves know nothing of this."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from fluidlift import __version__
from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.io.asset_folder import is_owner, load_stage, mark_owner, save_stage
from fluidlift.io.atomic import disk_errors, require_writable
from fluidlift.io.stage_cache import Scratch

Arrays = dict[str, np.ndarray]
Meta = dict[str, Any]


class Progress(Protocol):
    """Where progress is told: a terminal, plain lines, or nowhere."""

    def stage(self, name: str, number: int, count: int) -> None:
        """A stage begins."""

    def update(self, done: int, total: int) -> None:
        """Part of the current stage is done."""

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """A stage ended."""

    def warn(self, text: str) -> None:
        """Something the user should know."""


class Silence:
    """No progress at all."""

    def stage(self, name: str, number: int, count: int) -> None:
        """Nothing."""

    def update(self, done: int, total: int) -> None:
        """Nothing."""

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """Nothing."""

    def warn(self, text: str) -> None:
        """Nothing."""


@dataclass
class Result:
    """What a stage left: arrays, and plain values that fit in JSON."""

    arrays: Arrays = field(default_factory=dict)
    meta: Meta = field(default_factory=dict)


def content_hash(*parts: Any) -> str:
    """SHA-256 of plain values (JSON) and bytes, in order."""
    digest = hashlib.sha256()
    for part in parts:
        data = part if isinstance(part, bytes) else json.dumps(part, sort_keys=True, default=str).encode()
        digest.update(len(data).to_bytes(8, "little"))
        digest.update(data)
    return digest.hexdigest()


def file_hash(path: Path) -> str:
    """SHA-256 of a file, or of all files of a folder with their names."""
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for file in files:
        digest.update(file.name.encode())
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


class Story:
    """The stages of one job, in the order in which they are called."""

    def __init__(
        self, folder: Path, stages: tuple[str, ...], *, force: frozenset[str] = frozenset(), progress: Progress
    ) -> None:
        self.folder, self.stages, self.force, self.progress = folder, stages, force, progress
        self.results: dict[str, Result] = {}
        self.keys: dict[str, str] = {}
        self.timings: dict[str, dict[str, Any]] = {}
        self.warnings: list[str] = []
        self.scratch = Scratch(folder, "none")
        """for large arrays of the stage that is at work"""
        self._stale = False

    def __getitem__(self, name: str) -> Result:
        return self.results[name]

    def run(
        self,
        name: str,
        work: Callable[[], Result],
        *,
        settings: Any,
        after: tuple[str, ...],
        still_there: Callable[[Result], bool] = lambda result: True,
        owns_files: bool = False,
    ) -> Result:
        """Run a stage, or take its result from the cache where nothing it depends on has changed.

        Args:
            name: of the stage.
            work: does it.
            settings: plain values that its result depends on.
            after: stages whose results it uses.
            still_there: whether files that the stage wrote beside its result still exist.
            owns_files: there are such files, and other settings would write the same ones: a cached result counts only
                while they are its own.
        """
        key = content_hash(__version__, name, settings, [self.keys[a] for a in after])
        self.keys[name] = key
        self.progress.stage(name, self.stages.index(name) + 1, len(self.stages))
        began = time.perf_counter()
        result, cached = None, False
        if name in self.force:
            self._stale = True
        if not self._stale and (not owns_files or is_owner(self.folder, name, key)):
            found = load_stage(self.folder, name, key)
            if found is not None and still_there(Result(*found)):
                result, cached = Result(*found), True
        if result is None:
            result = self._worked(name, key, work, began, owns_files)
        seconds = time.perf_counter() - began
        self.results[name] = result
        self.timings[name] = {
            "seconds": result.meta.get("seconds", round(seconds, 3)),
            "cached": cached,
            "peak_memory_mb": round(peak_memory_mb(), 1),
        }
        for text in result.meta.get("warnings", ()):
            self.warn(text)
        self.progress.finished(name, seconds, cached)
        return result

    def _worked(self, name: str, key: str, work: Callable[[], Result], began: float, owns_files: bool) -> Result:
        """Do the work of a stage and keep its result."""
        if owns_files:
            mark_owner(self.folder, name, None)
        self.scratch = Scratch(self.folder, name)
        try:
            result = work()
            result.meta["seconds"] = round(time.perf_counter() - began, 3)
            save_stage(self.folder, name, key, result.arrays, result.meta, scratch=self.scratch)
        finally:
            self.scratch.discard()
        if owns_files:
            mark_owner(self.folder, name, key)
        return result

    def recall(self, name: str, key: str) -> bool:
        """Take the result of an earlier run by its key, without knowing how to make it; whether it was there."""
        found = load_stage(self.folder, name, key)
        if found is None:
            return False
        self.results[name], self.keys[name] = Result(*found), key
        seconds = float(self.results[name].meta.get("seconds", 0.0))
        self.timings[name] = {"seconds": seconds, "cached": True, "peak_memory_mb": round(peak_memory_mb(), 1)}
        return True

    def warn(self, text: str) -> None:
        """Tell once, and remember for the report."""
        if text not in self.warnings:
            self.warnings.append(text)
            self.progress.warn(text)

    def step(self, done: int, total: int) -> None:
        """Progress inside the current stage."""
        self.progress.update(done, total)


@contextmanager
def gone_if_refused(story: Story, until: str) -> Iterator[None]:
    """Where an input is refused before the stage `until` is done, a folder that was not there before goes again.

    Work that was done before, such as before a disk ran full, is kept. That the folder can be written is tried first.

    Raises:
        InputRejected: as what is done inside, and for errors of the disk.
        MissingPackage: as what is done inside.
    """
    fresh = not story.folder.exists()
    try:
        require_writable(story.folder)
        with disk_errors(story.folder):
            yield
    except (InputRejected, MissingPackage):
        if fresh and until not in story.results:
            shutil.rmtree(story.folder, ignore_errors=True)
        raise


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    usage = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return usage / (1024.0 * 1024.0 if sys.platform == "darwin" else 1024.0)


def available_memory() -> int:
    """Bytes that this process can still take without swapping: what the machine or its container has left."""
    free = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(OSError, ValueError, IndexError, StopIteration):  # Linux: free memory and what files are cached in
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    with suppress(OSError, ValueError, StopIteration):  # a container; "max" is no number
        group = Path("/sys/fs/cgroup")
        taken = int((group / "memory.current").read_text())
        stat = (group / "memory.stat").read_text().splitlines()
        cached = next(int(line.split()[1]) for line in stat if line.startswith("inactive_file "))
        free = min(free, max(int((group / "memory.max").read_text()) - taken + cached, 0))
    return free


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """torch's and Numba's thread pools spin against each other: loops that alternate both are faster on one thread."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
