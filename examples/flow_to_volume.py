"""Flow to volume: optical flow of a clip, lifted to the surface in m/s, extended to a divergence-free volume.

    python examples/flow_to_volume.py [FRAMES]

Pixels become metres by a camera and a depth; here both are made up: a camera that looks down on a level pool.
"""

import sys

import numpy as np

import fluidlift as fl
from fluidlift.synthetic.demo import demo_clip

count = int(sys.argv[1]) if len(sys.argv) > 1 else 3
clip = fl.read_clip(demo_clip())
flow = fl.estimate_flow(np.asarray(clip.frames[:count]), method="dis")  # px per frame, with a confidence

height, width = flow.displacement.shape[1:3]
camera = fl.PinholeCamera.looking((0.0, 0.0, 3.0), (0.0, 0.001, 0.0), 35.0, (width, height))
depth = np.full((height, width), 3.0, np.float32)
fluid = np.zeros((height, width), bool)
fluid[height // 4 : -height // 4] = True
seen = flow.confidence[0] > 0.5
surface = fl.lift_flow(flow.displacement[0], seen, fluid, depth, depth, camera, clip.interval)

grid = fl.Grid(shape=(32, 10, 6), spacing=1.92 / 32, origin=(-0.96, -0.3, -0.33))
cells = np.full(grid.shape, fl.CellType.FLUID, np.uint8)
cells[0], cells[-1] = fl.CellType.INFLOW, fl.CellType.OUTFLOW
velocity, report = fl.volume_velocity(surface, None, cells, grid, kind="stream", mainstream=np.array([1.0, 0, 0]))
print(f"surface: {len(surface.points)} points, {100 * surface.observed.mean():.0f} % observed, "
      f"{np.linalg.norm(surface.velocities, axis=1).mean():.2f} m/s")  # fmt: skip
print(f"volume: {np.linalg.norm(velocity.at_centers(), axis=-1).mean():.2f} m/s, "
      f"{report.flux_in:.4f} m^3/s in, {report.flux_out:.4f} out, divergence {report.divergence_mean:.0e}")  # fmt: skip
