"""Files of a finished asset for other tools."""

from fluidlift.export.asset import export_asset
from fluidlift.export.job import FORMATS, ExportRequest

__all__ = ["FORMATS", "ExportRequest", "export_asset"]
