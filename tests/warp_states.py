"""Small made states of a liquid for the tests of Warp's kernels: on the host and on Warp's CPU device."""

from dataclasses import dataclass, replace

import numpy as np

from fluidlift.backends.warp_device import warp_device
from fluidlift.backends.warp_particle_store import ParticleStore
from fluidlift.backends.warp_region import WarpBox, WarpRegion
from fluidlift.physics import boundaries, transfer
from fluidlift.physics.boundaries import cell_capacity
from fluidlift.physics.free_surface import SolidShares, solid_shares
from fluidlift.types import CellType, FaceVelocity, Grid, Particles, Terrain, TriangleMesh

GRID = Grid((14, 9, 11), 0.1, (-0.4, 2.0, 0.0))
DENSITY = 1000.0


@dataclass
class Basin:
    """A wavy bed with liquid on it, an inlet at one end and an outlet at the other."""

    walls: boundaries.Walls
    capacity: np.ndarray
    solids: SolidShares
    particles: Particles
    order: transfer.CellOrder
    whole: WarpBox
    region: WarpRegion
    store: ParticleStore
    counts: object
    ends: object

    @property
    def volumes(self):
        return (self.particles.masses / DENSITY).astype(np.float32)

    @property
    def occupied(self):
        return (np.diff(self.order.start) > 0).reshape(GRID.shape)


def basin(seed=0, n=3000):
    """The basin with a body of liquid that has gaps, drops above it, and crowded cells."""
    rng = np.random.default_rng(seed)
    x = GRID.nodes() - GRID.low
    distance = 0.9 * x[..., 2] - 0.2 * x[..., 0] + 0.05 * np.sin(9 * x[..., 1]) - 0.1
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    terrain = Terrain(GRID, np.float32(distance), np.array([1.0, 0, 0]), mesh)
    types = np.zeros(GRID.shape, np.uint8)
    types[0], types[-2:] = CellType.INFLOW, CellType.OUTFLOW
    walls = boundaries.build_walls(terrain, types, np.zeros((3, 2), bool))
    low, high = GRID.low + 0.003, GRID.high - [0.003, 0.003, 0.45]
    body = rng.uniform(low, high, (n, 3))
    drops = rng.uniform(low + [0, 0, 0.6], GRID.high - 0.003, (60, 3))
    crowd = rng.uniform([0.5, 2.3, 0.45], [0.6, 2.4, 0.5], (70, 3))
    positions = np.concatenate([body, drops, crowd]).astype(np.float32)
    cell = GRID.cell_of(positions)
    clear = boundaries.mean_of_corners(walls.signed_distance)[tuple(cell.T)] > 0
    positions = positions[clear]
    m = len(positions)
    particles = replace(
        Particles.at_rest(positions, DENSITY * rng.uniform(0.5, 1.5, m) * GRID.spacing**3 / 8, np.arange(m) % 7),
        velocities=rng.normal(0, 1, (m, 3)).astype(np.float32),
        affine=rng.normal(0, 3, (m, 3, 3)).astype(np.float32),
        deformation=(np.eye(3) + rng.normal(0, 0.1, (m, 3, 3))).astype(np.float32),
    )
    order = transfer.sort_by_cell(particles.positions, GRID)
    particles = transfer.select_particles(particles, order.order)
    order = transfer.CellOrder(np.arange(m), order.start)
    capacity, solids = cell_capacity(walls.signed_distance, GRID), solid_shares(walls.signed_distance, GRID)
    device = warp_device("cpu")
    box = tuple(slice(0, k) for k in GRID.shape)
    whole = WarpBox(walls, capacity, solids, device)
    region = WarpRegion(whole, box)
    store = ParticleStore(device)
    store.upload(particles)
    counts, ends = store.sort(GRID)
    return Basin(walls, capacity, solids, particles, order, whole, region, store, counts, ends)


def on_host(faces):
    """The three components of `warp_faces.Faces` (or of marks)."""
    return tuple(getattr(faces, name).numpy() for name in "xyz")


def put_faces(faces, components):
    """Fill `warp_faces.Faces`, in place."""
    for name, values in zip("xyz", components):
        getattr(faces, name).assign(np.ascontiguousarray(values))


def random_velocity(seed=1):
    rng = np.random.default_rng(seed)
    return FaceVelocity(*(rng.normal(0, 1, GRID.face_shape(a)).astype(np.float32) for a in range(3)))
