"""Progress for people: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from typing import TextIO

LABELS = {
    "read": "reading the clip",
    "flow": "optical flow",
    "segment": "finding the fluid",
    "geometry": "shape, camera and terrain",
    "refine": "Gaussians",
    "motion": "velocities",
    "fit": "fitting the physics",
    "simulate": "re-simulating",
    "show": "rendering and writing",
}


class PlainProgress:
    """One line when a stage begins and one when it ends."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stderr
        self._head = ""

    def stage(self, name: str, number: int, count: int) -> None:
        """A stage begins."""
        self._head = f"[{number}/{count}] {LABELS.get(name, name)}"
        print(f"{self._head} ...", file=self.stream, flush=True)

    def update(self, done: int, total: int) -> None:
        """Part of the current stage is done: not told line by line."""

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
            TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn(), console=self.console, transient=True,
        )  # fmt: skip
        self._task, self._head, self._last = None, "", 0.0

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
        self._task = self.bar.add_task(self._head.replace("[", r"\["), total=None)

    def update(self, done: int, total: int) -> None:
        """Part of the current stage is done."""
        now = time.monotonic()
        if self._task is not None and (now - self._last > 0.1 or done >= total):
            self._last = now
            self.bar.update(self._task, completed=done, total=max(total, 1))

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """A stage ended."""
        how = "already done" if cached else f"{seconds:.1f} s"
        self.console.print(f"{self._head}: {how}", markup=False, highlight=False)

    def warn(self, text: str) -> None:
        """Something the user should know."""
        self.console.print(f"warning: {text}", style="yellow", markup=False, highlight=False)
