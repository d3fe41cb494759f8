"""Which way is up: what a picture says of it beside the fluid's motion, as log likelihoods of the camera's tilt."""

from fluidlift.shape.view.habit import Scene, habit_prior
from fluidlift.shape.view.picture import PictureEvidence, look_at
from fluidlift.shape.view.relief import as_relief

__all__ = ["PictureEvidence", "Scene", "as_relief", "habit_prior", "look_at"]
