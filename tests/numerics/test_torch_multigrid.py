"""The torch solver finds the pressure that the NumPy one finds, on any device, in as many iterations on any grid."""

import dataclasses

import numpy as np
import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from fluidlift.numerics import torch_multigrid
from fluidlift.numerics.poisson import PoissonSystem
from fluidlift.numerics.poisson import solve as solve_on_host
from fluidlift.numerics.torch_multigrid import jacobi, solve, v_cycle
from fluidlift.numerics.torch_poisson import DeviceSystem

CUDA = pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device"))
DEVICES = ["cpu", CUDA]


pytestmark = pytest.mark.usefixtures("single_thread")


def face_shape(shape, axis):
    return tuple(n + (a == axis) for a, n in enumerate(shape))


def faces_between(cells, axis):
    """Whether the cells on both sides of the inner faces differ."""
    c = np.moveaxis(cells, axis, 0)
    return c[1:] != c[:-1]


def sea_round_a_ball(n, seed=0):
    """Waves under air whose surface lies anywhere between the cells (weights up to 4), a solid ball, solid borders."""
    rng = np.random.default_rng(seed)
    x, y, z = (np.indices((n, n, n)) + 0.5) / n
    ball = (x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.3) ** 2 < 0.04
    unknown = (z < 0.6 + 0.1 * np.sin(6 * x)) & ~ball
    weights = []
    for axis in range(3):
        w = np.ones((n + 1, n, n))
        w[[0, -1]] = 0.0
        near = faces_between(unknown, axis)
        w[1:-1][near] = rng.uniform(1, 4, near.sum())
        w[1:-1][faces_between(ball, axis)] = 0.0
        weights.append(np.moveaxis(w, 0, axis).astype(np.float32))
    return PoissonSystem(unknown, *weights, 1.0 / n)


def closed_box(shape=(13, 10, 7), seed=1):
    """Random open fractions inside, no way out."""
    rng = np.random.default_rng(seed)
    weights = []
    for axis in range(3):
        w = np.moveaxis(rng.uniform(0.05, 1.0, face_shape(shape, axis)), axis, 0)
        w[[0, -1]] = 0.0
        weights.append(np.moveaxis(w, 0, axis).astype(np.float32))
    return PoissonSystem(np.ones(shape, bool), *weights, 0.1)


def two_chambers_and_a_pond():
    """A wall cuts a closed box; beside it a pond under air, and one cell that nothing reaches."""
    system = closed_box((16, 9, 8))
    x, y, z = system.weights
    x[5], x[10] = 0.0, 0.0
    z[11:, :, -1] = 1.0
    for w in (x[11:13], y[11, :2], z[11, 0, :2]):
        w[...] = 0.0
    y[11], z[11] = 0.0, 0.0
    return system


def rubble(shape=(18, 15, 11), seed=2):
    """Cells and faces closed at random."""
    rng = np.random.default_rng(seed)
    weights = [(rng.random(face_shape(shape, a)) < 0.7).astype(np.float32) for a in range(3)]
    return PoissonSystem(rng.random(shape) < 0.7, *weights, 0.05)


SYSTEMS = {
    "sea": lambda: sea_round_a_ball(22),
    "closed": closed_box,
    "chambers": two_chambers_and_a_pond,
    "rubble": rubble,
}


def random_side(system, dtype=np.float64, seed=3):
    return np.where(system.unknown, np.random.default_rng(seed).standard_normal(system.unknown.shape), 0).astype(dtype)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", list(SYSTEMS))
def test_the_pressure_is_that_of_the_numpy_solver(name, device):
    system = SYSTEMS[name]()
    rhs = random_side(system)
    expected, on_host = solve_on_host(system, rhs, tolerance=1e-11)
    p, report = solve(DeviceSystem.of(system, device), torch.from_numpy(rhs).to(device), tolerance=1e-11)
    assert on_host.converged and report.converged
    assert ("mean" in report.advice) == ("mean" in on_host.advice)
    # two residuals of 1e-11 and a condition below 1e4
    np.testing.assert_allclose(p.cpu().numpy(), expected, atol=1e-7 * np.abs(expected).max())
    assert not p.cpu().numpy()[~system.unknown].any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_reported_residual_is_the_true_one_and_keeps_the_tolerance(dtype, device):
    system = sea_round_a_ball(32)
    rhs = random_side(system, dtype)
    for tolerance in (1e-2, 1e-5, 1e-12):
        p, report = solve(DeviceSystem.of(system, device), torch.from_numpy(rhs).to(device), tolerance=tolerance)
        assert report.converged and report.residual <= tolerance * (1 + 1e-6)
        if dtype == np.float64:
            true = np.sqrt(np.square(rhs - system.apply(p.cpu().numpy())).sum() / np.square(rhs).sum())
            # sums in another order
            assert report.residual == pytest.approx(true, rel=1e-6, abs=1e-14)


