"""Gradient of a rollout through PhiFlow and torch; prints one line of JSON. Needs `pip install phiflow torch`.

    python benchmarks/peers/phiflow_rollout.py '{"cells": 32, "steps": 10, "threads": 1, "repeats": 3}'

The scene of `benchmarks/rollout_gradient.py`: a box with a pillar, inflow, outflow, air above. Semi-Lagrangian
advection, body force, explicit diffusion, pressure by conjugate gradients, whose gradient is PhiFlow's implicit one.
The box ends at the surface, where it is open (p = 0): the cells of air above cost PhiFlow nothing.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any


def reset_peak() -> float:
    """Lets the high-water mark of the memory begin anew; returns MB in use."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return peak("VmRSS:")


def peak(name: str = "VmHWM:") -> float:
    """MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith(name)) / 1024


def measure(scene: dict[str, Any]) -> dict[str, Any]:
    """Medians are left to the caller: times of every repeat after the first."""
    torch = importlib.import_module("torch")
    torch.set_num_threads(scene["threads"])
    flow = importlib.import_module("phi.torch.flow")
    math, fluid, advect, diffuse = flow.math, flow.fluid, flow.advect, flow.diffuse
    math.set_global_precision(scene.get("precision", 32))
    n, steps = scene["cells"], 1 if scene["repeats"] else scene["steps"]
    h, dt = 1.0 / n, 0.5 / n
    depth = n - n // 4
    box = flow.Box(x=1, y=1, z=depth * h)
    c, r = n // 2 * h, n // 12 * h
    pillar = flow.Obstacle(flow.Box(x=(c - r, c + r), y=(c - r, c + r), z=(0, n // 2 * h)))
    solver = flow.Solve("CG", scene.get("tolerance", 1e-5), 0, max_iterations=2000)

    def loss_of(gravity: Any, viscosity: Any, inflow: Any) -> Any:
        vector = flow.channel(vector="x,y,z")
        pull, speed = math.wrap(gravity, vector), math.wrap(inflow, vector)
        nu = math.wrap(viscosity)
        sides = {"x-": speed, "x+": flow.ZERO_GRADIENT, "y": 0, "z-": 0, "z+": flow.ZERO_GRADIENT}
        velocity = flow.StaggeredGrid((1, 0, 0), flow.extrapolation.combine_sides(**sides), box, x=n, y=n, z=depth)
        for _ in range(steps):
            velocity = advect.semi_lagrangian(velocity, velocity, dt)
            velocity = velocity + pull * dt
            velocity = diffuse.explicit(velocity, nu, dt)
            velocity, _ = fluid.make_incompressible(velocity, [pillar], solver)
        squares = velocity.at_centers().values ** 2
        return math.sum(math.mean(squares, squares.shape.spatial), "vector").native()

    def values() -> list[Any]:
        kind = torch.float64 if scene.get("precision", 32) == 64 else torch.float32
        numbers = ([1.0, 0.0, -9.81], 5e-3, [1.0, 0.0, 0.0])
        return [torch.tensor(x, dtype=kind, requires_grad=True) for x in numbers]

    forward, backward, used = [], [], 0.0
    for turn in range(scene["repeats"] + 1):
        if turn == 1:  # what one step leaves behind is the program, not the rollout
            used, steps = reset_peak(), scene["steps"]
        leaves = values()
        began = time.perf_counter()
        loss = loss_of(*leaves)
        middle = time.perf_counter()
        loss.backward()
        end = time.perf_counter()
        forward.append(middle - began)
        backward.append(end - middle)
    kept = max(scene["repeats"], 1)
    gradient = [float(x) for leaf in leaves for x in leaf.grad.reshape(-1)]
    return {
        "forward": forward[-kept:], "backward": backward[-kept:], "peak_mb": peak() - used, "loss": float(loss),
        "gradient": gradient, "version": importlib.import_module("phi").__version__,
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(measure(json.loads(sys.argv[1]))))
