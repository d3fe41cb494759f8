"""The pressure solver in Warp (here on its CPU device) is that of `numerics.multigrid`, and compiles for a GPU."""

import importlib

import numpy as np
import pytest
from boxes import closed_box

from fluidlift.backends.warp_device import warp_device
from fluidlift.numerics.multigrid_plain import plain_levels, plain_v_cycle
from fluidlift.numerics.poisson import PoissonSystem, solve
from fluidlift.types import triple

warp = pytest.importorskip("warp")

from fluidlift.backends import warp_poisson  # noqa: E402
from fluidlift.backends.warp_poisson import WarpPoisson  # noqa: E402

DEVICE = warp_device("cpu")
SPACING = 0.1


def with_gaps(unknown, weights, seed=0):
    """Weights towards known cells over gaps: 1 to 1000."""
    rng = np.random.default_rng(seed)
    out = []
    for axis, w in enumerate(weights):
        wide = np.moveaxis(np.pad(unknown, [(1, 1) if a == axis else (0, 0) for a in range(3)]), axis, 0)
        surface = np.moveaxis(wide[1:] != wide[:-1], 0, axis)
        gap = np.maximum(rng.uniform(size=w.shape) ** 4, 1e-3)
        out.append(np.where(surface, w / gap, w).astype(np.float32))
    return out


def cut(weights, seed=1):
    """Weights of cut cells: some closed, the others anything."""
    rng = np.random.default_rng(seed)
    return [w * np.maximum(rng.uniform(-0.3, 1.0, w.shape), 0).astype(np.float32) for w in weights]


def box_with_air(shape=(20, 18, 22)):
    unknown = np.ones(shape, bool)
    unknown[:, :, int(0.9 * shape[2]) :] = False
    return unknown, with_gaps(unknown, closed_box(shape))


def thin_river(shape=(24, 14, 17)):
    """A sheet of 2 or 3 cells on a sloping bed of cut cells."""
    i, j, k = np.indices(shape) + 0.5
    bed = 10 - 0.3 * i + 0.8 * np.sin(0.5 * j)
    unknown = (k > bed - 0.5) & (k < bed + 2.5)
    weights = closed_box(shape)
    for axis, w in enumerate(weights):
        x = [np.arange(n) + 0.5 for n in shape]
        x[axis] = np.arange(shape[axis] + 1.0)
        i, j, k = np.meshgrid(*x, indexing="ij", sparse=True)
        w *= np.clip(k - (10 - 0.3 * i + 0.8 * np.sin(0.5 * j)) + 0.5, 0, 1).astype(np.float32)
    return unknown, with_gaps(unknown, weights)


def scattered(shape=(13, 9, 16)):
    """Spray: single cells, pairs, larger groups; faces of any size between them."""
    unknown = np.random.default_rng(2).uniform(size=shape) < 0.45
    return unknown, with_gaps(unknown, cut(closed_box(shape)))


