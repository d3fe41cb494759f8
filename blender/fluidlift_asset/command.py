"""Calls of the fluidlift command, which does the work in its own Python."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

DONE = (0, 4)
"""exit codes of success; 4: with warnings"""


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

    def wait(self) -> None:
        self.process.wait()

    def stop(self) -> None:
        """End it; frames that are finished stay."""
        if self.running():
            self.process.terminate()

    def said(self) -> str:
        """All that it printed so far."""
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


def run(words: list[str]) -> str:
    """Run a command to its end; what it printed.

    Raises:
        RuntimeError: it failed.
    """
    call = Call(words)
    call.wait()
    call.check()
    return call.said()
