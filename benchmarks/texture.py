"""How the fluid's texture fares in a re-simulation: is it as fine as the clip's, and is it drawn into streaks?

    python benchmarks/texture.py river.fluid honey.fluid ...

Of the previews (input and re-simulation side by side, same size), over the last two thirds of the clip's frames and
inside the fluid's mask: the mean gradient of the brightness over the clip's own (1: as fine; less: blurred), and the
coherence of the structure tensor over 2 % of the picture's width (0: alike in all directions, 1: lines), of both.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import av
import cv2
import numpy as np
from report import table as rows_of
from scipy import ndimage

from fluidlift.io.asset_folder import read_manifest
from fluidlift.pipeline.recall import footage_of_asset

CAPTION = 0.08
"""upper share of a panel, where its caption stands"""


def gradients(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Along both axes, of the brightness, blurred by a pixel against the film's compression."""
    grey = ndimage.gaussian_filter(picture.astype(np.float64).mean(axis=-1), 1.0)
    return ndimage.sobel(grey, axis=0) / 8, ndimage.sobel(grey, axis=1) / 8


def texture(picture: np.ndarray, inside: np.ndarray) -> tuple[float, float]:
    """Mean gradient, and coherence weighted with the gradients' squares."""
    dy, dx = gradients(picture)
    width = 0.02 * picture.shape[1]
    yy, xx, xy = (ndimage.gaussian_filter(a * inside, width) for a in (dy * dy, dx * dx, dy * dx))
    total = yy + xx
    lines = np.sqrt((xx - yy) ** 2 + 4 * xy**2)
    return float(np.hypot(dx, dy)[inside].mean()), float(lines[inside].sum() / max(total[inside].sum(), 1e-12))


def measured(folder: Path) -> list[str]:
    """One row."""
    manifest = read_manifest(folder)
    footage = footage_of_asset(folder, manifest)
    if footage is None:
        raise SystemExit(f"{folder}: without the stages of its clip in work/")
    fluid, start = footage.labels.fluid, footage.start
    with av.open(str(folder / "preview.mp4")) as film:
        frames = [f.to_ndarray(format="rgb24") for f in film.decode(video=0)]
    found = []
    count = min(len(frames), len(footage.clip) - start)
    for k in range(count // 3, count):
        panel = frames[k].shape[1] // 3
        mask = cv2.resize(np.asarray(fluid[start + k], np.uint8), (panel, frames[k].shape[0])) > 0
        mask[: int(CAPTION * len(mask))] = False
        inside = ndimage.binary_erosion(mask, iterations=4)
        found.append([*texture(frames[k][:, :panel], inside), *texture(frames[k][:, panel : 2 * panel], inside)])
    fine, lines, fine_again, lines_again = np.mean(found, axis=0)
    return [folder.stem, f"{fine_again / fine:.2f}", f"{lines:.2f}", f"{lines_again:.2f}"]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("assets", nargs="+", type=Path)
    rows = [measured(folder) for folder in parser.parse_args().assets]
    print(
        "\n".join(rows_of(["asset", "gradient over the clip's", "coherence of the clip", "of the re-simulation"], rows))
    )


if __name__ == "__main__":
    main()