@pytest.mark.parametrize("device", DEVICES)
def test_iterations_hardly_grow_with_the_resolution(device):
    counts = []
    for n in (16, 32, 64):
        system = sea_round_a_ball(n)
        _, report = solve(DeviceSystem.of(system, device), torch.from_numpy(random_side(system)).to(device))
        assert report.converged
        counts.append(report.iterations)
    print("iterations", counts)
    # the smoother and the coarse operator work the same at each size; off the CPU counts are multiples of four
    assert max(counts) <= min(counts) + (2 if device == "cpu" else 4) and max(counts) <= 8


@pytest.mark.parametrize("name", list(SYSTEMS))
def test_the_cycle_is_symmetric_and_positive(name):
    system = DeviceSystem.of(SYSTEMS[name](), "cpu")
    rng = torch.Generator().manual_seed(0)
    inside = system.active.float()
    a, b = (torch.randn(inside.shape, generator=rng) * inside for _ in range(2))
    for vector in (a, b):
        if system.closed_cells.numel():
            # the cycle acts on the scaled unknowns: what the equation admits there
            wide = (vector * system.levels[0].unscale).double()
            system.remove_means(wide)
            vector.copy_(wide * system.levels[0].scale)
    ma, mb = v_cycle(system, a.clone()), v_cycle(system, b.clone())
    size = float(a.norm() * mb.norm())
    # single precision over some hundred operations
    assert abs(float((a.double() * mb).sum() - (ma.double() * b).sum())) < 1e-5 * size
    assert float((a * ma).sum()) > 0 and float((b * mb).sum()) > 0


@pytest.mark.parametrize("device", DEVICES)
def test_jacobi_sweeps_are_those_of_the_numpy_solver(device):
    for system in (sea_round_a_ball(12), two_chambers_and_a_pond()):
        rhs = random_side(system)
        expected, on_host = solve_on_host(system, rhs, method="jacobi", tolerance=0.0, max_iterations=23)
        p, report = jacobi(DeviceSystem.of(system, device), torch.from_numpy(rhs).to(device), sweeps=23)
        # rounding of 23 sweeps
        np.testing.assert_allclose(p.cpu().numpy(), expected, atol=1e-12 * np.abs(expected).max())
        assert report.residual == pytest.approx(on_host.residual, rel=1e-9) and not report.converged


def test_a_first_guess_saves_iterations_and_a_solution_needs_none():
    system = DeviceSystem.of(sea_round_a_ball(20), "cpu")
    rhs = torch.from_numpy(random_side(sea_round_a_ball(20)))
    p, cold = solve(system, rhs, tolerance=1e-8)
    _, warm = solve(system, 1.001 * rhs, tolerance=1e-8, initial=p)
    _, again = solve(system, rhs, tolerance=1.1e-8, initial=p)
    assert warm.converged and warm.iterations < cold.iterations and again.iterations == 0


def test_looking_at_the_residual_seldom_changes_only_how_far_it_falls(monkeypatch):
    monkeypatch.setattr(torch_multigrid, "check_every", lambda device: 4)
    system = sea_round_a_ball(20)
    p, report = solve(DeviceSystem.of(system, "cpu"), torch.from_numpy(random_side(system)), tolerance=1e-5)
    assert report.converged and report.iterations % 4 == 0
    # a lone cell is solved by the first iteration: the next three must not divide by zero
    lone = PoissonSystem(np.ones((1, 1, 1), bool), np.ones((2, 1, 1)), np.ones((1, 2, 1)), np.ones((1, 1, 2)), 1.0)
    p, report = solve(DeviceSystem.of(lone, "cpu"), torch.full((1, 1, 1), 3.0, dtype=torch.float64), tolerance=1e-14)
    assert report.converged and float(p) == pytest.approx(0.5, rel=1e-14)


