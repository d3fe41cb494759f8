"""The waterline of a film is that of its simulation wherever the two are within a cell of each other."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from fluidlift.look.filmed_outline import FINER, LEFT, RIM, TORN, WIDEST, FilmedOutline, FilmedOutlines, reach
from fluidlift.look.footage import FluidFootage
from fluidlift.look.rasterize import render
from fluidlift.look.surface_axes import PictureAxes, PlanAxes
from fluidlift.look.surface_map import MARGIN, SurfaceMap
from fluidlift.look.surface_skin import SurfaceSkin
from fluidlift.types import PinholeCamera

CELL, LEVEL = 0.2, 0.5
CAMERA = PinholeCamera.looking(
    (2.0, 2.0, 8.5), (2.0, 2.0, LEVEL), fov_degrees=30.0, size=(160, 160), up=(0.0, 1.0, 0.0)
)
"""sees 4.3 x 4.3 m of the surface from straight above"""
PIXEL = 8.0 / CAMERA.focal[0]
"""m on the surface: seven and a half in a cell"""


def filmed(shore: float) -> np.ndarray:
    """px to the nearest fluid: water to the left of x = `shore`, m."""
    x = (np.arange(160) + 0.5 - 80) * PIXEL + 2.0
    wet = np.broadcast_to(x < shore, (160, 160))
    frames = np.zeros((8, 160, 160, 3), np.uint8)
    return FluidFootage.of(frames, np.repeat(wet[None], 8, axis=0), 0.04).outside


def simulated(shore: float, axes=None, low: float = 0.3, margin: int = MARGIN) -> SurfaceMap:
    """Water to the left of x = `shore`."""
    x, y, z = np.meshgrid(np.arange(low, shore, 0.05), np.arange(0.3, 3.7, 0.05), [0.45, LEVEL], indexing="ij")
    world = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    points = world if axes is None else axes.points(world)
    return SurfaceMap.of(points, np.zeros_like(points), CELL, margin=margin)


def waterline(surface: SurfaceMap) -> float:
    """x of the right rim of the wet columns in the middle rows, m."""
    middle = np.abs(surface.middles()[0, :, 1] - 2.0) < 1.0
    return (
        float(np.max(np.where(surface.wet[:, middle], surface.middles()[:, middle, 0], -np.inf))) + 0.5 * surface.pitch
    )


@pytest.mark.parametrize("film", [2.35, 2.43, 2.6])
def test_a_rim_within_a_cell_is_moved_to_the_films(film):
    """Both ways: what is simulated beyond the film's waterline goes, what falls short of it is filled up."""
    outline = FilmedOutline(CAMERA, filmed(film), CELL)
    before = simulated(2.5)
    after = outline.cut(before, PlanAxes())
    # a column of the map is half a cell wide; pixels are 2.7 cm
    assert waterline(after) == pytest.approx(film, abs=0.5 * before.pitch + PIXEL)
    assert abs(waterline(after) - film) <= abs(waterline(before) - film) + 1e-9


@pytest.mark.parametrize("film", [1.8, 3.1])
def test_a_rim_that_is_further_off_stays_as_it_is_simulated(film):
    """There the two tell of different flows: only a band about the film's own line is its own."""
    before = simulated(2.5)
    after = FilmedOutline(CAMERA, filmed(film), CELL).cut(before, PlanAxes())
    x = before.middles()[..., 0]
    if film > 2.5:  # filled by a cell at most (two columns, and half of one where it ends)
        assert waterline(after) <= waterline(before) + FINER * CELL + 1e-9
        assert (after.wet >= before.wet).all()
    else:  # what lies more than two cells from the film's water is left
        far = x > film + LEFT * CELL + PIXEL
        assert (before.wet & far).any()
        np.testing.assert_array_equal(after.wet[far], before.wet[far])


