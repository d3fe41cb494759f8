"""A camera that shakes, a clip that is cut, and fluids that must not pass for either."""

import cv2
import numpy as np
import pytest

from fluidlift.messages import code_of
from fluidlift.motion.full_frame import seen_pixels
from fluidlift.motion.stabilize import find_cuts, shake_and_drift, stabilise, steady_run, unlike
from fluidlift.types.clip import VideoClip

FRAMES, HEIGHT, WIDTH = 14, 180, 240


def scene(seed: int) -> np.ndarray:
    """A still picture with detail at several scales, float32 [H+40,W+40]."""
    rng = np.random.default_rng(seed)
    size = (HEIGHT + 40, WIDTH + 40)
    parts = [cv2.GaussianBlur(rng.normal(size=size).astype(np.float32), (0, 0), s) for s in (1.5, 4.0, 20.0)]
    return 120.0 + sum(w * p / p.std() for w, p in zip((15.0, 25.0, 20.0), parts))


def clip_of(grey: np.ndarray) -> VideoClip:
    frames = np.clip(grey, 0, 255).round().astype(np.uint8)[..., None].repeat(3, axis=-1)
    return VideoClip(frames, np.arange(len(frames)) / 25.0)


def shaken(places: np.ndarray, seed: int = 0) -> np.ndarray:
    """Views of one scene from a camera displaced by `places` [T,2] px."""
    picture = scene(seed)
    return np.stack(
        [
            cv2.warpAffine(
                picture, np.float32([[1, 0, x - 20], [0, 1, y - 20]]), (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC
            )
            for x, y in places
        ]
    )


def flowing(grey: np.ndarray, *, speed: int = 4) -> np.ndarray:
    """The same with a pattern that flows through 60% of the picture."""
    result, pattern = grey.copy(), scene(99)[:HEIGHT, :WIDTH]
    rows = slice(int(0.2 * HEIGHT), int(0.8 * HEIGHT))
    for t in range(len(grey)):
        result[t, rows] = np.roll(pattern, speed * t, axis=1)[rows]
    return result


def test_a_still_camera_is_left_alone():
    clip = clip_of(shaken(np.zeros((FRAMES, 2))))
    same, report = stabilise(clip)
    assert same is clip and not report.stabilised
    assert report.shake_px < 0.05 and report.drift_px < 0.05 and report.cuts == () and report.warnings == ()


def test_the_path_of_the_camera_is_told_as_it_went():
    places = np.linspace(0, 12, FRAMES)[:, None] * np.array([[-1.0, 0.25]])  # `places` shift the picture
    _, report = stabilise(clip_of(shaken(places)))
    went = report.path - report.path[0]
    assert went == pytest.approx(-(places - places[0]), abs=0.4)
    assert np.abs(report.path).min() < 0.1  # it is told from the frame that all are laid on


def test_a_mild_shake_is_measured_and_taken_out():
    places = np.random.default_rng(1).normal(scale=1.2, size=(FRAMES, 2))
    steady, report = stabilise(clip_of(shaken(places)))
    true = np.percentile(np.linalg.norm(np.diff(places, axis=0), axis=1), 95)
    assert report.stabilised
    assert report.shake_px == pytest.approx(true, rel=0.1)  # feature tracking is good to about 0.1 px
    _, after = stabilise(steady)
    assert after.shake_px < 0.3, "what is left is below the level at which anything would be warped"


def test_a_fluid_over_most_of_the_picture_does_not_pass_for_the_camera():
    clip = clip_of(flowing(shaken(np.zeros((FRAMES, 2)))))
    same, report = stabilise(clip)
    assert same is clip and report.shake_px < 0.1


def panned(steps: np.ndarray) -> np.ndarray:
    """Views of a wide scene from a camera that turns by `steps` [T] px to the right."""
    picture = np.concatenate([scene(seed) for seed in range(3)], axis=1)
    return np.stack([picture[20 : 20 + HEIGHT, 20 + int(x) : 20 + int(x) + WIDTH] for x in steps])


def test_a_turn_of_the_camera_is_taken_out_and_what_it_does_not_see_is_filled_in():
    # all are laid on the middle one: the first and the last miss a fifth of its picture
    steps = 5 * np.arange(19)
    clip = clip_of(panned(steps))
    steady, report = stabilise(clip)
    assert report.stabilised and report.runs == ((0, 19),)
    assert report.drift_px == pytest.approx(45.0, abs=0.5)
    assert "45 px" in report.warnings[0]
    error = np.abs(steady.frames.astype(float) - clip.frames[9])[:, 4:-4, 4:-4]
    assert np.percentile(error, 99) < 8.0, "grey levels; interpolation of the finest detail leaves some"


def test_what_a_steadied_frame_does_not_see_is_told():
    steady, report = stabilise(clip_of(panned(5 * np.arange(19))))
    assert report.unseen is not None
    own, cell = seen_pixels(report.unseen, steady.size), max(steady.size) / max(report.unseen.shape[1:])
    for t, filled in ((0, 45), (9, 0), (18, 45)):  # px that lie beyond the frame's edge, on the side it turned from
        blind = ~own[t].any(axis=0)
        side = blind[::-1] if t < 9 else blind
        assert 0 <= int(np.argmin(side)) - filled <= 3 * cell, "and a cell or two beside it, over which it blends in"
        assert own[t].mean() > 0.97 * (1 - (filled + 3 * cell) / WIDTH)
    assert stabilise(clip_of(panned(np.zeros(19))))[1].unseen is None, "nothing was moved"


def test_a_fluid_is_not_taken_for_the_camera_while_it_turns():
    _, report = stabilise(clip_of(flowing(panned(5 * np.arange(19)), speed=5)))
    assert report.stabilised and report.drift_px == pytest.approx(45.0, abs=1.0)


def test_of_a_camera_that_turns_away_the_longest_run_of_one_view_is_used():
    steps = np.concatenate([8 * np.arange(6), np.full(12, 44), 44 + 14 * np.arange(1, 15)])
    _, report = stabilise(clip_of(panned(steps)))
    ((first, last),) = report.runs
    assert report.stabilised
    # 72 px are three tenths of the picture: a frame among the first is laid on, and all that see seven tenths of it
    assert np.ptp(steps[first:last]) <= 2 * 0.3 * WIDTH and last - first >= 18
    assert first < 6 and last > 18


def test_a_run_is_the_longest_around_any_frame():
    motions = np.tile(np.eye(3), (40, 1, 1))
    motions[:, 0, 2] = np.where(np.arange(40) < 25, 0.0, 100.0)
    assert steady_run(motions, (200, 100), 0.7) == (0, 25, 20)
    assert steady_run(motions, (200, 100), 0.5)[:2] == (0, 40)


def test_without_features_the_camera_is_assumed_still_and_the_report_says_so():
    black = np.zeros((FRAMES, HEIGHT, WIDTH), np.float32)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH]
    for t in range(FRAMES):
        black[t] += 150.0 * np.exp(-((rows - 150 + 5 * t) ** 2 + (columns - 120) ** 2) / 300.0)
    clip = clip_of(black)
    same, report = stabilise(clip)
    assert same is clip and report.shake_px == 0.0 and report.cuts == ()
    assert "camera-not-seen" in map(code_of, report.warnings)


