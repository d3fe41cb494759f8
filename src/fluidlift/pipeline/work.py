"""What a stage may use of its run beside its inputs: room on disk, and who is told how far it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from fluidlift.io.stage_cache import Scratch
from fluidlift.messages import Notice

T = TypeVar("T")


def _alone(name: str, function: Callable[..., T], *inputs: Any, **named: Any) -> T:
    return function(*inputs, **named)


@dataclass(frozen=True)
class Work:
    """Nothing of it changes what a stage finds."""

    scratch: Scratch
    """for large arrays"""
    step: Callable[[int, int], None] = lambda done, total: None
    """told (done, all)"""
    warn: Callable[[Notice], None] = lambda text: None
    key: str = ""
    """of the stage's result, for files that are kept under it"""
    again: bool = False
    """this stage, or one before it, was asked for again: what was kept of an earlier run does not count"""
    part: Callable[..., Any] = _alone
    """`part(name, function, *inputs, **named)` is `function(*inputs, work=..., **named)`; what is slow is kept between
    runs"""

    remembered: Callable[..., Any] = _alone
    """likewise; kept in memory alone, the last value of each name, where the run is one of several of one process"""

    @classmethod
    def alone(cls, folder: Path) -> Work:
        """Of a stage that is called by itself."""
        work = cls(Scratch(folder, "alone"))
        return replace(work, part=lambda name, function, *inputs, **named: function(*inputs, work=work, **named))
