"""Progress for people: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any, TextIO

from fluidlift.messages import visible

LABELS = {
    "compile": "compiling",
    "window": "looking through the clip",
    "read": "reading the clip",
    "flow": "optical flow",
    "segment": "finding the fluid",
    "generate": "bodies by the generator",
    "geometry": "shape, camera and terrain",
    "refine": "Gaussians",
    "masks": "writing the masks",
    "motion": "velocities",
    "velocities": "velocities of every frame",
    "elsewhere": "velocities of other times",
    "fit": "fitting the physics",
    "calibrate": "calibrating the flow",
    "simulate": "re-simulating",
    "show": "rendering and writing",
}


def label_of(name: str) -> str:
    """Of a stage, for people; that of a stretch of a long clip, `read_2`, has its number."""
    stage, _, number = name.rpartition("_")
    return f"{LABELS[stage]}, time {number}" if stage in LABELS and number.isdecimal() else LABELS.get(name, name)


WARM_UP = 2
"""parts at the beginning of a stage that say nothing about the rest: of a simulation the body at rest, which takes no
time, and the frame for which a fresh installation compiles"""


interrupted = threading.Event()
"""a person or a scheduler has asked for the end. The exception may get lost in a library, as imports within a bare
`except:` lose it; then it is raised again by the next stage, or the next part of one"""


class Interrupted(KeyboardInterrupt):
    """What is raised then. It is no plain KeyboardInterrupt: if one of those leaves code that `exec` runs (as when a
    dataclass is defined), CPython remembers it, even if it is caught, and ends `python -m` by SIGINT in place of its
    exit code (`run_eval_code_obj` in CPython)."""


def _go_on() -> None:
    if interrupted.is_set() and threading.current_thread() is threading.main_thread():
        raise Interrupted


class Pace:
    """How fast a stage goes on, from the later half of its parts: it may slow down as a fluid grows."""

    def __init__(self) -> None:
        self._times: list[tuple[int, float]] = []

    def at(self, done: int, now: float) -> None:
        """Parts that are done at a time (s, of a steady clock)."""
        if not self._times or done > self._times[-1][0]:
            self._times.append((done, now))

    def left(self, total: int) -> str:
        """How long the rest takes if it goes on like that, in words; empty where nothing is known yet."""
        usable = self._times[min(WARM_UP, len(self._times)) :] if self._times else []
        if len(usable) < 2 or usable[-1][0] >= total:
            return ""
        (since, began), (done, now) = usable[(len(usable) - 1) // 2], usable[-1]
        left = (now - began) / (done - since) * (total - done)
        if left < 90:
            return f"about {left:.0f} s left"
        return f"about {left / 60:.0f} min left" if left < 5400 else f"about {left / 3600:.1f} h left"


class PlainProgress:
    """One line when a stage begins and one when it ends; of a long one also how far it is, every few seconds.

    Args:
        stream: standard error where None.
        every: s between lines of a stage.
    """

    def __init__(self, stream: TextIO | None = None, every: float = 10.0) -> None:
        self.stream, self.every = stream or sys.stderr, every
        self.head = ""
        """of the current stage, as its line begins"""
        self._pace, self._last = Pace(), time.monotonic()

    def say(self, text: str) -> None:
        """Something good to know."""
        print(visible(text), file=self.stream, flush=True)

    def stage(self, name: str, number: int, count: int) -> None:
        """A stage begins."""
        _go_on()
        self.head = f"[{number}/{count}] {label_of(name)}"
        self._pace, self._last = Pace(), time.monotonic()
        print(f"{self.head} ...", file=self.stream, flush=True)

    def update(self, done: int, total: int) -> None:
        """Part of the current stage is done."""
        _go_on()
        now = time.monotonic()
        self._pace.at(done, now)
        if now - self._last >= self.every and done < total:
            self._last, left = now, self._pace.left(total)
            print(f"{self.head}: {done} of {total}{', ' + left if left else ''}", file=self.stream, flush=True)

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """A stage ended."""
        how = "already done" if cached else f"{seconds:.1f} s"
        print(f"{self.head}: {how}", file=self.stream, flush=True)

    def warn(self, text: str) -> None:
        """Something the user should know."""
        print(visible(f"warning: {text}"), file=self.stream, flush=True)


class BarProgress:
    """A live bar with stage, share and time."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        self.console = Console(stderr=True)
        self.bar = Progress(
            SpinnerColumn(), TextColumn("{task.description}", justify="left"), BarColumn(bar_width=28),
            TextColumn("{task.fields[parts]}"), TimeElapsedColumn(), TextColumn("{task.fields[left]}"),
            console=self.console, transient=True,
        )  # fmt: skip
        self.head = ""
        """of the current stage, as its line begins"""
        self._task, self._last, self._pace = None, 0.0, Pace()

    def __enter__(self) -> BarProgress:
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def say(self, text: str) -> None:
        """Something good to know."""
        self.console.print(visible(text), markup=False, highlight=False)

    def stage(self, name: str, number: int, count: int) -> None:
        """A stage begins."""
        _go_on()
        self.head = f"[{number}/{count}] {label_of(name)}"
        if self._task is not None:
            self.bar.remove_task(self._task)
        self._task = self.bar.add_task(self.head.replace("[", r"\["), total=None, parts="", left="")
        self._pace = Pace()

    def update(self, done: int, total: int) -> None:
        """Part of the current stage is done."""
        _go_on()
        now = time.monotonic()
        self._pace.at(done, now)
        if self._task is not None and (now - self._last > 0.1 or done >= total):
            self._last, left = now, self._pace.left(total)
            # until something is known, what was said before stays
            told: dict[str, Any] = {"left": left} if left else {}
            self.bar.update(self._task, completed=done, total=max(total, 1), parts=f"{done}/{total}", **told)

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """A stage ended."""
        how = "already done" if cached else f"{seconds:.1f} s"
        self.console.print(f"{self.head}: {how}", markup=False, highlight=False)

    def warn(self, text: str) -> None:
        """Something the user should know."""
        self.console.print(visible(f"warning: {text}"), style="yellow", markup=False, highlight=False)


@contextlib.contextmanager
def shown_progress() -> Iterator[BarProgress | PlainProgress]:
    """A bar where standard error is a terminal, plain lines elsewhere. What is raised gets a note of the stage."""
    with BarProgress() if sys.stderr.isatty() else contextlib.nullcontext(PlainProgress()) as progress:
        try:
            yield progress
        except Exception as error:
            if progress.head:
                error.add_note(f"while {progress.head}")
            raise
