"""The river's box stood on its side: gravity points across the stream, and the water has become lava.

The same from the shell:

    fluidlift edit demo.fluid --set parameters.gravity='[0, 6.937, -6.937]' \\
        --set look.style=relit --set look.material=lava
    fluidlift sim demo.fluid
    fluidlift render demo.fluid -o turned.mp4 --view side
"""

import numpy as np
from workbench import FIRST, bench, end, places

from fluidlift.pipeline import EditSession
from fluidlift.pipeline.editing import Set

b = bench("turned", __doc__)
asset = b.asset
along = asset.terrain.mainstream / np.linalg.norm(asset.terrain.mainstream)
across = np.cross([0.0, 0.0, 1.0], along)
across /= np.linalg.norm(across)
gravity = 9.81 * (across - np.array([0.0, 0.0, 1.0])) / np.sqrt(2)

edits = EditSession.open(b.folder)
edits.apply([
    Set("parameters.gravity", places(gravity)), Set("look.style", "relit"), Set("look.material", "lava"),
])  # fmt: skip
b.edited(edits)
b.simulate()
b.picture("02_turned")

# in the first frames nothing but the bank is in the way: the middle of the fluid falls as a stone would on an incline
early = min(4, b.count - 1)
side = [float((b.splats(FIRST + k)[0].means @ across).mean()) for k in (0, early)]
free = 0.5 * (9.81 / np.sqrt(2)) * (early * asset.interval) ** 2
share = (side[1] - side[0]) / free
# the lower bank holds part of it back; steps of finite length fall up to a fourth too far in four frames
b.check(
    "the fluid goes where gravity points",
    0.5 < share < 1.3,
    f"its middle moved by {side[1] - side[0]:.3f} m to that side in {early} frames, {share:.2f} of free fall",
)
fluid, velocities = b.last()
b.check("all positions are finite", bool(np.isfinite(fluid.means).all()), f"{len(fluid)} splats")
count = b.history().count
b.check("what falls over the bank is gone", count[-1] < count[0], f"{count[-1]} particles of {count[0]} are left")
b.divergence_free()
b.solids_stay_dry()
end(b)
