"""The body that is lifted: as many splats as are asked for, and inside as many as the simulation needs."""

import pytest

from fluidlift.config import build_config
from fluidlift.io.stage_cache import load_stage
from fluidlift.pipeline import STAGES, Inputs, Silence
from fluidlift.pipeline.refining import WHOLE, refine
from fluidlift.pipeline.story import Result, Story
from fluidlift.types import CellType


@pytest.fixture(scope="module")
def story(made):
    story = Story(made.folder, STAGES, progress=Silence())
    for name in ("read", "flow", "segment", "geometry"):
        (facts,) = (made.folder / "work" / name).glob("*.json")
        story.results[name] = Result(*load_stage(made.folder, name, facts.stem))
    return story


def body(story, most: int):
    config = build_config(overrides=["shape.refine_iterations=0", f"shape.max_gaussians={most}"])
    return refine(story, Inputs(clip="unused.mp4"), config).meta


def test_a_body_is_filled_inside_whatever_the_limit_of_its_splats(story):
    cells = int((story["geometry"].arrays["cell_types"] == CellType.FLUID).sum())
    free, tight = body(story, 1_000_000), body(story, 2_000)
    assert tight["front"] + tight["hull"] <= 2_000 < free["front"] + free["hull"]  # what is seen keeps to the limit
    assert tight["filled"] > 2_000  # and a body of so many would be empty inside
    assert tight["filled"] <= WHOLE * cells