def test_only_the_rim_is_touched():
    before = simulated(2.5)
    after = FilmedOutline(CAMERA, filmed(2.4), CELL).cut(before, PlanAxes())
    # the film is wet up to the picture's other sides as well: rims there may grow by a cell, two columns of the map
    away = np.maximum(*(ndimage.distance_transform_cdt(m, "taxicab") for m in (before.wet, ~before.wet))) > 2
    assert away.mean() > 0.5
    np.testing.assert_array_equal(after.wet[away], before.wet[away])
    np.testing.assert_array_equal(after.height, before.height)
    np.testing.assert_array_equal(after.velocity, before.velocity)


@pytest.mark.parametrize(("half", "closed"), [(1.5, True), (3.5, False)])
def test_a_hole_of_a_torn_sheet_is_closed_where_the_film_shows_fluid(half, closed):
    before = simulated(3.7)
    hole = (np.abs(before.middles() - 1.2) < half * CELL).all(axis=-1)
    torn = replace(before, wet=before.wet & ~hole)
    after = FilmedOutline(CAMERA, filmed(2.4), CELL).cut(torn, PlanAxes())
    core = (np.abs(before.middles() - 1.2) < 0.5 * CELL).all(axis=-1)
    assert (after.wet[core] == closed).all() and (torn.wet & hole).sum() == 0
    beside = FilmedOutline(CAMERA, np.where(filmed(2.4) > 0, filmed(2.4), 0.0) + 50.0, CELL).cut(torn, PlanAxes())
    assert not beside.wet[core].any(), "what the film shows dry stays so"


def test_nothing_beyond_the_picture_is_touched():
    """A stream goes on where the film ends; its border is no waterline."""
    near = PinholeCamera.looking(
        (2.0, 2.0, 8.5), (2.0, 2.0, LEVEL), fov_degrees=12.0, size=(64, 64), up=(0.0, 1.0, 0.0)
    )
    before, half = simulated(3.7), 8.0 * np.tan(np.radians(6.0))
    dry = FilmedOutline(near, np.full((64, 64), 3.0), CELL)  # a film that is dry all over, right beside its fluid
    after = dry.cut(before, PlanAxes())
    inside = (np.abs(before.middles() - 2.0) < half - 1e-6).all(axis=-1)
    np.testing.assert_array_equal(after.wet[~inside], before.wet[~inside])
    assert not after.wet[inside].any(), "or this says nothing"
    beyond = np.array([[0.5, 2.0, LEVEL], [2.0, 3.5, LEVEL], [2.0, 2.0, 20.0]])  # the last is behind the camera
    assert np.isposinf(dry.room(beyond)).all() and dry.inside(beyond).all()


def test_water_that_fills_the_whole_picture_has_no_rim():
    outline = FilmedOutline(CAMERA, filmed(99.0), CELL)
    before = simulated(2.5)
    assert (outline.cut(before, PlanAxes()).wet >= before.wet).all()
    places = np.array([[0.5, 0.5, LEVEL], [2.0, 2.0, LEVEL], [3.9, 0.2, LEVEL]])
    assert outline.inside(places).all() and (outline.room(places) > 100.0).all()  # m: any splat


def test_splats_have_no_room_beside_the_fluid_and_more_the_deeper_inside_they_are():
    outline = FilmedOutline(CAMERA, filmed(2.4), CELL)
    away = np.array([-1.0, -0.5, -0.2, -0.05, 0.05, 0.15])  # m to the right of the waterline
    places = np.stack([2.4 + away, np.full(6, 2.0), np.full(6, LEVEL)], axis=-1)
    room = outline.room(places)
    # a splat ends within the outline: WIDEST of its distance, known to the half pixel of the mask and of its tolerance
    np.testing.assert_allclose(room[:4], WIDEST * -away[:4], atol=WIDEST * (RIM + 0.6) * PIXEL)
    assert (np.diff(room[:4]) < 0).all() and (room[4:] == 0).all()
    np.testing.assert_array_equal(outline.inside(places), [True] * 4 + [False] * 2)
    # two cells beside it, the simulation has its way
    far = np.array([[2.4 + LEFT * CELL + 2 * PIXEL, 2.0, LEVEL]])
    assert np.isposinf(outline.room(far)).all() and outline.inside(far).all()


