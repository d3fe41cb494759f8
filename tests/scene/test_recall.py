"""What an asset was made from, as it is found again."""

import numpy as np
import pytest

from fluidlift.io.kept_values import recalled
from fluidlift.pipeline.runner import Runner
from fluidlift.pipeline.stages.correct import correct, nothing_found
from fluidlift.seams import Silence
from fluidlift.types import Label, PixelFlow, VideoClip
from fluidlift.types.hints import Region
from fluidlift.types.stages import Flow, Read


@pytest.mark.parametrize("corrected", [True, False])
def test_labels_are_those_that_a_person_corrected(tmp_path, corrected):
    clip = VideoClip(np.zeros((2, 24, 32, 3), np.uint8), 0.1 * np.arange(2), "made")
    flow = Flow(PixelFlow(np.zeros((1, 24, 32, 2), np.float16), np.ones((1, 24, 32), np.float16)), "dis")
    read = Read(clip, np.arange(2), 2, 0.0, False)
    runner = Runner(tmp_path / "x.fluid", ("segment", "correct"), progress=Silence())
    found = runner.run("segment", nothing_found, read)
    if corrected:
        region = Region("fluid", ((4.0, 4.0), (20.0, 4.0), (20.0, 20.0)))
        runner.run("correct", correct, read, flow, found, (region,))
    again = recalled(tmp_path / "x.fluid", {"provenance": {"stages": dict(runner.keys)}}, "segment")
    assert again is not None and (again.labels.labels == Label.FLUID).any() == corrected
