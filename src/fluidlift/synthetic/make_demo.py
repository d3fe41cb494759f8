"""Makes the demo clip and its truth: python -m fluidlift.synthetic.make_demo OUT."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from fluidlift.io.video import write_video
from fluidlift.synthetic.demo import FILES
from fluidlift.synthetic.record import Recording, record, write_case
from fluidlift.synthetic.scenes import SyntheticScene, stream

SIZE, FRAMES, CELLS = (320, 208), 40, 72
COARSE = 4
"""pixels of the clip along one pixel of the shipped truth"""


def on_coarse_raster(scene: SyntheticScene, recording: Recording) -> tuple[SyntheticScene, Recording]:
    """The same truth for a picture of a quarter of the width: nearest samples, displacements in coarse pixels."""
    w, h = scene.camera.size
    camera = scene.camera.resized((w // COARSE, h // COARSE))
    pick = slice(COARSE // 2, None, COARSE)
    flow = np.round(recording.flow[:, pick, pick].astype(np.float32) / COARSE * 32) / 32
    depth = recording.depth[:, pick, pick].astype(np.float32)
    small = replace(
        recording,
        flow=flow.astype(np.float16),
        depth=(np.round(depth * 512) / 512).astype(np.float16),
        dz=(np.round(recording.dz[:, pick, pick].astype(np.float32) * 2048) / 2048).astype(np.float16),
        mask=recording.mask[:, pick, pick],
        visible=recording.visible[:, pick, pick],
        static_depth=recording.static_depth[pick, pick],
        grid_velocity=(np.round(recording.grid_velocity.astype(np.float32) * 64) / 64).astype(np.float16),
        grid_phi=(np.round(recording.grid_phi.astype(np.float32) * 8) / 8).astype(np.float16),
    )
    return replace(scene, camera=camera), small


def make_demo(
    folder: Path,
    *,
    size: tuple[int, int] = SIZE,
    frames: int = FRAMES,
    cells: int = CELLS,
    settle: float | None = None,
) -> list[Path]:
    """Simulate and film the demo and write its files.

    Args:
        folder: where to; made if absent.
        size: of the picture, px, multiples of `COARSE`.
        frames: of the clip.
        cells: of the grid along x.
        settle: s of simulation before the first frame; None: the scene's own.

    Returns:
        The files.
    """
    folder = Path(folder)
    scene = stream(size=size, seed=7, cells=cells)
    if settle is not None:
        scene = replace(scene, settle=settle)
    recording = record(scene, frames, seed=7, progress=_show)
    write_case(*on_coarse_raster(scene, recording), folder)
    (folder / "video.mp4").unlink()
    for name, target in FILES.items():
        if name != "video.mp4":
            (folder / name).replace(folder / target)
    write_video(folder / "demo.mp4", list(recording.frames), scene.fps, quality=21.0, repeatable=True)
    seen = recording.mask[0] & (recording.depth[0] > 0)
    water = scene.camera.unproject(scene.camera.pixel_grid()[seen], recording.depth[0][seen])
    surveyed = scene.camera.to_dict() | {"water_level_z": round(float(np.median(water[:, 2])), 3)}
    (folder / "demo_camera.json").write_text(json.dumps(surveyed, indent=1))
    return sorted(folder.glob("demo*"))


def _show(done: int, total: int) -> None:
    print(f"frame {done} of {total}", file=sys.stderr)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Make the demo clip and its truth.")
    parser.add_argument("out", type=Path, help="folder for the files")
    for path in make_demo(parser.parse_args().out):
        print(f"{path.stat().st_size:9d}  {path}")
