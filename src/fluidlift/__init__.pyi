"""The names of the public face, for type checkers and editors; `__init__.py` imports them when they are used."""

from fluidlift.config import build_config
from fluidlift.evaluate import evaluate_asset
from fluidlift.fit.optimize import FitOptions, fit_parameters
from fluidlift.io.asset_folder import load_asset, save_asset
from fluidlift.io.video import read_clip
from fluidlift.look.rasterize import render
from fluidlift.motion.lift import lift_flow
from fluidlift.motion.optical_flow import estimate_flow
from fluidlift.motion.volume import volume_velocity
from fluidlift.physics.apic import LiquidSimulator, SimulationSettings
from fluidlift.physics.gas import GasSimulator
from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import RolloutParameters, rollout
from fluidlift.physics.rollout_domain import prepare_domain
from fluidlift.pipeline import (
    EditSession,
    ExportRequest,
    Inputs,
    RenderRequest,
    SimulationRequest,
    export_asset,
    find_masks,
    make,
    measure_motion,
    refit,
    render_asset,
    resimulate,
)
from fluidlift.types import (
    CellType,
    FaceVelocity,
    FluidAsset,
    FluidParameters,
    Gaussians,
    Grid,
    Particles,
    PinholeCamera,
    Terrain,
    TriangleMesh,
)
from fluidlift.validate import validate_asset

__version__: str

__all__ = [
    "CellType",
    "EditSession",
    "ExportRequest",
    "FaceVelocity",
    "FitOptions",
    "FluidAsset",
    "FluidParameters",
    "GasSimulator",
    "Gaussians",
    "Grid",
    "Inputs",
    "LiquidSimulator",
    "Particles",
    "PinholeCamera",
    "RenderRequest",
    "RolloutParameters",
    "SimulationRequest",
    "SimulationSettings",
    "Terrain",
    "TriangleMesh",
    "__version__",
    "build_config",
    "build_system",
    "estimate_flow",
    "evaluate_asset",
    "export_asset",
    "find_masks",
    "fit_parameters",
    "lift_flow",
    "load_asset",
    "make",
    "measure_motion",
    "prepare_domain",
    "read_clip",
    "refit",
    "render",
    "render_asset",
    "resimulate",
    "rollout",
    "save_asset",
    "validate_asset",
    "volume_velocity",
]
