"""Make, in a process of its own, so that it can be stopped at any time; stages that are done are kept.

python -m fluidlift.studio.making CLIP HINTS ASSET PRESET PICTURES MODELS USE
tells its progress as JSON, one object a line.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fluidlift.errors import FluidliftError
from fluidlift.pipeline.models import NO_MODELS, ModelWish

STOP_SECONDS = 20.0
"""that a process may take to end by itself"""


@dataclass(frozen=True)
class MakeJob:
    """What is made."""

    clip: Path
    hints: Path | None
    asset: Path
    """folder to write"""
    preset: str
    pictures: Path
    """folder for those of the stages"""
    learned: ModelWish = NO_MODELS

    def arguments(self) -> list[str]:
        """Of `main`."""
        return [
            str(self.clip), str(self.hints or ""), str(self.asset), self.preset, str(self.pictures),
            self.learned.models, self.learned.use or "",
        ]  # fmt: skip


@dataclass
class MakeState:
    """How far it is."""

    asset: str = ""
    """name of the folder; empty: nothing was made yet"""
    running: bool = False
    stage: str = ""
    number: int = 0
    count: int = 0
    share: float = 0.0
    finished: list[dict[str, Any]] = field(default_factory=list)
    """name, seconds and whether it was kept from before, of each stage"""
    warnings: list[str] = field(default_factory=list)
    outcome: str = ""
    failed: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        return dict(vars(self))


class Making:
    """One make at a time.

    Args:
        changed: called from another thread whenever something new is known.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed, self._lock = changed, threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._stopped = False
        self.state = MakeState()

    def start(self, job: MakeJob) -> bool:
        """Begin; False where one is running."""
        with self._lock:
            if self.state.running:
                return False
            self.state, self._stopped = MakeState(job.asset.name, running=True, stage="beginning"), False
            command = [sys.executable, "-m", "fluidlift.studio.making", *job.arguments()]
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
        threading.Thread(target=self._listen, args=(self._process,), name="making", daemon=True).start()
        self._changed()
        return True

    def stop(self) -> None:
        """Ask it to end; what is done is kept."""
        process = self._process
        if process is None or process.poll() is not None:
            return
        self._stopped = True
        process.send_signal(signal.SIGTERM)
        threading.Timer(STOP_SECONDS, lambda: process.poll() is None and process.kill()).start()

    def close(self) -> None:
        """End it with the program."""
        process = self._process
        if process is not None and process.poll() is None:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(STOP_SECONDS)

    def _listen(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            with contextlib.suppress(ValueError):
                told = json.loads(line)
                if isinstance(told, dict):
                    self._told(told)
        code = process.wait()
        s = self.state
        if self._stopped:
            s.outcome, s.failed = "stopped; what was done is kept, and the next make goes on from there", False
        elif not s.outcome:
            s.outcome, s.failed = f"the process ended by itself (exit code {code}); make again goes on from there", True
        s.running, s.stage = False, ""
        self._changed()

    def _told(self, told: dict[str, Any]) -> None:
        s = self.state
        if "finished" in told:
            s.finished = [*s.finished, told["finished"]]
        if "warning" in told:
            s.warnings = [*s.warnings, told["warning"]]
        for name in ("stage", "number", "count", "share", "outcome", "failed"):
            if name in told:
                setattr(s, name, told[name])
        self._changed()


def say(**what: Any) -> None:
    """One line for who listens."""
    print(json.dumps(what), flush=True)


class _Lines:
    """Progress as lines."""

    def __init__(self) -> None:
        self._last = -1

    def stage(self, name: str, number: int, count: int) -> None:
        """A stage begins."""
        self._last = -1
        say(stage=name, number=number, count=count, share=0.0)

    def update(self, done: int, total: int) -> None:
        """Part of it is done."""
        share = int(100 * done / max(total, 1))
        if share != self._last:
            self._last = share
            say(share=share / 100)

    def finished(self, name: str, seconds: float, cached: bool) -> None:
        """A stage ended."""
        say(finished={"name": name, "seconds": round(seconds, 1), "kept": cached})

    def warn(self, text: str) -> None:
        """Something to know."""
        say(warning=text)

    def say(self, text: str) -> None:
        """What a line in a terminal is for; the page tells it by itself."""


def main(clip: str, hints_file: str, asset: str, preset: str, pictures: str, models: str, use: str) -> int:
    """Make one asset; the exit code."""
    from fluidlift.config import build_config
    from fluidlift.io.asset_folder import read_manifest
    from fluidlift.io.hints_file import read_hints, require_same_clip
    from fluidlift.pipeline import Inputs, card_of, make
    from fluidlift.studio.stage_pictures import StagePictures
    from fluidlift.types.hints import NOTHING_SAID

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        hints = read_hints(hints_file) if hints_file else NOTHING_SAID
        require_same_clip(hints, Path(clip), Path(hints_file).name)
        config = build_config(preset, base=dict(hints.settings))
        config = ModelWish(models, use or None).on(config, Inputs(Path(clip))).config
        shown = StagePictures(Path(pictures))
        made = make(
            Inputs(Path(clip)), Path(asset), config, hints=hints, progress=_Lines(), value_told=shown.told
        )  # fmt: skip
        card = card_of(read_manifest(made.folder))
        say(outcome=f"made in {made.seconds:.0f} s. {card if isinstance(card, str) else card.sentence()}", failed=False)
        return 0
    except FluidliftError as error:
        say(outcome=str(error), failed=True)
        return 1
    except KeyboardInterrupt:
        return 1


if __name__ == "__main__":
    # who listens may be gone: then there is nobody to tell
    with contextlib.suppress(BrokenPipeError):
        code = main(*sys.argv[1:8])
        sys.stdout.flush()
        os._exit(code)
    os._exit(1)
