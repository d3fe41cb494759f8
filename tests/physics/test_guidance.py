"""Body forces of each place: a steady one accelerates, a pull decays in its time, and tells what it took."""

import numpy as np
import pytest

from fluidlift.physics.apic import LiquidSimulator
from fluidlift.physics.guidance import Guiding, Nudging, SteadyForce
from fluidlift.types import FaceVelocity, FilmedMotion, FluidParameters, Grid, Particles, Terrain, TriangleMesh

H = 0.1
GRID = Grid((24, 16, 24), H)
NO_MESH = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
WHOLE = tuple(slice(0, n) for n in GRID.shape)


def uniform(x: float, y: float, z: float) -> FaceVelocity:
    return FaceVelocity(*(np.full(GRID.face_shape(a), v, np.float32) for a, v in enumerate((x, y, z))))


def rates(value: float) -> tuple[np.ndarray, ...]:
    return tuple(np.full(GRID.face_shape(a), value, np.float32) for a in range(3))


def masses(value: float = 1.0) -> tuple[np.ndarray, ...]:
    return rates(value)


def blob(
    forces, *, velocity=(0.0, 0.0, 0.0), gravity=(0.0, 0.0, 0.0), low=(0.8, 0.6, 1.4), step=0.01
) -> LiquidSimulator:
    """A cube of 0.4 m in the middle of a box that it does not touch, in one piece and moving as one."""
    axis = (np.arange(8) + 0.5) * 0.5 * H
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3) + low
    body = Particles.at_rest(points, 1.0, velocities=np.broadcast_to(np.float32(velocity), points.shape))
    terrain = Terrain(GRID, np.full([n + 1 for n in GRID.shape], 10.0, np.float32), np.array([1.0, 0.0, 0.0]), NO_MESH)
    return LiquidSimulator(
        GRID, terrain, FluidParameters(gravity=gravity, time_step=step), body,
        cell_types=np.zeros(GRID.shape, np.uint8), open_sides=np.zeros((3, 2), bool), forces=forces,
    )  # fmt: skip


def test_a_steady_force_adds_its_acceleration_to_that_of_gravity():
    acceleration, seconds = np.array([2.0, -0.5, 1.0]), 0.3
    simulator = blob([SteadyForce(uniform(*acceleration))], gravity=(0.0, 0.0, -9.81))
    simulator.advance(seconds)
    expected = (acceleration + [0, 0, -9.81]) * seconds
    # single precision over some thirty steps, each of which goes to the grid and back; nothing presses on a body that
    # falls as one
    np.testing.assert_allclose(simulator.particles.velocities, np.broadcast_to(expected, (512, 3)), atol=2e-3)


def test_two_forces_add_up():
    simulator = blob([SteadyForce(uniform(1, 0, 0)), SteadyForce(uniform(1, 2, 0))])
    simulator.advance(0.2)
    np.testing.assert_allclose(simulator.particles.velocities.mean(axis=0), [0.4, 0.4, 0.0], atol=1e-3)


def test_a_force_that_differs_from_place_to_place_pulls_a_body_apart():
    """Towards +x in the right half and -x in the left: what is solved stays free of divergence inside, so less."""
    acceleration = uniform(0, 0, 0)
    acceleration.u[:10] = -1.0
    acceleration.u[11:] = 1.0
    simulator = blob([SteadyForce(acceleration)])
    simulator.advance(0.1)
    p = simulator.particles
    right = p.positions[:, 0] > 1.0
    assert p.velocities[right, 0].mean() > 0.01 and p.velocities[~right, 0].mean() < -0.01
    assert abs(p.velocities[:, 0].mean()) < 1e-3, "nothing pushes the whole"


def test_the_strength_of_a_force_is_told_for_the_time_step():
    force = uniform(3, 0, 0)
    force.w[2, 2, 2] = -4.0
    assert SteadyForce(force).largest == pytest.approx(5.0, rel=1e-6)  # of components on different faces: at most
    assert Nudging(uniform(1, 0, 0), rates(5.0)).largest == 0.0
    # gains of a frame in which nothing moves yet: more steps under a force that crosses cells
    slow, fast = (blob([SteadyForce(uniform(a, 0, 0))], step=1.0, low=(0.2, 0.6, 1.0)) for a in (0.1, 200.0))
    assert fast.advance(0.05).substeps > slow.advance(0.05).substeps


