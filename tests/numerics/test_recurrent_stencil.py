"""The recurrent stencil: what it solves, how it is fitted, and when it is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.numerics.recurrent_stencil import (
    FittedStencil,
    LayerInput,
    LayerWeights,
    recurrent_layers,
    recurrent_solve,
    relative_residual,
    stencil_domain,
)
from fluidlift.numerics.recurrent_stencil_fit import PressureSample, fit_recurrent_stencil, fit_stencil, validate

GENERAL = FittedStencil(
    np.array([0.05, 0.04, 0.06, 0.02, 0.01, 0.015, 0.01]), 0.1, -0.2, np.array([0.5, 0.7]), np.array([0.3, 0.5]), 20
)


pytestmark = pytest.mark.usefixtures("single_thread")


def irregular(shape=(10, 8, 7), seed=0, lid=False):
    """A box with walls around, a rock, some partly open faces, air on top (or a lid)."""
    rng = np.random.default_rng(seed)
    unknown = np.ones(shape, bool)
    unknown[4:6, 2:4, :4] = False
    weights = []
    for axis in range(3):
        w = rng.choice([1.0, 1.0, 0.4], tuple(n + (a == axis) for a, n in enumerate(shape)))
        ends = [slice(None)] * 3
        for ends[axis] in (0, -1):
            w[tuple(ends)] = 0.0
        inner, low, high = ([slice(None)] * 3 for _ in range(3))
        inner[axis], low[axis], high[axis] = slice(1, -1), slice(None, -1), slice(1, None)
        w[tuple(inner)] *= unknown[tuple(low)] & unknown[tuple(high)]
        weights.append(w)
    if not lid:
        weights[2][:, :, -1] = 1.6  # a surface nearer than the next centre
    return PoissonSystem(unknown, *weights, spacing=0.1)


def samples_of(*systems, count=2, seed=0):
    """Pressures of random data, exact to rounding."""
    rng = np.random.default_rng(seed)
    found = []
    for system in systems:
        for _ in range(count):
            q, _ = solve(
                system, np.where(system.unknown, rng.standard_normal(system.unknown.shape), 0), tolerance=1e-10
            )
            found.append(PressureSample(system, system.apply(q), q))
    return found


@pytest.mark.parametrize("lid", [False, True])
def test_without_kernel_and_momentum_it_is_jacobis_method(lid):
    system = irregular(lid=lid)
    rhs = np.random.default_rng(1).standard_normal(system.unknown.shape)
    expected, report = solve(system, rhs, method="jacobi", tolerance=0.0, max_iterations=60)
    found = recurrent_solve(FittedStencil.jacobi(60), stencil_domain(system), rhs)
    # the same sums in another order, in double precision
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())
    assert relative_residual(stencil_domain(system), rhs, found) == pytest.approx(report.residual, rel=1e-9)


@pytest.mark.parametrize("stencil", [GENERAL, replace(GENERAL, neighbours=np.zeros(7))], ids=["kernel", "diagonal"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_compiled_and_recorded_recurrences_are_one_map_with_one_gradient(stencil, dtype):
    domain = stencil_domain(irregular())
    rng = np.random.default_rng(2)
    rhs, incoming = rng.standard_normal((2, *domain.shape)).astype(dtype)
    number = torch.float32 if dtype is np.float32 else torch.float64
    b = torch.from_numpy(domain.into_box(rhs)).requires_grad_()
    q = recurrent_layers(LayerWeights.of(stencil, number), LayerInput.of(domain, number), b, 20)
    (gradient,) = torch.autograd.grad(q, b, torch.from_numpy(domain.into_box(incoming)))
    # 20 sub-steps of some ten sums each, rounded in another order
    bound = 200 * np.finfo(dtype).eps
    for recorded, values in ((q, rhs), (gradient * torch.from_numpy(domain.inside), incoming)):
        found = recurrent_solve(stencil, domain, values)
        expected = domain.out_of_box(recorded.detach().numpy())
        assert np.abs(found - expected).max() < bound * np.abs(expected).max()


def test_the_true_pressure_is_where_every_stencil_rests():
    """A q = b has no residual, so a sub-step from it changes nothing, whatever the weights."""
    system = irregular()
    ((_, rhs, q),) = samples_of(system, count=1)
    domain = stencil_domain(system)
    many = recurrent_solve(replace(GENERAL, sub_steps=4000), domain, rhs)
    # 4000 sub-steps of a converging recurrence reach the solution to its own rounding
    np.testing.assert_allclose(many, q, atol=1e-8 * np.abs(q).max())


def near_surface(seed=0):
    """A surface as near to cells' centres as is allowed, `SMALLEST_GAP`: weights from 1 to 1000 side by side."""
    system = irregular(seed=seed)
    gaps = np.random.default_rng(seed).choice([1e-3, 0.02, 0.3, 1.0], system.weight_z[:, :, -1].shape)
    system.weight_z[:, :, -1] = 1 / gaps
    return system


@pytest.mark.parametrize(
    "stencil", [FittedStencil.jacobi(8000), replace(GENERAL, sub_steps=4000)], ids=["jacobi", "kernel"]
)
def test_a_surface_a_thousandth_of_a_cell_away_does_not_hinder_convergence(stencil):
    """Scaled by the diagonal no eigenvalue leaves the bound, however large a weight towards air is."""
    system = near_surface()
    ((_, rhs, q),) = samples_of(system, count=1)
    # thousands of sub-steps reach the solution to its own rounding
    np.testing.assert_allclose(recurrent_solve(stencil, stencil_domain(system), rhs), q, atol=1e-8 * np.abs(q).max())


