"""What is known of the camera: its lens and its pose from a file, the user or the video, and where the ground lies."""

from __future__ import annotations

import numpy as np

from fluidlift.config import JobConfig
from fluidlift.pipeline import given_body
from fluidlift.pipeline.reading import Inputs
from fluidlift.types import PinholeCamera

USUAL_FIELD_OF_VIEW = 50.0
"""degrees across the longer side, where nothing says better: between a phone's main lens (65) and a short telephoto"""


def known_field_of_view(inputs: Inputs, config: JobConfig, size: tuple[int, int]) -> tuple[float, bool]:
    """Degrees across the longer side, and whether that was told: by the user, a camera file or the lens."""
    from fluidlift.io.lens import lens_field_of_view

    focal = max(known_camera(inputs, config, size)[0].focal)
    told = inputs.camera is not None or config.shape.fov or lens_field_of_view(inputs.clip)
    return float(2 * np.degrees(np.arctan(0.5 * max(size) / focal))), bool(told)


def known_camera(inputs: Inputs, config: JobConfig, size: tuple[int, int]) -> tuple[PinholeCamera, bool]:
    """The camera file's camera, or one from the field of view; and whether its pose is known."""
    from fluidlift.io.images import read_camera, read_json

    if inputs.geometry is not None and given_body.note_of(inputs.geometry) is None:
        # its camera is the one that saw the body; its world is not the user's
        return read_camera(inputs.geometry / "camera.json", size), False
    if inputs.camera is None:
        from fluidlift.io.lens import lens_field_of_view

        fov = config.shape.fov or lens_field_of_view(inputs.clip) or USUAL_FIELD_OF_VIEW
        return PinholeCamera.from_fov(fov, size), False
    camera = read_camera(inputs.camera, size)
    data = read_json(inputs.camera, "camera file")
    return camera, "R" in data or "frames" in data


def level_of(level: tuple[str, str], inputs: Inputs) -> tuple[float, str]:
    """z of the plane that a surveyed camera stands over (`FluidKind.surveyed_level`), m, where a camera file says it;
    else 0, the ground of its world, and a warning.
    """
    from fluidlift.io.images import read_json

    name, what = level
    data = read_json(inputs.camera, "camera file") if inputs.camera is not None else {}
    value = data.get(name)
    if isinstance(value, int | float):
        return float(value), ""
    return 0.0, (
        f"the camera file does not say how high {what}: z = 0 is assumed, which sets the scale; "
        f"add {name} (m) to it, or give --size"
    )