@pytest.mark.parametrize("step", [0.1, 0.01])
def test_nudging_decays_as_its_time_says_for_any_step(step):
    """v = target + (v0 - target) exp(-t / tau), to the last digit and not to an order of the step."""
    tau, seconds, start, target = 0.15, 0.3, np.array([0.6, 0.0, -0.3]), np.array([0.1, 0.4, 0.2])
    simulator = blob([Nudging(uniform(*target), rates(1 / tau))], velocity=start, step=step)
    simulator.advance(seconds)
    expected = target + (start - target) * np.exp(-seconds / tau)
    found = simulator.particles.velocities
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=2e-3)  # single precision, as above


def test_one_step_is_as_good_as_two_halves_and_none_overshoots():
    start, target = uniform(1, 0, 0), uniform(0, 0, 0)
    once = Nudging(target, rates(8.0)).applied(start, masses(), WHOLE, 0.5)
    half = Nudging(target, rates(8.0))
    twice = half.applied(half.applied(start, masses(), WHOLE, 0.25), masses(), WHOLE, 0.25)
    np.testing.assert_allclose(once.u, twice.u, atol=1e-6)  # single precision
    np.testing.assert_allclose(once.u, np.exp(-4.0), rtol=1e-4)
    assert Nudging(target, rates(1e6)).applied(start, masses(), WHOLE, 10.0).u.min() >= 0


def test_where_nothing_is_known_nothing_is_pulled():
    known = rates(0.0)
    known[0][:12] = 10.0
    nudging = Nudging(uniform(1, 1, 1), known)
    out = nudging.applied(uniform(0, 0, 0), masses(), WHOLE, 0.1)
    np.testing.assert_allclose(out.u[:12], 1 - np.exp(-1.0), rtol=1e-5)
    assert not out.u[12:].any() and not out.v.any() and not out.w.any()
    assert not nudging.mean().v.any()


def test_the_mean_force_keeps_the_flow_that_it_was_needed_for():
    """A body on which a steady pull acts that the model does not know of is held by nudging; the mean of that, applied
    alone, holds it as well."""
    tau, unknown = 0.02, (-1.0, 0.0, 0.0)
    # at rest but for what the pull leaves: it balances at v = a tau, a drift of a fifth of a cell in a second
    start = (tau * unknown[0], 0.0, 0.0)
    nudging = Nudging(uniform(0, 0, 0), rates(1 / tau), after=0.2)
    held = blob([nudging], velocity=start, gravity=unknown)
    held.advance(1.0)
    mean = nudging.mean()
    wet = held.particles.positions[:, 0].mean()
    inside = tuple(np.round([wet / H, 0.8 / H, 1.6 / H]).astype(int))
    assert mean.u[inside] == pytest.approx(1.0, rel=0.02)  # the drift's start is in the balance of steps, not of time
    alone = blob([SteadyForce(mean)], velocity=start, gravity=unknown)
    alone.advance(0.5)
    free = blob([], velocity=start, gravity=unknown)
    free.advance(0.5)
    # 2 % of what the unknown pull does in half a second
    assert alone.particles.velocities[:, 0].mean() == pytest.approx(start[0], abs=0.02 * 0.5)
    assert free.particles.velocities[:, 0].mean() == pytest.approx(start[0] - 0.5, abs=2e-3)


def test_what_is_learnt_leaves_the_flow_behind_so_many_times_less():
    """A pull that the model does not know of, a: v stays behind by a tau under a pull alone, by a tau / (1 + gain) in
    the end where a force is learnt from it; and the mean is what the unknown pull takes."""
    tau, unknown, gain = 0.1, -1.0, 3.0
    nudging = Nudging(uniform(0, 0, 0), rates(1 / tau), gain=gain, learning=12 * tau, after=8.0)
    v = uniform(0, 0, 0)
    for _ in range(1000):
        v = nudging.applied(uniform(float(v.u[5, 5, 5]) + 0.01 * unknown, 0, 0), masses(), WHOLE, 0.01)
    # a step of 0.1 tau: of that order
    np.testing.assert_allclose(nudging.behind().u, -unknown * tau / (1 + gain), rtol=0.06)
    np.testing.assert_allclose(nudging.mean().u, -unknown, rtol=0.01)
    with pytest.raises(ValueError, match="gain"):
        Nudging(uniform(0, 0, 0), rates(1.0), gain=-1.0)


