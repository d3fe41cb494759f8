"""The body that is lifted: as many splats as are asked for, and inside as many as the simulation needs."""

from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.pipeline.settings import RefineSettings, taken
from fluidlift.pipeline.stages.refine import WHOLE, _not_contradicted, refine
from fluidlift.pipeline.work import Work
from fluidlift.types import CellType, Gaussians, PinholeCamera


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


def test_water_behind_a_near_shore_stays_in_a_basin():
    """Below a level surface, seen over the ground of the shore before it: no contradiction to the picture."""
    camera = PinholeCamera.looking((0.0, -3.0, 1.0), (0.0, 0.0, 0.0), 50.0, (96, 64))
    deep, top = np.array([[0.0, 0.2, -0.8]]), np.array([[0.0, 0.6, -0.02]])
    allowed = np.zeros((64, 96), bool)
    row, col, _ = camera.nearest_pixels(np.concatenate([deep, top, [[0.0, -1.35, -0.02]]]))
    allowed[: row[0] - 2] = True
    assert allowed[row[1], col[1]] and not allowed[row[0], col[0]] and not allowed[row[2], col[2]]
    body = Gaussians.isotropic(np.concatenate([deep, top, [[0.0, -1.35, -0.02]]]), 0.05, np.full((3, 3), 0.5), 0.8)
    terrain = SimpleNamespace(grid=SimpleNamespace(spacing=0.1))
    kept = {}
    for kind in ("basin", "stream"):
        seen = SimpleNamespace(
            kind=kind, camera=camera, setting=SimpleNamespace(surface_height=np.zeros((2, 2)), terrain=terrain)
        )
        kept[kind] = np.sort(_not_contradicted(body, seen, allowed).means[:, 1])  # type: ignore[arg-type]
    np.testing.assert_allclose(kept["basin"], [0.2, 0.6], atol=1e-6)
    np.testing.assert_allclose(kept["stream"], [0.6], atol=1e-6)
