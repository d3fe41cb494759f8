"""Who makes shots: the seam behind which processes of this machine and a cluster are alike.

An engine decides where and when; what a make is, what it leaves and when a shot is finished is the same for all
(`farm.making`), so that one engine goes on where another was stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from fluidlift.farm.shots import Shot
from fluidlift.farm.state import ShotOutcome

Tell = Callable[[str], None]

TASK_CORES = 2
"""of a task on a farm or a cluster: a make is 1.5 times as fast on two as on one, and little faster on more"""
TASK_MEMORY = 4e9
"""bytes: a make of the demo takes 1.0 GB, one of a clip of 3 s at 512 px 1.4 GB; longer clips and finer cells more"""


@dataclass(frozen=True)
class Limits:
    """What each shot may take, and how often it is tried."""

    seconds: float | None = None
    memory: float | None = None
    """bytes, resident, of a make and all that it starts"""
    retry: str | None = None
    """make only shots that failed like that; None: all that are not finished"""
    tries: int = 1
    """before a shot counts as failed, where another one can help (`next_limits`)"""
    threads: int | None = None
    """of each make; None: as many as this process has cores"""
    program: tuple[str, ...] | None = None
    """what makes a shot, given the arguments of `fluidlift`; None: fluidlift, on whatever machine"""


class Engine(Protocol):
    """Makes shots."""

    def shots(self, shots: list[Shot], folder: Path, limits: Limits, tell: Tell, part: Tell) -> Iterator[ShotOutcome]:
        """Each shot as it ends; of those that are finished what is known of them, and no process is started.

        Stopped (Ctrl-C, SIGTERM), the makes that run are told to end; what they finished is kept.

        Args:
            shots: with names of their own.
            folder: for assets, logs and states; it is there.
            limits: of each.
            tell: lines for people.
            part: told "done of all" of the stages of a shot that is the only one, for farms.

        Raises:
            InputRejected: what would fail every shot: a full disk, machines that cannot do it. Before any has begun,
                as far as that can be seen.
        """
        ...


def next_limits(outcome: ShotOutcome, limits: Limits, most: float) -> Limits | None:
    """Those of the next try of a shot that failed; None where another one would end alike.

    What is wrong with the input stays wrong, and what took too long would again. What broke down, or was ended from
    outside, may have been the machine. What needed more memory gets twice as much.

    Args:
        outcome: of the last try.
        limits: of the last try.
        most: bytes that a make may be given.
    """
    if outcome.well or limits.tries <= 1 or outcome.failure in ("input", "time"):
        return None
    fewer = replace(limits, tries=limits.tries - 1, retry=None)
    if outcome.failure != "memory" or limits.memory is None:
        return fewer
    return replace(fewer, memory=min(2.0 * limits.memory, most)) if limits.memory < most else None