def test_a_stencil_fitted_beside_a_near_surface_is_accepted_there():
    found = fit_stencil(samples_of(near_surface()), sub_steps=24, iterations=30, seed=0)
    validation = validate(found.stencil, samples_of(near_surface(seed=3), seed=4))
    print(f"errors {validation.errors}, Jacobi {validation.jacobi_errors}")
    assert validation.accepted
    # as on the domain without such weights
    assert (validation.errors < 0.2 * validation.jacobi_errors).all()


def test_the_spectrum_stays_below_the_bound():
    """Power iteration on S K S A finds its largest eigenvalue: the bound holds and is not ten times too large."""
    system = irregular()
    domain = stencil_domain(system)
    one = replace(GENERAL, relaxation=np.ones(1), momentum=np.zeros(1), sub_steps=1)
    v = np.random.default_rng(3).standard_normal(domain.shape) * system.unknown
    largest = 0.0
    for _ in range(200):
        image = recurrent_solve(one, domain, system.apply(v))
        largest = float(np.sqrt(np.square(image).sum() / np.square(v).sum()))
        v = image / largest
    print(f"largest eigenvalue {largest:.3f}, bound {GENERAL.bound:.3f}")
    assert 0.1 * GENERAL.bound < largest < GENERAL.bound


def test_amplification_predicts_the_decay_of_an_eigenvector():
    """In a closed box of open faces cosines are eigenvectors of the plain sweep's interior operator: check one by its
    Rayleigh quotient, with momentum."""
    shape = (6, 1, 1)
    weights = [np.zeros(tuple(n + (a == axis) for a, n in enumerate(shape))) for axis in range(3)]
    weights[0][:] = 1.0  # air at both ends
    system = PoissonSystem(np.ones(shape, bool), *weights, spacing=0.5)
    mode = np.sin(np.pi * 2 * (np.arange(6) + 1) / 7).reshape(shape)
    eigenvalue = 1 - np.cos(2 * np.pi / 7)  # of A over its diagonal
    stencil = FittedStencil(np.zeros(7), 0.0, 0.0, np.array([0.7]), np.array([0.4]), 5)
    found = recurrent_solve(stencil, stencil_domain(system), system.apply(mode))
    left = np.abs(mode - found).max() / np.abs(mode).max()
    assert left == pytest.approx(float(stencil.amplification(np.array([eigenvalue]))[0]), rel=1e-10)


@pytest.fixture(scope="module")
def fitted(single_thread):
    """A stencil of 24 sub-steps learnt on one domain."""
    return fit_stencil(samples_of(irregular()), sub_steps=24, iterations=30, seed=0)


def test_fitting_beats_jacobi_on_a_domain_that_it_has_not_seen(fitted):
    validation = validate(fitted.stencil, samples_of(irregular((12, 9, 8), seed=5), seed=7))
    print(f"errors {validation.errors}, Jacobi {validation.jacobi_errors}")
    assert validation.accepted and validation.advice == ""
    # momentum takes the root of the condition number: some tens here, so an order of magnitude after 24 sub-steps
    assert (validation.errors < 0.2 * validation.jacobi_errors).all()
    assert validation.curve[-1] < validation.curve[0]
    assert fitted.errors[-1] < 0.2 * fitted.errors[0]


def test_the_same_seed_gives_the_same_stencil():
    problems = samples_of(irregular((5, 5, 4)))
    a, b = (fit_recurrent_stencil(problems, sub_steps=6, iterations=4, seed=3) for _ in range(2))
    assert all(np.array_equal(x, y) for x, y in zip(vars(a).values(), vars(b).values()))


def test_a_stencil_that_is_no_better_than_jacobi_is_refused_with_a_reason():
    problems = samples_of(irregular(), count=1)
    weak = validate(FittedStencil.jacobi(24, relaxation=0.5), problems)
    assert not weak.accepted and "Jacobi" in weak.advice
    wild = validate(FittedStencil(np.zeros(7), 0.0, 0.0, np.array([3.0]), np.zeros(1), 24), problems)
    assert not wild.accepted and not wild.converges_anywhere and "amplifies" in wild.advice


def test_a_stencil_survives_its_file(tmp_path, fitted):
    path = tmp_path / "stencil.npz"
    fitted.stencil.save(path)
    loaded = FittedStencil.load(path)
    assert all(np.array_equal(a, b) for a, b in zip(vars(fitted.stencil).values(), vars(loaded).values()))
    with np.load(path, allow_pickle=False) as file:
        entries = dict(file)
    del entries["momentum"]
    np.savez(path, **entries)
    with pytest.raises(ValueError, match="momentum"):
        FittedStencil.load(path)


def test_a_domain_lives_as_long_as_its_system():
    from fluidlift.numerics import recurrent_stencil

    system = irregular((5, 5, 4))
    key = id(system)
    assert stencil_domain(system) is stencil_domain(system)
    del system
    assert key not in recurrent_stencil._known


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"neighbours": np.full(7, 0.05)}, "below 1"),
        ({"momentum": np.zeros(3)}, "schedules"),
        ({"sub_steps": 0}, "sub-steps"),
    ],
)
def test_weights_that_may_not_converge_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(GENERAL, **change)
    with pytest.raises(ValueError, match="samples"):
        fit_recurrent_stencil([])
