"""The paper's own method from end to end, on half a second of the demo: an asset, by the paper's settings."""

import json

import numpy as np
import yaml

from fluidlift.cli import main
from fluidlift.config import build_config
from fluidlift.io.asset_folder import load_asset, read_manifest
from fluidlift.io.kept_values import recalled
from fluidlift.scene.splat_files import frame_file, read_frame
from fluidlift.synthetic.demo import demo_clip

SMALL = {
    "read.duration": 0.3, "read.max_size": 160, "shape.cells": 20, "shape.refine_iterations": 4, "motion.targets": 3,
    "simulate.frames": 3, "show.usd": False, "show.preview": False, "fit.max_work": 3e6,
}  # fmt: skip
"""as coarse as a test needs; none of these is part of the method"""


def test_an_asset_is_made_by_the_methods_of_the_paper(tmp_path, capsys):
    folder = tmp_path / "paper.fluid"
    settings = [part for name, value in SMALL.items() for part in ("--set", f"{name}={json.dumps(value)}")]
    camera = demo_clip().with_name("demo_camera.json")
    command = ["make", str(demo_clip()), "-o", str(folder), "--preset", "paper", "--camera", str(camera), *settings]
    assert main(command) in (0, 4)
    capsys.readouterr()
    manifest = read_manifest(folder)
    used = manifest["provenance"]["config"]
    wanted = build_config("paper", overrides=[f"{k}={yaml.safe_dump(v).split()[0]}" for k, v in SMALL.items()])
    for section in ("motion", "fit", "simulate"):
        assert used[section] == json.loads(json.dumps(wanted.section(section)))
    flow, fit = recalled(folder, manifest, "flow"), recalled(folder, manifest, "fit")
    assert flow.method == "farneback"
    # it was fitted through a convolution that passed its validation, or the note says why not
    assert any("convolution" in note for note in fit.notes), fit.notes
    assert fit.status in ("fitted", "unfinished"), fit.reason
    # deformed splats alone: no skin, whose ids are odd, and no force that keeps the filmed flow
    last = read_frame(frame_file(folder, 1003))
    assert (last.ids % 2 == 0).all() and len(last.ids) > 100
    assert np.isfinite(load_asset(folder).parameters.inflow_velocity).all()
