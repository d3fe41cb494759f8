"""Draw splats: 3D Gaussians from any camera, with depth and coverage; of an asset, or made up.

python examples/draw_splats.py [ASSET.fluid] [OUT.png]
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import fluidlift as fl

arguments = sys.argv[1:]
out = Path(arguments.pop()) if arguments and arguments[-1].endswith(".png") else Path("splats.png")
if arguments:
    splats = fl.load_asset(arguments[0]).rest
else:  # a torus of round Gaussians, coloured by where they are
    a, b = np.random.default_rng(0).uniform(0, 2 * np.pi, (2, 20_000))
    ring = 1.0 + 0.35 * np.cos(b)
    points = np.stack([ring * np.cos(a), ring * np.sin(a), 0.35 * np.sin(b)], axis=1)
    splats = fl.Gaussians.isotropic(points, 0.02, 0.5 + 0.36 * points, opacity=0.8)

middle = splats.means.mean(axis=0)
reach = float(np.linalg.norm(splats.means - middle, axis=1).max())
camera = fl.PinholeCamera.looking(middle + reach * np.array([1.2, -1.8, 1.4]), middle, 45.0, (640, 416))
drawn = fl.render(splats, camera, background=(0.93, 0.93, 0.95))
Image.fromarray((255 * np.clip(drawn.image, 0, 1)).astype(np.uint8)).save(out)
near, far = np.percentile(drawn.depth[drawn.alpha > 0.5], [1, 99])
print(f"{out}: {len(splats)} Gaussians, {100 * drawn.alpha.mean():.0f} % covered, {near:.2f} to {far:.2f} m away")
