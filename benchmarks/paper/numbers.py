"""Tables of the page that other benchmarks measure, and those of run time and of the paper's configuration."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from benchmarks.paper.tiles import Tile, sheet
from benchmarks.paper.workshop import FIRST, PICTURES, ROOT, Workshop

from fluidlift.config import build_config
from fluidlift.evaluate.case import read_case
from fluidlift.evaluate.of_run import arrays_of_run
from fluidlift.evaluate.planar import score_conservation, score_flow, score_resimulation
from fluidlift.evaluate.score import read_video
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.pipeline import Inputs, make
from fluidlift.synthetic.demo import demo_clip

ROUTES = {"recurrent": "fitted convolution", "jacobi": "Jacobi sweeps", "implicit": "analytic gradient"}
ITERATIONS = 150
"""of Adam: by then every route has stopped improving on the twin"""


def other(script: str, *arguments: str) -> None:
    """Run another benchmark, with one thread: its pieces are small.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, str(ROOT / "benchmarks" / script), *arguments]
    subprocess.run(command, check=True, env=os.environ | threads, stdout=subprocess.DEVNULL)


def study(shop: Workshop) -> None:
    """The twins of fit_study.py, once."""
    if not (shop.folder / "fit_study.json").is_file():
        shop.folder.mkdir(parents=True, exist_ok=True)
        files = "--figure", str(shop.folder / "fit_fields.png"), "--json", str(shop.folder / "fit_study.json")
        other("fit_study.py", "--seeds", "1", "--parts", "table", "comparison", *files)


def pressure(shop: Workshop) -> None:
    """Figs. percnn_str_fit and percnnresult."""
    found = shop.folder / "pressure_routes.json"
    if not found.is_file():
        other("pressure_routes.py", "--routes", *ROUTES, "--iterations", str(ITERATIONS), "--seconds", "60",
              "--sizes", "--figure", str(shop.folder / "pressure_routes.png"), "--json", str(found))  # fmt: skip
    told = shop.json(found.name)
    for run in told["runs"]:
        name = ROUTES.get(run["route"])
        if name is None:
            continue
        method = "Adam" if run["method"] == "adam" else "Levenberg-Marquardt"
        subject, count = f"pressure route: {name}, {method}, {run['batch']} at a time", len(run["losses"]) - 1
        shop.tell(subject, "ms per iteration", 1e3 * run["seconds"][-1] / count, "ms", "less")
        shop.tell(subject, "loss over start", run["losses"][-1] / run["losses"][0], "", "less")
        shop.tell(subject, "parameter error over start", run["errors"][-1], "", "less")
        shop.tell(subject, "iterations", count)
    shutil.copyfile(shop.folder / "pressure_routes.png", PICTURES / "pressure.png")


def parameters(shop: Workshop) -> None:
    """Table 1 and the twins' four fields."""
    study(shop)
    told = shop.json("fit_study.json")
    for row in told["comparison"]:
        shop.tell(f"twin: {row['scene']}", row["field"], row["relative"], "", "less")
    for row in told["table"]:
        if row["scene"] == "river":
            for name, ends in row.get("parameters", {}).items():
                for end, value in ends.items():
                    shop.tell("table: river twin", f"{name}, {end}", value)
    shutil.copyfile(shop.folder / "fit_fields.png", PICTURES / "twins.png")
    found = shop.stage(shop.asset("demo"), "fit")
    pairs = {
        "gravity_z [m/s2]": lambda p: p.gravity[2], "viscosity [m2/s]": lambda p: p.kinematic_viscosity,
        "inflow [m/s]": lambda p: np.linalg.norm(p.inflow_velocity),
        "inflow fluctuation [m/s]": lambda p: p.inflow_fluctuation, "outflow [m/s]": lambda p: p.outflow_velocity,
        "restitution": lambda p: p.restitution, "wall damping": lambda p: p.wall_damping,
        "time step [s]": lambda p: p.time_step,
    }  # fmt: skip
    for name, value in pairs.items():
        shop.tell("table: demo clip", f"{name}, before", float(value(found.initial)))
        shop.tell("table: demo clip", f"{name}, after", float(value(found.parameters)))


def run_time(shop: Workshop) -> None:
    """Fig. time: stages of the demo by length of the clip and by grid, each made anew."""
    plans = {
        "0.4 s, 64 cells": ("read.duration=0.4",), "0.8 s, 64 cells": ("read.duration=0.8",),
        "0.4 s, 48 cells": ("read.duration=0.4", "shape.cells=48"),
    }  # fmt: skip
    for name, settings in plans.items():
        folder = shop.folder / "timed.fluid"
        shutil.rmtree(folder, ignore_errors=True)
        clip = demo_clip()
        made = make(Inputs(clip, camera=clip.with_name("demo_camera.json")), folder,
                    build_config("draft", overrides=["show.usd=false", *settings]))  # fmt: skip
        for stage, seconds in read_manifest(folder)["timings"].items():
            shop.tell(f"run time: {name}", stage, seconds, "s", "less")
        shop.tell(f"run time: {name}", "all", made.seconds, "s", "less")
    shutil.rmtree(shop.folder / "timed.fluid", ignore_errors=True)


def preset(shop: Workshop) -> None:
    """The demo by the paper's configuration, beside the default's, against the truth."""
    tiles = []
    for name in ("draft", "paper"):
        folder = shop.asset("demo", preset=name)
        _score(shop, folder, f"preset {name}")
        size = load_asset(folder).camera.size
        picture = shop.drawn(folder, FIRST + 14, (2 * size[0], 2 * size[1]), view="input", background="auto")
        side = shop.drawn(folder, FIRST + 14, (2 * size[0], 2 * size[1]), view="side")
        tiles += [Tile(f"{name}: the clip's view", picture), Tile(f"{name}: from the side", side)]
    shop.keep("preset.jpg", sheet(tiles, 2, 400))


def _score(shop: Workshop, folder: Path, subject: str) -> None:
    """Flow, re-simulation and cost."""
    manifest, case = read_manifest(folder), read_case(shop.case("demo"))
    arrays = arrays_of_run(folder, manifest)
    frames = arrays["resim_frames"]
    video = read_video(case.video, (frames.shape[2], frames.shape[1]))
    wanted = {
        "flow.completed.epe": "error of the flow", "flow.completed.cosine": "cosine of the flow",
        "flow.resimulated.epe": "error of the re-simulation's flow", "flow.resimulated.cosine": "its cosine",
        "resimulation.psnr_fluid.fitted": "PSNR in the fluid, fitted frames",
        "resimulation.psnr_fluid.predicted": "PSNR in the fluid, later frames",
        "resimulation.mask_iou.predicted": "IoU of the mask, later frames",
        "resimulation.volume_drift": "volume drift",
    }  # fmt: skip
    told = [*score_flow(arrays, case), *score_resimulation(arrays, case, video)[0], *score_conservation(arrays, case)]
    for figure in told:
        if figure.key in wanted and figure.value is not None:
            shop.tell(subject, wanted[figure.key], figure.value, figure.unit)
    for stage in ("flow", "motion", "fit", "simulate"):
        shop.tell(subject, f"time, {stage}", manifest["timings"][stage], "s", "less")
