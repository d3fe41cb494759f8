"""The pattern of a surface is carried by the flow, and is not drawn out by it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import ndimage

from fluidlift.look.appearance import SteadyShading
from fluidlift.look.footage import FluidFootage
from fluidlift.look.picture_texture import PictureTexture
from fluidlift.look.seen_texture import SeenTexture
from fluidlift.look.surface_axes import PictureAxes
from fluidlift.look.surface_map import SurfaceMap, sampled
from fluidlift.look.texture_patches import FASTEST, LIMIT, Patches, TexturePatches, instants_together
from fluidlift.types import Gaussians, PinholeCamera

CELL, SIZE = 0.1, 4.0
CAMERA = PinholeCamera.looking((2.0, 2.0, 10.0), (2.0, 2.0, 0.5), fov_degrees=25.0, size=(128, 128), up=(0.0, 1.0, 0.0))
SPOT = 0.35
"""m, between dark and bright"""


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Brightness of a surface that is alike in all directions."""
    rng = np.random.default_rng(5)
    waves = rng.uniform(0, 2 * np.pi, (24, 2))
    k = np.pi / SPOT
    return 0.5 + 0.4 * sum(np.sin(k * (np.cos(a) * x + np.sin(a) * y) + p) for a, p in waves) / np.sqrt(12) / 1.5


def sheet(pitch: float = 0.03, colors=None) -> Gaussians:
    x, y = (a.ravel() for a in np.meshgrid(*[np.arange(0, SIZE, pitch)] * 2, indexing="ij"))
    grey = np.clip(pattern(x, y), 0, 1)[:, None] * np.ones(3) if colors is None else colors(x, y)
    # at one depth, splats would cover their neighbours on one side only
    z = 0.5 + np.random.default_rng(3).uniform(-1e-3, 1e-3, len(x))
    means = np.stack([x, y, z], axis=-1).astype(np.float32)
    return Gaussians.isotropic(means, 0.6 * pitch, grey.astype(np.float32), 0.99)


def surface(flow) -> SurfaceMap:
    x, y, z = np.meshgrid(np.arange(0.025, SIZE, 0.05), np.arange(0.025, SIZE, 0.05), [0.45, 0.5], indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    velocity = np.stack([*flow(points[:, 0], points[:, 1]), np.zeros(len(points))], axis=-1)
    return SurfaceMap.of(points, velocity, CELL)


def patches_over(flow, frames: int, interval: float = 0.05, body: Gaussians | None = None, radius: float = 0.6):
    where = surface(flow)
    patches = TexturePatches(SeenTexture(sheet() if body is None else body, CAMERA, where), radius)
    for k in range(frames + 1):
        patches.advance(where, interval if k else 0.0, np.random.default_rng([1, k]))
    return patches


def places(count: int = 60, inset: float = 1.2) -> np.ndarray:
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(inset, SIZE - inset, count)] * 2, indexing="ij"))
    return np.stack([x, y, np.full_like(x, 0.5)], axis=-1)


def test_at_the_first_instant_the_body_is_seen_as_it_is():
    points = places()
    color, there, _ = patches_over(lambda x, y: (0 * x, 0 * y), 0).colors(points)
    expected = np.clip(pattern(points[:, 0], points[:, 1]), 0, 1)
    # pixels are 3.3 cm wide, a tenth of the pattern's half wave
    assert there.all() and np.abs(color[:, 0] - expected).mean() < 0.02


def test_a_flow_without_shear_carries_the_pattern_along():
    points = places()
    color, *_ = patches_over(lambda x, y: (0.5 + 0 * x, 0.2 + 0 * y), 20).colors(points)
    carried = np.clip(pattern(points[:, 0] - 0.5, points[:, 1] - 0.2), 0, 1)
    still = np.clip(pattern(points[:, 0], points[:, 1]), 0, 1)
    assert np.abs(color[:, 0] - carried).mean() < 0.03
    assert np.abs(still - carried).mean() > 0.1, "the two patterns must differ for this to say anything"


