"""Contact of rigid bodies with terrain, box and each other."""

import numpy as np
import pytest
from boxes import walls_of

from fluidlift.errors import InputRejected
from fluidlift.physics.contact import REST_GAP, SLACK
from fluidlift.physics.rigid import RigidBodies, RigidBody, Trajectory
from fluidlift.types import CellType

G = 9.81
H = 0.05
DT = 0.005


def world(bodies, shape=(20, 20, 20), distance=None, *, gravity=(0.0, 0.0, -G), regions=None):
    """Bodies in a box with an open top; `distance` gives the terrain from the nodes."""
    return RigidBodies(bodies, walls_of(shape, distance, regions=regions), density=1000.0, gravity=gravity)


def run(bodies, duration, record=lambda b: None, dt=DT):
    out = []
    for _ in range(round(duration / dt)):
        bodies.predict(dt)
        bodies.advance()
        out.append(record(bodies))
    return np.array(out)


def test_a_box_comes_to_rest_on_the_floor_without_jitter_or_sinking():
    bodies = world([RigidBody.box("crate", (0.3, 0.2, 0.2), position=(0.5, 0.5, 0.2), restitution=0.0)])
    run(bodies, 0.5)
    still = run(bodies, 1.5, lambda b: [*b.center[0], *b.velocity[0], *b.spin[0]])
    gaps = (still[:, 2] - 0.1) / H
    assert gaps.min() >= REST_GAP - SLACK - 1e-6 and gaps.max() <= REST_GAP + 1e-6
    assert np.ptp(still[:, :3], axis=0).max() < 1e-6 * H
    assert np.abs(still[:, 3:]).max() < 1e-6  # gravity adds 0.05 m/s in each of these steps


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_a_ball_bounces_with_its_restitution(restitution):
    bodies = world([RigidBody.sphere("ball", 0.1, position=(0.5, 0.5, 0.6), restitution=restitution)])
    speeds = run(bodies, 0.45, lambda b: b.velocity[0, 2], dt=0.002)
    impact = int(np.argmin(speeds))
    # the speed that a fall of half a metre less the gap at rest gives, and gravity of one step
    assert speeds[impact] == pytest.approx(-np.sqrt(2 * G * (0.5 - REST_GAP * H)), abs=2 * G * 0.002)
    after = speeds[impact + 1]
    if restitution > 0:
        assert after == pytest.approx(-restitution * (speeds[impact] - G * 0.002), rel=1e-6)
    else:
        assert -speeds[impact] * 0.05 < after + 2 * H / 0.002 and after <= 0.0


def slope(angle, at=1.2):
    """Terrain falling along x."""
    return lambda x: (x - np.array([0.0, 0.0, at])) @ np.array([np.sin(angle), 0.0, np.cos(angle)])


def crate_on_slope(angle, friction):
    normal = np.array([np.sin(angle), 0.0, np.cos(angle)])
    start = np.array([0.4, 0.3, 1.2 - np.tan(angle) * 0.4]) + normal * (0.1 + REST_GAP * H)
    turned = (np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0)
    crate = RigidBody.box(
        "crate", (0.2, 0.2, 0.2), position=start, orientation=turned, restitution=0.0, friction=friction
    )
    return world([crate], (60, 12, 30), slope(angle)), start


@pytest.mark.parametrize("margin", [1.02, 1.5])
def test_a_crate_on_a_slope_below_its_friction_angle_stays(margin):
    angle = np.radians(20)
    bodies, start = crate_on_slope(angle, margin * np.tan(angle))
    run(bodies, 1.0)
    # of the 1.7 m that it would slide without friction
    assert np.abs(bodies.center[0] - start).max() < 1e-3 * H


@pytest.mark.parametrize("share", [0.0, 0.5, 0.95])
def test_a_crate_on_a_slope_above_its_friction_angle_slides_as_coulomb_says(share):
    angle = np.radians(20)
    friction = share * np.tan(angle)
    bodies, _ = crate_on_slope(angle, friction)
    duration = 0.6
    run(bodies, duration)
    wanted = G * (np.sin(angle) - friction * np.cos(angle)) * duration
    along = bodies.velocity[0] @ np.array([np.cos(angle), 0.0, -np.sin(angle)])
    # the friction cone is exact; the solver stops at 1e-5 of a step's gain
    assert along == pytest.approx(wanted, rel=1e-3)
    assert np.abs(bodies.spin).max() < 1e-3


