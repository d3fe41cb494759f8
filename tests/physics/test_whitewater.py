"""Spray, foam and bubbles: where they come from, and how they move."""

from dataclasses import replace

import numba
import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.physics import whitewater
from fluidlift.physics.whitewater import (
    BUBBLE,
    FOAM,
    LIFE,
    RISE,
    SPRAY,
    Ground,
    LiquidState,
    PotentialRange,
    SeenBirths,
    Whitewater,
    WhitewaterLaw,
    fallen,
    lots,
    neighbours,
    relative_motion,
    told,
)
from fluidlift.synthetic.tanks import dam_break, pool
from fluidlift.types import Grid, Particles, Terrain, TriangleMesh

H = 0.05
G = (0.0, 0.0, -9.81)
LAW = WhitewaterLaw(PotentialRange(0.02, 0.1), PotentialRange(2.0, 20.0), PotentialRange(0.05, 0.5), 200.0, 200.0)
"""limits between a pool at rest (0.003 m/s) and water that hits a wall (0.1 m/s)"""
DAM = WhitewaterLaw(PotentialRange(0.12, 0.5), PotentialRange(8.0, 30.0), PotentialRange(0.05, 0.5), 200.0, 200.0)
"""of a dam of 0.4 m, whose front closes in on itself by up to 0.11 m/s as it runs out, and by 0.8 m/s at the wall"""


STILL = np.zeros((3, 3))


def terrain(shape=(24, 16, 20), bed=0.0):
    """A level bed, whose box begins below it."""
    grid = Grid(shape, H)
    mesh = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    return Terrain(grid, (grid.nodes()[..., 2] - bed).astype(np.float32), np.array([1.0, 0.0, 0.0]), mesh)


def block(ground, velocity, gradient=STILL, low=(0.2, 0.2, 0.0), high=(1.0, 0.6, 0.5)):
    """Water that moves as velocity + gradient (x - middle), eight particles to a cell."""
    low, high = np.asarray(low), np.asarray(high)
    count = np.round((high - low) / (0.5 * H)).astype(int)
    places = low + (np.moveaxis(np.indices(count), 0, -1).reshape(-1, 3) + 0.5) * 0.5 * H
    moves = np.asarray(velocity) + (places - 0.5 * (low + high)) @ np.asarray(gradient).T
    made = Particles.at_rest(places, 1000.0 * (0.5 * H) ** 3, velocities=moves)
    return replace(made, affine=np.broadcast_to(np.float32(gradient), (len(places), 3, 3)).copy())


def ground_of(land):
    return Ground.of(land, np.zeros(land.grid.shape, np.uint8))


@pytest.fixture(scope="module")
def flat():
    return ground_of(terrain())


TURN = np.array([[0.0, -3.0, 1.0], [3.0, 0.0, -2.0], [-1.0, 2.0, 0.0]])
"""1/s, a rotation"""


@pytest.mark.parametrize("gradient", [STILL, TURN], ids=["uniform", "turning"])
def test_water_that_moves_as_one_traps_no_air_and_has_no_crests(flat, gradient):
    state = LiquidState.of(block(flat, (1.5, -0.4, 0.2), gradient), flat, 1000.0)
    # single precision, of speeds up to 3 m/s
    assert state.trapped.max() < 1e-5
    inner = state.crest[6:-6, 6:-6]
    assert inner.max() < 0.01 and state.energy.max() > 1.0


def test_trapped_air_and_crests_are_those_of_any_observer_who_moves_evenly(flat):
    gradient = np.diag([-2.0, 1.0, 1.0])
    first, second = (LiquidState.of(block(flat, v, gradient), flat, 1000.0) for v in ((0, 0, 0), (2.0, -1.0, 0.5)))
    assert first.trapped.max() > 0.04
    np.testing.assert_allclose(first.trapped, second.trapped, atol=2e-6)
    # whether a crest moves along its normal is a question of yes and no
    assert (np.abs(first.crest - second.crest) > 1e-3).mean() < 1e-3


def test_air_is_trapped_where_water_closes_in_and_not_where_it_comes_apart(flat):
    closing, apart = (
        LiquidState.of(block(flat, (0, 0, 0), s * np.diag([1.0, 0.0, 0.0])), flat, 1000.0) for s in (-2.0, 2.0)
    )
    assert closing.trapped.max() > 0.04 and apart.trapped.max() < 1e-6


