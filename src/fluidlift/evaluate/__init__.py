"""How close an asset came to a known truth: the figures of one case."""

from fluidlift.evaluate.case import Case, read_case
from fluidlift.evaluate.report import Evaluation, Figure
from fluidlift.evaluate.score import evaluate_arrays, evaluate_asset

__all__ = ["Case", "Evaluation", "Figure", "evaluate_arrays", "evaluate_asset", "read_case"]
