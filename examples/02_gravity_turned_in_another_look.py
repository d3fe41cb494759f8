"""The river's box stood on its side: gravity points across the stream, and the water has become lava.

The same from the shell:

    fluidlift edit demo.fluid --set parameters.gravity='[0, 6.9, -6.9]' --set look.style=relit --set look.material=lava
    fluidlift sim demo.fluid
    fluidlift render demo.fluid -o turned.mp4 --view side
"""

import numpy as np
from workbench import bench, end

from fluidlift.io.asset_folder import load_asset
from fluidlift.pipeline import EditSession
from fluidlift.pipeline.editing import Set

b = bench("turned", __doc__)
asset = load_asset(b.folder)
along = asset.terrain.mainstream / np.linalg.norm(asset.terrain.mainstream)
across = np.cross([0.0, 0.0, 1.0], along)
across /= np.linalg.norm(across)
gravity = 9.81 * (across - np.array([0.0, 0.0, 1.0])) / np.sqrt(2)

edits = EditSession.open(b.folder)
edits.apply(
    [
        Set("parameters.gravity", [round(float(v), 4) for v in gravity]),
        Set("look.style", "relit"),
        Set("look.material", "lava"),
    ]
)
print(edits.diff())
start = float((asset.rest.means @ across).mean())
b.simulate()
b.picture("02_turned", background="terrain")

fluid, _ = b.last()
shift = float((fluid.means @ across).mean()) - start
b.check("the fluid goes where gravity points", shift > 0.02, f"its middle moved by {shift:.2f} m to that side")
b.check("all positions are finite", bool(np.isfinite(fluid.means).all()), f"{len(fluid)} splats")
b.solids_stay_dry()
end(b)