def two_chambers(shape=(16, 12, 10)):
    """No cell of air at all, and a wall between the two halves."""
    weights = cut(closed_box(shape))
    weights[0][shape[0] // 2] = 0.0
    return np.ones(shape, bool), weights


def cave_beside_a_pool(shape=(12, 14, 11)):
    """A pool below air, and a cave of liquid in the rock that only a tunnel joins with it; another that none does."""
    weights = closed_box(shape)
    unknown = np.ones(shape, bool)
    unknown[:, :, -2:] = False
    weights[0][6] = 0.0  # the rock
    weights[2][6:, :, 8] = 0.0  # a ceiling over the caves
    weights[1][6:, 7] = 0.0  # and a wall between them
    weights[0][6, 2, 3] = 0.4  # the tunnel
    return unknown, weights


def needle(shape=(40, 2, 3)):
    unknown = np.ones(shape, bool)
    unknown[-1] = False
    return unknown, closed_box(shape)


def thimble(shape=(3, 4, 2)):
    """One level."""
    unknown = np.ones(shape, bool)
    unknown[0, 0, 0] = False
    return unknown, closed_box(shape)


DOMAINS = [box_with_air, thin_river, scattered, two_chambers, cave_beside_a_pool, needle, thimble]


def upload(values, dtype=None):
    return warp.array(np.ascontiguousarray(values), dtype=dtype or warp.float32, device=DEVICE)


def arguments(unknown, weights, rhs):
    return upload(unknown.astype(np.uint8), warp.uint8), triple(upload(w) for w in weights), upload(rhs)


def on_device(unknown, weights, rhs, initial=None, tolerance=1e-6, **options):
    solver = WarpPoisson(unknown.shape, SPACING, DEVICE, **options)
    start = None if initial is None else upload(initial)
    p, report = solver.solve(*arguments(unknown, weights, rhs), start, tolerance=tolerance)
    return p.numpy(), report


def noise(unknown, seed=3):
    return np.random.default_rng(seed).normal(size=unknown.shape).astype(np.float32)


def v_cycle(solver, unknown, weights, rhs):
    """What the preconditioner makes of a right side."""
    solver.solve(*arguments(unknown, weights, noise(unknown)), tolerance=1e-1, max_iterations=0)
    inner, (nx, ny, nz) = (slice(1, -1),) * 3, unknown.shape
    ringed = (nx + 2, ny + 2, nz + 2)
    count = int(np.prod(ringed))
    has_equation = solver._op.inverse.numpy()[:count] > 0
    padded = np.zeros(ringed, np.float32)
    padded[inner] = rhs
    values = np.where(has_equation, padded.ravel(), 0)
    red = (np.indices(ringed).sum(axis=0) % 2 == 0).ravel()
    for array, content in ((solver._op.rhs, values), (solver._op.x, values * red * solver._op.inverse.numpy()[:count])):
        whole = array.numpy().copy()
        whole[:count] = content
        array.assign(whole)
    solver._krylov.scalars.zero_()
    solver._v_cycle()
    return solver._op.x.numpy()[:count].reshape(ringed)[inner].copy(), has_equation.reshape(ringed)[inner]


@pytest.mark.parametrize("small", [1, 400, 4096])
@pytest.mark.parametrize("domain", DOMAINS)
def test_the_v_cycle_is_the_plain_one(domain, small, monkeypatch):
    monkeypatch.setattr(warp_poisson, "SMALL_CELLS", small)  # levels in launches of their own, or in one block
    unknown, weights = domain()
    rhs = noise(unknown)
    found, has_equation = v_cycle(WarpPoisson(unknown.shape, SPACING, DEVICE), unknown, weights, rhs)
    wanted = plain_v_cycle(plain_levels(unknown, tuple(weights)), np.where(has_equation, rhs, 0.0))
    wanted = np.where(has_equation, wanted, 0.0)
    # single precision; where a component has no air, what its constant comes to is rounding times the size of its cells
    np.testing.assert_allclose(found, wanted, atol=2e-5 * np.abs(wanted).max())
    assert np.abs(wanted).max() > 0.1


@pytest.mark.parametrize("domain", [box_with_air, thin_river, scattered])
def test_the_preconditioner_is_symmetric_and_positive(domain):
    unknown, weights = domain()
    solver = WarpPoisson(unknown.shape, SPACING, DEVICE)
    a, b = noise(unknown, 5), noise(unknown, 6)
    ma, has_equation = v_cycle(solver, unknown, weights, a)
    mb, _ = v_cycle(solver, unknown, weights, b)
    a, b = (np.where(has_equation, v, 0).astype(np.float64) for v in (a, b))
    assert abs((a * mb).sum() - (b * ma).sum()) < 1e-5 * np.sqrt((a * ma).sum() * (b * mb).sum())
    assert (a * ma).sum() > 0 and (b * mb).sum() > 0


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
@pytest.mark.parametrize("domain", DOMAINS)
def test_the_solution_is_that_of_the_cpu_in_as_many_iterations(domain, tolerance):
    unknown, weights = domain()
    rhs = noise(unknown)
    system = PoissonSystem(unknown, *weights, SPACING)
    wanted, theirs = solve(system, rhs, tolerance=tolerance)
    p, ours = on_device(unknown, weights, rhs, tolerance=tolerance)
    assert ours.converged and theirs.converged and ours.method == theirs.method
    # the CPU's coarse cells begin at the first unknown cell, these at the first cell of the box
    assert abs(ours.iterations - theirs.iterations) <= 1
    assert ours.advice == theirs.advice
    assert 0 < ours.residual <= tolerance
    scale = np.abs(wanted).max()
    assert np.abs(p - wanted).max() < 50 * tolerance * scale  # smooth errors hide in the residual: their share of it
    assert not p[~unknown].any()


def test_the_reported_residual_is_the_true_one():
    unknown, weights = box_with_air()
    rhs = noise(unknown)
    p, report = on_device(unknown, weights, rhs, tolerance=1e-3)
    left = np.where(unknown, rhs - PoissonSystem(unknown, *weights, SPACING).apply(p.astype(np.float64)), 0)
    size = np.linalg.norm(rhs[unknown])
    np.testing.assert_allclose(np.linalg.norm(left) / size, report.residual, rtol=1e-2)  # p is rounded afterwards


def test_every_closed_component_loses_its_mean():
    unknown, weights = two_chambers()
    rhs = noise(unknown) + np.float32(2.0)
    p, report = on_device(unknown, weights, rhs)
    assert report.converged and "2 closed component(s)" in report.advice
    for half in (slice(None, 8), slice(8, None)):
        assert abs(p[half].mean()) < 1e-6 * np.abs(p).max()


def test_only_the_cave_without_a_way_to_the_air_is_closed():
    unknown, weights = cave_beside_a_pool()
    _, report = on_device(unknown, weights, noise(unknown))
    assert report.converged and "1 closed component(s)" in report.advice


def test_without_unknown_cells_or_a_right_side_there_is_nothing_to_do():
    unknown, weights = box_with_air((6, 5, 7))
    for given, rhs in ((np.zeros_like(unknown), noise(unknown)), (unknown, np.zeros(unknown.shape))):
        p, report = on_device(given, weights, rhs, initial=noise(unknown))
        assert report.converged and report.iterations == 0 and report.residual == 0.0
        assert not p.any()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["rhs", "initial"])
