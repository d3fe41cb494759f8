"""An inlet that moves, as a jug in a hand does."""

import numpy as np
import pytest

from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.emitter import Supply
from fluidlift.physics.inflow_schedule import InletPath
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid, Particles, Terrain, TriangleMesh

H, SPEED = 0.05, 1.0
GRID = Grid((24, 12, 24), H)


def jet(path: InletPath | None = None, seed: int = 0) -> LiquidSimulator:
    """A jet of four by four cells that falls from the top of a box, out of which its floor lets it."""
    cells = np.zeros(GRID.shape, np.uint8)
    cells[4:8, 4:8, 20:22] = CellType.INFLOW
    cells[:, :, 0] = CellType.OUTFLOW
    distance = GRID.nodes()[..., 2] + 1.0
    terrain = Terrain(GRID, distance.astype(np.float32), np.array([0.0, 0.0, -1.0]), no_mesh())
    fast_in_the_middle = FaceVelocity.zeros(GRID)
    fast_in_the_middle.w[5:7, 5:7, :] = -1.5
    fast_in_the_middle.w[4:8, 4:8, :] -= 0.5
    parameters = FluidParameters(time_step=0.01, inflow_velocity=(0.0, 0.0, -SPEED))
    nothing = Particles.at_rest(np.zeros((0, 3)), 1.0)
    return LiquidSimulator(
        GRID, terrain, parameters, nothing, cell_types=cells, inflow_profile=fast_in_the_middle, seed=seed,
        supply=Supply(path=path),
    )  # fmt: skip


def no_mesh() -> TriangleMesh:
    return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))


def along_x(*steps: tuple[float, int]) -> InletPath:
    times, cells = zip(*steps)
    return InletPath(np.array(times), np.array([(c, 0, 0) for c in cells]))


def under(simulator: LiquidSimulator, height: float) -> np.ndarray:
    """x (m) of the particles that left the inlet and are above a height."""
    p = simulator.particles.positions
    return p[(p[:, 2] > height) & (p[:, 2] < 20 * H), 0]


def test_a_path_that_stays_is_the_inlet_that_stands():
    plain, stays = jet(), jet(along_x((0.0, 0)))
    for _ in range(4):
        plain.advance(0.02)
        stays.advance(0.02)
    assert len(plain.particles) == len(stays.particles) > 300
    np.testing.assert_allclose(stays.particles.positions, plain.particles.positions, atol=1e-4)


def test_what_comes_later_falls_from_where_the_inlet_stands_by_then_and_what_fell_before_does_not_follow():
    moves = jet(along_x((0.0, 0), (0.1, 5), (0.3, 10)))
    for step in range(20):
        moves.advance(0.02)
        x = under(moves, 19 * H)
        first = 4 + (0 if step < 5 else 5 if step < 15 else 10)
        if (step + 5) % 10 > 4 or step < 5:  # what it leaves behind as it goes falls for 0.1 s
            assert x.min() > (first - 0.6) * H and x.max() < (first + 4.6) * H
    below = moves.particles.positions[moves.particles.positions[:, 2] < 10 * H, 0] / H
    first, second = np.abs(below - 6) < 2.6, np.abs(below - 11) < 2.6
    assert first.sum() > 50 and second.sum() > 50 and (first | second).all(), "it goes straight down"


def test_as_much_flows_in_and_as_fast_wherever_it_stands():
    plain, moves = jet(), jet(along_x((0.0, 2), (0.04, 6), (0.08, 9)))
    for _ in range(8):
        plain.advance(0.02)
        moves.advance(0.02)
    # what is left behind in its old place falls on, and the new one is filled: once its own volume for each move
    filled = 2 * 4 * 4 * 2 * H**3
    assert plain.volume < moves.volume < plain.volume + 1.1 * filled

    def speeds(simulator: LiquidSimulator, x: int) -> tuple[float, float]:
        """In the middle of the inlet, and around that, m/s."""
        p = simulator.particles
        apart = np.abs(p.positions - np.array([x, 6, 21]) * H)
        held, middle = (apart < np.array([2, 2, 1]) * H).all(axis=1), (apart < H).all(axis=1)
        return float(p.velocities[held & middle, 2].mean()), float(p.velocities[held & ~middle, 2].mean())

    there, home = speeds(moves, 15), speeds(plain, 6)
    assert there == pytest.approx(home, rel=0.03) and home[0] < 2.0 * home[1], "its profile moves along"


def test_it_goes_on_from_a_state_where_it_stands_then_and_stays_in_the_box():
    steps = along_x((0.0, 0), (0.05, 3), (0.1, 30))
    moves, again = jet(steps), jet(steps)
    for _ in range(4):
        moves.advance(0.02)
    again.restore(moves.state())
    for _ in range(4):
        moves.advance(0.02)
        again.advance(0.02)
    np.testing.assert_array_equal(moves.particles.positions, again.particles.positions)
    assert under(moves, 17 * H).max() < 12 * H, "beyond the box there is no place: it stays where it was"
    away = jet(along_x((0.0, -100)))
    away.advance(0.02)
    assert len(away.particles) > 100


@pytest.mark.parametrize(
    ("times", "cells"), [([], []), ([0.1], [[0, 0, 0]]), ([0.0, 0.0], [[0, 0, 0]] * 2), ([0.0], [[0, 0, 0]] * 2)]
)
def test_a_path_that_is_none_is_refused(times, cells):
    with pytest.raises(ValueError):
        InletPath(np.array(times, float), np.array(cells, int).reshape(-1, 3))
