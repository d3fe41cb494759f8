"""The liquid's whole substep in NVIDIA Warp: a dam break, timed by part, beside the same one on the CPU.

    python benchmarks/warp_liquid.py [--device cuda] [--counts 100000 500000 2000000] [--frames 12] [--host] [--check]

One frame is 1/30 s. "ms per substep" and "frames per second" are of the simulator as it is called, its host part
included; the split by part waits for the device after each part, so its sum is larger. The share of bandwidth is the
compulsory traffic of a transfer (each particle array and each face near the liquid read or written once) over its time,
against a copy measured here. `--host` runs the CPU's simulator too; `--check` first compares a dam break, a river and
honey with the CPU's, with itself, and with itself from a checkpoint. Needs numpy, scipy, numba, jaxtyping and Warp.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from typing import Any

import numpy as np
import warp as wp

from fluidlift.backends.warp_liquid import WarpLiquids
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.numba_particles import ParticleWork
from fluidlift.synthetic import tanks

INTERVAL = 1.0 / 30.0
"""s of a frame"""
BASE = 4.0
"""m: across the base of the column. Large enough that the viscosity of water is lost on the cells"""
PER_CELL = 8
SETTLE = 3
"""frames before the clock runs: what is compiled, captured and allocated is there then, and the column has begun to
fall"""


def dam(count: int) -> tanks.Tank:
    """A column twice as high as wide, and two thirds as deep, of about `count` particles."""
    cells = max(4, round((count / (PER_CELL * 2 * 2 / 3)) ** (1 / 3)))
    return tanks.dam_break(cells=cells, width_cells=max(4, round(count / (PER_CELL * 2 * cells**2))), base=BASE)


class Parts:
    """Seconds of each part of the substeps, the device waited for after each."""

    def __init__(self, device: wp.Device) -> None:
        self._device, self.seconds, self._last = device, defaultdict(float), 0.0

    def begin(self) -> None:
        """The clock runs from here."""
        wp.synchronize_device(self._device)
        self._last = time.perf_counter()

    def __call__(self, part: str) -> None:
        """A part is over."""
        wp.synchronize_device(self._device)
        now = time.perf_counter()
        self.seconds[part] += now - self._last
        self._last = now


def copy_bandwidth(device: wp.Device) -> float:
    """bytes/s of a copy on the device, read and written."""
    size = 2**28 if device.is_cuda else 2**25
    source, target = (wp.zeros(size // 4, dtype=wp.float32, device=device) for _ in range(2))
    best = np.inf
    for _ in range(5):
        wp.synchronize_device(device)
        begin = time.perf_counter()
        wp.copy(target, source)
        wp.synchronize_device(device)
        best = min(best, time.perf_counter() - begin)
    return 2 * size / best


def transfer_bytes(count: int) -> dict[str, int]:
    """Compulsory traffic of a scatter and a gather."""
    faces = 3 * count // PER_CELL
    return {
        "particles to grid": count * 4 * (3 + 3 + 9 + 1) + faces * 8,
        "grid to particles": count * 4 * (3 + 3 + 9 + 3 + 3) + faces * 4,
    }


def used(device: wp.Device) -> float:
    """GB that the device's memory pool has held at most."""
    return wp.get_mempool_used_mem_high(device) / 1e9 if device.is_cuda else float("nan")


def timed(simulator: LiquidSimulator, frames: int, device: wp.Device | None) -> tuple[float, int, int]:
    """Seconds, substeps and pressure iterations of some frames."""
    substeps = iterations = 0
    if device is not None:
        wp.synchronize_device(device)
    begin = time.perf_counter()
    for _ in range(frames):
        report = simulator.advance(INTERVAL)
        substeps += report.substeps
        iterations += sum(r.iterations for r in report.pressure)
    if device is not None:
        wp.synchronize_device(device)
    return time.perf_counter() - begin, substeps, iterations