def test_numbers_that_are_not_finite_are_reported(bad, where):
    unknown, weights = box_with_air((6, 5, 7))
    given = {"rhs": noise(unknown), "initial": noise(unknown)}
    given[where][2, 2, 2] = bad
    p, report = on_device(unknown, weights, **given)
    assert not report.converged and np.isnan(report.residual) and "not finite" in report.advice
    assert not p.any()


def test_a_good_first_guess_saves_iterations():
    unknown, weights = box_with_air()
    rhs = noise(unknown)
    p, cold = on_device(unknown, weights, rhs, tolerance=1e-5)
    _, warm = on_device(unknown, weights, rhs * np.float32(1.001), initial=p, tolerance=1e-5)
    _, done = on_device(unknown, weights, rhs, initial=p, tolerance=1e-4)
    assert 0 < warm.iterations < cold.iterations and done.iterations == 0


def test_iterations_end_at_their_limit():
    unknown, weights = box_with_air()
    solver = WarpPoisson(unknown.shape, SPACING, DEVICE)
    _, report = solver.solve(*arguments(unknown, weights, noise(unknown)), tolerance=1e-9, max_iterations=3)
    assert not report.converged and report.iterations == 3 and "max_iterations" in report.advice


def test_a_solver_forgets_the_system_before():
    solver = WarpPoisson((13, 9, 16), SPACING, DEVICE)
    fresh = []
    for domain in (scattered, box_with_air, two_chambers, scattered):
        unknown, weights = domain((13, 9, 16))
        again, _ = solver.solve(*arguments(unknown, weights, noise(unknown)), tolerance=1e-6)
        alone, _ = on_device(unknown, weights, noise(unknown))
        np.testing.assert_array_equal(again.numpy(), alone)
        fresh.append(alone)
    np.testing.assert_array_equal(fresh[0], fresh[3])


@pytest.mark.parametrize("loops", [False, True])
def test_graphs_give_the_same_bits(loops):
    unknown, weights = thin_river()
    given = arguments(unknown, weights, noise(unknown))
    plain = WarpPoisson(unknown.shape, SPACING, DEVICE, graphs=False)
    replayed = WarpPoisson(unknown.shape, SPACING, DEVICE, graphs=True, loops=loops)
    first = None
    for _ in range(3):  # directly, captured, replayed; from the second on, each begins with the solution before
        wanted, one = plain.solve(*given, first, tolerance=1e-6)
        wanted = wanted.numpy().copy()
        found, two = replayed.solve(*given, first, tolerance=1e-6)
        np.testing.assert_array_equal(found.numpy(), wanted)
        assert one == two
        given[2].assign(given[2].numpy() * 1.5 + noise(unknown, 9))
    assert replayed.launches < plain.launches / 2


def test_an_iteration_needs_few_launches():
    unknown, weights = box_with_air((32, 32, 32))
    solver = WarpPoisson(unknown.shape, SPACING, DEVICE)
    solver.solve(*arguments(unknown, weights, noise(unknown)), tolerance=1e-1, max_iterations=1)
    before = solver.launches
    solver._two_iterations()
    # 8 of a level in its own launches, 1 of all smaller levels, 5 of the conjugate gradients
    assert solver.launches - before == 2 * (8 + 1 + 5)


def test_arrays_of_another_shape_are_refused():
    unknown, weights = box_with_air((6, 5, 7))
    given, faces, rhs = arguments(unknown, weights, noise(unknown))
    solver = WarpPoisson((6, 5, 8), SPACING, DEVICE)
    with pytest.raises(ValueError, match="unknown"):
        solver.solve(given, faces, rhs, tolerance=1e-3)
    solver = WarpPoisson((6, 5, 7), SPACING, DEVICE)
    with pytest.raises(ValueError, match="weights across y"):
        solver.solve(given, (faces[0], faces[0], faces[2]), rhs, tolerance=1e-3)
    with pytest.raises(ValueError, match="cells"):
        WarpPoisson((0, 5, 7), SPACING, DEVICE)


KERNELS = ["poisson_kernels", "poisson_assembly", "poisson_small", "pressure_kernels", "transfer_kernels"]
KERNELS += ["motion_kernels", "stress_kernels", "stress_assembly"]


@pytest.mark.parametrize("name", KERNELS)
def test_kernels_compile_for_a_gpu_that_is_not_here(name, tmp_path):
    module = importlib.import_module(f"fluidlift.backends.warp_{name}")
    paths = warp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    text = "".join(path.read_text() for path in paths)
    assert ".target sm_90" in text
    kernels = [k for k in vars(module).values() if isinstance(k, warp.Kernel) and k.module.name == module.__name__]
    assert kernels and all(k.key in text for k in kernels)
