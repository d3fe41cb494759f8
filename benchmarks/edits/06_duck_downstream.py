"""A duck is dropped into the river and floats down it.

The same from the shell; any closed mesh will do for the duck (duck.py wrote this one):

    python benchmarks/edits/duck.py demo.fluid/duck.obj
    fluidlift edit demo.fluid --set extend_downstream=0.8 \\
        --add obstacles='{name: duck, mesh: duck.obj, position: [-0.4, 0, 0.2], motion: free, density: 350}'
    fluidlift sim demo.fluid --duration 2
    fluidlift render demo.fluid -o duck.mp4 --view side
"""

import numpy as np
from duck import write_duck
from workbench import FIRST, bench, end, places

from fluidlift.numerics.mesh_distance import mesh_distance
from fluidlift.numerics.sampling import sample_faces, sample_nodes
from fluidlift.pipeline import EditSession
from fluidlift.pipeline.editing import Add, Set
from fluidlift.types import matrix_from_quat

DENSITY = 350.0
"""kg/m^3: a hollow toy"""
LONGER, SECONDS = 0.8, 2.0

b = bench("duck", __doc__)
asset = b.asset
along = asset.terrain.mainstream / np.linalg.norm(asset.terrain.mainstream)
h = asset.terrain.grid.spacing
mesh = write_duck(b.folder / "duck.obj", 9 * h)
length, tall = float(np.ptp(mesh.vertices[:, 0])), float(np.ptp(mesh.vertices[:, 2]))

# a hand above the upstream part, where deep water is fast
points = asset.rest.means
reach = points @ along
upstream = points[(reach > np.percentile(reach, 20)) & (reach < np.percentile(reach, 40))]
downstream = np.maximum(sample_faces(asset.velocity, asset.grid, upstream) @ along, 0.0)
cells, column = np.unique(np.floor(upstream[:, :2] / length).astype(int), axis=0, return_inverse=True)
middle = (cells[np.bincount(column.ravel(), downstream).argmax()] + 0.5) * length
near = np.linalg.norm(upstream[:, :2] - middle, axis=1) < 0.5 * length
height = float(upstream[near, 2].max()) + 0.7 * tall
turn = float(np.degrees(np.arctan2(along[1], along[0])))

edits = EditSession.open(b.folder)
duck = {"name": "duck", "mesh": "duck.obj", "position": places([*middle, height]), "rotation": places([0, 0, turn]),
        "motion": "free", "density": DENSITY}  # fmt: skip
edits.apply([Set("extend_downstream", LONGER), Add("obstacles", duck)])
b.edited(edits)
b.simulate(SECONDS)
b.film("06_duck")
b.picture("06_duck")

poses = b.history().poses[:, 0]
half = len(poses) // 2
moved, seconds = float((poses[-1, :3] - poses[half, :3]) @ along), (len(poses) - 1 - half) * asset.interval
speed = float(np.linalg.norm(asset.parameters.inflow_velocity))
# it starts at rest and must fall first; from then on the water carries it, more slowly behind rocks
b.check(
    "the duck floats downstream",
    moved > 0.3 * speed * seconds,
    f"{moved:.2f} m in the last {seconds:.1f} s; the inflow would go {speed * seconds:.2f} m",
)

# Archimedes: the share of the duck below the water is its density over the water's
found = mesh_distance(mesh, length / 40)
nodes = np.stack(np.meshgrid(*(np.arange(n) for n in found.distance.shape), indexing="ij"), axis=-1)
inside = (nodes * found.grid.spacing + found.grid.low)[found.distance < 0]
shares = []
for number in range(half, len(poses)):
    fluid, _ = b.splats(FIRST + number)
    away = np.linalg.norm(fluid.means[:, :2] - poses[number, :2], axis=1)
    ring = fluid.means[(away > 0.6 * length) & (away < 1.2 * length)]
    if len(ring) < 20:
        continue
    # the surface: of each column of a cell the highest particle, plus a quarter of a cell, half the distance of two
    column = np.floor(ring[:, :2] / h).astype(int)
    _, column = np.unique(column, axis=0, return_inverse=True)
    top = np.full(column.max() + 1, -np.inf)
    np.maximum.at(top, column.ravel(), ring[:, 2])
    level = float(np.median(top)) + 0.25 * h
    body = inside @ matrix_from_quat(poses[number, 3:]).T + poses[number, :3]
    shares.append(float((body[:, 2] < level).mean()))
share, wanted = float(np.mean(shares)), DENSITY / asset.parameters.density
# the level around the duck is known to half a cell or so: waves, and a body that the grid sees with cells
tolerance = 0.5 * h / tall + 0.05
b.check(
    "at Archimedes' depth",
    abs(share - wanted) < tolerance,
    f"{share:.2f} of it below the water (from {min(shares):.2f} to {max(shares):.2f}), {wanted:.2f} by weight",
)
upright = np.array([matrix_from_quat(p[3:])[2, 2] for p in poses[half:]])
# waves of a third of its length rock it; a duck on its side has 0, one on its head -1
b.check("keel down", upright.min() > 0.5, f"leaning by {np.degrees(np.arccos(upright.min())):.0f} degrees at most")
grid, distance = asset.terrain.grid, asset.terrain.signed_distance
skin = [mesh.vertices @ matrix_from_quat(p[3:]).T + p[:3] for p in poses]
depth = min(float(sample_nodes(distance, grid, v[grid.contains(v)]).min(initial=np.inf)) for v in skin)
# the ground is known to half a cell: contacts are found on the grid's distances
b.check("out of the bed", depth > -0.5 * h, f"nearest to the ground {1e3 * depth:.0f} mm, a cell is {1e3 * h:.0f} mm")
b.divergence_free()
b.solids_stay_dry()
end(b)
