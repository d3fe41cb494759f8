"""A column of liquid before it collapses: height, basin, metres, from outlines that are known exactly."""

import cv2
import numpy as np
import pytest

from fluidlift.errors import InputRejected
from fluidlift.shape import prism, standing
from fluidlift.shape.kind import estimate_up, level_camera
from fluidlift.types import CellType, PinholeCamera, Similarity3, UpEvidence

SIZE = (256, 192)
WORLD = Similarity3(2.0, np.eye(3), np.array([0.3, -0.4, 2.1]))
"""puts the camera 2 m over ground at z = 0.1"""
LOW, HIGH = np.array([-0.6, 1.3]), np.array([0.7, 1.9])
"""the basin; the camera is 1 above the ground"""
PILLAR = (np.array([0.25, 1.6]), 0.06, 0.45)


def camera(pitch=32.0):
    return level_camera(PinholeCamera.from_fov(60.0, SIZE), UpEvidence(pitch, 0.0, "", 1.0))


def box(low, high, height, base=0.0, view=None):
    """The outline of a box over the ground: the hull of its eight corners."""
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (base, height)])
    uv, _ = (view or camera()).project(corners + [0.0, 0.0, prism.GROUND])
    mask = np.zeros(SIZE[::-1], np.uint8)
    cv2.fillConvexPoly(mask, np.round(cv2.convexHull(uv.astype(np.float32)) * 16).astype(np.int32) - 8, 1, shift=4)
    return mask.astype(bool)


def collapse(height=0.4, across=0.45, frames=12, *, pillar=True):
    """Outlines of a column that becomes a level layer of the same volume, and pixels that stay dry."""
    (x, y), radius, top = PILLAR
    masks = []
    for t in range(frames):
        end = min(LOW[0] + across + 0.15 * t, HIGH[0])
        level = height * across / (end - LOW[0])
        water = box(LOW, (end, HIGH[1]), level)
        if pillar and end > x:  # its foot is under water
            water &= ~box((x - radius, y - radius), (x + radius, y + radius), top, level)
        masks.append(water)
    return np.array(masks)


