"""What a job can be told: typed sections, presets, YAML files and single overrides.

Modules of the face:

    of_asset  The settings that an asset was made with
"""

from fluidlift.config.build import build_config
from fluidlift.config.presets import PRESETS, RANGES
from fluidlift.config.sections import (
    DepthConfig,
    FitConfig,
    GenerateConfig,
    JobConfig,
    MotionConfig,
    ReadConfig,
    SegmentConfig,
    ShapeConfig,
    ShowConfig,
    SimulateConfig,
    ViewConfig,
)

__all__ = [
    "PRESETS", "RANGES", "DepthConfig", "FitConfig", "GenerateConfig", "JobConfig", "MotionConfig",
    "ReadConfig", "SegmentConfig", "ShapeConfig", "ShowConfig", "SimulateConfig", "ViewConfig", "build_config",
    "of_asset",
]  # fmt: skip