def test_the_same_holds_on_a_map_over_the_picture():
    """A fall's map is the picture itself."""
    axes = PictureAxes(CAMERA, 8.0)
    before = simulated(2.5, axes)
    after = FilmedOutline(CAMERA, filmed(2.4), CELL).cut(before, axes)
    # X counts from the middle of the picture, at x = 2
    middle = np.abs(before.middles()[0, :, 1]) < 1.0
    line = np.max(np.where(after.wet[:, middle], after.middles()[:, middle, 0], -np.inf)) + 0.5 * after.pitch
    assert line == pytest.approx(0.4, abs=0.5 * before.pitch + PIXEL)


@pytest.mark.parametrize("film", [3.1, 3.9])
def test_a_sheet_that_breaks_up_in_the_air_is_followed_further(film):
    """Three cells are filled up, where a stream would be by one; of seven, no more than six are."""
    axes = PictureAxes(CAMERA, 8.0)
    before = simulated(2.5, axes, margin=2 + reach(axes))
    after = FilmedOutline(CAMERA, filmed(film), CELL).cut(before, axes)
    middle = np.abs(before.middles()[0, :, 1]) < 1.0
    line = np.max(np.where(after.wet[:, middle], after.middles()[:, middle, 0], -np.inf)) + 0.5 * after.pitch
    assert line == pytest.approx(min(film - 2.0, 0.5 + TORN * CELL), abs=before.pitch + PIXEL)


def test_what_fills_its_vessel_may_rise_above_its_film_but_not_leave_it_sideways():
    """The camera looks along -z with y up in its picture: filmed up to y = 2, in a vessel from x = 1.2 to 2.8."""
    rows, columns = np.mgrid[0:160, 0:160]
    x, y = 2.0 + (columns + 0.5 - 80) * PIXEL, 2.0 - (rows + 0.5 - 80) * PIXEL
    wet = (np.abs(x - 2.0) < 0.8) & (y < 2.0)
    outside = ndimage.distance_transform_edt(~wet)
    above, beside, low = np.array([[2.0, 2.3, LEVEL]]), np.array([[3.0, 1.0, LEVEL]]), np.array([[2.0, 1.0, LEVEL]])
    stays, rises = (FilmedOutline(CAMERA, outside, CELL, rises=px) for px in (0, 16))
    assert not stays.inside(above).any() and rises.inside(above).all()
    assert not rises.inside(np.array([[2.0, 2.6, LEVEL]])).any(), "16 px are 0.43 m"
    for outline in (stays, rises):
        assert not outline.inside(beside).any() and outline.inside(low).all()
    # what the film shows is filled up; above it the level is the simulation's own
    before = simulated(1.6)
    up = np.arange(before.wet.shape[1]) * before.pitch + before.low[1] > 2.0 + before.pitch
    both = [outline.cut(before, PlanAxes()).wet & ~before.wet for outline in (stays, rises)]
    assert all(added[:, ~up].any() for added in both) and not both[1][:, up].any()


def covered(wet: np.ndarray, level: int) -> np.ndarray:
    """Pixels that the skin of a pool covers, which stands further than a film (bool [160,160]) shows it."""
    outline = FilmedOutline(CAMERA, ndimage.distance_transform_edt(~wet), CELL)
    surface = outline.cut(simulated(3.7), PlanAxes())
    skin = SurfaceSkin(CELL, lambda places: np.full(len(places), level))
    for _ in range(3):
        skin.advance(surface, 0.0, np.random.default_rng(2))
    splats = skin.splats(surface, np.ones((len(skin), 3)))
    return render(splats.select(outline.inside(splats.means.astype(np.float64))), CAMERA).alpha > 0.5


@pytest.mark.parametrize("width", [3, 7, 20, 60])
@pytest.mark.parametrize("level", [1, 2])
def test_a_skin_covers_what_the_film_shows_and_not_a_pixel_more_on_either_side(width, level):
    """A jet of some px from the upper to the lower side of the picture: its splats are 1.3 and 0.9 px apart."""
    wet = np.zeros((160, 160), bool)
    wet[:, 70 : 70 + width] = True
    found = covered(wet, level)[40:120]  # rows where the pool is; 15 px beside the film it has its way
    found[:, :56] = found[:, 84 + width :] = False
    # half a pixel on either side is what a mask of whole pixels is known to, and so is the border of what is covered
    assert found.sum(axis=1).mean() == pytest.approx(width, abs=1.0)
    assert not found[:, :69].any() and not found[:, 71 + width :].any()
    assert found[:, 71 : 69 + width].mean() > 0.97


