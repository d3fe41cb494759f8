"""The story: the only place that knows the order of the stages."""

from fluidlift.pipeline.make import STAGES, Made, make
from fluidlift.pipeline.seeing import Inputs
from fluidlift.pipeline.story import Progress, Silence

__all__ = ["STAGES", "Inputs", "Made", "Progress", "Silence", "make"]