def plain_relative_motion(asked, wet, velocity):
    """The twin of the kernel, for reading."""
    closing, apart = np.zeros(wet.shape), np.zeros((*wet.shape, 3))
    for place in np.argwhere(asked):
        total, near, mean = 0.0, 0.0, np.zeros(3)
        for *offset, weight in neighbours():
            there = place + np.array(offset, int)
            if (there < 0).any() or (there >= wet.shape).any() or not wet[tuple(there)]:
                continue
            relative = velocity[tuple(there)].astype(float) - velocity[tuple(place)]
            near += weight * max(0.0, -relative @ offset / np.linalg.norm(offset))
            mean -= weight * relative
            total += weight
        if total > 0:
            closing[tuple(place)], apart[tuple(place)] = near / total, mean / total
    return closing, apart


def test_the_kernel_and_its_plain_twin_agree():
    rng = np.random.default_rng(0)
    wet = rng.random((9, 8, 7)) < 0.7
    velocity = rng.normal(size=(9, 8, 7, 3)).astype(np.float32)
    asked = wet & (rng.random(wet.shape) < 0.3)
    for mine, plain in zip(relative_motion(asked, wet, velocity), plain_relative_motion(asked, wet, velocity)):
        np.testing.assert_allclose(mine, plain, rtol=1e-12, atol=1e-12)


def test_a_pool_at_rest_makes_none():
    tank = pool(cells=16)
    simulator, water = tank.simulator(), Whitewater(ground_of(tank.terrain), LAW, G, 1000.0)
    for _ in range(5):
        simulator.advance(0.04)
        water.advance(simulator.particles, 0.04)
    assert len(water) == 0 and water.next_id == 0


def broken_dam(threads=2):
    """(most particles of white water before the front has come to the wall, after it, the last state): 0.4 m high."""
    before = numba.get_num_threads()
    numba.set_num_threads(min(threads, before))
    try:
        tank = dam_break(cells=8, base=0.2, length=4.0)
        simulator, water = tank.simulator(), Whitewater(ground_of(tank.terrain), DAM, G, 1000.0, seed=3)
        made = {False: 0, True: 0}
        for _ in range(26):
            simulator.advance(0.03)
            water.advance(simulator.particles, 0.03)
            arrived = float(simulator.particles.positions[:, 0].max()) > tank.grid.high[0] - 1.5 * tank.grid.spacing
            made[arrived] = max(made[arrived], water.next_id)
        return made[False], made[True], water
    finally:
        numba.set_num_threads(before)


@pytest.fixture(scope="module")
def dam():
    return broken_dam()


def test_a_dam_break_makes_white_water_when_it_hits_the_wall(dam):
    before, after, water = dam
    assert before == 0 and after > 100
    assert len(np.unique(water.ids)) == len(water) and (water.ids < water.next_id).all()
    assert water.ground.terrain.grid.contains(water.positions).all()


def test_one_thread_and_two_give_the_same_bytes(dam):
    other = broken_dam(threads=1)[2].state()
    for name, values in dam[2].state().items():
        np.testing.assert_array_equal(values, other[name], err_msg=name)


def test_a_state_goes_on_bit_for_bit_and_one_that_does_not_fit_is_refused(dam):
    water = dam[2]
    kept, body = water.state(), block(water.ground, (0.3, 0, 0), low=(0.1, 0.0, 0.0), high=(0.5, 0.1, 0.2))
    first, second = (Whitewater(water.ground, LAW, G, 1000.0, seed=3) for _ in range(2))
    for one in (first, second):
        one.restore(kept)
        one.advance(body, 0.03)
    for name, values in first.state().items():
        np.testing.assert_array_equal(values, second.state()[name])
    with pytest.raises(InputRejected, match="does not fit"):
        second.restore({k: v for k, v in kept.items() if k != "lives"})
    with pytest.raises(InputRejected, match="another shape"):
        second.restore(kept | {"lives": np.full(len(water), np.nan)})


@pytest.mark.parametrize(("speed", "share"), [(1.0, 1.0), (2.0, 1.0), (0.5, 0.25), (0.0, 0.0)])
def test_as_many_are_born_in_a_column_as_are_asked_for_and_fewer_in_slower_water(flat, speed, share):
    water, shape = block(flat, (speed, 0.0, 0.0)), flat.terrain.grid.shape[:2]
    rate, full = np.zeros(shape), np.full(shape, 0.5)  # m^2/s^2 of 1 m/s
    rate[8:16, 6:10] = 50.0
    law = replace(LAW, trapped_rate=0.0, crest_rate=0.0, seen=SeenBirths(flat.terrain.grid, rate, full))
    white = Whitewater(flat, law, G, 1000.0)
    state = LiquidState.of(water, flat, 1000.0)
    white._bear(state, water, 1.0)
    # 1600 a second, within four standard deviations and what the particles' lattice leaves uneven
    assert white.next_id == pytest.approx(1600 * share, abs=240)
    if share:
        depth = 0.5 - white.positions[:, 2]
        assert np.median(depth) < 1.1 * H  # at the surface


