"""Times the liquid simulator next to its peers on the same dam break, and writes Markdown tables.

    python benchmarks/simulator.py --peers PEERS --frames 4
    python benchmarks/simulator.py --peers PEERS --only transfer blender --rounds 5

Peers are looked for in a folder of environments (`--peers`); one that is missing is named with the way to get it:
  PEERS/taichi     a virtual environment with taichi==1.7.4
  PEERS/phiflow    a virtual environment with phiflow and jax
  PEERS/blender    the program, or `blender` on the PATH
Every measurement is a process of its own (`benchmarks/peers/*.py`). Within a round the simulator and its peer run one
after the other; figures are medians over rounds, ratios medians of the ratios within a round. Peers twenty times
slower get one round.

CPU times are those of all threads together: they hardly depend on what else runs on the machine.

The dam: a block of 8 particles per cell in the corner of a box of air, released at rest; frames of 1/24 s, counted
after the first few. "whole step" is transfer, pressure, moving, everything.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from peers.runner import (
    HOW_TO_GET,
    Bench,
    Result,
    Scene,
    label_of,
    machine,
    memory,
    middle,
    ratio,
    show,
    text_of,
    title,
)

from fluidlift.machine import cores


def dam(cells: int, block: tuple[int, int, int], **more: Any) -> Scene:
    """A cubic box of 1 m."""
    return {"cells": [cells] * 3, "block": list(block), "spacing": 1.0 / cells, **more}


def against_taichi(bench: Bench) -> None:
    """Transfers alone: sort, particles to grid, gravity, grid to particles, move."""
    rows = []
    for cells, block in ((64, (25, 20, 25)), (128, (25, 20, 25)), (64, (50, 25, 50)), (128, (50, 25, 50))):
        scene = dam(cells, block, frames=15, mode="transfer")
        best: dict[str, list[str]] = {}

        def taichi(grid: str, scene: Scene = scene, best: dict[str, list[str]] = best) -> Result:
            result = bench.run("taichi", "taichi_apic.py", scene | {"grid": grid} | (
                {"variants": best[grid]} if grid in best else {}
            ))  # fmt: skip
            if "variant" in result:
                best[grid] = [result["variant"].split()[-1]]
            return result

        runs = bench.rounds_of(
            {"ours": lambda s=scene: bench.ours(s), "mac": lambda: taichi("mac"), "nodal": lambda: taichi("nodal")}
        )
        for name, label in (("ours", "fluidlift"), ("mac", "Taichi"), ("nodal", "Taichi")):
            if name != "ours":
                bench.ahead(f"Taichi ({name} grid)", scene, runs[name], runs["ours"], "ms_step")
            rows.append([
                title(scene), label_of(label, runs[name]), text_of(runs[name], "variant"),
                show(middle(runs[name], "ms_step")), show(middle(runs[name], "cpu_ms_step")),
                "" if name == "ours" else ratio(runs[name], runs["ours"], "ms_step"),
            ])  # fmt: skip
    bench.table(
        "Affine transfers alone, per step", ["particles, box", "program", "how", "ms", "CPU ms", "ms over ours"], rows,
        "Taichi's figure is the fastest of its three ways to write the scatter.",
    )  # fmt: skip


def against_frames(
    bench: Bench, heading: str, scenes: list[tuple[Scene, dict[str, Callable[[Result], Result]], int]], notes: str = ""
) -> None:
    """Whole frames of ours and of peers. A peer gets our result of the round: it may take over the number of steps."""
    rows = []
    for scene, peers, rounds in scenes:
        last: dict[str, Result] = {}

        def our_turn(scene: Scene = scene, last: dict[str, Result] = last) -> Result:
            last["ours"] = bench.ours(scene | {"mode": "frames"})
            return last["ours"]

        turns = {"fluidlift": our_turn} | {n: (lambda go=go, last=last: go(last["ours"])) for n, go in peers.items()}
        runs = bench.rounds_of(turns, rounds)
        for name, results in runs.items():
            mine = name == "fluidlift"
            if not mine:
                bench.ahead(name, scene, results, runs["fluidlift"], "ms_frame")
            rows.append([
                title(scene), label_of(name, results), text_of(results, "variant"), show(middle(results, "ms_step")),
                show(middle(results, "cpu_ms_step")),
                show(middle(results, "steps_per_frame")), show(middle(results, "ms_frame")),
                "" if mine else ratio(results, runs["fluidlift"], "ms_step"),
                "" if mine else ratio(results, runs["fluidlift"], "ms_frame"),
                show((middle(results, "particles") or 0) / 1e3, ".0f"), show(middle(results, "mean_height"), ".3f"),
            ])  # fmt: skip
    columns = ["particles, box", "program", "how", "ms per step", "CPU ms per step", "steps per frame", "ms per frame",
               "step over ours", "frame over ours", "particles at the end, k", "mean height at the end, m"]  # fmt: skip
    bench.table(heading, columns, rows, notes)


def against_blender(bench: Bench) -> None:
    """Mantaflow at the same Courant number, by its affine and its FLIP transfer, and with Blender's default steps."""

    def mantaflow(scene: Scene, **how: Any) -> Callable[[Result], Result]:
        return lambda _ours: bench.run("blender", "blender_mantaflow.py", scene | how)

    small, large = dam(48, (25, 20, 25)), dam(96, (50, 40, 50))
    equal, default = {"courant": 1, "max_steps": 100}, {"courant": 4, "max_steps": 4}
    scenes = []
    for scene, rounds in ((small, bench.rounds), (large, 1)):
        rivals = {"Mantaflow, affine": mantaflow(scene, method="APIC", **equal)}
        if scene is small:  # on the fine grid a few fast particles drive it to half a hundred steps per frame
            rivals["Mantaflow, FLIP"] = mantaflow(scene, method="FLIP", **equal)
        scenes.append((scene | {"courant": 1.0}, rivals, rounds))
        rivals = {"Mantaflow, Blender's defaults": mantaflow(scene, method="FLIP", **default)}
        scenes.append((scene | {"courant": 4.0}, rivals, rounds))
    notes = (
        "Mantaflow resamples (8 to 16 particles per cell), solves for pressure to its own default tolerance, and is "
        "half a frame ahead: its first frame has felt gravity already."
    )
    against_frames(bench, "Whole frames next to Blender's Mantaflow", scenes, notes)


