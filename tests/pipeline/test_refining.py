"""The body that is lifted: as many splats as are asked for, and inside as many as the simulation needs."""

from fluidlift.config import build_config
from fluidlift.pipeline import Inputs
from fluidlift.pipeline.refining import WHOLE, refine
from fluidlift.types import CellType


def body(story, most: int):
    config = build_config(overrides=["shape.refine_iterations=0", f"shape.max_gaussians={most}"])
    return refine(story, Inputs(clip="unused.mp4"), config).meta


def test_a_body_is_filled_inside_whatever_the_limit_of_its_splats(story):
    cells = int((story["geometry"].arrays["cell_types"] == CellType.FLUID).sum())
    free, tight = body(story, 1_000_000), body(story, 2_000)
    assert tight["front"] + tight["hull"] <= 2_000 < free["front"] + free["hull"]  # what is seen keeps to the limit
    assert tight["filled"] > 2_000  # and a body of so many would be empty inside
    assert tight["filled"] <= WHOLE * cells


def test_the_parts_of_a_body_add_up(story):
    counted = body(story, 1_000_000)
    assert counted["pruned"] >= 0  # none where splats are carried on beyond the picture
    assert counted["front"] - counted["pruned"] + counted["hull"] + counted["filled"] == counted["total"]
