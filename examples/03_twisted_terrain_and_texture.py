"""A bed that is twisted along the stream, stripes painted on the water, and a tap of blue dye.

The same from the shell, without the stripes:

    fluidlift edit demo.fluid --add terrain='{twist: 12}' \\
        --add emitters='{name: dye, shape: cylinder, radius: 0.04, height: 0.05, position: [-0.3, 0, 0.35]}'
    fluidlift sim demo.fluid

The stripes show how Python changes what the command line has no word for: the rest body's colours.
"""

from dataclasses import replace

import numpy as np
from workbench import bench, end

from fluidlift.io.asset_folder import load_asset, save_asset
from fluidlift.pipeline import EditSession
from fluidlift.types import sh_from_rgb

BLUE = (0.1, 0.2, 0.9)

b = bench("twisted", __doc__)
asset = load_asset(b.folder)
along = asset.terrain.mainstream / np.linalg.norm(asset.terrain.mainstream)
low, high = asset.rest.means.min(axis=0), asset.rest.means.max(axis=0)
middle, size = np.median(asset.rest.means, axis=0), float(high[2] - low[2])

stripes = 0.5 + 0.5 * np.sign(np.sin(14.0 * (asset.rest.means @ along)))
paint = np.stack([0.85 * stripes + 0.1, 0.75 - 0.5 * stripes, 0.35 + 0.1 * stripes], axis=-1)
sh = asset.rest.sh.copy()
sh[:, 0] = sh_from_rgb(0.5 * asset.rest.rgb + 0.5 * paint)[:, 0]
save_asset(b.folder, replace(asset, rest=replace(asset.rest, sh=sh)))

edits = EditSession.open(b.folder)
edits.add("terrain", {"twist": 12})
tap = middle - 0.25 * along + [0, 0, 1.2 * size]
edits.add(
    "emitters",
    {"name": "dye", "shape": "cylinder", "radius": 0.3 * size, "height": 0.3 * size,
     "position": [float(v) for v in tap], "velocity": [0, 0, -0.8], "color": list(BLUE)},
)  # fmt: skip
print(edits.diff())
b.simulate()
b.picture("03_twisted", background="terrain")

fluid, velocities = b.last()
blue = np.abs(fluid.rgb - BLUE).max(axis=1) < 0.25
b.check("the tap gives dye", blue.sum() > 20, f"{blue.sum()} blue splats")
moved = float(((fluid.means[blue] - tap) @ along).max()) if blue.any() else 0.0
b.check("which the stream carries on", moved > 0.02, f"{moved:.2f} m downstream")
b.solids_stay_dry()
end(b)