def found_in(masks, view=None):
    often = masks[-len(masks) // 3 :].mean(axis=0)
    return standing.find_standing(view or camera(), masks[0], often)


@pytest.mark.parametrize("height", [0.25, 0.4, 0.55])
def test_a_column_is_as_tall_as_its_outline_allows(height):
    found = found_in(collapse(height, pillar=False))
    # three pixels, each 0.007 of the way to it: outlines are taken a pixel wide on either side
    assert found.height == pytest.approx(height, abs=0.021)
    at = found.raster.centers()[found.footprint]
    np.testing.assert_allclose(at.min(axis=0), LOW, atol=0.05)
    np.testing.assert_allclose(at.max(axis=0), [LOW[0] + 0.45, HIGH[1]], atol=0.07)


def test_its_volume_lies_level_in_the_basin():
    found = found_in(collapse())
    step = found.raster.step
    assert found.basin.sum() * step**2 == pytest.approx(np.prod(HIGH - LOW), rel=0.15)
    assert found.basin.sum() * found.level == pytest.approx(found.footprint.sum() * found.height, rel=1e-6)
    assert found.direction @ [1.0, 0.0, 0.0] > 0.97


def test_what_hides_level_water_stands_in_it():
    found = found_in(collapse())
    assert len(found.pillars) == 1
    (centre, radius, _), pillar = PILLAR, found.pillars[0]
    np.testing.assert_allclose(pillar.center, centre, atol=0.06)
    assert pillar.radius == pytest.approx(radius, rel=0.4)  # it is square
    square = box(centre - radius, centre + radius, PILLAR[2])
    assert (found.solid & square).sum() > 0.7 * square.sum()
    assert (found.solid & ~square).sum() < 0.3 * square.sum()
    assert found_in(collapse(pillar=False)).pillars == ()


def test_a_front_that_climbs_the_wall_at_the_end_does_not_lengthen_the_basin():
    masks = collapse(pillar=False)
    masks[-4:] |= box((HIGH[0] - 0.15, LOW[1]), HIGH, 0.3)
    found = found_in(masks)
    # a column of the raster is 0.01 wide; behind water that high ground up to 0.26 further on seems wet
    assert found.raster.centers()[found.basin][:, 0].max() == pytest.approx(HIGH[0], abs=0.07)


def test_a_pillar_that_the_front_splashed_over_is_found():
    (centre, radius, top), masks = PILLAR, collapse()
    masks[3:7] |= box(centre - radius, centre + radius, top)
    assert len(found_in(masks).pillars) == 1


def test_the_front_of_the_prism_is_where_the_column_is():
    found = found_in(collapse(pillar=False))
    view, front = camera(), None
    front = standing.standing_front(view, found)
    assert (front.depth[collapse()[0]] > 0).mean() > 0.97
    points = view.unproject(view.pixel_grid(), front.depth)[collapse()[0]]
    inside = (points[:, :2] > LOW - 0.06).all(1) & (points[:, :2] < [LOW[0] + 0.45 + 0.06, HIGH[1] + 0.06]).all(1)
    assert inside.mean() > 0.97
    assert points[:, 2].max() < prism.GROUND + 1.08 * 0.4


def test_metres_come_from_the_user_the_camera_or_the_front():
    masks = collapse()
    found = found_in(masks)

    def scale(size=None, height=None, speed=lambda: pytest.fail("nobody needs it")):
        return standing.standing_scale(found, size=size, height=height, speed=speed)

    assert scale(3.0, 2.0).value == pytest.approx(3.0 / max(0.45, 0.6, found.height), rel=0.1)
    assert scale(None, 2.0).value == 2.0
    seen = scale(speed=lambda: standing.front_speed(camera(), found, iter(masks[1:])) / 0.04)
    # 0.15 per frame of 0.04 s in units in which the column is 0.4 high: s v = 1.55 sqrt(g s h)
    assert seen.source == "front"
    assert seen.value == pytest.approx(9.81 * 0.4 * (1.55 * 0.04 / 0.15) ** 2, rel=0.35)
    still = scale(speed=lambda: standing.front_speed(camera(), found, iter(masks[:1])))
    assert still.source == "assumed" and "--size" in still.warning


def test_the_setting_holds_the_volume_in_a_closed_box_with_the_pillar():
    found = found_in(collapse())
    setting = standing.standing_setting(found, WORLD, [1.0, 0.0, 0.0], longest=48, limit=200_000)
    grid = setting.terrain.grid
    wet = setting.cell_types == CellType.FLUID
    volume = 2.0**3 * 0.45 * 0.6 * 0.4
    assert wet.sum() * grid.spacing**3 == pytest.approx(volume, rel=0.2)  # cells are a tenth of its height
    assert set(np.unique(setting.cell_types)) == {CellType.EMPTY, CellType.FLUID, CellType.SOLID}
    assert grid.low[2] + 3 * grid.spacing == pytest.approx(0.1)
    x, y, _ = WORLD.points(np.array([[*PILLAR[0], 0.0]]))[0]
    column = setting.cell_types[
        grid.cell_of(np.array([[x, y, 0.2]]))[0][0], grid.cell_of(np.array([[x, y, 0.2]]))[0][1]
    ]
    assert (column == CellType.SOLID).sum() * grid.spacing > 0.7
    touching = wet.any(axis=2)
    assert touching[0].any() and touching[:, 0].any() and touching[:, -1].any()  # it stood at three walls
    assert not touching[-1].any()


def test_a_body_is_held_until_its_outline_changes():
    assert standing.held_until(lambda t: 0.0 if t < 5 else 0.3, 12) == 4
    assert standing.held_until(lambda t: 0.1 * t, 12) == 0
    assert standing.held_until(lambda t: 0.0, 12) == 0  # it never moves


def test_a_camera_that_sees_no_ground_is_refused():
    with pytest.raises(InputRejected, match="horizon"):
        found_in(collapse(), camera(pitch=-60.0))


@pytest.mark.parametrize("pitch", [18.0, 32.0, 44.0])
def test_the_upright_edges_of_a_body_point_to_what_lies_below_the_camera(pitch):
    away = 1.0 / np.tan(np.radians(pitch))
    body = box(away * np.array([-0.4, 0.85]), away * np.array([0.35, 1.2]), min(0.4 * away, 0.8), view=camera(pitch))
    mean, error = prism.upright_tilt(body, camera, (25.0, 12.0))
    assert abs(mean - pitch) < 2.0 * error  # its own standard error
    # an edge 60 px long with ends 2 px off leans 1.9 degrees more; of two, 0.35 beside the axis: 4 degrees of tilt
    assert error < 5.0
    known = estimate_up("dam", body, np.zeros((*body.shape, 2)), np.zeros(body.shape), camera())
    assert known.pitch == pytest.approx(mean) and "upright" in known.source and 0.6 < known.confidence < 1.0


def test_a_body_without_upright_edges_leaves_the_usual_tilt():
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    wide = np.abs(rows - 100) + 0.15 * np.abs(columns - 128) < 14
    mean, error = prism.upright_tilt(wide, camera, (25.0, 12.0))
    assert mean == pytest.approx(25.0, abs=1.0) and error == pytest.approx(12.0, rel=0.1)
