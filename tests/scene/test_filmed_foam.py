"""Births of foam from its map in the picture: made streams whose births are known."""

from dataclasses import replace

import numpy as np
import pytest

from fluidlift.look.whitewater_splats import WHITE, FilmedFoam
from fluidlift.scene.filmed_foam import births_in_columns, seen_area, share_in_columns
from fluidlift.types import Grid, PinholeCamera

GRID = Grid((48, 24, 8), 0.1, (-2.4, -1.2, 0.0))
LEVEL, LIFE, COVERS = 0.4, 1.5, 0.1


def steady(births, velocity, steps=4000, dt=0.01):
    """Number per column in the end: upwind transport, and decay with a mean life."""
    n = np.zeros(births.shape)
    for _ in range(steps):
        flux = np.zeros_like(n)
        for axis in range(2):
            v = velocity[axis]
            up = np.diff(n, axis=axis, prepend=0.0) if v > 0 else np.diff(n, axis=axis, append=0.0)
            flux += v * up / GRID.spacing
        n += dt * (births - n / LIFE - flux)
    return n


def seen_from(camera, number):
    """The film of a level surface with so much foam in its columns."""
    width, height = camera.size
    v, u = np.indices((height, width)) + 0.5
    rays = np.stack([(u - camera.center[0]) / camera.focal[0], (v - camera.center[1]) / camera.focal[1],
                     np.ones_like(u)], axis=-1) @ camera.camera_from_world.rotation  # fmt: skip
    down = (LEVEL - camera.position[2]) / np.where(np.abs(rays[..., 2]) > 1e-9, rays[..., 2], 1e-9)
    places = camera.position + down[..., None] * rays
    cell = np.floor((places[..., :2] - GRID.low[:2]) / GRID.spacing).astype(int)
    there = (down > 0) & ((cell >= 0) & (cell < GRID.shape[:2])).all(axis=-1)
    share = np.zeros((height, width))
    # balls, which are as large from any side, on a level that is seen at a slant
    slant = np.abs(rays[..., 2] / np.linalg.norm(rays, axis=-1))
    share[there] = 1.0 - np.exp(-COVERS * number[cell[there][:, 0], cell[there][:, 1]] / slant[there])
    return FilmedFoam(float(share[there].mean()), WHITE, share, there.astype(float))


CAMERAS = {
    "from above": PinholeCamera.looking(np.array([0.0, -0.01, 6.0]), np.zeros(3), 60, (320, 240)),
    "from the bank": PinholeCamera.looking(np.array([0.5, -4.0, 3.0]), np.array([0.0, 0.0, LEVEL]), 60, (320, 240)),
}
FLOWS = {"along": (0.4, 0.0), "back": (-0.6, 0.0), "askew": (0.3, 0.15), "still": (0.0, 0.0)}


@pytest.mark.parametrize("view", CAMERAS)
@pytest.mark.parametrize("flow", FLOWS)
def test_births_are_found_where_the_foam_begins_and_not_where_it_went(view, flow):
    births, velocity = np.zeros(GRID.shape[:2]), np.broadcast_to(FLOWS[flow], (*GRID.shape[:2], 2))
    births[20:26, 9:14] = 6.0 if view == "from above" else 3.0  # as white in the picture, where it is seen at a slant
    film = seen_from(CAMERAS[view], steady(births, FLOWS[flow]))
    height, lasting = np.full(births.shape, LEVEL), np.full(births.shape, LIFE)
    found = births_in_columns(film, CAMERAS[view], GRID, height, velocity, lasting, COVERS).births
    # smoothing over a cell loses a tenth of the amount at most, and spreads it by two cells
    assert found.sum() == pytest.approx(births.sum(), rel=0.15)
    assert found[18:28, 7:16].sum() > 0.8 * found.sum()


