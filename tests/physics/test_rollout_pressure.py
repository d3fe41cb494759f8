"""The ways through the pressure solve of a rollout: where they agree, and by how much they do not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fluidlift.numerics.recurrent_stencil import FittedStencil
from fluidlift.physics import rollout_pressure
from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import RolloutParameters, rollout
from fluidlift.physics.rollout_domain import prepare_domain
from fluidlift.physics.rollout_pressure import (
    ROUTES,
    RolloutOptions,
    project,
    recurrent_options,
    sample_pressure_problems,
)
from fluidlift.types import CellType, FluidParameters, Grid

H = 0.1
DOWNSTREAM = np.array([1.0, 0.0, 0.0])
STENCIL = FittedStencil(
    np.array([0.07, 0.07, 0.06, 0.05, 0.03, 0.03, 0.01]), -0.3, 0.07, np.array([0.8]), np.array([0.8]), 20
)
WATER = FluidParameters(
    kinematic_viscosity=3e-3, gravity=(0.8, 0.1, -9.0), inflow_velocity=(1.0, 0.1, 0.0), outflow_velocity=0.9,
    restitution=0.3, wall_damping=0.2, time_step=0.02,
)  # fmt: skip


pytestmark = pytest.mark.usefixtures("single_thread")


def channel(shape=(6, 5, 5), lid=False):
    """Bed, two banks, a rock; air above and open ends, or walls on all sides."""
    types = np.full(shape, CellType.EMPTY, np.uint8)
    types[:, :, : shape[2] - 1] = CellType.FLUID
    types[:, :, 0] = CellType.SOLID
    types[:, 0], types[:, -1] = CellType.SOLID, CellType.SOLID
    middle = shape[0] // 2
    types[middle, 2 : max(3, shape[1] // 2), : shape[2] - 2] = CellType.SOLID
    if lid:
        types[:, :, -1] = CellType.SOLID
        types[[0, -1]] = CellType.SOLID
        return types
    types[0][types[0] == CellType.FLUID] = CellType.INFLOW
    types[-1][types[-1] == CellType.FLUID] = CellType.OUTFLOW
    return types


def domain_of(types, dtype=np.float64):
    system = build_system(types, None, Grid(types.shape, H))
    return prepare_domain(types, system, mainstream=DOWNSTREAM, dtype=dtype)


def faces_of(domain, seed=1):
    rng = np.random.default_rng(seed)
    return torch.tensor(rng.standard_normal(domain.offsets[3]) * domain.interior)


def options_of(name, sub_steps=20, **fields):
    return RolloutOptions(name, sweeps=sub_steps, stencil=replace(STENCIL, sub_steps=sub_steps), **fields)


def projected(domain, start, options, weights=None):
    """The velocity, and the gradient of its product with `weights`."""
    x = start.clone().requires_grad_()
    out = project(x, domain, options=options)
    out.backward(faces_of(domain, 9) if weights is None else weights)
    return out.detach(), x.grad


@pytest.mark.parametrize("lid", [False, True], ids=["open", "closed"])
@pytest.mark.parametrize("name", ROUTES)
def test_every_route_passes_the_float64_gradcheck(name, lid):
    domain = domain_of(channel(lid=lid))
    start = faces_of(domain).requires_grad_()
    options = options_of(name, tolerance=1e-13)
    # linear maps: differences of 1e-6 in double precision leave some 1e-10 of rounding, times weights of 1/h = 10
    assert torch.autograd.gradcheck(
        lambda v: project(v, domain, options=options), start, eps=1e-6, atol=1e-7, fast_mode=True
    )


@pytest.mark.parametrize("lid", [False, True], ids=["open", "closed"])
@pytest.mark.parametrize("pair", [("jacobi", "unrolled"), ("recurrent", "recurrent_unrolled")], ids=lambda p: p[0])
def test_sweeps_of_the_incoming_gradient_are_the_gradient_of_the_sweeps(pair, lid):
    """The self-adjoint shortcut against torch's record of every sub-step: one velocity and one gradient."""
    domain = domain_of(channel((9, 6, 5), lid=lid))
    fast, recorded = (projected(domain, faces_of(domain), options_of(name)) for name in pair)
    for a, b in zip(fast, recorded):
        # the same sums in another order
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12 * float(b.abs().max()))


