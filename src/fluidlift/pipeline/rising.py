"""The buoyancy of smoke: with it, the re-simulation rises as high as the clip's outline."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fluidlift.pipeline.fluid_masks import FluidMasks
from fluidlift.pipeline.machine import one_torch_thread
from fluidlift.types import Estimate, FaceVelocity, FluidParameters
from fluidlift.types.stages import Geometry, Read

PRECISE = 0.05
"""share of the value up to which it counts as determined, as in the fit of velocities"""


def outline_rises(masks: FluidMasks, start: int) -> bool:
    """Whether the outlines of a plume, from frame `start` of its masks on, tell its buoyancy."""
    from fluidlift.fit.buoyancy import course

    return course(lambda k: masks[start + k], len(masks) - start) is not None


def with_buoyancy(
    read: Read, masks: FluidMasks, geometry: Geometry, parameters: FluidParameters, estimates: dict[str, Estimate],
    velocity: FaceVelocity, step: Callable[[int, int], None],
) -> tuple[FluidParameters, dict[str, Estimate], dict[str, float]]:  # fmt: skip
    """Parameters and estimates of a plume with the buoyancy that its outlines tell, and figures for the report.

    Args:
        read: the clip.
        masks: of it.
        geometry: of the body.
        parameters: of it; the size of gravity is a first guess of the buoyancy.
        estimates: by label.
        velocity: of the whole box at the first instant, m/s.
        step: told (done, all).
    """
    from fluidlift.fit.buoyancy import RisingSmoke, buoyancy_from_rise

    setting, start = geometry.setting, geometry.rest_frame
    guess = float(np.linalg.norm(parameters.gravity))
    smoke = RisingSmoke(
        setting.terrain, setting.cell_types, velocity, parameters, geometry.camera, read.clip.interval,
        lambda k: masks[start + k], len(masks) - start,
    )  # fmt: skip
    with one_torch_thread():
        lift = buoyancy_from_rise(smoke, guess, step=step)
    if lift is None:
        return parameters, estimates, {}
    gravity = tuple(float(g) * lift.value / guess for g in parameters.gravity)
    found = dict(estimates)
    for axis, g in zip("xyz", gravity):
        if g != 0.0:
            sigma = lift.sigma * abs(g) / lift.value
            found[f"gravity_{axis}"] = replace(
                estimates[f"gravity_{axis}"], value=g, sigma=sigma, identifiable=sigma <= PRECISE * abs(g)
            )
    figures = {"buoyancy": lift.value, "rise_runs": float(lift.runs), "rise_frames": float(lift.frames)}
    return parameters.updated({"gravity": gravity}), found, figures