def seen_law(flat, **parts):
    none = np.zeros(flat.terrain.grid.shape[:2])
    return replace(LAW, trapped_rate=0.0, crest_rate=0.0, seen=SeenBirths(flat.terrain.grid, none, none, **parts))


def test_what_a_film_shows_is_there_from_the_first_step_on_and_of_any_age(flat):
    there = np.zeros(flat.terrain.grid.shape[:2])
    there[6:18, 5:11] = 4.0
    water = Whitewater(flat, seen_law(flat, there=there), G, 1000.0)
    liquid = block(flat, (1.0, 0.0, 0.0))
    water.advance(liquid, 0.01)
    many = len(water)
    assert many == pytest.approx(there.sum(), rel=0.2)
    longest = LIFE[0] + (LIFE[1] - LIFE[0]) * float(LAW.energy.share(np.array(0.5)))
    assert np.histogram(water.lives, 4, (0.0, longest))[0] == pytest.approx(np.full(4, many / 4), rel=0.4)
    water.advance(liquid, 0.01)
    assert len(water) <= many and water.next_id == many  # once


def test_foam_breaks_up_where_a_film_says_so(flat):
    there = np.full(flat.terrain.grid.shape[:2], 10.0)
    breaking = np.zeros_like(there)
    breaking[12:] = 5.0
    water = Whitewater(flat, seen_law(flat, there=there, breaking=breaking), G, 1000.0)
    liquid = block(flat, (0.0, 0.0, 0.0))
    for _ in range(20):  # 0.2 s in still water
        water.advance(liquid, 0.01)
    on = water.kinds == FOAM
    right = flat.terrain.grid.cell_of(water.positions)[:, 0] >= 12
    free = Whitewater(flat, seen_law(flat, there=there), G, 1000.0)
    for _ in range(20):
        free.advance(liquid, 0.01)
    beside = flat.terrain.grid.cell_of(free.positions)[:, 0] >= 12
    assert (on & ~right).sum() == pytest.approx(((free.kinds == FOAM) & ~beside).sum(), rel=0.05)
    share = (on & right).sum() / ((free.kinds == FOAM) & beside).sum()
    assert share == pytest.approx(np.exp(-1.0), rel=0.2)


def test_a_state_of_more_than_the_law_allows_is_refused(flat):
    white = Whitewater(flat, replace(LAW, most=10), G, 1000.0)
    other = Whitewater(flat, LAW, G, 1000.0, positions=np.zeros((11, 3)), velocities=np.zeros((11, 3)),
                       lives=np.ones(11), kinds=np.zeros(11, np.uint8), ids=np.arange(11))  # fmt: skip
    with pytest.raises(InputRejected, match="11 particles"):
        white.restore(other.state())
    assert len(white) == 0


def one_of(ground, place, velocity=(0.0, 0.0, 0.0), law=LAW):
    """White water of one particle."""
    water = Whitewater(ground, law, G, 1000.0)
    water.positions, water.velocities = np.array([place], float), np.array([velocity], float)
    water.lives, water.kinds, water.ids, water.next_id = np.array([9.0]), np.zeros(1, np.uint8), np.zeros(1, int), 1
    return water


def test_spray_falls_by_half_g_t_squared(flat):
    still = block(flat, (0, 0, 0), high=(1.0, 0.6, 0.1))
    water, start = one_of(flat, (0.3, 0.4, 0.9), (0.5, 0.0, 0.0)), np.array([0.3, 0.4, 0.9])
    for _ in range(5):
        water.advance(still, 0.06)
    assert water.kinds[0] == SPRAY
    # drag takes t / (3 v / g) of the fall and t / (2 v / g) of the way, v = 8 m/s: 12 and 18 % at most here
    t = 0.3
    assert start[2] - water.positions[0, 2] == pytest.approx(0.5 * 9.81 * t * t, rel=0.13)
    assert water.positions[0, 0] - 0.3 == pytest.approx(0.5 * t, rel=0.19)


