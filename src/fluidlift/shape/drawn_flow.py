"""The direction of the flow as a person drew it: arrows, each of which counts as given around it.

Where the motion around an arrow was measured and goes one way at large, all of it is turned by the angle between that
way and the arrow: eddies and what bends around rocks stay as they were seen, and what goes another way there (a ledge
above a pool) stays as it is. Where nothing was measured, or it goes all ways, it loses its confidence, and the arrow
takes its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from fluidlift.errors import InputRejected
from fluidlift.messages import Notice
from fluidlift.shape.view.habit import ROLL
from fluidlift.types import SaidFlow
from fluidlift.types.flow import TRUSTED
from fluidlift.types.hints import Arrow

REACH = 0.25
"""of the picture's longer side, to which an arrow speaks: fully to half of that, and less and less beyond"""
AROUND = 0.05
"""of the longer side: the motion at an arrow is the mean of what was measured about so near it"""
BESIDE = 0.03
"""of the longer side: arrows nearer to each other lie at one place, and cannot point against each other"""
NEAREST = 0.02
"""of the longer side: arrows farther away than this from a pixel count by the inverse square of their distance"""
ONE_WAY = 0.5
"""length of the mean of the measured motion over the mean of its lengths, from which it goes one way"""
ALIKE, UNLIKE = np.cos(np.radians(45.0)), np.cos(np.radians(80.0))
"""of the angle between the motion of a place and that at an arrow, which speaks for the one and not for the other"""
KNOWN = 0.1
"""mean confidence around an arrow from which the motion there was measured"""
LEAST_PX = 0.05
"""px per frame: the error of optical flow at its best (`slope.LEAST_NOISE`)"""
AGAINST = 60.0
"""degrees between an arrow and what was measured with `TRUSTED` confidence around it, from which the user is told"""
PARALLEL = 2.0 * ROLL
"""degrees between a level line and the horizon, at most: twice how far people hold a camera off the level"""
OVERLAP = 0.03
"""of the picture's height that a stroke of sky may hang over the horizon"""
Ends = tuple[tuple[float, float], tuple[float, float]]
"""two points of a line, the left one first"""


@dataclass(frozen=True)
class Heard:
    """What came of the arrows."""

    flow: SaidFlow
    speed: float
    """px per frame, usual for the fluid"""
    warnings: tuple[Notice, ...] = ()

    def mean(
        self, motion: Float[np.ndarray, "h w 2"], trust: Float[np.ndarray, "h w"]
    ) -> tuple[Float[np.ndarray, "h w 2"], Float[np.ndarray, "h w"]]:
        """Mean motion and its confidence with what was said: px per frame, float32."""
        turned = np.einsum("hwij,hwj->hwi", self.flow.turn, motion)
        kept = self.flow.kept[..., None]
        given = self.flow.way * self.speed
        found = np.where(kept < 1.0, kept * turned + (1.0 - kept) * given, turned)
        sure = np.maximum(trust * self.flow.kept, 1.0 - self.flow.kept)
        return found.astype(np.float32), sure.astype(np.float32)


