"""What a person says about where the fluid is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluidlift.errors import InputRejected


@dataclass(frozen=True)
class Hints:
    """What a person says about where the fluid is, in px of the working picture."""

    roi: tuple[int, int, int, int] | None = None
    """x, y, width, height: fluid is only looked for inside"""
    points: tuple[tuple[float, float, bool], ...] = ()
    """x, y, and whether there is fluid there"""

    @classmethod
    def of(cls, roi: str | None, here: Sequence[str], not_here: Sequence[str]) -> Hints:
        """From texts such as "10,20,300,200" and "64,48".

        Raises:
            InputRejected: a text that is no list of so many numbers.
        """
        box = None if roi is None else _numbers(roi, 4, "--roi", "x,y,width,height")
        points = [(*_numbers(text, 2, "--click", "x,y"), True) for text in here]
        points += [(*_numbers(text, 2, "--not-here", "x,y"), False) for text in not_here]
        return cls(None if box is None else tuple(round(v) for v in box), tuple(points))  # type: ignore[arg-type]

    def clicks(self) -> list[tuple[float, float, int]]:
        """The points as `shape.segment` takes them."""
        return [(x, y, int(there)) for x, y, there in self.points]


NO_HINTS = Hints()


def _numbers(text: str, count: int, option: str, form: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not np.isfinite(values).all():
        raise InputRejected(
            f"{option} {text}", f"{form} in px", f"such as {option} {','.join(['64', '48', '320', '200'][:count])}"
        )
    return values