@pytest.mark.parametrize("slow", [1e-4, 0.1, 1e3, 1e9])
def test_a_fall_with_drag_is_exact_whatever_the_steps(slow):
    x, v, push = np.zeros((1, 3)), np.array([[1.0, 0.0, 2.0]]), np.array([0.0, 0.0, -9.81])
    once = fallen(x, v, push, slow, 0.4)
    for _ in range(8):
        x, v = fallen(x, v, push, slow, 0.05)
    np.testing.assert_allclose(x, once[0], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(v, once[1], rtol=1e-6, atol=1e-9)
    if slow > 1e2:
        np.testing.assert_allclose(x[0], [0.4, 0.0, 0.8 - 0.5 * 9.81 * 0.16], atol=1e-3)


def test_foam_goes_with_the_surface_and_stays_on_it(flat):
    water, body = one_of(flat, (0.5, 0.4, 0.47)), block(flat, (0.6, 0.1, 0.0))
    for _ in range(5):
        water.advance(body, 0.05)
    assert water.kinds[0] == FOAM
    # the surface of a block of particles is known to a few hundredths of a cell
    np.testing.assert_allclose(water.positions[0], [0.65, 0.425, 0.5], atol=0.1 * H)
    np.testing.assert_allclose(water.velocities[0], [0.6, 0.1, 0.0], atol=1e-3)


def test_a_bubble_rises_as_fast_as_bubbles_do(flat):
    water, body = one_of(flat, (0.5, 0.4, 0.12)), block(flat, (0.2, 0.0, 0.0), high=(1.0, 0.6, 0.7))
    for _ in range(10):
        water.advance(body, 0.05)
    assert water.kinds[0] == BUBBLE and water.velocities[0, 2] == pytest.approx(RISE, rel=1e-3)
    assert water.positions[0, 2] - 0.12 == pytest.approx(0.5 * RISE, rel=0.05)  # it takes 0.01 s to get up to speed
    assert water.positions[0, 0] - 0.5 == pytest.approx(0.1, rel=0.05)


def test_kinds_go_by_how_much_water_is_around(flat):
    state = LiquidState.of(block(flat, (0, 0, 0)), flat, 1000.0)
    places = np.array([[0.6, 0.4, 0.5 + d * H] for d in (-2.0, 0.0, 2.0)] + [[0.6, 0.4, 40.0]])
    assert told(state, places).tolist() == [BUBBLE, FOAM, SPRAY, SPRAY]


@pytest.mark.parametrize(
    "place, velocity", [((0.6, 0.4, 0.12), (0, 0, -9.0)), ((1.15, 0.4, 0.9), (9.0, 0, 0))], ids=["ground", "box"]
)
def test_white_water_ends_in_the_ground_and_beyond_the_box(place, velocity):
    ground = ground_of(terrain(bed=0.1))
    water = one_of(ground, place, velocity)
    water.advance(block(ground, (0, 0, 0), low=(0.2, 0.2, 0.1), high=(0.4, 0.4, 0.2)), 0.1)
    assert len(water) == 0


def test_white_water_ends_at_outlets_in_bodies_and_with_its_life(flat):
    body = block(flat, (0, 0, 0))
    outlet = replace(flat, outlet=np.ones(flat.outlet.shape, bool))
    for water, inside in (
        (one_of(outlet, (0.6, 0.4, 0.5)), None),
        (one_of(flat, (0.6, 0.4, 0.5)), lambda x: np.ones(len(x), bool)),
    ):
        water.advance(body, 0.01, inside)
        assert len(water) == 0
    old = one_of(flat, (0.6, 0.4, 0.5))
    old.lives[:] = 0.05
    old.advance(body, 0.04)
    assert len(old) == 1
    old.advance(body, 0.04)
    assert len(old) == 0


def test_more_than_the_limit_is_thinned_by_lot_and_known():
    ground = ground_of(terrain())
    body = block(ground, (1.0, 0, 0), np.diag([-4.0, 2.0, 2.0]))
    free, held = (Whitewater(ground, replace(LAW, trapped_rate=2000.0, most=most), G, 1000.0) for most in (10**6, 500))
    for _ in range(3):
        free.advance(body, 0.02)
        before = held.ids
        held.advance(body, 0.02)
        assert len(held) <= 500
    assert len(free) > 2000 and not free.thinned and held.thinned and len(held) == 500
    # most that were there are still there: the same ids win
    assert np.isin(before, held.ids).sum() > 100
    assert len(np.unique(lots(np.arange(10_000)))) == 10_000


def test_what_a_column_is_known_to_do_makes_none(flat):
    body = block(flat, (1.0, 0, 0), np.diag([-4.0, 2.0, 2.0]))
    state, shape = LiquidState.of(body, flat, 1000.0), flat.terrain.grid.shape[:2]
    none = np.zeros(shape)
    everywhere, nowhere = (
        replace(LAW, known=(flat.terrain.grid, np.full(shape, most), none + 1e9 * (most > 0))) for most in (0.0, 1e9)
    )
    assert everywhere.births(state).sum() == LAW.births(state).sum() > 0.0
    assert nowhere.births(state).sum() == 0.0


def test_without_liquid_what_is_left_falls(flat):
    water = one_of(flat, (0.5, 0.4, 0.8))
    nothing = block(flat, (0, 0, 0)).select(np.zeros(0, int))
    assert water.advance(nothing, 0.1) is None
    assert 0.8 - water.positions[0, 2] == pytest.approx(0.5 * 9.81 * 0.01, rel=0.05)
    assert whitewater.SPRAY == water.kinds[0]
