"""What a person gets to read where fluidlift itself is at fault: one line, and a file with the details."""

from __future__ import annotations

import os
import platform
import tempfile
import traceback
from collections.abc import Sequence

from fluidlift import __version__

DEBUG = "FLUIDLIFT_DEBUG"
"""environment variable: anything but empty or 0 shows the traceback on standard error"""
_LONGEST = 200


def failure_line(error: BaseException, args: Sequence[str]) -> str:
    """One line on an exception that nobody expected, with the name of the file that its traceback was written to.

    Args:
        error: what was raised; its notes say what was being done (`fluidlift.progress`).
        args: of the command line.
    """
    doing = next((note for note in reversed(getattr(error, "__notes__", ())) if note.startswith("while ")), "")
    command = args[0] if args and not args[0].startswith("-") else "the command"
    what = " ".join(f"{type(error).__name__}: {error}".split())[:_LONGEST].rstrip(": ")
    if isinstance(error, MemoryError):
        return (
            f"fluidlift: {command} ran out of memory{' ' + doing if doing else ''}. Do: close other programs, or make "
            "it smaller (--preset draft, --max-size, --duration)"
        )
    if os.environ.get(DEBUG, "") not in ("", "0"):
        return f"{''.join(traceback.format_exception(error))}fluidlift: {command} failed{' ' + doing if doing else ''}"
    return (
        f"fluidlift: {command} failed{' ' + doing if doing else ''} ({what}). This is a fault of fluidlift. "
        f"Details: {_logged(error, args)}. Do: report it with that file; {DEBUG}=1 shows the traceback"
    )


def _logged(error: BaseException, args: Sequence[str]) -> str:
    """The name of a new file, which only this user may read, with versions, command and traceback."""
    text = (
        f"fluidlift {__version__}, Python {platform.python_version()}, {platform.platform()}\n"
        f"fluidlift {' '.join(args)}\n\n{''.join(traceback.format_exception(error))}"
    )
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="fluidlift-", suffix=".log", delete=False, encoding="utf-8", errors="replace"
        ) as file:
            file.write(text)
    except OSError as unwritten:
        return f"not kept, no temporary folder can be written ({unwritten.strerror})"
    return file.name
