"""Draws docs/pictures/pipeline.jpg: what each stage of the pipeline made of the shipped demo.

    fluidlift demo -o demo.fluid
    python benchmarks/pipeline_picture.py demo.fluid

The tiles are figures of the asset's own report, its fitted parameters, and two drawings of `fluidlift render`.
"""

from __future__ import annotations

import argparse
import base64
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np

from fluidlift.io.asset_folder import load_asset
from fluidlift.pipeline import RenderRequest, render_asset
from fluidlift.scene.splat_files import frame_files

matplotlib.use("Agg")
import matplotlib.pyplot as plt

PAGE = Path(__file__).resolve().parent.parent / "docs" / "pictures" / "pipeline.jpg"
WIDTH, HEIGHT = 640, 416
"""px of a tile: twice the demo's working pictures"""
STAGES = (
    ("the clip", "one camera that stands"),
    ("1  See", "fluid, rocks, optical flow"),
    ("2  Shape", "surface, bed, Gaussians"),
    ("3  Move", "completed flow, volume velocity"),
    ("4  Fit", "fitted parameters; grey: prior kept"),
    ("5  Re-simulate", "the last frame"),
)


@dataclass(frozen=True)
class Figures:
    """The pictures of an asset's report, u8 [h,w,3], by the beginning of their texts."""

    by_text: dict[str, np.ndarray]

    @classmethod
    def of(cls, report: Path) -> Figures:
        """Read report.html."""
        found = re.findall(r"<figure><img alt='([^']*)' src='data:image/png;base64,([^']*)'", report.read_text())
        bytes_of = {text: np.frombuffer(base64.b64decode(data), np.uint8) for text, data in found}
        return cls({text: cv2.imdecode(b, cv2.IMREAD_COLOR)[..., ::-1] for text, b in bytes_of.items()})

    def named(self, beginning: str) -> np.ndarray:
        """The first figure whose text begins so."""
        return next(picture for text, picture in self.by_text.items() if text.startswith(beginning))


def drawn(folder: Path, number: int) -> np.ndarray:
    """A frame of the re-simulation from the side, u8 [h,w,3]."""
    request = RenderRequest(view="side", frames=(number, number), size=(WIDTH, HEIGHT), background="terrain")
    with tempfile.TemporaryDirectory() as place:
        made = render_asset(folder, Path(place) / "side", request)
        return cv2.imread(str(made.folder / f"{number}.png"), cv2.IMREAD_COLOR)[..., ::-1]


def parameter_lines(folder: Path) -> list[tuple[str, bool]]:
    """Name, value, interval and unit of each parameter, and whether the clip told it."""
    lines = []
    for name, e in load_asset(folder).estimates.items():
        value = f"{e.value:9.3g} ± {e.sigma:<7.2g}" if e.fitted else f"{e.value:9.3g} (prior)  "
        lines.append((f"{name:20.20} {value} {e.unit}", e.fitted))
    return lines


def compose(folder: Path, path: Path) -> None:
    """Two rows of three tiles, with arrows from each to the next."""
    figures = Figures.of(folder / "report.html")
    both = figures.named("Frame 0: the clip")
    last = 1000 + len(frame_files(folder))
    tiles = [
        both[:, : both.shape[1] // 2], figures.named("Frame 0: what is taken for fluid"), drawn(folder, 1001),
        figures.named("The same after averaging"), None, drawn(folder, last),
    ]  # fmt: skip
    figure, axes = plt.subplots(2, 3, figsize=(12, 6.1), dpi=100)
    figure.subplots_adjust(left=0.015, right=0.985, top=0.92, bottom=0.02, wspace=0.09, hspace=0.24)
    for axis, (title, words), tile in zip(axes.flat, STAGES, tiles):
        axis.set_title(title, loc="left", fontsize=13, fontweight="bold")
        axis.set_title(words, loc="right", fontsize=9.5, color="0.3")
        axis.set(xticks=[], yticks=[], xlim=(0, WIDTH), ylim=(HEIGHT, 0), aspect="equal")
        if tile is not None:
            axis.imshow(cv2.resize(tile, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC))
            continue
        for k, (line, fitted) in enumerate(parameter_lines(folder)[:16]):
            axis.text(14, 34 + 27 * k, line, family="monospace", fontsize=8, color="black" if fitted else "0.55")
    for axis in [*axes[0, :2], *axes[1, :2]]:
        axis.annotate("", (1.08, 0.5), (1.005, 0.5), xycoords="axes fraction",
                      arrowprops={"arrowstyle": "-|>", "lw": 2, "color": "0.2"})  # fmt: skip
    figure.savefig(path, pil_kwargs={"quality": 88})


def main() -> int:
    """Draw it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("asset", type=Path, help="the demo's asset, as `fluidlift demo` makes it")
    parser.add_argument("--out", type=Path, default=PAGE, help="default: docs/pictures/pipeline.jpg")
    args = parser.parse_args()
    compose(args.asset, args.out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