def footage(wet: np.ndarray) -> FluidFootage:
    """A film of masks bool [t,160,160]."""
    found = FluidFootage.of(np.zeros((*wet.shape, 3), np.uint8), wet, 0.04)
    assert found is not None
    return found


def swaying(frames: int = 12) -> np.ndarray:
    """A jet of 12 px that goes a pixel to the right with every frame, and is missed in one of them."""
    wet = np.zeros((frames, 160, 160), bool)
    for t in range(frames):
        wet[t, 40:120, 60 + t : 72 + t] = True
    wet[5] = False
    return wet


def seen_inside(outline: FilmedOutline, row: int = 80) -> np.ndarray:
    """Columns of a row of the picture whose middles are inside."""
    uv = np.stack([np.arange(160) + 0.5, np.full(160, row + 0.5)], axis=-1)
    return np.flatnonzero(outline.inside(CAMERA.unproject(uv, np.full(160, 8.0))) & (np.abs(uv[:, 0] - 72) < 14))


def test_what_sways_is_as_wide_as_each_frame_shows_it():
    wet = swaying()
    outlines = FilmedOutlines(CAMERA, footage(wet), CELL, rises=False)
    for t in (1, 3, 8, 10):
        columns = seen_inside(outlines.at(t))
        # ten whole pixels, less that at either rim of which the splat would stand out
        assert (columns.min(), columns.max()) == (60 + t + 1, 71 + t - 1)
    assert len(seen_inside(outlines.at(5))) >= 8, "a mask that failed once opens no hole"
    union = FilmedOutline(CAMERA, footage(wet).outside, CELL)
    assert len(seen_inside(union)) > len(seen_inside(outlines.at(8))) + 4, "or this says nothing"


@pytest.mark.parametrize("rises", [False, True])
def test_after_its_film_a_fluid_keeps_its_last_outline_unless_it_came_back_to_what_it_was(rises):
    outlines = FilmedOutlines(CAMERA, footage(swaying()), CELL, rises=rises)
    last, after = outlines.at(11.0), outlines.at(30.0)
    np.testing.assert_array_equal(seen_inside(last), seen_inside(after))
    assert outlines.at(30.0) is after, "the same outline is not made twice"
    # what came back to where it was goes on with what its surface shows; what fills does not sink again
    again = seen_inside(outlines.at(30.0, shown=3.0))
    np.testing.assert_array_equal(again, seen_inside(last if rises else outlines.at(3.0)))


def test_a_vessel_goes_on_to_fill_as_fast_as_it_was_filmed_beside_a_jet_that_stays_as_wide():
    """A pool that rises by two px a frame, to row 76 in the last of 12, below a jet of 8 px."""
    wet = np.zeros((12, 160, 160), bool)
    wet[:, 20:120, 76:84] = True
    for t in range(12):
        wet[t, 98 - 2 * t : 120, 40:120] = True
    outlines = FilmedOutlines(CAMERA, footage(wet), CELL, rises=True)

    def top(outline: FilmedOutline, column: int) -> int:
        uv = np.stack([np.full(160, column + 0.5), np.arange(160) + 0.5], axis=-1)
        beside = np.flatnonzero(~outline.inside(CAMERA.unproject(uv, np.full(160, 8.0))))
        return int(beside[beside < 110].max()) + 1

    assert [top(outlines.at(t), 60) for t in (2.0, 8.0)] == [95, 83], "a pixel inside"
    # by the majority of three frames the last is one behind
    assert top(outlines.at(21.0), 60) == pytest.approx(77 + 2 - 20, abs=1)
    jet, later = seen_inside(outlines.at(11.0), 40), seen_inside(outlines.at(15.0), 40)
    np.testing.assert_array_equal(jet, later)
