"""How many stops journeys through the code make: of an edit until particles exist, of a picture until Gaussians do.

    python benchmarks/journeys.py            # makes a small asset first, some minutes
    PYTHONPATH=OTHER/src python benchmarks/journeys.py --asset ASSET.fluid    # of another checkout, its own asset

A stop is a function of fluidlift that is entered from another module, counted once however often it is called: where
somebody has to look who follows the journey by reading. It is a return where its module was visited before. The number
of times that control passes from one module to another is told beside it; it grows with loops.

Each journey is followed through all of fluidlift, and through `pipeline` alone, where the stages are wired up. The edit
goes once through the files of an asset (`fluidlift sim`), and once as a value, with the asset at hand (the viewer, or
somebody's program).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np

import fluidlift
from fluidlift.config import build_config
from fluidlift.io.video import write_video

ROOT = Path(fluidlift.__file__).parent
QUICK = ("shape.cells=16", "shape.refine_iterations=1", "motion.targets=1", "fit.max_seconds=5", "simulate.frames=3")


class Arrived(BaseException):
    """The end of a journey; no error of fluidlift's, so that nothing catches it."""


@dataclass
class Traveller:
    """Follows calls until a function of some module returns.

    Args:
        inside: names of modules begin so.
        until: name of the function, and how its module's name ends in any version of the code.
    """

    inside: str
    until: tuple[str, tuple[str, ...]]
    stops: list[str] = field(default_factory=list)
    visited: set[str] = field(default_factory=set)
    returns: int = 0
    passes: int = 0
    _stack: list[str] = field(default_factory=list)
    _seen: set[CodeType] = field(default_factory=set)

    def follow(self, journey: Callable[[], Any]) -> None:
        """Make the journey."""
        sys.setprofile(self._event)
        try:
            journey()
        except Arrived:
            return
        finally:
            sys.setprofile(None)
        raise SystemExit(f"the journey never came to {self.until[0]}")

    def _event(self, frame: FrameType, event: str, _: Any) -> None:
        if event not in ("call", "return"):
            return
        code, module = frame.f_code, _module(frame.f_code)
        if module is None or code.co_name in ("<module>", "<lambda>", "<genexpr>", "<listcomp>", "<dictcomp>"):
            return
        if event == "call":
            before = self._stack[-1] if self._stack else ""
            self._stack.append(module)
            if module != before and module.startswith(self.inside):
                self._stop(code, module)
        else:
            if self._stack:
                self._stack.pop()
            name, modules = self.until
            if code.co_name == name and module.endswith(modules):
                raise Arrived

    def _stop(self, code: CodeType, module: str) -> None:
        self.passes += 1
        if code in self._seen:
            return
        self._seen.add(code)
        self.stops.append(f"{module}.{code.co_name}")
        self.returns += module in self.visited
        self.visited.add(module)


def _module(code: CodeType) -> str | None:
    """The module of some code of fluidlift, by its path below the package; None of others."""
    path = code.co_filename
    return path[len(str(ROOT)) + 1 : -3].replace("/", ".") if path.startswith(str(ROOT)) else None


EDIT = ("simulator_of", ("pipeline.simulating", "pipeline.simulator"))
PICTURE = ("refine", ("pipeline.refining", "pipeline.stages.refine"))


def small_clip(path: Path) -> Path:
    """Striped water that runs to the right between banks, 8 frames of 96 x 64 px."""
    rng = np.random.default_rng(0)
    ground = rng.integers(80, 140, (64, 96, 3))
    water = np.kron(rng.integers(40, 220, (64, 60, 1)), np.ones((1, 2, 3), int))
    frames = []
    for t in range(8):
        picture = ground.copy()
        picture[20:48] = water[20:48, 2 * (8 - t) : 2 * (8 - t) + 96]
        frames.append(picture.astype(np.uint8))
    return write_video(path, np.stack(frames), 25.0, repeatable=True)


def journeys(folder: Path, asset: Path | None, show: bool) -> list[str]:
    """Rows of the table."""
    from fluidlift import pipeline
    from fluidlift.io.asset_folder import load_asset
    from fluidlift.io.scene import SceneEdits
    from fluidlift.pipeline import EditSession, Inputs, make, resimulate

    clip, config = small_clip(folder / "clip.mp4"), build_config("draft", None, QUICK, {"shape.size": 2.0})
    if asset is None:
        asset = folder / "asset.fluid"
        make(Inputs(clip), asset, config)
    EditSession.open(asset).set("parameters.kinematic_viscosity", 0.001)
    lifted, edits = load_asset(asset), SceneEdits(parameters={"kinematic_viscosity": 0.001})
    rows = []
    for number, (inside, where) in enumerate((("", "fluidlift"), ("pipeline.", "pipeline alone"))):
        fresh = folder / f"{number}.fluid"
        for title, until, journey in (
            ("an edit until particles exist", EDIT, lambda: resimulate(asset)),
            (
                "an edit as a value until particles exist",
                EDIT,
                lambda: pipeline.simulator_of(pipeline.edited_scene(lifted, edits)),
            ),
            ("a picture until Gaussians exist", PICTURE, lambda fresh=fresh: make(Inputs(clip), fresh, config)),
        ):
            if "value" in title and not hasattr(pipeline, "edited_scene"):
                continue  # code in which values do not travel
            found = Traveller(inside, until)
            found.follow(journey)
            rows.append(
                f"{title}, {where}: {len(found.stops)} stops in {len(found.visited)} modules, {found.returns} of them "
                f"returns; control passes {found.passes} times"
            )
            if show:
                rows += [f"    {stop}" for stop in found.stops]
    return rows


def main() -> None:
    """Print both journeys."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--asset", type=Path, help="with the work/ of this checkout; its scene.yaml is edited")
    parser.add_argument("--show", action="store_true", help="every stop")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        print("\n".join(journeys(Path(folder), options.asset, options.show)))


if __name__ == "__main__":
    main()