def run(count: int, frames: int, device: wp.Device, name: str) -> dict[str, Any]:
    """A dam break on the device."""
    tank = dam(count)
    simulator = tank.simulator(work=ParticleWork(liquid=WarpLiquids(name)))
    if simulator.on_host_because:
        raise SystemExit(f"left to the host: {simulator.on_host_because}")
    timed(simulator, SETTLE, device)
    seconds, substeps, iterations = timed(simulator, frames, device)
    stepper: Any = simulator._stepper  # its clock is for measurements alone
    parts = Parts(device)
    stepper.told = parts
    began = time.perf_counter()
    split_substeps = 0
    for _ in range(max(2, frames // 4)):
        parts.begin()
        split_substeps += simulator.advance(INTERVAL).substeps
        parts("host")
    split_total = time.perf_counter() - began
    begin = time.perf_counter()
    particles = simulator.particles
    download = time.perf_counter() - begin
    split = {part: 1e3 * s / split_substeps for part, s in parts.seconds.items()}
    copy, traffic = copy_bandwidth(device), transfer_bytes(len(particles))
    return {
        "device": device.name if device.is_cuda else "cpu", "particles": len(particles), "cells": tank.grid.cells,
        "region": stepper._region.grid.shape, "frames": frames, "substeps_per_frame": substeps / frames,
        "ms_per_substep": 1e3 * seconds / substeps, "frames_per_second": frames / seconds,
        "pressure_iterations": iterations / substeps, "split_ms": split,
        "split_sum_ms": 1e3 * split_total / split_substeps,
        "share_of_copy": {part: traffic[part] / copy / (1e-3 * split[part]) for part in traffic},
        "copy_GB_s": copy / 1e9, "peak_GB": used(device), "download_ms": 1e3 * download,
    }  # fmt: skip


def check(name: str) -> None:
    """A few frames of small scenes, on the device (twice, and from a checkpoint) and on the host."""
    scenes = {
        "dam break": tanks.dam_break(cells=16, width_cells=8, base=BASE), "river": tanks.river(cells=48),
        "honey": tanks.honey_slope(cells=32),
    }  # fmt: skip
    for title, tank in scenes.items():
        ends, speeds = [], []
        for make in (WarpLiquids(name), WarpLiquids(name), None):
            simulator = tank.simulator(work=ParticleWork(liquid=make))
            for _ in range(4):
                simulator.advance(0.75 * tank.parameters.time_step)
            ends.append(simulator.particles)
            if make is not None and len(ends) == 1:
                state = simulator.state()
            speeds.append(float((ends[-1].masses * np.square(ends[-1].velocities).sum(axis=1)).sum(dtype=np.float64)))
            if len(ends) == 2:
                onward = simulator
        again = tank.simulator(work=ParticleWork(liquid=WarpLiquids(name)))
        again.restore(state)
        for simulator in (again, onward):
            simulator.advance(0.75 * tank.parameters.time_step)
        same = all(np.array_equal(getattr(ends[0], f), getattr(ends[1], f)) for f in ("positions", "velocities", "ids"))
        resumed = np.array_equal(again.particles.positions, onward.particles.positions)
        host, device = ends[2], ends[0]
        apart = "different particles"
        if np.array_equal(host.ids, device.ids):
            gap = np.abs(host.positions - device.positions) / tank.grid.spacing
            apart = f"{gap.max():.2g} cells at most, {np.sqrt(np.square(gap).mean()):.2g} typically"
        print(
            f"{title}, {len(device)} particles: from the CPU's {apart}, energy {speeds[0] / speeds[2] - 1:+.1e}; "
            f"the same bits twice: {same}; from a checkpoint: {resumed}"
        )


def report(found: dict[str, Any]) -> None:
    """For people."""
    print(
        f"\n{found['particles']} particles, {found['cells']} cells, region {found['region']}, {found['device']}\n"
        f"  {found['ms_per_substep']:.2f} ms per substep, {found['substeps_per_frame']:.1f} substeps per frame, "
        f"{found['frames_per_second']:.1f} frames per second; {found['pressure_iterations']:.1f} pressure iterations; "
        f"peak {found['peak_GB']:.2f} GB; particles to the host {found['download_ms']:.1f} ms"
    )
    for part, milliseconds in sorted(found["split_ms"].items(), key=lambda item: -item[1]):
        share = found["share_of_copy"].get(part)
        tail = "" if share is None else f"   {100 * share:.0f} % of a copy's {found['copy_GB_s']:.0f} GB/s"
        print(f"  {part:20s} {milliseconds:8.3f} ms{tail}")
    print(f"  {'sum, waited for':20s} {found['split_sum_ms']:8.3f} ms")


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1... or cpu")
    parser.add_argument("--counts", type=int, nargs="+", default=[100_000, 500_000, 2_000_000])
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--host", action="store_true", help="run the CPU's simulator too")
    parser.add_argument("--check", action="store_true", help="compare small scenes with the CPU first")
    parser.add_argument("--json", help="a file for the numbers")
    given = parser.parse_args()
    from fluidlift.backends.warp_device import warp_device

    device, all_found = warp_device(given.device), []
    if given.check:
        check(given.device)
    for count in given.counts:
        found = run(count, given.frames, device, given.device)
        if given.host:
            simulator = dam(count).simulator()
            timed(simulator, SETTLE, None)
            seconds, substeps, _ = timed(simulator, given.frames, None)
            found["host_ms_per_substep"] = 1e3 * seconds / substeps
            print(f"the CPU's simulator, {count} particles: {found['host_ms_per_substep']:.1f} ms per substep")
        report(found)
        all_found.append(found)
        if given.json:
            with open(given.json, "w", encoding="utf-8") as file:
                json.dump(all_found, file, indent=1)


if __name__ == "__main__":
    main()
