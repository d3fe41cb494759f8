"""The river as honey, then as water again.

The same from the shell:

    fluidlift edit demo.fluid --material honey --simulate
    fluidlift edit demo.fluid --undo --simulate
"""

import numpy as np
from workbench import bench, end

from fluidlift.pipeline import EditSession

b = bench("honey_and_water", __doc__)
edits = EditSession.open(b.folder)
text = (b.folder / "scene.yaml").read_bytes()
if not b.dry:
    b.simulate()
    water, speed = b.last()
    mean = float(np.linalg.norm(speed, axis=1).mean())

edits.apply(edits.made_of("honey"))
b.edited(edits)
b.simulate()
b.picture("04_honey")
_, slow = b.last()
thick = float(np.linalg.norm(slow, axis=1).mean())
# what comes in is the same; the film at the bed, where viscosity holds the honey, reaches through the whole depth
b.check("honey is slower", thick < 0.9 * mean, f"{thick:.2f} m/s on the mean, water {mean:.2f} m/s")
b.divergence_free()
b.solids_stay_dry()

edits.undo()
b.check("undo gives back the same file", (b.folder / "scene.yaml").read_bytes() == text, "scene.yaml, byte for byte")
b.simulate()
again, _ = b.last()
b.check(
    "and the same water",
    len(again) == len(water) and np.array_equal(again.means, water.means),
    f"{len(again)} splats in the same places, to the bit",
)
b.picture("04_water", look="surface", material="water")
end(b)
