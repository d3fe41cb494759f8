"""A bed that is twisted along the stream, stripes painted on the water, and a tap of blue dye.

The same from the shell, without the stripes:

    fluidlift edit demo.fluid --add terrain='{twist: 12}' \\
        --add emitters='{name: dye, shape: cylinder, radius: 0.045, height: 0.054, position: [-0.2, -0.1, 0.4], velocity: [0, 0, -0.8], color: [0.1, 0.2, 0.9]}'
    fluidlift sim demo.fluid

The stripes show how Python changes what the command line has no word for: the rest body's colours.
"""  # noqa: E501

from dataclasses import replace

import numpy as np
from workbench import bench, end, places

from fluidlift.io.asset_folder import save_asset
from fluidlift.pipeline import EditSession
from fluidlift.pipeline.editing import Add
from fluidlift.types import sh_from_rgb
from fluidlift.validate import validate_asset

BLUE, CREAM, RED = (0.1, 0.2, 0.9), (0.98, 0.88, 0.62), (0.83, 0.22, 0.12)
"""sRGB"""
STRIPE = 0.12
"""share of the river's length"""

b = bench("twisted", __doc__)
asset = b.asset
along = asset.terrain.mainstream / np.linalg.norm(asset.terrain.mainstream)
across = np.cross([0.0, 0.0, 1.0], along)
reach = asset.rest.means @ along
middle, size = np.median(asset.rest.means, axis=0), float(np.ptp(asset.rest.means[:, 2]))

striped = np.floor(reach / (STRIPE * np.ptp(reach))).astype(int) % 2
light = asset.rest.rgb.mean(axis=1, keepdims=True) / asset.rest.rgb.mean()  # its shading stays
paint = np.clip(np.array([CREAM, RED])[striped] * (0.5 + 0.5 * light), 0.0, 1.0)
sh = np.zeros_like(asset.rest.sh)
sh[:, 0] = sh_from_rgb(paint)[:, 0]
save_asset(b.folder, replace(asset, rest=replace(asset.rest, sh=sh)))

edits = EditSession.open(b.folder)
tap = middle - 1.7 * size * along - 0.5 * size * across + [0, 0, 1.4 * size]
dye = {"name": "dye", "shape": "cylinder", "radius": round(0.25 * size, 3), "height": round(0.3 * size, 3),
       "position": places(tap), "velocity": [0, 0, -0.8], "color": list(BLUE)}  # fmt: skip
edits.apply([Add("terrain", {"twist": 12}), Add("emitters", dye)])
b.edited(edits)
b.simulate()
b.picture("03_twisted")

fluid, velocities = b.last()
drops = fluid.means[np.abs(fluid.rgb - BLUE).max(axis=1) < 0.25]
# what a tap gives: its cross section times its speed, and what it holds itself, in particles of an eighth of a cell
run = 0.8 * (b.count - 1) * asset.interval + dye["height"]
given = np.pi * dye["radius"] ** 2 * run / (b.simulated_grid().spacing ** 3 / 8)
# the disk is three to four cells wide: its area is known to some ten per cent, and dye that has mixed is not counted
b.check(
    "the tap gives dye",
    0.5 * given < len(drops) < 1.5 * given,
    f"{len(drops)} blue splats, {given:.0f} by cross section and speed",
)
moved = float(((drops - tap) @ along).max()) if len(drops) else 0.0
b.check("which the stream carries on", moved > 2 * dye["radius"], f"{moved:.2f} m downstream of the tap")
wrong = [f.line() for f in validate_asset(b.folder) if not f.passed]
b.check("the asset is whole", not wrong, "; ".join(wrong) or "as fluidlift validate sees it")
b.divergence_free()
b.solids_stay_dry()
end(b)
