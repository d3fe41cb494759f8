"""Particle-grid transfers and the particle side of a step: Numba on the CPU, Warp on its CPU device and on the GPU.

    python benchmarks/warp_transfer.py [--counts 100000 500000 2000000] [--repeats 7] [--device cuda]

Medians of the repeats after one warm-up. Eight particles per cell in a block of liquid. "kernel" has all arrays on the
device; "call" is what the simulator waits for, copies from and to NumPy included. The share of bandwidth is the
compulsory traffic (each particle array and each face read or written once) over the time, against a copy measured here.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numba
import numpy as np

from fluidlift.errors import FluidliftError
from fluidlift.physics import boundaries, transfer
from fluidlift.physics.advect_particles import displacements
from fluidlift.physics.numba_particles import NumbaMover, NumbaTransfer
from fluidlift.seams import MoveRules, ParticleMover, ParticleTransfer
from fluidlift.types import Grid, Particles, Terrain, TriangleMesh

PER_CELL = 8
DT = 0.002


def liquid(count: int) -> tuple[Grid, Particles, boundaries.Walls]:
    """A block of liquid in a quarter of its box, on a flat bed; the particles are grouped by cell."""
    cells = round((4.0 * count / PER_CELL) ** (1 / 3) / 4) * 4
    grid = Grid((cells, cells, cells), 1.0 / cells)
    rng = np.random.default_rng(0)
    top = 0.05 + count / PER_CELL / (0.5 * 0.9 * cells**3)
    positions = rng.uniform([0.05, 0.05, 0.05], [0.55, 0.95, top], (count, 3)).astype(np.float32)
    particles = Particles.at_rest(positions, 1.0)
    spin = np.float32([[0, -1.0, 0.3], [1.0, 0, 0], [-0.3, 0, 0]])
    velocities = (positions - np.float32([0.3, 0.5, 0.2])) @ spin.T
    particles = replace(particles, velocities=velocities, affine=np.broadcast_to(spin, (count, 3, 3)).copy())
    bed = np.float32(grid.nodes()[..., 2] - 0.05)
    terrain = Terrain(grid, bed, np.array([1.0, 0, 0]), TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
    walls = boundaries.build_walls(terrain, np.zeros(grid.shape, np.uint8), np.zeros((3, 2), bool))
    return grid, particles.select(transfer.sort_by_cell(positions, grid).order), walls


def median(run: Callable[[], object], repeats: int) -> float:
    """Seconds."""
    run()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def compulsory_bytes(grid: Grid, count: int) -> tuple[int, int]:
    """Of a scatter and of a gather: float32 state of the particles, and the faces that liquid touches."""
    faces = min(3 * grid.cells, 3 * count // PER_CELL)
    return count * 4 * (3 + 3 + 9 + 1) + faces * 8, count * 4 * (3 + 3 + 9) + faces * 4


@numba.njit(parallel=True)
def _copy(source, target):
    for n in numba.prange(len(source)):
        target[n] = source[n]


def cpu_bandwidth(repeats: int) -> float:
    """bytes/s of a copy by all threads, read and written."""
    source, target = np.ones(2**25, np.float32), np.zeros(2**25, np.float32)
    return 2 * source.nbytes / median(lambda: _copy(source, target), repeats)


def report(name: str, seconds: dict[str, float], traffic: dict[str, int], peak: float) -> None:
    """One line: milliseconds and share of the copy's bandwidth."""
    parts = []
    for what, s in seconds.items():
        share = f" ({100 * traffic[what] / s / peak:.0f} %)" if what in traffic else ""
        parts.append(f"{what} {1e3 * s:.2f} ms{share}")
    print(f"  {name:<24}" + ", ".join(parts), flush=True)


