"""Which way is up: what a picture says of it beside the fluid's motion, as log likelihoods of the camera's tilt."""

from fluidlift.shape.view.habit import ViewContext, habit_prior
from fluidlift.shape.view.horizon import Skyline, horizon_evidence, horizon_line, sky_of, tilt_of_horizon
from fluidlift.shape.view.learned import LearnedTilt
from fluidlift.shape.view.open_horizon import OpenHorizon, open_horizon
from fluidlift.shape.view.picture import MeasuredPlane, PictureEvidence, look_at
from fluidlift.shape.view.relief import as_relief
from fluidlift.shape.view.rims import drawn_rim, find_rims
from fluidlift.shape.view.roundness import Ellipse

__all__ = [
    "Ellipse", "LearnedTilt", "MeasuredPlane", "OpenHorizon", "PictureEvidence", "Skyline", "ViewContext", "as_relief",
    "drawn_rim", "find_rims", "habit_prior", "horizon_evidence", "horizon_line", "look_at", "open_horizon", "sky_of",
    "tilt_of_horizon",
]  # fmt: skip
