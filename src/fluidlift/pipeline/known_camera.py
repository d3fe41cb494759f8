"""What is known of the camera: its lens and its pose from a file, the user or the video, and where the ground lies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fluidlift.messages import NONE, Notice
from fluidlift.pipeline import given_body
from fluidlift.pipeline.inputs import GivenFile
from fluidlift.pipeline.settings import GivenView
from fluidlift.types import PinholeCamera

USUAL_FIELD_OF_VIEW = 50.0
"""degrees across the longer side, where nothing says better: between a phone's main lens (65) and a short telephoto"""
USUAL_SPREAD = 0.4
"""relative standard deviation of the focal length then: 65 degrees are 0.3 away in its logarithm, 30 degrees 0.6"""
MODEL_LENS_ERROR = 0.08
"""relative standard error of a learned model's focal length: assumed, some 3.5 degrees of 50; none was measured here"""


class KnownCamera(NamedTuple):
    """A camera, and what of it somebody knows."""

    camera: PinholeCamera
    pose_given: bool
    lens_told: bool
    """the user, a camera file or the clip's file says how wide the picture is"""


def known_field_of_view(given: GivenView, fov: float | None, size: tuple[int, int]) -> tuple[float, bool]:
    """Degrees across the longer side, and whether that was told: by the user, a camera file or the lens."""
    known = known_camera(given, fov, size)
    return float(2 * np.degrees(np.arctan(0.5 * max(size) / max(known.camera.focal)))), known.lens_told


def known_camera(given: GivenView, fov: float | None, size: tuple[int, int]) -> KnownCamera:
    """The camera file's camera, or one from the field of view (`fov`, degrees)."""
    from fluidlift.io.images import read_camera
    from fluidlift.io.lens import lens_field_of_view

    bodies = None if given.bodies is None else given.bodies.path
    wide = None if given.camera is not None else fov or lens_field_of_view(given.clip.path)
    told = given.camera is not None or bool(wide)
    if bodies is not None and given_body.note_of(bodies) is None:
        # its camera is the one that saw the body; its world is not the user's
        return KnownCamera(read_camera(bodies / "camera.json", size), False, told)
    if given.camera is None:
        return KnownCamera(PinholeCamera.from_fov(wide or USUAL_FIELD_OF_VIEW, size), False, told)
    return KnownCamera(read_camera(given.camera.path, size), tells_pose(given.camera.path), told)


def tells_pose(path: Path) -> bool:
    """Whether a camera file says where the camera stands, and not its lens alone.

    Raises:
        InputRejected: it cannot be read.
    """
    from fluidlift.io.images import read_json

    data = read_json(path, "camera file")
    return "R" in data or "frames" in data


def with_model_lens(camera: PinholeCamera, error: float, field_of_view: float) -> PinholeCamera:
    """The camera with the focal length that its own evidence and a learned model's field of view give together.

    Args:
        camera: as it is taken to be without the model.
        error: relative standard deviation of its focal length: `USUAL_SPREAD` where nothing says it.
        field_of_view: degrees across the longer side, by the model.
    """
    seen = float(PinholeCamera.from_fov(field_of_view, camera.size).focal[0])
    weights = np.array([max(error, 1e-3), MODEL_LENS_ERROR]) ** -2.0
    focal = float(np.exp(weights @ np.log([camera.focal[0], seen]) / weights.sum()))
    return replace(camera, focal=(focal, focal))


def level_of(level: tuple[str, str], camera: GivenFile | None) -> tuple[float, Notice]:
    """z of the plane that a surveyed camera stands over (`FluidKind.surveyed_level`), m, where a camera file says it;
    else 0, the ground of its world, and a warning.
    """
    from fluidlift.io.images import read_json

    name, what = level
    data = read_json(camera.path, "camera file") if camera is not None else {}
    value = data.get(name)
    if isinstance(value, int | float):
        return float(value), NONE
    return 0.0, (
        Notice(
            "camera-height-missing",
            f"the camera file does not say how high {what}: z = 0 is assumed, which sets the scale; "
            f"add {name} (m) to it, or give --size",
        )
    )
