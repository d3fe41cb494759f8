"""The river as honey, then as water again.

The same from the shell:

    fluidlift edit demo.fluid --material honey --simulate
    fluidlift edit demo.fluid --undo --simulate
"""

import numpy as np
from workbench import bench, end

from fluidlift.pipeline import EditSession

b = bench("honey_and_water", __doc__)
b.simulate()
edits = EditSession.open(b.folder)
text = (b.folder / "scene.yaml").read_bytes()
water, speed = b.last()
mean = float(np.linalg.norm(speed, axis=1).mean())

edits.apply(edits.made_of("honey"))
print(edits.diff())
b.simulate()
b.picture("04_honey", background="terrain")
_, slow = b.last()
thick = float(np.linalg.norm(slow, axis=1).mean())
b.check("honey is slower", thick < 0.9 * mean, f"{thick:.2f} m/s, water {mean:.2f} m/s")
b.solids_stay_dry()

edits.undo()
b.check("undo gives back the same file", (b.folder / "scene.yaml").read_bytes() == text, "scene.yaml, byte for byte")
b.simulate()
again, _ = b.last()
b.check(
    "and the same water",
    len(again) == len(water) and np.array_equal(again.means, water.means),
    f"{len(again)} splats in the same places",
)
b.picture("04_water", background="terrain")
end(b)
