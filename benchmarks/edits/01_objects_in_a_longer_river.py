"""A rock and a pillar in a river that goes on for another 0.8 m.

The same from the shell:

    fluidlift edit demo.fluid --set extend_downstream=0.8 \\
        --add obstacles='{name: rock, shape: ellipsoid, size: [0.3, 0.24, 0.3], position: [0.65, -0.15, 0.15], color: [0.5, 0.45, 0.4]}' \\
        --add obstacles='{name: pillar, shape: cylinder, radius: 0.07, height: 0.6, position: [1.15, 0.1, 0.2], color: [0.75, 0.35, 0.2]}'
    fluidlift sim demo.fluid
"""  # noqa: E501

import numpy as np
from workbench import FIRST, bench, end, places

from fluidlift.pipeline import EditSession
from fluidlift.pipeline.editing import Add, Set

LONGER = 0.8
"""m"""

b = bench("longer_river", __doc__)
asset = b.asset
along = asset.terrain.mainstream / np.linalg.norm(asset.terrain.mainstream)
across = np.cross([0.0, 0.0, 1.0], along)
middle, size = np.median(asset.rest.means, axis=0), float(np.ptp(asset.rest.means[:, 2]))
before = float((asset.rest.means @ along).max())
start = middle + (before - middle @ along) * along
"""in the middle of the old end"""

rock, radius = start - 1.8 * size * along - 0.8 * size * across, 0.4 * size
pillar = start + 0.4 * LONGER * along + 0.5 * size * across
edits = EditSession.open(b.folder)
edits.apply([
    Set("extend_downstream", LONGER),
    Add("obstacles", {"name": "rock", "shape": "ellipsoid", "size": places([1.6 * size, 1.3 * size, 1.6 * size]),
                      "position": places(rock), "color": [0.5, 0.45, 0.4]}),
    Add("obstacles", {"name": "pillar", "shape": "cylinder", "radius": round(radius, 3), "height": round(3 * size, 3),
                      "position": places(pillar), "color": [0.75, 0.35, 0.2]}),
])  # fmt: skip
b.edited(edits)
b.simulate()
b.picture("01_longer_river")

fluid, velocities = b.last()
reach = fluid.means @ along
# the channel is filled along its new part from the first frame on; its last cells belong to the outlet
b.check(
    "the added reach is wet",
    float(reach.max()) > before + 0.9 * LONGER,
    f"water goes on for {reach.max() - before:.2f} m of {LONGER} m",
)
beyond, inflow = velocities[reach > before], float(np.linalg.norm(asset.parameters.inflow_velocity))
# the same discharge in the same cross section; half of the inflow's speed leaves room for the pillar's wake
b.check(
    "and it flows",
    float((beyond @ along).mean()) > 0.5 * inflow,
    f"{(beyond @ along).mean():.2f} m/s downstream, the inflow {inflow:.2f} m/s",
)
h = b.simulated_grid().spacing
drawn = b.all_splats(FIRST + b.count - 1).means
away = np.hypot((drawn - pillar) @ along, (drawn - pillar) @ across)
inside = (away < radius - 0.1 * h) & (np.abs(drawn[:, 2] - pillar[2]) < 1.4 * size)
b.check("no water inside the pillar", not inside.any(), f"{inside.sum()} of {len(inside)} splats")
# the obstacles push water aside and a bow wave stands before them: some per cent of the whole
b.volume_kept(0.1)
b.divergence_free()
b.solids_stay_dry()
end(b)