def against_phiflow(bench: Bench) -> None:
    """PhiFlow's FLIP example with as many steps per frame as ours took."""

    def phiflow(scene: Scene) -> Callable[[Result], Result]:
        return lambda ours: bench.run(
            "phiflow", "phiflow_flip.py", scene | {"steps": max(1, round(ours.get("steps_per_frame", 4)))}
        )

    small, large = dam(32, (12, 10, 12)), dam(64, (25, 20, 25))
    scenes = [(small, {"PhiFlow, FLIP": phiflow(small)}, bench.rounds), (large, {"PhiFlow, FLIP": phiflow(large)}, 1)]
    against_frames(bench, "Whole frames next to PhiFlow", scenes)


def own_steps(bench: Bench) -> None:
    """Where a step's time goes, and whether 100 000 particles reach five whole steps per second."""
    rows = []
    for cells, block in ((64, (25, 20, 25)), (128, (50, 25, 50))):
        scene = dam(cells, block)
        runs = bench.rounds_of({
            "transfers alone": lambda s=scene: bench.ours(s | {"mode": "transfer", "frames": 15}),
            "whole step, water": lambda s=scene: bench.ours(s | {"mode": "frames"}),
            "whole step, 0.01 m2/s": lambda s=scene: bench.ours(s | {"mode": "frames", "viscosity": 0.01}),
        })  # fmt: skip
        for name, results in runs.items():
            ms = middle(results, "ms_step")
            if ms and name == "whole step, water" and cells == 64:
                bench.judge("5 whole steps per second, 100 k particles", f"{1e3 / ms:.1f}", ms <= 200.0)
            rows.append([
                title(scene), name, show(ms), show(middle(results, "cpu_ms_step")), show(1e3 / ms if ms else None),
                show(middle(results, "steps_per_frame")),
                show(middle(results, "ms_frame")), show(middle(results, "iterations")), text_of(results, "error"),
            ])  # fmt: skip
    columns = ["particles, box", "what", "ms per step", "CPU ms per step", "steps per s", "steps per frame",
               "ms per frame", "pressure iterations", ""]  # fmt: skip
    bench.table("Our step", columns, rows)


def short_steps(scene: Scene) -> Scene:
    """Steps of 1/240 s: about one per report, for scaling."""
    return scene | {"mode": "frames", "frame": 1 / 240, "time_step": 1 / 240, "warm": 4, "frames": 6}


def scaling(bench: Bench) -> None:
    """Cost per particle from 10 k to 2 M, in boxes that the block fills to a sixteenth."""
    rows = []
    for side in (11, 23, 40, 50, 63):
        scene = short_steps({"cells": [round(2.5 * side)] * 3, "block": [side] * 3, "spacing": 1 / 64})
        results = [bench.ours(scene) for _ in range(bench.rounds if side < 40 else 1)]
        ms, n = middle(results, "ms_step"), 8 * side**3
        box = scene["cells"][0] ** 3
        rows.append([
            title(scene), show(ms), show(middle(results, "cpu_ms_step")), show(1e6 * ms / n if ms else None),
            show(8e6 * ms / n if ms else None),
            show(1e6 * ms / box if ms else None), show(middle(results, "iterations")),
            show(memory(results)), text_of(results, "error"),
        ])  # fmt: skip
    columns = ["particles, box", "ms per step", "CPU ms per step", "ns per particle", "ns per cell of the block",
               "ns per cell of the box", "pressure iterations", "MB above the loaded program", ""]  # fmt: skip
    bench.table("Scaling with the liquid", columns, rows)


