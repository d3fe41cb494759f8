"""The story: the only place that knows the order of the stages."""

from fluidlift.pipeline.make import STAGES, make
from fluidlift.pipeline.refit import Refitted, refit
from fluidlift.pipeline.resimulate import Made, resimulate
from fluidlift.pipeline.scene import SimulationRequest
from fluidlift.pipeline.seeing import Inputs
from fluidlift.pipeline.story import Progress, Silence

__all__ = [
    "STAGES",
    "Inputs",
    "Made",
    "Progress",
    "Refitted",
    "Silence",
    "SimulationRequest",
    "make",
    "refit",
    "resimulate",
]
