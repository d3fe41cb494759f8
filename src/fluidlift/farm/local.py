"""The engine of one machine: a process per shot, some at a time."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path

from fluidlift.farm.engine import Limits, Tell, next_limits
from fluidlift.farm.making import RunningMakes, make_shot
from fluidlift.farm.preflight import looked_at, require_fit
from fluidlift.farm.shots import Shot
from fluidlift.farm.state import ShotOutcome, list_names
from fluidlift.farm.store import Store
from fluidlift.machine import available_memory, cores


@dataclass(frozen=True)
class LocalEngine:
    """Processes of this machine, among which its cores are divided."""

    jobs: int = 1
    """at a time"""
    store: Store | None = None
    """where assets belong, which are made in the folder; None: there"""

    def shots(self, shots: list[Shot], folder: Path, limits: Limits, tell: Tell, part: Tell) -> Iterator[ShotOutcome]:
        """As `Engine.shots`."""
        require_fit([looked_at(folder)], folder)
        list_names(folder, [shot.name for shot in shots])
        limits = limits if limits.threads else replace(limits, threads=max(cores() // self.jobs, 1))
        making = RunningMakes(tell, part)
        with ThreadPoolExecutor(self.jobs) as pool:
            waiting = [pool.submit(_shot, shot, folder, limits, making, self.store) for shot in shots]
            try:
                for one in as_completed(waiting):
                    if (outcome := one.result()) is not None:
                        yield outcome
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                making.stop()
                raise


def _shot(shot: Shot, folder: Path, limits: Limits, making: RunningMakes, store: Store | None) -> ShotOutcome | None:
    """As `make_shot`, as often as it can help."""
    outcome = None
    bounds: Limits | None = limits
    while bounds is not None:
        last = make_shot(shot, folder, bounds, making, store)
        outcome = outcome if last is None else last
        bounds = None if last is None or making.stopped else next_limits(last, bounds, available_memory())
        if bounds is not None and last is not None:
            making.tell(f"{shot.name}: {last.reason or last.failure}; tried again")
    return outcome