def test_nothing_to_solve_gives_zero_and_what_is_not_finite_is_said():
    box = PoissonSystem(np.zeros((3, 4, 5), bool), np.ones((4, 4, 5)), np.ones((3, 5, 5)), np.ones((3, 4, 6)), 1.0)
    full = dataclasses.replace(box, unknown=np.ones((3, 4, 5), bool))
    for system, rhs in ((box, torch.ones(3, 4, 5)), (full, torch.zeros(3, 4, 5))):
        p, report = solve(DeviceSystem.of(system, "cpu"), rhs)
        assert report.converged and not p.any() and p.dtype == torch.float32
    broken = torch.full((3, 4, 5), float("nan"))
    for rhs, guess in ((broken, None), (torch.ones(3, 4, 5), broken)):
        p, report = solve(DeviceSystem.of(full, "cpu"), rhs, initial=guess)
        assert not report.converged and "not finite" in report.advice and not p.any()


def test_what_lies_outside_the_unknown_cells_need_not_be_finite():
    system = sea_round_a_ball(12)
    rhs = random_side(system)
    expected, _ = solve(DeviceSystem.of(system, "cpu"), torch.from_numpy(rhs))
    rhs[~system.unknown] = np.nan
    p, report = solve(DeviceSystem.of(system, "cpu"), torch.from_numpy(rhs))
    assert report.converged and torch.equal(p, expected)


def test_arguments_that_do_not_fit_are_refused():
    system = DeviceSystem.of(closed_box(), "cpu")
    with pytest.raises(ValueError, match="rhs"):
        solve(system, torch.zeros(3, 4, 4))
    with pytest.raises(ValueError, match="first guess"):
        solve(system, torch.ones(13, 10, 7), initial=torch.ones(2, 2, 2))
    with pytest.raises(ValueError, match="meta"):
        solve(system, torch.ones(13, 10, 7, device="meta"))
    with pytest.raises(ValueError, match="double precision"):
        DeviceSystem.of(closed_box(), "mps")
    if not torch.cuda.is_available():
        with pytest.raises(ValueError, match="torch sees"):
            DeviceSystem.of(closed_box(), "cuda")


def on_a_pretended_device(value):
    """The same tensors on a device that holds no numbers; mixing it with the CPU is an error, as it is on CUDA."""
    if isinstance(value, torch.Tensor):
        return torch.empty_strided(value.shape, value.stride(), dtype=value.dtype, device="meta")
    if isinstance(value, tuple):
        return tuple(on_a_pretended_device(v) for v in value)
    if dataclasses.is_dataclass(value):
        parts = {f.name: on_a_pretended_device(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return dataclasses.replace(value, **parts)
    return value


def test_no_tensor_of_a_solve_is_left_on_the_host(monkeypatch):
    looks = iter([1.0, 0.1] + [1.0, 1.0, 0.0] * 20)
    monkeypatch.setattr(torch_multigrid, "host_value", lambda value: (value.device.type == "meta") * next(looks))
    system = DeviceSystem.of(two_chambers_and_a_pond(), "cpu")
    with FakeTensorMode():
        pretended = on_a_pretended_device(system)
        rhs = torch.ones(system.shape, device="meta")
        p, report = solve(pretended, rhs)
        q, _ = jacobi(pretended, rhs, sweeps=3)
    assert p.device.type == q.device.type == "meta" and report.iterations > 0


def test_all_tensors_of_a_system_go_to_its_device():
    system = DeviceSystem.of(two_chambers_and_a_pond(), "meta")

    def tensors(value):
        if isinstance(value, torch.Tensor):
            return [value]
        if dataclasses.is_dataclass(value):
            value = tuple(getattr(value, f.name) for f in dataclasses.fields(value))
        return [t for v in value for t in tensors(v)] if isinstance(value, tuple) else []

    found = tensors(system)
    assert len(found) > 20 and {t.device.type for t in found} == {"meta"}
