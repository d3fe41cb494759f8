"""The pressure on a device: iterations, time and launches of `WarpPoisson`, with and without graphs; and viscosity.

    python benchmarks/warp_poisson.py [--device cuda] [--sizes 64x64x64 128x128x128 256x128x64] [--repeats 5] [--tune]

The scene is a pool with a wavy surface over a bed of cut cells, the surface anywhere within its cells, at rest until
gravity acts on it; solved from 0 to 1e-5. "iteration" is a V-cycle with its step of conjugate gradients, from solves
that may not stop early. The share of bandwidth is what the kernels of an iteration have to read and write (each array
of a pass once, cells without equation only their diagonal, levels in one block not counted) over its time, against a
copy measured here; a share above 1 means that the caches serve. "loops" are graphs that hold the loop of the iteration.
Viscosity is the same scene, stirred, with nu dt / h^2 = 1, a honey in small cells. --tune: time of an iteration for
other sizes of the block that visits the small levels. First come three systems that the CPU solves too.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
import warp as wp

from fluidlift.backends import warp_poisson
from fluidlift.backends.warp_device import warp_device
from fluidlift.backends.warp_pressure import WarpPressure
from fluidlift.backends.warp_viscosity import WarpViscosity
from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.physics.free_surface import surface_gaps
from fluidlift.types import triple

TOLERANCE = 1e-5
SPACING = 0.02
FIXED = 20
"""iterations of solves that may not stop early"""
MODES = {"loops": {"graphs": True, "loops": True}, "graphs": {"graphs": True}, "launches": {"graphs": False}}
HALF_SWEEP, RESTRICT, TURN, DESCEND = 28, 25, 44, 56
"""bytes per cell: x twice, rhs, diagonal, three couplings; the same without the second x, and a share of the coarse
level; x, diagonal, air (8), couplings, both directions, q (8); diagonal, p and r twice each (8), direction, q (8), rhs
and x"""


def scene(shape: tuple[int, int, int]) -> tuple[np.ndarray, list[np.ndarray], np.ndarray]:
    """Cell types, open shares of the faces, and distances (m) from the surface."""
    i, j, k = np.indices(shape, np.float32)
    depth = shape[2] * (0.7 + 0.05 * np.sin(12 * i / shape[0]) * np.cos(9 * j / shape[1]))
    distance = ((k + 0.5 - depth) * SPACING).astype(np.float32)
    openings = []
    for axis in range(3):
        x = [np.arange(n) + 0.5 for n in shape]
        x[axis] = np.arange(shape[axis] + 1.0)
        a, b, c = np.meshgrid(*x, indexing="ij", sparse=True)
        bed = shape[2] * (0.2 + 0.1 * np.sin(7 * a / shape[0] + 4 * b / shape[1]))
        share = np.clip(c - bed + 0.5, 0.0, 1.0)
        openings.append(np.ascontiguousarray(np.where(share < 0.02, 0.0, share), np.float32))
    return (distance < 0).astype(np.uint8), openings, distance


def falling(pressure: WarpPressure, shape: tuple[int, int, int]) -> tuple[wp.array, ...]:
    """The system of the scene, and velocities after 2 ms of gravity."""
    types, openings, distance = scene(shape)
    device = pressure.device

    def faces(values: list[np.ndarray]) -> tuple[wp.array, wp.array, wp.array]:
        return triple(wp.array(v, dtype=wp.float32, device=device) for v in values)

    on_device = wp.array(types, dtype=wp.uint8, device=device)
    pressure.build(on_device, faces(openings), faces(list(surface_gaps(distance, types))))
    velocity = faces([np.full_like(o, v) for o, v in zip(openings, (0.0, 0.0, -9.81 * 0.002))])
    pressure.right_side(velocity)
    return velocity


def median(run: Callable[[], object], device: wp.Device, repeats: int) -> float:
    """Seconds."""
    for _ in range(3):  # compiled, captured, replayed
        run()
    times = []
    for _ in range(repeats):
        wp.synchronize_device(device)
        begin = time.perf_counter()
        run()
        wp.synchronize_device(device)
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def bandwidth(device: wp.Device, repeats: int) -> float:
    """bytes/s of a copy on the device, read and written."""
    one, other = (wp.zeros(2**26 if device.is_cuda else 2**22, dtype=wp.float32, device=device) for _ in range(2))
    return 2 * 4 * one.size / median(lambda: wp.copy(other, one), device, repeats)


def traffic(solver: warp_poisson.WarpPoisson, unknown: np.ndarray) -> int:
    """Bytes of an iteration."""
    filled = unknown.mean()
    total, sweeps = 0.0, 2
    for n, level in enumerate(solver._levels[: solver._small]):
        cells = float(np.prod(level[:3]))
        passes = 4 * sweeps - 1
        total += cells * (filled * (passes * HALF_SWEEP + RESTRICT) + (1 - filled) * 4 * (passes + 1))
        if n == 0:
            total += cells * (filled * (TURN + DESCEND) + (1 - filled) * 8)
    return int(total)


def measured(
    shape: tuple[int, int, int], device: wp.Device, repeats: int, *, graphs: bool, loops: bool = False
) -> dict[str, float]:
    """Seconds of a solve, of an iteration and of what is done once per solve; iterations, launches, bytes."""
    pressure = WarpPressure(shape, SPACING, device, graphs=graphs, loops=loops)
    falling(pressure, shape)
    solver, given = pressure.solver, (pressure.unknown, pressure.weights, pressure.rhs)
    _, report = solver.solve(*given, tolerance=TOLERANCE)
    before = solver.launches
    solver._two_iterations()
    launches = (solver.launches - before) / 2
    whole = median(lambda: solver.solve(*given, tolerance=TOLERANCE), device, repeats)
    once = median(lambda: solver.solve(*given, tolerance=0.0, max_iterations=0), device, repeats)
    fixed = median(lambda: solver.solve(*given, tolerance=0.0, max_iterations=FIXED), device, repeats)
    return {
        "converged": report.converged, "iterations": report.iterations, "launches": launches, "solve": whole,
        "once": once, "iteration": (fixed - once) / FIXED,
        "bytes": traffic(solver, pressure.unknown.numpy().astype(bool)),
    }  # fmt: skip


def viscous(shape: tuple[int, int, int], device: wp.Device, repeats: int) -> None:
    """Time of a viscous step."""
    types, openings, distance = scene(shape)
    rng, wet = np.random.default_rng(0), np.pad(types, 1) > 0

    def marks(values: list[np.ndarray]) -> tuple[wp.array, wp.array, wp.array]:
        return triple(wp.array(v.astype(np.uint8), dtype=wp.uint8, device=device) for v in values)

    solved = []
    for axis, opening in enumerate(openings):
        inner = tuple(slice(0, None) if a == axis else slice(1, -1) for a in range(3))
        cells = np.moveaxis(wet[inner], axis, 0)
        solved.append(np.moveaxis(cells[1:] | cells[:-1], 0, axis) & (opening > 0))
    walls = [opening == 0 for opening in openings]
    roles = triple(marks(m) for m in (solved, [np.zeros_like(w) for w in walls], walls))
    a, b, c = np.meshgrid(*(np.arange(n + 1.0) for n in shape), indexing="ij", sparse=True)
    bed = (c - shape[2] * (0.2 + 0.1 * np.sin(7 * a / shape[0] + 4 * b / shape[1]))) * SPACING
    liquid, solid = (wp.array(np.float32(d), dtype=wp.float32, device=device) for d in (distance, bed))
    stirred = [np.where(m, rng.normal(size=m.shape), 0).astype(np.float32) for m in solved]
    for name, mode in MODES.items():
        solver = WarpViscosity(shape, SPACING, device, **mode)
        velocity = triple(wp.array(v, dtype=wp.float32, device=device) for v in stirred)
        options = {"viscosity": SPACING**2 / 0.002, "dt": 0.002, "wall_share": 1.0}
        report = solver.diffuse(velocity, roles, liquid, solid, **options)

        times = []
        for _ in range(repeats + 2):
            for array, start in zip(velocity, stirred):
                array.assign(start)
            wp.synchronize_device(device)
            begin = time.perf_counter()
            solver.diffuse(velocity, roles, liquid, solid, **options)
            wp.synchronize_device(device)
            times.append(time.perf_counter() - begin)
        iterations = 0 if report is None else report.iterations
        took = 1e3 * float(np.median(times[2:]))
        print(f"    viscosity, {name}: {iterations} iterations, {took:.2f} ms", flush=True)


def scattered(n: int, _: wp.Device) -> tuple[np.ndarray, list[np.ndarray]]:
    """Unknown cells anyhow, with faces of any size: many components, some of them closed."""
    rng = np.random.default_rng(2)
    weights = []
    for axis in range(3):
        w = np.maximum(rng.uniform(-0.5, 1.0, tuple(n + (a == axis) for a in range(3))), 0.0).astype(np.float32)
        np.moveaxis(w, axis, 0)[[0, -1]] = 0.0
        weights.append(w)
    return rng.uniform(size=(n, n, n)) < 0.9, weights


def chambers(n: int, device: wp.Device) -> tuple[np.ndarray, list[np.ndarray]]:
    """No air at all, and a wall between the two halves."""
    _, weights = scattered(n, device)
    weights[0][n // 2] = 0.0
    return np.ones((n, n, n), bool), weights


def pool(n: int, device: wp.Device) -> tuple[np.ndarray, list[np.ndarray]]:
    """The scene, as `WarpPressure` makes a system of it."""
    pressure = WarpPressure((n, n, n), SPACING, device)
    falling(pressure, (n, n, n))
    return pressure.unknown.numpy().astype(bool), [w.numpy() for w in pressure.weights]


def check(device: wp.Device, n: int) -> None:
    """Solutions against those of the CPU, twice with each solver: directly and by a graph."""
    for make in (pool, scattered, chambers):
        unknown, weights = make(n, device)
        rhs = np.random.default_rng(3).normal(size=unknown.shape).astype(np.float32)
        wanted, theirs = solve(PoissonSystem(unknown, *weights, SPACING), rhs, tolerance=1e-6)
        given = wp.array(unknown.astype(np.uint8), dtype=wp.uint8, device=device)
        faces = triple(wp.array(w, dtype=wp.float32, device=device) for w in weights)
        for name, mode in MODES.items():
            solver = warp_poisson.WarpPoisson(unknown.shape, SPACING, device, **mode)
            right = wp.array(rhs, dtype=wp.float32, device=device)
            for _ in range(3):
                p, ours = solver.solve(given, faces, right, tolerance=1e-6)
            error = float(np.abs(p.numpy() - wanted).max() / np.abs(wanted).max())
            good = error < 1e-4 and ours.advice == theirs.advice and abs(ours.iterations - theirs.iterations) < 3
            print(
                f"  {'agrees' if good else 'DIFFERS'}: {make.__name__} of {n}^3, {name}: error {error:.1e}, "
                f"{ours.iterations} iterations here, {theirs.iterations} on the CPU; {ours.advice or 'no advice'}",
                flush=True,
            )


def tune(shape: tuple[int, int, int], device: wp.Device, repeats: int) -> None:
    """Time of an iteration for other limits of the small levels and blocks for them."""
    usual = warp_poisson.SMALL_CELLS, warp_poisson.SMALL_BLOCK
    for cells in (512, 4096, 32768):
        for block in (256, 512, 1024):
            warp_poisson.SMALL_CELLS, warp_poisson.SMALL_BLOCK = cells, block
            found = measured(shape, device, repeats, graphs=True)
            print(
                f"    small levels up to {cells} cells, {block} threads: {1e6 * found['iteration']:.0f} us per "
                f"iteration, {found['launches']:.0f} launches", flush=True,
            )  # fmt: skip
    warp_poisson.SMALL_CELLS, warp_poisson.SMALL_BLOCK = usual


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--sizes", nargs="+", default=["64x64x64", "128x128x128", "256x128x64"])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--tune", action="store_true")
    parser.add_argument("--no-check", action="store_true", help="leave out the comparison with the CPU")
    options = parser.parse_args()
    device = warp_device(options.device)
    peak = bandwidth(device, options.repeats)
    print(f"{device.name}: copy {peak / 1e9:.0f} GB/s")
    if not options.no_check:
        check(device, 48 if device.is_cuda else 20)
    for text in options.sizes:
        shape = triple(int(n) for n in text.split("x"))
        print(f"  {text}", flush=True)
        for name, mode in MODES.items():
            m = measured(shape, device, options.repeats, **mode)
            share = m["bytes"] / m["iteration"] / peak
            print(
                f"    {name:<9}{m['iterations']:.0f} iterations"
                f"{'' if m['converged'] else ' (not converged)'}, {1e3 * m['solve']:.2f} ms per solve, of which "
                f"{1e3 * m['once']:.2f} ms once; {1e6 * m['iteration']:.0f} us and {m['launches']:.0f} launches per "
                f"iteration, {m['bytes'] / 1e6:.0f} MB, {100 * share:.0f} % of the bandwidth", flush=True,
            )  # fmt: skip
        viscous(shape, device, options.repeats)
        if options.tune:
            tune(shape, device, options.repeats)


if __name__ == "__main__":
    main()
