"""An affine particle-in-cell step in Taichi on the CPU; prints one line of JSON. Needs `pip install taichi==1.7.4`.

    python benchmarks/peers/taichi_apic.py '{"cells": [64, 64, 64], "block": [25, 20, 25], "frames": 20, "threads": 2}'

Quadratic B-splines, single precision, no pressure. "grid": "mac" (staggered, as fluidlift does it) or "nodal" (one set
of weights for all components and one vector per node: about a third of the arithmetic). Three ways of writing the
scatter; the fastest counts:
  random   atomic additions, particles in random order
  sorted   atomic additions, particles stored cell by cell from the start; the sorting itself is not charged
  slabs    no atomics: a counting sort per step, then slabs of four layers of cells, even ones before odd ones; the
           particles are stored anew in that order every fourth step
Only the part of the grid that the block reaches is cleared and swept: its bounds are given, and cost nothing.
"""

import json
import sys
import time
from typing import Any

import numpy as np
import taichi as ti

SLAB = 4
REORDER_EVERY = 4


def block_of_particles(block: list[int], spacing: float) -> np.ndarray:
    """Eight particles per cell, slightly jittered, cell by cell in the order of the grid."""
    cells = np.stack(np.meshgrid(*(np.arange(n) for n in block), indexing="ij"), axis=-1).reshape(-1, 1, 3)
    corners = np.stack(np.meshgrid(*([[0.25, 0.75]] * 3), indexing="ij"), axis=-1).reshape(1, 8, 3)
    jitter = np.random.default_rng(0).uniform(-0.1, 0.1, (len(cells), 8, 3))
    return ((cells + corners + jitter) * spacing).reshape(-1, 3).astype(np.float32)