def test_what_guides_is_between_the_frames_of_a_film_half_a_step_later():
    frames = [uniform(s, 0, 0).components for s in (0.0, 4.0)]
    film = FilmedMotion(*(np.stack(c).astype(np.float16) for c in zip(*frames)), 1.0)
    out = Guiding(film, rates(1e6)).applied(uniform(9, 9, 9), masses(), WHOLE, 0.5, 0.25)
    np.testing.assert_allclose(out.u, 2.0, atol=1e-3)  # at 0.5 s
    assert not out.v.any()
    gentle = Guiding(film, rates(2.0)).applied(uniform(0, 0, 0), masses(), WHOLE, 0.5, 0.75)
    np.testing.assert_allclose(gentle.u, 4.0 * (1 - np.exp(-1.0)), rtol=1e-3)
    with pytest.raises(ValueError, match="rates"):
        Guiding(film, tuple(r[:-1] for r in rates(1.0)))


def test_faces_without_liquid_do_not_count():
    """Air moves anyhow; and where liquid comes by less than half of the time, the pull is that of splashes."""
    nudging, often, seldom = Nudging(uniform(1, 0, 0), rates(5.0)), masses(), masses()
    for m in (often, seldom):
        m[0][:8] = 0.0
    seldom[0][8:12] = 0.0
    for k in range(10):
        nudging.applied(uniform(0, 0, 0), often if k % 3 == 0 else seldom, WHOLE, 0.1)
    mean = nudging.mean().u
    assert (mean[:8] == 0).all(), "never wet"
    assert (mean[8:12] == 0).all(), "four times in ten"
    # each time from rest: (1 - exp(-0.5)) / 0.1 s
    np.testing.assert_allclose(mean[12:], (1 - np.exp(-0.5)) / 0.1, rtol=1e-5)


def test_a_face_counts_the_time_in_which_it_was_wet():
    """Dry for a third of the time: the mean is that of the rest, not watered down."""
    nudging, wet, dry = Nudging(uniform(1, 0, 0), rates(5.0)), masses(), masses(0.0)
    for k in range(9):
        nudging.applied(uniform(0, 0, 0), dry if k % 3 == 0 else wet, WHOLE, 0.1)
    np.testing.assert_allclose(nudging.mean().u, (1 - np.exp(-0.5)) / 0.1, rtol=1e-5)


def test_what_comes_before_the_flow_has_settled_does_not_count():
    nudging = Nudging(uniform(1, 0, 0), rates(5.0), after=0.35)
    for k in range(8):
        nudging.applied(uniform(0.0 if k > 3 else -50.0, 0, 0), masses(), WHOLE, 0.1)
    np.testing.assert_allclose(nudging.mean().u, (1 - np.exp(-0.5)) / 0.1, rtol=1e-5)


def test_forces_act_in_the_window_of_the_simulator():
    """The window moves with the liquid; a force is known on the faces of the whole grid."""
    box = (slice(8, 16), slice(0, 8), slice(16, 24))
    acceleration = FaceVelocity(
        *(np.random.default_rng(a).normal(size=GRID.face_shape(a)).astype(np.float32) for a in range(3))
    )
    faces = [tuple(slice(s.start, s.stop + (a == k)) for a, s in enumerate(box)) for k in range(3)]
    still = FaceVelocity(*(np.zeros(c[f].shape, np.float32) for c, f in zip(acceleration.components, faces)))
    out = SteadyForce(acceleration).applied(still, tuple(c + 1 for c in still.components), box, 0.5)
    for found, whole, f in zip(out.components, acceleration.components, faces):
        np.testing.assert_allclose(found, 0.5 * whole[f], rtol=1e-6)


def test_rates_of_another_grid_are_refused():
    with pytest.raises(ValueError, match="rates"):
        Nudging(uniform(0, 0, 0), tuple(np.zeros(GRID.shape, np.float32) for _ in range(3)))