def heard(
    arrows: Sequence[Arrow], mask: Bool[np.ndarray, "h w"], motion: Float[np.ndarray, "h w 2"],
    trust: Float[np.ndarray, "h w"],
) -> Heard:  # fmt: skip
    """What arrows say of the motion.

    Args:
        arrows: px of the working picture.
        mask: fluid pixels.
        motion: mean over the clip, px per frame.
        trust: of it, 0 to 1.

    Raises:
        InputRejected: an arrow beside the fluid, or two at one place that point against each other.
    """
    longer = max(mask.shape)
    _require_one_way_each(arrows, longer)
    grid = np.stack(np.meshgrid(np.arange(mask.shape[1]), np.arange(mask.shape[0])), axis=-1) + 0.5
    speaks, nearness, changes, warnings = [], [], [], []
    speed = _usual_speed(mask, motion, trust)
    for number, arrow in enumerate(arrows, 1):
        away = np.linalg.norm(grid - np.asarray(arrow.at), axis=-1) / longer
        if not (mask & (away < 0.5 * REACH)).any():
            raise InputRejected(
                f"arrow {number} of the flow lies where no fluid was found", "an arrow that begins on the fluid",
                "move it there, or mark the fluid (a region: {is: fluid})",
            )  # fmt: skip
        speaks.append(0.5 + 0.5 * np.cos(np.pi * np.clip(2.0 * away / REACH - 1.0, 0.0, 1.0)))
        nearness.append(1.0 / (away**2 + NEAREST**2))
        turn, told = _change_at(arrow, mask * np.exp(-((away / AROUND) ** 2)), motion, trust)
        changes.append(turn)
        if turn is not None:
            speaks[-1] = speaks[-1] * _likeness(turn.T @ arrow.direction, motion, trust)
        if told is not None and told > AGAINST:
            warnings.append(_against(number, arrow, told))
    weight = np.array(speaks) * np.array(nearness)
    share = weight / np.maximum(weight.sum(axis=0), 1e-12) * np.max(speaks, axis=0)
    one = np.eye(2)
    turns = np.array([one if turn is None else turn for turn in changes]) - one
    lost = np.array([float(turn is None) for turn in changes])
    flow = SaidFlow(
        (one + np.einsum("khw,kij->hwij", share, turns)).astype(np.float32),
        (1.0 - np.einsum("khw,k->hw", share, lost)).astype(np.float32),
        np.einsum("khw,ki->hwi", share, np.array([a.direction for a in arrows])).astype(np.float32),
    )
    return Heard(flow, speed, tuple(warnings))


def _change_at(
    arrow: Arrow, around: np.ndarray, motion: np.ndarray, trust: np.ndarray
) -> tuple[np.ndarray | None, float | None]:
    """The turn [2,2] from the motion measured around an arrow to the arrow, and by how many degrees where that motion
    is sure; no turn where nothing was measured there or it goes all ways.

    Args:
        arrow: px.
        around: [h,w], weight of each place.
        motion: px per frame.
        trust: of it.
    """
    weight = around * trust
    sure = float(weight.sum() / max(around.sum(), 1e-12))
    if sure < KNOWN:
        return None, None
    total = np.einsum("hw,hwi->i", weight, motion)
    lengths = float((weight * np.linalg.norm(motion, axis=-1)).sum())
    if lengths < LEAST_PX * weight.sum() or np.linalg.norm(total) < ONE_WAY * lengths:
        return None, None
    (dx, dy), (mx, my) = arrow.direction, total / np.linalg.norm(total)
    cosine, sine = dx * mx + dy * my, mx * dy - my * dx
    degrees = float(np.degrees(np.arctan2(abs(sine), cosine)))
    return np.array([[cosine, -sine], [sine, cosine]]), degrees if sure > TRUSTED else None


def _likeness(way: np.ndarray, motion: np.ndarray, trust: np.ndarray) -> np.ndarray:
    """[h,w], 0 to 1: how far each place goes a way (unit vector) at large; 1 where nothing was measured."""
    sigma = NEAREST * max(trust.shape)
    mean, known = (cv2.GaussianBlur(a.astype(np.float32), (0, 0), sigma) for a in (motion * trust[..., None], trust))
    length = np.linalg.norm(mean, axis=-1)
    cosine = (mean @ way.astype(np.float32)) / np.maximum(length, 1e-9)
    like = np.clip((cosine - UNLIKE) / (ALIKE - UNLIKE), 0.0, 1.0)
    return np.where((known < KNOWN) | (length < LEAST_PX * known), 1.0, like)


def _usual_speed(mask: np.ndarray, motion: np.ndarray, trust: np.ndarray) -> float:
    """px per frame: median of what was measured on the fluid; one where nothing was."""
    known = mask & (trust > TRUSTED)
    speeds = np.linalg.norm(motion[known], axis=-1)
    return max(float(np.median(speeds)), LEAST_PX) if known.any() else 1.0


