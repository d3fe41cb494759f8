"""Flights of a fountain's water, against the law of a stone that is thrown."""

import numpy as np
import pytest

from fluidlift.motion.thrown_up import Flight, with_flights
from fluidlift.types import GRAVITY, CellType, FaceVelocity, Grid

FLIGHT = Flight((0.2, 0.0), (0.5, 0.1), 0.4, 2.0, 0.1, 0.8)


def followed(point: np.ndarray, flight: Flight = FLIGHT, steps: int = 4000) -> np.ndarray:
    """Where a drop comes down on the level that goes as the field of velocities says, from a start in the nozzle."""
    dt = flight.duration / steps
    velocity = flight.velocity(point[None])[0]
    for _ in range(2 * steps):
        velocity = velocity - np.array([0.0, 0.0, GRAVITY * dt])
        point = point + velocity * dt
        if velocity[2] < 0 and point[2] <= flight.level:
            return point
    raise AssertionError("never down")


def test_it_reaches_its_height_and_no_more():
    middle = np.array([[*FLIGHT.nozzle, FLIGHT.level]])
    assert FLIGHT.velocity(middle)[0, 2] ** 2 / (2 * GRAVITY) == pytest.approx(FLIGHT.height)
    top = FLIGHT.velocity(np.array([[0.35, 0.05, FLIGHT.level + FLIGHT.height]]))
    assert top[0, 2] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("share", [-1.0, 0.0, 0.5])
def test_what_leaves_the_nozzle_lands_where_it_is_seen_to(share):
    start = np.array([FLIGHT.nozzle[0] + share * FLIGHT.narrow, FLIGHT.nozzle[1], FLIGHT.level])
    end = followed(start)
    np.testing.assert_allclose(end[:2] - FLIGHT.landing, [share * FLIGHT.wide, 0.0], atol=0.02)


def test_it_rises_within_and_falls_outside():
    half = FLIGHT.level + 0.5 * FLIGHT.height
    inside, outside = FLIGHT.velocity(np.array([[0.25, 0.02, half], [0.95, 0.1, half]]))
    assert inside[2] > 0 > outside[2] and inside[2] == pytest.approx(-outside[2])
    assert outside[0] > FLIGHT.velocity(np.array([[0.25, 0.02, half]]))[0, 0]  # and away from the middle


def test_the_pool_keeps_its_own_motion():
    grid = Grid((8, 8, 10), 0.25, (-1.0, -1.0, 0.0))
    cells = np.full(grid.shape, CellType.EMPTY, np.uint8)
    cells[:, :, :2] = CellType.FLUID
    cells[3:5, 3:5, 1:3] = CellType.INFLOW
    cells[3:5, 3:5, 3:9] = CellType.FLUID
    before = FaceVelocity(*(np.full(grid.face_shape(a), 0.3, np.float32) for a in range(3)))
    after = with_flights(
        before, (Flight((0.0, 0.0), (0.0, 0.0), 0.5, 1.5, 0.2, 0.3),), cells, np.full((8, 8), 0.5), grid
    )
    assert (after.components[2][0, 0] == np.float32(0.3)).all()
    assert after.at_centers()[cells == CellType.INFLOW][:, 2].min() > 3.0
    assert with_flights(before, (), cells, np.full((8, 8), 0.5), grid) is before


def test_a_flight_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="high"):
        Flight((0.0, 0.0), (0.0, 0.0), 0.0, 0.0, 0.1, 0.2)
    with pytest.raises(ValueError, match="radii"):
        Flight((0.0, 0.0), (0.0, 0.0), 0.0, 1.0, 0.3, 0.2)