def memory_per_particle(bench: Bench) -> None:
    """Peak memory against the number of particles in one box: the slope is the cost of a particle."""
    rows, before = [], None
    for block in ((25, 20, 25), (50, 25, 50), (50, 50, 50), (100, 50, 50)):
        scene = short_steps(dam(128, block)) | {"warm": 1, "frames": 2}
        peak, n = memory([bench.ours(scene)]), 8 * block[0] * block[1] * block[2]
        slope = None if before is None or peak is None else (peak - before[0]) / (n - before[1]) * 1e6 * 1.048576
        rows.append([title(scene), show(peak), show(slope)])
        before = None if peak is None else (peak, n)
    bench.table("Memory", ["particles, box", "MB above the loaded program", "bytes per further particle"], rows)


def threads(bench: Bench) -> None:
    """One thread, and twice as many as long as the machine has them."""
    counts = [1 << k for k in range(cores().bit_length())]
    rows = []
    for cells, block in ((64, (25, 20, 25)), (128, (50, 25, 50))):
        scene = short_steps(dam(cells, block))
        runs = bench.rounds_of({str(k): (lambda s=scene, k=k: bench.ours(s | {"threads": k})) for k in counts})
        for k in counts:
            both = [runs["1"], runs[str(k)]]
            rows.append([title(scene), str(k), show(middle(both[1], "ms_step")), ratio(*both, "ms_step"),
                         show(middle(both[1], "cpu_ms_step"))])  # fmt: skip
    bench.table("Threads", ["particles, box", "threads", "ms per step", "speed-up", "CPU ms per step"], rows)


def box_size(bench: Bench) -> None:
    """The same liquid in larger boxes at the same cell width: does the cost follow the liquid or the box?"""
    scenes = [short_steps({"cells": [n] * 3, "block": [25, 20, 25], "spacing": 1 / 64}) for n in (64, 96, 128)]
    runs = bench.rounds_of({title(s): (lambda s=s: bench.ours(s)) for s in scenes})
    base, rows = runs[title(scenes[0])], []
    for scene in scenes:
        results = runs[title(scene)]
        rows.append([
            title(scene), show(middle(results, "ms_step")), show(middle(results, "cpu_ms_step")),
            ratio(results, base, "ms_step"), show(memory(results)),
        ])  # fmt: skip
    columns = ["particles, box", "ms per step", "CPU ms per step", "over the smallest box",
               "MB above the loaded program"]  # fmt: skip
    bench.table("The same liquid in larger boxes", columns, rows)


SECTIONS: dict[str, Callable[[Bench], None]] = {
    "transfer": against_taichi, "blender": against_blender, "phiflow": against_phiflow, "step": own_steps,
    "size": scaling, "memory": memory_per_particle, "threads": threads, "box": box_size,
}  # fmt: skip


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", type=Path, default=Path("peers"), help="folder of the peers' environments")
    parser.add_argument("--frames", type=int, default=4, help="frames that count, after three that do not")
    parser.add_argument("--rounds", type=int, default=3, help="repetitions of what is not slow")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", nargs="*", choices=list(SECTIONS), help="sections to run")
    parser.add_argument("--output", type=Path, help="writes the tables here too, and every figure beside it as .json")
    given = parser.parse_args()
    bench = Bench(given.peers.absolute(), given.frames, given.rounds, given.threads)
    missing = [f"{name} is missing. Get it: {how.format(given.peers)}" for name, how in HOW_TO_GET.items()
               if name not in bench.peers]  # fmt: skip
    print("\n".join(missing), file=sys.stderr)
    bench.lines += [f"{machine()}; {given.threads} threads; medians of {given.rounds} rounds.", "", *missing, ""]
    for name in given.only or SECTIONS:
        print(name, file=sys.stderr, flush=True)
        SECTIONS[name](bench)
    if bench.verdicts:
        bench.table("Goals", ["goal", "got", "met"], bench.verdicts)
    bench.lines.append(f"At the end: {machine()}.")
    text = "\n".join(bench.lines) + "\n"
    print(text)
    if given.output:
        given.output.write_text(text, encoding="utf-8")
        given.output.with_suffix(".json").write_text(json.dumps(bench.log, indent=1), encoding="utf-8")
    return int(any(entry["peer"] == "ours" and "error" in entry["result"] for entry in bench.log))


if __name__ == "__main__":
    sys.exit(main())
