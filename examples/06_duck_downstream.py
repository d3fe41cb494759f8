"""A duck is dropped into the river and floats down it.

The same from the shell, with a duck of your own:

    cp duck.obj demo.fluid/
    fluidlift edit demo.fluid --set extend_downstream=0.8 \\
        --add obstacles='{name: duck, mesh: duck.obj, position: [-0.4, 0, 0.3], motion: free, density: 350}'
    fluidlift sim demo.fluid --duration 2
    fluidlift render demo.fluid -o duck.mp4 --view side
"""

import numpy as np
from duck import write_duck
from workbench import FIRST, bench, end

from fluidlift.io.asset_folder import load_asset
from fluidlift.numerics.mesh_distance import mesh_distance
from fluidlift.pipeline import EditSession
from fluidlift.pipeline.editing import Set
from fluidlift.types import matrix_from_quat

DENSITY = 350.0
"""kg/m^3"""

b = bench("duck", __doc__)
asset = load_asset(b.folder)
along = asset.terrain.mainstream / np.linalg.norm(asset.terrain.mainstream)
h = asset.terrain.grid.spacing
length = 8 * h
mesh = write_duck(b.folder / "duck.obj", length)

# over the deepest water of the upstream part
points = asset.rest.means
reach = points @ along
upstream = points[(reach > np.percentile(reach, 20)) & (reach < np.percentile(reach, 40))]
cells, counts = np.unique(np.floor(upstream[:, :2] / (2 * h)).astype(int), axis=0, return_counts=True)
x, y = (cells[counts.argmax()] + 0.5) * 2 * h
z = float(points[:, 2].max()) + 0.35 * float(np.ptp(mesh.vertices[:, 2]))
turn = float(np.degrees(np.arctan2(along[1], along[0])))

edits = EditSession.open(b.folder)
edits.apply([Set("extend_downstream", 0.8)])
edits.add(
    "obstacles",
    {"name": "duck", "mesh": "duck.obj", "position": [float(x), float(y), z], "rotation": [0, 0, turn],
     "motion": "free", "density": DENSITY},
)  # fmt: skip
print(edits.diff())
b.simulate(2.0)
b.film("06_duck", background="terrain")
b.picture("06_duck", background="terrain")

poses = b.history()["poses"][:, 0]
moved = float((poses[-1, :3] - poses[0, :3]) @ along)
b.check("the duck floats downstream", moved > 0.05, f"{moved:.2f} m in {len(poses)} frames")

# Archimedes: the share of the duck below the water is its density over the water's
found = mesh_distance(mesh, length / 40)
nodes = np.stack(np.meshgrid(*(np.arange(n) for n in found.distance.shape), indexing="ij"), axis=-1)
inside = (nodes * found.grid.spacing + found.grid.low)[found.distance < 0]
shares = []
for number in range(len(poses) // 2, len(poses)):
    fluid, _ = b.splats(FIRST + number)
    away = np.linalg.norm(fluid.means[:, :2] - poses[number, :2], axis=1)
    ring = fluid.means[(away > 0.6 * length) & (away < 1.2 * length)]
    if len(ring) < 20:
        continue
    level = np.percentile(ring[:, 2], 95) + 0.25 * h  # particles lie half a cell apart, the surface half of that above
    body = inside @ matrix_from_quat(poses[number, 3:]).T + poses[number, :3]
    shares.append(float((body[:, 2] < level).mean()))
share, wanted = float(np.mean(shares)), DENSITY / asset.parameters.density
# the water is two to five cells deep and waves pass: the level around the duck is known to a cell or so
tolerance = h / float(np.ptp(mesh.vertices[:, 2])) + 0.1
b.check(
    "at Archimedes' depth",
    abs(share - wanted) < tolerance,
    f"{share:.2f} of it below the water, {wanted:.2f} by weight",
)
lowest = min(float((mesh.vertices @ matrix_from_quat(p[3:]).T + p[:3])[:, 2].min()) for p in poses)
bed = float(asset.terrain.mesh.vertices[:, 2].min())
b.check("above the bed", lowest > bed - h, f"lowest point {lowest:.2f} m, lowest bed {bed:.2f} m")
b.solids_stay_dry()
end(b)