def test_a_sliding_ball_ends_up_rolling_with_five_sevenths_of_its_speed():
    ball = RigidBody.sphere(
        "ball", 0.1, position=(0.3, 0.3, 0.1 + REST_GAP * H), velocity=(1.0, 0, 0), restitution=0.0, friction=0.4
    )
    bodies = world([ball], (40, 12, 8))
    run(bodies, 0.5)  # sliding ends after 2 v / (7 mu g) = 0.07 s
    # facets: the ball is a polyhedron with sides of a fifteenth of its radius
    assert bodies.velocity[0, 0] == pytest.approx(5 / 7, rel=0.03)
    assert bodies.spin[0, 1] == pytest.approx(bodies.velocity[0, 0] / 0.1, rel=0.03)


@pytest.mark.parametrize("restitution", [0.0, 0.6, 1.0])
def test_two_balls_that_meet_keep_momentum_and_part_with_their_restitution(restitution):
    options = {"restitution": restitution, "friction": 0.0}
    one = RigidBody.sphere("one", 0.1, position=(0.3, 0.5, 0.5), velocity=(1.0, 0, 0), **options)
    two = RigidBody.sphere("two", 0.1, position=(0.7, 0.5, 0.5), density=1500.0, **options)
    bodies = world([one, two], gravity=(0, 0, 0))
    before = (bodies.mass[:, None] * bodies.velocity).sum(axis=0)
    run(bodies, 0.35)
    after = (bodies.mass[:, None] * bodies.velocity).sum(axis=0)
    np.testing.assert_allclose(after, before, atol=1e-12)
    parting = bodies.velocity[1, 0] - bodies.velocity[0, 0]
    assert parting == pytest.approx(restitution * 1.0, abs=0.01)  # the line of impact is off by a facet


def test_three_crates_stay_stacked():
    bodies = world(
        [
            RigidBody.box("a", (0.3, 0.3, 0.2), position=(0.5, 0.5, 0.103), restitution=0.0),
            RigidBody.box("b", (0.2, 0.2, 0.2), position=(0.52, 0.5, 0.306), restitution=0.0),
            RigidBody.box("c", (0.2, 0.2, 0.2), position=(0.5, 0.5, 0.51), density=2000.0, restitution=0.0),
        ],
        (20, 20, 16),
    )
    run(bodies, 0.5)
    settled = bodies.center.copy()
    run(bodies, 1.5)
    # the solver's tolerance is 1e-5 of gravity's gain per step (5e-7 m/s per contact): creep, but hardly any
    assert np.abs(bodies.center - settled).max() < 0.01 * H
    assert np.abs(bodies.velocity).max() < 1e-3 and np.abs(bodies.spin).max() < 5e-3
    assert (np.diff(bodies.center[:, 2]) > 0.2).all()


def test_overlap_is_taken_back_without_a_jump():
    bodies = world([RigidBody.box("crate", (0.2, 0.2, 0.2), position=(0.5, 0.5, 0.1 - 0.5 * H), restitution=0.0)])
    speeds = run(bodies, 0.5, lambda b: np.abs(b.velocity).max())
    assert (bodies.center[0, 2] - 0.1) / H == pytest.approx(REST_GAP - SLACK, abs=0.011)
    assert speeds.max() < 1e-6


def test_bodies_bounce_off_closed_sides_and_leave_through_open_ones():
    options = {"velocity": (2.0, 0, 0), "restitution": 1.0, "friction": 0.0}
    bodies = world([RigidBody.sphere("ball", 0.1, position=(0.5, 0.5, 0.5), **options)], gravity=(0, 0, 0))
    run(bodies, 0.4)
    assert bodies.velocity[0, 0] == pytest.approx(-2.0, rel=1e-3)
    regions = np.zeros((20, 20, 20), np.uint8)
    regions[-2:] = CellType.OUTFLOW
    ball = RigidBody.sphere("ball", 0.1, position=(0.5, 0.5, 0.5), **options)
    bodies = world([ball], gravity=(0, 0, 0), regions=regions)
    run(bodies, 0.4)
    assert bodies.center[0, 0] > 1.1 and not bodies.active[0]
    assert bodies.max_speed(DT) == 0.0  # what has left does not shorten the steps