def call_times(
    transfers: ParticleTransfer, mover: ParticleMover, grid: Grid, particles: Particles, walls: boundaries.Walls,
    repeats: int,
) -> dict[str, float]:  # fmt: skip
    """Seconds of what the simulator calls, from NumPy to NumPy."""
    velocity, _ = transfers.particles_to_grid(particles, grid)
    rules = MoveRules(DT, 0.2, 0.9, 4.0)

    def step() -> None:
        order = transfer.sort_by_cell(particles.positions, grid)
        field, _ = transfers.particles_to_grid(particles, grid, order)
        v, c = transfers.grid_to_particles(field, grid, particles.positions, order)
        moves, _ = displacements(v, c, DT)
        mover.moved(particles, moves, v, c, walls, rules)

    order = transfer.sort_by_cell(particles.positions, grid)
    return {
        "P2G": median(lambda: transfers.particles_to_grid(particles, grid, order), repeats),
        "G2P": median(lambda: transfers.grid_to_particles(velocity, grid, particles.positions, order), repeats),
        "step": median(step, repeats),
    }


def warp_call_times(device: str, ordered: bool, *scene: Any) -> dict[str, float]:
    """`call_times` of the back end."""
    from fluidlift.backends.warp_particles import WarpMover, WarpTransfer

    return call_times(WarpTransfer(device, ordered=ordered), WarpMover(device), *scene)


def warp_kernel_times(device: str, ordered: bool, grid: Grid, particles: Particles, repeats: int) -> dict[str, float]:
    """Seconds of the kernels with all arrays on the device."""
    import warp as wp

    from fluidlift.backends.warp_particles import WarpTransfer

    transfers = WarpTransfer(device, ordered=ordered)
    state = transfers.upload(particles)
    momenta, _ = transfers.scattered(state, grid)

    def timed(run: Callable[[], object]) -> float:
        def waited() -> None:
            run()
            wp.synchronize_device(device)

        return median(waited, repeats)

    return {
        "P2G": timed(lambda: transfers.scattered(state, grid)),
        "G2P": timed(lambda: transfers.gathered(momenta, grid, state[0])),
    }


def warp_bandwidth(device: str, repeats: int) -> float:
    """bytes/s of a copy on the device, read and written."""
    import warp as wp

    source, target = (wp.zeros(2**26, dtype=wp.float32, device=device) for _ in range(2))

    def copy() -> None:
        wp.copy(target, source)
        wp.synchronize_device(device)

    return 2 * 4 * 2**26 / median(copy, repeats)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--counts", type=int, nargs="+", default=[100_000, 500_000, 2_000_000])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--device", nargs="*", default=["cpu", "cuda"], help="of Warp's")
    options = parser.parse_args()
    devices: list[str] = []
    for name in options.device:
        try:
            from fluidlift.backends.warp_device import warp_device

            devices.append(warp_device(name).alias)
        except FluidliftError as error:  # say so and go on with what there is
            print(error)
    peak = {"numba": cpu_bandwidth(options.repeats)} | {d: warp_bandwidth(d, options.repeats) for d in devices}
    print("copy: " + ", ".join(f"{name} {rate / 1e9:.1f} GB/s" for name, rate in peak.items()))
    for count in options.counts:
        grid, particles, walls = liquid(count)
        scene = (grid, particles, walls, options.repeats)
        print(f"{count} particles, {grid.shape[0]}^3 cells")
        traffic = dict(zip(("P2G", "G2P"), compulsory_bytes(grid, count)))
        times = call_times(NumbaTransfer(), NumbaMover(), *scene)
        report(f"Numba, {numba.get_num_threads()} threads", times, traffic, peak["numba"])
        for device in devices:
            # in order costs ten times as much on one thread, and there the atomics have an order, too
            for ordered in (False, True) if device != "cpu" else (False,):
                name = f"Warp {device} {'ordered' if ordered else 'atomic'}"
                kernels = warp_kernel_times(device, ordered, grid, particles, options.repeats)
                report(f"{name} kernel", kernels, traffic, peak[device])
                report(f"{name} call", warp_call_times(device, ordered, *scene), {}, 1.0)


if __name__ == "__main__":
    main()
