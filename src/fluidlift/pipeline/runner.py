"""Runs stages: cache by content, progress, timing, warnings. The stages themselves know nothing of this.

A stage is a function from values to a value of `types.stages`. Its key is made of what it is called with and of its
source: values of earlier stages by their keys, files by their content, settings and all else as they are. What a stage
is not given it cannot read, so nothing has to be listed by hand.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fluidlift.errors import InputRejected, MissingPackage
from fluidlift.io.atomic import disk_errors, require_writable
from fluidlift.io.kept_values import kept_stage, kept_value
from fluidlift.io.stage_cache import Scratch, is_owner, mark_owner, save_stage
from fluidlift.io.stage_codec import packed
from fluidlift.machine import peak_memory_mb
from fluidlift.messages import Notice
from fluidlift.pipeline.work import Work
from fluidlift.seams import Progress
from fluidlift.source import source_hash

T = TypeVar("T")


class Runner:
    """Runs the stages of one job, in the order in which they are called.

    Args:
        folder: of the asset.
        stages: names of those that will be run, for progress.
        force: names of stages to run again, with all that come after.
        progress: where progress is told.
        value_told: gets the name and the value of each stage as it ends.
        memory: key and value of what stages asked to be remembered, by name; given to the next runner it saves that
            work. None: nothing is remembered.

    Raises:
        InputRejected: a stage to run again that there is not.
    """

    def __init__(
        self, folder: Path, stages: tuple[str, ...], *, force: frozenset[str] = frozenset(), progress: Progress,
        value_told: Callable[[str, Any], None] = lambda name, value: None,
        memory: dict[str, tuple[str, Any]] | None = None,
    ) -> None:  # fmt: skip
        unknown = sorted(force - set(stages))
        if unknown:
            raise InputRejected(f"unknown stage '{unknown[0]}'", "one of " + ", ".join(stages))
        self.folder, self.stages, self.force, self.progress = folder, stages, force, progress
        self._value_told, self._memory = value_told, memory
        self.keys: dict[str, str] = {}
        self.timings: dict[str, dict[str, Any]] = {}
        """of the stages that are done"""
        self.warnings: list[Notice] = []
        self.told: list[Notice] = []
        """those of the stages that were run, in order"""
        self._known: dict[int, tuple[Any, str]] = {}
        self._stale = False

    def run(
        self,
        name: str,
        stage: Callable[..., T],
        *inputs: Any,
        beside: dict[str, Any] | None = None,
        before: Callable[[], None] = lambda: None,
        still_there: Callable[[T], bool] = lambda value: True,
        owns_files: bool = False,
        **named: Any,
    ) -> T:
        """Call a stage, or take its value from the cache where nothing it depends on has changed.

        Args:
            name: of the stage.
            stage: the function; its module's source counts. It gets a `Work` where it has a parameter `work`.
            inputs: values that its result depends on.
            named: likewise, by name.
            beside: what it is called with that does not change its result.
            before: what is looked at before the stage does its work, and not where its value is in the cache.
            still_there: whether files that the stage wrote beside its value still exist.
            owns_files: there are such files, and other settings would write the same ones: a cached value counts only
                while they are its own.
        """
        key = self.keys[name] = self._key(name, stage, inputs, named)
        self.progress.stage(name, self.stages.index(name) + 1, len(self.stages))
        began = time.perf_counter()
        if name in self.force:
            self._stale = True
        found = None
        if not self._stale and (not owns_files or is_owner(self.folder, name, key)):
            found = kept_value(self.folder, name, key, result_type(stage))
        cached = found is not None and still_there(found[0])
        if found is None or not cached:
            before()
            if owns_files:
                mark_owner(self.folder, name, None)
            found = self._worked(name, key, stage, inputs, named | (beside or {}))
            if owns_files:
                mark_owner(self.folder, name, key)
        seconds = time.perf_counter() - began
        self._note(name, found[0], key, found[1], cached)
        for text in getattr(found[0], "warnings", ()):
            self.told.append(text)
            self.warn(text)
        self._value_told(name, found[0])
        self.progress.finished(name, seconds, cached)
        return found[0]

    def recall(self, manifest: dict[str, Any], name: str, kind: type[T]) -> T | None:
        """The value that a stage had when the asset was made, without knowing how to make it; None where it is gone."""
        found = kept_stage(self.folder, manifest, name, kind)
        if found is None:
            return None
        self.keys[found.name] = found.key
        self._note(found.name, found.value, found.key, found.seconds, True)
        return found.value

    def forget(self) -> None:
        """Know nothing of earlier runs any more."""
        for part in (self.keys, self.timings, self._known):
            part.clear()

    def follows(self, value: T, *of: Any) -> T:
        """The value, which is known to follow from others alone: their keys are its key."""
        return self._learned(value, digest_of([self._part(v) for v in of]))

    def warn(self, text: Notice) -> None:
        """Tell once, and remember for the report."""
        if text not in self.warnings:
            self.warnings.append(text)
            self.progress.warn(text)

    def _key(self, name: str, stage: Callable[..., Any], inputs: tuple[Any, ...], named: dict[str, Any]) -> str:
        given = inspect.signature(stage).bind_partial(*inputs, **named).arguments
        return digest_of([name, source_hash(stage.__module__), {k: self._part(v) for k, v in given.items()}])

    def _part(self, value: Any) -> Any:
        """What a key knows of a value."""
        known = self._known.get(id(value))
        if known is not None and known[0] is value:
            return known[1]
        own = getattr(value, "cache_key", None)
        if own is not None:
            return own
        if isinstance(value, np.ndarray):
            head = f"{value.dtype.str}{value.shape}".encode()
            return hashlib.sha256(head + np.ascontiguousarray(value).tobytes()).hexdigest()
        if is_dataclass(value) and not isinstance(value, type):
            shown = [f for f in fields(value) if f.metadata.get("keyed", True)]
            return {f.name: self._part(getattr(value, f.name)) for f in shown}
        if isinstance(value, dict):
            return {str(k): self._part(v) for k, v in value.items()}
        if isinstance(value, list | tuple):
            return [self._part(v) for v in value]
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, Enum):
            return value.value
        if value is None or isinstance(value, bool | int | float | str):
            return value
        raise TypeError(f"a {type(value).__name__} says nothing of its content: no key can be made of it")

    def _worked(
        self, name: str, key: str, stage: Callable[..., T], inputs: tuple[Any, ...], named: dict[str, Any]
    ) -> tuple[T, float]:
        """Do the work of a stage and keep its value; the seconds that it took."""
        scratch, began = Scratch(self.folder, name), time.perf_counter()
        if "work" in inspect.signature(stage).parameters:
            named = named | {
                "work": Work(
                    scratch, self.progress.update, self.warn, key, self._stale, self._part_of_stage, self._remembered
                )
            }
        try:
            value = stage(*inputs, **named)
            arrays, data = packed(value)
            seconds = round(time.perf_counter() - began, 3)
            save_stage(self.folder, name, key, arrays, {"seconds": seconds, "value": data}, scratch=scratch)
        finally:
            scratch.discard()
        return value, seconds

    def _part_of_stage(self, name: str, function: Callable[..., T], *inputs: Any, **named: Any) -> T:
        """Part of a stage that is kept by itself; forcing the stage does not repeat it."""
        key = self._key(name, function, inputs, named)
        found = kept_value(self.folder, name, key, result_type(function))
        return self._learned((found or self._worked(name, key, function, inputs, named))[0], key)

    def _remembered(self, name: str, function: Callable[..., T], *inputs: Any) -> T:
        """What a function gives, from memory where its inputs are those of the last time."""
        if self._memory is None:
            return function(*inputs)
        key = self._key(name, function, inputs, {})
        known = self._memory.get(name)
        if known is None or known[0] != key:
            known = self._memory[name] = key, function(*inputs)
        return known[1]

    def _note(self, name: str, value: Any, key: str, seconds: float, cached: bool) -> None:
        self._learned(value, key)
        self.timings[name] = {"seconds": seconds, "cached": cached, "peak_memory_mb": round(peak_memory_mb(), 1)}

    def _learned(self, value: T, key: str) -> T:
        self._known[id(value)] = (value, key)  # held, so that no other value takes its place
        return value


def digest_of(part: Any) -> str:
    """SHA-256 of plain values, as JSON."""
    return hashlib.sha256(json.dumps(part, sort_keys=True).encode()).hexdigest()


def result_type(stage: Callable[..., T]) -> type[T]:
    """What a stage says that it returns."""
    said = inspect.get_annotations(inspect.unwrap(stage))["return"]
    return getattr(sys.modules[stage.__module__], said) if isinstance(said, str) else said


@contextmanager
def gone_if_refused(runner: Runner, until: str) -> Iterator[None]:
    """Where an input is refused before the stage `until` is done, a folder that was not there before goes again.

    Work that was done before, such as before a disk ran full, is kept. That the folder can be written is tried first.

    Raises:
        InputRejected: as what is done inside, and for errors of the disk.
        MissingPackage: as what is done inside.
    """
    fresh = not runner.folder.exists()
    try:
        require_writable(runner.folder)
        with disk_errors(runner.folder):
            yield
    except (InputRejected, MissingPackage):
        if fresh and until not in runner.timings:
            shutil.rmtree(runner.folder, ignore_errors=True)
        raise
