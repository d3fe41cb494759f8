"""A dam break in the liquid simulator (affine particle-in-cell, APIC): no clip, no asset.

    python examples/dam_break.py [CELLS]

A column of water, twice as high as wide, falls in a closed tank; a line per 0.05 s says how far its front is.
"""

import sys

import numpy as np

import fluidlift as fl

width, cells = 0.1, int(sys.argv[1]) if len(sys.argv) > 1 else 16  # m, and cells across the column
h = width / cells
grid = fl.Grid(shape=(5 * cells, 4, 3 * cells), spacing=h)
nothing = fl.TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))  # the sides of the box are walls by themselves
terrain = fl.Terrain(grid, np.full([n + 1 for n in grid.shape], 1.0, np.float32), np.array([1.0, 0, 0]), nothing)

axes = [np.arange(0.25 * h, length, 0.5 * h) for length in (width, 4 * h, 2 * width)]  # 8 particles per cell
points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
water = fl.FluidParameters(density=1000.0, kinematic_viscosity=1e-6, gravity=(0, 0, -9.81), time_step=0.01)
particles = fl.Particles.at_rest(points, masses=1000.0 * h**3 / 8)
no_inlet = np.zeros(grid.shape, np.uint8)

simulator = fl.LiquidSimulator(grid, terrain, water, particles, cell_types=no_inlet)
for _ in range(4):
    report = simulator.advance(0.05)
    front = np.percentile(simulator.particles.positions[:, 0], 99.8)  # of the tongue, not of single drops
    worst = max(solve.residual for solve in report.pressure)
    print(f"t = {simulator.time:.2f} s: front at {front:.3f} m, {report.substeps} steps, residual {worst:.0e}")
