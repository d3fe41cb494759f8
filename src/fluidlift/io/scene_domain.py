"""Whether what a person put into a scene lies where the simulation takes place."""

from __future__ import annotations

import numpy as np

from fluidlift.errors import InputRejected
from fluidlift.io.obstacles import Obstacle
from fluidlift.io.scene import SceneEdits
from fluidlift.messages import Notice
from fluidlift.physics.terrain_edit import Replace
from fluidlift.types import Grid, TriangleMesh, matrix_from_quat

HUGE = 20.0
"""times the domain's longest side above which a mesh is taken to be in other units"""
MOSTLY = 0.5
"""share of a mesh's extent outside the domain above which one is warned"""
DROP = 2.0
"""longest sides of the domain above it from which a free obstacle may be dropped"""
PULL = (0.0, 0.0, -9.81)
"""m/s^2, where scene.yaml gives no gravity: which way is down matters, not how strong"""


def require_inside(
    edits: SceneEdits, grid: Grid, *, reach: float = 0.0, above: float = 0.0, seconds: float | None = None
) -> list[Notice]:
    """See that obstacles, emitters and a new terrain touch the simulation's box.

    Args:
        edits: of scene.yaml.
        grid: that is simulated on.
        reach: m by which the box may become longer than that to each side (a channel that is extended).
        above: m by which it may become higher for emitters.
        seconds: that are simulated; None: they do not matter.

    Returns:
        Warnings about those that lie mostly outside, or fall in only after the end.

    Raises:
        InputRejected: one that lies wholly outside, or is many times larger than the box; the message names its line.
    """
    low = np.asarray(grid.low, float) - [reach, reach, 0.0]
    high = np.asarray(grid.high, float) + [reach, reach, 0.0]
    warnings = []
    for obstacle in edits.obstacles:
        what = f"{obstacle.line}: obstacle '{obstacle.name}'"
        fall = _fall(obstacle, (low, high), edits.parameters.get("gravity", PULL)[2])
        if fall is not None:
            late = seconds is not None and fall > seconds
            warnings += [
                Notice(
                    "obstacle-falls-late",
                    f"{what} falls for {fall:.2g} s before it is in the domain, after the last frame",
                )
            ] * late
            continue
        warnings += _judged(what, _all_places(obstacle), (low, high), still=obstacle.motion == "static")
    for emitter in edits.emitters:
        points = _points(emitter.mesh)
        most = high + [0.0, 0.0, above]  # the box is made higher for a whole emitter only
        box = (low, most if points[:, 2].max() < most[2] else high)
        warnings += _judged(f"{emitter.line}: emitter '{emitter.name}'", [points], box, room=most)
    for edit in edits.terrain:
        if isinstance(edit, Replace):  # a bed may go on far beyond the box
            _judged(f"{edit.line}: the terrain's mesh", [_points(edit.mesh)], (low, high), still=False)
    return warnings


def _fall(obstacle: Obstacle, box: tuple[np.ndarray, np.ndarray], pull: float) -> float | None:
    """Seconds in which a free obstacle falls into the box from straight above it; None where it is no such one."""
    points = _all_places(obstacle)[0]
    (low, high), first, last = box, points.min(axis=0), points.max(axis=0)
    way = float(first[2] - high[2])
    over = ((last > low) & (first < high))[:2].all() and 0 <= way < DROP * float((high - low).max())
    if obstacle.motion != "free" or not over or pull >= 0:
        return None
    rise = float(obstacle.velocity[2])
    return (rise + (rise * rise - 2.0 * pull * way) ** 0.5) / -pull


def _points(mesh: TriangleMesh) -> np.ndarray:
    return np.asarray(mesh.vertices, float)


def _all_places(obstacle: Obstacle) -> list[np.ndarray]:
    """The vertices in the world, m, at the start and at each keyframe."""
    points = _points(obstacle.mesh)
    poses = [(k.rotation, k.position) for k in obstacle.keyframes] or [(obstacle.rotation, obstacle.position)]
    return [points @ matrix_from_quat(turn).T + np.asarray(at, float) for turn, at in poses]


def _judged(
    what: str, places: list[np.ndarray], box: tuple[np.ndarray, np.ndarray], *, still: bool = True,
    room: np.ndarray | None = None,
) -> list[Notice]:  # fmt: skip
    low, high = box
    size = float(max(np.ptp(p, axis=0).max() for p in places))
    side = float((high - low).max())
    if size > HUGE * side:
        raise InputRejected(
            f"{what} is {size:.3g} m long, in a domain of {side:.3g} m", f"metres, at most {HUGE:g} times the domain",
            f"is it in millimetres or centimetres? write scale: {_unit(size / side):g}",
        )  # fmt: skip
    touching = [p for p in places if ((p.max(axis=0) > low) & (p.min(axis=0) < high)).all()]
    if not touching and len(places) > 1:  # it may pass through between two keyframes
        together = np.concatenate(places)
        touching = [together] * bool(((together.max(axis=0) > low) & (together.min(axis=0) < high)).all())
    if not touching:
        start = places[0]
        raise InputRejected(
            f"{what} from {_place(start.min(axis=0))} to {_place(start.max(axis=0))} m lies outside the domain",
            f"a place within {_place(low)} to {_place(high if room is None else room)} m",
            "change its position or scale",
        )
    outside = min(1.0 - _share_inside(p, low, high) for p in touching)
    if still and outside > MOSTLY:
        return [
            Notice(
                "mostly-outside",
                f"{what} lies outside the domain with {100 * outside:.0f} % of its extent: only the rest acts",
            )
        ]
    return []


def _share_inside(points: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Of the volume of the box around some points."""
    first, last = points.min(axis=0), points.max(axis=0)
    common = np.minimum(last, high) - np.maximum(first, low)
    return float(np.prod(np.clip(common, 0.0, None) / np.maximum(last - first, 1e-12)))


def _unit(ratio: float) -> float:
    return 0.001 if ratio > 200 else 0.01


def _place(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.3g}" for x in point) + ")"
