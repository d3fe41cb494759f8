"""Vessels that pours fill: floor, level, radii and volume from silhouettes of known solids of revolution."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import label

from fluidlift.shape.filled_vessel import (
    FilledVessel,
    behind_its_wall,
    distance_ahead,
    filled_volume,
    find_vessel,
    pool_depths,
    seen_higher,
    vessel_of,
)
from fluidlift.shape.kind import level_camera
from fluidlift.types import PinholeCamera, Similarity3, UpEvidence

AWAY = 2.0
"""m from the eye to the axis along the ground"""


def camera_at(pitch: float, roll: float = 0.0) -> PinholeCamera:
    return level_camera(PinholeCamera.from_fov(40.0, (240, 240)), UpEvidence(pitch, roll, "", 0.0))


def made(pitch: float, profile: str = "straight", level: float = 0.3, at: float = 0.1) -> FilledVessel:
    """A glass 0.5 m high and 0.25 m in radius, around the place that a camera at the origin looks at."""
    heights = np.linspace(0.0, level, 60)
    radii = {
        "straight": np.full(60, 0.25),
        "stepped": np.interp(heights, [0.09, 0.12], [0.18, 0.25]),
        "conical": 0.16 + 0.3 * heights,
    }[profile]
    z = -AWAY * np.tan(np.radians(pitch)) - 0.15
    return FilledVessel((at, AWAY), heights + z, radii, level + z)


def silhouette(camera: PinholeCamera, vessel: FilledVessel, jet: float = 0.04) -> np.ndarray:
    """What it holds, and a jet of 1 m that falls into it along its axis."""
    whole = np.ones(camera.size[::-1], bool)
    shown = np.isfinite(pool_depths(camera, whole, vessel)[0])
    falling = FilledVessel(vessel.axis, np.array([vessel.floor, vessel.level]), np.full(2, jet), vessel.level + 0.55)
    return shown | np.isfinite(pool_depths(camera, whole, falling)[0])


@pytest.mark.parametrize("profile", ["straight", "stepped", "conical"])
@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (12.0, 0.0), (25.0, 4.0), (-8.0, 0.0)])
def test_floor_level_and_radii_are_those_of_the_glass(profile, pitch, roll):
    camera, truth = camera_at(pitch, roll), made(pitch, profile)
    found = find_vessel(camera, silhouette(camera, truth), AWAY)
    assert found is not None
    pixel = AWAY / camera.focal[0] / np.cos(np.radians(pitch))
    assert found.axis == pytest.approx(truth.axis, abs=1.5 * pixel)
    # a row is a pixel, its error that of the circle's height; a sloped wall adds its lean
    assert found.floor == pytest.approx(truth.floor, abs=3.0 * pixel)
    assert found.level == pytest.approx(truth.level, abs=3.0 * pixel)
    z = np.linspace(truth.floor + 0.05, truth.level - 0.05, 9)
    shoulder = 0.25 if profile == "stepped" and pitch > 20.0 else 0.0  # from there it hides the narrower part
    assert (found.radius_at(z) < np.maximum(truth.radius_at(z), shoulder) + 3.0 * pixel).all()
    assert (found.radius_at(z) > truth.radius_at(z) - 3.0 * pixel).all()
    # 3 px of 47 in height and 1 of 28 in radius; a hidden shoulder adds up to what lies below it, 15 % of the glass
    assert found.volume == pytest.approx(truth.volume, rel=0.15 if shoulder else 0.08)


@pytest.mark.parametrize("lean", [-0.2, 0.0, 0.1])
def test_the_jet_falls_in_as_it_leans(lean):
    camera, truth = camera_at(12.0), made(12.0)
    mask = np.isfinite(pool_depths(camera, np.ones((240, 240), bool), truth)[0])
    for z in np.linspace(truth.level, truth.level + 0.55, 200):
        uv, _ = camera.project(np.array([[truth.axis[0] + lean * (truth.level - z), AWAY, z]]))
        column, row = np.floor(uv[0]).astype(int)
        mask[row, column - 3 : column + 4] = True
    found = find_vessel(camera, mask, AWAY)
    assert found is not None
    assert found.inflow[0] / -found.inflow[2] == pytest.approx(lean, abs=0.02) and abs(found.inflow[1]) < 1e-9
    assert np.linalg.norm(found.inflow) == pytest.approx(1.0)


def test_an_image_of_the_middle_tells_how_far_it_is():
    camera, truth = camera_at(15.0), made(15.0)
    mask = silhouette(camera, truth)
    near, far = pool_depths(camera, mask, truth)
    middle = np.where(np.isfinite(near), 0.5 * (near + far), 0.0)
    assert distance_ahead(camera, mask & (middle > 0), middle) == pytest.approx(AWAY, rel=0.02)


def test_neither_a_jet_nor_a_ball_nor_a_wide_thing_above_a_narrow_one_stands_in_a_vessel():
    camera = camera_at(10.0)
    v, u = np.mgrid[:240, :240]
    for mask in (
        np.abs(u - 120) < 8,
        np.hypot(u - 120, v - 120) < 50,
        (np.abs(u - 120) < 50) & (v < 90) | (np.abs(u - 120) < 8),
        (np.abs(u - 120) < 50) & (v > 60) & (v < 75) | (np.abs(u - 120) < 8),
    ):
        assert find_vessel(camera, mask, AWAY) is None


@pytest.mark.parametrize("pitch", [90.0, 80.0, -90.0])
def test_from_above_no_vessel_is_seen(pitch):
    camera = camera_at(pitch)
    v, u = np.mgrid[:240, :240]
    mask = (np.hypot(u - 120, v - 150) < 60) | (np.abs(u - 120) < 8) & (v < 100)
    away = distance_ahead(camera, mask, np.ones(mask.shape))
    assert np.isfinite(away) and find_vessel(camera, mask, away) is None
    assert find_vessel(camera_at(30.0), mask, AWAY) is not None, "or the picture tells nothing"


def test_of_a_cup_that_is_looked_into_only_the_surface_is_seen_and_it_is_taken_to_be_as_deep_as_it_is_wide():
    camera = camera_at(35.0)
    flat = made(35.0, level=0.01)
    found = find_vessel(camera, silhouette(camera, flat), AWAY)
    assert found is not None
    assert found.level - found.floor == pytest.approx(0.25, rel=0.1)


def test_as_it_fills_its_volume_grows_and_its_radii_are_seen_higher():
    camera = camera_at(12.0)
    first, last = made(12.0, "conical", level=0.2), made(12.0, "conical", level=0.35)
    early, late = silhouette(camera, first), silhouette(camera, last)
    found = find_vessel(camera, early, AWAY)
    assert found is not None
    whole = seen_higher(found, camera, early | late)
    assert whole.level == found.level and whole.heights[-1] == pytest.approx(last.level, abs=0.02)
    assert whole.radius_at(last.level) == pytest.approx(last.radius_at(last.level), abs=0.02)
    volumes = [filled_volume(whole, camera, mask) for mask in (early, late)]
    assert volumes == pytest.approx([first.volume, last.volume], rel=0.08)
    assert filled_volume(whole, camera, np.zeros_like(early)) is None


def test_the_wall_stands_around_what_it_holds_and_moves_with_it():
    glass = made(0.0, "stepped")
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    t = Similarity3(2.0, quarter, np.array([1.0, 2.0, 3.0]))
    moved = glass.transformed(t)
    turn = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)[:, None]
    z = np.linspace(glass.floor + 0.01, glass.level - 0.01, 20)
    r = glass.radius_at(z)

    def ring(radius):
        x, y = (a + radius * way for a, way in zip(glass.axis, (np.cos(turn), np.sin(turn)), strict=True))
        return np.stack([x, y, np.broadcast_to(z, x.shape)], -1)

    assert moved.inflow == pytest.approx((0.0, 0.0, -1.0))
    for vessel, thick, put in ((glass, 0.05, lambda p: p), (moved, 0.1, t.points)):
        assert (vessel.wall(put(ring(r - 0.01)), thick) > 0).all() and vessel.holds(put(ring(r - 0.01))).all()
        assert (vessel.wall(put(ring(r + 0.025)), thick) < 0).all() and not vessel.holds(put(ring(r + 0.025))).any()
        above = put(np.array([[glass.axis[0] + 0.27, glass.axis[1], glass.level + 0.4]]))
        assert (vessel.wall(above, thick) > 0).all()


@pytest.mark.parametrize("narrow", [0.05, 0.15])
def test_the_wall_has_no_gap_where_its_radius_jumps(narrow):
    """Cells that are open inside and outside of a wall of 2.4 cells do not touch, not even by a corner."""
    h, step = 0.02, 0.15
    glass = FilledVessel((0.0, 0.0), np.array([0.0, step - 0.001, step + 0.001, 0.4]), np.array([0.2, 0.2, 1, 1]), 0.4)
    glass.radii[2:] = 0.2 + narrow
    axes = (np.arange(-0.5, 0.5, h), np.arange(-0.5, 0.5, h), np.arange(0.0, glass.rim, h))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    open_cells = glass.wall(points, 2.4 * h) > 0
    parts = label(open_cells, np.ones((3, 3, 3)))[0]
    inside, outside = parts[len(axes[0]) // 2, len(axes[1]) // 2], parts[0, 0]
    assert inside.all() and outside.all() and not set(inside) & set(outside)


def test_a_ragged_surface_is_no_neck_of_what_is_filled_later():
    camera = camera_at(12.0)
    first, last = made(12.0, level=0.2), made(12.0, level=0.35)
    early, late = silhouette(camera, first), silhouette(camera, last)
    found = find_vessel(camera, early, AWAY)
    assert found is not None
    found.radii[found.heights > first.level - 0.06] *= 0.7
    z = np.linspace(first.floor + 0.02, last.level - 0.02, 40)
    np.testing.assert_allclose(seen_higher(found, camera, early | late).radius_at(z), 0.25, atol=0.02)


def test_a_frayed_surface_does_not_close_the_glass_above_it():
    camera, truth = camera_at(15.0), made(15.0)
    mask, rng = silhouette(camera, truth), np.random.default_rng(0)
    edge = mask.argmax(axis=0)
    for column in np.flatnonzero(mask.any(axis=0)):  # waves of up to 5 px take away from the upper edge
        mask[edge[column] : edge[column] + rng.integers(0, 6), column] = False
    found = find_vessel(camera, mask, AWAY)
    assert found is not None
    upper = np.linspace(found.level - 0.08, found.rim, 20)
    np.testing.assert_allclose(found.radius_at(upper), 0.25, atol=0.02)


@pytest.mark.parametrize("above", [0.04, 0.08])  # from a third of its radius on, the edge hides its widest row
def test_a_cup_that_is_looked_into_holds_what_its_near_wall_hides(above):
    camera, truth = camera_at(35.0), made(35.0)
    whole = np.ones((240, 240), bool)
    disc, opening = (_disc(camera, truth, z) for z in (truth.level, truth.level + above))
    hidden = disc & ~opening
    jet = FilledVessel(truth.axis, np.array([truth.floor, truth.level]), np.full(2, 0.03), truth.level + 0.25)
    falls = np.isfinite(pool_depths(camera, whole, jet)[0]) & ~np.isfinite(pool_depths(camera, whole, truth)[0])
    found = find_vessel(camera, (disc & ~hidden) | falls, AWAY)
    assert found is not None and found.looked_into
    pixel = AWAY / camera.focal[0] / np.cos(np.radians(35.0))
    assert found.level == pytest.approx(truth.level, abs=3.0 * pixel)
    assert found.rim - found.level == pytest.approx(above, abs=3.0 * pixel)
    walls = behind_its_wall(found, camera, disc & ~hidden)
    assert walls[hidden].mean() > 0.9 and not walls[disc & ~hidden].any()
    moved = found.transformed(Similarity3(2.0, np.eye(3), np.array([0.0, 0.0, 1.0])))
    assert moved.looked_into and moved.rim == pytest.approx(1.0 + 2.0 * found.rim)


def test_a_glass_seen_from_the_side_hides_nothing():
    camera, truth = camera_at(12.0), made(12.0)
    found = find_vessel(camera, silhouette(camera, truth), AWAY)
    assert found is not None and not found.looked_into
    assert not behind_its_wall(found, camera, np.zeros((240, 240), bool)).any()


def _disc(camera: PinholeCamera, vessel: FilledVessel, z: float) -> np.ndarray:
    """Where a level disc of the vessel's width is seen at some height."""
    turns = np.linspace(0.0, 2.0 * np.pi, 200)
    ring = [vessel.axis[0] + 0.25 * np.cos(turns), vessel.axis[1] + 0.25 * np.sin(turns), np.full(200, z)]
    corners = np.round(camera.project(np.stack(ring, axis=1))[0] - 0.5).astype(np.int32)
    return cv2.fillPoly(np.zeros(camera.size[::-1], np.uint8), [corners], 1) > 0


