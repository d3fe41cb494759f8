"""A twin is what the rollout makes of its parameters; noise and hidden cells spoil only what is given of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from fluidlift.physics.rollout import flatten
from fluidlift.synthetic.twins import PLANS, hidden_cells, make_twin
from fluidlift.types import CellType

NAMES = sorted(PLANS)

pytestmark = pytest.mark.usefixtures("single_thread")


@pytest.fixture(scope="module")
def twins():
    return {name: make_twin(name, seed=4) for name in NAMES}


def open_faces(twin):
    domain = twin.domain()
    return domain.dynamic | (domain.inflow > 0)


@pytest.mark.parametrize("name", NAMES)
def test_the_same_seed_gives_the_same_twin_and_another_seed_another(name, twins):
    a, b = (make_twin(name, seed=4, noise=0.1, hidden=0.2) for _ in range(2))
    other = make_twin(name, seed=5)
    assert a.truth == b.truth == twins[name].truth
    assert a.truth != other.truth and a.start == other.start
    for one, two in zip(a.frames, b.frames, strict=True):
        assert all(np.array_equal(x, y) for x, y in zip(one.components, two.components, strict=True))
    assert np.array_equal(a.observed[0], b.observed[0])
    # noise and hidden cells leave the flow alone
    assert np.array_equal(a.exact[-1].u, twins[name].exact[-1].u)


@pytest.mark.parametrize("name", NAMES)
def test_each_frame_is_the_rollout_of_the_frame_before(name, twins):
    twin = twins[name]
    for before, after in zip(twin.exact[:-1], twin.exact[1:], strict=True):
        again = twin.continued(twin.truth, before, 1)[0]
        assert all(np.array_equal(x, y) for x, y in zip(again.components, after.components, strict=True))


@pytest.mark.parametrize("name", NAMES)
def test_no_fluid_cell_makes_or_loses_volume(name, twins):
    twin = twins[name]
    domain = twin.domain()
    for frame in twin.exact:
        divergence = (domain.divergence.matrix @ flatten(frame).numpy())[domain.system.unknown.ravel()]
        # what crosses a cell is U / h per second: the solves end at 1e-6 of the divergence that gravity makes
        assert np.abs(divergence).max() * twin.grid.spacing / twin.speed < 1e-4


@pytest.mark.parametrize("name", NAMES)
def test_the_flow_develops_and_is_nearly_steady_at_the_end(name, twins):
    twin = twins[name]
    fluid = twin.cell_types == CellType.FLUID
    speeds = [np.linalg.norm(f.at_centers()[fluid], axis=-1) for f in twin.exact]
    changes = [np.abs(b - a).mean() / twin.speed for a, b in zip(speeds[:-1], speeds[1:], strict=True)]
    assert 8 <= len(twin.exact) <= 10
    # speeds up by a tenth at least, and a frame at the end changes it by half as much as the liveliest, or less
    assert speeds[-1].mean() > 1.1 * speeds[0].mean()
    assert changes[-1] < 0.5 * max(changes)
    # nothing blows up: the fastest fluid fell through the height of the box or is a few times faster than the mean
    height = twin.grid.shape[2] * twin.grid.spacing
    assert speeds[-1].max() < max(np.sqrt(2 * 11 * height + 1.0), 8 * twin.speed)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(4))
def test_every_seed_has_fluid_from_its_inlet_to_its_outlet(name, seed):
    twin = make_twin(name, seed=seed, frames=2)
    wet = np.isin(twin.cell_types, (CellType.FLUID, CellType.INFLOW, CellType.OUTFLOW))
    assert np.array_equal(ndimage.binary_propagation(twin.cell_types == CellType.INFLOW, mask=wet), wet)
    assert {CellType.INFLOW, CellType.OUTFLOW} <= set(np.unique(twin.cell_types))
    # parameters are drawn around the scene's, and the guess is not the truth
    plan = PLANS[name]
    assert 0.7 <= twin.truth.kinematic_viscosity / plan.truth.kinematic_viscosity <= 1.3
    assert 0.9 <= np.linalg.norm(twin.truth.gravity) / 9.81 <= 1.1
    assert twin.start.kinematic_viscosity < 0.5 * twin.truth.kinematic_viscosity


@pytest.mark.parametrize("name", NAMES)
def test_noise_is_gaussian_of_the_stated_size_and_new_in_each_frame(name, twins):
    clean, noisy = twins[name], make_twin(name, seed=4, noise=0.2)
    at = open_faces(clean)
    error = np.stack([(flatten(n) - flatten(c)).numpy() for n, c in zip(noisy.frames, clean.exact, strict=True)])
    sigma = 0.2 * clean.speed
    inside = error[:, at]
    # n values estimate a standard deviation to 1 / sqrt(2 n), a mean to 1 / sqrt(n); four of those
    n = inside.size
    assert inside.std() == pytest.approx(sigma, rel=4 / np.sqrt(2 * n))
    assert abs(inside.mean()) < 4 * sigma / np.sqrt(n)
    assert abs((inside[0] * inside[1]).mean()) < 4 * sigma**2 / np.sqrt(at.sum())
    assert not error[:, ~at].any()
    # the share beyond two standard deviations of a Gaussian
    assert (np.abs(inside) > 2 * sigma).mean() == pytest.approx(0.0455, abs=4 * np.sqrt(0.0455 / n))


@pytest.mark.parametrize("name", NAMES)
def test_hidden_cells_are_the_stated_share_in_blobs_and_their_faces_are_zero(name):
    twin = make_twin(name, seed=4, hidden=1 / 3)
    fluid = twin.cell_types == CellType.FLUID
    hidden = ~twin.observed[0]
    assert hidden[~fluid].sum() == 0
    assert hidden.sum() == round(fluid.sum() / 3)
    assert all(o is twin.observed[0] for o in twin.observed)
    # blobs: a neighbour across x of a hidden fluid cell is hidden far more often than one in three
    pairs = hidden[:-1] & fluid[1:]
    assert hidden[1:][pairs].mean() > 0.6
    # a hidden cell between hidden cells has no velocity left
    inner = hidden[:-1] & hidden[1:]
    for given, exact in zip(twin.frames, twin.exact, strict=True):
        assert not given.u[1:-1][inner].any()
        seen = twin.observed[0] & fluid
        assert np.array_equal(given.at_centers()[seen], exact.at_centers()[seen])


def test_honey_is_ten_times_as_viscous_as_the_grid():
    """Linear semi-Lagrangian steps diffuse by U h (1 - c) / 2 (c: Courant number of a step), so by U h / 2 at most."""
    for seed in range(4):
        twin = make_twin("honey", seed=seed, frames=6)
        assert twin.truth.kinematic_viscosity > 10 * 0.5 * twin.speed * twin.grid.spacing


@pytest.mark.parametrize("name", NAMES)
def test_the_flow_knows_its_parameters(name, twins):
    """Each parameter that a scene is about changes its frames by more than single precision does."""
    twin = twins[name]
    changed = {
        "kinematic_viscosity": 1.1 * twin.truth.kinematic_viscosity,
        "gravity": tuple(1.1 * g for g in twin.truth.gravity),
        "inflow_velocity": tuple(1.1 * v for v in twin.truth.inflow_velocity),
        "outflow_velocity": 1.1 * twin.truth.outflow_velocity,
        "wall_damping": 0.9 * twin.truth.wall_damping,
    }
    fluid = twin.cell_types == CellType.FLUID
    for label, value in changed.items():
        other = twin.continued(replace(twin.truth, **{label: value}), twin.exact[0], 3)[-1]
        difference = np.linalg.norm((other.at_centers() - twin.exact[3].at_centers())[fluid], axis=-1).mean()
        # ten times the 1e-5 that a fit's pressure solves leave
        assert difference > 1e-4 * twin.speed, label


def test_more_cells_are_the_same_flow_at_the_same_courant_number():
    coarse, fine = make_twin("honey", seed=1), make_twin("honey", seed=1, cells=(36, 18, 18))
    assert fine.truth == replace(coarse.truth, time_step=coarse.truth.time_step * 24 / 36)
    assert fine.grid.shape == (36, 18, 18) and fine.grid.spacing * 36 == pytest.approx(coarse.grid.spacing * 24)
    # the same early flow, a third finer: 20 %
    assert fine.speed == pytest.approx(coarse.speed, rel=0.2)


def test_a_share_of_none_hides_nothing_and_unknown_names_are_refused():
    twin = make_twin("pour", seed=0, frames=2)
    assert twin.observed is None
    assert not hidden_cells(twin.cell_types, 0.0, np.random.default_rng(0)).any()
    with pytest.raises(ValueError, match="honey, pour, river"):
        make_twin("sea", seed=0)
    with pytest.raises(ValueError, match="hidden"):
        make_twin("pour", seed=0, hidden=1.0)
