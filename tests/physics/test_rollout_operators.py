"""The kernels of a rollout's terms against their readable twins, forward and backward, and against differences."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch
from channels import WATER, rocky_channel
from scipy.sparse import diags, identity
from scipy.sparse.linalg import spsolve

from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import (
    RolloutParameters,
    apply_walls,
    explicit_terms,
    explicit_terms_plain,
    rollout,
    set_inflow,
)
from fluidlift.physics.rollout_domain import prepare_domain
from fluidlift.physics.rollout_operators import apply_linear, implicit_diffusion, set_outflow, subtract_gradient
from fluidlift.physics.rollout_pressure import RolloutOptions, project
from fluidlift.types import CellType, Grid

H = 0.1
EXACT = RolloutOptions(tolerance=1e-13)


pytestmark = pytest.mark.usefixtures("single_thread")


def channel(dtype=np.float64):
    types = rocky_channel((8, 6, 6))
    system = build_system(types, None, Grid(types.shape, H))
    return prepare_domain(types, system, mainstream=np.array([1.0, 0.0, 0.0]), dtype=dtype)


def room(dtype=np.float64):
    """Smoke around a block in a box with open sides: dynamic faces up to the ends of every row."""
    types = np.full((5, 6, 7), CellType.EMPTY, np.uint8)
    types[1:4, 1:4, 1:5] = CellType.FLUID
    types[2, 2, 3] = CellType.SOLID
    layout = np.where(types == CellType.EMPTY, CellType.FLUID, types).astype(np.uint8)
    system = build_system(layout, None, Grid(types.shape, H), open_border=True)
    return prepare_domain(types, system, smoke=(types == CellType.FLUID).astype(float), dtype=dtype)


SCENES = pytest.mark.parametrize("scene", [channel, room])


def random_faces(domain, seed=0, size=1.0):
    rng = np.random.default_rng(seed)
    return torch.tensor(size * rng.standard_normal(domain.offsets[3]), dtype=torch.float64)


def parameters_of(physical, **fields):
    return replace(RolloutParameters.of(physical, torch.float64), **fields)


def leaves(physical):
    """All parameters that act on the velocity, with gradients."""
    values = vars(parameters_of(physical))
    return {k: v.clone().requires_grad_() for k, v in values.items() if k != "density"}


@SCENES
@pytest.mark.parametrize("name", ["extrapolation", "divergence", "gradient", "boundary_laplacian"])
def test_linear_kernels_do_what_their_sparse_matrices_say(scene, name):
    domain = scene()
    linear = getattr(domain, name)
    rng = np.random.default_rng(4)
    x, y = rng.standard_normal(linear.matrix.shape[1]), rng.standard_normal(linear.matrix.shape[0])
    # the same sums of a few numbers of size 10 in another order
    np.testing.assert_allclose(linear.forward(x), linear.matrix @ x, rtol=0, atol=1e-12)
    np.testing.assert_allclose(linear.adjoint(y), linear.transpose @ y, rtol=0, atol=1e-12)
    assert np.abs(linear.matrix).sum() > 0 or (name == "boundary_laplacian" and scene is room)


def test_subtracting_the_gradient_is_the_difference_forward_and_backward():
    domain = channel()
    rng = np.random.default_rng(5)
    q = torch.tensor(rng.standard_normal(domain.gradient.matrix.shape[1]), requires_grad=True)
    v, weights = random_faces(domain).requires_grad_(), random_faces(domain, 6)
    fused, plain = subtract_gradient(v, q, domain), v - apply_linear(q, domain.gradient)
    torch.testing.assert_close(fused, plain, rtol=0, atol=1e-13)
    pair = [torch.autograd.grad((out * weights).sum(), (v, q)) for out in (fused, plain)]
    for a, b in zip(*pair):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


@SCENES
@pytest.mark.parametrize("viscosity", [1e-7, 3e-3, 0.5, 20.0])
def test_diffusion_solves_its_sparse_system_and_so_does_its_adjoint(scene, viscosity):
    domain = scene()
    damping, dt = torch.tensor(0.4, dtype=torch.float64), torch.tensor(0.02, dtype=torch.float64)
    v, g = random_faces(domain).requires_grad_(), random_faces(domain, 1)
    out = implicit_diffusion(v, domain, torch.tensor(viscosity, dtype=torch.float64), damping, dt)
    c = viscosity * 0.02
    drag = diags(domain.wall_count * (2 * c * 0.4 / H**2))
    matrix = (identity(v.numel()) - c * domain.laplacian + drag).tocsc()
    x = spsolve(matrix, v.detach().numpy() + c * (domain.boundary_laplacian.matrix @ v.detach().numpy()))
    # residual 1e-13 times a condition number of up to 12 c / h^2 = 500, and its rounding
    np.testing.assert_allclose(out.detach().numpy(), x, rtol=0, atol=1e-10)
    adjoint = spsolve(matrix, g.numpy())
    expected = adjoint + c * (domain.boundary_laplacian.transpose @ adjoint)
    np.testing.assert_allclose(torch.autograd.grad(out, v, g)[0].numpy(), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("rate", [0.01, 1.0, 50.0])
def test_diffusion_in_single_precision_meets_its_tolerance_at_any_viscosity(rate):
    """rate = c / h^2. The residual counts in the norm of D^-1, D the diagonal, in which Chebyshev's bound holds."""
    domain = channel(np.float32)
    v = random_faces(domain).float()
    dt, none = torch.tensor(0.02), torch.tensor(0.0)
    failed = []
    out = implicit_diffusion(v, domain, torch.tensor(rate * H**2 / 0.02), none, dt, failed).double().numpy()
    start = v.double().numpy()
    matrix = (identity(v.numel()) - rate * H**2 * domain.laplacian.astype(float)).tocsc()
    b = start + rate * H**2 * (domain.boundary_laplacian.matrix.astype(float) @ start)
    weight = domain.dynamic / matrix.diagonal()
    left = np.sqrt((weight * (b - matrix @ out) ** 2).sum() / (weight * b**2).sum())
    print(f"c / h^2 = {rate}: residual {left:.2e}")
    # the solve's 1e-6, and as much again from rounding: x to 6e-8, times D / sqrt(D) = 17 for the stiffest
    assert not failed and left < 2e-6
    # the inverse has a norm of 1 at most
    np.testing.assert_allclose(out, spsolve(matrix, b), rtol=0, atol=1e-5 * np.abs(b).max())


