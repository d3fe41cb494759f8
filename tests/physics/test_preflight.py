"""What cannot be simulated is said before the simulation begins, with numbers."""

import os
import subprocess
import sys

import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.physics import preflight
from fluidlift.types import CellType, Grid, Terrain, TriangleMesh

GRID = Grid((12, 6, 6), 0.1)

RUN = """
import sys
import numpy as np
from fluidlift.physics.apic import LiquidSimulator
from fluidlift.types import FluidParameters, Grid, Particles, Terrain, TriangleMesh

def simulate(n):
    grid = Grid((n, n, n), 1.0 / n)
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    terrain = Terrain(grid, np.full((n + 1,) * 3, 10.0, np.float32), np.array([1.0, 0.0, 0.0]), mesh)
    per_side = 2 * n
    axis = (np.arange(per_side) + 0.5) / per_side
    points = np.stack(np.meshgrid(axis, axis, axis[: n // 2], indexing="ij"), -1).reshape(-1, 3)
    body = Particles.at_rest(points, 1.0)
    LiquidSimulator(grid, terrain, FluidParameters(), body, cell_types=np.zeros((n, n, n), np.uint8)).advance(0.01)
    return grid.cells, len(body)

def memory(name):
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) * 1024 for line in status if line.startswith(name))

simulate(8)  # compiles, or loads what is compiled
with open("/proc/self/clear_refs", "w") as reset:
    reset.write("5")  # forget the peak so far
before = memory("VmRSS:")
cells, particles = simulate(int(sys.argv[1]))
print(cells, particles, memory("VmHWM:") - before)
"""


def terrain(distance=None):
    distance = np.full(tuple(n + 1 for n in GRID.shape), 10.0) if distance is None else distance
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    return Terrain(GRID, np.float32(distance), np.array([1.0, 0.0, 0.0]), mesh)


def inlet(layers=2):
    cells = np.zeros(GRID.shape, np.uint8)
    cells[:layers] = CellType.INFLOW
    return cells


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/proc is Linux's")
def test_the_memory_that_is_announced_is_the_memory_that_is_taken():
    run = subprocess.run([sys.executable, "-c", RUN, "48"], capture_output=True, text=True, env=os.environ)
    assert run.returncode == 0, run.stderr
    cells, particles, taken = map(int, run.stdout.split())
    announced = cells * preflight.BYTES_PER_CELL + particles * preflight.BYTES_PER_PARTICLE
    # an estimate: half of it is on the safe side, and more than the announced by a half would end in swapping
    assert 0.5 * announced < taken < 1.5 * announced


def test_a_grid_that_does_not_fit_is_rejected_with_its_numbers():
    grid = Grid((2000, 1000, 500), 0.01)
    with pytest.raises(InputRejected, match=r"2000 x 1000 x 500 = 1,000,000,000 cells.* GB, and 8\.0 GB are free"):
        preflight.check_memory(grid, 10**6, 8 * 10**9)
    preflight.check_memory(Grid((64, 64, 64), 0.01), 10**5, 8 * 10**9)


def test_an_inlet_inside_the_terrain_is_rejected():
    x = GRID.nodes()
    with pytest.raises(InputRejected, match="72 inflow cells lie inside the terrain"):
        preflight.check_inlet(terrain(x[..., 0] - 0.35), inlet(), np.array([1.0, 0.0, 0.0]))
    preflight.check_inlet(terrain(x[..., 2] - 0.25), inlet(), np.array([1.0, 0.0, 0.0]))  # the bed takes a part of it


def test_an_inlet_that_blows_at_a_wall_is_rejected():
    wall = 0.35 - GRID.nodes()[..., 0]  # solid from x = 0.35 on, right behind inlet cells that reach to 0.4
    with pytest.raises(InputRejected, match=r"\(1, 0, 0\) m/s points into walls"):
        preflight.check_inlet(terrain(wall), inlet(4), np.array([1.0, 0.0, 0.0]))
    preflight.check_inlet(terrain(), inlet(4), np.array([1.0, 0.0, 0.0]))


def test_an_inlet_that_stands_still_or_is_not_there_is_no_fault():
    wall = terrain(0.35 - GRID.nodes()[..., 0])
    preflight.check_inlet(wall, inlet(4), np.zeros(3))
    preflight.check_inlet(wall, np.zeros(GRID.shape, np.uint8), np.array([1.0, 0.0, 0.0]))


def test_frames_without_end_and_frames_too_far_apart_are_rejected():
    with pytest.raises(InputRejected, match="2,500,000 frames"):
        preflight.check_frames(2_500_000, 0.04, 0.01, 1000)
    with pytest.raises(InputRejected, match=r"2,000 steps of 0\.005 s"):
        preflight.check_frames(10, 10.0, 0.005, 1000)
    preflight.check_frames(250, 0.04, 0.005, 1000)
