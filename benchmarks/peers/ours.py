"""The liquid of fluidlift in the dam break that the peers run too; prints one line of JSON.

    python benchmarks/peers/ours.py '{"mode": "frames", "cells": [64, 64, 64], "block": [25, 20, 25], "frames": 5}'

Modes: "transfer" (the affine transfers alone, one step at a time) and "frames" (whole steps, pressure included).
A scene: `cells` and `block` count cells, `spacing` is their width (m), the block stands in the low corner with eight
particles per cell; see `benchmarks/simulator.py` for the rest.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np

from fluidlift.physics import transfer
from fluidlift.physics.active_region import region_around
from fluidlift.physics.advect_particles import displacements
from fluidlift.physics.apic import LiquidSimulator, SimulationSettings
from fluidlift.physics.forces import add_gravity
from fluidlift.physics.stepping import TIDY_EVERY
from fluidlift.types import FluidParameters, Grid, Particles, Terrain, TriangleMesh

GRAVITY = (0.0, 0.0, -9.81)


def peak_memory() -> float:
    """MB, of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def block_of_particles(block: list[int], spacing: float, seed: int = 0) -> Particles:
    """Eight particles per cell, slightly jittered, cell by cell in the order of the grid."""
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in block), indexing="ij"), axis=-1).reshape(-1, 1, 3)
    corners = np.stack(np.meshgrid(*([[0.25, 0.75]] * 3), indexing="ij"), axis=-1).reshape(1, 8, 3)
    jitter = np.random.default_rng(seed).uniform(-0.1, 0.1, (len(cells), 8, 3))
    return Particles.at_rest(((cells + corners + jitter) * spacing).reshape(-1, 3), 1000.0 * spacing**3 / 8)


def measure_transfer(scene: dict[str, Any]) -> dict[str, Any]:
    """ActiveRegion, sort by cell, particles to grid, gravity, grid to particles, move; reorder every few steps.

    As in a substep of the simulator, without pressure, viscosity, walls and crowds.
    """
    grid = Grid(tuple(scene["cells"]), scene["spacing"])
    particles = block_of_particles(scene["block"], grid.spacing)
    dt, times, busy = scene.get("time_step", 1e-3), [], 0.0
    for number in range(scene["warm"] + scene["frames"]):
        if number == scene["warm"]:
            busy = time.process_time()
        began = time.perf_counter()
        box = region_around(particles.positions, grid)
        low = tuple(o + s.start * grid.spacing for o, s in zip(grid.origin, box))
        region = Grid(tuple(s.stop - s.start for s in box), grid.spacing, low)
        order = transfer.sort_by_cell(particles.positions, region)
        if number % TIDY_EVERY == 0:
            particles = transfer.select_particles(particles, order.order)
            order = transfer.CellOrder(np.arange(len(particles)), order.start)
        velocity, _ = transfer.particles_to_grid(particles, region, order)
        velocity = add_gravity(velocity, GRAVITY, dt)
        velocities, affine = transfer.grid_to_particles(velocity, region, particles.positions, order)
        moves, _ = displacements(velocities, affine, dt)
        positions = particles.positions + moves
        particles = replace(particles, positions=positions, velocities=velocities, affine=affine)
        times.append(time.perf_counter() - began)
    return {
        "ms_step": 1e3 * float(np.median(times[scene["warm"] :])), "particles": len(particles),
        "cpu_ms_step": 1e3 * (time.process_time() - busy) / scene["frames"],
        "mean_velocity_z": float(particles.velocities[:, 2].mean(dtype=np.float64)), "variant": "mac grid, blocks",
    }  # fmt: skip


def simulator_of(scene: dict[str, Any]) -> LiquidSimulator:
    """The dam in a box with frictionless walls and no terrain."""
    grid = Grid(tuple(scene["cells"]), scene["spacing"])
    far = np.full(tuple(n + 1 for n in grid.shape), 10.0, np.float32)
    terrain = Terrain(grid, far, np.array([1.0, 0.0, 0.0]), TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
    parameters = FluidParameters(
        kinematic_viscosity=scene.get("viscosity", 1e-6), gravity=GRAVITY, time_step=scene.get("time_step", 1 / 24)
    )
    return LiquidSimulator(
        grid, terrain, parameters, block_of_particles(scene["block"], grid.spacing),
        cell_types=np.zeros(grid.shape, np.uint8),
        settings=SimulationSettings(courant=scene.get("courant", 1.0)),
    )  # fmt: skip


def measure_frames(scene: dict[str, Any]) -> dict[str, Any]:
    """Wall time of frames (1/24 s unless the scene says otherwise) after the first few, substeps, iterations."""
    frame = scene.get("frame", 1 / 24)
    small = dict(scene, cells=[12, 12, 12], block=[5, 5, 5])
    simulator_of(small).advance(frame)  # compiles, or loads what is compiled
    loaded = peak_memory()
    simulator = simulator_of(scene)
    times, reports, busy = [], [], 0.0
    for number in range(scene["warm"] + scene["frames"]):
        if number == scene["warm"]:
            busy = time.process_time()
        began = time.perf_counter()
        reports.append(simulator.advance(frame))
        times.append(time.perf_counter() - began)
    busy = time.process_time() - busy
    times, kept = times[scene["warm"] :], reports[scene["warm"] :]
    steps = sum(r.substeps for r in kept)
    particles = simulator.particles
    return {
        "ms_frame": 1e3 * sum(times) / len(times), "ms_step": 1e3 * sum(times) / steps,
        "cpu_ms_step": 1e3 * busy / steps,
        "steps_per_frame": steps / len(times), "particles": len(particles),
        "iterations": float(np.mean([s.iterations for r in kept for s in r.pressure])),
        "residual": float(max(s.residual for r in kept for s in r.pressure)),
        "fluid_cells": reports[-1].wet_volume / simulator.grid.spacing**3,
        "front": float(np.percentile(particles.positions[:, 0], 99)),
        "mean_height": float(particles.positions[:, 2].mean(dtype=np.float64)),
        "peak_mb": peak_memory(), "loaded_mb": loaded,
        "variant": f"courant {scene.get('courant', 1.0):g}, relative residual 1e-5",
    }  # fmt: skip


if __name__ == "__main__":
    given = json.loads(sys.argv[1])
    print(json.dumps({"transfer": measure_transfer, "frames": measure_frames}[given["mode"]](given)))