@pytest.mark.parametrize("bank", [False, True])
def test_a_body_from_above_the_box_falls_freely_and_lands_as_from_inside(bank):
    """A bank reaches up to a centimetre below the open top: its distance field ends there, with a small value."""
    ground = (lambda x: np.minimum(x[..., 2] - 0.3, 100.0)) if not bank else (lambda x: x[..., 2] - 0.99)
    ball = RigidBody.sphere("ball", 0.1, position=(0.5, 0.5, 3.0), restitution=0.0)
    bodies = world([ball], distance=ground)
    assert bodies.active[0] and not bodies.warnings
    low = 0.99 if bank else 0.3
    landing = np.sqrt(2 * (2.9 - low) / G)
    steps = int(0.95 * landing / DT)
    run(bodies, steps * DT)
    # symplectic Euler falls dt / 2 times the speed farther than t^2 says; nothing in the air holds it back
    assert bodies.center[0, 2] == pytest.approx(3.0 - 0.5 * G * (steps * DT) * (steps + 1) * DT, abs=1e-9)
    run(bodies, 1.0)
    assert bodies.center[0, 2] == pytest.approx(low + 0.1, abs=0.2 * H)
    assert bodies.active[0]


def test_a_body_that_is_thrown_out_of_the_open_top_comes_back_but_not_one_beside_the_box():
    ball = RigidBody.sphere("ball", 0.1, position=(0.5, 0.5, 0.8), velocity=(0, 0, 6.0))
    bodies = world([ball])
    heights = run(bodies, 2.0, lambda b: b.center[0, 2])
    assert heights.max() > 2.0 and heights[-1] < 0.5 and bodies.active[0]
    with pytest.raises(InputRejected, match="outside the simulation's box"):
        world([RigidBody.sphere("ball", 0.1, position=(0.5, 0.5, 3.0))], gravity=(0, 0, G))  # it would fall up
    with pytest.raises(InputRejected, match="outside the simulation's box"):
        world([RigidBody.sphere("ball", 0.1, position=(0.5, 0.5, 3.0), motion="static")])


def test_an_animated_ram_pushes_a_crate_ahead():
    times = np.array([0.0, 1.0])
    places = np.array([[0.15, 0.5, 0.2], [0.65, 0.5, 0.2]])
    ram = RigidBody.box(
        "ram", (0.1, 0.4, 0.3), motion="animated", trajectory=Trajectory(times, places, np.tile([1.0, 0, 0, 0], (2, 1)))
    )
    crate = RigidBody.box("crate", (0.2, 0.2, 0.2), position=(0.4, 0.5, 0.1 + REST_GAP * H), restitution=0.0)
    bodies = world([ram, crate], (30, 20, 12))
    run(bodies, 0.8)
    assert bodies.center[0, 0] == pytest.approx(0.55)
    assert bodies.velocity[1, 0] == pytest.approx(0.5, abs=1e-3)
    assert bodies.center[1, 0] - bodies.center[0, 0] == pytest.approx(0.15 + REST_GAP * H, abs=0.02 * H)


def test_a_crate_thrown_along_the_floor_stops_where_friction_stops_it():
    crate = RigidBody.box(
        "crate", (0.3, 0.3, 0.1), position=(0.3, 0.3, 0.05 + REST_GAP * H), velocity=(1.5, 0, 0), restitution=0.0,
        friction=0.5,
    )  # fmt: skip
    bodies = world([crate], (30, 12, 8))
    run(bodies, 0.6)
    # half a step's way: velocities change before positions
    assert bodies.center[0, 0] - 0.3 == pytest.approx(1.5**2 / (2 * 0.5 * G), abs=0.5 * 1.5 * DT + 1e-3)
    assert np.abs(bodies.velocity).max() < 1e-5