def test_a_viscosity_that_the_sweeps_do_not_reach_is_told_and_not_hidden():
    """c / h^2 = 1e6 is a million times what a step resolves."""
    domain = channel(np.float32)
    start = random_faces(domain).float()
    for viscosity, fine in ((1.0, True), (5e5, False)):
        physical = RolloutParameters.of(replace(WATER, kinematic_viscosity=viscosity))
        for options in (RolloutOptions(), RolloutOptions(projection="jacobi", sweeps=5)):
            found = rollout(start, domain, physical, steps=2, options=options)
            methods = [r.method for r in found.reports]
            assert len(methods) == 2 and ("viscosity" in methods) != fine
        if not fine:
            worst = found.reports[0]
            assert not worst.converged and worst.residual > 1e-6 and "shorten" in worst.advice


def test_lists_that_two_threads_ask_for_at_once_are_the_same():
    """Both may build them; whoever reads, reads what one thread alone would have built."""
    barrier = threading.Barrier(4)
    for _ in range(5):
        domain, alone = channel(), channel()

        def ask(domain=domain):
            barrier.wait()
            velocity = random_faces(domain)
            return project(apply_linear(velocity, domain.extrapolation), domain, options=EXACT)

        expected = project(apply_linear(random_faces(alone), alone.extrapolation), alone, options=EXACT)
        with ThreadPoolExecutor(4, initializer=numba.set_num_threads, initargs=(1,)) as pool:
            found = [f.result() for f in [pool.submit(ask) for _ in range(4)]]
        assert all(torch.equal(f, expected) for f in found)


def test_diffusion_without_viscosity_changes_nothing_and_tells_how_viscosity_would():
    domain = channel()
    zero = torch.tensor(0.0, dtype=torch.float64, requires_grad=True)
    damping, dt = torch.tensor(0.4, dtype=torch.float64), torch.tensor(0.02, dtype=torch.float64)
    v, g = random_faces(domain), random_faces(domain, 1)
    out = implicit_diffusion(v, domain, zero, damping, dt)
    assert torch.equal(out, v)
    change = (domain.laplacian + domain.boundary_laplacian.matrix) @ v.numpy()
    change -= domain.wall_count * (2 * 0.4 / H**2) * v.numpy()
    expected = 0.02 * float((g.numpy() * change).sum())
    assert float(torch.autograd.grad(out, zero, g)[0]) == pytest.approx(expected, rel=1e-10)


@SCENES
@pytest.mark.parametrize("size", [0.5, 12.0])
def test_explicit_terms_agree_with_their_plain_twin_forward_and_backward(scene, size):
    """At Courant numbers of a fraction and of several cells, where walls are reached within a step."""
    domain = scene()
    weights = random_faces(domain, 3)
    results = []
    for terms in (explicit_terms, explicit_terms_plain):
        values, v = leaves(WATER), random_faces(domain, 1, size).requires_grad_()
        pattern = random_faces(domain, 2).requires_grad_()
        out = terms(v, domain, parameters_of(WATER, **values), pattern)
        inputs = [v, pattern, *(values[k] for k in sorted(values))]
        grads = torch.autograd.grad((out * weights).sum(), inputs, allow_unused=True, materialize_grads=True)
        results.append([out.detach(), *grads])
    for fast, plain in zip(*results):
        # sums of some thousand numbers of size 10 in another order
        torch.testing.assert_close(fast, plain, rtol=1e-11, atol=1e-10)


