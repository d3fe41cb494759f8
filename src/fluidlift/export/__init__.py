"""Files of a finished asset for other tools.

Modules of the face:

    asset       Files of a finished asset for other tools: meshes, splats, volumes, USD, glTF, a page, what the clip
                showed
    job         What an export is asked for, and what its writers share
    whitewater  White water for other tools: points with velocity and kind beside the meshes, and densities in the
                volumes
"""

from fluidlift.export.asset import export_asset
from fluidlift.export.job import FORMATS, ExportRequest

__all__ = [
    "FORMATS", "ExportRequest", "asset", "export_asset", "job", "whitewater",
]  # fmt: skip
