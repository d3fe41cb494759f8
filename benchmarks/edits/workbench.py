"""What these edits share: an asset to work on, pictures, and checks that are counted."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy import ndimage

from fluidlift.config import build_config
from fluidlift.io.asset_folder import load_asset, read_manifest, save_asset
from fluidlift.io.kept_values import last_value
from fluidlift.physics.transfer import particles_to_grid, sort_by_cell
from fluidlift.pipeline import Inputs, RenderRequest, make, render_asset, resimulate
from fluidlift.scene import EditSession, SimulationRequest
from fluidlift.scene.coarse_copy import coarser
from fluidlift.scene.footage import Footage
from fluidlift.scene.recall import footage_of_asset
from fluidlift.scene.splat_files import frame_file, read_frame
from fluidlift.synthetic.demo import demo_clip
from fluidlift.types import FluidAsset, Grid, Particles
from fluidlift.types.stages import Simulation

FIRST = 1001
WIDTH = 640
"""px, of the pictures"""


@dataclass
class Bench:
    """A copy of an asset, the place for pictures, and how the checks went."""

    folder: Path
    out: Path
    frames: int | None
    dry: bool
    failed: list[str] = field(default_factory=list)
    began: float = field(default_factory=time.perf_counter)

    @property
    def asset(self) -> FluidAsset:
        """As it lies on disk."""
        return load_asset(self.folder)

    def edited(self, session: EditSession) -> None:
        """Show an edit; with `--dry` this is all."""
        print(session.diff())
        if self.dry:
            print(f"stale: {', '.join(sorted(session.stale())) or 'nothing'}")
            sys.exit(0)

    def simulate(self, seconds: float | None = None, *, preview: bool = True) -> None:
        """The scene as it is edited now; `--frames` shortens it."""
        interval = self.asset.interval
        if self.frames is not None:
            longest = (self.frames + 0.01) * interval
            seconds = longest if seconds is None else min(seconds, longest)
        began = time.perf_counter()
        made = resimulate(self.folder, request=SimulationRequest(duration=seconds), overrides=[
            "show.usd=false", f"show.preview={str(preview).lower()}"
        ])  # fmt: skip
        told = ", with the preview" * preview
        print(f"simulated: {made.frames} frames in {time.perf_counter() - began:.0f} s{told}")

    @property
    def count(self) -> int:
        """Frames that were simulated."""
        return read_manifest(self.folder)["simulation"]["frames"]

    def picture(self, name: str, view: str = "side", frame: int | None = None, **told) -> Path:
        """A frame (counted from 0; the last one) as PNG, named after the example."""
        number = FIRST + (self.count - 1 if frame is None else frame)
        width, height = self.asset.camera.size
        size = (WIDTH, 2 * round(0.5 * WIDTH * height / width))
        request = RenderRequest(view=view, frames=(number, number), size=size, background="terrain", **told)
        made = render_asset(self.folder, self.out / "frame", request)
        path = self.out / f"{name}.png"
        shutil.move(made.folder / f"{number}.png", path)
        shutil.rmtree(self.out / "frame")
        print(f"picture: {path}")
        return path

    def film(self, name: str, view: str = "side", **told) -> Path:
        """All frames as MP4."""
        path = self.out / f"{name}.mp4"
        render_asset(self.folder, path, RenderRequest(view=view, background="terrain", **told))
        print(f"film: {path}")
        return path

    def history(self) -> Simulation:
        """Figures of every simulated frame: volume (m^3), leak (share of particles inside solids), count, poses."""
        found = last_value(self.folder, "simulate", Simulation)
        assert found is not None, "the simulation's figures are gone"
        return found

    def footage(self) -> Footage | None:
        """The clip as `make` read it, with its mask; None where work/ is gone."""
        return footage_of_asset(self.folder, read_manifest(self.folder))

    def splats(self, number: int):
        """Gaussians and velocities [n,3] (m/s) of the particles of a frame, without the skin over them (odd ids)."""
        found = read_frame(frame_file(self.folder, number))
        particles = found.ids % 2 == 0
        return found.gaussians.select(particles), found.velocities[particles]

    def all_splats(self, number: int):
        """Gaussians of a frame as they are drawn, the skin among them."""
        return read_frame(frame_file(self.folder, number)).gaussians

    def last(self):
        """Those of the last frame."""
        return self.splats(FIRST + self.count - 1)

    def check(self, what: str, passed: bool, measured: str) -> None:
        """One line per check."""
        print(f"{'ok    ' if passed else 'FAILED'} {what}: {measured}")
        if not passed:
            self.failed.append(what)

    def solids_stay_dry(self, most: float = 0.001) -> None:
        """No particles inside the terrain, at any time.

        Each step ends with pushing particles out of the ground. A particle counts as inside from a tenth of a cell on;
        one in a thousand is left for clefts narrower than a cell, which the grid cannot tell from solid.
        """
        leak = float(self.history().leak.max())
        self.check("nothing inside solids", leak <= most, f"{100 * leak:.3f} % of the particles at worst")

    def volume_kept(self, most: float) -> None:
        """The volume stays near that of the first frame: what flows in flows out. The bound is each example's own."""
        volume = self.history().volume
        drift = float(np.abs(volume / volume[0] - 1).max())
        self.check("volume kept", drift <= most, f"{100 * drift:.1f} % from the first frame at worst")

    def divergence_free(self, most: float = 0.03) -> None:
        """What flows into a cell flows out of it, from the last frame's splats alone.

        Their velocities are brought to a grid again and looked at inside the liquid, where all cells around hold
        particles too. The velocity that moved them has no divergence (the solver's tolerance is 1e-5); on the way
        through the particles about 1 % of the mean speed per cell comes back, as measured on the demo. A field with
        these differences between neighbouring faces in each direction that did not cancel would have 4 to 6 %.
        """
        grid = self.simulated_grid()
        fluid, velocities = self.last()
        points = fluid.means
        there = grid.contains(points)
        body = Particles.at_rest(points[there], 1.0, np.flatnonzero(there), velocities[there])
        order = sort_by_cell(body.positions, grid)
        velocity, _ = particles_to_grid(body, grid, order)
        count = np.diff(order.start).reshape(grid.shape)
        inner = ndimage.binary_erosion(count >= 4, np.ones((3, 3, 3)))
        speed = float(np.linalg.norm(velocities, axis=1).mean())
        change = sum(np.diff(c, axis=a) for a, c in enumerate(velocity.components))
        left = float(np.abs(change[inner]).mean()) / speed if inner.any() else 0.0
        self.check(
            "divergence", left <= most, f"{100 * left:.1f} % of the mean speed per cell, in {inner.sum()} inner cells"
        )

    def simulated_grid(self) -> Grid:
        """Of the frames on disk."""
        found = read_manifest(self.folder)["simulation"]["grid"]
        return Grid(tuple(found["shape"]), found["spacing"], tuple(found["origin"]))

    def done(self) -> int:
        """The exit code."""
        print(f"{len(self.failed)} checks failed" if self.failed else "all checks passed", end="")
        print(f", {time.perf_counter() - self.began:.0f} s in all")
        return int(bool(self.failed))


def places(values) -> list[float]:
    """Numbers as a person would write them: to the millimetre."""
    return [round(float(v), 3) for v in values]


def bench(name: str, description: str | None) -> Bench:
    """Read the options, copy the asset, or make the demo's."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--asset", type=Path, help="a finished asset of a stream; by default the demo's is made")
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the copy and the pictures")
    parser.add_argument("--frames", type=int, help="at most so many")
    parser.add_argument(
        "--coarse", action="store_true", help="on cells twice as wide, with an eighth of the splats: ten times as fast"
    )
    parser.add_argument("--dry", action="store_true", help="make the edit and show it, but do not simulate")
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
    if a.coarse:
        save_asset(folder, coarser(load_asset(folder)))
    return Bench(folder, a.out, a.frames, a.dry)


def end(made: Bench) -> None:
    """Leave with the exit code."""
    sys.exit(made.done())
