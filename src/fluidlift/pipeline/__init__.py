"""The only place that knows the order of the stages, and the commands that run them.

Modules of the face:

    find     What is found of a clip before anything is made of it: mask, kind, tilt, flow, scale, for a person to
             correct
    preview  Simulation while somebody edits: a coarse copy of the scene, frame by frame, the newest wish first
    render   Pictures of a finished asset from any camera: a film, numbered PNG with transparency, or numbered EXR
             with depth
"""

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
    "find",
    "find_masks",
    "make",
    "measure_motion",
    "preview",
    "refit",
    "render",
    "render_asset",
    "resimulate",
]  # fmt: skip
