"""Volume velocity of the demo's clip: as the video says, of random parameters, of the L2 loss, of the full loss."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from benchmarks.paper.tiles import Tile, arrows, coloured, sheet
from benchmarks.paper.workshop import FIRST, Workshop, frames_of

from fluidlift.evaluate.volumes import field_cosine, relative_l2
from fluidlift.fit.loss import VelocityLossWeights
from fluidlift.fit.optimize import fit_parameters
from fluidlift.io.asset_folder import load_asset
from fluidlift.io.kept_values import last_value
from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import RolloutParameters, flatten, rollout, unflatten
from fluidlift.physics.rollout_domain import prepare_domain
from fluidlift.pipeline import resimulate
from fluidlift.pipeline.stages.fit import prior_widths
from fluidlift.scene import EditSession
from fluidlift.scene.edits import Set
from fluidlift.scene.splat_files import frame_file, read_frame
from fluidlift.types import CellType, FaceVelocity, FluidParameters, kind_of
from fluidlift.types.stages import Simulation

AHEAD = 6
"""frames that are rolled out from the first target"""
STARTS = 3
"""of the fit, from arbitrary values"""
FREE = (
    "gravity", "kinematic_viscosity", "inflow_velocity", "inflow_fluctuation", "outflow_velocity",
)  # fmt: skip
"""those that the pipeline fits to a stream"""


def random_parameters(start: FluidParameters, rng: np.random.Generator) -> FluidParameters:
    """Plausible scales, arbitrary values: speeds half to twice, viscosity over two decades, gravity 15 degrees off."""

    def around(value: float, decades: float) -> float:
        return value * 10 ** rng.uniform(-decades, decades)

    down, turn = np.asarray(start.gravity), rng.standard_normal(3)
    aside = np.cross(turn / np.linalg.norm(turn), [0.0, 0.0, 1.0])
    gravity = down + np.tan(np.radians(15)) * np.linalg.norm(down) * aside
    pace = around(1.0, 0.3)
    return replace(
        start, kinematic_viscosity=around(start.kinematic_viscosity, 1.0), gravity=tuple(float(g) for g in gravity),
        inflow_velocity=tuple(pace * v for v in start.inflow_velocity),
        outflow_velocity=around(start.outflow_velocity, 0.3), wall_damping=float(rng.uniform(0, 1)),
        restitution=float(rng.uniform(0, 0.5)),
    )  # fmt: skip


class Clip:
    """What a fit of the demo has: targets, layout, and a way to roll parameters out."""

    def __init__(self, shop: Workshop) -> None:
        self.asset = load_asset(shop.asset("demo"))
        self.geometry, self.motion = (shop.stage(shop.asset("demo"), n) for n in ("geometry", "motion"))
        self.found = shop.stage(shop.asset("demo"), "fit")
        setting = self.geometry.setting
        self.cells, self.terrain, self.grid = setting.cell_types, setting.terrain, setting.terrain.grid
        system = build_system(self.cells, self.terrain, self.grid)
        self.domain = prepare_domain(self.cells, system, mainstream=self.terrain.mainstream, sweeps=5)
        self.wet = self.cells == CellType.FLUID

    def fitted(self, start: FluidParameters, weights: VelocityLossWeights | None, restarts: int = 1):
        """As the pipeline fits, with other weights or from another start."""
        return fit_parameters(
            self.motion.velocities, self.cells, self.terrain, self.grid, self.asset.interval, start,
            kind=self.geometry.kind, mainstream=self.terrain.mainstream, free=FREE, weights=weights,
            prior_sigmas=prior_widths(kind_of(self.geometry.kind)), max_work=1e9, max_seconds=240.0, restarts=restarts,
        )  # fmt: skip

    def simulated(self, parameters: FluidParameters) -> list[FaceVelocity]:
        """Velocity of each frame after the first target."""
        steps = max(int(np.ceil(self.asset.interval / parameters.time_step)), 2)
        known = RolloutParameters.of(replace(parameters, time_step=self.asset.interval / steps))
        now, out = flatten(self.motion.velocities[0]), []
        with torch.no_grad():
            for _ in range(min(AHEAD, len(self.motion.velocities) - 1)):
                now = rollout(now, self.domain, known, steps=steps).velocity
                out.append(FaceVelocity(*(c.numpy().copy() for c in unflatten(now, self.domain))))
        return out

    def misfit(self, frames: Sequence[FaceVelocity]) -> tuple[float | None, float | None]:
        """Relative L2 and cosine against the video's velocity in the cells of the fluid."""
        a = np.concatenate([f.at_centers()[self.wet] for f in frames]).astype(float)
        b = np.concatenate([f.at_centers()[self.wet] for f in self.motion.velocities[1 : len(frames) + 1]]).astype(
            float
        )
        return relative_l2(a, b), field_cosine(a, b)


