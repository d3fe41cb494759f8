"""Rocks and a pillar in a river that goes on for another metre.

The same from the shell:

    fluidlift edit demo.fluid --set extend_downstream=0.8 \\
        --add obstacles='{name: rock, shape: ellipsoid, size: [0.2, 0.16, 0.24], position: [0.3, 0.0, 0.12]}'
    fluidlift sim demo.fluid
"""

import numpy as np
from workbench import bench, end

from fluidlift.io.asset_folder import load_asset
from fluidlift.pipeline import EditSession

LONGER = 0.8
"""m"""

b = bench("longer_river", __doc__)
asset = load_asset(b.folder)
along = asset.terrain.mainstream / np.linalg.norm(asset.terrain.mainstream)
surface, middle = asset.rest.means[:, 2].max(), np.median(asset.rest.means, axis=0)
size = float(np.ptp(asset.rest.means[:, 2]))

edits = EditSession.open(b.folder)
edits.set("extend_downstream", LONGER)
for name, shape, shift in (
    ("rock", {"shape": "ellipsoid", "size": [1.6 * size, 1.3 * size, 2.2 * size]}, 0.15),
    ("pillar", {"shape": "cylinder", "radius": 0.5 * size, "height": 3 * size}, 0.45),
):
    place = middle + shift * along
    edits.add("obstacles", {"name": name, **shape, "position": [float(v) for v in place]})
print(edits.diff())

before = float((asset.rest.means @ along).max())
b.simulate()
b.picture("01_longer_river", background="terrain")

fluid, velocities = b.last()
reach = fluid.means @ along
b.check(
    "the added reach is wet",
    float(reach.max()) > before + 0.7 * LONGER,
    f"water goes on for {reach.max() - before:.2f} m of {LONGER} m",
)
beyond = velocities[reach > before]
b.check("and it flows", float((beyond @ along).mean()) > 0, f"{(beyond @ along).mean():.2f} m/s downstream")
edge = np.abs(fluid.means - (middle + 0.45 * along))
inside = (np.hypot(edge[:, 0], edge[:, 1]) < 0.4 * size) & (edge[:, 2] < 1.4 * size)
b.check("no water inside the pillar", inside.mean() < 1e-3, f"{inside.sum()} of {len(inside)} splats")
b.solids_stay_dry()
end(b)
