"""The liquid example of PhiFlow (FLIP) in three dimensions; prints one line of JSON. Needs `pip install phiflow jax`.

    python benchmarks/peers/phiflow_flip.py '{"cells": [32, 32, 32], "block": [12, 10, 12], "frames": 3, "steps": 4}'

As in PhiFlow's own example (particles to a staggered grid, pressure by conjugate gradients on the occupied cells, FLIP
update, fourth-order advection, particles pushed into the box), without an obstacle, compiled by JAX, one z axis more.
"steps" of equal length per frame, since the example has no adaptive step. "backend": jax, torch or numpy.
"""

from __future__ import annotations

import importlib
import json
import resource
import sys
import time
from typing import Any

import numpy as np


def block_of_particles(block: list[int], spacing: float) -> np.ndarray:
    """Eight particles per cell, slightly jittered, cell by cell in the order of the grid."""
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in block), indexing="ij"), axis=-1).reshape(-1, 1, 3)
    corners = np.stack(np.meshgrid(*([[0.25, 0.75]] * 3), indexing="ij"), axis=-1).reshape(1, 8, 3)
    jitter = np.random.default_rng(0).uniform(-0.1, 0.1, (len(cells), 8, 3))
    return ((cells + corners + jitter) * spacing).reshape(-1, 3).astype(np.float32)


def measure(scene: dict[str, Any]) -> dict[str, Any]:
    """Wall time of frames of 1/24 s after the first few."""
    backend = scene.get("backend", "jax")
    flow = importlib.import_module("phi.flow" if backend == "numpy" else f"phi.{backend}.flow")
    math, field, fluid, advect = flow.math, flow.field, flow.fluid, flow.advect
    n, h = dict(zip("xyz", scene["cells"])), scene["spacing"]
    domain = flow.Box(**{axis: count * h for axis, count in n.items()})
    gravity = flow.vec(x=0, y=0, z=-9.81)
    steps = scene["steps"]
    dt = 1 / 24 / steps
    solver = flow.Solve(scene.get("method", "auto"), scene.get("tolerance", 1e-5), 0, max_iterations=1000)

    def step(points, velocities):  # plain tensors: compiled by JAX, a point cloud does not come back
        particles = flow.PointCloud(flow.Sphere(points, radius=0.5 * h), velocities, math.NAN)
        grid_v = before = field.finite_fill(
            particles.at(flow.StaggeredGrid(0, 0, domain, **n), scatter=True, outside_handling="clamp")
        )
        cells = flow.CenteredGrid(0, grid_v.extrapolation.spatial_gradient(), grid_v.bounds, grid_v.resolution)
        occupied = flow.resample(field.mask(particles), cells, scatter=True, outside_handling="clamp")
        grid_v, _ = fluid.make_incompressible(grid_v + gravity * dt, [], solver, active=occupied)
        particles += flow.resample(grid_v - before, to=particles)
        particles = advect.points(particles, grid_v, dt, advect.finite_rk4)
        particles = fluid.boundary_push(particles, [~domain], separation=0.5 * h)
        return particles.geometry.center, particles.values

    step = step if backend == "numpy" else flow.jit_compile(step)
    positions = block_of_particles(scene["block"], h)
    points = math.tensor(positions, math.instance("points"), math.channel(vector="x,y,z"))
    points, velocities = points + math.zeros(points.shape), math.zeros(points.shape)
    times = []
    for number in range(scene["warm"] + scene["frames"]):
        if number == scene["warm"]:
            busy = time.process_time()
        began = time.perf_counter()
        for _ in range(steps):
            points, velocities = step(points, velocities)
        places = np.asarray(points.numpy("points,vector"))  # waits for the result
        times.append(time.perf_counter() - began)
    busy = time.process_time() - busy
    kept = times[scene["warm"] :]
    return {
        "ms_frame": 1e3 * sum(kept) / len(kept), "ms_step": 1e3 * sum(kept) / len(kept) / steps,
        "cpu_ms_step": 1e3 * busy / len(kept) / steps,
        "steps_per_frame": steps, "particles": len(positions), "first_frame_s": times[0],
        "front": float(np.percentile(places[:, 0], 99)), "mean_height": float(places[:, 2].mean(dtype=np.float64)),
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "variant": f"{backend}, {scene.get('method', 'auto')} to {scene.get('tolerance', 1e-5):g}",
        "version": importlib.import_module("phi").__version__,
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(measure(json.loads(sys.argv[1]))))
