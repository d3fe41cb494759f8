"""Twin experiments: parameters of flows that the rollout itself made, found again from a wrong start."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fluidlift.fit.evaluation import Budget, evaluate, jacobian
from fluidlift.fit.evaluation import single_thread as _single_thread
from fluidlift.fit.identifiability import Curvature, determined, effective_observations
from fluidlift.fit.methods import adam
from fluidlift.fit.optimize import fit_parameters
from fluidlift.fit.problem import build_problem, build_scene, plan_windows
from fluidlift.fit.ranges import parameter_space
from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import RolloutParameters, rollout
from fluidlift.physics.rollout_domain import prepare_domain
from fluidlift.synthetic.twins import make_twin
from fluidlift.types import CellType, FaceVelocity, FluidParameters, Grid

GRID = Grid((16, 10, 8), 0.1)
INTERVAL = 0.04
DOWNSTREAM = np.array([1.0, 0.0, 0.0])
TRUTH = FluidParameters(
    kinematic_viscosity=5e-3, gravity=(1.5, 0.2, -9.0), inflow_velocity=(1.0, 0.1, 0.0), outflow_velocity=1.1,
    wall_damping=0.3, time_step=INTERVAL / 2,
)  # fmt: skip
WRONG = FluidParameters(
    density=900.0, kinematic_viscosity=5e-4, gravity=(0.0, 0.0, -9.81), inflow_velocity=(0.5, 0.0, 0.0),
    outflow_velocity=0.5, wall_damping=0.1,
)  # fmt: skip


def channel():
    types = np.zeros(GRID.shape, np.uint8)
    types[:, :, :6] = CellType.FLUID
    types[:, :, 0] = CellType.SOLID
    types[:, 0], types[:, -1] = CellType.SOLID, CellType.SOLID
    types[7:9, 4:6, :4] = CellType.SOLID
    types[0][types[0] == CellType.FLUID] = CellType.INFLOW
    types[-1][types[-1] == CellType.FLUID] = CellType.OUTFLOW
    return types


@pytest.fixture(scope="module")
def twin():
    """Seven frames of a channel that is speeding up."""
    types = channel()
    domain = prepare_domain(types, build_system(types, None, GRID), mainstream=DOWNSTREAM, sweeps=5)
    state = FaceVelocity.zeros(GRID)
    state.u[:] = 0.5
    frames = []
    with torch.no_grad(), _single_thread():
        for _ in range(7):
            result = rollout(state, domain, RolloutParameters.of(TRUTH), steps=2)
            state = FaceVelocity(*(c.numpy().copy() for c in result.faces()))
            frames.append(state)
    return frames


def noisy(frames, size, seed=0):
    rng = np.random.default_rng(seed)
    return [
        FaceVelocity(*(c + size * rng.standard_normal(c.shape).astype(np.float32) for c in f.components))
        for f in frames
    ]


def fit(frames, initial=WRONG, **options):
    options = {"mainstream": DOWNSTREAM, "steps_per_frame": 2, "windows": 2} | options
    return fit_parameters(frames, channel(), None, GRID, INTERVAL, initial, **options)


@pytest.fixture(scope="module")
def clean(twin):
    """The fit to the twin without noise, with a wide prior: gravity starts 1.7 m/s^2 off."""
    return fit(twin, prior_sigmas={"gravity": 0.3})


def test_a_wrong_start_finds_the_parameters_of_a_clean_twin(clean):
    result, found = clean, clean.parameters
    assert result.converged
    # the weak priors (a tenfold viscosity away, say) pull a little: a few per cent
    assert found.inflow_velocity == pytest.approx(TRUTH.inflow_velocity, abs=0.02)
    assert found.gravity == pytest.approx(TRUTH.gravity, abs=0.2)
    assert found.kinematic_viscosity == pytest.approx(TRUTH.kinematic_viscosity, rel=0.05)
    assert found.wall_damping == pytest.approx(TRUTH.wall_damping, rel=0.05)
    assert found.outflow_velocity == pytest.approx(TRUTH.outflow_velocity, rel=0.03)
    assert result.loss_history[-1] < 1e-3 * result.extra["loss_at_prior"]
    assert result.extra["loss_at_prior"] < result.extra["loss_at_rest"]


def test_a_fit_that_begins_on_wider_cells_ends_where_the_given_cells_want_it():
    """Wider cells move differently: their minimum is a start, and no nearer to the end than another."""
    t = make_twin("river", seed=0, frames=6)
    found = fit_parameters(
        t.frames, t.cell_types, None, t.grid, t.interval, t.start, kind=t.kind, mainstream=t.mainstream,
        steps_per_frame=t.steps_per_frame, windows=2, coarse_first=100,
    )  # fmt: skip
    assert found.converged
    # exact targets leave single precision; the minimum of the wider cells, taken for the end, leaves 2e-3
    assert found.extra["loss"] < 1e-6
    # 2 %: the goal for exact velocities
    assert found.estimates["gravity_x"].value == pytest.approx(t.truth.gravity[0], rel=0.02)


def test_the_time_step_stays_where_the_frame_rate_puts_it(clean):
    step = clean.estimates["time_step"]
    # the number of steps per frame is given, so the length of a step is known: 1 % is the fit's own stopping rule
    assert step.value == pytest.approx(INTERVAL / 2, rel=0.01)
    assert abs(step.value - INTERVAL / 2) < 2 * step.sigma


def test_what_cannot_be_known_keeps_its_prior_and_is_flagged(clean):
    result = clean
    density = result.estimates["density"]
    assert not density.identifiable
    assert density.value == WRONG.density == result.parameters.density
    # an inlet without fluctuations has no pattern to scale
    assert not result.estimates["inflow_fluctuation"].identifiable
    assert result.estimates["inflow_velocity_x"].identifiable
    assert result.estimates["gravity_x"].identifiable


def test_noise_widens_the_uncertainty_and_the_truth_stays_within_it(twin, clean):
    rough = fit(noisy(twin, 0.05), windows=1)
    names = ("inflow_velocity_x", "outflow_velocity", "gravity_x", "wall_damping")
    truth = dict(zip(names, (1.0, 1.1, 1.5, 0.3)))
    for name in names:
        estimate = rough.estimates[name]
        assert estimate.sigma > clean.estimates[name].sigma * 0.5
        # noise in the start of a window is not modelled: 4 sigma instead of 3
        assert abs(estimate.value - truth[name]) < 4 * estimate.sigma
    assert rough.extra["loss"] > clean.extra["loss"]


def test_one_steady_frame_is_enough_to_run(twin):
    result = fit(twin[-1:], free=("inflow_velocity", "outflow_velocity"))
    assert any("steady" in note for note in result.notes)
    assert result.parameters.inflow_velocity[0] == pytest.approx(1.0, abs=0.1)


def test_a_spent_budget_returns_the_prior_and_says_so(twin):
    result = fit(twin, max_rollouts=3)
    assert not result.converged
    assert result.parameters.gravity == WRONG.gravity
    assert any("nothing was fitted" in note for note in result.notes)


def test_zero_inflow_is_first_read_off_the_targets(twin):
    start = replace(WRONG, inflow_velocity=(0.0, 0.0, 0.0), outflow_velocity=0.0)
    result = fit(twin, initial=start, free=("kinematic_viscosity",))
    # not fitted here: read, to single precision
    assert result.parameters.inflow_velocity == pytest.approx(TRUTH.inflow_velocity, abs=1e-5)


def test_gradient_and_finite_difference_jacobian_see_the_same_slope(twin):
    """d loss = 2 J^T r: the analytic gradient and the differences describe one function."""
    with _single_thread():
        scene = build_scene(twin, [channel()] * len(twin), None, GRID, kind="stream", mainstream=DOWNSTREAM)
        plan = plan_windows(scene, INTERVAL, windows=1, steps_per_frame=2, frames=2)
        problem = build_problem(scene, plan)
        prior = replace(WRONG, time_step=INTERVAL / 2)
        space = parameter_space(prior, free=("gravity", "inflow_velocity"), speed=scene.speed, spacing=0.1)
        budget = Budget(deadline=float("inf"), max_rollouts=100)
        base = evaluate(problem, space, space.prior_raw, budget)
        slopes = jacobian(problem, space, base, budget)
        raw = torch.tensor(space.prior_raw, dtype=torch.float32, requires_grad=True)
        problem.loss(0, problem.roll(0, space.physical(raw))).backward()
    gradient = raw.grad.double().numpy()
    # forward differences of 0.02 raw units: first-order error of about that size
    assert slopes is not None
    np.testing.assert_allclose(2 * slopes.slope, gradient, rtol=0.05, atol=0.02 * np.abs(gradient).max())


def test_adam_lowers_the_loss_on_the_analytic_gradient(twin):
    with _single_thread():
        scene = build_scene(twin, [channel()] * len(twin), None, GRID, kind="stream", mainstream=DOWNSTREAM)
        plan = plan_windows(scene, INTERVAL, windows=1, steps_per_frame=2, frames=3)
        problem = build_problem(scene, plan)
        prior = replace(WRONG, time_step=INTERVAL / 2)
        space = parameter_space(prior, free=("inflow_velocity",), speed=scene.speed, spacing=0.1)
        budget = Budget(deadline=float("inf"), max_rollouts=60)
        found = adam(problem, space, space.prior_raw, budget, max_iterations=20, rate=0.1)
    assert found.loss < 0.5 * found.history[0]


def test_tied_parameters_are_given_up_one_at_a_time():
    """J sees only the sum of the first two, so fixing one determines the other; nothing sees the last."""
    rows = np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    curvature = Curvature(rows.T @ rows, loss=0.01, observations=100.0)
    keep = determined(curvature, np.array([1.0, 2.0, 1.0, 1.0]))
    assert keep.tolist() in ([True, False, True, False], [False, True, True, False])


def test_a_loose_bound_far_from_the_prior_counts_as_knowledge():
    # sigma is 0.88 of the prior's
    curvature = Curvature(np.array([[3e-5]]), loss=0.01, observations=100.0)
    width = np.array([1.0])
    assert not determined(curvature, width, np.array([0.5]))[0]
    assert determined(curvature, width, np.array([4.0]))[0]


def test_smooth_misfit_counts_as_fewer_observations_than_white_noise():
    rng = np.random.default_rng(0)
    white = rng.standard_normal((12, 12, 12, 3))
    x = np.linspace(0, np.pi, 12)
    smooth = np.sin(x)[:, None, None, None] * np.ones((12, 12, 12, 3))
    mask = np.full((12, 12, 12), 1 / 12**3)
    many, few = (effective_observations([f], [mask]) for f in (white, smooth))
    assert many > 0.7 * 3 * 12**3
    assert few < 0.02 * many
    # the same window twice tells nothing new
    assert effective_observations([white, white], [mask, mask]) == pytest.approx(many, rel=1e-9)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"method": "newton"}, "newton"), ({"device": "cuda"}, "cuda"), ({"frames_per_window": 9}, "windows of 9 frames")],
)
def test_arguments_that_do_not_fit_are_refused(twin, options, message):
    with pytest.raises(ValueError, match=message):
        fit(twin, **options)


def test_buoyancy_of_a_plume_twin_is_found():
    """Smoke in the middle of a box of air that speeds up from its own lift, made and fitted with the same model."""
    grid = Grid((10, 10, 12), 0.1)
    types = np.zeros(grid.shape, np.uint8)
    types[3:7, 3:7, 2:9] = CellType.FLUID
    smoke = (types == CellType.FLUID).astype(float)
    system = build_system(np.full(grid.shape, CellType.FLUID, np.uint8), None, grid, open_border=True)
    domain = prepare_domain(types, system, smoke=smoke, sweeps=5)
    truth = FluidParameters(gravity=(0.3, 0.0, -2.5), kinematic_viscosity=1.5e-5, time_step=INTERVAL)
    state, frames = FaceVelocity.zeros(grid), []
    with torch.no_grad(), _single_thread():
        for _ in range(8):
            result = rollout(state, domain, RolloutParameters.of(truth), steps=1)
            state = FaceVelocity(*(c.numpy().copy() for c in result.faces()))
            frames.append(state)
    initial = FluidParameters(density=1.2, kinematic_viscosity=1.5e-5)
    found = fit_parameters(
        frames[2:], types, None, grid, INTERVAL, initial, kind="plume", steps_per_frame=1, windows=2,
        free=("gravity", "kinematic_viscosity", "density"),
    )  # fmt: skip
    # clean data, the prior from the speed scale is a factor off and as wide: a few per cent of pull
    assert found.parameters.gravity == pytest.approx(truth.gravity, abs=0.15)
    assert found.extra["buoyancy"] == pytest.approx(float(np.hypot(0.3, 2.5)), rel=0.05)
    assert not found.estimates["density"].identifiable


def test_stretches_of_another_time_are_fitted_together_and_no_window_goes_from_one_to_the_next(twin):
    """The last four frames of a channel that is speeding up, and then the first four."""
    frames = [*twin[3:], *twin[:4]]
    domain = build_scene(frames, [channel()] * 8, None, GRID, kind="stream", mainstream=DOWNSTREAM, firsts=(0, 4))
    plan = plan_windows(domain, INTERVAL, windows=4, steps_per_frame=2)
    assert {s < 4 for s in plan.starts} == {True, False} and all(
        s + plan.frames < (4 if s < 4 else 8) for s in plan.starts
    )
    together = fit(frames, firsts=(0, 4))
    assert not together.reason and together.extra["windows"] == 2
    # velocities are exact, so one clip or two stretches of it tell the same; as one clip there is a jump back in time
    assert together.parameters.inflow_velocity[0] == pytest.approx(TRUTH.inflow_velocity[0], rel=0.02)
    joined = fit(frames, windows=7)
    assert together.extra["loss"] < 0.1 * joined.extra["loss"]
    with pytest.raises(ValueError, match="stretches"):
        fit(frames, firsts=(0, 8))