def test_a_flow_that_turns_turns_the_pattern():
    turned = 0.6
    speed, points = turned / 1.0, places(inset=1.5)
    color, *_ = patches_over(lambda x, y: (-speed * (y - 2), speed * (x - 2)), 100, interval=0.01).colors(points)
    away, cos, sin = points[:, :2] - 2.0, np.cos(-turned), np.sin(-turned)
    x, y = 2 + cos * away[:, 0] - sin * away[:, 1], 2 + sin * away[:, 0] + cos * away[:, 1]
    assert np.abs(color[:, 0] - np.clip(pattern(x, y), 0, 1)).mean() < 0.06  # the middle of each patch moves exactly


def gradients(color: np.ndarray, count: int) -> np.ndarray:
    picture = color[:, 0].reshape(count, count)
    return np.array([np.abs(np.diff(picture, axis=a)).mean() for a in (0, 1)])


def test_shear_does_not_draw_the_pattern_out():
    shear, seconds = 2.0, 5.0
    points = places()
    at_rest = gradients(np.clip(pattern(points[:, 0], points[:, 1]), 0, 1)[:, None], 60)
    drawn_out = gradients(
        np.clip(pattern(points[:, 0] - shear * seconds * (points[:, 1] - 2), points[:, 1]), 0, 1)[:, None], 60
    )
    assert drawn_out[1] > 2.5 * at_rest[1], "carried alone it would be streaks (as far as the raster can show them)"
    patches = patches_over(lambda x, y: (shear * (y - 2), 0 * y), 100)
    found = gradients(patches.colors(points)[0], 60)
    # seams between patches of 0.6 m add edges to a pattern of 0.35 m, in no direction more than in the other
    assert (0.7 < found / at_rest).all() and (found / at_rest < 1.5).all()
    assert 0.75 < (found[1] / at_rest[1]) / (found[0] / at_rest[0]) < 1.33
    assert (patches.state.strains < LIMIT + 13 * 0.05 * shear).all(), "those beyond the limit go within twelve frames"


def test_streaks_stay_along_a_flow_that_shears():
    """Turned with half of the vorticity, they would lie across it by half a radian before they give way."""
    state = patches_over(lambda x, y: (2.0 + 0.8 * (y - 2), 0 * y), 60).state
    assert state.strains.max() > 0.5 and np.abs(state.turns).max() < 0.05


def test_a_piece_taken_from_a_stretch_that_heads_elsewhere_lies_along_the_flow():
    """Seen, everything went along x; now it goes along y: old pieces come round as fast as the flow can turn a line."""
    seen = surface(lambda x, y: (1.0 + 0 * x, 0 * y))
    patches = TexturePatches(SeenTexture(sheet(), CAMERA, seen), 0.6)
    patches.advance(seen, 0.0, np.random.default_rng(0))
    now = surface(lambda x, y: (0 * x, 1.0 + 0 * y))
    for k in range(60):
        patches.advance(now, 0.05, np.random.default_rng(k))
    young = patches.state.presences < 1
    assert young.any()
    np.testing.assert_allclose(patches.state.turns[young], np.pi / 2, atol=0.05)


def test_new_patches_show_what_was_seen_of_the_fluid_and_not_what_was_not():
    """Red is what may not lend its look: a bank, say. After three seconds all that was there at first has left."""
    inside = lambda x, y: (np.abs(x - 2) < 1.4) & (np.abs(y - 2) < 1.4)  # noqa: E731
    body = sheet(colors=lambda x, y: np.where(inside(x, y)[:, None], [0.2, 0.5, 0.2], [1.0, 0.0, 0.0]))
    where = surface(lambda x, y: (1.5 + 0 * x, 0.3 * np.sin(3 * y)))
    texture = SeenTexture(body, CAMERA, where, usable=inside(body.means[:, 0], body.means[:, 1]))
    patches = TexturePatches(texture, 0.6)
    for k in range(61):
        patches.advance(where, 0.05 if k else 0.0, np.random.default_rng([2, k]))
    color, there, _ = patches.colors(places(40, inset=0.2))
    # a source is good from four fifths on: its last fifth shows where no other patch is
    assert there.all() and (color[:, 0] > 0.3).mean() < 0.02 and color[:, 0].mean() < 0.22


