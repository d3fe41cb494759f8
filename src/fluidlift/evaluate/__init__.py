"""How close an asset came to a known truth: the figures of one case.

Modules of the face:

    as_filmed  How near a re-simulation stays to its own clip, without a truth: figures, their floors, a verdict and
               advice
"""

from fluidlift.evaluate.case import Case, read_case
from fluidlift.evaluate.of_run import arrays_of_run
from fluidlift.evaluate.report import Evaluation, Metric
from fluidlift.evaluate.score import evaluate_arrays, evaluate_asset

__all__ = [
    "Case", "Evaluation", "Metric", "arrays_of_run", "as_filmed", "evaluate_arrays", "evaluate_asset", "read_case",
]  # fmt: skip
