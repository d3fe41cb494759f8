"""What the examples share: an asset to work on, pictures, and checks that are counted."""

from __future__ import annotations

import argparse
import shutil
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fluidlift.config import build_config
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.ply import read_splats
from fluidlift.io.stage_cache import load_stage, owner_of
from fluidlift.pipeline import Inputs, RenderRequest, SimulationRequest, make, render_asset, resimulate
from fluidlift.synthetic.demo import demo_clip

FIRST = 1001


@dataclass
class Bench:
    """A copy of an asset, the place for pictures, and how the checks went."""

    folder: Path
    out: Path
    frames: int | None
    failed: list[str] = field(default_factory=list)

    def simulate(self, seconds: float | None = None) -> None:
        """The scene as it is edited now; `--frames` shortens it."""
        interval = load_asset(self.folder).interval
        if self.frames is not None:
            longest = (self.frames + 0.01) * interval
            seconds = longest if seconds is None else min(seconds, longest)
        resimulate(self.folder, request=SimulationRequest(duration=seconds), overrides=["show.usd=false"])

    def picture(self, name: str, view: str = "side", **told) -> Path:
        """The last frame as PNG, named after the example."""
        number = FIRST + read_manifest(self.folder)["simulation"]["frames"] - 1
        request = RenderRequest(view=view, frames=(number, number), **told)
        made = render_asset(self.folder, self.out / "frame", request)
        path = self.out / f"{name}.png"
        shutil.move(made.folder / f"{number}.png", path)
        shutil.rmtree(self.out / "frame")
        print(f"picture: {path}")
        return path

    def film(self, name: str, view: str = "side", **told) -> Path:
        """All frames as MP4."""
        path = self.out / f"{name}.mp4"
        render_asset(self.folder, path, RenderRequest(view=view, **told))
        print(f"film: {path}")
        return path

    def history(self) -> dict[str, np.ndarray]:
        """Figures of every simulated frame: volume (m^3), leak (share of particles inside solids), count, poses."""
        key = owner_of(self.folder, "simulate")
        found = None if key is None else load_stage(self.folder, "simulate", key)
        assert found is not None, "the simulation's figures are gone"
        return found[0]

    def splats(self, number: int):
        """Positions [n,3] and velocities [n,3] of a frame."""
        found = read_splats(self.folder / "frames" / "splats" / f"{number}.ply")
        return found.gaussians, np.stack([found.extras[v] for v in ("vx", "vy", "vz")], axis=-1)

    def last(self):
        """Those of the last frame."""
        return self.splats(FIRST + read_manifest(self.folder)["simulation"]["frames"] - 1)

    def check(self, what: str, passed: bool, measured: str) -> None:
        """One line per check."""
        print(f"{'ok    ' if passed else 'FAILED'} {what}: {measured}")
        if not passed:
            self.failed.append(what)

    def solids_stay_dry(self, most: float = 0.01) -> None:
        """Few particles inside the terrain at any time."""
        leak = float(self.history()["leak"].max())
        self.check("nothing inside solids", leak <= most, f"{100 * leak:.2f} % of the particles at worst")

    def volume_kept(self, most: float = 0.25) -> None:
        """The volume stays near that of the first frame: what flows in flows out."""
        volume = self.history()["volume"]
        drift = float(np.abs(volume / volume[0] - 1).max())
        self.check("volume kept", drift <= most, f"{100 * drift:.1f} % from the first frame at worst")

    def done(self) -> int:
        """The exit code."""
        print(f"{len(self.failed)} checks failed" if self.failed else "all checks passed")
        return int(bool(self.failed))


def bench(name: str, description: str | None) -> Bench:
    """Read the options, copy the asset, or make the demo's."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--asset", type=Path, help="a finished asset of a stream; by default the demo's is made")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the copy and the pictures")
    parser.add_argument("--frames", type=int, help="at most so many")
    a = parser.parse_args()
    a.out.mkdir(parents=True, exist_ok=True)
    source = a.asset
    if source is None:
        source = a.out / "demo.fluid"
        clip = demo_clip()
        make(Inputs(clip, camera=clip.with_name("demo_camera.json")), source, build_config("draft"))
    folder = a.out / f"{name}.fluid"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(source, folder)
    return Bench(folder, a.out, a.frames)


def end(made: Bench) -> None:
    """Leave with the exit code."""
    sys.exit(made.done())
