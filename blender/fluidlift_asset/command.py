"""Calls of the fluidlift command, which does the work in its own Python."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

DONE = (0, 4)
"""exit codes of success; 4: with warnings"""
EVERY = 0.5
"""s between two looks at what a command has printed"""
HOW_FAR = re.compile(r": (\d+) of (\d+)\b")
Told = Callable[[str], None]
"""takes the last line of a command that is at work"""


def find_command(given: str) -> str:
    """The path in the preferences, or what the system finds by name.

    Raises:
        RuntimeError: there is none.
    """
    found = given.strip() or shutil.which("fluidlift")
    if not found or not Path(found).is_file() or not os.access(found, os.X_OK):
        raise RuntimeError(
            f"The command fluidlift was not found ({given or 'not on the PATH'}). Install it (pip install fluidlift) "
            "and give its path in Edit > Preferences > Add-ons > fluidlift assets."
        )
    return found


@dataclass
class Call:
    """One running command, whose output goes to a file so that no pipe can fill up."""

    words: list[str]
    output: IO[bytes] = field(default_factory=tempfile.TemporaryFile)

    def __post_init__(self) -> None:
        self.process = subprocess.Popen(self.words, stdout=self.output, stderr=subprocess.STDOUT)

    def running(self) -> bool:
        return self.process.poll() is None

    def wait(self, told: Told = lambda line: None) -> None:
        """Until it has ended; meanwhile what it printed last is told."""
        while True:
            try:
                self.process.wait(EVERY)
                return
            except subprocess.TimeoutExpired:
                told(self.last_line())

    def stop(self) -> None:
        """End it; frames that are finished stay."""
        if self.running():
            self.process.terminate()

    def said(self) -> str:
        """All that it printed so far."""
        if hasattr(os, "pread"):  # the command writes where the file is read: after a seek, over its own beginning
            file = self.output.fileno()
            return os.pread(file, os.fstat(file).st_size, 0).decode("utf-8", "replace")
        self.output.seek(0)
        return self.output.read().decode("utf-8", "replace")

    def last_line(self) -> str:
        lines = [line for line in self.said().replace("\r", "\n").splitlines() if line.strip()]
        return lines[-1].strip() if lines else ""

    def check(self) -> None:
        """Raise RuntimeError with its last lines where it failed."""
        if self.process.returncode not in DONE:
            tail = "\n".join(self.said().strip().splitlines()[-4:])
            raise RuntimeError(f"{' '.join(self.words[1:3])} ended with code {self.process.returncode}: {tail}")


def share_done(line: str) -> float | None:
    """0 to 1, of a line such as `[1/1] export: 12 of 40, about 3 min left`; None where it does not say."""
    found = HOW_FAR.search(line)
    return min(int(found[1]) / int(found[2]), 1.0) if found and int(found[2]) else None


def run(words: list[str], told: Told = lambda line: None) -> str:
    """Run a command to its end; what it printed. Meanwhile the last line of that is told.

    Raises:
        RuntimeError: it failed.
    """
    call = Call(words)
    call.wait(told)
    call.check()
    return call.said()