@pytest.mark.parametrize(("pitch", "level"), [(0.0, 0.03), (-8.0, 0.03), (12.0, 0.03), (12.0, 0.0), (25.0, 0.0)])
def test_a_glass_that_is_nearly_empty_is_told_by_what_it_holds_later(pitch, level):
    camera, full = camera_at(pitch), made(pitch, level=0.3)
    now = FilledVessel(full.axis, full.heights, full.radii, full.floor + level)
    mask, ever = silhouette(camera, now), silhouette(camera, now) | silhouette(camera, full)
    found = vessel_of(camera, mask, ever, AWAY)
    assert found is not None
    assert found.nearly_empty is (find_vessel(camera, mask, AWAY) is None)  # of some its own silhouette tells
    pixel = AWAY / camera.focal[0] / np.cos(np.radians(pitch))
    assert found.floor == pytest.approx(full.floor, abs=3.0 * pixel)
    assert found.level - found.floor == pytest.approx(level, abs=4.0 * pixel)  # two ends, as above
    assert found.heights[0] == found.floor and found.heights[-1] == pytest.approx(found.level)
    higher = seen_higher(found, camera, ever)
    assert (np.abs(higher.radius_at(np.linspace(full.floor + 0.05, full.level - 0.05, 9)) - 0.25) < 3.0 * pixel).all()
    assert higher.heights[-1] == pytest.approx(full.level, abs=3.0 * pixel) and higher.level == found.level
    assert (np.diff(higher.heights) > 0).all()
    volume = filled_volume(higher, camera, ever)
    assert volume == pytest.approx(full.volume, rel=0.1)
    nearly = filled_volume(higher, camera, mask)
    assert nearly is not None and nearly == pytest.approx(now.volume, abs=4.0 * pixel * np.pi * 0.25**2)


def test_a_heap_that_does_not_become_more_is_in_no_vessel():
    camera, truth = camera_at(12.0), made(12.0)
    heap = silhouette(camera, truth)
    sways = heap | np.roll(heap, 3, axis=1)
    low = heap.copy()
    low[: np.argmax(heap.sum(axis=1) > 60) + 12, :] = False  # its top is hidden now, and the jet with it
    assert find_vessel(camera, low, AWAY) is None and find_vessel(camera, sways, AWAY) is not None
    assert vessel_of(camera, low, sways, AWAY) is None


def test_a_glass_draws_in_below_its_level_no_more_than_the_tilt_may_err():
    seen, known = camera_at(14.0), camera_at(4.0)
    full = made(14.0, level=0.3)
    now = FilledVessel(full.axis, full.heights, full.radii, full.floor)
    mask, ever = silhouette(seen, now), silhouette(seen, now) | silhouette(seen, full)
    found = vessel_of(known, mask, ever, AWAY)
    assert found is not None and found.nearly_empty
    higher = seen_higher(found, known, ever)
    assert (higher.radii[higher.heights > 0.5 * (higher.floor + higher.heights[-1])] > 0.23).all()
