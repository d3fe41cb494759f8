"""The buoyancy of smoke: with it, the re-simulation rises as high as the clip's outline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fluidlift.pipeline.body import camera_of, setting_of
from fluidlift.pipeline.reading import clip_of
from fluidlift.pipeline.seeing import masks_of
from fluidlift.pipeline.story import Story, one_torch_thread
from fluidlift.types import Estimate, FaceVelocity, FluidParameters

PRECISE = 0.05
"""share of the value up to which it counts as determined, as in the fit of velocities"""


def outline_rises(story: Story) -> bool:
    """Whether the outlines of a plume tell its buoyancy."""
    from fluidlift.fit.buoyancy import course

    masks, start = masks_of(story), int(story["geometry"].meta["rest_frame"])
    return course(lambda k: masks[start + k], len(masks) - start) is not None


def with_buoyancy(
    story: Story, parameters: FluidParameters, estimates: dict[str, Estimate], velocity: FaceVelocity
) -> tuple[FluidParameters, dict[str, Estimate], dict[str, float]]:
    """Parameters and estimates of a plume with the buoyancy that its outlines tell, and figures for the report.

    Args:
        story: up to its motion.
        parameters: of it; the size of gravity is a first guess of the buoyancy.
        estimates: by label.
        velocity: of the whole box at the first instant, m/s.
    """
    from fluidlift.fit.buoyancy import RisingSmoke, buoyancy_from_rise

    setting, masks, start = setting_of(story), masks_of(story), int(story["geometry"].meta["rest_frame"])
    guess = float(np.linalg.norm(parameters.gravity))
    smoke = RisingSmoke(
        setting.terrain, setting.cell_types, velocity, parameters, camera_of(story), clip_of(story).interval,
        lambda k: masks[start + k], len(masks) - start,
    )  # fmt: skip
    with one_torch_thread():
        lift = buoyancy_from_rise(smoke, guess, step=story.step)
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