def four_fields(shop: Workshop) -> None:
    """Fig. 3dvcomp on a clip, with the particles of random parameters over their bed."""
    clip, rng = Clip(shop), np.random.default_rng(5)
    start = clip.found.initial
    draws = [random_parameters(start, rng) for _ in range(5)]
    rolled = [clip.simulated(p) for p in draws]
    middle = int(np.argsort([clip.misfit(r)[0] or 0.0 for r in rolled])[2])
    weights = {"L2 alone": VelocityLossWeights(direction=0.0), "full loss": None}
    fits = {name: clip.fitted(start, w).parameters for name, w in weights.items()}
    fields = {"video": clip.motion.velocities[1 : AHEAD + 1], "random parameters": rolled[middle]}
    fields |= {name: clip.simulated(p) for name, p in fits.items()}
    tiles = []
    level = int(np.argmax(clip.wet.sum(axis=(0, 1))))
    top = float(np.percentile(np.linalg.norm(fields["video"][-1].at_centers()[clip.wet], axis=-1), 98))
    for name, frames in fields.items():
        text = name
        if name != "video":
            error, cosine = clip.misfit(frames)
            assert error is not None
            text += f": off by {100 * error:.0f} %"
            shop.tell("volume velocity of the demo's clip", f"relative L2, {name}", error, "", "less")
            shop.tell("volume velocity of the demo's clip", f"cosine, {name}", cosine, "", "more")
        tiles.append(Tile(text, _plan(frames[-1], clip, level, top)))
    shop.keep("fields.png", sheet(tiles, 2, 430))
    _overflow(shop, draws[middle])


def _plan(velocity: FaceVelocity, clip: Clip, level: int, top: float) -> np.ndarray:
    """Speed and arrows in a horizontal layer of cells, x to the right and y up."""
    v = velocity.at_centers()[:, :, level]
    wet = clip.wet[:, :, level].T[::-1]
    speed = np.where(wet, np.linalg.norm(v, axis=-1).T[::-1], np.nan)
    ground = (clip.cells[:, :, level] == CellType.SOLID).T[::-1]
    times = max(430 // speed.shape[1], 1)
    field = np.stack([v[..., 0].T[::-1], -v[..., 1].T[::-1]], axis=-1)
    picture = coloured(speed, top, ground=ground, times=times)
    return arrows(picture, field, wet, step=3, scale=3.0 / top, times=times)


def _overflow(shop: Workshop, parameters: FluidParameters) -> None:
    """The particle simulator under random parameters: how much leaves the bed, beside the fitted ones."""
    fitted, random = shop.asset("demo"), shop.folder / "demo_random.fluid"
    if not (random / "random.done").is_file():
        shutil.rmtree(random, ignore_errors=True)
        shutil.copytree(fitted, random)
        told = asdict(parameters)
        names = ("gravity", "kinematic_viscosity", "inflow_velocity", "wall_damping", "restitution")
        edits = EditSession.open(random)
        edits.apply([Set(f"parameters.{n}", _plain(told[n])) for n in names])
        resimulate(random, overrides=["show.usd=false", "show.preview=false"])
        (random / "random.done").touch()
    tiles = []
    for name, folder in (("fitted parameters", fitted), ("random parameters", random)):
        last = FIRST + frames_of(folder) - 1
        share = outside(folder, last, load_asset(fitted))
        shop.tell("volume velocity of the demo's clip", f"fluid outside its bed, {name}", share, "", "less")
        history = last_value(folder, "simulate", Simulation)
        if history is not None:
            left = float(history.volume[-1] / history.volume[0])
            shop.tell("volume velocity of the demo's clip", f"volume at the end over the first, {name}", left)
        picture = shop.drawn(folder, last, (640, 416), view="side")
        tiles.append(Tile(f"{name}: {100 * share:.1f} % of the fluid outside its bed", picture))
    shop.keep("overflow.jpg", sheet(tiles, 2, 430))


def _plain(value):
    return [round(float(v), 4) for v in value] if isinstance(value, list | tuple) else round(float(value), 8)


def outside(folder: Path, number: int, asset) -> float:
    """Share of the particles over columns of the grid that held no fluid at the start, two cells about left out."""
    from scipy import ndimage

    frame = read_frame(frame_file(folder, number))
    means = frame.gaussians.means[frame.ids % 2 == 0]
    wet = np.isin(asset.cell_types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW)).any(axis=2)
    wet = ndimage.binary_dilation(np.asarray(wet, np.uint8), iterations=2)
    index = np.floor((means[:, :2] - asset.grid.low[:2]) / asset.grid.spacing).astype(int)
    inside = ((index >= 0) & (index < wet.shape)).all(axis=1)
    held = np.zeros(len(means), bool)
    held[inside] = wet[tuple(index[inside].T)]
    return float(1 - held.mean())


def arbitrary_starts(shop: Workshop) -> None:
    """Convergence on a clip: fits from starts whose scale is arbitrary, and how far their ends lie apart."""
    clip, rng = Clip(shop), np.random.default_rng(11)
    reference = clip.fitted(clip.found.initial, None).parameters
    ends = [reference]
    for k in range(STARTS):
        start = random_parameters(clip.found.initial, rng)
        started = replace(start, gravity=clip.found.initial.gravity)  # its prior is as narrow as what is known of it
        ends.append(clip.fitted(started, None).parameters)
        shop.tell(f"start {k + 1}", "inflow at the start", np.linalg.norm(started.inflow_velocity), "m/s")
        shop.tell(f"start {k + 1}", "inflow at the end", np.linalg.norm(ends[-1].inflow_velocity), "m/s")
        shop.tell(f"start {k + 1}", "viscosity at the start", started.kinematic_viscosity, "m2/s")
        shop.tell(f"start {k + 1}", "viscosity at the end", ends[-1].kinematic_viscosity, "m2/s")
        shop.tell(f"start {k + 1}", "outflow at the start", started.outflow_velocity, "m/s")
        shop.tell(f"start {k + 1}", "outflow at the end", ends[-1].outflow_velocity, "m/s")
    inflow = np.array([np.linalg.norm(p.inflow_velocity) for p in ends])
    shop.tell("arbitrary starts", "spread of the inflow over its mean", np.ptp(inflow) / inflow.mean(), "", "less")