def rising(frames: int, life: float, half: float) -> np.ndarray:
    """A textured plume before black that rises by 3 px a frame and changes its look with a memory of `life` frames;
    `half` its width over that of the picture."""
    rng = np.random.default_rng(0)
    keep, pattern, shown = np.exp(-1.0 / life), scene(5), []
    for _ in range(frames):
        grain = cv2.GaussianBlur(rng.normal(size=pattern.shape).astype(np.float32), (0, 0), 3.0)
        pattern = np.roll(pattern, -3, axis=0)
        pattern = 120.0 + keep * (pattern - 120.0) + np.sqrt(1.0 - keep**2) * 45.0 * grain / grain.std()
        shown.append(pattern[20 : 20 + HEIGHT, 20 : 20 + WIDTH].copy())
    columns = np.arange(WIDTH)
    return np.stack(shown) * (np.abs(columns - 0.5 * WIDTH) < half * WIDTH)


@pytest.mark.parametrize(("life", "half"), [(6.0, 0.2), (30.0, 0.12)])
def test_a_plume_before_black_does_not_carry_the_camera_along(life, half):
    """It moves as one from frame to frame, and its features are all that there are: followed, it would stand still.
    One that keeps its look for a second is a thing in the dark, and still no scene."""
    frames = rising(48, life, half)
    same, report = stabilise(clip_of(frames))
    assert not report.stabilised and report.drift_px == 0.0 and same.frames.shape == (48, HEIGHT, WIDTH, 3)
    assert "camera-not-seen" in map(code_of, report.warnings)


def test_a_long_way_of_a_camera_over_a_scene_is_believed():
    pan = panned(9 * np.arange(48))
    _, report = stabilise(clip_of(pan), least_overlap=0.3)
    assert report.stabilised and report.drift_px > 150.0


def test_a_cut_is_found_at_the_first_frame_of_the_new_shot():
    clip = clip_of(np.concatenate([shaken(np.zeros((8, 2)), 0), shaken(np.zeros((9, 2)), 5)]))
    same, report = stabilise(clip)
    assert report.cuts == (8,) and report.runs == ((0, 8), (8, 17))
    assert report.shake_px < 0.05, "the jump at the cut is no shake"
    assert same is clip


def test_flicker_flash_and_flow_are_no_cuts():
    still = shaken(np.zeros((FRAMES, 2)))
    flicker = still * (1.0 + 0.3 * np.sin(2.0 * np.arange(FRAMES)))[:, None, None]
    flash = still.copy()
    flash[6] = 255.0
    for pictures in (flicker, flash, flowing(still, speed=9)):
        assert find_cuts(list(np.clip(pictures, 0, 255).astype(np.uint8))) == ()


def test_layouts_are_compared_without_their_brightness_and_contrast():
    layout = np.random.default_rng(0).normal(100.0, 30.0, (18, 32)).astype(np.float32)
    assert unlike(layout, 0.5 * layout + 40.0) == pytest.approx(0.0, abs=1e-5)
    assert unlike(layout, 200.0 - layout) == pytest.approx(2.0, abs=1e-5)
    assert unlike(np.full_like(layout, 9.0), np.full_like(layout, 10.0)) == 0.0


def test_shake_counts_steps_and_drift_counts_distance():
    motions = np.tile(np.eye(3), (11, 1, 1))
    motions[:, 0, 2] = 0.5 * (np.arange(11) - 5)
    shake, drift = shake_and_drift(motions, 100, 80, ())
    assert shake == pytest.approx(0.5) and drift == pytest.approx(2.5)
    assert shake_and_drift(motions[:1], 100, 80, ()) == (0.0, 0.0)


def test_a_clip_of_one_frame_passes_through():
    clip = clip_of(shaken(np.zeros((1, 2))))
    assert stabilise(clip)[0] is clip


def test_a_limit_of_zero_is_an_error():
    with pytest.raises(ValueError, match="least_overlap"):
        stabilise(clip_of(shaken(np.zeros((2, 2)))), least_overlap=0.0)