@ti.data_oriented
class AffineStep:
    """State and kernels. Grids have a layer more on each side, so that no index is clipped."""

    def __init__(self, positions: np.ndarray, scene: dict[str, Any]) -> None:
        self.n, self.cells, self.h = len(positions), scene["cells"], scene["spacing"]
        self.dt = scene.get("time_step", 1e-3)
        self.staggered = scene.get("grid", "mac") == "mac"
        nodes = [n + 4 for n in self.cells]
        self.active = tuple(min(b + 6, n) for b, n in zip(scene["block"], nodes))
        self.x, self.v, self.x2, self.v2 = (ti.Vector.field(3, ti.f32, self.n) for _ in range(4))
        self.c, self.c2 = (ti.Matrix.field(3, 3, ti.f32, self.n) for _ in range(2))
        # momentum (or velocity) and mass side by side
        if self.staggered:
            self.grids = [ti.Vector.field(2, ti.f32, nodes) for _ in range(3)]
        else:
            self.grids = [ti.Vector.field(4, ti.f32, nodes)]
        self.count = ti.field(ti.i32, self.cells[0] * self.cells[1] * self.cells[2] + 1)
        self.cell, self.order = ti.field(ti.i32, self.n), ti.field(ti.i32, self.n)
        self.x.from_numpy(positions)

    @ti.func
    def place(self, p, axis: ti.template()):
        """Coordinate, first of the three nodes along each axis, weights of all three, on the grid of a component."""
        at = self.x[p] / self.h + 1.0
        if ti.static(self.staggered):
            for a in ti.static(range(3)):
                if ti.static(a != axis):
                    at[a] -= 0.5
        base = ti.cast(ti.floor(at - 0.5), ti.i32)
        d = at - base
        return at, base, [0.5 * (1.5 - d) ** 2, 0.75 - (d - 1.0) ** 2, 0.5 * (d - 0.5) ** 2]

    @ti.func
    def add(self, p, atomic: ti.template()):
        for g in ti.static(range(len(self.grids))):
            at, base, w = self.place(p, g)
            row = ti.Vector([self.c[p][g, 0], self.c[p][g, 1], self.c[p][g, 2]])
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                weight = w[i][0] * w[j][1] * w[k][2]
                away = (base + offset - at) * self.h
                amount = ti.Vector.zero(ti.f32, 2 if ti.static(self.staggered) else 4)
                if ti.static(self.staggered):
                    amount = ti.Vector([weight * (self.v[p][g] + row.dot(away)), weight])
                else:
                    m = weight * (self.v[p] + self.c[p] @ away)
                    amount = ti.Vector([m[0], m[1], m[2], weight])
                if ti.static(atomic):
                    self.grids[g][base + offset] += amount
                else:
                    self.grids[g][base + offset] = self.grids[g][base + offset] + amount

    @ti.kernel
    def clear(self):
        for g in ti.static(range(len(self.grids))):
            for i in ti.grouped(ti.ndrange(*self.active)):
                self.grids[g][i] = 0.0

    @ti.kernel
    def scatter_atomic(self):
        for p in range(self.n):
            self.add(p, True)

    @ti.kernel
    def scatter_slabs(self, color: ti.i32, slabs: ti.i32):
        ti.loop_config(block_dim=1)
        for s in range(slabs):
            slab = 2 * s + color
            layer = self.cells[1] * self.cells[2]
            first = self.count[ti.min(slab * SLAB, self.cells[0]) * layer]
            last = self.count[ti.min((slab + 1) * SLAB, self.cells[0]) * layer]
            for q in range(first, last):
                self.add(self.order[q], False)

    @ti.kernel
    def forces(self):
        for g in ti.static(range(len(self.grids))):
            for i in ti.grouped(ti.ndrange(*self.active)):
                value = self.grids[g][i]
                if ti.static(self.staggered):
                    if value[1] > 0:
                        push = ti.static(-9.81 * self.dt if g == 2 else 0.0)
                        self.grids[g][i] = ti.Vector([value[0] / value[1] + push, value[1]])
                else:
                    if value[3] > 0:
                        v = value / value[3]
                        self.grids[g][i] = ti.Vector([v[0], v[1], v[2] - 9.81 * self.dt, value[3]])

    @ti.kernel
    def gather(self):
        for p in range(self.n):
            v = ti.Vector.zero(ti.f32, 3)
            c = ti.Matrix.zero(ti.f32, 3, 3)
            for g in ti.static(range(len(self.grids))):
                at, base, w = self.place(p, g)
                for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                    offset = ti.Vector([i, j, k])
                    weight = w[i][0] * w[j][1] * w[k][2]
                    node = self.grids[g][base + offset]
                    away = base + offset - at
                    if ti.static(self.staggered):
                        v[g] += weight * node[0]
                        for b in ti.static(range(3)):
                            c[g, b] += weight * node[0] * away[b]
                    else:
                        u = weight * ti.Vector([node[0], node[1], node[2]])
                        v += u
                        c += u.outer_product(away)
            self.v[p], self.c[p] = v, c * (4.0 / self.h)
            x = self.x[p] + self.dt * v
            for a in ti.static(range(3)):
                x[a] = ti.min(ti.max(x[a], 0.0), self.cells[a] * self.h - 1e-4)
            self.x[p] = x

    @ti.kernel
    def counting_sort(self):
        for c in self.count:
            self.count[c] = 0
        for p in range(self.n):
            i = ti.cast(self.x[p] / self.h, ti.i32)
            self.cell[p] = (i[0] * self.cells[1] + i[1]) * self.cells[2] + i[2]
        ti.loop_config(serialize=True)
        for p in range(self.n):
            self.count[self.cell[p]] = self.count[self.cell[p]] + 1
        ti.loop_config(serialize=True)
        for c in range(1, self.count.shape[0]):
            self.count[c] = self.count[c] + self.count[c - 1]
        # from the back: afterwards count[c] is where cell c begins
        ti.loop_config(serialize=True)
        for q in range(self.n):
            p = self.n - 1 - q
            to = self.count[self.cell[p]] - 1
            self.count[self.cell[p]] = to
            self.order[to] = p

    @ti.kernel
    def reorder(self):
        for q in range(self.n):
            p = self.order[q]
            self.x2[q], self.v2[q], self.c2[q] = self.x[p], self.v[p], self.c[p]
        for p in range(self.n):
            self.x[p], self.v[p], self.c[p] = self.x2[p], self.v2[p], self.c2[p]
            self.order[p] = p

    def step(self, slabs: bool, number: int) -> None:
        """One step of every particle."""
        if slabs:
            self.counting_sort()
            if number % REORDER_EVERY == 0:
                self.reorder()
        self.clear()
        if slabs:
            number = -(-self.cells[0] // SLAB)
            self.scatter_slabs(0, (number + 1) // 2)
            self.scatter_slabs(1, number // 2)
        else:
            self.scatter_atomic()
        self.forces()
        self.gather()


def measure(scene: dict[str, Any]) -> dict[str, Any]:
    """The median step of each variant, ms, and which is the fastest."""
    positions = block_of_particles(scene["block"], scene["spacing"])
    results, busy, mean = {}, {}, 0.0
    for variant in scene.get("variants", ("random", "sorted", "slabs")):
        ti.init(arch=ti.cpu, cpu_max_num_threads=scene.get("threads", 2), log_level=ti.ERROR, fast_math=True)
        given = positions
        if variant == "random":
            given = positions[np.random.default_rng(1).permutation(len(positions))]
        state, times = AffineStep(given, scene), []
        for number in range(scene["warm"] + scene["frames"]):
            if number == scene["warm"]:
                cpu = time.process_time()
            began = time.perf_counter()
            state.step(variant == "slabs", number)
            ti.sync()
            times.append(time.perf_counter() - began)
        busy[variant] = 1e3 * (time.process_time() - cpu) / scene["frames"]
        results[variant] = 1e3 * float(np.median(times[scene["warm"] :]))
        mean = float(state.v.to_numpy()[:, 2].mean(dtype=np.float64))
        ti.reset()
    best = min(results, key=results.get)
    return {
        "ms_step": results[best], "cpu_ms_step": busy[best], "variants": results,
        "variant": f"{scene.get('grid', 'mac')} grid, {best}", "particles": len(positions), "mean_velocity_z": mean,
        "version": ".".join(map(str, ti.__version__)),
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(measure(json.loads(sys.argv[1]))))
