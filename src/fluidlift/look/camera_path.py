"""Where a film is seen from: one camera for every frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fluidlift.errors import require
from fluidlift.look.scenery import orbit_camera
from fluidlift.types import PinholeCamera, ViewKey

ELEVATION = 24.0
"""degrees above the horizontal, of views from all around"""


def orbit_path(
    camera: PinholeCamera,
    points: Float[np.ndarray, "n 3"],
    frames: int,
    *,
    turn: float = 360.0,
    size: tuple[int, int] | None = None,
) -> list[PinholeCamera]:
    """Cameras that go around the middle of some points at one height and distance, from the side of the original view.

    A full turn ends one step before its start, so that it loops.

    Args:
        camera: the original view.
        points: what must be seen from everywhere, m.
        frames: of the film.
        turn: degrees over all frames, counter-clockwise seen from above.
        size: of the picture; None keeps the original's.
    """
    require(frames > 0, f"{frames} frames", "at least one")
    steps = frames if abs(turn) % 360.0 == 0.0 else max(frames - 1, 1)
    around = [orbit_camera(camera, points, azimuth=turn * k / steps, elevation=ELEVATION, size=size)
              for k in range(frames)]  # fmt: skip
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    # each is as near as its own view allows: from one distance nothing swells on the way
    farthest = max(float(np.linalg.norm(c.position - centre)) for c in around)
    out = []
    for one in around:
        away = one.position - centre
        eye = centre + away * (farthest / max(float(np.linalg.norm(away)), 1e-12))
        view = PinholeCamera.looking(eye, centre, 40.0, one.size)
        out.append(PinholeCamera(one.focal, one.center, one.size, view.camera_from_world))
    return out


def keyed_path(keys: Sequence[ViewKey], frames: int, size: tuple[int, int]) -> list[PinholeCamera]:
    """Cameras through keys, monotone cubic in time (PCHIP, Fritsch and Butland 1984: it never overshoots a key); they
    stand still before the first key and after the last.

    Args:
        keys: in any order; one alone is a standing camera.
        frames: of the film.
        size: width, height of the picture, px.

    Raises:
        ValueError: no keys, two of one frame, or an eye at its target on the way.
    """
    from scipy.interpolate import PchipInterpolator  # a third of a second that other cameras need not wait

    require(len(keys) > 0 and frames > 0, f"{len(keys)} keys and {frames} frames", "at least one of each")
    ordered = sorted(keys, key=lambda k: k.frame)
    times = np.array([k.frame for k in ordered], float)
    require(len(times) < 2 or bool((np.diff(times) > 0).all()), "two camera keys of one frame", "one key per frame")
    values = np.array([[*k.eye, *k.target, k.fov] for k in ordered], float)
    at = np.clip(np.arange(frames, dtype=float), times[0], times[-1])
    rows = values[np.zeros(frames, int)] if len(times) == 1 else PchipInterpolator(times, values, axis=0)(at)
    return [PinholeCamera.looking(r[:3], r[3:6], float(r[6]), size) for r in rows]
