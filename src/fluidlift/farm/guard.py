"""A make ends with who started it, also where that was killed: nobody would take what it makes, or count its memory."""

from __future__ import annotations

import os
import signal
import threading

WATCHED = "FLUIDLIFT_ENDS_WITH_STDIN"
"""environment variable of a make whose standard input is a pipe that its parent holds, and never writes to"""


def end_with_parent() -> None:
    """Kill this process, and its group where it leads one, once its parent is gone; only where `WATCHED` is set.

    At once, without last steps: files are whole or absent (`io.atomic`), and the next try goes on from the last stage.
    What this process starts itself does not watch.
    """
    if os.environ.pop(WATCHED, "") != "1":
        return
    threading.Thread(target=_watch, daemon=True, name="parent").start()


def _watch() -> None:
    try:
        while os.read(0, 1):
            pass
    except OSError:  # no standard input
        return
    if os.getpgid(0) == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os.kill(os.getpid(), signal.SIGKILL)