def _require_one_way_each(arrows: Sequence[Arrow], longer: int) -> None:
    for k, a in enumerate(arrows):
        for m, b in enumerate(arrows[:k]):
            apart = np.hypot(a.at[0] - b.at[0], a.at[1] - b.at[1])
            if apart < BESIDE * longer and a.direction[0] * b.direction[0] + a.direction[1] * b.direction[1] < 0:
                raise InputRejected(
                    f"arrows {m + 1} and {k + 1} of the flow begin at one place and point against each other",
                    "one direction at a place", "turn or take back one of them",
                )  # fmt: skip


def _against(number: int, arrow: Arrow, degrees: float) -> Notice:
    return Notice(
        "flow-as-drawn",
        f"arrow {number} of the flow, at ({arrow.at[0]:.0f}, {arrow.at[1]:.0f}) px of the working picture, is "
        f"{degrees:.0f} degrees off what was measured around it: yours counts; if it was not meant so, turn it or take "
        "it back",
    )


def require_downhill(arrows: Sequence[Arrow], ledges: Sequence[np.ndarray], horizon: Ends | None) -> None:
    """Raise `InputRejected` where an arrow runs up a ledge, against the vertical of the picture.

    Args:
        arrows: px of the working picture.
        ledges: bool [h,w], pixels of each marked ledge.
        horizon: two points, the left one first; None: the picture's own vertical.
    """
    down = np.array([0.0, 1.0])
    if horizon is not None:
        (ax, ay), (bx, by) = horizon
        down = np.array([ay - by, bx - ax]) / max(float(np.hypot(bx - ax, by - ay)), 1e-9)
    for number, arrow in enumerate(arrows, 1):
        points = (arrow.at, (0.5 * (arrow.at[0] + arrow.to[0]), 0.5 * (arrow.at[1] + arrow.to[1])))
        for which, pixels in enumerate(ledges, 1):
            if any(_at(pixels, p) for p in points) and float(np.dot(arrow.direction, down)) <= 0.0:
                raise InputRejected(
                    f"ledge {which} runs uphill: arrow {number} of the flow points up it",
                    "water that comes down a ledge", "turn the arrow, or take the ledge back",
                )  # fmt: skip


def require_one_horizon(
    horizon: Ends | None, level: Ends | None, sky_ends: Sequence[tuple[float, float]], height: int
) -> None:  # fmt: skip
    """Raise `InputRejected` where what was drawn means two horizons.

    Args:
        horizon: two points of it, the left one first.
        level: two points of a level line, which is parallel to it, the left one first.
        sky_ends: points of marked sky.
        height: px, of the picture.
    """
    if horizon is None:
        return
    (ax, ay), (bx, by) = horizon
    slope = np.arctan2(by - ay, bx - ax)
    if level is not None:
        turned = np.degrees(abs(np.arctan2(level[1][1] - level[0][1], level[1][0] - level[0][0]) - slope))
        if turned > PARALLEL:
            raise InputRejected(
                f"two horizons: the level line is turned by {turned:.0f} degrees against the horizon that was drawn",
                "lines that are parallel to within 5 degrees", "turn or take back one of them",
            )  # fmt: skip
    below = [(y - ay) * np.cos(slope) - (x - ax) * np.sin(slope) for x, y in sky_ends]
    if below and max(below) > OVERLAP * height:
        raise InputRejected(
            "two horizons: marked sky reaches below the horizon that was drawn", "sky above the horizon",
            "move the horizon down, or take the sky back (what is reflected is no sky)",
        )  # fmt: skip


def _at(pixels: np.ndarray, point: tuple[float, float]) -> bool:
    u, v = int(point[0]), int(point[1])
    return 0 <= v < pixels.shape[0] and 0 <= u < pixels.shape[1] and bool(pixels[v, u])
