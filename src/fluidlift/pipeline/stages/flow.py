"""The stage that measures optical flow between neighbouring frames. It is written to disk frame by frame."""

from __future__ import annotations

import numpy as np

from fluidlift.backends.learned import FLOW_METHODS, ModelChoice, make_estimator
from fluidlift.pipeline.settings import FlowSettings, GivenFlow
from fluidlift.pipeline.work import Work
from fluidlift.seams import FlowEstimator
from fluidlift.types import PixelFlow
from fluidlift.types.stages import GIVEN, Flow, Read


def estimated_flow(read: Read, config: FlowSettings, *, work: Work) -> Flow:
    """Optical flow of every pair of frames.

    Raises:
        InputRejected: a learned method without its weights.
    """
    from fluidlift.motion.optical_flow import estimate_flow

    method, out = flow_method(config), _room(read, work)
    estimate_flow(read.clip.frames, method=method, progress=work.step, out=out)
    return Flow(PixelFlow(*out), config.method)


def given_flow(read: Read, given: GivenFlow, *, work: Work) -> Flow:
    """The user's flow, of the pairs of frames that are used.

    Raises:
        InputRejected: a flow of another shape, or too few pairs.
    """
    from fluidlift.pipeline.given_flow import flow_of_files

    displacement, confidence = out = _room(read, work)
    pairs, sure, warnings = flow_of_files(read, given)
    for t, pair in enumerate(pairs):
        displacement[t], confidence[t] = pair
        work.step(t + 1, len(displacement))
    return Flow(PixelFlow(*out), GIVEN, trusted_as_given=not sure, warnings=tuple(warnings))


def _room(read: Read, work: Work) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and confidence on disk, of zeros."""
    count, (width, height) = len(read.clip) - 1, read.clip.size
    # float16 ends at 65504, far beyond any picture
    displacement = work.scratch.array("displacement", (count, height, width, 2), np.float16)
    return displacement, work.scratch.array("confidence", (count, height, width), np.float16)


def flow_method(config: FlowSettings) -> str | FlowEstimator:
    """Name of a classical method, or a learned estimator with its weights."""
    if config.method in FLOW_METHODS:
        weights = None if config.weights is None else config.weights.name
        return make_estimator(config.method, ModelChoice(weights, config.device, config.download))
    return config.method