def test_the_shade_of_a_place_stays_there():
    """Left half in the shade: three tenths darker, whatever comes by."""
    shade = np.ones((128, 128, 3), np.float32)
    shade[:, :64] = 0.7
    body = sheet(colors=lambda x, y: np.where(x[:, None] < 2, 0.56, 0.8) * np.ones(3))
    where = surface(lambda x, y: (1.0 + 0 * x, 0 * y))
    patches = TexturePatches(SeenTexture(body, CAMERA, where, shading=SteadyShading(shade, CAMERA)), 0.6)
    for k in range(21):
        patches.advance(where, 0.05 if k else 0.0, np.random.default_rng(k))
    points = places(40)
    color = patches.colors(points)[0][:, 0]
    left, right = color[points[:, 0] < 1.8], color[points[:, 0] > 2.2]
    np.testing.assert_allclose([left.mean(), right.mean()], [0.56, 0.8], rtol=0.05)


def test_their_number_does_not_grow_with_time():
    flow = lambda x, y: (0.5 + np.sin(2 * y), np.cos(3 * x))  # noqa: E731
    few, many = (len(patches_over(flow, n).state) for n in (40, 160))
    assert many < 1.2 * few


def test_a_radius_of_nothing_and_a_body_out_of_sight_are_refused():
    where = surface(lambda x, y: (0 * x, 0 * y))
    with pytest.raises(ValueError, match="radius"):
        TexturePatches(SeenTexture(sheet(), CAMERA, where), 0.0)
    away = PinholeCamera.looking((2.0, 2.0, 10.0), (2.0, 9.0, 20.0), fov_degrees=20.0, size=(64, 64))
    with pytest.raises(ValueError, match="nothing was seen"):
        TexturePatches(SeenTexture(sheet(), away, where), 0.6)


# with a film of the surface ------------------------------------------------------------------------------------------

STEP = 0.05
"""s between frames"""
AXES = PictureAxes(CAMERA, 9.5)
CONTRAST = 0.1


def noise_film(count: int = 60, fluid: np.ndarray | None = None) -> FluidFootage:
    """Grain around grey, another one in each pixel, frame and colour."""
    values = 0.5 + CONTRAST * np.random.default_rng(11).normal(size=(count, 128, 128, 3))
    frames = np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)
    film = FluidFootage.of(frames, np.ones(frames.shape[:3], bool) if fluid is None else fluid, STEP)
    assert film is not None
    return film


FILM = noise_film()


def upright(flow) -> SurfaceMap:
    """`surface` as a map over the picture."""
    x, y, z = np.meshgrid(np.arange(0.025, SIZE, 0.05), np.arange(0.025, SIZE, 0.05), [0.45, 0.5], indexing="ij")
    world = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    moving = np.stack([*flow(world[:, 0], world[:, 1]), np.zeros(len(world))], axis=-1)
    return SurfaceMap.of(AXES.points(world), AXES.velocities(world, moving), CELL)


def uniform(u: float, v: float = 0.0):
    return lambda x, y: (u + 0 * x, v + 0 * y)


def played(frames: int, film: FluidFootage = FILM, *, now=None, interval: float = STEP, **options) -> TexturePatches:
    """Patches of a film, of a surface that was seen to flow at 0.5 m/s, after some frames of the flow `now`."""
    seen = upright(uniform(0.5))
    patches = TexturePatches(PictureTexture(AXES, seen, film), 0.6, footage=film, **options)
    patches.advance(seen, 0.0, np.random.default_rng([3, 0]))
    where = seen if now is None else upright(now)
    for k in range(1, frames + 1):
        patches.advance(where, interval, np.random.default_rng([3, k]))
    return patches


