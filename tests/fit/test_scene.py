"""What a fit makes of its layouts: hidden cells on wider cells."""

import numpy as np
import pytest

from fluidlift.fit.coarsen import coarsen_seen, coarsen_velocity
from fluidlift.fit.optimize import FitOptions, fit_parameters
from fluidlift.synthetic.twins import make_twin
from fluidlift.types import FaceVelocity, Grid


def test_coarse_faces_take_the_seen_ones_alone():
    rng = np.random.default_rng(0)
    grid = Grid((8, 6, 10), 0.1)
    observed = rng.random(grid.shape) < 0.6
    uniform = FaceVelocity(*(np.full(grid.face_shape(a), 1.0 + a, np.float32) for a in range(3)))
    spoilt = []
    for axis, part in enumerate(uniform.components):
        wide = np.pad(observed, [(int(a == axis),) * 2 for a in range(3)])
        n = grid.shape[axis]
        seen = np.take(wide, range(n + 1), axis) | np.take(wide, range(1, n + 2), axis)
        spoilt.append(np.where(seen, part, 99.0).astype(np.float32))
    coarse, view = coarsen_seen(FaceVelocity(*spoilt), observed)
    assert view.any()
    for axis, part in enumerate(coarse.components):
        n = view.shape[axis]
        wide = np.pad(view, [(int(a == axis),) * 2 for a in range(3)])
        beside = np.take(wide, range(n + 1), axis) | np.take(wide, range(1, n + 2), axis)
        # sums of four in single precision
        np.testing.assert_allclose(part[beside], 1.0 + axis, rtol=1e-6)
    whole, every = coarsen_seen(uniform, np.ones(grid.shape, bool))
    assert every.all()
    np.testing.assert_array_equal(whole.u, coarsen_velocity(uniform).u)


@pytest.mark.parametrize("hidden", ["scattered", "one of every block"])
def test_hidden_cells_in_every_block_leave_a_fit_from_wide_cells_possible(hidden):
    twin = make_twin("river", seed=0, cells=(16, 8, 8), frames=6)
    rng = np.random.default_rng(0)
    seen = rng.random(twin.grid.shape) > 1 / 3 if hidden == "scattered" else np.ones(twin.grid.shape, bool)
    seen[::2, ::2, ::2] = False
    options = FitOptions(
        free=("inflow_velocity", "outflow_velocity"), windows=1, steps_per_frame=twin.steps_per_frame, coarse_first=500,
        start_rounds=1, workers=1,
    )  # fmt: skip
    result = fit_parameters(
        twin.frames, twin.cell_types, None, twin.grid, twin.interval, twin.truth, mainstream=twin.mainstream,
        observed=seen, settings=options,
    )  # fmt: skip
    assert not result.reason
    # the other parameters are the true ones, and velocities exact: what the fill of hidden cells leaves
    assert result.parameters.inflow_velocity[0] == pytest.approx(twin.truth.inflow_velocity[0], rel=0.02)


def test_a_fit_whose_wide_cells_were_not_seen_starts_on_its_own():
    twin = make_twin("river", seed=0, cells=(16, 8, 8), frames=6)
    # every other pair of layers along the flow: no block has more than half of its cells in sight, and its faces
    seen = np.zeros(twin.grid.shape, bool)
    seen[1::4] = True
    result = fit_parameters(
        twin.frames, twin.cell_types, None, twin.grid, twin.interval, twin.truth, mainstream=twin.mainstream,
        observed=seen, free=("inflow_velocity",), windows=1, steps_per_frame=twin.steps_per_frame, coarse_first=500,
        start_rounds=1,
    )  # fmt: skip
    assert not result.reason