def operators(domain):
    """Each term as a function of the velocity and what else has a gradient."""
    tensor = lambda *v: torch.tensor(v if len(v) > 1 else v[0], dtype=torch.float64, requires_grad=True)  # noqa: E731
    pattern = random_faces(domain, 8).requires_grad_()
    inflow = (tensor(1.0, 0.2, 0.1), tensor(0.3), pattern)
    p = parameters_of(WATER)

    def advected(v, dt):
        still = replace(p, time_step=dt, gravity=0 * p.gravity, wall_damping=0 * dt, restitution=0 * dt)
        return explicit_terms(v, domain, still)

    def walled(v, dt, damping, restitution):
        return apply_walls(v, domain, replace(p, time_step=dt, wall_damping=damping, restitution=restitution))

    def explicit(v, dt, damping, restitution, gravity, speed, fluctuation, shape):
        moving = replace(p, time_step=dt, wall_damping=damping, restitution=restitution, gravity=gravity)
        return explicit_terms(v, domain, replace(moving, inflow_velocity=speed, inflow_fluctuation=fluctuation), shape)

    return {
        "extrapolation": (lambda v: apply_linear(v, domain.extrapolation), ()),
        "divergence": (lambda v: apply_linear(v, domain.divergence), ()),
        "advection": (advected, (tensor(0.02),)),
        "walls": (walled, (tensor(0.02), tensor(0.3), tensor(0.4))),
        "force": (lambda v, g: explicit_terms(0 * v, domain, replace(p, gravity=g)), (tensor(0.1, 0.2, -9.0),)),
        "inflow": (
            lambda v, s, f, shape: set_inflow(v, domain, replace(p, inflow_velocity=s, inflow_fluctuation=f), shape),
            inflow,
        ),
        "explicit": (
            explicit,
            (*(tensor(x) for x in (0.02, 0.3, 0.4)), tensor(0.1, 0.2, -9.0), *inflow),
        ),
        "diffusion": (
            lambda v, nu, d, dt: implicit_diffusion(v, domain, nu, d, dt), (tensor(2e-2), tensor(0.3), tensor(0.02))
        ),
        "outflow": (lambda v, s: set_outflow(v, domain, s), (tensor(0.8),)),
        "projection": (lambda v: project(v, domain, options=EXACT), ()),
    }  # fmt: skip


@pytest.mark.parametrize(
    "name",
    ["extrapolation", "divergence", "advection", "walls", "force", "inflow", "explicit", "diffusion", "outflow",
     "projection"],
)  # fmt: skip
def test_each_operator_passes_the_float64_gradcheck(name):
    domain = channel()
    function, more = operators(domain)[name]
    # 0.5 m/s: back-traced points stay within a tenth of a cell, clear of the kinks of the weights at cell borders
    velocity = random_faces(domain, 7, 0.5).requires_grad_()
    # a projection on random directions instead of the full Jacobian: 1000 faces, one number each way
    assert torch.autograd.gradcheck(function, (velocity, *more), eps=1e-6, atol=1e-6, fast_mode=True)


def test_single_precision_follows_double_precision():
    fine, coarse = channel(), channel(np.float32)
    start = 0.5 * random_faces(fine) * torch.from_numpy(fine.interior)
    a = rollout(start, fine, RolloutParameters.of(WATER, torch.float64), steps=3, options=EXACT).velocity
    b = rollout(start.float(), coarse, RolloutParameters.of(WATER), steps=3, options=RolloutOptions(tolerance=1e-7))
    # velocities of a few m/s: rounding of 1e-7 and solver tolerances of 1e-6, amplified by three steps at most tenfold
    torch.testing.assert_close(b.velocity.double(), a, rtol=0, atol=1e-4)


def test_two_rollouts_side_by_side_give_the_bits_of_one_after_the_other():
    domain = channel(np.float32)
    starts = [random_faces(domain, seed, 0.5).float() for seed in range(4)]

    def gradient(start):
        numba.set_num_threads(1)
        p = RolloutParameters.of(WATER)
        p.gravity.requires_grad_()
        result = rollout(start, domain, p, steps=4)
        (result.velocity**2).sum().backward()
        return torch.cat([result.velocity.detach(), p.gravity.grad])

    alone = [gradient(s) for s in starts]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(gradient, starts))
    assert all(torch.equal(a, b) for a, b in zip(alone, together))