@pytest.mark.parametrize("name", ["jacobi", "unrolled", "recurrent"])
def test_with_enough_sub_steps_every_route_is_the_implicit_one(name):
    domain = domain_of(channel((9, 6, 5)))
    exact = projected(domain, faces_of(domain), options_of("implicit", tolerance=1e-12))
    # the slowest component of some hundred cells loses 1 % per Jacobi sweep at the least: e^-30 after 3000
    many = projected(domain, faces_of(domain), options_of(name, sub_steps=3000 if name == "jacobi" else 1200))
    for a, b in zip(many, exact):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-5 * float(b.abs().max()))


@pytest.mark.parametrize(("name", "grows"), [(n, n.endswith("unrolled")) for n in ROUTES])
def test_only_recorded_routes_keep_their_sub_steps(name, grows):
    domain = domain_of(channel())
    kept = []
    for sub_steps in (10, 20):
        count = 0

        def pack(tensor):
            nonlocal count
            count += tensor.numel()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            project(faces_of(domain).requires_grad_(), domain, options=options_of(name, sub_steps))
        kept.append(count)
    assert kept[1] > 1.8 * kept[0] if grows else kept == [0, 0]


@pytest.fixture(scope="module")
def flow():
    """Four steps of a channel on the implicit route: domain, start, potentials."""
    domain = domain_of(channel((20, 12, 10)), np.float32)
    start = torch.from_numpy((domain.interior + domain.inflow).astype(np.float32)) * 0.5
    with torch.no_grad():
        result = rollout(start, domain, RolloutParameters.of(WATER), steps=4, options=RolloutOptions(tolerance=1e-7))
    return domain, start, result.potentials


def inflow_gradient(flow, options):
    """d (mean square of the velocity) / d (inflow along x) after three steps."""
    domain, start, _ = flow
    speed = torch.tensor(WATER.inflow_velocity, dtype=torch.float32).requires_grad_()
    physical = replace(RolloutParameters.of(WATER), inflow_velocity=speed)
    moved = rollout(start, domain, physical, steps=3, options=options).velocity
    (moved[torch.from_numpy(domain.dynamic)] ** 2).mean().backward()
    return float(speed.grad[0])


def test_a_fitted_stencil_gives_the_implicit_gradient_where_as_many_sweeps_do_not(flow):
    domain, _, potentials = flow
    options, validation = recurrent_options([domain] * 4, potentials, RolloutOptions(sweeps=40), iterations=25, seed=1)
    assert options.projection == "recurrent" and validation.accepted and validation.advice == ""
    exact = inflow_gradient(flow, RolloutOptions())
    learnt = abs(inflow_gradient(flow, options) / exact - 1)
    swept = abs(inflow_gradient(flow, RolloutOptions("jacobi", sweeps=40)) / exact - 1)
    print(f"inflow gradient off by {learnt:.2%} with the stencil, {swept:.1%} with Jacobi's sweeps")
    # errors of q carry over to the gradient about as they are: a few per cent against tens
    assert learnt < 0.05 < 0.2 < swept


def test_samples_solve_their_systems(flow):
    domain, _, potentials = flow
    samples = sample_pressure_problems([domain] * 4, potentials, most=2, seed=3)
    assert len(samples) == 3  # the first and the last step, and one of rough data
    for system, rhs, q in samples:
        np.testing.assert_array_equal(system.apply(q), rhs)
        assert np.abs(q).max() > 0


def test_a_stencil_that_fails_validation_leaves_the_implicit_route(flow, monkeypatch):
    domain, _, potentials = flow
    poor = FittedStencil.jacobi(40, relaxation=0.5)
    monkeypatch.setattr(rollout_pressure, "fit_recurrent_stencil", lambda *_, **__: poor)
    options, validation = recurrent_options([domain] * 4, potentials, RolloutOptions(sweeps=40))
    assert options.projection == "implicit" and options.stencil is None
    assert "Jacobi" in validation.advice


def test_reports_tell_what_a_fixed_number_of_sub_steps_leaves():
    domain = domain_of(channel((9, 6, 5)))
    kept = []
    for name in ROUTES:
        project(faces_of(domain), domain, options=options_of(name), kept=kept)
    for name, (_, report) in zip(ROUTES, kept):
        assert report.converged == (name == "implicit")
        assert report.residual <= 1e-5 or report.advice
    assert kept[1][1].residual == pytest.approx(kept[2][1].residual, rel=1e-9)


def test_unknown_routes_and_gradients_are_refused():
    with pytest.raises(ValueError, match="projection 'multigrid'"):
        RolloutOptions("multigrid")
    with pytest.raises(ValueError, match="without a stencil"):
        RolloutOptions("recurrent")
    with pytest.raises(ValueError, match="advection gradient 'downwind'"):
        RolloutOptions(advection_gradient="downwind")
