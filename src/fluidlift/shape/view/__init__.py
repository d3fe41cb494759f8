"""Which way is up: what a picture says of it beside the fluid's motion, as log likelihoods of the camera's tilt."""

from fluidlift.shape.view.habit import USUAL_PITCH
from fluidlift.shape.view.picture import PictureEvidence, look_at

__all__ = ["USUAL_PITCH", "PictureEvidence", "look_at"]
