"""The rollout in torch operations does what the rollout on the CPU does, forward and backward, on any device."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import torch
from channels import WATER, rocky_channel
from torch._subclasses.fake_tensor import FakeTensorMode

from fluidlift.numerics import torch_multigrid
from fluidlift.physics import rollout_torch
from fluidlift.physics.advection import advect as advect_on_host
from fluidlift.physics.pressure import build_system
from fluidlift.physics.rollout import RolloutParameters, rollout, unflatten
from fluidlift.physics.rollout_domain import prepare_domain
from fluidlift.physics.rollout_pressure import RolloutOptions
from fluidlift.physics.rollout_torch import (
    Solved,
    apply_walls,
    back_trace,
    diffuse,
    extrapolate,
    project,
    rollout_on_device,
)
from fluidlift.physics.rollout_torch_domain import (
    TorchDomain,
    box_to_flat,
    differences,
    flat_to_box,
    flux_balance,
    neighbour_sum,
)
from fluidlift.types import CellType, Grid

CUDA = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device"))
DEVICES = ["cpu", CUDA]
H = 0.1
DOWNSTREAM = np.array([1.0, 0.0, 0.0])
EXACT = RolloutOptions(tolerance=1e-12)


pytestmark = pytest.mark.usefixtures("single_thread")


def river(shape=(9, 6, 5), depth=4, dtype=np.float64):
    types = rocky_channel(shape, depth)
    return prepare_domain(types, build_system(types, None, Grid(shape, H)), mainstream=DOWNSTREAM, dtype=dtype)


def plume(shape=(7, 6, 8), dtype=np.float64):
    """Smoke in air with open borders; a solid below."""
    types = np.full(shape, CellType.EMPTY, np.uint8)
    types[2:5, 2:5, 2:5] = CellType.FLUID
    types[:, :, 0] = CellType.SOLID
    types[3, 3, 0] = CellType.INFLOW
    smoke = (types == CellType.FLUID).astype(float)
    layout = np.where(types == CellType.EMPTY, CellType.FLUID, types).astype(np.uint8)
    system = build_system(layout, None, Grid(shape, H), open_border=True)
    return prepare_domain(types, system, smoke=smoke, dtype=dtype)


def pool(shape=(6, 5, 6), dtype=np.float64):
    """A closed box full of liquid but for one block: the pressure has a free constant."""
    types = np.full(shape, CellType.FLUID, np.uint8)
    types[2:4, 1:3, 0:2] = CellType.SOLID
    return prepare_domain(types, build_system(types, None, Grid(shape, H)), dtype=dtype)


LAYOUTS = {"river": river, "plume": plume, "pool": pool}


def random_faces(domain, size=1.0, seed=1):
    flat = size * np.random.default_rng(seed).standard_normal(domain.offsets[3])
    return torch.tensor(flat, dtype=torch.from_numpy(domain.inflow).dtype)


def leaves(dtype=torch.float64, device="cpu"):
    return {k: v.to(device).requires_grad_() for k, v in vars(RolloutParameters.of(WATER, dtype)).items()}


def value_and_gradients(function, domain, dtype=torch.float64, **arguments):
    """The last velocity of four steps, and the gradient of a random projection of it in start and parameters."""
    values, start = leaves(dtype), random_faces(domain, 0.5).requires_grad_()
    result = function(
        start, domain, RolloutParameters(**values), steps=4, patterns=random_faces(domain, seed=2), **arguments
    )
    (result.velocity * random_faces(domain, seed=3)).sum().backward()
    gradients = {k: torch.zeros_like(v) if v.grad is None else v.grad for k, v in values.items()}
    return result, gradients | {"start": start.grad}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", list(LAYOUTS))
@pytest.mark.parametrize(
    "options",
    [EXACT, replace(EXACT, advection_gradient="upwind"), RolloutOptions(projection="jacobi", sweeps=30)],
    ids=["exact", "upwind", "jacobi"],
)
def test_velocity_and_gradients_are_those_of_the_rollout_on_the_cpu(name, options, device):
    domain = LAYOUTS[name]()
    expected, expected_gradients = value_and_gradients(rollout, domain, options=options)
    result, gradients = value_and_gradients(rollout_on_device, domain, options=options, device=device)
    # solves to 1e-12 of pressures and 1e-13 of viscosity, a condition of some hundred, four steps
    torch.testing.assert_close(result.velocity, expected.velocity, rtol=0, atol=1e-9)
    np.testing.assert_allclose(result.potentials, expected.potentials, rtol=0, atol=1e-9)
    moving = ["kinematic_viscosity", "gravity", "time_step", "wall_damping", "restitution", "start"]
    assert all(
        gradients[k].norm() > 0 for k in moving + ["outflow_velocity", "inflow_fluctuation"][: 2 * (name == "river")]
    )
    largest = max(float(g.norm()) for k, g in expected_gradients.items())
    for key, gradient in expected_gradients.items():
        assert (gradients[key] - gradient).norm() <= 1e-9 * (gradient.norm() + 1e-3 * largest), key


@pytest.mark.parametrize("device", DEVICES)
def test_single_precision_agrees_to_the_working_tolerance(device):
    domain = river((12, 9, 8), depth=6, dtype=np.float32)
    expected, expected_gradients = value_and_gradients(rollout, domain, torch.float32)
    result, gradients = value_and_gradients(rollout_on_device, domain, torch.float32, device=device)
    assert result.velocity.dtype == torch.float32 and all(r.converged for r in result.reports)
    # both solve to 1e-5; the condition of some hundred cells makes it 1e-4
    torch.testing.assert_close(result.velocity, expected.velocity, rtol=0, atol=3e-4)
    for key, gradient in expected_gradients.items():
        assert (gradients[key] - gradient).norm() <= 2e-3 * gradient.norm(), key


def test_segments_that_are_computed_again_change_no_gradient_and_layouts_may_change():
    shallow, deep = river(depth=3), river(depth=4)
    domains = [deep, deep, shallow, shallow]
    patterns = [None, random_faces(deep, seed=4), None, random_faces(deep, seed=5)]
    found = []
    for every in (None, 1, 3):
        values, start = leaves(), random_faces(deep, 0.5).requires_grad_()
        result = rollout_on_device(
            start, domains, RolloutParameters(**values), steps=4, patterns=patterns, options=EXACT,
            checkpoint_every=every,
        )  # fmt: skip
        result.velocity.square().sum().backward()
        assert len(result.reports) == len(result.potentials) == 4 and result.domain is shallow
        found.append((result.velocity.detach(), start.grad, values["time_step"].grad))
    for again in found[1:]:
        for a, b in zip(found[0], again):
            # the same operations on the same numbers; sums of gradients in another order
            torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)
    on_host = rollout(
        random_faces(deep, 0.5), domains, RolloutParameters.of(WATER, torch.float64), steps=4, patterns=patterns,
        options=EXACT,
    )  # fmt: skip
    torch.testing.assert_close(found[0][0], on_host.velocity, rtol=0, atol=1e-9)


def test_first_guesses_change_nothing_but_the_work_and_a_placed_layout_serves_many_calls():
    domain = river((16, 12, 10), depth=8, dtype=np.float32)
    placed, physical = TorchDomain.of(domain, "cpu"), RolloutParameters.of(WATER)
    start = random_faces(domain, 0.3)
    cold = rollout_on_device(start, placed, physical, steps=3)
    warm = rollout_on_device(start, placed, physical, steps=3, guesses=cold.potentials)
    assert sum(r.iterations for r in warm.reports) < sum(r.iterations for r in cold.reports)
    torch.testing.assert_close(warm.velocity, cold.velocity, rtol=0, atol=1e-3)
    assert cold.domain is domain


@pytest.mark.parametrize("name", list(LAYOUTS))
def test_slices_are_the_sparse_operators_of_the_layout(name):
    domain = LAYOUTS[name]()
    placed = TorchDomain.of(domain, "cpu")
    flat = random_faces(domain)
    box, q = flat_to_box(flat, domain), torch.where(torch.from_numpy(domain.system.unknown), 1.0, 0.0).double()
    q = q * torch.randn(q.shape, dtype=q.dtype, generator=torch.Generator().manual_seed(0))
    assert torch.equal(box_to_flat(box, domain), flat)
    dynamic, inflow = torch.from_numpy(domain.dynamic), torch.from_numpy(domain.inflow)
    pairs = [
        (extrapolate(box, placed), domain.extrapolation.matrix @ flat.numpy()),
        (placed.slope * differences(q), domain.gradient.matrix @ q.numpy().ravel()),
        (rollout_torch._laplacian(box, placed), domain.laplacian @ flat.numpy()),
        (
            neighbour_sum(box * placed.inflow) * placed.dynamic / H**2,
            domain.boundary_laplacian.matrix @ flat.numpy(),
        ),
    ]
    for ours, expected in pairs:
        # a handful of additions; faces outside the fluid have no row in the matrices
        np.testing.assert_allclose(
            box_to_flat(ours, domain).numpy(), expected, rtol=0, atol=1e-12 * max(np.abs(expected).max(), 1)
        )
    balance = flux_balance(placed.area * box) * torch.from_numpy(domain.system.unknown)
    np.testing.assert_allclose(balance.numpy().ravel(), domain.divergence.matrix @ flat.numpy(), atol=1e-12)
    assert dynamic.any() and (name == "pool" or inflow.any())


def test_the_back_trace_is_that_of_the_kernels_beyond_the_box_and_at_high_courant_numbers():
    for domain in (pool((5, 4, 6)), pool((6, 1, 4)), river()):
        flat = random_faces(domain, 3.0)
        expected = advect_on_host(unflatten(flat, domain), 0.1, spacing=H, active=domain.active())
        box = back_trace(
            flat_to_box(flat, domain), torch.tensor(1.0, dtype=torch.float64), TorchDomain.of(domain, "cpu")
        )
        # the same interpolation, multiplied out in another order
        torch.testing.assert_close(
            box_to_flat(box, domain), torch.cat([e.reshape(-1) for e in expected]), rtol=1e-12, atol=1e-12
        )


@pytest.mark.parametrize("term", ["extrapolation", "advection", "viscosity", "walls", "projection"])
def test_each_term_passes_the_float64_gradcheck(term):
    domain = river((6, 5, 5))
    placed = TorchDomain.of(domain, "cpu")
    start = random_faces(domain).requires_grad_()
    names = ("kinematic_viscosity", "wall_damping", "restitution", "time_step")
    values = [torch.tensor(x, dtype=torch.float64, requires_grad=True) for x in (2e-2, 0.3, 0.4, 0.02)]

    def apply(flat, *values):
        physical = replace(RolloutParameters.of(WATER, torch.float64), **dict(zip(names, values)))
        box = flat_to_box(flat, domain)
        if term == "extrapolation":
            box = extrapolate(box, placed)
        elif term == "advection":
            box = back_trace(box, physical.time_step / H, placed)
        elif term == "viscosity":
            box = diffuse(box, placed, physical)
        elif term == "walls":
            box = apply_walls(box, placed, physical)
        else:
            box = project(box, placed, options=replace(EXACT, tolerance=1e-13))
        return box_to_flat(box, domain)

    # a projection of random directions instead of the full Jacobian: 300 faces, one number each way
    assert torch.autograd.gradcheck(apply, (start, *values), eps=1e-6, atol=1e-6, fast_mode=True)


def test_taylor_remainder_of_a_four_step_rollout_falls_with_the_square_of_the_step():
    domain = river()
    placed = TorchDomain.of(domain, "cpu")
    physical = RolloutParameters.of(WATER, torch.float64)
    # smooth start: kinks of the back-trace and of the walls are then not crossed by small steps
    start = rollout_on_device(random_faces(domain, 0.2), placed, physical, steps=3, options=EXACT).velocity
    pattern = random_faces(domain, seed=7)
    rng = np.random.default_rng(7)

    def loss(values):
        result = rollout_on_device(start, placed, RolloutParameters(**values), steps=4, patterns=pattern, options=EXACT)
        inside = result.velocity[torch.from_numpy(domain.dynamic)]
        return inside.square().mean() + inside.mean()

    values = leaves()
    value = loss(values)
    value.backward()
    directions = {k: torch.tensor(rng.standard_normal(v.shape)) * (v.detach().abs() + 1e-3) for k, v in values.items()}
    slope = sum(float((v.grad * directions[k]).sum()) for k, v in values.items() if v.grad is not None)
    steps = np.array([1e-2, 5e-3, 2.5e-3, 1.25e-3])
    remainders = []
    for e in steps:
        moved = {k: v.detach() + e * directions[k] for k, v in values.items()}
        remainders.append(abs(float((loss(moved) - value).detach()) - e * slope))
    order = np.polyfit(np.log(steps), np.log(remainders), 1)[0]
    print(f"order {order:.3f}, remainders {remainders}")
    assert 1.9 < order < 2.1


def on_a_pretended_device(value):
    """The same tensors on a device that holds no numbers; mixing it with the CPU is an error, as it is on CUDA."""
    if isinstance(value, torch.Tensor):
        return torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device="meta")
    if isinstance(value, tuple):
        return tuple(on_a_pretended_device(v) for v in value)
    if dataclasses.is_dataclass(value) and type(value).__module__.startswith("fluidlift.") and "layout" != value:
        parts = {
            f.name: on_a_pretended_device(getattr(value, f.name))
            for f in dataclasses.fields(value)
            if f.name != "layout"
        }
        return dataclasses.replace(value, **parts)
    return value


@pytest.mark.parametrize("projection", ["implicit", "jacobi"])
@pytest.mark.parametrize("gradient", ["exact", "upwind"])
def test_no_tensor_of_a_rollout_is_left_on_the_host(projection, gradient, monkeypatch):
    """Start and parameters lie on the CPU, all else must follow the layout: forward, backward, and when repeated."""
    domain = river()
    placed = TorchDomain.of(domain, "cpu")
    looks = []

    def look(value):
        assert value.device.type == "meta", value
        looks.append(value)
        return float(len(looks) % 3 > 0)

    monkeypatch.setattr(torch_multigrid, "host_value", look)
    monkeypatch.setattr(rollout_torch, "_on_host", lambda values: np.zeros(tuple(values.shape)))
    options = RolloutOptions(projection=projection, sweeps=3, advection_gradient=gradient)
    with FakeTensorMode():
        pretended = on_a_pretended_device(placed)
        assert pretended.device.type == "meta"
        flat = torch.ones(domain.offsets[3], dtype=torch.float64, requires_grad=True)
        shapes = vars(RolloutParameters.of(WATER))
        values = {k: torch.ones(v.shape, dtype=torch.float64, requires_grad=True) for k, v in shapes.items()}
        for every in (None, 1):
            result = rollout_on_device(
                flat, pretended, RolloutParameters(**values), steps=2, patterns=torch.ones_like(flat), options=options,
                checkpoint_every=every,
            )  # fmt: skip
            result.velocity.sum().backward()
        assert result.velocity.device.type == flat.grad.device.type == values["gravity"].grad.device.type == "cpu"
    assert len(looks) > 20


def test_all_tensors_of_a_layout_go_to_its_device():
    placed = TorchDomain.of(plume(), "meta")
    found = [v for v in (vars(placed) | vars(placed.trace)).values() if isinstance(v, torch.Tensor)]
    found += placed.fills
    assert len(found) > 20 and {t.device.type for t in found} == {"meta"}
    assert placed.system.diagonal.device.type == "meta"


def test_a_viscous_solve_that_misses_its_tolerance_is_told(monkeypatch):
    domain = river()
    physical = replace(RolloutParameters.of(WATER, torch.float64), kinematic_viscosity=torch.tensor(1.0).double())
    for fine in (True, False):
        if not fine:  # c / h^2 = 2 takes some ten times as many
            monkeypatch.setattr(rollout_torch, "MOST_DIFFUSION_ITERATIONS", 4)
        found = rollout_on_device(random_faces(domain), domain, physical, steps=2)
        assert [r.method for r in found.reports] == ["torch multigrid" if fine else "viscosity"] * 2
    worst = found.reports[0]
    assert not worst.converged and 1e-12 < worst.residual < 1 and "shorten" in worst.advice


def test_what_the_device_does_not_know_is_refused():
    domain = river()
    physical = RolloutParameters.of(WATER, torch.float64)
    start = random_faces(domain)
    with pytest.raises(ValueError, match="advection gradient"):
        rollout_on_device(start, domain, physical, steps=1, options=RolloutOptions(advection_gradient="plain"))
    with pytest.raises(ValueError, match="faces"):
        rollout_on_device(start[:-1], domain, physical, steps=1)
    with pytest.raises(ValueError, match="2 domains for 3 steps"):
        rollout_on_device(start, [domain] * 2, physical, steps=3)
    with pytest.raises(ValueError, match="checkpoint_every"):
        rollout_on_device(start, domain, physical, steps=1, checkpoint_every=0)
    with pytest.raises(ValueError, match="projection 'unrolled'"):
        project(
            flat_to_box(start, domain), TorchDomain.of(domain, "cpu"), options=RolloutOptions(projection="unrolled")
        )


def test_a_step_that_is_computed_again_takes_its_pressure_from_before(monkeypatch):
    placed = TorchDomain.of(river(), "cpu")
    box = flat_to_box(random_faces(placed.layout), placed.layout)
    solved = Solved()
    first = project(box, placed, options=EXACT, solved=solved)
    assert solved.report is not None and solved.report.converged
    monkeypatch.setattr(torch_multigrid, "solve", None)
    assert torch.equal(project(box, placed, options=EXACT, solved=solved), first)