def pixels(inset: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Points of the map (m) at the middles of pixels, and these pixels."""
    index = np.stack(np.meshgrid(np.arange(inset, 128 - inset), np.arange(inset, 128 - inset), indexing="ij"), -1)
    index = index.reshape(-1, 2)
    world = CAMERA.unproject(index[:, ::-1] + 0.5, np.full(len(index), 9.5))
    return AXES.points(world), index


def shown_at(film: FluidFootage, index: np.ndarray, frame: int) -> np.ndarray:
    return film.frames[frame, index[:, 0], index[:, 1]] / 255.0


def at_home(centers: np.ndarray, instants: np.ndarray) -> Patches:
    n = len(centers)
    return Patches(centers, centers.copy(), np.zeros(n), np.zeros(n), np.ones(n), instants, np.full(n, np.inf))


def test_patches_of_a_film_stay_and_play_as_fast_as_it_was_filmed():
    before, after = (played(n, start=4.0).state for n in (0, 1))
    n = len(before)
    np.testing.assert_array_equal(after.centers[:n], before.centers)
    np.testing.assert_array_equal(after.turns, 0)
    assert (before.instants == 4).all()
    np.testing.assert_allclose(after.instants[:n], 5.0, rtol=1e-12)
    slow = played(1, start=4.0, interval=0.25 * STEP).state
    np.testing.assert_allclose(slow.instants[:n], 4.25, rtol=1e-12)


def test_how_the_surface_moves_is_not_asked_for_where_patches_stay(monkeypatch):
    patches, where = played(0, start=4.0), upright(uniform(0.5))
    monkeypatch.setattr("fluidlift.look.texture_patches._gradients", lambda *_: pytest.fail("nobody needs it"))
    for k in range(1, 40):
        patches.advance(where, STEP, np.random.default_rng(k))
    assert len(patches.state) and (patches.state.turns == 0).all()


@pytest.mark.parametrize("instant", [0, 7, 59])
def test_one_patch_at_home_shows_the_clips_own_picture(instant):
    patches = played(0)
    patches.state = at_home(np.zeros((1, 2)), np.array([float(instant)]))
    points, index = pixels(inset=56)
    color, there, _ = patches.colors(points)
    assert there.all()
    np.testing.assert_allclose(color, shown_at(FILM, index, instant), atol=1e-5)  # single precision


def test_patches_of_one_instant_show_together_what_one_of_them_shows():
    """What they share is one picture, not several that happen to be added up: where they overlap it is no livelier."""
    patches = played(0, start=9.0)
    points, index = pixels()
    assert len(patches.state) > 10
    color, there, _ = patches.colors(points)
    assert there.all()
    np.testing.assert_allclose(color, shown_at(FILM, index, 9), atol=1e-5)


def test_a_surface_seen_in_plan_shows_the_clips_own_picture_whatever_its_level():
    """Water that has risen is looked up where it is seen now."""
    where = surface(uniform(0.5))
    patches = TexturePatches(SeenTexture(sheet(), CAMERA, where), 0.6, footage=FILM, start=9.0)
    patches.advance(where, 0.0, np.random.default_rng(0))
    index = pixels()[1]
    for depth in (9.5, 9.3):  # the surface as it was, and 20 cm higher
        points = CAMERA.unproject(index[:, ::-1] + 0.5, np.full(len(index), depth))
        color, there, _ = patches.colors(points)
        assert there.all()
        np.testing.assert_allclose(color, shown_at(FILM, index, 9), atol=1e-4)  # single precision of the projection


@pytest.mark.parametrize("seen_in", ["the picture", "plan"])
def test_pairs_at_home_are_those_that_are_looked_up_like_any_other(seen_in):
    """A patch a picometre from its own place is asked for its source as one from elsewhere is: the plain way."""
    if seen_in == "plan":
        where = surface(uniform(0.5))
        patches = TexturePatches(SeenTexture(sheet(), CAMERA, where), 0.6, footage=FILM, start=40.0)
        for k, interval in enumerate([0.0, *[STEP] * 40]):  # the first ones have gone at the film's end
            patches.advance(where, interval, np.random.default_rng(k))
        points = CAMERA.unproject(pixels()[1][:, ::-1] + 0.5, np.full(len(pixels()[1]), 9.4))
    else:
        patches, points = played(40, start=40.0), pixels()[0]
    fast = patches.colors(points)
    s = patches.state
    assert len(np.unique(s.instants)) > 3 and (s.sources == s.centers).all()
    patches.state = replace(s, sources=s.sources + 1e-12)
    for a, b in zip(fast, patches.colors(points), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-6)  # single precision
    patches.state = replace(s, sources=s.sources + np.where(np.arange(len(s))[:, None] % 2, 0.3, 0.0))  # some of each
    mixed, there, _ = patches.colors(points)
    patches.state = replace(s, sources=patches.state.sources + 1e-12)
    np.testing.assert_allclose(mixed, patches.colors(points)[0], atol=2e-6)
    assert there.all() and np.abs(mixed - fast[0]).max() > 0.05


def test_a_blend_of_pieces_of_different_instants_is_as_lively_as_each():
    """Two patches of the same weight along the line between them; a mean would have half of the variance."""
    patches, rng = played(0), np.random.default_rng(8)
    points, index = pixels(inset=50)
    middle = np.abs(points[:, 0] - points[len(points) // 2, 0]) < 1e-6
    points, index = points[middle], index[middle]
    x = points[0, 0]
    found, mean = [], FILM.mean[index[:, 0], index[:, 1]]
    for _ in range(60):
        first, second = rng.choice(len(FILM), 2, replace=False)
        patches.state = at_home(np.array([[x - 0.25, 0.0], [x + 0.25, 0.0]]), np.array([first, second], float))
        found.append(patches.colors(points)[0] - mean)
    found = np.array(found)
    # 60 x 28 x 3 values, of which the film's 60 frames give as many that are new: sampling error of a variance
    # sqrt(2 / 5040) = 2 %; residuals of a mean of sixty frames are a sixtieth smaller, and anticorrelated by as much
    assert found.size > 5000
    assert found.var() == pytest.approx(CONTRAST**2, rel=4 * 0.02)


def test_liveliness_is_the_same_wherever_and_whenever_one_looks():
    """Many patches, at random instants, coming and going."""
    patches, where = played(70), upright(uniform(0.5))
    points, index = pixels()
    mean = FILM.mean[index[:, 0], index[:, 1]]
    found = []
    for k in range(6):
        for j in range(5):
            patches.advance(where, STEP, np.random.default_rng([4, k, j]))
        found.append((patches.colors(points)[0] - mean).var())
    # 48 x 48 x 3 values each: 1.7 %; residuals are a sixtieth smaller, and those of two frames anticorrelated
    np.testing.assert_allclose(found, CONTRAST**2, rtol=4 * 0.017 + 2 / 60)


def test_after_the_films_end_other_patches_play():
    """The first ones go after its last frame, no other ever comes to it, and nothing is bare."""
    film = noise_film(24)
    last, points = len(film) - 1, pixels()[0]
    seen = upright(uniform(0.5))
    patches = TexturePatches(PictureTexture(AXES, seen, film), 0.6, footage=film)
    latest = []
    for k in range(60):
        patches.advance(seen, STEP if k else 0.0, np.random.default_rng([5, k]))
        latest.append(patches.state.instants.max())
        assert patches.colors(points)[1].all()
        if k <= last:
            np.testing.assert_allclose(patches.state.presences, 1.0)
    assert max(latest) == last + 3 and max(latest[last + 4 :]) <= last  # gone within a fade, a sixth of the film
    assert np.ptp(patches.state.instants) > 0.3 * last, "of many instants, where the first ones were of one"
    assert (patches.state.instants < 60).all()


def test_until_its_film_ends_each_place_shows_the_instant_that_was_filmed():
    """So that it goes with the frames of the clip; then places part, and do not end at once again."""
    film = noise_film(36)
    seen = upright(uniform(0.5))
    patches = TexturePatches(PictureTexture(AXES, seen, film), 0.6, footage=film)
    begun = []
    for k in range(80):
        patches.advance(seen, STEP if k else 0.0, np.random.default_rng([7, k]))
        if k < len(film):
            np.testing.assert_allclose(patches.state.instants, k, atol=1e-9)
        begun.append(int((patches.state.presences < 1.1 / 6).sum()))
    count = len(np.unique(patches.state.centers, axis=0))
    assert begun[: len(film)] == [0] * len(film) and begun[len(film)] == count
    assert count > 10 and 0 < max(begun[42:]) < 0.6 * count


def test_places_that_end_at_once_do_not_do_so_again_though_one_has_come_later():
    film = noise_film(36)
    seen = upright(uniform(0.5))
    patches = TexturePatches(PictureTexture(AXES, seen, film), 0.6, footage=film)
    going = []
    for k in range(80):
        if k == 15:
            patches.state = patches.state.select(np.arange(1, len(patches.state)))  # its place is covered anew
        patches.advance(seen, STEP if k else 0.0, np.random.default_rng([8, k]))
        going.append(int(patches.state.going.sum()))
    count = len(np.unique(patches.state.centers, axis=0))
    assert count > 10 and count - 2 <= max(going[25:40]) < count and max(going[42:]) < 0.6 * count


def test_in_a_loop_as_many_places_go_over_in_each_frame():
    film = noise_film(36)
    seen = upright(uniform(0.5))
    patches = TexturePatches(PictureTexture(AXES, seen, film), 0.6, footage=film, first_end="apart")
    patches.advance(seen, 0.0, np.random.default_rng([7, 0]))
    ends = np.sort(patches.state.ends)
    assert len(ends) > 10 and (patches.state.instants == 0).all()
    # one in each of as many equal parts of the film's 35 frames, less the 6 of a fade
    np.testing.assert_array_equal(np.floor(ends / 29 * len(ends)), np.arange(len(ends)))


def drifting_film(count: int, speed: float) -> FluidFootage:
    """Soft grain that moves along rows by so many pixels per frame."""
    grain = ndimage.gaussian_filter(np.random.default_rng(5).normal(size=(128, 300)), 2.0, mode="wrap")
    moved = [ndimage.shift(grain / grain.std(), (0, speed * t), mode="grid-wrap")[:, 60:188] for t in range(count)]
    frames = np.round(255 * np.clip(0.5 + CONTRAST * np.array(moved), 0, 1)).astype(np.uint8)
    film = FluidFootage.of(np.repeat(frames[..., None], 3, axis=-1), np.ones(frames.shape, bool), STEP)
    assert film is not None
    return film


def test_the_last_frame_of_a_film_is_carried_on_until_other_patches_have_come():
    """What leaves with a still picture would be seen to stop: a film whose grain moves as its surface does."""
    seen, (points, index) = upright(uniform(0.5)), pixels(40)
    speed = 0.5 * STEP * CAMERA.focal[0] / 9.5  # px per frame
    film = drifting_film(24, speed)
    patches = TexturePatches(PictureTexture(AXES, seen, film), 0.6, footage=film)
    for k in range(len(film) + 2):
        patches.advance(seen, STEP if k else 0.0, np.random.default_rng([9, k]))
    gone = patches.state.instants > len(film) - 0.5
    patches.state = patches.state.select(gone)  # the pictures of those alone that go
    assert gone.any() and not gone.all()
    shown = patches.colors(points)[0][:, 0]
    after = sampled(drifting_film(len(film) + 2, speed).frames[-1] / 255.0, index.astype(float))[:, 0]
    still = sampled(film.frames[-1] / 255.0, index.astype(float))[:, 0]
    assert np.abs(shown - after).mean() < 0.25 * np.abs(still - after).mean()


def test_where_a_film_goes_over_into_itself_slow_water_seems_to_move_as_it_was_filmed():
    """For any time: flow between frames long after the film's end. Fronts between patches would move on their own."""
    speed, seen = 0.25, upright(uniform(0.5))
    film, (points, _) = drifting_film(36, speed), pixels(32)
    patches = TexturePatches(PictureTexture(AXES, seen, film), 0.6, footage=film)
    places, shown = [], []
    for k in range(80):
        patches.advance(seen, STEP if k else 0.0, np.random.default_rng([5, k]))
        places.append(np.unique(patches.state.centers, axis=0))
        if k >= 40:
            grey = np.round(255 * patches.colors(points)[0][:, 0].reshape(64, 64)).astype(np.uint8)
            shown.append(cv2.resize(grey, (128, 128)))
    np.testing.assert_array_equal(places[-1], places[0])  # in its own place each gives way to the next
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    found = np.stack([flow.calc(a, b, np.zeros((128, 128, 2), np.float32)) for a, b in zip(shown[:-1], shown[1:])]) / 2
    off = np.linalg.norm(found - [speed, 0.0], axis=-1).mean() / speed
    assert off < 0.35  # of the film itself 0.14, which is the error of the flow; of fronts between patches 0.5


@pytest.mark.parametrize("count", [8, 12])
def test_a_short_film_does_not_stand_still_at_its_end(count):
    film = noise_film(count)
    for interval in (STEP, 2 * STEP):  # frames as filmed, and half as many of them
        seen = upright(uniform(0.5))
        patches = TexturePatches(PictureTexture(AXES, seen, film), 0.6, footage=film)
        for k in range(30):
            patches.advance(seen, interval if k else 0.0, np.random.default_rng([6, k]))
            # rounded to a frame; by how much one step overshoots is not held back
            assert patches.state.instants.max() <= count - 1 + interval / STEP


def test_an_edited_flow_of_the_same_kind_only_plays_faster():
    """1.6 times as fast along the same way: the film itself carries its foam along."""
    before, after = (played(n, edited=True, now=uniform(0.8)).state for n in (0, 1))
    n = len(before)
    inner = np.abs(before.centers).max(axis=1) < 1.0  # at a rim the flow of the map is known less well
    assert inner.sum() > 5
    # a splat's flow is that of half a cell around it
    np.testing.assert_allclose(after.instants[:n][inner], 1.6, rtol=1e-3)
    np.testing.assert_allclose(after.centers[:n][inner], before.centers[inner], atol=1e-4)


def test_a_film_is_not_played_faster_than_a_viewer_can_follow():
    """Three times as fast: it plays at twice its speed, and patches make up the rest."""
    before, after = (played(n, edited=True, now=uniform(1.5)).state for n in (0, 1))
    inner = np.flatnonzero(np.abs(before.centers).max(axis=1) < 1.0)
    np.testing.assert_allclose(after.instants[inner], FASTEST, rtol=1e-6)
    rest = (1.5 - FASTEST * 0.5) * STEP
    np.testing.assert_allclose(after.centers[inner] - before.centers[inner], [[rest, 0.0]] * len(inner), atol=1e-4)


def test_an_edited_flow_that_turns_carries_patches_by_the_difference():
    """It was filmed along x and goes along y: the film carries along x what must be taken back."""
    before, after = (played(n, edited=True, now=uniform(0.0, 0.5)).state for n in (0, 1))
    inner = np.flatnonzero(np.abs(before.centers).max(axis=1) < 1.0)
    moved = after.centers[inner] - before.centers[inner]
    np.testing.assert_allclose(moved, [[-0.5 * STEP, 0.5 * STEP]] * len(inner), atol=1e-4)
    np.testing.assert_allclose(after.instants[inner], 1.0, rtol=1e-3)


def test_water_that_an_edit_stops_shows_a_still():
    before, after = (played(n, edited=True, now=uniform(0.0)).state for n in (0, 10))
    inner = np.flatnonzero(np.abs(before.centers).max(axis=1) < 1.0)
    np.testing.assert_allclose(after.instants[inner], before.instants[inner], atol=1e-6)
    np.testing.assert_allclose(after.centers[inner], before.centers[inner], atol=1e-6)


def test_what_was_filmed_is_shown_in_its_place_up_to_where_the_film_ends():
    """A patch whose middle lies beside the filmed fluid covers some of it, with the look of that place."""
    fluid = np.ones((60, 128, 128), bool)
    fluid[:, :, :64] = False
    film = noise_film(fluid=fluid)
    patches = played(0, film, start=9.0)
    beside = patches.state.centers[:, 0] < -0.1
    near = patches.state.centers[:, 0] > -0.5  # of a radius of 0.6 m
    assert (beside & near).any(), "or nothing is tried"
    np.testing.assert_array_equal(patches.state.sources[near], patches.state.centers[near])
    points, index = pixels()
    filmed = index[:, 1] >= 64
    color, there, _ = patches.colors(points[filmed])
    assert there.all()
    np.testing.assert_allclose(color, shown_at(film, index[filmed], 9), atol=1e-5)


def test_where_an_edit_makes_the_flow_unlike_the_film_new_patches_come_from_elsewhere():
    """A place that now flows three times as fast looks otherwise than it was filmed."""
    patches = played(80, edited=True, now=uniform(1.5))
    assert len(patches.state) and (np.linalg.norm(patches.state.sources - patches.state.centers, axis=1) > 0.05).all()
    same = played(80, edited=True, now=uniform(0.5))
    young = same.state.instants < 40
    assert young.any()
    np.testing.assert_allclose(same.state.centers[young], same.state.sources[young], atol=0.02)


def test_a_level_surface_seen_from_flat_above_lends_its_look():
    """Splats on a plane seem to hide metres of it behind them; a plane does not."""
    where = surface(lambda x, y: (0.0 * x, 0.0 * y))
    flat = PinholeCamera.looking((2.0, -4.0, 0.85), (2.0, 2.0, 0.5), fov_degrees=40.0, size=(128, 128))
    body, seen = sheet(0.1), np.ones((128, 128), bool)
    lends = [SeenTexture(body, flat, where, plane=plane).trust(where.columns()) > 0.5 for plane in (None, seen)]
    assert lends[0].mean() < 0.6 and lends[1].mean() > 0.9


def test_patches_of_a_sea_show_one_instant_and_begin_again_together():
    where, rng = surface(lambda x, y: (0.0 * x, 0.0 * y)), np.random.default_rng(0)
    texture = SeenTexture(sheet(), CAMERA, where)
    sea = TexturePatches(texture, 0.6, footage=FILM, start=40.0, together=True, first_end="faded")
    ended, before = 0, 0.0
    for frame in range(20):
        sea.advance(where, STEP if frame else 0.0, rng)
        staying = sea.state.instants[~sea.state.going]
        assert len(staying) > 10 and np.ptp(staying) < 1e-9, "a crest is one thing from shore to shore"
        ended += bool(frame) and bool(staying[0] < before - 1.0)
        before = staying[0]
    assert ended == 1 and before == 10.0, "after nine frames from the first one on"


@pytest.mark.parametrize("first_end", ["carried", "faded", "apart"])
@pytest.mark.parametrize(("again", "interval"), [(0.0, STEP), (0.5 * len(FILM), STEP), (0.0, 1.6 * STEP)])
def test_the_instant_that_all_of_them_show_is_known_beforehand(again, interval, first_end):
    ground, rng = upright(uniform(0.0)), np.random.default_rng(0)
    known = {"start": 40.0, "again": again, "first_end": first_end}
    jet = TexturePatches(PictureTexture(AXES, ground, FILM), 0.6, footage=FILM, together=True, **known)
    shown = []
    for k in range(3 * len(FILM)):
        jet.advance(ground, interval if k else 0.0, rng)
        shown.append(jet.leading)
    pace = interval / FILM.interval
    expected = instants_together(len(FILM), pace=pace, count=len(shown), **known)
    apart = np.abs(np.array(shown) - expected)
    assert np.median(apart) < 0.01 and (apart > 2.0 * pace).mean() < 0.05
