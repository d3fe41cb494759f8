"""What the steps of the page share: a folder to work in, assets and cases in it, pictures and records to leave."""

from __future__ import annotations

import datetime
import json
import platform
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from benchmarks.paper import scenes, tiles
from benchmarks.report import FOLDER, put, text_of

from fluidlift.config import build_config
from fluidlift.io.asset_folder import read_manifest
from fluidlift.io.kept_values import recalled
from fluidlift.pipeline import Inputs, RenderRequest, make, render_asset
from fluidlift.synthetic.demo import demo_clip, unpack_demo_case
from fluidlift.synthetic.record import record, write_case

ROOT = Path(__file__).resolve().parent.parent.parent
PICTURES = ROOT / "docs" / "pictures" / "paper"
TOPIC = "paper"
FIRST = 1001
"""number of the first frame of an asset"""


@dataclass
class Workshop:
    """A folder whose contents are made when they are first asked for."""

    folder: Path
    records: list[dict[str, Any]] = field(default_factory=list)

    def case(self, name: str) -> Path:
        """Clip and truth of the demo or of a made scene."""
        folder = self.folder / "cases" / name
        if not (folder / "truth.npz").is_file():
            shutil.rmtree(folder, ignore_errors=True)
            if name == "demo":
                return unpack_demo_case(folder)
            plan = scenes.PLANS[name]
            scene = plan.scene()
            write_case(scene, record(scene, plan.frames, seed=plan.seed), folder)
        return folder

    def asset(self, name: str, *, preset: str = "draft", settings: Sequence[str] = ()) -> Path:
        """Made of the clip of a case with its camera, unless it lies there already. The stages are cached."""
        label = name if preset == "draft" else f"{name}_{preset}"
        folder, case = self.folder / f"{label}.fluid", self.case(name)
        if not (folder / "report.html").is_file():
            if name == "demo":
                kind, inputs = "auto", Inputs(demo_clip(), camera=demo_clip().with_name("demo_camera.json"))
            else:
                kind, inputs = scenes.PLANS[name].kind, Inputs(case / "video.mp4", camera=case / "camera.json")
            make(inputs, folder, build_config(preset, overrides=[f"shape.kind={kind}", "show.usd=false", *settings]))
        return folder

    def stage(self, asset: Path, name: str) -> Any:
        """The value of a stage that the asset was made from."""
        found = recalled(asset, read_manifest(asset), name)
        assert found is not None, f"{asset.name} has no {name} any more"
        return found

    def drawn(self, asset: Path, number: int, size: tuple[int, int], **request: Any) -> np.ndarray:
        """A frame of an asset, u8 [h,w,3]."""
        place = self.folder / "drawn"
        shutil.rmtree(place, ignore_errors=True)
        told: dict[str, Any] = {"background": "terrain"} | request
        asked = RenderRequest(frames=(number, number), size=size, **told)
        made = render_asset(asset, place, asked)
        return read_picture(made.folder / f"{number}.png")

    def keep(self, name: str, picture: np.ndarray) -> None:
        """A picture of the page."""
        tiles.save(PICTURES / name, picture)

    def tell(
        self, subject: str, figure: str, value: float | np.floating | None, unit: str = "", better: str = ""
    ) -> None:
        """A record of the page; None was not measured."""
        if value is None:
            return
        told = {"subject": subject, "figure": figure, "value": float(f"{value:.4g}"), "unit": unit, "better": better}
        self.records.append(told)

    def flush(self, command: str) -> None:
        """Write the records to benchmarks/results/paper.json; older ones of the same command that are not among them
        go."""
        path = FOLDER / f"{TOPIC}.json"
        content = json.loads(path.read_text(encoding="utf-8"))
        told = {(r["subject"], r["figure"]) for r in self.records}
        content["records"] = [
            r for r in content["records"] if r.get("command") != command or (r["subject"], r["figure"]) in told
        ]
        path.write_text(text_of(content), encoding="utf-8")
        machine = f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"
        put(TOPIC, self.records, command=command, date=datetime.date.today().isoformat(), machine=machine)
        self.records.clear()

    def json(self, name: str) -> Any:
        """A file of another benchmark that was run into this folder."""
        return json.loads((self.folder / name).read_text(encoding="utf-8"))


def read_picture(path: Path) -> np.ndarray:
    """u8 [h,w,3], sRGB.

    Raises:
        FileNotFoundError: it cannot be read.
    """
    found = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if found is None:
        raise FileNotFoundError(path.name)
    return np.ascontiguousarray(found[..., ::-1])


def frames_of(asset: Path) -> int:
    """Frames that were simulated."""
    return int(read_manifest(asset)["simulation"]["frames"])