def test_foam_that_drifts_past_has_no_births_on_its_way():
    births, velocity = np.zeros(GRID.shape[:2]), np.broadcast_to((0.4, 0.0), (*GRID.shape[:2], 2))
    births[4:8, 9:14] = 8.0
    number = steady(births, (0.4, 0.0))
    camera = CAMERAS["from above"]
    film = seen_from(camera, number)
    height, lasting = np.full(births.shape, LEVEL), np.full(births.shape, LIFE)
    found = births_in_columns(film, camera, GRID, height, velocity, lasting, COVERS).births
    assert number[12:20].sum() > 0.5 * number.sum() * 0.5  # there is foam
    assert found[12:].sum() < 0.1 * found.sum()


def test_what_the_camera_does_not_see_is_unknown_and_has_none():
    # from so far that all of it is seen from straight above
    far = 2.5e4
    camera = PinholeCamera.looking(np.array([-1.2, -0.01, far]), np.array([-1.2, 0.0, 0.0]), 40, (160, 120))
    near = (far - LEVEL) / (2.5 - LEVEL)
    camera = replace(camera, focal=(near * camera.focal[0], near * camera.focal[1]))
    film = seen_from(camera, np.full(GRID.shape[:2], 4.0))
    height = np.full(GRID.shape[:2], LEVEL)
    height[:12] = np.nan
    share = share_in_columns(film, camera, GRID, height)
    assert np.isnan(share[:12]).all() and np.isnan(share[30:]).all() and np.isfinite(share[13, 12])
    seen = np.isfinite(share)
    np.testing.assert_allclose(share[seen], 1 - np.exp(-0.4), atol=1e-6)
    still, lasting = np.zeros((*height.shape, 2)), np.full(height.shape, LIFE)
    found = births_in_columns(film, camera, GRID, height, still, lasting, COVERS).births
    np.testing.assert_allclose(found[seen], 4.0 / LIFE, rtol=1e-6)
    assert (found[np.isnan(share)] == 0).all()
    nowhere = np.full(height.shape, np.nan)
    assert (births_in_columns(film, camera, GRID, nowhere, still, lasting, COVERS).births == 0).all()


def test_a_surface_is_seen_at_its_slant_and_a_curtain_is_all_seen():
    level = np.full(GRID.shape[:2], LEVEL)
    np.testing.assert_allclose(seen_area(CAMERAS["from above"], GRID, level)[20:28, 10:14], 1.0, atol=0.01)
    bank = seen_area(CAMERAS["from the bank"], GRID, level)
    place = np.array([*((np.array([24, 12]) + 0.5) * GRID.spacing + GRID.low[:2]), LEVEL])
    sight = CAMERAS["from the bank"].position - place
    assert bank[24, 12] == pytest.approx(sight[2] / np.linalg.norm(sight), rel=1e-6)
    # a fall of 60 degrees towards the camera: seen along its normal it has 1 / cos 60 of the plan's area
    y = (np.arange(GRID.shape[1]) + 0.5) * GRID.spacing
    steep = np.broadcast_to(np.tan(np.radians(60)) * y, GRID.shape[:2])
    far = PinholeCamera.looking(
        np.array([0.0, -1.2 - 40 * np.sin(np.radians(60)), 2.0 + 40 * np.cos(np.radians(60))]),
        np.array([0.0, -1.2, 2.0]), 10, (320, 240),
    )  # fmt: skip
    assert seen_area(far, GRID, steep)[24, 12] == pytest.approx(2.0, rel=0.05)
    assert (seen_area(CAMERAS["from above"], GRID, np.full(GRID.shape[:2], np.nan)) > 0).all()


def test_where_the_films_foam_breaks_up_the_balance_is_below_zero():
    number, flow = np.zeros(GRID.shape[:2]), np.broadcast_to((0.4, 0.0), (*GRID.shape[:2], 2))
    number[10:20, 9:14] = 4.0
    film = seen_from(CAMERAS["from above"], number)
    height, lasting = np.full(number.shape, LEVEL), np.full(number.shape, LIFE)
    found = births_in_columns(film, CAMERAS["from above"], GRID, height, flow, lasting, COVERS)
    assert found.balance[9:11, 10:13].min() > 0 > found.balance[19:21, 10:13].max()
    assert (found.births >= 0).all() and found.number[12:18, 10:13] == pytest.approx(4.0, rel=0.15)
