"""The dam break in Blender's Mantaflow; prints one line of JSON. Needs the program `blender` (2.9 or newer).

    blender -b --factory-startup -t 2 -P benchmarks/peers/blender_mantaflow.py -- \\
        '{"cells": [48, 48, 48], "block": [25, 20, 25], "spacing": 0.02, "courant": 1, "max_steps": 100}'

A liquid domain without mesh, spray or viscosity, replayed frame by frame (24 per second). Blender counts one layer of
cells on each side as wall, so the domain has two cells more than the scene along each axis. Eight particles per cell
(2^3, between 8 and 16 kept by its own resampling), the narrow band off ("band" null): otherwise Blender drops the
particles deeper than three cells. The first frame has felt gravity already: Mantaflow is half a frame ahead.
"method": FLIP or APIC. What is timed: the whole frame, and the solver's own step inside it (without Blender's cache
files and its scene graph), which is the figure that counts.
"""

from __future__ import annotations

import gzip
import json
import math
import resource
import shutil
import struct
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import bpy

FRAME_RATE = 24


def add_box(name: str, low: list[float], high: list[float]) -> Any:
    """A closed box mesh."""
    bpy.ops.mesh.primitive_cube_add(size=1.0)
    box = bpy.context.object
    box.name = name
    box.location = [(a + b) / 2 for a, b in zip(low, high)]
    box.scale = [b - a for a, b in zip(low, high)]
    bpy.ops.object.transform_apply(location=False, rotation=False, scale=True)
    return box


def build_scene(scene: dict[str, Any], cache: str) -> Any:
    """The domain's settings."""
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    h = scene["spacing"]
    domain = add_box("domain", [-h] * 3, [(n + 1) * h for n in scene["cells"]])
    modifier = domain.modifiers.new("fluid", "FLUID")
    modifier.fluid_type = "DOMAIN"
    settings = modifier.domain_settings
    settings.domain_type = "LIQUID"
    settings.resolution_max = max(scene["cells"]) + 2
    settings.simulation_method = scene.get("method", "FLIP")
    settings.use_adaptive_timesteps = True
    settings.cfl_condition = scene["courant"]
    settings.timesteps_min, settings.timesteps_max = 1, scene["max_steps"]
    settings.particle_number, settings.particle_min, settings.particle_max = 2, 8, 16
    settings.particle_randomness = 0.1
    settings.particle_band_width = scene.get("band") or 1000.0
    settings.use_mesh = False
    settings.cache_type, settings.cache_data_format = "REPLAY", "UNI"
    settings.cache_directory = cache
    settings.cache_frame_end = bpy.context.scene.frame_end = scene["warm"] + scene["frames"] + 1
    bpy.context.scene.render.fps = FRAME_RATE
    # slightly beyond the walls: the block touches them
    block = add_box("block", [-h / 2] * 3, [n * h for n in scene["block"]])
    modifier = block.modifiers.new("fluid", "FLUID")
    modifier.fluid_type = "FLOW"
    modifier.flow_settings.flow_type = "LIQUID"
    modifier.flow_settings.flow_behavior = "GEOMETRY"
    return settings


class StepWatch:
    """Counts and times the solver's steps: wraps the function that Blender's Mantaflow calls for each of them."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self.busy: list[float] = []
        self._names: set[str] = set()

    def attach(self) -> None:
        """Call it once the solver exists, after the first frame."""
        for module in list(sys.modules.values()):
            names = vars(module) if hasattr(module, "__dict__") else {}
            for name in [n for n in names if n.startswith("liquid_adaptive_step_")]:
                if not hasattr(names[name], "watched"):
                    setattr(module, name, self._wrapped(names[name]))
                    self._names.add(name)

    def _wrapped(self, function: Any) -> Any:
        def watched(*args: Any) -> None:
            began, busy = time.perf_counter(), time.process_time()
            function(*args)
            self.seconds.append(time.perf_counter() - began)
            self.busy.append(time.process_time() - busy)

        watched.watched = True
        return watched


def particles_of(cache: str, frame: int) -> tuple[int, float, float]:
    """Number, mean height (cells) and 99th percentile of x (cells) in a frame's cache file; walls included."""
    raw = gzip.decompress((Path(cache) / "data" / f"pp_{frame:04d}.uni").read_bytes())
    count, size = struct.unpack("<i", raw[4:8])[0], 16  # x, y, z, flag
    begin = len(raw) - count * size
    values = struct.unpack(f"<{count * 4}f", raw[begin:])
    x = sorted(values[0::4])
    return count, math.fsum(values[2::4]) / count, x[int(0.99 * count)]


def measure(scene: dict[str, Any]) -> dict[str, Any]:
    """Wall time of frames of 1/24 s after the first few."""
    cache = tempfile.mkdtemp(prefix="mantaflow-")
    build_scene(scene, cache)
    watch, times, steps, inside = StepWatch(), [], [], []
    try:
        # frame 1 holds the block, as the others count from rest
        for frame in range(1, scene["warm"] + scene["frames"] + 2):
            before = len(watch.seconds)
            began = time.perf_counter()
            bpy.context.scene.frame_set(frame)
            times.append(time.perf_counter() - began)
            steps.append(len(watch.seconds) - before)
            inside.append(sum(watch.seconds[before:]))
            watch.attach()
        count, height, front = particles_of(cache, scene["warm"] + scene["frames"] + 1)
        first, _, _ = particles_of(cache, 1)
    finally:
        shutil.rmtree(cache, ignore_errors=True)
    kept = slice(scene["warm"] + 1, None)
    frames, total = scene["frames"], sum(steps[kept])
    busy = sum(watch.busy[len(watch.busy) - total :])
    h = scene["spacing"]
    return {
        "ms_frame": 1e3 * sum(inside[kept]) / frames, "ms_step": 1e3 * sum(inside[kept]) / max(total, 1),
        "cpu_ms_step": 1e3 * busy / max(total, 1),
        "ms_frame_with_cache": 1e3 * sum(times[kept]) / frames, "steps_per_frame": total / frames,
        "particles": count, "first_particles": first, "front": (front - 1) * h, "mean_height": (height - 1) * h,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        "variant": f"{scene.get('method', 'FLIP')}, courant {scene['courant']:g}, at most {scene['max_steps']} steps",
        "version": "Blender " + bpy.app.version_string,
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(measure(json.loads(sys.argv[sys.argv.index("--") + 1]))))
