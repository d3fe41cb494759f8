"""Differentiate a rollout: how the flow after n steps depends on gravity, viscosity and inflow.

    python examples/differentiate_rollout.py [CELLS]

A channel with an inlet and an outlet; the gradient is that of autograd, through advection, viscosity and pressure.
"""

import sys

import numpy as np
import torch

import fluidlift as fl

n = int(sys.argv[1]) if len(sys.argv) > 1 else 16
grid = fl.Grid(shape=(2 * n, n, n), spacing=1.0 / n)
cells = np.full(grid.shape, fl.CellType.FLUID, np.uint8)
cells[:, :, n // 2 :] = fl.CellType.EMPTY  # air: p = 0
cells[0, :, : n // 2], cells[-1, :, : n // 2] = fl.CellType.INFLOW, fl.CellType.OUTFLOW
cells[n - 2 : n + 2, n // 3 : n // 2, : n // 2] = fl.CellType.SOLID  # a pillar
domain = fl.prepare_domain(cells, fl.build_system(cells, None, grid), mainstream=np.array([1.0, 0, 0]))

p = fl.RolloutParameters.of(fl.FluidParameters(inflow_velocity=(0.5, 0, 0), outflow_velocity=0.5,
                                               kinematic_viscosity=1e-3, time_step=0.02))  # fmt: skip
wanted = [p.gravity, p.kinematic_viscosity, p.inflow_velocity]
for tensor in wanted:
    tensor.requires_grad_()

start = fl.FaceVelocity.zeros(grid)
result = fl.rollout(start, domain, p, steps=10)
energy = 0.5 * grid.spacing**3 * (result.velocity**2).sum()
gradients = torch.autograd.grad(energy, wanted)
print(f"after 10 steps: {energy.item():.4f} m^5/s^2 ({result.reports[-1].iterations} iterations of the last solve)")
for name, gradient in zip(("gravity", "kinematic viscosity", "inflow velocity"), gradients):
    print(f"  d energy / d {name}: {np.round(gradient.numpy(), 5)}")
