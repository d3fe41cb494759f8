"""Where the fit starts: what is measured at the ends of the flow, and what is taken for known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fluidlift.config import build_config
from fluidlift.errors import InputRejected
from fluidlift.pipeline.stages import fit as stage
from fluidlift.shape.filled_vessel import FilledVessel, pool_depths
from fluidlift.shape.kind import level_camera
from fluidlift.types import (
    GRAVITY,
    CellType,
    Coat,
    Estimate,
    FaceVelocity,
    FluidParameters,
    Grid,
    Label,
    PinholeCamera,
    UpEvidence,
    VideoClip,
    kind_of,
)
from fluidlift.types.fluid_masks import FluidMasks

GRID = Grid((12, 6, 5), 0.05, (0.0, 0.0, 0.0))
X = np.array([1.0, 0.0, 0.0])
INTERVAL = 0.04


def channel():
    """Inlet at the low end of x, outlet at the high one, the topmost layer empty."""
    cells = np.full(GRID.shape, CellType.FLUID, np.uint8)
    cells[:, :, -1] = CellType.EMPTY
    cells[0, :, :-1], cells[-1, :, :-1] = CellType.INFLOW, CellType.OUTFLOW
    return cells


def flow(u, v=0.0, w=0.0):
    """Speed along x given per face, the others even."""
    nx, ny, nz = GRID.shape
    shapes = ((nx + 1, ny, nz), (nx, ny + 1, nz), (nx, ny, nz + 1))
    u = np.broadcast_to(np.reshape(u, (-1, 1, 1)), shapes[0]).astype(np.float32)
    return FaceVelocity(u, np.full(shapes[1], v, np.float32), np.full(shapes[2], w, np.float32))


def body(kind, cells=None):
    """What counts of a geometry with these cells."""
    terrain = SimpleNamespace(grid=GRID, mainstream=X)
    cells = channel() if cells is None else cells
    setting = SimpleNamespace(cell_types=cells, terrain=terrain, pool_level=None, coat=None)
    return SimpleNamespace(kind=kind, setting=setting)


@pytest.fixture
def guess():
    """`first_guess` of a body with these cells."""

    def find(targets, *, kind="stream", cells=None, filling=None, **more):
        return stage.first_guess(body(kind, cells), targets, INTERVAL, filling, **more)

    return find


def test_the_fit_starts_with_the_speed_at_the_inlet_and_at_the_outlet(guess):
    ramp = np.linspace(1.0, 0.4, GRID.shape[0] + 1)
    found = guess([flow(ramp, 0.1, -0.2)] * 2)
    first = 0.5 * (ramp[0] + ramp[1])
    assert found.inflow_velocity == pytest.approx((first, 0.1, -0.2), rel=1e-6)
    assert found.inflow_fluctuation == pytest.approx(0.0, abs=1e-7)
    # the two layers of fluid before the outlet
    assert found.outflow_velocity == pytest.approx(ramp[9:12].mean(), rel=1e-5)


def test_the_fluctuation_is_that_of_the_inlet_over_the_frames(guess):
    found = guess([flow(0.9), flow(1.1)])
    assert found.inflow_velocity[0] == pytest.approx(1.0)
    # 0.1 along x and nothing along the others
    assert found.inflow_fluctuation == pytest.approx(0.1, rel=1e-4)


def test_what_falls_freely_enters_as_steadily_as_jets_do(guess):
    """Where a fall was seen to begin differs from frame to frame, and with it the speed that free fall gives it."""
    targets = [flow(1.0), flow(2.0)]
    assert guess(targets, kind="pour").inflow_fluctuation == pytest.approx(0.5)
    assert guess(targets, kind="pour", falls=True).inflow_fluctuation == pytest.approx(stage.SCATTER * 1.5)
    assert guess([flow(1.0)] * 2, kind="pour", falls=True).inflow_fluctuation == pytest.approx(0.0, abs=1e-6)
    # of the jet as it was filmed, however slowly its vessel fills
    slow = guess(targets, kind="pour", falls=True, filling=0.1 * GRID.spacing**2)
    assert slow.inflow_fluctuation == pytest.approx(stage.SCATTER * 1.5)


def test_a_fluctuation_does_not_make_up_for_a_discharge_that_is_less_than_what_was_filmed():
    names = [stage.usually_fitted(falls=falls, fills=True) for falls in (False, True)]
    assert not any({"inflow_velocity", "inflow_fluctuation"} & set(n) for n in names)
    assert all("outflow_velocity" in n for n in names)
    assert {"inflow_velocity", "inflow_fluctuation"} <= set(stage.usually_fitted(falls=True, fills=False))
    assert "kinematic_viscosity" in stage.usually_fitted(falls=False, fills=False)


def test_a_steady_profile_is_no_fluctuation():
    """Of the fit's pattern, which has both, the simulator's inlet has the profile already."""
    cells = channel()
    cells[1, :, :-1] = CellType.INFLOW
    ramp = np.linspace(1.0, 0.4, GRID.shape[0] + 1)  # two layers of the inlet, a step of it apart
    uneven = stage.inflow_unevenness(body("stream", cells), [flow(ramp - 0.02), flow(ramp + 0.02)])
    assert uneven == pytest.approx(0.5 * (ramp[0] - ramp[1]), rel=1e-5)
    initial = FluidParameters(inflow_fluctuation=0.02)
    start = stage.with_profile(initial, uneven)
    assert start.inflow_fluctuation == pytest.approx(np.hypot(uneven, 0.02))
    e = Estimate(1.5 * start.inflow_fluctuation, 0.1 * start.inflow_fluctuation, True, start.inflow_fluctuation)
    found, estimates = stage.without_profile(
        replace(start, inflow_fluctuation=e.value), {"inflow_fluctuation": e}, initial, uneven
    )
    assert found.inflow_fluctuation == pytest.approx(1.5 * 0.02)
    own = estimates["inflow_fluctuation"]
    assert (own.value, own.sigma, own.prior) == pytest.approx((0.03, 0.002, 0.02))
    # one that was not fitted comes back as it went in
    assert stage.without_profile(start, {}, initial, uneven)[0].inflow_fluctuation == pytest.approx(0.02)
    assert stage.without_profile(initial, {}, initial, 0.0)[0] == initial


def test_water_that_flows_backwards_leaves_no_outlet_that_sucks(guess):
    assert guess([flow(-0.5)]).outflow_velocity == 0.0


def test_without_inlet_and_outlet_the_whole_body_says_how_fast_it_is(guess):
    cells = channel()
    cells[0], cells[-1] = cells[1], cells[1]
    found = guess([flow(0.3)], cells=cells)
    assert found.inflow_velocity == pytest.approx((0.3, 0.0, 0.0), rel=1e-5)  # float32 faces, averaged
    assert (found.inflow_fluctuation, found.outflow_velocity) == (0.0, pytest.approx(0.3, rel=1e-5))


def test_a_step_crosses_two_cells_at_most_and_never_outlasts_a_frame(guess):
    # 5 m/s through cells of 0.05 m: 0.01 s each
    assert guess([flow(5.0)]).time_step == pytest.approx(0.02)
    assert guess([flow(0.01)]).time_step == INTERVAL
    assert guess([flow(1000.0)]).time_step == pytest.approx(INTERVAL / 20)


def test_what_fills_the_vessel_is_what_the_inlet_brings(guess):
    mouth = 6 * 4 * GRID.spacing**2
    found = guess([flow(2.0)], kind="pour", filling=0.5 * mouth)
    assert found.inflow_velocity == pytest.approx((0.5, 0.0, 0.0))
    # a vessel that fills faster than the jet moves was measured wrongly: the jet's speed is the limit
    assert guess([flow(2.0)], kind="pour", filling=9.0 * mouth).inflow_velocity == pytest.approx((2.0, 0.0, 0.0))


SIDE = 200
"""px of a picture of a glass"""


def glass(rises):
    """A glass 0.5 m wide, 2 m away, that fills by some m within ten frames, and what counts of its geometry."""
    camera, away, times = (
        level_camera(PinholeCamera.from_fov(40.0, (SIDE, SIDE)), UpEvidence(0.0, 0.0, "", 0.0)),
        2.0,
        10,
    )
    whole, labels = np.ones((SIDE, SIDE), bool), np.full((times, SIDE, SIDE), Label.BACKGROUND, np.uint8)
    jet = FilledVessel((0.0, away), np.array([-0.4, 0.7]), np.full(2, 0.05), 0.6)
    for t in range(times):
        level = -0.1 + rises * t / (times - 1)
        held = FilledVessel((0.0, away), np.array([-0.4, level]), np.full(2, 0.25), level)
        shown = [np.isfinite(pool_depths(camera, whole, vessel)[0]) for vessel in (jet, held)]
        labels[t][shown[0] | shown[1]] = Label.FLUID
    clip = VideoClip(np.zeros((times, SIDE, SIDE, 3), np.uint8), INTERVAL * np.arange(times), "made")
    flat = np.full((SIDE, SIDE), away, np.float32)
    geometry = SimpleNamespace(
        kind="pour", setting=SimpleNamespace(pool_level=-0.1, rim=None), camera=camera, mask=labels[0] == Label.FLUID,
        depth=flat, half_thickness=np.zeros_like(flat), rest_frame=0,
    )  # fmt: skip
    return SimpleNamespace(clip=clip), FluidMasks(labels), geometry


def test_a_vessel_gains_what_its_level_rises_by():
    seconds, area = 9 * INTERVAL, np.pi * 0.25**2
    # a pixel of 7 mm, by which radius and rise are known, is 6 % of the area and 4 % of the rise
    assert stage.filling_rate(*glass(0.2)) == pytest.approx(0.2 * area / seconds, rel=0.12)
    row = 2.0 / PinholeCamera.from_fov(40.0, (SIDE, SIDE)).focal[0]
    assert stage.filling_rate(*glass(0.0)) == pytest.approx(row * area / seconds, rel=0.1), "more would be seen"


@pytest.mark.parametrize("kind", ["stream", "fall", "pour", "plume"])
def test_what_the_velocities_cannot_say_is_what_such_a_fluid_usually_has(guess, kind):
    found = guess([flow(0.3)], kind=kind)
    assert found.kinematic_viscosity == kind_of(kind).kinematic_viscosity
    assert found.wall_damping == kind_of(kind).wall_damping
    assert found.gravity == (0.0, 0.0, -9.81)


@pytest.mark.parametrize(("kind", "width"), [("stream", 0.02), ("fall", 0.02), ("pour", 0.02)])
def test_gravity_is_nearly_known_for_what_has_weight(kind, width):
    assert stage.prior_widths(kind_of(kind))["gravity"] == width


def test_the_buoyancy_of_smoke_is_free():
    assert stage.prior_widths(kind_of("plume")) == {"time_step": 0.01}


def test_the_gravity_of_smoke_cannot_be_known_since_it_stands_for_buoyancy():
    segmentation = SimpleNamespace(labels=SimpleNamespace(labels=np.zeros((2, 3, 4), np.uint8)))
    config = build_config(overrides=["fit.hold=gravity=3"]).fit
    with pytest.raises(InputRejected, match="buoyancy"):
        stage.fit(None, segmentation, body("plume"), None, config, work=None)


def test_water_slips_over_its_bed_and_a_viscous_film_sticks_to_it():
    def stick(*viscous):
        return stage.sticking(kind_of("stream"), [{"viscous": v} for v in viscous])

    water = kind_of("stream").wall_damping
    assert stick() == water
    assert stick(0.0, 0.0, 1.0) == water  # one frame of three is an outlier
    assert stick(1.0, 1.0, 0.9) == 1.0
    assert water < stick(0.5) < 0.5


COAT = Coat(0.12, 0.2, 0.03)
"""a film of 3 cm around something 0.2 m in radius, whose top is 0.12 m above the eye"""


def test_a_film_runs_down_as_it_is_seen_to_or_as_fast_as_it_has_to():
    # Nusselt's film: g d^2 / (3 nu) in the mean
    assert GRAVITY * COAT.thickness**2 / (3 * stage.film_viscosity(COAT, 1.0, 0.05)) == pytest.approx(0.05)
    nu = stage.film_viscosity(COAT, 2e-4, None)
    carried = GRAVITY * COAT.thickness**3 / (3 * nu) * 2 * np.pi * COAT.radius
    assert carried == pytest.approx(2e-4)
    assert np.isfinite(stage.film_viscosity(COAT, 0.0, None))


def test_the_film_on_what_a_pour_covers_is_told_from_its_jet_by_its_height():
    camera = level_camera(PinholeCamera.from_fov(40.0, (60, 60)), UpEvidence(0.0, 0.0, "", 0.0))
    mask = np.zeros((60, 60), bool)
    mask[5:50, 25:35] = True  # 1 m high in 2 m, the upper half of it a jet
    flow = np.zeros((60, 60, 2))
    flow[..., 1] = np.where(np.arange(60) < 25, 6.0, 1.5)[:, None]
    trust = np.where(mask, 0.9, 0.0)
    seen = SimpleNamespace(
        camera=camera, depth=np.full((60, 60), 2.0), mask=mask, mean_flow=flow, mean_confidence=trust
    )
    speed = stage.coat_speed(seen, COAT, INTERVAL)
    assert speed == pytest.approx(1.5 * 2.0 / camera.focal[0] / INTERVAL, rel=1e-6)
    seen.mean_confidence = np.where(np.arange(60) > 40, 0.9, 0.0)[:, None] * mask
    assert stage.coat_speed(seen, COAT, INTERVAL) is None, "most of it is not seen"


def test_a_pour_that_covers_something_is_as_viscous_as_its_film_needs_and_never_less_than_usual(monkeypatch):
    cells, scene = channel(), body("pour")
    scene.setting.coat = COAT
    for seen, expected in ((0.01, stage.film_viscosity(COAT, 0.0, 0.01)), (1e9, kind_of("pour").kinematic_viscosity)):
        monkeypatch.setattr(stage, "coat_speed", lambda *_, at=seen: at)
        found = stage.first_guess(scene, [flow(1.0)], INTERVAL, None)
        assert found.kinematic_viscosity == pytest.approx(expected)
    monkeypatch.setattr(stage, "coat_speed", lambda *_: None)
    section = GRID.spacing**2 * (cells[0] == CellType.INFLOW).sum()
    found = stage.first_guess(scene, [flow(0.1)], INTERVAL, None)
    assert found.kinematic_viscosity == pytest.approx(stage.film_viscosity(COAT, 0.1 * section, None), rel=1e-5)
