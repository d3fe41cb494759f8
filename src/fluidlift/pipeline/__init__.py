"""The only place that knows the order of the stages, and the commands that run them.

Modules of the face:

    find        What is found of a clip before anything is made of it: mask, kind, tilt, flow, scale, for a person
                to correct
    hints       What a person says about where the fluid is, on the command line or in a hints file
    make        From a clip to an asset folder
    models      Learned models by name: which of the user's cache a job takes (`--models`), and which one a job has
                used
    preview     Simulation while somebody edits: a coarse copy of the scene, frame by frame, the newest wish first
    refit       The parameters of a finished asset, fitted again: `fluidlift fit`
    render      Pictures of a finished asset from any camera: a film, numbered PNG with transparency, or numbered
                EXR with depth
    resimulate  The second half, which `make` and `sim` share: an asset at rest becomes frames, pictures and USD
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fluidlift.pipeline.compare import card_against
    from fluidlift.pipeline.hints import MaskHints
    from fluidlift.pipeline.inputs import Inputs
    from fluidlift.pipeline.make import STAGES, make
    from fluidlift.pipeline.mask_files import find_masks
    from fluidlift.pipeline.motion_files import MotionFiles, measure_motion
    from fluidlift.pipeline.refit import Refitted, refit
    from fluidlift.pipeline.render import RenderRequest, render_asset
    from fluidlift.pipeline.resimulate import Made, resimulate
    from fluidlift.present.as_filmed import card_of

_FROM = {
    "card_against": "pipeline.compare", "MaskHints": "pipeline.hints", "Inputs": "pipeline.inputs",
    "STAGES": "pipeline.make", "make": "pipeline.make", "find_masks": "pipeline.mask_files",
    "MotionFiles": "pipeline.motion_files", "measure_motion": "pipeline.motion_files", "Refitted": "pipeline.refit",
    "refit": "pipeline.refit", "RenderRequest": "pipeline.render", "render_asset": "pipeline.render",
    "Made": "pipeline.resimulate", "resimulate": "pipeline.resimulate", "card_of": "present.as_filmed",
}  # fmt: skip
"""modules of the names of the face: each is imported when it is first used, since a picture needs no simulator, and
neither that nor torch is read for it"""


class _Face(ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name not in _FROM:
            raise AttributeError(f"module '{self.__name__}' has no attribute '{name}'")
        found = getattr(import_module(f"fluidlift.{_FROM[name]}"), name)
        super().__setattr__(name, found)
        return found

    def __setattr__(self, name: str, value: Any) -> None:
        # a module that is called as a function of the face does not take its place
        if not (name in _FROM and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Face

__all__ = [
    "STAGES",
    "Inputs",
    "Made",
    "MaskHints",
    "MotionFiles",
    "Refitted",
    "RenderRequest",
    "card_against",
    "card_of",
    "find",
    "find_masks",
    "hints",
    "make",
    "measure_motion",
    "models",
    "preview",
    "refit",
    "render",
    "render_asset",
    "resimulate",
]  # fmt: skip
