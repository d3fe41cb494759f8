"""The only place that knows the order of the stages, and the commands that run them."""

from fluidlift.pipeline.compare import card_against
from fluidlift.pipeline.hints import Hints
from fluidlift.pipeline.inputs import Inputs
from fluidlift.pipeline.make import STAGES, make
from fluidlift.pipeline.mask_files import find_masks
from fluidlift.pipeline.motion_files import MotionFiles, measure_motion
from fluidlift.pipeline.refit import Refitted, refit
from fluidlift.pipeline.render import RenderRequest, render_asset
from fluidlift.pipeline.resimulate import Made, resimulate
from fluidlift.present.as_filmed import card_of

__all__ = [
    "STAGES",
    "Hints",
    "Inputs",
    "Made",
    "MotionFiles",
    "Refitted",
    "RenderRequest",
    "card_against",
    "card_of",
    "find_masks",
    "make",
    "measure_motion",
    "refit",
    "render_asset",
    "resimulate",
]
