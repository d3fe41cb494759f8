"""The way through the pressure by a word: the paper's convolution is fitted to the flow at hand, and serves its fit."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fluidlift.fit import pressure_route
from fluidlift.fit.coarsen import coarse_grid
from fluidlift.fit.pressure_route import with_route
from fluidlift.fit.settings import FitOptions
from fluidlift.numerics.isosurface import surface_nets
from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import RolloutParameters, flatten, rollout, unflatten
from fluidlift.physics.rollout_domain import prepare_domain
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Terrain, TriangleMesh

GRID, INTERVAL = Grid((14, 8, 6), 0.1), 0.04
DOWNSTREAM = np.array([1.0, 0.0, 0.0])
TRUTH = FluidParameters(
    kinematic_viscosity=5e-3, inflow_velocity=(1.0, 0.0, 0.0), outflow_velocity=1.0, wall_damping=0.2, time_step=0.04
)
WRONG = replace(TRUTH, inflow_velocity=(0.5, 0.0, 0.0), outflow_velocity=0.5)


def stream() -> tuple[list[FaceVelocity], np.ndarray, Terrain]:
    """A short channel that speeds up over six frames."""
    types = np.full(GRID.shape, CellType.EMPTY, np.uint8)
    types[:, :, :4] = CellType.FLUID
    types[:, :, 0] = types[:, 0] = types[:, -1] = CellType.SOLID
    types[0, 1:-1, 1:4], types[-1, 1:-1, 1:4] = CellType.INFLOW, CellType.OUTFLOW
    nodes = GRID.nodes()
    distance = np.minimum(nodes[..., 2] - 0.1, 0.3 - np.abs(nodes[..., 1] - 0.4)).astype(np.float32)
    vertices, faces = surface_nets(distance, spacing=GRID.spacing, origin=GRID.origin, close=False)
    terrain = Terrain(GRID, distance, DOWNSTREAM, TriangleMesh(vertices.astype(np.float32), faces.astype(np.int64)))
    domain = prepare_domain(types, build_system(types, terrain, GRID), mainstream=DOWNSTREAM, sweeps=5)
    still = FaceVelocity.zeros(GRID)
    still.u[:] = 0.3
    flat, frames = flatten(still), []
    for _ in range(6):
        flat = rollout(flat, domain, RolloutParameters.of(TRUTH), steps=1).velocity.detach()
        frames.append(FaceVelocity(*(c.numpy().copy() for c in unflatten(flat, domain))))
    return frames, types, terrain


def chosen(way: str) -> tuple[FitOptions, tuple[str, ...]]:
    frames, types, terrain = stream()
    return with_route(FitOptions(), way, "upwind", frames, types, terrain, WRONG, (INTERVAL, "stream"))


@pytest.mark.parametrize("way", ["implicit", "jacobi"])
def test_other_ways_are_taken_as_they_are(way):
    options, notes = chosen(way)
    assert options.options is not None and not notes
    assert (options.options.projection, options.options.advection_gradient) == (way, "upwind")


def test_the_convolution_is_fitted_to_the_flow_and_takes_it_where_the_solver_does():
    options, notes = chosen("recurrent")
    assert options.options is not None and options.options.projection == "recurrent"
    assert options.options.advection_gradient == "upwind"
    assert options.most_cells == options.coarse_first >= GRID.cells, "on this layout and no other"
    assert "convolution" in notes[0]
    frames, types, terrain = stream()
    domain = prepare_domain(types, build_system(types, terrain, GRID), mainstream=DOWNSTREAM, sweeps=5)

    def ahead(route: RolloutOptions | None) -> torch.Tensor:
        known = RolloutParameters.of(replace(WRONG, time_step=INTERVAL))
        return rollout(frames[2], domain, known, steps=4, options=route).velocity.detach()[domain.dynamic]

    solved, learnt = ahead(RolloutOptions(tolerance=1e-7)), ahead(options.options)
    # the fitted sub-steps leave 1e-6 of the pressure; single precision leaves as much of the velocity
    assert float((learnt - solved).norm() / solved.norm()) < 1e-4
    swept = ahead(RolloutOptions("jacobi", sweeps=options.options.sweeps))
    assert (learnt - solved).norm() < 0.1 * (swept - solved).norm()


def test_of_a_layout_of_many_cells_it_is_learnt_on_wider_ones_as_the_fit_takes_them(monkeypatch):
    seen = []

    def learnt(domains, potentials, options, **_):
        seen.extend(d.shape for d in domains)
        passed = SimpleNamespace(errors=np.zeros(1), jacobi_errors=np.ones(1), accepted=True)
        return options, passed

    monkeypatch.setattr(pressure_route, "MOST_CELLS", GRID.cells - 1)
    monkeypatch.setattr(pressure_route, "recurrent_options", learnt)
    options, _ = chosen("recurrent")
    assert set(seen) == {coarse_grid(GRID).shape}
    assert options.most_cells == options.coarse_first == GRID.cells - 1


def test_another_word_is_refused():
    with pytest.raises(ValueError, match="way"):
        chosen("multigrid")
