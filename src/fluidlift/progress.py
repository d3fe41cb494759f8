"""Progress for people: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from typing import TextIO

LABELS = {
    "read": "reading the clip",
    "flow": "optical flow",
    "segment": "finding the fluid",
    "generate": "bodies by the generator",
    "geometry": "shape, camera and terrain",
    "refine": "Gaussians",
    "masks": "writing the masks",
    "motion": "velocities",
    "velocities": "velocities of every frame",
    "fit": "fitting the physics",
    "simulate": "re-simulating",
    "show": "rendering and writing",
}


def time_left(done: int, total: int, first: int, seconds: float) -> str:
    """How long the rest takes if it goes on as since part `first`, in words; empty where nothing is known yet."""
    if done <= first or done >= total:
        return ""
    left = seconds / (done - first) * (total - done)
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
        self._head, self._first, self._began, self._last = "", None, 0.0, 0.0

    def stage(self, name: str, number: int, count: int) -> None:
        """A stage begins."""
        self._head = f"[{number}/{count}] {LABELS.get(name, name)}"
        self._first = None
        print(f"{self._head} ...", file=self.stream, flush=True)

    def update(self, done: int, total: int) -> None:
        """Part of the current stage is done."""
        now = time.monotonic()
        if self._first is None:
            self._first, self._began, self._last = done, now, now
        if now - self._last >= self.every and done < total:
            self._last = now
            left = time_left(done, total, self._first, now - self._began)
            print(f"{self._head}: {done} of {total}{', ' + left if left else ''}", file=self.stream, flush=True)

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """A stage ended."""
        how = "already done" if cached else f"{seconds:.1f} s"
        print(f"{self._head}: {how}", file=self.stream, flush=True)

    def warn(self, text: str) -> None:
        """Something the user should know."""
        print(f"warning: {text}", file=self.stream, flush=True)


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
        self._task, self._head, self._last, self._began = None, "", 0.0, 0.0
        self._first: int | None = None

    def __enter__(self) -> BarProgress:
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def stage(self, name: str, number: int, count: int) -> None:
        """A stage begins."""
        self._head = f"[{number}/{count}] {LABELS.get(name, name)}"
        if self._task is not None:
            self.bar.remove_task(self._task)
        self._task = self.bar.add_task(self._head.replace("[", r"\["), total=None, parts="", left="")
        self._first = None

    def update(self, done: int, total: int) -> None:
        """Part of the current stage is done."""
        now = time.monotonic()
        if self._first is None:
            self._first, self._began = done, now
        if self._task is not None and (now - self._last > 0.1 or done >= total):
            self._last = now
            left = time_left(done, total, self._first, now - self._began)
            self.bar.update(self._task, completed=done, total=max(total, 1), parts=f"{done}/{total}", left=left)

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """A stage ended."""
        how = "already done" if cached else f"{seconds:.1f} s"
        self.console.print(f"{self._head}: {how}", markup=False, highlight=False)

    def warn(self, text: str) -> None:
        """Something the user should know."""
        self.console.print(f"warning: {text}", style="yellow", markup=False, highlight=False)


@contextlib.contextmanager
def shown_progress() -> Iterator[BarProgress | PlainProgress]:
    """A bar where standard error is a terminal, plain lines elsewhere."""
    if sys.stderr.isatty():
        with BarProgress() as bar:
            yield bar
    else:
        yield PlainProgress()
