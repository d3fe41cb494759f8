"""What the outlines of smoke say of its lift replaces what a few frames of velocities guess."""

from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.fit import buoyancy, rising
from fluidlift.fit.buoyancy import Buoyancy
from fluidlift.types import Estimate, FaceVelocity, FluidParameters, Grid

GRID = Grid((4, 4, 4), 0.1)


@pytest.fixture
def masks():
    """Smoke that rises by a pixel per frame."""
    found = np.zeros((20, 40, 10), bool)
    for k in range(20):
        found[k, 24 - k : 36, 3:7] = True
    return found


GEOMETRY = SimpleNamespace(
    setting=SimpleNamespace(terrain=None, cell_types=np.zeros((1, 1, 1), np.uint8)), camera=None, rest_frame=2
)
READ = SimpleNamespace(clip=SimpleNamespace(interval=0.04))


def estimates():
    return {f"gravity_{a}": Estimate(v, np.inf, False, v, "m/s^2") for a, v in zip("xyz", (0.06, 0.0, -0.08))}


def found(monkeypatch, masks, lift):
    seen = []

    def told(smoke, guess, step):
        seen.append((smoke, guess))
        return lift

    monkeypatch.setattr(buoyancy, "buoyancy_from_rise", told)
    parameters, quiet = FluidParameters(gravity=(0.06, 0.0, -0.08)), lambda done, total: None
    return rising.with_buoyancy(READ, masks, GEOMETRY, parameters, estimates(), FaceVelocity.zeros(GRID), quiet), seen


def test_the_lift_changes_and_its_direction_stays(monkeypatch, masks):
    (parameters, known, figures), seen = found(monkeypatch, masks, Buoyancy(2.0, 0.5, 18, 4))
    assert parameters.gravity == pytest.approx((1.2, 0.0, -1.6))
    assert known["gravity_z"].value == pytest.approx(-1.6) and known["gravity_z"].sigma == pytest.approx(0.4)
    assert known["gravity_z"].fitted and not known["gravity_z"].identifiable  # a quarter is more than 5 %
    assert known["gravity_y"] == estimates()["gravity_y"]
    assert figures["buoyancy"] == 2.0
    smoke, guess = seen[0]
    assert guess == pytest.approx(0.1)
    assert smoke.frames == 18 and smoke.outline(0).sum() == 4 * (36 - 22)  # from the first instant of the body on


def test_outlines_that_say_nothing_leave_the_guess(monkeypatch, masks):
    (parameters, known, figures), _ = found(monkeypatch, masks, None)
    assert parameters.gravity == (0.06, 0.0, -0.08) and known == estimates() and figures == {}


def test_smoke_must_rise_in_a_few_frames_at_least(masks):
    assert rising.outline_rises(masks, 2)
    assert not rising.outline_rises(masks[:6], 2)
