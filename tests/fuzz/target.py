"""One reader of files from strangers: what it is given, and how it is called."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from .corpus import Seed


@dataclass(frozen=True)
class Target:
    """One reader."""

    seeds: Callable[[], list[Seed]]
    read: Callable[[Path], object]
    """gets the folder that the file is in"""
    name: str
    """of the file in that folder"""
    beside: Callable[[], dict[str, bytes]] = field(default=dict)
    """what else lies in the folder"""
    slow: bool = False
    """takes milliseconds or more: fewer inputs in a run of all tests"""

    def seed(self, number: int) -> Seed:
        """One of the sound files, or what is in it."""
        seeds = _made(self.seeds)
        return seeds[number % len(seeds)]


@cache
def _made(seeds: Callable[[], list[Seed]]) -> list[Seed]:
    return seeds()


def texts(*sound: bytes) -> Callable[[], list[Seed]]:
    """Sound files that are written here."""
    return lambda: [Seed(text) for text in sound]
