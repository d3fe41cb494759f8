"""Writes src/fluidlift/kernels.json: what the jobs of the package compile, stage by stage.

    python benchmarks/record_kernels.py        makes the four assets of tests/catalogue.py with an empty cache, and a
                                               small scene with white water (5 min)

Run it when kernels were added, renamed or called with other types. Only what Python calls is listed: what a kernel
calls is compiled with it.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


class Recorder:
    """Listens to Numba."""

    def __init__(self) -> None:
        self.asset, self.stage = "", "read"
        self.rows: dict[tuple[str, tuple[str, ...]], list[Any]] = {}
        self.of_demo: dict[tuple[str, tuple[str, ...]], bool] = {}
        self._began: list[float] = []

    def on_start(self, event: Any) -> None:
        """A compilation begins, perhaps within another."""
        self._began.append(time.process_time())

    def on_end(self, event: Any) -> None:
        """A compilation ended."""
        seconds = time.process_time() - self._began.pop()
        function = event.data["dispatcher"].py_func
        if not self._began and function.__module__.startswith("fluidlift.") and "<" not in function.__qualname__:
            name = f"{function.__module__}:{function.__qualname__}"
            types = tuple(repr(t) for t in event.data["args"])
            row = [self.stage, name, types, round(seconds, 2)]
            self.rows.setdefault((name, types), row)
            self.of_demo.setdefault((name, types), self.asset == "demo")


def _with_whitewater(place: Path) -> None:
    """A small channel whose film shows foam, into which fast water runs: no asset of the catalogue has white water.

    Args:
        place: folder for its film.
    """
    import numpy as np
    from small_scene import striped_channel

    from fluidlift.io.footage_file import write_footage
    from fluidlift.scene.simulator import simulator_of
    from fluidlift.scene.surface_appearance import SurfaceAppearance
    from fluidlift.scene.whitewater import SceneWhitewater, measured

    frames = np.full((16, 48, 64, 3), (40, 90, 120), np.uint8)
    for k, frame in enumerate(frames):
        for column in range(0, 64, 16):
            frame[10:22, (column + k) % 60 : (column + k) % 60 + 4] = (225, 232, 235)
    film = write_footage(place / "film.mp4", frames, np.ones(frames.shape[:3], bool), 0.04)
    lifted = striped_channel(5, film=film)
    fast = (lifted.body.positions[:, 0] > 0.3) & (lifted.body.positions[:, 0] < 0.7)
    moves = np.where(fast[:, None], np.float32([3.0, 0.0, 0.0]), lifted.body.velocities)
    scene = replace(lifted, body=replace(lifted.body, velocities=moves), whitewater=1.0, as_lifted=lifted)
    simulator, appearance = simulator_of(scene), SurfaceAppearance(scene, SceneWhitewater(scene, measured(lifted)))
    for k in range(5):
        if k:
            simulator.advance(scene.interval)
        appearance.advance(simulator.particles, k)
    appearance.dressed(simulator.particles, 4)


def main() -> int:
    """See the module."""
    with tempfile.TemporaryDirectory() as cache:
        os.environ["NUMBA_CACHE_DIR"] = cache
        sys.path.insert(0, str(ROOT / "tests"))
        from catalogue import RECIPES
        from numba.core import event

        from fluidlift import kernels
        from fluidlift.progress import PlainProgress

        # Numba must not be imported before its cache is named, so the listener becomes one here
        recorder = type("Listener", (Recorder, event.Listener), {})()
        event.register("numba:compile", recorder)
        begin = PlainProgress.stage

        def stage(self: PlainProgress, name: str, number: int, count: int) -> None:
            recorder.stage = name
            begin(self, name, number, count)

        PlainProgress.stage = stage  # type: ignore[method-assign]
        kernels.compiled = lambda: True  # nothing beside it
        for name in ("demo", *(n for n in RECIPES if n != "demo")):
            place = Path(cache) / "assets" / name
            place.mkdir(parents=True)
            recorder.asset = name
            RECIPES[name](place)
        recorder.asset, recorder.stage = "white water", "simulate"
        _with_whitewater(Path(cache))
        order = list(dict.fromkeys(row[0] for row in recorder.rows.values()))
        # what the demo, which is made first, does not call comes first: the process beside it begins at the end
        found = sorted(recorder.rows.items(), key=lambda item: (recorder.of_demo[item[0]], order.index(item[1][0])))
        rows = [row for _, row in found]
        kernels.LIST.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n", encoding="utf-8")
        print(f"{len(rows)} kernels, {sum(row[3] for row in rows):.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
