"""What a person says about where the fluid is, on the command line or in a hints file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.pipeline.inputs import GivenFiles
from fluidlift.shape import drawn, drawn_flow
from fluidlift.types.hints import ClipHints


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

    @classmethod
    def drawn(cls, hints: ClipHints) -> Hints:
        """Those of a hints file, in px of the working picture (`ClipHints.at`)."""
        points = tuple((c.at[0], c.at[1], c.fluid) for c in hints.clicks)
        if hints.roi is None:
            return cls(None, points)
        x, y, width, height = hints.roi
        return cls((round(x), round(y), round(width), round(height)), points)

    def clicks(self) -> list[tuple[float, float, int]]:
        """The points as `shape.segment` takes them."""
        return [(x, y, int(there)) for x, y, there in self.points]


NO_HINTS = Hints()


def require_no_contradiction(hints: ClipHints, config: JobConfig, given: GivenFiles) -> None:
    """Raise `InputRejected` where a hints file and what stands beside it say the same thing twice."""
    s = config.shape
    if hints.horizon is not None and (s.pitch is not None or s.roll is not None):
        raise InputRejected(
            "two horizons: one drawn in the hints, and --pitch or --roll", "one of them", "leave one out"
        )
    if hints.level is not None and s.roll is not None:
        raise InputRejected("two levels: a line drawn in the hints, and --roll", "one of them", "leave one out")
    if hints.ruler is not None and s.size is not None:
        raise InputRejected("two sizes: a ruler in the hints, and --size", "one of them", "leave one out")
    if given.camera is not None and (hints.horizon is not None or hints.fov is not None):
        from fluidlift.io.images import read_json

        posed = {"R", "frames"} & set(read_json(given.camera.path, "camera file"))
        if hints.fov is not None or posed:
            raise InputRejected(
                "a camera file, and a horizon or a field of view in the hints", "one of them", "leave one out"
            )


def require_possible(hints: ClipHints, size: tuple[int, int]) -> None:
    """Raise `InputRejected` where what was drawn cannot be: water that runs up a ledge, two horizons.

    Args:
        hints: px of the working picture.
        size: width and height of it.
    """
    marked = {what: [r for r in hints.regions if r.what == what] for what in ("ledge", "sky")}
    shape = (size[1], size[0])
    ledges = [drawn.drawn_pixels(r.line, r.width, shape) for r in marked["ledge"]] if hints.flow else []
    drawn_flow.require_downhill(hints.flow, ledges, hints.horizon)
    drawn_flow.require_one_horizon(hints.horizon, hints.level, [p for r in marked["sky"] for p in r.line], size[1])


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
