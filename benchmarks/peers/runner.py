"""Runs the scripts of this folder, each in a process of its own, and turns what they print into Markdown."""

from __future__ import annotations

import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

SCRIPTS = Path(__file__).resolve().parent
Result = dict[str, Any]
Scene = dict[str, Any]
HOW_TO_GET = {
    "taichi": "python -m venv {0}/taichi && {0}/taichi/bin/pip install taichi==1.7.4",
    "phiflow": "python -m venv {0}/phiflow && {0}/phiflow/bin/pip install phiflow 'jax[cpu]'",
    "blender": "apt-get install blender, or unpack a release and link its program to {0}/blender",
}


def title(scene: Scene) -> str:
    """Particles and box, as a table names them."""
    b = scene["block"]
    n = 8 * b[0] * b[1] * b[2]
    count = f"{n / 1e6:.3g} M" if n >= 1e6 else f"{n / 1e3:.4g} k"
    return f"{count}, {'x'.join(map(str, scene['cells']))}"


def programs(folder: Path) -> dict[str, list[str]]:
    """Peer -> command that runs its scripts; peers that are not there are left out."""
    found = {}
    for name in ("taichi", "phiflow"):
        if (folder / name / "bin" / "python").exists():
            found[name] = [str(folder / name / "bin" / "python")]
    blender = next((str(p) for p in (folder / "blender", folder / "blender" / "blender") if p.is_file()), None)
    blender = blender or shutil.which("blender")
    if blender:
        found["blender"] = [blender, "-b", "--factory-startup", "-t", "{threads}", "-P"]
    return found


class Bench:
    """Runs scripts and collects what they print."""

    def __init__(self, folder: Path, frames: int, rounds: int, threads: int) -> None:
        self.peers, self.folder = programs(folder), folder
        self.frames, self.rounds, self.threads = frames, rounds, threads
        self.log: list[Result] = []
        self.lines: list[str] = []
        self.verdicts: list[list[str]] = []

    def run(self, peer: str, script: str, scene: Scene) -> Result:
        """One measurement in a process of its own; {"error": ...} where it fails or the peer is missing."""
        command = [sys.executable] if peer == "ours" else self.peers.get(peer)
        if command is None:
            return {"error": "missing"}
        threads = str(scene.get("threads", self.threads))
        scene = {"frames": self.frames, "warm": 3, "threads": int(threads), **scene}
        command = [part.format(threads=threads) for part in command] + [str(SCRIPTS / script)]
        command += (["--"] if peer == "blender" else []) + [json.dumps(scene)]
        env = dict(os.environ, NUMBA_NUM_THREADS=threads, OMP_NUM_THREADS=threads, OPENBLAS_NUM_THREADS=threads)
        if peer != "ours":
            env.pop("PYTHONPATH", None)
        done = subprocess.run(command, env=env, capture_output=True, text=True)
        found = [line for line in done.stdout.splitlines() if line.startswith("{")]
        if not found:
            last = (done.stderr.strip() or done.stdout.strip() or f"exit code {done.returncode}").splitlines()[-1]
            result = {"error": last[:160]}
        else:
            result = json.loads(found[-1])
        self.log.append({"peer": peer, "script": script, "scene": scene, "result": result})
        print(f"  {peer:8} {title(scene):20} {brief(result)}", file=sys.stderr, flush=True)
        return result

    def rounds_of(self, runs: dict[str, Callable[[], Result]], rounds: int | None = None) -> dict[str, list[Result]]:
        """Each of the runs once per round; one that failed is not tried again."""
        out: dict[str, list[Result]] = {name: [] for name in runs}
        for _ in range(rounds or self.rounds):
            for name, go in runs.items():
                if not (out[name] and "error" in out[name][0]):
                    out[name].append(go())
        return out

    def table(self, heading: str, columns: list[str], rows: list[list[str]], notes: str = "") -> None:
        """Adds a Markdown table."""
        self.lines += [f"### {heading}", ""]
        self.lines += ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
        self.lines += ["| " + " | ".join(row) + " |" for row in rows] + [""]
        self.lines += [notes, ""] if notes else []

    def judge(self, goal: str, got: str, met: bool) -> None:
        """Adds a line to the table of goals."""
        self.verdicts.append([goal, got, "yes" if met else "no"])

    def ahead(self, peer: str, scene: Scene, peers: list[Result], ours: list[Result], key: str) -> None:
        """Judges whether ours is faster, by the median ratio of a round."""
        times = ratio(peers, ours, key)
        if times:
            unit = "frame" if key == "ms_frame" else "step"
            self.judge(f"ahead of {peer} per {unit}, {title(scene)}", f"{times} times", float(times) > 1.0)

    def ours(self, scene: Scene) -> Result:
        """The simulator's own figures; `scene["mode"]` says of what."""
        return self.run("ours", "ours.py", scene)


def brief(result: Result) -> str:
    """The main figures of a result in one line."""
    keys = ("ms_step", "ms_frame", "steps_per_frame", "particles", "variant", "error")
    return ", ".join(
        f"{k} {result[k]:.4g}" if isinstance(result[k], float) else f"{result[k]}" for k in keys if k in result
    )


def middle(results: list[Result], key: str) -> float | None:
    """The median over rounds."""
    values = [r[key] for r in results if key in r]
    return statistics.median(values) if values else None


def ratio(peer: list[Result], ours: list[Result], key: str) -> str:
    """Peer over ours, the median over rounds."""
    values = [p[key] / o[key] for p, o in zip(peer, ours) if key in p and key in o]
    return f"{statistics.median(values):.2f}" if values else ""


def show(value: float | None, form: str = ".3g") -> str:
    """A figure, or a dash."""
    if value is None:
        return "-"
    return f"{value:.0f}" if form == ".3g" and abs(value) >= 100 else f"{value:{form}}"


def text_of(results: list[Result], key: str) -> str:
    """A text that is the same in every round, or the error."""
    return str(results[0].get(key, results[0].get("error", ""))) if results else ""


def label_of(name: str, results: list[Result]) -> str:
    """A program with its version."""
    version = results[0].get("version", "") if results else ""
    return f"{name} ({version})" if version else name


def memory(results: list[Result]) -> float | None:
    """MB at the peak beyond what the loaded and warmed-up program takes."""
    values = [r["peak_mb"] - r["loaded_mb"] for r in results if "peak_mb" in r]
    return statistics.median(values) if values else None


def machine() -> str:
    """Processor, cores, load."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        found = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        name = found[0] if found else name
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return f"{name}, {os.cpu_count()} cores{load}"
