"""Which way through the pressure a fit takes, from the word of a setting; the paper's is fitted to the flow first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from fluidlift.errors import require
from fluidlift.fit.coarsen import coarsen_cells, coarsen_terrain, coarsen_velocity
from fluidlift.fit.inlet import boundary_prior
from fluidlift.fit.scene import build_scene, plan_windows
from fluidlift.fit.settings import FitOptions
from fluidlift.physics.rollout import RolloutParameters, flatten, rollout
from fluidlift.physics.rollout_pressure import RolloutOptions, recurrent_options
from fluidlift.types import FaceVelocity, FluidKind, FluidParameters, Terrain

WAYS = ("implicit", "jacobi", "recurrent")
"""of `with_route`"""
SAMPLED = 4
"""steps from the first target whose pressures the convolution learns from, every other one, and is validated on"""
MOST_CELLS = 20_000
"""of a layout that is fitted so: a hundred sub-steps over its box cost ten times the solver's work; a fit by Adam on
54 000 cells took more than ten minutes, on an eighth of them 41 s"""
LEARNT = 30
"""iterations of its fit, on two pressures of the flow and one of rough data"""


def with_route(
    options: FitOptions,
    way: str,
    gradient: str,
    targets: Sequence[FaceVelocity],
    cell_types: np.ndarray,
    terrain: Terrain,
    initial: FluidParameters,
    flow: tuple[float, str | FluidKind],
) -> tuple[FitOptions, tuple[str, ...]]:
    """Options whose rollouts take one way through the pressure, and what is to be said of it.

    For "recurrent" (paper: PeRCNN) the flow is rolled out with the implicit solver, a convolution is fitted to its
    pressures and validated on others; where it does not pass, the solver stays. It serves the layout that it was
    fitted on alone, so the fit stays on one: of more than `MOST_CELLS` cells, on one of cells twice as wide.

    Args:
        options: of the fit.
        way: one of `WAYS`.
        gradient: of advection, one of `physics.rollout_pressure.ADVECTION_GRADIENTS`.
        targets: velocities of consecutive frames, m/s.
        cell_types: u8 [nx,ny,nz], of all frames.
        terrain: the ground; its grid is that of the targets.
        initial: parameters of the sampled rollout.
        flow: s between targets, and the kind of the fluid.

    Raises:
        ValueError: another word for the way.
    """
    require(way in WAYS, f"way '{way}' through the pressure", " or ".join(WAYS))
    rolled = RolloutOptions("jacobi" if way == "jacobi" else "implicit", advection_gradient=gradient)
    if way != "recurrent":
        return replace(options, options=rolled), ()
    interval, kind = flow
    most = min(options.most_cells, MOST_CELLS)
    while terrain.grid.cells > most:  # as the fit will do
        targets = [coarsen_velocity(t) for t in targets]
        cell_types, terrain = coarsen_cells(cell_types), coarsen_terrain(terrain)
    scene = build_scene(
        targets, [cell_types] * len(targets), terrain, terrain.grid, kind=kind, mainstream=terrain.mainstream
    )
    start = boundary_prior(scene, initial)
    plan = plan_windows(scene, interval, windows=1, fall=float(np.linalg.norm(start.gravity)))
    known = RolloutParameters.of(replace(start, time_step=interval / plan.steps_per_frame))
    now, domain, potentials = flatten(targets[0]), scene.domains[0], []
    with torch.no_grad():
        for _ in range(SAMPLED):
            made = rollout(now, domain, known, steps=1)
            now = made.velocity
            potentials += made.potentials
    found, validation = recurrent_options([domain] * len(potentials), potentials, rolled, iterations=LEARNT)
    ours, jacobi = validation.errors.max(), validation.jacobi_errors.max()
    errors = f"relative error {ours:.1g} on unseen ones, {jacobi:.1g} by as many sweeps of Jacobi"
    note = f"pressure by a convolution that was fitted to this flow ({errors})"
    if not validation.accepted:
        return replace(options, options=found), (f"pressure solved: {validation.advice}",)
    return replace(options, options=found, most_cells=most, coarse_first=most), (note,)
