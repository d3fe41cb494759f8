"""What a person says about where the fluid is, on the command line or in a hints file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.errors import InputRejected
from fluidlift.messages import NONE, Notice
from fluidlift.pipeline.inputs import GivenFiles
from fluidlift.shape import drawn, drawn_flow
from fluidlift.shape.drawn import frame_at
from fluidlift.types.hints import ClipHints, ClipIdentity, Point
from fluidlift.types.stages import Read


@dataclass(frozen=True)
class MaskHints:
    """What a person says about where the fluid is, in px of the working picture."""

    roi: tuple[int, int, int, int] | None = None
    """x, y, width, height: fluid is only looked for inside"""
    points: tuple[tuple[float, float, bool], ...] = ()
    """x, y, and whether there is fluid there"""

    @classmethod
    def of(cls, roi: str | None, here: Sequence[str], not_here: Sequence[str]) -> MaskHints:
        """From texts such as "10,20,300,200" and "64,48".

        Raises:
            InputRejected: a text that is no list of so many numbers.
        """
        box = None if roi is None else _numbers(roi, 4, "--roi", "x,y,width,height")
        points = [(*_numbers(text, 2, "--click", "x,y"), True) for text in here]
        points += [(*_numbers(text, 2, "--not-here", "x,y"), False) for text in not_here]
        return cls(None if box is None else tuple(round(v) for v in box), tuple(points))  # type: ignore[arg-type]

    @classmethod
    def drawn(cls, hints: ClipHints) -> MaskHints:
        """Those of a hints file, in px of the working picture (`ClipHints.at`)."""
        points = tuple((c.at[0], c.at[1], c.fluid) for c in hints.clicks)
        if hints.roi is None:
            return cls(None, points)
        x, y, width, height = hints.roi
        return cls((round(x), round(y), round(width), round(height)), points)


NO_HINTS = MaskHints()


def laid_on(hints: ClipHints, read: Read) -> tuple[ClipHints, Notice]:
    """Hints in px of the working picture that all frames are laid on, and what to say of it.

    Where the camera's motion was taken out, a point of the frame that it was drawn on (`ClipIdentity.time`) lies where
    the middle of that frame went: turning and zoom of a hand-held camera move it by less than a person's hand does.

    Raises:
        InputRejected: a picture of another shape, or what cannot be: water that runs up a ledge, two horizons.
    """
    drawn = hints.at(read.clip.size)
    shift = picture_shift(read, None if hints.clip is None else hints.clip.time)
    if shift is None:
        _require_possible(drawn, read.clip.size)
        return drawn, NONE
    drawn = drawn.moved(shift)
    _require_possible(drawn, read.clip.size)
    times, time = read.clip.times, cast(ClipIdentity, hints.clip).time
    near = read.clip.interval
    unseen = hints.has_points and not times[0] - near <= cast(float, time) <= times[-1] + near
    said = Notice(
        "hints-of-another-part",
        f"the hints were drawn on the picture at {time:.2f} s, which is not among those in use, and the camera moves: "
        "where they lie is a guess; look at the mask, and draw them again on this part",
    )
    return drawn, said if unseen else NONE


def picture_shift(read: Read, time: float | None) -> Point | None:
    """px of the working picture from the frame at a time, s, to the one that all are laid on; None: it is that one."""
    if time is None or not read.stabilised or read.path is None:
        return None
    x, y = read.path[frame_at(read.clip.times, time)]
    return float(x), float(y)


def time_laid_on(read: Read) -> float | None:
    """s into the clip of the frame that the others are laid on; None where the camera's motion was not taken out."""
    if not read.stabilised or read.path is None:
        return None
    return round(float(read.clip.times[int(np.linalg.norm(read.path, axis=1).argmin())]), 4)


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
    if given.camera is not None and any(v is not None for v in (hints.horizon, hints.pitch, hints.fov)):
        from fluidlift.io.images import read_json

        posed = {"R", "frames"} & set(read_json(given.camera.path, "camera file"))
        if hints.fov is not None or posed:
            raise InputRejected(
                "a camera file, and a horizon, a pitch or a field of view in the hints", "one of them", "leave one out"
            )


def _require_possible(hints: ClipHints, size: tuple[int, int]) -> None:
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
