"""Long work behind the page: one piece at a time, with progress, that can be stopped."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from fluidlift.errors import FluidliftError

LOG = logging.getLogger(__name__)
WORDS = {"simulate": "simulating", "show": "rendering the preview film", "export": "exporting", "render": "drawing"}


class Stopped(FluidliftError):
    """Somebody wanted the work to end."""


@dataclass(frozen=True)
class JobState:
    """How far a piece of work is."""

    name: str = ""
    """in words; empty: there was none yet"""
    running: bool = False
    stage: str = ""
    done: int = 0
    total: int = 0
    outcome: str = ""
    """in words, once it has ended"""
    failed: bool = False

    @property
    def share(self) -> float:
        """0 to 100 %, of the stage."""
        return 100.0 * self.done / self.total if self.total else 0.0

    @property
    def told(self) -> str:
        """In words."""
        if not self.running:
            return self.outcome
        count = f", frame {self.done} of {self.total}" if self.total else ""
        return f"{self.name}: {WORDS.get(self.stage, self.stage) or 'beginning'}{count}"


class JobProgress:
    """Where pipelines tell their progress; the place where a stop reaches them: between two frames."""

    def __init__(self, runner: Jobs) -> None:
        self._runner = runner

    def stage(self, name: str, number: int, count: int) -> None:
        """A stage begins."""
        self._runner._told(stage=name, done=0, total=0)

    def update(self, done: int, total: int) -> None:
        """Part of the current stage is done."""
        self._runner._told(done=done, total=total)

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """A stage ended."""

    def warn(self, text: str) -> None:
        """Something the user should know."""

    def say(self, text: str) -> None:
        """Something good to know."""


class Jobs:
    """Runs one piece of work at a time in a thread.

    Args:
        ended: is called, from that thread, when a piece has ended.
    """

    def __init__(self, ended: Callable[[], None] = lambda: None) -> None:
        self._ended = ended
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.state = JobState()

    @property
    def running(self) -> bool:
        """Whether something is being done."""
        return self.state.running

    def start(self, name: str, work: Callable[[JobProgress], str]) -> bool:
        """Begin a piece of work that returns its outcome in words; False where another one is not done yet."""
        with self._lock:
            if self.state.running:
                return False
            self._stop.clear()
            self.state = JobState(name, running=True)
            self._thread = threading.Thread(target=self._run, args=(name, work), name="job", daemon=True)
        self._thread.start()
        return True

    def stop(self) -> None:
        """Ask the work to end; it does between two frames."""
        self._stop.set()

    def wait(self, seconds: float) -> bool:
        """Whether the work has ended within some seconds."""
        if self._thread is not None:
            self._thread.join(seconds)
        return not self.state.running

    def _told(self, **changes: Any) -> None:
        if self._stop.is_set():
            raise Stopped("stopped")
        with self._lock:
            self.state = replace(self.state, **changes)

    def _run(self, name: str, work: Callable[[JobProgress], str]) -> None:
        failed, outcome = True, ""
        try:
            outcome, failed = work(JobProgress(self)), False
        except Stopped:
            outcome, failed = f"{name}: stopped. What was finished is kept.", False
        except FluidliftError as error:
            outcome = f"{name}: {error}"
        except Exception as error:
            LOG.exception("%s", name)
            outcome = f"{name}: unexpected {type(error).__name__}: {error}"
        finally:
            with self._lock:
                self.state = JobState(name, running=False, outcome=outcome, failed=failed)
            try:
                self._ended()
            except Exception:
                LOG.exception("after %s", name)
