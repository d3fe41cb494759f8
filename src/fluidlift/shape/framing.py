"""Where the fluid lies in the picture and in time: what a mask can say against itself before a body is made of it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from fluidlift.messages import Notice

ALL = 0.995
"""share of the picture from which all of it counts as fluid: what a mask of nothing but white has, rounded corners of a
lens or a few specks left aside"""
BORDER = 0.5
"""share of each border, in px, that a fluid on all sides has at least: a stream seen from inside has more, one that
crosses a corner less"""


def framing_warnings(mask: Bool[np.ndarray, "h w"], areas: Float[np.ndarray, " t"]) -> list[Notice]:
    """What the user should know of a fluid that the picture cuts off on all sides, or that is gone at times.

    Args:
        mask: the fluid at the first instant.
        areas: px of fluid in every frame.
    """
    warnings = []
    sides = [mask[0].mean(), mask[-1].mean(), mask[:, 0].mean(), mask[:, -1].mean()]
    if mask.mean() >= ALL:
        warnings.append(
            Notice(
                "whole-picture-fluid",
                "the whole picture counts as fluid: no bank, no bed and no background is seen, so its edges are "
                "those of "
                "the picture and what holds it is made up; a mask must be white on the fluid only",
            )
        )
    elif min(sides) >= BORDER:
        warnings.append(
            Notice(
                "fluid-at-all-borders",
                "the fluid reaches all four borders of the picture: what holds it at the sides is not seen and is "
                "made up; "
                "a mask that is inverted looks like this too",
            )
        )
    present = np.flatnonzero(areas > 0)
    gone = [int(t) for t in range(present[0], present[-1]) if areas[t] == 0] if len(present) else []
    if gone:
        shown = ", ".join(map(str, gone[:6])) + (", ..." if len(gone) > 6 else "")
        warnings.append(
            Notice(
                "frames-without-fluid",
                f"no fluid in {len(gone)} frame(s) between others that have some ({shown}): they are passed over; "
                "check the mask there",
            )
        )
    return warnings
