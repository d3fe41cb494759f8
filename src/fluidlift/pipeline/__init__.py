"""The only place that knows the order of the stages, and the commands that run them."""

from fluidlift.pipeline.as_filmed import card_of
from fluidlift.pipeline.editing import EditSession
from fluidlift.pipeline.exporting import ExportRequest, export_asset
from fluidlift.pipeline.hints import Hints
from fluidlift.pipeline.inputs import Inputs
from fluidlift.pipeline.make import STAGES, make
from fluidlift.pipeline.mask_files import find_masks
from fluidlift.pipeline.motion_files import MotionFiles, measure_motion
from fluidlift.pipeline.other_footage import card_against
from fluidlift.pipeline.refit import Refitted, refit
from fluidlift.pipeline.rendering import RenderRequest, render_asset
from fluidlift.pipeline.resimulate import Made, resimulate
from fluidlift.pipeline.scene import SimulationRequest, edited_scene
from fluidlift.pipeline.simulator import simulator_of
from fluidlift.pipeline.work import Progress, Silence

__all__ = [
    "STAGES",
    "EditSession",
    "ExportRequest",
    "Hints",
    "Inputs",
    "Made",
    "MotionFiles",
    "Progress",
    "Refitted",
    "RenderRequest",
    "Silence",
    "SimulationRequest",
    "card_against",
    "card_of",
    "edited_scene",
    "export_asset",
    "find_masks",
    "make",
    "measure_motion",
    "refit",
    "render_asset",
    "resimulate",
    "simulator_of",
]
