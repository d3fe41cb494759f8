"""The body that is lifted: as many splats as are asked for, and inside as many as the simulation needs."""

import pytest

from fluidlift.config import build_config
from fluidlift.pipeline.settings import RefineSettings, taken
from fluidlift.pipeline.stages.refine import WHOLE, refine
from fluidlift.pipeline.work import Work
from fluidlift.types import CellType


@pytest.fixture
def body(finished, tmp_path):
    """The body of the small clip with so many splats at most."""

    def make(most: int):
        lift = finished.lift
        config = build_config(overrides=["shape.refine_iterations=0", f"shape.max_gaussians={most}"])
        settings = taken(RefineSettings, config.shape, seed=config.seed)
        seen = lift.read, lift.flow, lift.segmentation, lift.geometry
        return refine(*seen, None, settings, work=Work.alone(tmp_path))

    return make


def test_a_body_is_filled_inside_whatever_the_limit_of_its_splats(finished, body):
    cells = int((finished.lift.geometry.setting.cell_types == CellType.FLUID).sum())
    free, tight = body(1_000_000), body(2_000)
    assert tight.front + tight.hull <= 2_000 < free.front + free.hull  # what is seen keeps to the limit
    assert tight.filled > 2_000  # and a body of so many would be empty inside
    assert tight.filled <= WHOLE * cells


def test_the_parts_of_a_body_add_up(body):
    counted = body(1_000_000)
    assert counted.pruned >= 0  # none where splats are carried on beyond the picture
    assert counted.front - counted.pruned + counted.hull + counted.filled == len(counted.body)
